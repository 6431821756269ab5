"""Times as loggers write them into text: dates of several countries, with and without a fraction."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Times: TypeAlias = NDArray[np.datetime64]
    Whole: TypeAlias = NDArray[np.int64]

Holds = Literal["both", "date", "time"]
"""What a cell holds: a date and a time of the day, or one of them."""

_CLOCK = (
    r"(?P<h>\d{1,2}):(?P<min>\d{2})(?::(?P<s>\d{2})(?:[.,](?P<f>\d{1,9})\d*)?)?"
    r"(?:\s?(?P<half>[AaPp][Mm]))?(?:\s?(?:Z|UTC|[+-]\d{2}:?\d{2}))?"
)
_DATES = (
    r"(?P<y>\d{4})-(?P<m>\d{2})-(?P<d>\d{2})",
    r"(?P<y>\d{4})/(?P<m>\d{1,2})/(?P<d>\d{1,2})",
    r"(?P<d>\d{1,2})\.(?P<m>\d{1,2})\.(?P<y>\d{4})",
    r"(?P<d>\d{1,2})[/-](?P<m>\d{1,2})[/-](?P<y>\d{4})",
    r"(?P<m>\d{1,2})[/-](?P<d>\d{1,2})[/-](?P<y>\d{4})",
)
"""A day stands before the month where both can be meant: only the distance between two times is looked at."""

_NS_PER_S = 10**9
_DAY_NS = 86_400 * _NS_PER_S
_LARGEST = {"m": 12, "d": 31, "h": 23, "min": 59, "s": 60}


@dataclass(frozen=True, slots=True)
class TimeFormat:
    """How the times in a column are written.

    Attributes:
        pattern: of a cell.
        holds: what is in it.
    """

    pattern: re.Pattern[str]
    holds: Holds

    def fits(self, cell: str) -> bool:
        """Whether a cell is such a time."""
        found = self.pattern.fullmatch(cell)
        return found is not None and all(
            int(digits) <= _LARGEST[name]
            for name, digits in found.groupdict().items()
            if name in _LARGEST and digits
        )


FORMATS = (
    *(TimeFormat(re.compile(rf"{date}[T ]\s?{_CLOCK}"), "both") for date in _DATES),
    *(TimeFormat(re.compile(date), "date") for date in _DATES),
    TimeFormat(re.compile(_CLOCK), "time"),
)


def format_of(cells: Sequence[str]) -> TimeFormat | None:
    """The format of all cells of a column that are not empty; None if they are no times."""
    written = [cell for cell in cells if cell]
    if not written:
        return None
    return next((one for one in FORMATS if all(map(one.fits, written))), None)


def times_of(cells: Sequence[str], form: TimeFormat) -> Times:
    """Times datetime64[ns] ``[n]``, of a clock alone since midnight of 1970-01-01; NaT where there is none.

    A zone is left out, as only the distance between two times is looked at.
    """
    fields = _of_one_shape(cells, form)
    if fields is None:
        matches = [form.pattern.fullmatch(cell) for cell in cells]
        fields = {
            name: np.array([_number(match, name) for match in matches], np.int64)
            for name in form.pattern.groupindex
        }
        missing = np.array([match is None for match in matches])
    else:
        missing = np.zeros(len(cells), np.bool_)
    return _joined(fields, missing)


def in_turn(times: Times) -> Times:
    """Times of a clock alone, a day later behind each midnight."""
    steps = np.diff(times.astype(np.int64))
    known = ~(np.isnat(times[1:]) | np.isnat(times[:-1]))
    days = np.cumsum(known & (steps < -_DAY_NS // 2))
    later = times.copy()
    later[1:] += (days * _DAY_NS).astype("timedelta64[ns]")
    return later


def _number(match: re.Match[str] | None, name: str) -> int:
    text = None if match is None else match[name]
    if text is None:
        return 0
    if name == "half":
        return 1 if text[0] in "Aa" else 2
    return int(text.ljust(9, "0")) if name == "f" else int(text)


def _of_one_shape(cells: Sequence[str], form: TimeFormat) -> dict[str, Whole] | None:
    """The fields, where all cells have their digits in the places of the first one; else None."""
    first = form.pattern.fullmatch(cells[0])
    text = np.array(cells)
    if first is None or first.groupdict().get("half") or len(cells[0]) * 4 != text.dtype.itemsize:
        return None
    codes = text.view(np.uint32).reshape(len(cells), -1).astype(np.int64)
    digits = np.array([letter.isdecimal() for letter in cells[0]])
    values = codes - ord("0")
    inside = values[:, digits]
    if (codes[:, ~digits] != codes[0, ~digits]).any() or (inside < 0).any() or (inside > 9).any():
        return None
    fields = {}
    for name in form.pattern.groupindex:
        begin, end = first.span(name)
        if begin < 0:
            fields[name] = np.zeros(len(cells), np.int64)
            continue
        scale = 9 if name == "f" else end - begin
        weights = 10 ** np.arange(scale - 1, scale - 1 - (end - begin), -1, dtype=np.int64)
        fields[name] = values[:, begin:end] @ weights
    return fields


def _joined(fields: dict[str, Whole], missing: NDArray[np.bool_]) -> Times:
    zero = np.zeros(len(missing), np.int64)
    out = missing.copy()
    for name, largest in _LARGEST.items():
        if name in fields:
            out |= fields[name] > largest
    ns = zero.copy()
    if "h" in fields:
        half = fields.get("half", zero)
        hours = np.where(half > 0, fields["h"] % 12 + 12 * (half == 2), fields["h"])
        ns += ((hours * 60 + fields["min"]) * 60 + fields["s"]) * _NS_PER_S + fields["f"]
    if "y" in fields:
        out |= (fields["m"] < 1) | (fields["d"] < 1) | (fields["y"] < 1678) | (fields["y"] > 2261)
        months = np.where(out, 0, 12 * (fields["y"] - 1970) + fields["m"] - 1).astype("datetime64[M]")
        days = months.astype("datetime64[D]").astype(np.int64) + np.where(out, 0, fields["d"] - 1)
        ns += days * _DAY_NS
    times = ns.astype("datetime64[ns]")
    times[out] = np.datetime64("NaT")
    return times
