"""What the fields of a line are: numbers, or nothing where a device has no value."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from daqsvc.settings.units import QUALIFIER
from drivers.serial.settings import LONGEST_BESIDE

if TYPE_CHECKING:
    from collections.abc import Mapping

NUMBER: Mapping[str, re.Pattern[str]] = {
    mark: re.compile(rf" *[+-]?([0-9]+{re.escape(mark)}?[0-9]*|{re.escape(mark)}[0-9]+)([eE][+-]?[0-9]+)? *")
    for mark in (".", ",")
}
"""A number, by decimal mark."""
ABSENT_WORDS = ("nan", "na", "n/a", "null", "none", "ol", "ovl", "inf", "+inf", "-inf")
"""Words for no value, or for one beyond what the device can measure. ``err`` is none: a code may follow."""
ABSENT = re.compile(rf" *(-*|{'|'.join(map(re.escape, ABSENT_WORDS))}) *", re.IGNORECASE)
"""What devices write where they have no value: nothing, dashes, or a word."""
_POWER = r"(?:\^?[23]|[²³])"
_NAME = rf"[A-Za-z%‰µμ\u2126Ω\u2103\u2109]+{_POWER}?"
_UNIT = rf"(?:°|°?{_NAME}(?:/{_NAME})?|1/[A-Za-z]+)(?i:(?: ?{QUALIFIER})?)"
_WITH_UNIT: Mapping[str, re.Pattern[str]] = {
    mark: re.compile(rf"({number.pattern})({_UNIT}) *") for mark, number in NUMBER.items()
}
_NAMED = re.compile(
    rf" *([^\W\d][\w.-]{{0,{LONGEST_BESIDE - 2}}}[=:])(?=[ +.,0-9-]|$|nan|inf|ol|n/?a|none|null)",
    re.IGNORECASE,
)
_UNPRINTED = re.compile(
    "(?<=[A-Za-z0-9])[\x80-\x9f]{1,2}(?![\x80-\x9f])|(?<![\x80-\x9f])[\x80-\x9f]{1,2}(?=[A-Za-z])|[\xa0\u202f\t]"
)
"""Letters of other tables than Latin-1, such as an umlaut of cp437, beside others; and blanks."""
BLANK = " "
RUN_OF_BLANKS = re.compile(" +")


def fields_of(text: str, separator: str) -> list[str]:
    """The fields of a line.

    A run of blanks is one separator, as devices pad columns with blanks to one width; those at the ends are
    none.
    """
    if separator == BLANK:
        return RUN_OF_BLANKS.split(text.strip(BLANK))
    return text.split(separator)


def text_of(data: bytes) -> str:
    """The text of bytes, of which units may be in UTF-8 or in Latin-1, as the device has it."""
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def encoded(text: str) -> tuple[bytes, bytes]:
    """A text as devices may write it: in UTF-8, and in Latin-1 where that has its letters."""
    try:
        return text.encode(), text.encode("latin-1")
    except UnicodeEncodeError:
        return text.encode(), text.encode()


def is_text(line: str) -> bool:
    """Whether all of a line, as `text_of` has it, is what lines of a device are made of, in any language."""
    return line.isprintable() or _UNPRINTED.sub("", line).isprintable()


def number_within(text: str, prefix: str, suffix: str) -> str | None:
    """The text of a number in a field that has other texts around it, such as its name and its unit.

    A field that states that there is no value may lack these. None if any other one does not have them.
    """
    if prefix and text.lstrip(BLANK).startswith(prefix):
        text = text.lstrip(BLANK).removeprefix(prefix)
    elif prefix:
        return text if ABSENT.fullmatch(text) else None
    if suffix and text.rstrip(BLANK).endswith(suffix):
        text = text.rstrip(BLANK).removesuffix(suffix)
    elif suffix:
        return text if ABSENT.fullmatch(text) else None
    return text


def parts_of(text: str, decimal: str) -> tuple[str, str] | None:
    """The name in front of the number of a field, and the unit behind it; None if there is no number."""
    name = name_before(text)
    bare = text.lstrip(BLANK)[len(name) :]
    unit = "" if NUMBER[decimal].fullmatch(bare) else unit_behind(bare, decimal) or None
    return None if unit is None or len(unit) > LONGEST_BESIDE else (name, unit)


def name_before(text: str) -> str:
    """What looks like a name in front of the number of a field, with its sign; empty if nothing does."""
    match = _NAMED.match(text)
    return "" if match is None else match[1]


def unit_behind(text: str, decimal: str) -> str:
    """What looks like a unit behind the number of a field, with that decimal mark; empty if nothing does."""
    match = _WITH_UNIT[decimal].fullmatch(text)
    return "" if match is None else match[match.re.groups]
