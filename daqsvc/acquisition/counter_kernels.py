"""Following a counter frame by frame, compiled: any frame costs little, however far its counter leaps.

`daqsvc.acquisition.counter` says what is done here, and why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Integers = NDArray[np.int64]
    Floats = NDArray[np.float64]

RAW, COUNT, SEEN_NS, HIGHEST, SUSPECT, SUSPECTED = range(6)
"""What is remembered of the last frame, as integers: its counter, its place, its arrival; the highest place
so far; a counter that may be that of a restart, and whether there is one."""

LOOKED_AHEAD = 16
"""Frames that are looked at ahead of others, per frame of a batch: those beyond are not waited for."""


class Rules(NamedTuple):
    """By what a counter is followed; all counts but the last three.

    Attributes:
        step: from one frame to the next.
        back: how far a frame may belong behind the last one.
        ahead: how far a frame may seem ahead of the clock.
        modulus: counts to a wrap.
        doubt: falling behind by more than this from one frame to the next is to be explained.
        rate: counts per ns.
        drift: how far the rate may be off.
        watch_ns: how long frames that have fallen behind are watched.
    """

    step: float
    back: float
    ahead: float
    modulus: float
    doubt: float
    rate: float
    drift: float
    watch_ns: float


@njit("int64(int64, int64)", cache=True, nogil=True)
def signed(step: int, unused_bits: int) -> int:
    """A step of a counter: its bits alone, the highest of them the sign, even where the step overflows."""
    return (step << unused_bits) >> unused_bits


@njit(
    "Tuple((boolean, int64))(int64[::1], int64[::1], int64, int64, int64, float64, float64[::1], int64,"
    " int64)",
    cache=True,
    nogil=True,
)
def catches_up(
    raw: Integers,
    arrival_ns: Integers,
    at: int,
    raw_before: int,
    seen_ns: int,
    late: float,
    rules: Floats,
    unused_bits: int,
    most: int,
) -> tuple[bool, int]:
    """Whether frames that have fallen behind were delayed: they come faster than they were sent.

    Args:
        raw: int64 ``[n]``, counters as sent.
        arrival_ns: int64 ``[n]``, host monotonic.
        at: the first frame that has fallen behind.
        raw_before: counter of the frame before it.
        seen_ns: arrival of that frame.
        late: how late that frame was, in counts.
        rules: float64 ``[8]``, see `Rules`.
        unused_bits: of 64.
        most: frames to be looked at.

    Returns:
        And how many frames were looked at.
    """
    _, _, ahead, _, doubt, rate, drift, watch_ns = rules
    end = min(at + most, len(raw))
    last = at
    while last + 1 < end and arrival_ns[last + 1] <= arrival_ns[at] + watch_ns:
        last += 1
    middle_ns = arrival_ns[at] + (arrival_ns[last] - arrival_ns[at]) // 2
    late_then = late_half = late
    half = False
    for k in range(at, last + 1):
        elapsed = (arrival_ns[k] - seen_ns) * rate
        late_then = max(late_then + elapsed * (1.0 - drift) - signed(raw[k] - raw_before, unused_bits), 0.0)
        raw_before, seen_ns = raw[k], arrival_ns[k]
        if not half and arrival_ns[k] >= middle_ns:
            half = True
            # Some are always held in a buffer when a link comes up: what counts is that it goes on.
            late_half = late_then
    return late_then - late <= doubt or late_half - late_then > ahead, last + 1 - at


@njit("int64(int64, float64, float64, float64[::1])", cache=True, nogil=True)
def advance(step: int, elapsed: float, unsure: float, rules: Floats) -> int:
    """Counts from the last frame to one that is ``step`` ahead but for wraps; 0 if none fits the time.

    Args:
        step: signed, modulo a wrap.
        elapsed: counts by the clock.
        unsure: how far those may be off.
        rules: float64 ``[8]``, see `Rules`.
    """
    ahead, modulus = rules[2], rules[3]
    found = step + np.rint((elapsed - step) / modulus) * modulus
    return int(found) if 0.0 < found < 2.0**62 and abs(found - elapsed) <= ahead + unsure else 0


@njit(
    "int64(int64[::1], int64[::1], int64[::1], float64[::1], float64[::1], int64, int64[::1], boolean[::1],"
    " int64[::1])",
    cache=True,
    nogil=True,
)
def follow(
    raw: Integers,
    arrival_ns: Integers,
    last: Integers,
    late: Floats,
    rules: Floats,
    unused_bits: int,
    count: Integers,
    kept: NDArray[np.bool_],
    restarts: Integers,
) -> int:
    """Place the frames of a batch.

    Args:
        raw: int64 ``[n]``, counters as sent.
        arrival_ns: int64 ``[n]``, host monotonic, not decreasing.
        last: int64 ``[6]``, what is remembered of the frame before (`RAW`, ...); changed.
        late: float64 ``[1]``, how late that frame was, in counts; changed.
        rules: float64 ``[8]``, see `Rules`.
        unused_bits: of 64.
        count: int64 ``[n]``, filled with the place of each frame that is kept.
        kept: bool ``[n]``, filled.
        restarts: int64 ``[n]``, filled with the places in the batch where the counter was restarted.

    Returns:
        How many restarts there are.
    """
    step_usual, back, ahead, modulus, doubt, rate, drift, _ = rules
    shift = np.uint64(unused_bits)
    found = 0
    budget = LOOKED_AHEAD * len(raw)
    for at in range(len(raw)):
        step = signed(raw[at] - last[RAW], unused_bits)
        elapsed = (arrival_ns[at] - last[SEEN_NS]) * rate
        before = late[0]
        # What lags by no more than the drift is a slow device, and not read late. None is ahead of its time.
        late_now = max(before + elapsed * (1.0 - drift) - step, 0.0)
        usual = step == step_usual
        # The very next count is no leap ahead of the clock, however fast the device is.
        sane = step >= -back and (usual or step <= elapsed + before + ahead + 2.0 * drift * before)
        # After half a wrap of silence a small step may hide whole wraps, unless it is the very next frame.
        sane = sane and (usual or elapsed + before < modulus / 2.0)
        if sane and late_now - before > doubt:
            sane, looked = catches_up(
                raw, arrival_ns, at, last[RAW], last[SEEN_NS], before, rules, unused_bits, budget
            )
            budget -= looked
        if sane:
            place = last[COUNT] + step
            late[0] = late_now
        else:
            # Either this frame is as late as the one before it, or it has not waited at all.
            ahead_by = advance(step, elapsed, elapsed * drift, rules)
            if ahead_by == 0:
                ahead_by = advance(step, elapsed + before, (elapsed + 2.0 * before) * drift, rules)
            beyond = (np.uint64(raw[at] - last[SUSPECT]) << shift) >> shift
            if ahead_by > 0:
                place = last[COUNT] + ahead_by
                late[0] = max(before + elapsed - ahead_by, 0.0)
            elif last[SUSPECTED] and np.uint64(0) < beyond <= np.uint64(4.0 * step_usual):
                # Never before anything placed already: two samples cannot share an index.
                by_clock = last[COUNT] + np.int64(np.rint(elapsed + before))
                place = max(by_clock, last[HIGHEST] + np.int64(step_usual))
                restarts[found] = at
                found += 1
                late[0] = 0.0
            else:
                last[SUSPECT], last[SUSPECTED] = raw[at], 1
                kept[at] = False
                continue
        kept[at] = True
        count[at] = place
        last[RAW], last[COUNT], last[SEEN_NS] = raw[at], place, arrival_ns[at]
        last[HIGHEST] = max(last[HIGHEST], place)
        last[SUSPECTED] = 0
    return found
