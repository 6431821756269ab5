"""Unwrapping a device's sample counter, and telling a wrap from a loss from a restart.

The counter says where a frame belongs; the time of arrival only decides what the counter cannot: how
often it wrapped during an outage, and whether it was restarted.

Samples may arrive late, but never early. So a counter that is ahead of the clock was restarted; one that is
behind it was restarted too, unless its frames were delayed on their way: then they catch up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.counter_kernels import COUNT, RAW, SEEN_NS, Rules, advance, follow

if TYPE_CHECKING:
    from numpy.typing import NDArray

JITTER_NS = 50_000_000
"""How far a frame may seem ahead of the host clock; five times the jitter we promise to bear."""

DRIFT = 0.01
"""How far a device's rate may be off its nominal one, while the time base has not measured it."""

DOUBT_NS = NS_PER_S // 2
"""A counter that falls behind the clock by more than this from one frame to the next is to be explained."""

WATCH_NS = NS_PER_S
"""How long frames that have fallen behind are watched: those that were delayed catch up, others do not."""


_DOUBT, _RATE, _DRIFT = (Rules._fields.index(name) for name in ("doubt", "rate", "drift"))

LEAST_BITS, MOST_BITS = 4, 64
"""How wide a counter may be: one of fewer bits wraps within a few frames, and tells nothing of a gap."""

_FIRST_BITS = 32
"""A wider counter begins at so many of its low bits: far from the end of the integers that count on."""


class Placement(NamedTuple):
    """Where the frames of a batch belong.

    Attributes:
        counts: int64 ``[n]``, the counter unwrapped; meaningless where ``kept`` is False.
        kept: bool ``[n]``, False for frames whose counter fits neither the sequence nor a restart.
        restarts: places in the batch at which the device was found to have restarted its counter;
            the distance to the frame before is estimated from the host clock.
    """

    counts: NDArray[np.int64]
    kept: NDArray[np.bool_]
    restarts: list[int]


class CounterUnwrapper:
    """Follows one device's counter of 4 to 64 bits, which begins again at 0 after all ones.

    A frame is taken by its sequence alone while that agrees with the host clock. Where it does not,
    the number of missed wraps comes from the clock; a counter that no number of wraps can explain is
    held back until the next frame continues from it, and only then believed to be a restart.

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

    def begin_afresh(self, first: int) -> None:
        """Take the next frame as the first one of a sender that begins anew, whatever its counter is.

        Args:
            first: the count of that frame.
        """
        self._started, self._first = False, first
        self._late[0] = 0.0
        self.forget_rate()

    def place(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> Placement:
        """Unwrap a batch.

        Args:
            raw: int64 ``[n]``, counters as sent; one of 64 bits as the signed number with the same bits.
            arrival_ns: int64 ``[n]``, host monotonic arrival times, not decreasing.
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
        found = follow(
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
        return Placement(count, kept, (restarts[:found] + at).tolist())

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
    """How late frames are, in counts: what they fall behind adds up, and nobody is ahead of his time.

    Args:
        before: how late the frame before the first one was.
        falling_behind: ``[n]``, by how much each falls behind the one before it; negative if it catches up.

    Returns:
        ``[n + 1]``, from the frame before the first one to the last one.
    """
    total = np.concatenate(([0.0], np.cumsum(falling_behind)))
    late: NDArray[np.float64] = np.maximum(before + total, total - np.minimum.accumulate(total))
    return late
