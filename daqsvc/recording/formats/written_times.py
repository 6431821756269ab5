"""Times as loggers write them into text: dates of several countries, with and without a fraction."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

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
    r"(?:\s?(?P<half>[AaPp][Mm]))?(?:\s?(?P<zone>Z|UTC|(?P<sign>[+-])(?P<zh>\d{2})(?::?(?P<zmin>\d{2}))?))?"
)
_DATES = (
    r"(?P<y>\d{4})-(?P<m>\d{2})-(?P<d>\d{2})",
    r"(?P<y>\d{4})/(?P<m>\d{1,2})/(?P<d>\d{1,2})",
    r"(?P<d>\d{1,2})\.(?P<m>\d{1,2})\.(?P<y>\d{4})",
    r"(?P<d>\d{1,2})[/-](?P<m>\d{1,2})[/-](?P<y>\d{4})",
    r"(?P<m>\d{1,2})[/-](?P<d>\d{1,2})[/-](?P<y>\d{4})",
)
"""Of the last two, the day or the month first, the rows of a column decide where both can be meant."""

_NS_PER_S = 10**9
_DAY_NS = 86_400 * _NS_PER_S
_SMALL = 0x20
"""The bit that makes a letter a small one."""
_LARGEST = {"m": 12, "d": 31, "h": 23, "min": 59, "s": 60, "zh": 15, "zmin": 59}


@dataclass(frozen=True, slots=True)
class TimeFormat:
    """How the times in a column are written.

    Attributes:
        pattern: of a cell.
        holds: what is in it.
        either: the day, which the pattern has first, and the month may be the other way round.
        halves: there is AM or PM behind the time of the day.
    """

    pattern: re.Pattern[str]
    holds: Holds
    either: bool = False
    halves: bool = False

    def fits(self, cell: str) -> bool:
        """Whether a cell is such a time."""
        match = self.pattern.fullmatch(cell)
        return match is not None and all(
            int(digits) <= _LARGEST[name]
            for name, digits in match.groupdict().items()
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
    fitting = [one for one in FORMATS if all(map(one.fits, written))]
    if not fitting:
        return None
    match = fitting[0].pattern.fullmatch(written[0])
    halves = match is not None and bool(match.groupdict().get("half"))
    return replace(fitting[0], either=len(fitting) > 1, halves=halves)


@dataclass(frozen=True, slots=True)
class WrittenTimes:
    """Times of a column as they are written.

    Attributes:
        times: datetime64[ns] ``[n]``, of a clock alone since midnight of 1970-01-01; NaT where there is none.
        others: the same with day and month the other way round; None where that cannot be meant.
        offsets_ns: int64 ``[n]``, what the clock is ahead of UTC, 0 where no zone is written; None if none.
        zoned: bool ``[n]``, whether a zone is written; None as above.
    """

    times: Times
    others: Times | None = None
    offsets_ns: Whole | None = None
    zoned: NDArray[np.bool_] | None = None


def times_of(cells: Sequence[str], form: TimeFormat) -> WrittenTimes:
    """The times of a column, or of a piece of it, that is written in a format."""
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
    others = None
    if form.either:
        others = _joined({**fields, "d": fields["m"], "m": fields["d"]}, missing)
    times = _joined(fields, missing)
    if "zone" not in fields or not fields["zone"].any():
        return WrittenTimes(times, others)
    offsets_ns = fields["sign"] * (fields["zh"] * 60 + fields["zmin"]) * 60 * _NS_PER_S
    return WrittenTimes(times, others, offsets_ns, fields["zone"] > 0)


class EitherDateError(ValueError):
    """Nothing shows which of two numbers is the day and which is the month."""


class ColumnTimes(NamedTuple):
    """The times of a whole column.

    Attributes:
        times: datetime64[ns] ``[n]``, in UTC where each names its zone, else as the clock on the wall had
            them.
        is_dated: whether their day is known, where the column has one.
    """

    times: Times
    is_dated: bool


def joined_times(pieces: Sequence[WrittenTimes], form: TimeFormat, length: int) -> ColumnTimes:
    """The times of a whole column.

    Args:
        pieces: of the column, one behind the other.
        form: how it is written.
        length: rows of the table.

    Raises:
        EitherDateError: day and month can be meant both ways, and the rows show neither.
    """
    times = np.concatenate([piece.times for piece in pieces])[:length]
    others = [piece.others for piece in pieces if piece.others is not None]
    is_dated = True
    if form.either:
        # Before the zones, which may carry the rows of one day over midnight.
        times, is_dated = _of_two_ways(times, np.concatenate(others)[:length], halves=form.halves)
    offsets_ns = [piece.offsets_ns for piece in pieces if piece.offsets_ns is not None]
    zoned = [piece.zoned for piece in pieces if piece.zoned is not None]
    if len(zoned) < len(pieces):
        return ColumnTimes(times, is_dated)
    # A zone that some rows name and others do not shows nothing of these.
    if (np.concatenate(zoned)[:length] | np.isnat(times)).all():
        times = times - np.concatenate(offsets_ns)[:length].astype("timedelta64[ns]")
    return ColumnTimes(times, is_dated)


def _is_same_day(times: Times) -> bool:
    """Whether all times that are known are of one date."""
    days = times[~np.isnat(times)].astype("datetime64[D]")
    return not len(days) or bool((days == days[0]).all())


def _of_two_ways(day_first: Times, month_first: Times, *, halves: bool) -> ColumnTimes:
    """The way to read dates in which every one is a date, and the rows go on by less than a day.

    Raises:
        EitherDateError: both or neither are such a way.
    """
    lacking = [int(np.isnat(times).sum()) for times in (day_first, month_first)]
    if lacking[0] != lacking[1]:
        return ColumnTimes(day_first if lacking[0] < lacking[1] else month_first, is_dated=True)
    leaps = [_leaps(times) for times in (day_first, month_first)]
    if leaps[0] != leaps[1]:
        return ColumnTimes(month_first if leaps[0] else day_first, is_dated=True)
    # Who writes AM and PM mostly writes the month first.
    if halves:
        return ColumnTimes(month_first, is_dated=True)
    # On one day the distances, and so the rate, are the same either way.
    if not leaps[0] and _is_same_day(day_first):
        return ColumnTimes(day_first, is_dated=False)
    raise EitherDateError


def _leaps(times: Times) -> bool:
    known = times[~np.isnat(times)].astype(np.int64)
    return bool((np.abs(np.diff(known)) > _DAY_NS).any())


def in_turn(times: Times) -> Times:
    """Times of a clock alone, a day later behind each midnight."""
    # From one known time to the next: midnight may pass where the time is not known.
    known = np.flatnonzero(~np.isnat(times))
    steps = np.diff(times[known].astype(np.int64))
    days = np.cumsum(steps < -_DAY_NS // 2)
    later = times.copy()
    later[known[1:]] += (days * _DAY_NS).astype("timedelta64[ns]")
    return later


def _number(match: re.Match[str] | None, name: str) -> int:
    text = None if match is None else match[name]
    if text is None:
        return 0
    if name == "half":
        return 1 if text[0] in "Aa" else 2
    if name == "zone":
        return 1
    if name == "sign":
        return -1 if text == "-" else 1
    return int(text.ljust(9, "0")) if name == "f" else int(text)


def _of_one_shape(cells: Sequence[str], form: TimeFormat) -> dict[str, Whole] | None:
    """The fields, where all cells have their digits in the places of the first one; else None."""
    first = form.pattern.fullmatch(cells[0])
    text = np.array(cells)
    if first is None or len(cells[0]) * 4 != text.dtype.itemsize:
        return None
    codes = text.view(np.uint32).reshape(len(cells), -1).astype(np.int64)
    digits = np.array([letter.isdecimal() for letter in cells[0]])
    same = ~digits
    fields = {}
    if first.groupdict().get("half"):
        begin, _ = first.span("half")
        letters = codes[:, begin] | _SMALL
        if not np.isin(letters, [ord("a"), ord("p")]).all():
            return None
        fields["half"] = np.where(letters == ord("a"), 1, 2)
        same[begin] = False
    values = codes - ord("0")
    inside = values[:, digits]
    if (codes[:, same] != codes[0, same]).any() or (inside < 0).any() or (inside > 9).any():
        return None
    for name in form.pattern.groupindex:
        begin, end = first.span(name)
        if name in fields:
            continue
        if begin < 0 or name in {"zone", "sign"}:
            fields[name] = np.full(len(cells), _number(first, name), np.int64)
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
