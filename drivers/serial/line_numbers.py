"""What a field of a line can be: a number, or nothing where a device has no value."""

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
