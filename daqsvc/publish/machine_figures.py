"""The figures of one machine, out of those of a box that watches several."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

MACHINES = "machines"
"""Where the figures of a box have those of its machines, if it watches several."""

_NAMED = ("streams", "grids", "detectors")


def of_machine(figures: Mapping[str, Any], machine: str, buses: Collection[str]) -> dict[str, Any]:
    """The figures by the names of the machine's own file: of what belongs to machines, only its own.

    Args:
        figures: as in `daqsvc.publish.payloads.StatusPayload`.
        machine: its name.
        buses: those that it is watched over.
    """
    own = dict(figures)
    machines = own.pop(MACHINES, None)
    if machines is None:
        return own
    prefix = f"{machine}/"
    for kind in _NAMED:
        of_kind = figures[kind].items()
        own[kind] = {name.removeprefix(prefix): one for name, one in of_kind if name.startswith(prefix)}
    own["buses"] = {name: one for name, one in figures["buses"].items() if name in buses}
    own.update(machines[machine])
    return own
