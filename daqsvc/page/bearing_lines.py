"""Where the parts of a machine's bearings are seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.bearing.geometry import BearingOrders, bearing_orders

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.page.machine_live import MachineLive


def bearing_lines(live: MachineLive, sensor: str) -> Iterator[tuple[str, float]]:
    """Where the parts of the bearings that a sensor watches are seen, in multiples of the speed.

    Args:
        live: the machine.
        sensor: its name; empty for the bearings of all sensors.
    """
    for one in live.values.get("pipeline", {}).get("bearing", {}).get("bearings", ()):
        if sensor and one.get("sensor", sensor) != sensor:
            continue
        told = one.get("orders")
        orders = (
            bearing_orders(one["type"])
            if told is None
            else BearingOrders(inner=told["bpfi"], outer=told["bpfo"], ball=told["bsf"], cage=told["ftf"])
        )
        parts = {"BPFO": orders.outer, "BPFI": orders.inner, "2 BSF": 2.0 * orders.ball, "FTF": orders.cage}
        for part, order in parts.items():
            yield f"{one.get('name', '')} {part}".strip(), order
