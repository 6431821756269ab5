"""Numbers of things in sentences for people."""

from __future__ import annotations


def counted(number: int, what: str) -> str:
    """A number of things: ``1 machine``, ``2 machines``, ``1,000 known faults``.

    Args:
        number: of them.
        what: one of them is called; its plural ends with an s.
    """
    return f"{number:,} {what}{'' if number == 1 else 's'}"
