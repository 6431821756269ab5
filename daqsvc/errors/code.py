"""What a code is, and where it is in a message."""

from __future__ import annotations

import re
from dataclasses import dataclass

_ENDS_WITH_CODE = re.compile(r" \[[A-Z]+[0-9]{2}\]\Z")


@dataclass(frozen=True, slots=True)
class Code:
    """A kind of mistake or fault.

    Attributes:
        id: the letter of its group and a number, e.g. ``F01``; never used again for anything else.
        title: what is wrong, as a heading.
        cause: what it means, and what usually leads to it.
        remedy: what to do about it.
        page: where to read on, a page of ``docs/``; may name a heading, e.g. ``alarms.md#votes``.
        example: a message that has it, without the code; a package may leave it empty.
    """

    id: str
    title: str
    cause: str
    remedy: str
    page: str
    example: str = ""

    def __str__(self) -> str:
        return self.id


_OF_PLUGIN = re.compile(r"[A-Z]{2,8}[0-9]{2}")


@dataclass(frozen=True, slots=True)
class PluginCode(Code):
    """A code of a package that adds drivers, detectors or outputs.

    ``id`` is two to eight capital letters, the same in all codes of the package, and two digits, e.g.
    ``ACME01``: codes of daqsvc have one letter, so that no two are alike. ``page`` is the address of a page;
    it may be empty.

    Raises:
        ValueError: the id is none.
    """

    def __post_init__(self) -> None:
        if not _OF_PLUGIN.fullmatch(self.id):
            raise ValueError(
                f"{self.id!r} is no code of a plugin; write two to eight capital letters of your own and two "
                "digits, e.g. ACME01, as one letter is for codes of daqsvc"
            )

    @property
    def letters(self) -> str:
        """Of the package."""
        return self.id[:-2]


def coded(code: Code | None) -> dict[str, Code | None]:
    """What a logger takes as ``extra``: the code is a field of the record, and ends its line."""
    return {"code": code}


def with_code(text: str, code: Code | str | None) -> str:
    """A message with a code at its end: its own if it has one, else this one, given as it is or by its id."""
    if code is None or _ENDS_WITH_CODE.search(text):
        return text
    return f"{text} [{code}]"
