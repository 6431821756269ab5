"""Channels of one machine that come in several streams, put on one grid, with the error of doing so.

Every device samples on its own clock. One stream is the **reference**: its samples are the grid, and
pass as they are (the edge of a keyphasor stays an edge). The samples of every other stream are interpolated
at the instants of the reference's, as the two time bases see them. How far off that may be goes with the
data; samples that cannot be placed well enough are left out.

The grid begins when all streams can be placed, some seconds after their first samples, or after `SETTLE_NS`
at the latest. From then on it never waits long for a stream that is silent: its columns are NaN, and if it is
the reference, the grid goes on by its last known rate. Silent is what states nothing although it is listened
to: after a pause of the process, what the buffers hold of one stream is read before that of the next.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.alignment_source import AlignedSource, Follower, SourceCounters
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.errors.buses import NOT_ALIGNED
from daqsvc.errors.code import coded

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import Samples

__all__ = ["AlignedBlock", "AlignedSource", "Aligner", "Alignment", "SourceCounters"]

logger = logging.getLogger(__name__)

_LEAST_S = 0.01
"""Shorter blocks are not worth the work."""
_MOST_S = 1.0
"""Of one block: what is missing for longer is filled up block by block."""
_BLOCK_NS = NS_PER_S
"""Room for the newest block in what is held."""
SETTLE_NS = 30 * NS_PER_S
"""In which time bases should have found out where samples belong."""


@dataclass(frozen=True, slots=True)
class AlignedBlock:
    """Consecutive rows of a grid.

    Attributes:
        stream: name of the grid.
        first_index: position of ``samples[0]`` on the reference's own sample count.
        samples: float32 ``[n, channels]``, the channels of all sources in order; NaN where samples are
            missing, came too late, or cannot be placed.
        t_first_ns: host monotonic time at which ``samples[0]`` was taken, less the reference's latency.
        period_ns: estimated time between rows.
        t_error_ns: how far ``t_first_ns`` may be off, 95th percentile.
        error_ns: by source in order, how far its columns may be off against the reference's, 95th percentile;
            0 for the reference itself, infinite if that is not known.
        lost_before: rows between the previous block and this one, when nothing came from any source for so
            long that it is not worth the rows.
        quality: `Quality.TIME_UNSETTLED` while the samples of a source cannot be placed;
            `Quality.PLACE_ESTIMATED` where that holds for the reference's.
    """

    stream: str
    first_index: int
    samples: Samples
    t_first_ns: int
    period_ns: float
    t_error_ns: float
    error_ns: tuple[float, ...]
    lost_before: int = 0
    quality: Quality = Quality.GOOD

    def as_block(self) -> SampleBlock:
        """The rows as a block of a stream that has the grid's name, for a `SampleRing`."""
        return SampleBlock(
            self.stream,
            self.first_index,
            self.samples,
            self.t_first_ns,
            self.period_ns,
            self.lost_before,
            self.quality,
            math.hypot(self.t_error_ns, max(self.error_ns)),
        )


class Aligner:
    """Puts the blocks of several streams on the grid of the first one.

    Without a clock the order of the blocks alone decides what comes out.

    Args:
        name: name of the grid.
        sources: the reference first.
        deliver: called with each aligned block, in order, from the thread that calls `accept`.
        max_error_ns: samples that may be further off the reference's are left out, until they are not; once
            placed, up to twice as far is borne.
        max_wait_ns: how long after all others a stream may come, in time of the samples.
        clock: of the host, on which it has to be that late too; unless given, blocks are taken to come as
            fast as samples are taken.

    Raises:
        ValueError: fewer than two sources, or two of one name.
    """

    def __init__(
        self,
        name: str,
        sources: Sequence[AlignedSource],
        deliver: Callable[[AlignedBlock], None],
        *,
        max_error_ns: float = 200_000.0,
        max_wait_ns: int = NS_PER_S,
        clock: Clock | None = None,
    ) -> None:
        if len(sources) < 2 or len({source.stream for source in sources}) < len(sources):
            raise ValueError(
                f"grid {name!r} is over {[source.stream for source in sources]}: name two or more streams, "
                "each of them once"
            )
        self.name = name
        self.sources = tuple(sources)
        self.channels = tuple(
            f"{source.stream}.{channel}" for source in sources for channel in source.channels
        )
        self._deliver = deliver
        self._max_wait_ns = max_wait_ns
        self._clock = clock
        self._heard: deque[tuple[int, int]] = deque()
        rate_hz = sources[0].rate_hz
        self._followers = [Follower(source, rate_hz, max_error_ns, max_wait_ns) for source in sources]
        self._by_stream = {follower.source.stream: follower for follower in self._followers}
        self._reference, *self._others = self._followers
        # A value is late by the half-width of its filter before anybody is to blame.
        self._filter_ns = max(round(f.reach * NS_PER_S / f.source.rate_hz) for f in self._others)
        self._least = max(1, round(_LEAST_S * rate_hz))
        self._most = max(self._least, round(_MOST_S * rate_hz))
        # What is older than a source remembers has no samples anyway.
        self._longest = self._most + max(round(f.memory_s * rate_hz) for f in self._followers)
        self._next: int | None = None
        self._since_ns: int | None = None
        self._break: int | None = None
        """Where the reference goes on at a place that is a guess: a block begins there."""

    @property
    def counters(self) -> Mapping[str, SourceCounters]:
        """What became of each source, by stream."""
        return {stream: follower.counters for stream, follower in self._by_stream.items()}

    @property
    def error_ns(self) -> Mapping[str, float]:
        """By stream, how far its columns may be off against the reference's now, 95th percentile."""
        return {stream: follower.error_ns for stream, follower in self._by_stream.items()}

    def accept(self, block: SampleBlock) -> None:
        """Take in a block; those of other streams are none of our business."""
        follower = self._by_stream.get(block.stream)
        if follower is None:
            return
        follower.append(block)
        if follower is self._reference and block.quality & Quality.PLACE_ESTIMATED:
            self._break = block.first_index
        due_ns = self._due_ns()
        if self._next is None and self._can_begin():
            self._next = self._reference.line.index
        while self._next is not None and (rows := self._ready(self._next, due_ns)) >= self._least:
            skipped = rows - self._most if rows > self._longest else 0
            self._next += skipped
            rows = min(rows, self._most)
            broken = self._break is not None and self._break <= self._next
            if broken:
                self._break = None
            elif self._break is not None:
                rows = min(rows, self._break - self._next)
            self._emit(self._next, rows, skipped, broken=broken)
            self._next += rows

    def _can_begin(self) -> bool:
        """Whether all streams can be placed, or that has been waited for long enough."""
        if not self._reference.started:
            return False
        line = self._reference.line
        if self._since_ns is None:
            self._since_ns = line.t_ns
        waited_ns = max(f.newest_ns for f in self._followers if f.started) - self._since_ns
        return waited_ns >= SETTLE_NS or all(f.placeable(line) for f in self._others)

    def _due_ns(self) -> int:
        """Up to when samples must have come, in time of the samples, or are waited for no longer."""
        newest_ns = max(f.newest_ns for f in self._followers if f.started)
        due_ns = newest_ns - self._max_wait_ns
        if self._clock is not None:
            now_ns = self._clock.monotonic_ns()
            self._heard.append((now_ns, newest_ns))
            # What was the newest of all a wait ago: its contemporaries have had the wait to come.
            while len(self._heard) > 1 and self._heard[1][0] <= now_ns - self._max_wait_ns:
                self._heard.popleft()
            # But what is held for it must not be forgotten meanwhile.
            held_ns = round(min(f.memory_s for f in self._followers) * NS_PER_S) - _BLOCK_NS
            due_ns = max(min(due_ns, self._heard[0][1]), newest_ns - held_ns)
        return due_ns - self._filter_ns

    def _ready(self, first: int, due_ns: int) -> int:
        """Rows from index ``first`` on that can be made: all streams are there, or one is too late."""
        line = self._reference.line
        covered = min(self._reference.end - first, *(f.covers(first, line) for f in self._others))
        # A reference that has just begun to speak again may be ahead of what a silent one was due for.
        overdue = math.floor(line.samples_to(due_ns)) + line.index - first
        return max(covered, overdue)

    def _emit(self, first: int, rows: int, skipped: int, *, broken: bool) -> None:
        line = self._reference.line
        for follower in self._followers if skipped else ():
            follower.skip(skipped)
        columns = [self._reference.own(first, rows)]
        columns += [follower.at(first, rows, line) for follower in self._others]
        self._reference.trim(first + rows)
        t_ns = line.time_of(first)
        settled = all(follower.trusted for follower in self._others)
        quality = Quality.GOOD if settled else Quality.TIME_UNSETTLED
        self._deliver(
            AlignedBlock(
                self.name,
                first,
                np.concatenate(columns, axis=1),
                t_ns,
                line.period_ns,
                line.error_at(t_ns),
                tuple(follower.error_ns for follower in self._followers),
                skipped,
                quality | Quality.PLACE_ESTIMATED if broken else quality,
            )
        )
        for follower in self._others:
            self._tell(follower)

    def _tell(self, follower: Follower) -> None:
        """Log once that a stream can be placed, that it no longer can, and that it never could."""
        placing = follower.news(round(SETTLE_NS / NS_PER_S * self._reference.source.rate_hz))
        if placing is None:
            return
        error_us = follower.error_ns / 1e3
        if placing == "placed":
            logger.info(
                "stream %r is on the grid of %r to %.0f us",
                follower.source.stream,
                self._reference.source.stream,
                error_us,
            )
            return
        logger.warning(
            "stream %r can be put on the grid of %r to %.0f us only, worse than max_error_us = %.0f: its "
            "samples are left out until that is better; let its device send more often or with less delay, "
            "or raise max_error_us in [pipeline.alignment]",
            follower.source.stream,
            self._reference.source.stream,
            error_us,
            follower.max_error_ns / 1e3,
            extra=coded(NOT_ALIGNED),
        )


class Alignment:
    """All grids of a machine.

    Args:
        aligners: one for each.
    """

    def __init__(self, aligners: Iterable[Aligner] = ()) -> None:
        self.aligners = tuple(aligners)

    def accept(self, block: SampleBlock) -> None:
        """Hand a block to every grid that it belongs to."""
        for aligner in self.aligners:
            aligner.accept(block)

    def figures(self) -> dict[str, dict[str, dict[str, float]]]:
        """By grid and stream: rows missing and left out, and the error in us, infinite if it is not known."""
        return {
            aligner.name: {
                stream: {
                    "rows_missing": counters.rows_missing,
                    "rows_withheld": counters.rows_withheld,
                    "steps": counters.steps,
                    "error_us": aligner.error_ns[stream] / 1e3,
                }
                for stream, counters in aligner.counters.items()
            }
            for aligner in self.aligners
        }
