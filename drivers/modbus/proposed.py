"""What ``daqsvc sniff modbus`` and ``daqsvc new`` propose alike where nobody has stated it."""

from __future__ import annotations

TIMEOUT_MS = 500.0
"""Of a bus in a machine file; a search takes less, as it waits for every unit that is not there."""


def unit_of_register(raw_type: str) -> str:
    """The unit of a register whose meaning is not known: a float is a quantity, all else a count."""
    return "1" if raw_type.startswith("float") else "count"
