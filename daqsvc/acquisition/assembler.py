"""From decoded frames to blocks: in order, each sample once, every loss counted.

One assembler serves one stream. It places frames by the time base, puts overtaken frames back in
order within the reorder window, drops repeats, and hands over blocks whose `lost_before` states exactly
what is missing.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.acquisition.arrival_count import SURE_FRAMES
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.counter_sense import CounterSense
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.acquisition.standing import QUIET_NS, StreamStanding, tell_nobody
from daqsvc.acquisition.timebase import TimeBase, TimeBaseState, rate_in_words
from daqsvc.dsp.quality.rate import FITS, ArrivalRate
from daqsvc.errors.buses import NO_FRAME, NO_MEASUREMENT, SAMPLES_MISSING, TIME_UNSURE
from daqsvc.errors.code import coded
from daqsvc.rounding import readable

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import Samples
    from daqsvc.acquisition.standing import Tell

    Frames: TypeAlias = tuple[NDArray[np.int64], Samples, NDArray[np.int64]]
    """Counters, samples and times of arrival, see `StreamAssembler.accept`."""

logger = logging.getLogger(__name__)

REMEMBERED_GAPS = 256
ASK_AGAIN_NS = NS_PER_S // 20
"""How often frames that wait for what comes after them are examined again."""


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
        frames_set_aside: of those, come while the stream could not be placed: its counter did not change or
            made no sense, or far more frames came than the file states.
        frames_wrong_length: frames of the stream's id that are shorter or longer than its layout.
        samples_received: samples handed on.
        samples_lost: samples that were lost, by the device's counter, or by time if it sends none.
        gaps: how often samples were missing.
        values_absent: values in the samples handed on, of any channel, that the device marked as
            absent, or that are not finite.
    """

    frames_received: int = 0
    frames_corrupt: int = 0
    frames_duplicate: int = 0
    frames_reordered: int = 0
    frames_late: int = 0
    frames_rejected: int = 0
    frames_set_aside: int = 0
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
            from the times of arrival (`daqsvc.dsp.quality.rate`).
        samples_per_frame: samples of each channel in a frame.
        counts_per_frame: by how much the counter grows from frame to frame.
        deliver: called with each block, in order, from the thread that calls `accept`.
        reorder_window_ns: how long a gap may wait for an overtaken frame, in time of the samples.
        stamped: whether the counter is made of the device's time stamps with the nominal rate, and so shows
            nothing of its rate.
        tell: called when it changes whether anything can be judged by the samples.
        unread: how many frames have come that could not be read and may have been of the stream.
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
        stamped: bool = False,
        tell: Tell = tell_nobody,
        unread: Callable[[], int] = lambda: 0,
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
        self._unplaced: list[Frames] = []
        self._doubtful: Frames | None = None
        """The last frame that came, if only the next one can show whether it is the first after a restart."""
        self._asked_ns = 0
        self._advanced_ns = 0
        frame_rate_hz = rate_hz / samples_per_frame
        self._sense = CounterSense(counter_bits, counts_per_frame, frame_rate_hz)
        self._arrivals = ArrivalRate(frame_rate_hz) if self._counts_arrivals or stamped else None
        self._rate_hz = rate_hz
        self._unread = unread
        self._standing = StreamStanding(stream, tell)
        self._logged_ns: dict[str, int] = {}

    @property
    def time_base(self) -> TimeBaseState:
        """What is known about the device's clock."""
        return self._time.state._replace(doubt=self.doubt)

    @property
    def doubt(self) -> str:
        """Why nothing can be judged by the samples; empty if nothing is known against them."""
        if self._sense.doubt or self._arrivals is None:
            return self._sense.doubt or self._time.rate_doubt
        if self._arrivals.rate_hz is None or self._arrivals.fits:
            return ""
        rate_hz, unread = self._arrivals.rate_hz * self._per_frame, self._unread()
        with_them_hz = rate_hz * (1.0 + unread / max(self.counters.frames_received, 1))
        if unread and abs(with_them_hz / self._rate_hz - 1.0) <= FITS:
            return (
                f"only {readable(rate_hz)} of {readable(self._rate_hz)} Hz can be read; the rest does not "
                "fit the layout (frames_malformed): correct the layout, or check the cable"
            )
        return rate_in_words(rate_hz, NS_PER_S / self._rate_hz)

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
                    "stream %r: the CRC of a frame, or the checksum of a line, does not match, or no sync "
                    "word follows a frame without a CRC; it is counted and left out. If it is every one, "
                    "compare crc and its place, sync_word, or checksum with those of the device",
                    self.stream,
                    extra=coded(NO_FRAME),
                )
            self.counters.frames_corrupt += int((~intact).sum())
            counter, samples, arrival_ns = counter[intact], samples[intact], arrival_ns[intact]
        if not len(counter):
            return
        self._look(counter, samples, arrival_ns)
        known = self._time.rate_known if self._arrivals is None else self._arrivals.known
        self._standing.update(self.doubt, int(arrival_ns[-1]), known=known)

    def _look(self, counter: NDArray[np.int64], samples: Samples, arrival_ns: NDArray[np.int64]) -> None:
        """Place frames, or set them aside."""
        if self._arrivals is not None:
            self._arrivals.add(arrival_ns)
        was_aside = bool(self._sense.doubt)
        if self._sense.look(counter, arrival_ns):
            if not was_aside:
                self._place()
                self._release(everything=True)
            self.counters.frames_set_aside += len(counter)
            if not self._sense.doubt:
                self._go_on(int(arrival_ns[-1]))
            return
        self._unplaced.append((counter, samples, arrival_ns))
        self._place(until_sure=True)

    def _go_on(self, now_ns: int) -> None:
        """The frames after those that were set aside can be placed: the clock shows where they belong."""
        if self._highest is None:
            return
        away = round((now_ns - self._advanced_ns) / self._time.period_ns / self._per_frame)
        self._time.begin_afresh(self._highest + max(away + 1, 1) * self._per_frame)
        self._after_restart = True

    def tick(self, now_ns: int) -> None:
        """Give up waiting for what nothing has come to show for a while; call every now and then.

        That is how a gap is closed, and why a counter is behind the clock.
        """
        waiting = self._unplaced[0] if self._unplaced else self._doubtful
        if waiting and now_ns - int(waiting[2][-1]) > self._time.watch_ns + self._patience_ns:
            self._place()
        if self._held is not None and now_ns - self._waiting_since_ns > self._patience_ns:
            self._release(everything=True)

    def begin_afresh(self) -> None:
        """What comes next is of a sender that is known to begin again, such as a recording played again.

        Its first frame takes the next index, whatever its counter is: nothing is lost. Its times are its own.
        """
        self._hand_over()
        if self._next is not None:
            self._time.begin_afresh(self._next)
            self._after_restart = True

    def flush(self) -> None:
        """Hand over what is held back: the link is gone, or the service stops."""
        self._hand_over()
        self._standing.give_up_waiting()

    def _hand_over(self) -> None:
        self._place()
        self._release(everything=True)

    def _place(self, *, until_sure: bool = False) -> None:
        """Place what has come, unless more has to come before that can be done for sure."""
        ready = self._ready(until_sure=until_sure)
        if ready is None:
            return
        counter, samples, arrival_ns = ready
        newest_ns = int(arrival_ns[-1])
        indices, fits, restarts, anew = self._time.place(counter, arrival_ns)
        if until_sure and not fits[-1]:
            self._doubtful = counter[-1:], samples[-1:], arrival_ns[-1:]
            counter, samples, indices, fits = counter[:-1], samples[:-1], indices[:-1], fits[:-1]
        before = self.counters.frames_rejected
        self._reject(int((~fits).sum()))
        if restarts:
            self._say(
                "stream %r: the device has restarted its counter, or has not counted for a while; "
                "how many samples are missing is estimated from the clock",
                newest_ns,
            )
        if anew:
            self._say(
                "stream %r: its samples do not arrive at the times that its clock predicts; its "
                "time base begins again",
                newest_ns,
            )
        start = 0
        for restart in [*restarts, len(counter)]:
            part = slice(start, restart)
            kept = fits[part]
            self._merge(indices[part][kept], samples[part][kept], int(arrival_ns[-1]))
            if restart < len(counter):
                self._release(everything=True)
                self._after_restart = True
            start = restart
        self._sense.placed(len(counter), self.counters.frames_rejected - before, newest_ns)

    def _ready(self, *, until_sure: bool) -> Frames | None:
        """What can be placed now, the frame that was doubtful first; None if that is nothing."""
        come = self._unplaced
        self._unplaced = []
        if until_sure:
            newest_ns = int(come[-1][2][-1])
            if len(come) > 1 and 0 <= newest_ns - self._asked_ns < ASK_AGAIN_NS:
                self._unplaced = come
                return None
            counter, samples, arrival_ns = _joined(come)
            if self._time.wants_more(counter, arrival_ns):
                self._asked_ns = newest_ns
                sure = self._time.sure(counter, arrival_ns)
                self._unplaced = [(counter[sure:], samples[sure:], arrival_ns[sure:])]
                if not sure:
                    return None
                counter, samples, arrival_ns = counter[:sure], samples[:sure], arrival_ns[:sure]
            come = [(counter, samples, arrival_ns)]
        if self._doubtful is not None:
            come = [self._doubtful, *come]
            self._doubtful = None
        return _joined(come) if come else None

    def _reject(self, frames: int) -> None:
        if frames and not self.counters.frames_rejected:
            logger.warning(
                "stream %r: a frame's counter fits neither the sequence nor a restart; "
                "such frames are counted and left out",
                self.stream,
                extra=coded(NO_FRAME),
            )
        self.counters.frames_rejected += frames

    def _say(self, message: str, now_ns: int) -> None:
        """Log what may happen again and again, but not as often."""
        if message not in self._logged_ns or now_ns - self._logged_ns[message] >= QUIET_NS:
            self._logged_ns[message] = now_ns
            logger.warning(message, self.stream, extra=coded(TIME_UNSURE))

    def _merge(self, index: NDArray[np.int64], samples: Samples, arrival_ns: int) -> None:
        if not len(index):
            return
        self._arrival_ns = arrival_ns
        fresh = self._count_overtaken(index)
        index, samples = index[fresh], samples[fresh]
        if self._held is not None:
            index = np.concatenate([self._held_index, index])
            samples = np.concatenate([self._held, samples])
        else:
            self._waiting_since_ns = arrival_ns
        if (np.diff(index) <= 0).any():
            order = np.argsort(index, kind="stable")
            index, samples = index[order], samples[order]
        self._hold(index, samples)
        self._release()

    def _count_overtaken(self, index: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell frames that were overtaken from repeats and from those that come too late.

        Returns:
            bool ``[n]``, False for the latter two.
        """
        fresh = np.ones(len(index), np.bool_)
        floor = index[0] - 1 if self._highest is None else self._highest
        before = np.maximum.accumulate(np.concatenate(([floor], index[:-1])))
        highest = max(int(floor), int(index.max()))
        if highest > floor:
            self._advanced_ns = self._arrival_ns
        self._highest = highest
        behind = index <= before
        if not behind.any():
            return fresh
        known = set(self._held_index.tolist())
        seen_at = {i: k for k, i in reversed(list(enumerate(index.tolist())))}
        for place in np.flatnonzero(behind).tolist():
            at = int(index[place])
            if self._next is not None and at < self._next:
                fresh[place] = False
                self._count_too_late(at)
            elif at in known or seen_at[at] < place:
                fresh[place] = False
                self.counters.frames_duplicate += 1
            else:
                self.counters.frames_reordered += 1
        return fresh

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
        if self._held is None:
            return
        index, held = self._held_index, self._held
        newest = int(index[-1])
        if self._next is None:
            # The first frame may have been overtaken too: wait as long as for any gap.
            if not everything and newest - int(index[0]) < self._window:
                return
            self._next = int(index[0])
        at = 0
        for end in [*(np.flatnonzero(np.diff(index) != self._per_frame) + 1).tolist(), len(index)]:
            # No count of a device is of a frame that another one has a part of.
            overlapping = int(np.searchsorted(index[at:end], self._next))
            self._reject(overlapping)
            at += overlapping
            if end == at:
                continue
            lost = int(index[at]) - self._next
            if lost and not everything and newest - self._next < self._window:
                break
            self._emit(int(index[at]), held[at:end], lost)
            at = end
        self._hold(index[at:], held[at:])

    def _hold(self, index: NDArray[np.int64], samples: Samples) -> None:
        self._held_index = index
        self._held = samples if len(index) else None

    def _emit(self, first: int, samples: Samples, lost: int) -> None:
        assert self._next is not None  # noqa: S101 - `_release` has set it
        quality, unsure = Quality.GOOD, False
        if not self._time.settled:
            quality |= Quality.TIME_UNSETTLED
        if lost:
            quality |= Quality.AFTER_LOSS
            if self._after_restart or self._counts_arrivals:
                quality |= Quality.LOSS_ESTIMATED
            unsure = self._counts_arrivals and lost > SURE_FRAMES * self._per_frame
            note_gap(self.counters, self.stream, lost, first)
            self._gaps.append((self._next, first))
        if self._after_restart or unsure:
            quality |= Quality.PLACE_ESTIMATED
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


def _joined(parts: list[Frames]) -> Frames:
    """Batches of frames, at least one, as one batch."""
    if len(parts) == 1:
        return parts[0]
    counter, samples, arrival_ns = zip(*parts, strict=True)
    return np.concatenate(counter), np.concatenate(samples), np.concatenate(arrival_ns)


def note_received(counters: StreamCounters, stream: str, samples: Samples, *, left_out: int = 0) -> Samples:
    """Count samples that are handed on, and what in them is absent; the first such is logged.

    A value is absent if the device states that it has none (NaN), or if it is infinite. An overflow on the
    device, or a number too large for a float32, leaves such a value; it is no measurement.

    Args:
        counters: of the stream.
        stream: its name.
        samples: float32 ``[n, channels]``.
        left_out: values counted as absent so far that were never asked for; they are logged elsewhere.

    Returns:
        The samples with NaN for what is absent; the same array if it states it already.
    """
    counters.samples_received += len(samples)
    there = np.isfinite(samples)
    if there.all():
        return samples
    absent = there.size - int(np.count_nonzero(there))
    if counters.values_absent == left_out:
        logger.warning(
            "stream %r: no measurement in %d of its values: the device states that it has none, or what it "
            "sends is not finite; such values are missing, and are counted from now on. Look at the sensors "
            "behind it",
            stream,
            absent,
            extra=coded(NO_MEASUREMENT),
        )
    counters.values_absent += absent
    return samples if not np.isinf(samples).any() else np.where(there, samples, np.float32(np.nan))


def note_gap(counters: StreamCounters, stream: str, lost: int, first: int) -> None:
    """Count a gap; the first one is logged.

    Args:
        counters: of the stream.
        stream: its name.
        lost: samples that are missing.
        first: index of the sample after them.
    """
    if not counters.gaps:
        logger.warning(
            "stream %r: samples are missing before index %d, by now %d; further gaps are only counted",
            stream,
            first,
            lost,
            extra=coded(SAMPLES_MISSING),
        )
    counters.gaps += 1
    counters.samples_lost += lost
