"""All pictures by the name of their file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from make_pictures import (
    alarm_states,
    alignment,
    architecture,
    detectors,
    order_change,
    outbox,
    several_machines,
    timebase,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from matplotlib.figure import Figure

PICTURES: Mapping[str, Callable[[], Figure]] = {
    "architecture": architecture.flow,
    "driver": architecture.driver,
    "layers": architecture.contract,
    "timebase": timebase.picture,
    "alignment": alignment.picture,
    "alarm-states": alarm_states.states,
    "outbox": outbox.picture,
    "order-change": order_change.picture,
    "several-machines": several_machines.picture,
    **{f"detector-{key.replace('_', '-')}": draw for key, draw in detectors.DETECTORS.items()},
}
