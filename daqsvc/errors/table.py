"""All codes, by group."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

from daqsvc.errors import alarms, buses, command_line, detectors, machine_file, outputs, recordings, service
from daqsvc.errors.code import Code

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import ModuleType

GROUPS: Mapping[str, ModuleType] = MappingProxyType(
    {
        "C": command_line,
        "F": machine_file,
        "R": recordings,
        "B": buses,
        "D": detectors,
        "A": alarms,
        "O": outputs,
        "S": service,
    }
)
"""The module of each group, by its letter."""

CODES: Mapping[str, Code] = MappingProxyType(
    {one.id: one for group in GROUPS.values() for one in vars(group).values() if isinstance(one, Code)}
)
"""Every code, by its id, in the order of the groups."""


def group_title(letter: str) -> str:
    """What the errors of a group are about."""
    return (GROUPS[letter].__doc__ or "").partition("\n")[0].rstrip(".")
