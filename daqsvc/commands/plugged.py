"""What other packages register by entry point for a verb."""

from __future__ import annotations

from collections import Counter
from importlib.metadata import entry_points
from typing import TypeVar

from daqsvc.commands.complaint import complain
from daqsvc.errors.code import PluginCode
from daqsvc.errors.command_line import LEFT_OUT

CODES = "daqsvc.codes"
"""The group of entry points of modules with codes, by the letters of these."""

T = TypeVar("T")

_packages: dict[str, str] = {}
"""By the top-level module of what was made, the distribution that brings it, with its version."""


def plugged(group: str, base: type[T], what: str) -> dict[str, T]:
    """What packages register in a group of entry points, by name, one made of each.

    What cannot be made is left out, and stderr states it: no package may take the others along.

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
            if point.dist is not None:
                home = type(made).__module__.partition(".")[0]
                _packages[home] = f"{point.dist.name} {point.dist.version}"
        else:
            why = f"it is not derived from {base.__name__} of daqsvc.api"
            complain("daqsvc", f"{what} {point.name} is left out: {why}", LEFT_OUT)
    return known


def foreign_words(error: Exception) -> str | None:
    """What code of another package has failed at, in words that name it; None if the error is not of one."""
    from daqsvc.settings import failures  # noqa: PLC0415 - only when something has failed

    failures.packages.update(_packages)
    failed = failures.foreign_failure(error)
    return None if failed is None else f"{failed}"


def plugged_codes() -> dict[str, PluginCode]:
    """The codes of packages, by id; letters that two packages have are left out and reported on stderr."""
    points = {(point.name, point.value): point for point in entry_points(group=CODES)}
    packages = Counter(name for name, _ in points)
    known: dict[str, PluginCode] = {}
    for (letters, value), point in points.items():
        try:
            if packages[letters] > 1:
                raise ValueError(f"two packages have these letters, one of them {value}")  # noqa: TRY301 - as others
            codes = [one for one in vars(point.load()).values() if isinstance(one, PluginCode)]
            if strange := [code.id for code in codes if code.letters != letters]:
                raise ValueError(f"{strange[0]} has other letters than its entry point")  # noqa: TRY301 - as above
        except Exception as error:  # noqa: BLE001 - no package may take the others along
            complain("daqsvc", f"group of codes {letters} is left out: {error}", LEFT_OUT)
            continue
        known |= {code.id: code for code in codes}
    return known
