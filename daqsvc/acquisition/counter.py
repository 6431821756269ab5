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
        self._modulus = 2**bits
        self._unused_bits = MOST_BITS - bits
        self._step = step
        self._nominal_rate = self._rate = rate_hz / NS_PER_S
        self._drift = DRIFT
        self._doubt_ns = max(DOUBT_NS, round(2 * step / self._rate))
        self.watch_ns = max(WATCH_NS, round(2 * step / self._rate))
        self._back = min(reorder_counts, self._modulus // 4)
        self._ahead = min(JITTER_NS * self._rate, self._modulus / 4)
        self._started = False
        self._first: int | None = None
        self._raw = 0
        self._count = 0
        self._seen_ns = 0
        self._late = 0.0
        self._highest = 0
        self._suspect: int | None = None

    def measured(self, rate_hz: float, drift: float) -> None:
        """Take the device's rate as it has been measured.

        Args:
            rate_hz: counts per second.
            drift: how far it may be off, relative; `DRIFT` is the most that is believed.
        """
        self._rate = rate_hz / NS_PER_S
        self._drift = min(drift, DRIFT)

    def forget_rate(self) -> None:
        """Go by the nominal rate again."""
        self._rate, self._drift = self._nominal_rate, DRIFT

    def wants_more(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> bool:
        """Whether a batch has fallen behind the clock, and only the frames after it can tell why.

        Args:
            raw: int64 ``[n]``, counters as sent.
            arrival_ns: int64 ``[n]``, host monotonic arrival times, not decreasing.
        """
        if not self._started or arrival_ns[-1] - self._seen_ns <= self._doubt_ns:
            return False
        steps, elapsed, late = self._lags(raw, arrival_ns)
        fallen = np.flatnonzero(np.diff(late) > self._doubt_ns * self._rate)
        if not len(fallen):
            return False
        at = int(fallen[0])
        since = float(elapsed[at])
        if steps[at] != self._step and self._advance(int(steps[at]), since, since * self._drift):
            return False  # wraps explain it
        watched_ns = int(arrival_ns[-1] - arrival_ns[at])
        return watched_ns < self.watch_ns and float(late[-1] - late[at]) > self._doubt_ns * self._rate

    def begin_afresh(self, first: int) -> None:
        """Take the next frame as the first one of a sender that begins anew, whatever its counter is.

        Args:
            first: the count of that frame.
        """
        self._started, self._first = False, first
        self._late = 0.0
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
        restarts: list[int] = []
        at = 0
        if n and not self._started:
            first = int(raw[0]) % 2**_FIRST_BITS if self._first is None else self._first
            self._accept(int(raw[0]), first, int(arrival_ns[0]))
            self._highest = count[0] = first
            at = 1
        while at < n:
            at += self._follow(raw[at:], arrival_ns[at:], count[at:])
            if at < n:
                self._decide(at, int(raw[at]), int(arrival_ns[at]), count, kept, restarts)
                at += 1
        return Placement(count, kept, restarts)

    def _follow(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64], count: NDArray[np.int64]) -> int:
        """Place the longest beginning of a batch that continues the sequence; returns its length."""
        steps, elapsed, late = self._lags(raw, arrival_ns)
        unsure = self._ahead + 2 * self._drift * late[:-1]
        sane = (steps >= -self._back) & (steps <= elapsed + late[:-1] + unsure)
        # After half a wrap of silence a small step may hide whole wraps, unless it is the very next frame.
        sane &= (elapsed + late[:-1] < self._modulus / 2) | (steps == self._step)
        for at in np.flatnonzero(np.diff(late) > self._doubt_ns * self._rate).tolist():
            sane[at] &= self._catches_up(late[at:], arrival_ns[at:])
        good = len(raw) if sane.all() else int(np.argmin(sane))
        if good:
            self._late = float(late[good])
            count[:good] = self._count + np.cumsum(steps[:good])
            self._highest = max(self._highest, int(count[:good].max()))
            self._accept(int(raw[good - 1]), int(count[good - 1]), int(arrival_ns[good - 1]))
        return good

    def _lags(
        self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Steps of the counter and of the clock from frame to frame ``[n]``; how late each is ``[n + 1]``."""
        steps = self._signed(raw - np.concatenate(([self._raw], raw[:-1])))
        elapsed: NDArray[np.float64] = np.diff(arrival_ns, prepend=self._seen_ns) * self._rate
        # What lags by no more than the drift is a slow device, and not read late.
        return steps, elapsed, _lateness(self._late, elapsed * (1 - self._drift) - steps)

    def _catches_up(self, late: NDArray[np.float64], arrival_ns: NDArray[np.int64]) -> bool:
        """Whether frames that have fallen behind were delayed: they come faster than they were sent.

        Args:
            late: ``[n + 1]``, how late they are, in counts; first the frame before them.
            arrival_ns: int64 ``[n]``.
        """
        end = int(np.searchsorted(arrival_ns, arrival_ns[0] + self.watch_ns, side="right"))
        if late[end] - late[0] <= self._doubt_ns * self._rate:
            return True
        # Some are always held in a buffer when a link comes up: what counts is that it goes on.
        half = int(np.searchsorted(arrival_ns, (arrival_ns[0] + arrival_ns[end - 1]) // 2))
        return bool(late[1 + half] - late[end] > self._ahead)

    def _decide(
        self,
        at: int,
        raw: int,
        arrival_ns: int,
        count: NDArray[np.int64],
        kept: NDArray[np.bool_],
        restarts: list[int],
    ) -> None:
        """Place one frame that the sequence does not explain."""
        step = int(self._signed(np.array([raw], np.int64) - self._raw)[0])
        since = (arrival_ns - self._seen_ns) * self._rate
        # Either this frame is as late as the one before it, or it has not waited at all.
        advance = self._advance(step, since, since * self._drift) or self._advance(
            step, since + self._late, (since + 2 * self._late) * self._drift
        )
        if advance:
            count[at] = self._count + advance
            self._late = max(self._late + since - advance, 0.0)
        elif self._suspect is not None and 0 < (raw - self._suspect) % self._modulus <= 4 * self._step:
            # Never before anything placed already: two samples cannot share an index.
            count[at] = max(self._count + round(since + self._late), self._highest + self._step)
            restarts.append(at)
            self._late = 0.0
        else:
            self._suspect = raw
            kept[at] = False
            return
        self._highest = max(self._highest, int(count[at]))
        self._accept(raw, int(count[at]), arrival_ns)

    def _advance(self, step: int, elapsed: float, unsure: float) -> int:
        """Counts from the last frame to one that is ``step`` ahead but for wraps; 0 if none fits the time."""
        advance = step + round((elapsed - step) / self._modulus) * self._modulus
        fits = advance > 0 and abs(advance - elapsed) <= self._ahead + unsure
        return advance if fits else 0

    def _accept(self, raw: int, count: int, arrival_ns: int) -> None:
        self._started = True
        self._raw, self._count, self._seen_ns = raw, count, arrival_ns
        self._suspect = None

    def _signed(self, steps: NDArray[np.int64]) -> NDArray[np.int64]:
        # The counter's bits alone, the highest of them the sign: that holds even where a step overflows.
        signed: NDArray[np.int64] = (steps << self._unused_bits) >> self._unused_bits
        return signed


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
