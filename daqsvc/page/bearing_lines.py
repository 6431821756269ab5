"""Where the parts of a machine's bearings are seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from daqsvc.bearing.geometry import BearingGeometry, BearingOrders, bearing_orders

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
        orders = _orders(one)
        parts = {"BPFO": orders.outer, "BPFI": orders.inner, "2 BSF": 2.0 * orders.ball, "FTF": orders.cage}
        for part, order in parts.items():
            yield f"{one.get('name', '')} {part}".strip(), order


def _orders(bearing: dict[str, Any]) -> BearingOrders:
    if (orders := bearing.get("orders")) is not None:
        return BearingOrders(
            inner=orders["bpfi"], outer=orders["bpfo"], ball=orders["bsf"], cage=orders["ftf"]
        )
    if (size := bearing.get("geometry")) is not None:
        diameters = size["ball_diameter_mm"], size["pitch_diameter_mm"]
        return BearingGeometry(size["balls"], *diameters, size.get("contact_deg", 0.0)).orders()
    return bearing_orders(bearing["type"])
