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
ABSENT = re.compile(r" *(-*|nan) *", re.IGNORECASE)
"""What devices write where they have no value: nothing, dashes, or ``nan``."""
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
