"""The line from a device's sample count to host time, under arrivals that come late and never early.

Two lines compete. The **support** lies under the earliest arrivals where it fits the window best (the
linear programme of Moon, Skelly and Towsley, INFOCOM 1999, solved on the lower convex hull). With N
arrivals whose delay is often close to the least one, its error is about delay / N, and no load of the host
moves it. Where a small delay is rare the support hangs on two lucky arrivals; there the **mean** line, of
least squares through all arrivals and lowered until it touches, errs less.

How far the line may be off is estimated from the earliest arrivals of parts of the window. The constants
below make that a 95th percentile for delays whose least value is not rare (uniform, exponential, in bursts),
and about the 85th for others: tests/acquisition/test_alignment_clocks.py draws them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.kernels import njit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

PARTS = 6
"""Parts of the window that a line is compared with: the earliest arrival of each should lie on it."""
SOFT = 0.5
"""The mean line is taken if its slope is sure, at the window's end, to so much of the support's gap."""
_LEAST_GROWTH = 1.3
"""Of the gap from parts to parts of these; 6 where small delays are frequent, nearing 1 as they get rare."""
_SUPPORT_ERROR = (2.5, 3.0)
"""The support's error in units of the gap, and of how far it lies above the least delay."""
_MEAN_ERROR = (1.0, 2.5)
_CALM = 2.0
"""The latest of six parts may make the mean gap so many times that of the rest; the host was busy then."""
_HEARD = 0.5
"""Of its share of the arrivals, what a part must have to be compared with the line."""
_STALLED = 10.0
"""Arrivals later by more than so many times the median come from a stall, and bend the mean line."""
_LEAST_USUAL = 6
"""Of such means as the mean line is drawn through: one through fewer has no evidence against it."""
_SIGMAS = 2.0
_TOUCHES_NS = 1e-3


class Bucket(NamedTuple):
    """Arrivals of a short while, in samples and ns since the first one.

    Attributes:
        x: sample count of the earliest arrival, by the line of its time.
        y_ns: when it arrived.
        arrivals: how many arrivals there were.
        mean_x: mean of their sample counts.
        mean_late_ns: mean of their arrival times behind the nominal line.
    """

    x: int
    y_ns: int
    arrivals: int
    mean_x: float
    mean_late_ns: float


class ClockLine(NamedTuple):
    """An estimated line: arrival at ``x * (nominal period + slope) + offset``, and how far it may be off.

    Attributes:
        slope_ns: ns per sample beyond the nominal period.
        offset_ns: at sample 0.
        error_ns: 95th percentile of the line's error at the end of the window.
    """

    slope_ns: float
    offset_ns: float
    error_ns: float


def clock_line(
    buckets: Sequence[Bucket] | Floats, nominal_ns: float, slopes_ns: tuple[float, float]
) -> ClockLine | None:
    """The better of the two lines.

    Args:
        buckets: at least one; also as float64 ``[n, 5]``. Of those with the same sample count the earliest is
            taken: a count that comes again shows nothing of the clock.
        nominal_ns: nominal time between samples.
        slopes_ns: least and greatest slope, ns per sample beyond the nominal period.

    Returns:
        None if all buckets have the same sample count, or have come at the same time: no line can be fitted.
    """
    table = _one_for_each_count(np.ascontiguousarray(buckets, np.float64))
    found, *line = _line_under(table, nominal_ns, *slopes_ns)
    return ClockLine(*line) if found else None


def _one_for_each_count(table: Floats) -> Floats:
    """Buckets ``[n, 5]`` in the order of their sample counts, the earliest of each."""
    if (table[1:, 0] > table[:-1, 0]).all():
        return table
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    first = np.ones(len(table), np.bool_)
    first[1:] = table[1:, 0] != table[:-1, 0]
    return table[first]


@njit("float64(float64[::1])", cache=True, nogil=True, error_model="numpy")
def _median(values: Floats) -> float:
    """``numpy.median``, by the sort that is compiled anyway."""
    ranked, middle = np.sort(values), len(values) // 2
    return float(ranked[middle] if len(values) % 2 else (ranked[middle - 1] + ranked[middle]) / 2.0)


@njit(
    "Tuple((float64, float64, float64))(float64[::1], float64[::1], float64[::1], float64)",
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _touching(x: Floats, late: Floats, along: Floats, slope: float) -> tuple[float, float, float]:
    """The line of a given slope under all arrivals.

    The earliest arrivals of the window's parts lie above it: the fewer arrivals, the later their earliest.
    How that grows from the window to its parts, and to parts of these, tells how late the earliest of all is.

    Returns:
        Offset of the line; mean gap between it and the earliest arrivals of the parts; how far it is
        estimated to lie above the least delay there is.
    """
    above = late - slope * x
    offset = above.min()
    gaps = np.empty(2)
    for k in range(2):
        parts = PARTS if k == 0 else PARTS**2
        least = np.full(parts, np.inf)
        come = np.zeros(parts)
        for i in range(len(x)):
            part = int(min(along[i] * parts, parts - 1.0))
            least[part] = min(least[part], above[i] - offset)
            come[part] += 1.0
        # What comes at once after a stall tells how long that was, and nothing of the clock.
        ranked = np.sort(least[come * parts >= _HEARD * len(x)])
        calm = ranked[: len(ranked) - int(np.rint(len(ranked) / PARTS))]
        gaps[k] = min(ranked.mean(), _CALM * calm.mean())
    gap, fine_gap = gaps
    if gap <= 0.0:
        # Too few arrivals: the line touches one in each part, and the others carry all the information.
        gap = above.mean() - offset
        return offset, gap, gap
    growth = min(max(fine_gap / gap - 1.0, _LEAST_GROWTH), float(PARTS))
    return offset, gap, gap / (growth - 1.0)


@njit("float64(float64[::1], float64[::1])", cache=True, nogil=True, error_model="numpy")
def _support_slope(x: Floats, late: Floats) -> float:
    """Slope of the edge of the lower convex hull that spans the mean of ``x``.

    Args:
        x: float64 ``[n]``, rising, at least two.
        late: float64 ``[n]``.
    """
    split = min(max(int(np.searchsorted(x, x.mean(), side="right")), 1), len(x) - 1)
    left, right = 0, len(x) - 1
    slope = 0.0
    # Each step lowers the line where the sides meet, and there are only so many points.
    for _ in range(len(x)):
        slope = (late[right] - late[left]) / (x[right] - x[left])
        lowest = int(np.argmin(late - slope * x))
        if late[lowest] - late[left] >= slope * (x[lowest] - x[left]) - _TOUCHES_NS:
            break
        if lowest < split:
            left = lowest
        else:
            right = lowest
    return slope


@njit(
    "UniTuple(float64, 2)(float64[::1], float64[::1], float64[::1])",
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _mean_slope(arrivals: Floats, x: Floats, late: Floats) -> tuple[float, float]:
    """Slope of least squares, and by how much it may be off at the end of the window, in ns.

    How far it may be off comes from the means of the window's parts, since neighbouring delays are alike.
    """
    weight = arrivals / arrivals.sum()
    centred = x - (weight * x).sum()
    moment = (weight * centred**2).sum()
    reach = centred[-1] - centred[0]
    if not (moment > 0.0 and reach > 0.0):
        return 0.0, np.inf
    slope = (weight * centred * late).sum() / moment
    left = late - (weight * late).sum() - slope * centred
    share, means = np.zeros(2 * PARTS), np.zeros(2 * PARTS)
    for i in range(len(x)):
        part = int(min((centred[i] - centred[0]) * (2 * PARTS / reach), 2 * PARTS - 1.0))
        share[part] += weight[i]
        means[part] += weight[i] * left[i]
    there = share > 0.0
    squares = (means[there] ** 2 / share[there]).sum()
    deviation = np.sqrt(squares / max(there.sum() - 2, 1))
    return slope, _SIGMAS * deviation * np.abs(centred).max() / np.sqrt(moment)


@njit(
    "Tuple((boolean, float64, float64, float64))(float64[:, ::1], float64, float64, float64)",
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _line_under(
    table: Floats, nominal_ns: float, least_slope: float, greatest_slope: float
) -> tuple[bool, float, float, float]:
    """The better of the two lines under buckets with rising sample counts; see `clock_line`.

    Returns:
        Whether there is a line; its slope, its offset and its error, in the order of `ClockLine`.
    """
    first_ns, span_ns = table[:, 1].min(), table[:, 1].max() - table[:, 1].min()
    # From the window's beginning on: a device may have counted for months.
    begin = table[0, 0]
    x, mean_x = table[:, 0] - begin, table[:, 3] - begin
    if not (x[-1] > 0.0 and span_ns > 0.0):
        return False, 0.0, 0.0, 0.0
    late, mean_late = table[:, 1] - table[:, 0] * nominal_ns, table[:, 4].copy()
    slope = min(max(_support_slope(x, late), least_slope), greatest_slope)
    along = (table[:, 1] - first_ns) / span_ns
    offset, gap, missed = _touching(x, late, along, slope)
    behind = mean_late - slope * mean_x
    behind -= behind.min()
    usual = behind <= _STALLED * _median(behind)
    mean_slope, spread_ns = _mean_slope(table[:, 2][usual], mean_x[usual], mean_late[usual])
    likely = least_slope <= mean_slope <= greatest_slope
    if usual.sum() < _LEAST_USUAL or spread_ns > SOFT * gap or not likely:
        return True, slope, offset - slope * begin, _SUPPORT_ERROR[0] * gap + _SUPPORT_ERROR[1] * missed
    offset, gap, missed = _touching(x, late, along, mean_slope)
    error_ns = spread_ns + _MEAN_ERROR[0] * gap + _MEAN_ERROR[1] * missed
    return True, mean_slope, offset - mean_slope * begin, error_ns
