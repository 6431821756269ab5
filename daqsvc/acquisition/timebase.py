"""The time base: from a device's sample count to host monotonic time.

Frames arrive late, never early: the bus, the kernel and the scheduler add delay and take none away.
So the truth lies along the lower edge of the cloud of arrivals. The estimator keeps the earliest
arrival of every tenth of a second and supports a line under them where it fits the whole window best
(`daqsvc.acquisition.clock_line`). Jitter of 10 ms then moves the estimate by far less than a millisecond,
and the estimate states how far off it may be. The constant part of the delay cannot be seen from one side and
stays in.

Where all arrivals contradict the line it was wrong, or the device's clock has stepped, and the line begins
again: at once when they are early, for nothing comes before its time; after some seconds when they are late
and do not catch up, for they may have been delayed.

A device whose clock is off by more than 5 % has another rate than the nominal one. The line then follows the
rate that it has, and `TimeBase.rate_doubt` states it.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.acquisition.arrival_count import ArrivalCount
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.clock_line import PARTS, Bucket, ClockLine, clock_line
from daqsvc.acquisition.counter import CounterUnwrapper
from daqsvc.dsp.quality.rate import AS_BEFORE, FITS, PLAUSIBLE
from daqsvc.rounding import readable

if TYPE_CHECKING:
    from numpy.typing import NDArray

BUCKET_NS = 100_000_000
WINDOW_BUCKETS = 600
SETTLING_NS = 2 * NS_PER_S
RECENT_DELAYS = 1024
CONTRADICTION_NS = NS_PER_S // 2
"""How far arrivals must be off the line, beyond what it may err, to contradict it."""
LATE_NS = 20_000_000
"""By how much all arrivals of a while must be late, too, for the line to be in doubt."""
CONTRADICTED_NS = 4 * NS_PER_S
"""How long late arrivals must contradict the line until it is given up."""
FELL_BEHIND_NS = 10 * NS_PER_S
"""How long arrivals must be later and later until the device is taken to be slower than it was."""
RATE_SURE_NS = 3 * NS_PER_S
"""Of how much time the arrivals must agree on another rate than the nominal one, ..."""
RATE_SURE_BUCKETS = 7
"""... and in how many buckets: of a frame every two seconds, one that is late makes another rate of three."""
PLAUSIBLE_NS = 2 * NS_PER_S // 5
"""The nominal rate is taken for the device's if the first arrivals of so long fit within `PLAUSIBLE`."""
STRAIGHT = 1.0 / 20.0
"""How far they may lie off a line of that rate, as a share of what they are off one of the nominal rate."""
BEND, BEND_BUCKETS = 0.85, 30
"""Arrivals of so many buckets that take a smaller part of their time are of a faster device."""
MOST_RATIO = 1000.0
"""How many times its nominal rate a device may seem to send, and the other way round."""
CLOCK_DRIFT = 300e-6
"""How far a device's rate may be off the measured one an outage later."""
_NO_BUCKETS = np.empty((0, len(Bucket._fields)))


class TimeBaseState(NamedTuple):
    """What the time base knows about a device's clock.

    Attributes:
        period_ns: estimated time between samples.
        drift_ppm: by how much the device samples faster (+) or slower (-) than its nominal rate.
        jitter_ns: 95th percentile of the delay of arrivals behind the earliest possible ones.
        settled: whether rate and offset come from at least two seconds of arrivals.
        restarts: how often the device has restarted its counter.
        error_ns: 95th percentile of the error of `TimeBase.time_of` for what arrives now, beside the constant
            part of the delay; infinite until it has settled.
        doubt: why nothing can be judged by the stream's samples; empty if they can.
    """

    period_ns: float
    drift_ppm: float
    jitter_ns: float
    settled: bool
    restarts: int
    error_ns: float = math.inf
    doubt: str = ""

    @property
    def rate_hz(self) -> float:
        """Samples per second, as estimated."""
        return NS_PER_S / self.period_ns


class Late(NamedTuple):
    """Arrivals that were late: their bucket, and how late the earliest of them was by the line, in ns."""

    bucket: Bucket
    off_ns: float


class TimeBase:
    """Places frames by their counter and disciplines a line from sample index to host time.

    Args:
        rate_hz: nominal sampling rate.
        counter_bits: width of the counter, see `daqsvc.acquisition.counter`; None if there is none: frames
            are then counted by their times (`daqsvc.acquisition.counter`), one count a frame.
        samples_per_frame: samples of each channel in a frame.
        counts_per_frame: by how much the counter grows from frame to frame.
        reorder_window_ns: how long a frame may be overtaken on its way.
    """

    def __init__(
        self,
        rate_hz: float,
        counter_bits: int | None,
        samples_per_frame: int,
        counts_per_frame: int,
        reorder_window_ns: int = 10_000_000,
    ) -> None:
        self._nominal_ns = NS_PER_S / rate_hz
        if counter_bits is None:
            counts_per_frame = 1
        self._samples_per_count = samples_per_frame // counts_per_frame
        count_rate_hz = rate_hz / self._samples_per_count
        self._unwrapper: CounterUnwrapper | ArrivalCount
        if counter_bits is None:
            self._unwrapper = ArrivalCount(NS_PER_S / count_rate_hz)
        else:
            self._unwrapper = CounterUnwrapper(
                counter_bits,
                counts_per_frame,
                count_rate_hz,
                # Wider than the window: a frame that comes too late should be known as late, not as alien.
                reorder_counts=round(4 * reorder_window_ns * count_rate_hz / NS_PER_S) + 2 * counts_per_frame,
            )
        # A frame is complete, and can leave, when its last sample has been taken.
        self._last_in_frame = samples_per_frame - 1
        self._restarts = 0
        self._delays: deque[float] = deque(maxlen=RECENT_DELAYS)
        self._buckets = _NO_BUCKETS
        self._period_ns = self._nominal_ns
        self._origin: tuple[int, int] | None = None
        self._bucket_best: tuple[int, int] | None = None
        self._bucket_start = 0
        self._bucket_sums = (0, 0.0, 0.0)
        self._offset_ns = 0.0
        self._error_ns = math.inf
        self._settled = False
        self._contradiction_ns = CONTRADICTION_NS + 2 * samples_per_frame * self._nominal_ns
        self._late: deque[Late] = deque()
        self.rate_doubt = ""
        """Why the device's rate is not the nominal one, in words; empty if it is, or if not known yet."""
        self._doubted_hz = 0.0
        self.rate_known = False
        """Whether the device's rate has been measured, or seems to be the nominal one."""

    @property
    def state(self) -> TimeBaseState:
        """A snapshot of what is known."""
        jitter = float(np.percentile(self._delays, 95)) if self._delays else 0.0
        return TimeBaseState(
            period_ns=self._period_ns,
            drift_ppm=(self._nominal_ns / self._period_ns - 1) * 1e6,
            jitter_ns=jitter,
            settled=self._settled,
            restarts=self._restarts,
            error_ns=max(self._error_ns, self._doubt_ns),
            doubt=self.rate_doubt,
        )

    @property
    def period_ns(self) -> float:
        """Estimated time between samples."""
        return self._period_ns

    @property
    def settled(self) -> bool:
        """Whether rate and offset come from at least two seconds of arrivals."""
        return self._settled

    @property
    def watch_ns(self) -> int:
        """How long a batch may have to wait for what comes after it; see `wants_more`."""
        return self._unwrapper.watch_ns

    def wants_more(self, counter: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> bool:
        """Whether a batch is behind the clock, so that it is better placed together with what comes after it.

        Args:
            counter: int64 ``[n]``, as sent.
            arrival_ns: int64 ``[n]``, host monotonic, not decreasing.
        """
        return self._unwrapper.wants_more(counter, arrival_ns)

    def sure(self, counter: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> int:
        """How many frames at the beginning of a batch that `wants_more` need not wait for what comes.

        Args:
            counter: int64 ``[n]``, as sent.
            arrival_ns: int64 ``[n]``, host monotonic, not decreasing.
        """
        return self._unwrapper.sure(counter, arrival_ns)

    def begin_afresh(self, first_index: int) -> None:
        """Take the next frame as the first one of a sender that begins again, with its own clock.

        Args:
            first_index: the index of its first sample.
        """
        self._forget()
        self._unwrapper.begin_afresh(first_index // self._samples_per_count)

    def place(
        self, counter: NDArray[np.int64], arrival_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_], list[int], bool]:
        """Place a batch of frames and learn from their arrivals.

        Args:
            counter: int64 ``[n]``, as sent.
            arrival_ns: int64 ``[n]``, host monotonic, not decreasing.

        Returns:
            int64 ``[n]``, the index of each frame's first sample; bool ``[n]``, False for frames that belong
            nowhere. Places in the batch at which the device restarted its counter; whether the arrivals
            contradicted the time base, so that it has begun again.
        """
        counts, kept, restarts = self._unwrapper.place(counter, arrival_ns)
        index = counts * self._samples_per_count
        if restarts:
            # A new epoch: where it begins on the old line is a guess, so the line starts afresh.
            self._restarts += len(restarts)
            fresh = slice(restarts[-1], None)
            self._forget()
            self._unwrapper.forget_rate()
            anew = self._learn(index[fresh][kept[fresh]], arrival_ns[fresh][kept[fresh]])
        else:
            anew = self._learn(index[kept], arrival_ns[kept])
        return index, kept, restarts, anew

    def learn(self, index: NDArray[np.int64], arrival_ns: NDArray[np.int64], *, restarted: bool) -> bool:
        """Learn from frames whose place is known, since their driver follows the device's counter itself.

        Args:
            index: int64 ``[n]``, sample index of each frame's first sample.
            arrival_ns: int64 ``[n]``, host monotonic, not decreasing.
            restarted: whether where they belong is a guess, since the device has restarted its counter.

        Returns:
            Whether the line has begun again, since the arrivals contradicted it.
        """
        if restarted:
            self._restarts += 1
            self._forget()
        return self._learn(index, arrival_ns)

    def time_of(self, index: int) -> int:
        """Host monotonic time in ns at which sample ``index`` was taken.

        Raises:
            LookupError: no frame has arrived yet.
        """
        if self._origin is None:
            raise LookupError("no frame has arrived yet: there is no time base")
        index0, arrival0 = self._origin
        return arrival0 + round((index - index0) * self._period_ns + self._offset_ns)

    def error_at(self, index: int) -> float:
        """95th percentile of the error of `time_of`, in ns, beside the constant part of the delay.

        It grows with the distance to the last arrivals; infinite until the time base has settled. While the
        arrivals contradict the line it is at least what they are off.
        """
        if self._origin is None or not self._settled:
            return math.inf
        return max(self._line_error(index - self._origin[0]), self._doubt_ns)

    def _line_error(self, x: int) -> float:
        first, last = float(self._buckets[:, 0].min()), float(self._buckets[:, 0].max())
        ahead = max(0.0, x - last)
        return self._error_ns * (1.0 + 2.0 * ahead / max(last - first, 1.0))

    def _forget(self) -> None:
        self._origin = self._bucket_best = None
        self._bucket_sums = (0, 0.0, 0.0)
        self._buckets = _NO_BUCKETS
        self._delays.clear()
        self._late.clear()
        self._period_ns, self._offset_ns = self._nominal_ns, 0.0
        self._error_ns = math.inf
        self._settled = False

    def _learn(self, index: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> bool:
        """Take in arrivals; returns whether the line has begun again because of them."""
        if not len(index):
            return False
        if self._origin is None:
            self._origin = (int(index[0]) + self._last_in_frame, int(arrival_ns[0]))
            self._bucket_start = 0
        x = index + self._last_in_frame - self._origin[0]
        y = arrival_ns - self._origin[1]
        delay = y - (x * self._period_ns + self._offset_ns)
        self._delays.extend(delay[-RECENT_DELAYS:].tolist())
        earliest = int(np.argmin(delay))
        point = (int(x[earliest]), int(y[earliest]))
        if self._bucket_best is None or self._residual(point) < self._residual(self._bucket_best):
            self._bucket_best = point
        count, sum_x, sum_late = self._bucket_sums
        self._bucket_sums = (
            count + len(x),
            sum_x + float(x.sum()),
            sum_late + float((y - x * self._nominal_ns).sum()),
        )
        if not self._settled:
            # Until there is a slope to speak of, hang the nominal line under the earliest arrival.
            self._offset_ns = min(self._offset_ns, self._residual(self._bucket_best))
        newest = int(y.max())
        if newest - self._bucket_start >= BUCKET_NS:
            count, sum_x, sum_late = self._bucket_sums
            bucket = Bucket(*self._bucket_best, count, sum_x / count, sum_late / count)
            self._bucket_best, self._bucket_sums = None, (0, 0.0, 0.0)
            self._bucket_start = newest
            return self._append(bucket)
        return False

    def _append(self, bucket: Bucket) -> bool:
        """Lay the line under a bucket, unless it contradicts the line; returns whether that began again."""
        off_ns = self._residual((bucket.x, bucket.y_ns)) - self._offset_ns if self._settled else 0.0
        may_err_ns = 3.0 * self._line_error(bucket.x) if self._settled else 0.0
        if off_ns < -self._contradiction_ns - may_err_ns:
            self._begin_anew([bucket])
            return True
        if off_ns <= LATE_NS + may_err_ns:
            self._late.clear()
        else:
            self._late.append(Late(bucket, off_ns))
            while len(self._late) > PARTS and bucket.y_ns - self._late[1].bucket.y_ns >= FELL_BEHIND_NS:
                self._late.popleft()
        if off_ns <= self._contradiction_ns + may_err_ns:
            self._buckets = np.vstack([self._buckets[1 - WINDOW_BUCKETS :], bucket])
            self.rate_known = self.rate_known or self._is_plausible()
            if self._is_faster():
                self._begin_anew([Bucket(*row) for row in self._buckets[-BEND_BUCKETS:].tolist()])
                return True
            self._support()
        elif late := self._late_for(CONTRADICTED_NS) or self._ever_later():
            self._begin_anew([one.bucket for one in late])
            return True
        return False

    def _late_for(self, duration_ns: int) -> list[Late]:
        """The arrivals of so long, if all were late by about as much: delayed ones catch up."""
        last = self._late[-1]
        first = next(
            (k for k, one in enumerate(reversed(self._late), 1) if _apart(one, last) >= duration_ns), 0
        )
        late = list(self._late)[-first:] if first >= PARTS else []
        steady = late and abs(last.off_ns - late[0].off_ns) <= FITS * _apart(late[0], last)
        return late if steady else []

    def _ever_later(self) -> list[Late]:
        """The latest arrivals, if they have fallen behind all the time: so do those of a slower device."""
        late = list(self._late)
        if _apart(late[0], late[-1]) < FELL_BEHIND_NS or len(late) < 2 * PARTS:
            return []
        off = np.array([one.off_ns for one in late])
        t = np.array([one.bucket.y_ns - late[0].bucket.y_ns for one in late], np.float64)
        growth = off[-1] - off[0]
        straight = np.abs(off - off[0] - growth * t / t[-1]).max() <= growth / 8.0
        counted = late[-1].bucket.x > late[0].bucket.x
        return late if counted and straight and growth > FITS * t[-1] else []

    @property
    def _doubt_ns(self) -> float:
        """By how much the arrivals contradict the line."""
        if not self._late:
            return 0.0
        if self._late[-1].off_ns > self._contradiction_ns:
            return self._late[-1].off_ns
        return min((late.off_ns for late in self._late_for(CONTRADICTED_NS // 2)), default=0.0)

    def _begin_anew(self, buckets: list[Bucket]) -> None:
        origin = self._origin
        self._forget()
        self._unwrapper.forget_rate()
        self._origin = origin
        self._buckets = np.array(buckets, np.float64)
        self._offset_ns = min(self._residual((bucket.x, bucket.y_ns)) for bucket in buckets)
        self._support()

    def _residual(self, point: tuple[int, int]) -> float:
        return point[1] - point[0] * self._period_ns

    def _support(self) -> None:
        """Lay the line under the window's arrivals."""
        if np.ptp(self._buckets[:, 1]) < SETTLING_NS:
            return
        drift_ns = FITS * self._nominal_ns
        line = self._line_of_any_rate() or clock_line(self._buckets, self._nominal_ns, (-drift_ns, drift_ns))
        off = line is not None and abs(line.slope_ns) > drift_ns
        if line is None or (off and not self._may_show_rate):
            return
        self._period_ns = self._nominal_ns + line.slope_ns
        self._offset_ns, self._error_ns = line.offset_ns, line.error_ns
        self._settled = True
        if off or abs(line.slope_ns) < drift_ns:
            self._note_rate(nominal=not off)
            counted_ns = float(np.ptp(self._buckets[:, 0])) * self._period_ns
            drift = CLOCK_DRIFT + 2.0 * line.error_ns / counted_ns
            self._unwrapper.measured(NS_PER_S / self._period_ns / self._samples_per_count, drift)

    @property
    def _may_show_rate(self) -> bool:
        """Whether there are arrivals enough to show another rate than the nominal one."""
        enough = len(self._buckets) >= RATE_SURE_BUCKETS
        return enough and float(np.ptp(self._buckets[:, 1])) >= RATE_SURE_NS

    def _line_of_any_rate(self) -> ClockLine | None:
        """The line, if the arrivals are those of a device with its own rate, whatever that is.

        None if they are of a stall, or of frames that were held up: such show no rate. Where the device has
        had another rate before, the arrivals of that time are forgotten.
        """
        drift_ns = FITS * self._nominal_ns
        any_slope = (self._nominal_ns / MOST_RATIO - self._nominal_ns, self._nominal_ns * MOST_RATIO)
        line = clock_line(self._buckets, self._nominal_ns, any_slope)
        if line is None or abs(line.slope_ns) <= drift_ns or not self._may_show_rate:
            return line
        if self._is_straight(line, self._buckets, self._nominal_ns):
            return line
        recent = self._buckets[-BEND_BUCKETS:]
        if np.ptp(recent[:, 1]) < SETTLING_NS:
            return None
        line = clock_line(recent, self._nominal_ns, any_slope)
        if line is None or abs(line.slope_ns) > drift_ns:
            return None
        self._buckets = recent
        return line

    def _note_rate(self, *, nominal: bool) -> None:
        self.rate_known = True
        rate_hz = NS_PER_S / self._period_ns
        if nominal:
            self.rate_doubt, self._doubted_hz = "", 0.0
        elif abs(rate_hz - self._doubted_hz) > AS_BEFORE * rate_hz:
            self.rate_doubt = rate_in_words(rate_hz, self._nominal_ns, self._samples_per_count)
            self._doubted_hz = rate_hz

    def _is_faster(self) -> bool:
        """Whether the latest arrivals are those of a faster device than the line's, which they only bend."""
        recent = self._buckets[-BEND_BUCKETS:]
        if not self._settled or len(self._buckets) < 2 * BEND_BUCKETS or recent[-1, 0] <= recent[0, 0]:
            return False
        if np.ptp(recent[:, 1]) > BEND * float(np.ptp(recent[:, 0])) * self._period_ns:
            return False
        limit_ns = self._nominal_ns * MOST_RATIO
        line = clock_line(recent, self._nominal_ns, (-self._nominal_ns, limit_ns))
        return line is not None and self._is_straight(line, recent, self._period_ns)

    def _is_plausible(self) -> bool:
        x, y_ns = self._buckets[-1, :2] - self._buckets[0, :2]
        return bool(y_ns >= PLAUSIBLE_NS and abs(x * self._nominal_ns / y_ns - 1.0) <= PLAUSIBLE)

    def _is_straight(self, line: ClockLine, buckets: NDArray[np.float64], period_ns: float) -> bool:
        """Whether arrivals lie along a line, as those of a device do that has another rate.

        Args:
            line: through them.
            buckets: float64 ``[n, 5]``.
            period_ns: of the rate that they are not of.
        """
        x = buckets[:, 0]
        measured_ns = self._nominal_ns + line.slope_ns
        late = buckets[:, 1] - x * measured_ns - line.offset_ns
        return float(np.percentile(late, 90)) <= STRAIGHT * abs(measured_ns - period_ns) * float(np.ptp(x))


_LIKE_SAMPLES = 0.02
"""How near the rate must be to that of a counter of samples."""


def rate_in_words(rate_hz: float, nominal_ns: float, samples_per_count: int = 1) -> str:
    """What to report about a device whose rate is not the nominal one.

    Args:
        rate_hz: what it sends, samples per second.
        nominal_ns: nominal time between samples.
        samples_per_count: samples of a channel by which the counter grows by 1, as the file has it.
    """
    stated_hz = NS_PER_S / nominal_ns
    begin = f"the device sends {readable(rate_hz)} Hz, the file states {readable(stated_hz)}"
    if samples_per_count > 1 and abs(rate_hz / stated_hz / samples_per_count - 1.0) < _LIKE_SAMPLES:
        # A frame seems to be that many frames, of which all but one are lost.
        return (
            f'{begin}, {samples_per_count} times less: write counts = "samples" for the counter if it grows '
            "by the samples in a frame, or correct rate_hz"
        )
    return f"{begin}; correct rate_hz in the machine file, or the device's setting"


def _apart(one: Late, other: Late) -> int:
    return other.bucket.y_ns - one.bucket.y_ns
