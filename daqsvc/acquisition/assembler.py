"""From decoded frames to blocks: in order, each sample once, every loss counted.

One assembler serves one stream. It places frames by the time base, puts overtaken frames back in
order within the reorder window, drops repeats, and hands over blocks whose `lost_before` says exactly
what is missing.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.books import note_gap, note_received
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.acquisition.timebase import TimeBase, TimeBaseState

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import Samples

logger = logging.getLogger(__name__)

REMEMBERED_GAPS = 256


@dataclass(slots=True)
class StreamCounters:
    """What happened to the frames and samples of a stream; every figure only grows.

    Attributes:
        frames_received: frames of the right length that arrived, intact or not.
        frames_corrupt: of those, with a CRC that does not match.
        frames_duplicate: of those, carrying samples that were there already.
        frames_reordered: of those, overtaken by a later frame and put back in order.
        frames_late: of those, arriving after their samples had been declared lost.
        frames_rejected: of those, with a counter that fits nothing.
        frames_wrong_length: frames of the stream's id that are shorter or longer than its layout.
        samples_received: samples handed on.
        samples_lost: samples declared missing, by the device's counter, or by time if it sends none.
        gaps: how often samples were missing.
        values_absent: values in the samples handed on, of any channel, that the device said it does not have,
            or that are not finite.
    """

    frames_received: int = 0
    frames_corrupt: int = 0
    frames_duplicate: int = 0
    frames_reordered: int = 0
    frames_late: int = 0
    frames_rejected: int = 0
    frames_wrong_length: int = 0
    samples_received: int = 0
    samples_lost: int = 0
    gaps: int = 0
    values_absent: int = 0


class StreamAssembler:
    """Turns frames of one stream into blocks.

    Args:
        stream: name of the stream.
        rate_hz: nominal sampling rate.
        counter_bits: width of the device's counter; None if it sends none, and loss can only be estimated
            from the times of arrival (`daqsvc.acquisition.arrival_count`).
        samples_per_frame: samples of each channel in a frame.
        counts_per_frame: by how much the counter grows from frame to frame.
        deliver: called with each block, in order, from the thread that calls `accept`.
        reorder_window_ns: how long a gap may wait for an overtaken frame, in time of the samples.
    """

    def __init__(
        self,
        stream: str,
        rate_hz: float,
        *,
        counter_bits: int | None,
        samples_per_frame: int,
        counts_per_frame: int,
        deliver: Callable[[SampleBlock], None],
        reorder_window_ns: int = 10_000_000,
    ) -> None:
        self.stream = stream
        self.counters = StreamCounters()
        self._deliver = deliver
        self._per_frame = samples_per_frame
        self._window = round(rate_hz * reorder_window_ns / NS_PER_S) + samples_per_frame
        self._patience_ns = 4 * reorder_window_ns + round(4 * samples_per_frame / rate_hz * NS_PER_S)
        self._counts_arrivals = counter_bits is None
        self._time = TimeBase(rate_hz, counter_bits, samples_per_frame, counts_per_frame, reorder_window_ns)
        self._next: int | None = None
        self._highest: int | None = None
        self._held_index = np.empty(0, np.int64)
        self._held: Samples | None = None
        self._waiting_since_ns = 0
        self._arrival_ns = 0
        self._gaps: deque[tuple[int, int]] = deque(maxlen=REMEMBERED_GAPS)
        self._after_restart = False
        self._unplaced: list[tuple[NDArray[np.int64], Samples, NDArray[np.int64]]] = []

    @property
    def time_base(self) -> TimeBaseState:
        """What is known about the device's clock."""
        return self._time.state

    @property
    def frames_lost(self) -> int:
        """Frames whose samples are missing, whether they never came or came corrupt."""
        return self.counters.samples_lost // self._per_frame

    def accept(
        self,
        counter: NDArray[np.int64],
        samples: Samples,
        intact: NDArray[np.bool_],
        arrival_ns: NDArray[np.int64],
    ) -> None:
        """Take in a batch of frames in their order of arrival.

        Args:
            counter: int64 ``[n]``, as sent; anything if the device sends none.
            samples: float32 ``[n, samples_per_frame, channels]``.
            intact: bool ``[n]``.
            arrival_ns: int64 ``[n]``, host monotonic.
        """
        self.counters.frames_received += len(counter)
        if not intact.all():
            if not self.counters.frames_corrupt:
                logger.warning(
                    "stream %r: a frame's CRC does not match; such frames are counted and left out. If it is "
                    "every frame, compare the place of the CRC in the layout with the device's",
                    self.stream,
                )
            self.counters.frames_corrupt += int((~intact).sum())
            counter, samples, arrival_ns = counter[intact], samples[intact], arrival_ns[intact]
        if not len(counter):
            return
        self._unplaced.append((counter, samples, arrival_ns))
        self._place(until_sure=True)

    def tick(self, now_ns: int) -> None:
        """Give up waiting for what nothing has come to tell for a while; call every now and then.

        That is how a gap is closed, and why a counter is behind the clock.
        """
        if self._unplaced:
            _, _, arrival_ns = self._unplaced[0]
            if now_ns - int(arrival_ns[-1]) > self._time.watch_ns + self._patience_ns:
                self._place()
        if self._held is not None and now_ns - self._waiting_since_ns > self._patience_ns:
            self._release(everything=True)

    def begin_afresh(self) -> None:
        """What comes next is of a sender that is known to begin anew, such as a recording played again.

        Its first frame takes the next index, whatever its counter is: nothing is lost. Its times are its own.
        """
        self.flush()
        if self._next is not None:
            self._time.begin_afresh(self._next)

    def flush(self) -> None:
        """Hand over what is held back: the link is gone, or the service stops."""
        self._place()
        self._release(everything=True)

    def _place(self, *, until_sure: bool = False) -> None:
        """Place what has come, unless more has to come before that can be done for sure."""
        if not self._unplaced:
            return
        counter, samples, arrival_ns = self._unplaced[0]
        if len(self._unplaced) > 1:
            counter, samples, arrival_ns = map(np.concatenate, zip(*self._unplaced, strict=True))
        if until_sure and self._time.wants_more(counter, arrival_ns):
            return
        self._unplaced = []
        placed = self._time.place(counter, arrival_ns)
        rejected = int((~placed.kept).sum())
        if rejected and not self.counters.frames_rejected:
            logger.warning(
                "stream %r: a frame's counter fits neither the sequence nor a restart; "
                "such frames are counted and left out",
                self.stream,
            )
        self.counters.frames_rejected += rejected
        for _ in placed.restarts:
            logger.warning(
                "stream %r: the device has restarted its counter, or has not counted for a while; "
                "how many samples are missing is estimated from the clock",
                self.stream,
            )
        if placed.anew:
            logger.warning(
                "stream %r: its samples do not arrive when its clock has told; its time base begins anew",
                self.stream,
            )
        start = 0
        for restart in [*placed.restarts, len(counter)]:
            part = slice(start, restart)
            kept = placed.kept[part]
            self._merge(placed.indices[part][kept], samples[part][kept], int(arrival_ns[-1]))
            if restart < len(counter):
                self._release(everything=True)
                self._after_restart = True
            start = restart

    def _merge(self, index: NDArray[np.int64], samples: Samples, arrival_ns: int) -> None:
        if not len(index):
            return
        self._count_overtaken(index)
        if self._held is not None:
            index = np.concatenate([self._held_index, index])
            samples = np.concatenate([self._held, samples])
        else:
            self._waiting_since_ns = arrival_ns
        self._arrival_ns = arrival_ns
        if (np.diff(index) <= 0).any():
            index, first = np.unique(index, return_index=True)
            samples = samples[first]
        self._held_index, self._held = index, samples
        self._release()

    def _count_overtaken(self, index: NDArray[np.int64]) -> None:
        """Tell frames that were overtaken from repeats and from those that come too late."""
        floor = index[0] - 1 if self._highest is None else self._highest
        before = np.maximum.accumulate(np.concatenate(([floor], index[:-1])))
        self._highest = max(int(floor), int(index.max()))
        behind = index <= before
        if not behind.any():
            return
        known = set(self._held_index.tolist())
        seen_at = {i: k for k, i in reversed(list(enumerate(index.tolist())))}
        for place in np.flatnonzero(behind).tolist():
            at = int(index[place])
            if self._next is not None and at < self._next:
                self._count_too_late(at)
            elif at in known or seen_at[at] < place:
                self.counters.frames_duplicate += 1
            else:
                self.counters.frames_reordered += 1

    def _count_too_late(self, at: int) -> None:
        for k, (start, end) in enumerate(self._gaps):
            if start <= at < end:
                # What is left of the gap: a second copy of the same frame is a repeat, not late.
                self._gaps[k] = (start, at)
                self._gaps.append((at + self._per_frame, end))
                self.counters.frames_late += 1
                return
        self.counters.frames_duplicate += 1

    def _release(self, *, everything: bool = False) -> None:
        while self._held is not None:
            index = self._held_index
            newest = int(index[-1])
            if self._next is None:
                # The first frame may have been overtaken too: wait as long as for any gap.
                if not everything and newest - int(index[0]) < self._window:
                    return
                self._next = int(index[0])
            keep = index >= self._next
            if not keep.all():
                self._hold(index[keep], self._held[keep])
                continue
            lost = int(index[0]) - self._next
            if lost and not everything and newest - self._next < self._window:
                return
            run = index - index[0] == self._per_frame * np.arange(len(index))
            length = len(run) if run.all() else int(np.argmin(run))
            self._emit(int(index[0]), self._held[:length], lost)
            self._hold(index[length:], self._held[length:])

    def _hold(self, index: NDArray[np.int64], samples: Samples) -> None:
        self._held_index = index
        self._held = samples if len(index) else None

    def _emit(self, first: int, samples: Samples, lost: int) -> None:
        assert self._next is not None  # noqa: S101 - `_release` has set it
        quality = Quality.GOOD
        if not self._time.settled:
            quality |= Quality.TIME_UNSETTLED
        if lost:
            quality |= Quality.AFTER_LOSS
            if self._after_restart or self._counts_arrivals:
                quality |= Quality.LOSS_ESTIMATED
            note_gap(self.counters, self.stream, lost, first)
            self._gaps.append((self._next, first))
        self._after_restart = False
        # Whatever is still held back waits for another frame than before.
        self._waiting_since_ns = self._arrival_ns
        flat = np.ascontiguousarray(samples.reshape(-1, samples.shape[2]))
        flat = note_received(self.counters, self.stream, flat)
        self._next = first + len(flat)
        self._deliver(
            SampleBlock(
                self.stream,
                first,
                flat,
                self._time.time_of(first),
                self._time.period_ns,
                lost,
                quality,
                self._time.error_at(first),
            )
        )
