"""What other packages register by entry point for a verb."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TypeVar

from daqsvc.commands.complaint import complain
from daqsvc.errors.command_line import LEFT_OUT

T = TypeVar("T")


def plugged(group: str, base: type[T], what: str) -> dict[str, T]:
    """What packages register in a group of entry points, by name, one made of each.

    What cannot be made is left out, and stderr says so: no package may take the others along.

    Args:
        group: of entry points.
        base: class of `daqsvc.api` that each must derive from.
        what: what they are, for that line.
    """
    known: dict[str, T] = {}
    for point in entry_points(group=group):
        try:
            made = point.load()()
        except Exception as error:  # noqa: BLE001 - see above
            complain("daqsvc", f"{what} {point.name} is left out: {error}", LEFT_OUT)
            continue
        if isinstance(made, base):
            known[point.name] = made
        else:
            why = f"it is not derived from {base.__name__} of daqsvc.api"
            complain("daqsvc", f"{what} {point.name} is left out: {why}", LEFT_OUT)
    return known
