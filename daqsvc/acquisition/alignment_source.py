"""One stream on the way to the common grid of several: where its samples are, and its values between them.

Values between samples are band-limited interpolation by a windowed sinc (Kaiser), any fraction of a sample.
It is flat to -90 dB up to 0.41 of the lower one of the two rates; what lies above 0.59 of it is gone, so that
a slower grid is not aliased into.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock, Samples


HALF_WIDTH = 16
"""Samples at the lower rate that count on either side of a value."""
BETA = 8.96
"""Of the Kaiser window: 0.1102 (A - 8.7) for A = 90 dB."""
PHASES = 512
"""Fractions of a sample that have a filter of their own; linear between them, which errs by -106 dB."""


class FractionalDelay:
    """Takes values of a sampled signal at any places between its samples.

    Args:
        rate_ratio: rate of the values over that of the samples; below 1 the band is narrowed for it.

    Attributes:
        reach: samples that count on either side of a place.
    """

    def __init__(self, rate_ratio: float = 1.0) -> None:
        if not rate_ratio > 0.0:
            raise ValueError(f"rate_ratio is {rate_ratio}; it must be positive")
        band = min(1.0, rate_ratio)
        self.reach = math.ceil(HALF_WIDTH / band)
        fraction = np.arange(PHASES + 1)[:, None] / PHASES
        t = np.arange(1 - self.reach, self.reach + 1) - fraction
        inside = np.sqrt(np.clip(1.0 - (t / self.reach) ** 2, 0.0, None))
        taps = np.sinc(band * t) * np.i0(BETA * inside)
        # A constant stays exactly what it is: the mean position of a shaft is a measured value too.
        self._taps = taps / taps.sum(axis=1, keepdims=True)

    def __call__(self, samples: Samples, places: NDArray[np.float64]) -> Samples:
        """The signal's values at places.

        Args:
            samples: float32 ``[m, channels]``.
            places: float64 ``[n]``, in samples from ``samples[0]``.

        Returns:
            float32 ``[n, channels]``; NaN, in the channel concerned, where one of the ``2 reach`` samples
            around a place is missing: not finite, or outside of ``samples``.
        """
        values = np.full((len(places), samples.shape[1]), np.nan, np.float32)
        before = np.floor(places)
        first = before.astype(np.int64) - (self.reach - 1)
        there = (first >= 0) & (first + 2 * self.reach <= len(samples))
        if not there.any():
            return values
        phase = (places[there] - before[there]) * PHASES
        row = np.minimum(phase.astype(np.int64), PHASES - 1)
        part = (phase - row)[:, None]
        taps = self._taps[row] * (1.0 - part) + self._taps[row + 1] * part
        around = np.lib.stride_tricks.sliding_window_view(samples, 2 * self.reach, axis=0)[first[there]]
        with np.errstate(invalid="ignore"):
            between = np.einsum("nct,nt->nc", around, taps)
        # Infinities of one sign would pass for a value.
        between[~np.isfinite(between)] = np.nan
        values[there] = between
        return values


News: TypeAlias = Literal["placed", "out of place", "never placed"]

FOLLOW_S = 1.0
"""Time constant with which the place follows what the time bases have learnt."""
MOST_SLEW = 1e-3
"""A place moves no faster against its clock: 1 us in 1 ms, less than a degree of 1X in a revolution."""
STALL_S = 8.0
"""For how long the process may stand still: one stream's samples of that time come before the next one's."""
_RATE_DOUBT = 2.0 * MOST_SLEW
_FORGET_NS = 5.0 * NS_PER_S
"""An estimated line is twice as far off so long after it was laid."""


@dataclass(frozen=True, slots=True)
class AlignedSource:
    """A stream that goes on a grid.

    Attributes:
        stream: name of the stream.
        channels: names of its columns.
        rate_hz: nominal sampling rate.
        latency_ns: constant part of the delay from the taking of a sample to the earliest arrival that it can
            have; no time base can see it.
    """

    stream: str
    channels: tuple[str, ...]
    rate_hz: float
    latency_ns: int = 0


@dataclass(slots=True)
class SourceCounters:
    """What became of a stream on a grid; every figure only grows.

    Attributes:
        rows_missing: rows without its samples: lost, too late, within the filter's reach of such, or silent.
        rows_withheld: rows without its samples because these could not be placed well enough.
        steps: how often its place was set again rather than followed, the first time included.
    """

    rows_missing: int = 0
    rows_withheld: int = 0
    steps: int = 0


@dataclass(frozen=True, slots=True)
class Line:
    """A stream's clock at its last block.

    Times are whole ns, and places are counted from the line's own: floats would not hold either for long.

    Attributes:
        index: sample index.
        t_ns: host time of that sample, less the stream's latency.
        period_ns: time between samples.
        error_ns: how far ``t_ns`` may be off, 95th percentile.
    """

    index: int
    t_ns: int
    period_ns: float
    error_ns: float

    def time_of(self, index: int) -> int:
        """Host time of a sample in ns."""
        return self.t_ns + round((index - self.index) * self.period_ns)

    def samples_to(self, t_ns: int) -> float:
        """Samples from the line's own to a host time in ns."""
        return (t_ns - self.t_ns) / self.period_ns

    def error_at(self, t_ns: int) -> float:
        """How far the line may be off at a host time, in ns; it grows after the last block."""
        return self.error_ns * (1.0 + max(0.0, t_ns - self.t_ns) / _FORGET_NS)


class Follower:
    """Keeps a stream's latest samples and reads them at the instants of the grid.

    The place to read at moves smoothly: what the time bases learn is followed with `FOLLOW_S`, so that the
    signal has no steps. Only where there is no signal anyway is it set again.

    Args:
        source: the stream.
        grid_rate_hz: nominal rate of the grid.
        max_error_ns: see `daqsvc.acquisition.alignment.Aligner`.
        max_wait_ns: see there.

    Attributes:
        counters: what became of it.
        error_ns: how far the rows made last may be off against the grid.
        trusted: whether that is little enough for the samples to be used.
    """

    def __init__(
        self, source: AlignedSource, grid_rate_hz: float, max_error_ns: float, max_wait_ns: int
    ) -> None:
        self.source = source
        self.max_error_ns = max_error_ns
        self.counters = SourceCounters()
        self.error_ns = 0.0
        self.trusted = False
        self._delay = FractionalDelay(grid_rate_hz / source.rate_hz)
        self._held = np.empty((0, len(source.channels)), np.float32)
        self._first = 0
        self._line: Line | None = None
        self._place: tuple[int, float] | None = None
        self._reported: News | None = None
        memory_s = STALL_S + 4.0 * max_wait_ns / NS_PER_S
        self._capacity = round(memory_s * source.rate_hz) + 8 * self._delay.reach

    @property
    def reach(self) -> int:
        """Samples on either side of a row that it is made of."""
        return self._delay.reach

    @property
    def memory_s(self) -> float:
        """How much of the past is kept."""
        return self._capacity / self.source.rate_hz

    @property
    def started(self) -> bool:
        """Whether anything has come."""
        return self._line is not None

    @property
    def line(self) -> Line:
        """The stream's clock at its last block.

        Raises:
            LookupError: nothing has come yet.
        """
        if self._line is None:
            raise LookupError(f"no sample of {self.source.stream!r} has come yet: it has no time base")
        return self._line

    @property
    def end(self) -> int:
        """One past the index of the newest sample."""
        return self._first + len(self._held)

    @property
    def newest_ns(self) -> int:
        """Host time of the newest sample, less the latency."""
        return self.line.time_of(self.end - 1)

    def append(self, block: SampleBlock) -> None:
        """Take in the samples and the clock of a block."""
        missing = block.first_index - self.end
        if self._line is None or not 0 <= missing < self._capacity:
            # The first block, or nothing that is held can matter any longer.
            self._held, self._first = block.samples, block.first_index
        else:
            gap = np.full((missing, self._held.shape[1]), np.nan, np.float32)
            self._held = np.concatenate([self._held, gap, block.samples])
        t_ns = block.t_first_ns - self.source.latency_ns
        self._line = Line(block.first_index, t_ns, block.period_ns, block.t_error_ns)
        self.trim(self.end - self._capacity)

    def trim(self, index: int) -> None:
        """Forget the samples before an index."""
        drop = min(max(index - self._first, 0), len(self._held))
        self._held = self._held[drop:]
        self._first += drop

    def own(self, first: int, rows: int) -> Samples:
        """Samples as they are, float32 ``[rows, channels]``; NaN where they are not there."""
        samples = np.full((rows, self._held.shape[1]), np.nan, np.float32)
        begin, end = max(first, self._first), min(first + rows, self.end)
        if begin < end:
            samples[begin - first : end - first] = self._held[begin - self._first : end - self._first]
        self._count(samples)
        return samples

    def placeable(self, grid: Line) -> bool:
        """Whether its samples are known well enough to lie where on the grid."""
        if self._line is None:
            return False
        return math.hypot(self._line.error_ns, grid.error_ns) <= self.max_error_ns

    def covers(self, first: int, grid: Line) -> int:
        """Rows of the grid from index ``first`` on that can be made now."""
        if self._line is None:
            return 0
        whole, part = self._target(first, grid) if self._place is None else self._place
        left = self.end - self.reach - whole - part
        return int(left * self._line.period_ns / grid.period_ns / (1.0 + _RATE_DOUBT))

    def at(self, first: int, rows: int, grid: Line) -> Samples:
        """Rows of the grid, float32 ``[rows, channels]``.

        Args:
            first: index of the first row.
            rows: how many.
            grid: the reference's clock.
        """
        if self._line is None:
            self.error_ns = math.inf
            samples = np.full((rows, self._held.shape[1]), np.nan, np.float32)
            self._count(samples)
            return samples
        ratio = grid.period_ns / self._line.period_ns
        whole, part = self._target(first, grid)
        lag = 0.0
        if self._place is not None:
            lag = self._place[0] - whole + self._place[1] - part
        left = lag * math.exp(-rows * grid.period_ns / (FOLLOW_S * NS_PER_S))
        slew = MOST_SLEW * ratio * rows
        left = lag + min(max(left - lag, -slew), slew)
        self._judge(grid, first + rows, lag)
        begin = whole - self._first + part + lag
        step = ratio + (left - lag) / rows
        samples = self._delay(self._held, begin + step * np.arange(rows, dtype=np.float64))
        if self.trusted:
            self._count(samples)
        else:
            self.counters.rows_withheld += rows
            samples[:] = np.nan
        if np.isfinite(samples).any():
            self.counters.steps += self._place is None
            ahead = begin + step * rows
            self._place = self._first + math.floor(ahead), ahead % 1.0
        else:
            # There is no signal to be kept smooth: what comes next is put where it belongs.
            self._place = None
            ahead = whole - self._first + part + ratio * rows
        self.trim(self._first + math.floor(ahead) - self.reach)
        return samples

    def skip(self, rows: int) -> None:
        """Leave out rows of the grid for which there is nothing."""
        self.counters.rows_missing += rows
        self._place = None

    def news(self, patience: int) -> News | None:
        """What has changed about the stream's place since this was asked last; None for nothing.

        Args:
            patience: rows in which it should have found its place.
        """
        before = self._reported
        if self.trusted:
            self._reported = "placed"
        elif before == "placed":
            self._reported = "out of place"
        elif before is None and self.counters.rows_withheld > patience:
            self._reported = "never placed"
        return None if self._reported == before else self._reported

    def _target(self, index: int, grid: Line) -> tuple[int, float]:
        """Where the time bases see a row of the grid among our samples: whole index and fraction."""
        line = self.line
        place = ((index - grid.index) * grid.period_ns + (grid.t_ns - line.t_ns)) / line.period_ns
        whole = math.floor(place)
        return line.index + whole, place - whole

    def _judge(self, grid: Line, end: int, lag: float) -> None:
        """How far off the rows are up to ``end``, and whether that is to be borne."""
        line, t_ns = self.line, grid.time_of(end)
        self.error_ns = math.hypot(line.error_at(t_ns), grid.error_at(t_ns)) + abs(lag) * line.period_ns
        self.trusted = self.error_ns <= self.max_error_ns * (2.0 if self.trusted else 1.0)

    def _count(self, samples: Samples) -> None:
        self.counters.rows_missing += int(np.isnan(samples).any(axis=1).sum())
