"""What the fields of a line are: numbers, or nothing where a device has no value."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

NUMBER: Mapping[str, re.Pattern[str]] = {
    mark: re.compile(rf" *[+-]?(\d+{re.escape(mark)}?\d*|{re.escape(mark)}\d+)([eE][+-]?\d+)? *")
    for mark in (".", ",")
}
"""A number, by decimal mark."""
ABSENT_WORDS = ("nan", "na", "n/a", "null", "none", "ol", "ovl", "inf", "+inf", "-inf")
"""Words for no value, or for one beyond what the device can measure. ``err`` is none: a code may follow."""
ABSENT = re.compile(rf" *(-*|{'|'.join(map(re.escape, ABSENT_WORDS))}) *", re.IGNORECASE)
"""What devices write where they have no value: nothing, dashes, or a word."""
_UNIT = r"[A-Za-z%]+[23]?(?:/[A-Za-z]+[23]?)?|[A-Za-z]+\^[23]|[A-Za-z]+/[A-Za-z]+\^[23]|1/[A-Za-z]+"
_WITH_UNIT: Mapping[str, re.Pattern[str]] = {
    mark: re.compile(rf"({number.pattern})({_UNIT}) *") for mark, number in NUMBER.items()
}
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


def number_before(text: str, suffix: str) -> str | None:
    """The text of a number in a field that has another text behind it, such as its unit.

    A field that states that there is no value may lack that text. None if any other one does not end with it.
    """
    if suffix and not text.rstrip(BLANK).endswith(suffix):
        return text if ABSENT.fullmatch(text) else None
    return text.rstrip(BLANK).removesuffix(suffix) if suffix else text


def unit_behind(text: str, decimal: str) -> str:
    """What looks like a unit behind the number of a field, with that decimal mark; empty if nothing does."""
    found = _WITH_UNIT[decimal].fullmatch(text)
    return "" if found is None else found[found.re.groups]
