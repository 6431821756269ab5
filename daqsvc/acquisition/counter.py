"""Unwrapping a device's sample counter, and telling a wrap from a loss from a restart.

The counter states where a frame belongs; the time of arrival only decides what the counter cannot: how
often it wrapped during an outage, and whether it was restarted.

Samples may arrive late, but never early. So a counter that is ahead of the clock was restarted; one that is
behind it was restarted too, unless its frames were delayed on their way: then they catch up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.kernels import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Integers = NDArray[np.int64]
    Floats = NDArray[np.float64]

RAW, COUNT, SEEN_NS, HIGHEST, SUSPECT, SUSPECTED = range(6)
"""What is remembered of the last frame, as integers: its counter, its place, its arrival; the highest place
so far; a counter that may be that of a restart, and whether there is one."""

LOOKED_AHEAD = 16
"""Frames that are examined ahead of others, per frame of a batch: those beyond are not waited for."""


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
        most: frames to be examined.

    Returns:
        And how many frames were examined.
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
    counts = step + np.rint((elapsed - step) / modulus) * modulus
    return int(counts) if 0.0 < counts < 2.0**62 and abs(counts - elapsed) <= ahead + unsure else 0


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
    n_restarts = 0
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
                # The frame before was the first of the new count; it may have been of another batch.
                first = max(at - 1, 0)
                until_first = (arrival_ns[first] - last[SEEN_NS]) * rate
                by_clock = last[COUNT] + np.int64(np.rint(until_first + before))
                # Never before anything placed already: two samples cannot share an index.
                place = max(by_clock, last[HIGHEST] + np.int64(step_usual))
                restarts[n_restarts] = first
                n_restarts += 1
                late[0] = 0.0
                if first < at:
                    kept[first], count[first] = True, place
                    place += np.int64(beyond)
                    late[0] = max((elapsed - until_first) * (1.0 - drift) - beyond, 0.0)
            else:
                last[SUSPECT], last[SUSPECTED] = raw[at], 1
                kept[at] = False
                continue
        kept[at] = True
        count[at] = place
        last[RAW], last[COUNT], last[SEEN_NS] = raw[at], place, arrival_ns[at]
        last[HIGHEST] = max(last[HIGHEST], place)
        last[SUSPECTED] = 0
    return n_restarts


JITTER_NS = 50_000_000
"""How far a frame may seem ahead of the host clock; five times the jitter that we promise to tolerate."""

DRIFT = 0.01
"""How far a device's rate may be off its nominal one, while the time base has not measured it."""

DOUBT_NS = NS_PER_S // 2
"""A counter that falls behind the clock by more than this from one frame to the next is to be explained."""

WATCH_NS = NS_PER_S
"""How long frames that have fallen behind are watched: those that were delayed catch up, others do not."""


_DOUBT, _RATE, _DRIFT = (Rules._fields.index(name) for name in ("doubt", "rate", "drift"))

LEAST_BITS, MOST_BITS = 4, 64
"""How wide a counter may be: one of fewer bits wraps within a few frames, and cannot show a gap."""

_FIRST_BITS = 32
"""A wider counter begins at so many of its low bits: far from the end of the integers that count on."""


class CounterUnwrapper:
    """Follows one device's counter of 4 to 64 bits, which begins again at 0 after all ones.

    A frame is taken by its sequence alone while that agrees with the host clock. Where it does not,
    the number of missed wraps comes from the clock. A counter that no number of wraps can explain is
    kept only if the next frame of the batch continues from it: then it is a restart. The last frame of a
    batch may come once more, as the first one of the next.

    Frames that waited in a buffer, because the process was suspended, arrive late and all at once. If the
    buffer overflowed, the first frame after them is a long step ahead in no time: such a step may be as long
    as the frames before it were late. Frames that have fallen behind and do not catch up were not late: the
    device was restarted and has counted past its old count meanwhile, or it has not counted for a while.
    Which it is shows in what comes next: a batch that `wants_more` is placed together with that.

    With ``M`` counts to a wrap, outages are resolved exactly while ``M`` lasts longer than twice the
    arrival jitter. A restart inside the reorder window cannot be told from late frames.

    Args:
        bits: width of the counter.
        step: counts from one frame to the next.
        rate_hz: nominal counts per second.
        reorder_counts: how far back a frame may belong that was overtaken on its way.
    """

    def __init__(self, bits: int, step: int, rate_hz: float, reorder_counts: int) -> None:
        if not LEAST_BITS <= bits <= MOST_BITS:
            raise ValueError(f"a counter has {LEAST_BITS} to {MOST_BITS} bits, not {bits}")
        if not 0 < step < 2 ** (bits - 2):
            raise ValueError(f"a {bits}-bit counter cannot tell frames of {step} counts apart; make it wider")
        self._unused_bits = MOST_BITS - bits
        self._step = step
        self._nominal_rate = rate_hz / NS_PER_S
        self._doubt_ns = max(DOUBT_NS, round(2 * step / self._nominal_rate))
        self.watch_ns = max(WATCH_NS, round(2 * step / self._nominal_rate))
        """How long a batch that `wants_more` may have to wait for what comes after it."""
        modulus = 2**bits
        self._nominal_rules = Rules(
            step=step,
            back=min(reorder_counts, modulus // 4),
            ahead=min(JITTER_NS * self._nominal_rate, modulus / 4),
            modulus=modulus,
            doubt=self._doubt_ns * self._nominal_rate,
            rate=self._nominal_rate,
            drift=DRIFT,
            watch_ns=self.watch_ns,
        )
        self._rules = np.array(self._nominal_rules, np.float64)
        self._started = False
        self._first: int | None = None
        self._last = np.zeros(6, np.int64)
        self._late = np.zeros(1)

    @property
    def last_count(self) -> int:
        """Where the last frame was placed."""
        return int(self._last[COUNT])

    def measured(self, rate_hz: float, drift: float) -> None:
        """Take the device's rate as it has been measured.

        Args:
            rate_hz: counts per second.
            drift: how far it may be off, relative; `DRIFT` is the most that is believed.
        """
        rate = rate_hz / NS_PER_S
        if abs(rate / self._rules[_RATE] - 1.0) > DRIFT:
            self._late[0] = 0.0  # that was against another rate
        rules = self._nominal_rules._replace(rate=rate, drift=min(drift, DRIFT), doubt=self._doubt_ns * rate)
        self._rules = np.array(rules, np.float64)

    def forget_rate(self) -> None:
        """Go by the nominal rate again."""
        self._rules = np.array(self._nominal_rules, np.float64)

    def wants_more(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> bool:
        """Whether a batch has fallen behind the clock, and only the frames after it can tell why.

        Args:
            raw: int64 ``[n]``, counters as sent.
            arrival_ns: int64 ``[n]``, host monotonic arrival times, not decreasing.
        """
        if not self._started or arrival_ns[-1] - self._last[SEEN_NS] <= self._doubt_ns:
            return False
        steps, elapsed, late = self._lags(raw, arrival_ns)
        doubt = self._rules[_DOUBT]
        fallen = np.flatnonzero(np.diff(late) > doubt)
        if not len(fallen):
            return False
        at = int(fallen[0])
        since = float(elapsed[at])
        unsure = since * self._rules[_DRIFT]
        if steps[at] != self._step and advance(int(steps[at]), since, unsure, self._rules):
            return False  # wraps explain it
        watched_ns = int(arrival_ns[-1] - arrival_ns[at])
        return watched_ns < self.watch_ns and float(late[-1] - late[at]) > doubt

    def sure(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> int:  # noqa: ARG002
        """How many frames at the beginning of a batch that `wants_more` need not wait: none."""
        return 0

    def begin_afresh(self, first: int) -> None:
        """Take the next frame as the first one of a sender that begins again, whatever its counter is.

        Args:
            first: the count of that frame.
        """
        self._started, self._first = False, first
        self._late[0] = 0.0
        self.forget_rate()

    def place(
        self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_], list[int]]:
        """Unwrap a batch.

        Args:
            raw: int64 ``[n]``, counters as sent; one of 64 bits as the signed number with the same bits.
            arrival_ns: int64 ``[n]``, host monotonic arrival times, not decreasing.

        Returns:
            int64 ``[n]``, the counter unwrapped; bool ``[n]``, False for frames whose counter fits neither
            the sequence nor a restart, and whose count is meaningless. Places in the batch at which the
            device was found to have restarted its counter. The distance to the frame before these is
            estimated from the host clock.
        """
        n = len(raw)
        count = np.zeros(n, np.int64)
        kept = np.ones(n, np.bool_)
        restarts = np.zeros(n, np.int64)
        at = 0
        if n and not self._started:
            first = int(raw[0]) % 2**_FIRST_BITS if self._first is None else self._first
            self._started = True
            self._last[:] = raw[0], first, arrival_ns[0], first, 0, 0
            count[0] = first
            at = 1
        n_restarts = follow(
            np.ascontiguousarray(raw[at:], np.int64),
            np.ascontiguousarray(arrival_ns[at:], np.int64),
            self._last,
            self._late,
            self._rules,
            self._unused_bits,
            count[at:],
            kept[at:],
            restarts,
        )
        return count, kept, (restarts[:n_restarts] + at).tolist()

    def _lags(
        self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Steps of the counter and of the clock from frame to frame ``[n]``; how late each is ``[n + 1]``."""
        steps = raw - np.concatenate((self._last[RAW : RAW + 1], raw[:-1]))
        # The counter's bits alone, the highest of them the sign: that holds even where a step overflows.
        steps = (steps << self._unused_bits) >> self._unused_bits
        elapsed: NDArray[np.float64] = np.diff(arrival_ns, prepend=self._last[SEEN_NS]) * self._rules[_RATE]
        # What lags by no more than the drift is a slow device, and not read late.
        falling_behind = elapsed * (1 - self._rules[_DRIFT]) - steps
        return steps, elapsed, _lateness(float(self._late[0]), falling_behind)


def _lateness(before: float, falling_behind: NDArray[np.floating]) -> NDArray[np.float64]:
    """How late frames are, in counts: what they fall behind adds up, and no frame is early.

    Args:
        before: how late the frame before the first one was.
        falling_behind: ``[n]``, by how much each falls behind the one before it; negative if it catches up.

    Returns:
        ``[n + 1]``, from the frame before the first one to the last one.
    """
    total = np.concatenate(([0.0], np.cumsum(falling_behind)))
    late: NDArray[np.float64] = np.maximum(before + total, total - np.minimum.accumulate(total))
    return late
