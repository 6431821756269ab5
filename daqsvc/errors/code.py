"""What a code is, and where it stands in a message."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Code:
    """A kind of mistake or fault.

    Attributes:
        id: the letter of its group and a number, e.g. ``F01``; never used again for anything else.
        title: what is wrong, as a heading.
        cause: what it means, and what usually leads to it.
        remedy: what to do about it.
        page: where to read on, a page of ``docs/``; may name a heading, e.g. ``alarms.md#votes``.
        example: a message that has it, without the code; empty where the reference shows none.
    """

    id: str
    title: str
    cause: str
    remedy: str
    page: str
    example: str = ""

    def __str__(self) -> str:
        return self.id


def coded(code: Code | None) -> dict[str, Code | None]:
    """What a logger takes as ``extra``: the code is a field of the record, and ends its line."""
    return {"code": code}


def with_code(text: str, code: Code | None) -> str:
    """A message with its code at the end, once; as it is without one, e.g. that of a plugin from outside."""
    if code is None or text.endswith(f"[{code}]"):
        return text
    return f"{text} [{code}]"
