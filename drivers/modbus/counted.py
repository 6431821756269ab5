"""Samples that the device counts: how far its count may have come, and from rows to blocks on a time base."""

from __future__ import annotations

import logging
from abc import abstractmethod
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from daqsvc.acquisition.assembler import StreamCounters, note_gap, note_received
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.acquisition.standing import QUIET_NS, StreamStanding
from daqsvc.acquisition.timebase import TimeBase
from daqsvc.errors.buses import TIME_UNSURE
from daqsvc.errors.code import coded
from drivers.modbus.reading import PollingReader
from drivers.modbus.registers import RegisterRecord
from drivers.modbus.settings import FifoLayout, RingLayout

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.base import BusPort, StreamSpec

logger = logging.getLogger(__name__)

LARGEST_DRIFT = 0.05
"""How far a device's rate may be off its nominal one."""

AT_ONCE_NS = NS_PER_S
"""Time whose samples a device may show at once."""

STANDSTILL_NS = 2 * NS_PER_S
"""A count that falls behind the clock by more than this has stopped, or has begun again."""

STILL_PERIODS = 4
"""A count that stays for longer than that, and than this number of samples or reads, stands still."""

LEAST_SLACK = 16
"""Samples by which a count may be off the clock, however slow the device is."""

SURE = 4
"""Reads in a row after which a count is believed that neither its past nor the clock explains."""

CountedT = TypeVar("CountedT", FifoLayout, RingLayout)


class SampleClock:
    """What the host clock states about a device's count.

    Args:
        rate_hz: nominal sampling rate.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate = rate_hz / NS_PER_S
        self.at_once = max(AT_ONCE_NS * self._rate, LEAST_SLACK)
        self.standstill = max(STANDSTILL_NS * self._rate, LEAST_SLACK)

    def samples(self, elapsed_ns: int) -> int:
        """Samples that the device takes in a time."""
        return round(self._rate * max(elapsed_ns, 0))

    def least(self, elapsed_ns: int) -> float:
        """Samples that it takes at least."""
        return self._rate * (1 - LARGEST_DRIFT) * max(elapsed_ns, 0)

    def most(self, elapsed_ns: int) -> float:
        """Samples that it takes at most."""
        return self._rate * (1 + LARGEST_DRIFT) * max(elapsed_ns, 0)


class CountedRows:
    """From the registers of counted samples to the blocks of their stream.

    Whoever reads them knows the place of each sample, and hands on each once, in order.

    Args:
        spec: the stream.
        port: of its bus.
    """

    def __init__(self, spec: StreamSpec[CountedT], port: BusPort) -> None:
        self.counters = StreamCounters()
        self._name = spec.name
        self._record = RegisterRecord.of(spec.layout)
        self._deliver = port.deliver
        self._time = TimeBase(
            spec.rate_hz, spec.layout.count.bits, samples_per_frame=1, counts_per_frame=1, reorder_window_ns=0
        )
        self._next: int | None = None
        self._standing = StreamStanding(spec.name, port.tell)
        looks_ns = max(round(NS_PER_S / spec.rate_hz), spec.layout.poll_ns(spec.rate_hz))
        self._still_ns = max(STANDSTILL_NS, STILL_PERIODS * looks_ns)
        self._still = ""
        self._count: int | None = None
        self._count_since_ns = self._looked_ns = 0
        self._new_base_logged_ns: int | None = None

    @property
    def time_base(self) -> TimeBaseState:
        """What is known about the clock of the samples."""
        return self._time.state._replace(doubt=self._still or self._time.rate_doubt)

    def look(self, count: int, seen_ns: int) -> None:
        """See whether the device counts at all.

        Args:
            count: its count, as sent.
            seen_ns: when it was seen, host monotonic.
        """
        listened = seen_ns - self._looked_ns < self._still_ns
        self._looked_ns = seen_ns
        if count != self._count or not listened:
            self._count, self._count_since_ns, self._still = count, seen_ns, ""
        elif seen_ns - self._count_since_ns >= self._still_ns:
            self._still = f"the device's counter stands still at {count}; check the device"
        self._stand(seen_ns)

    def flush(self) -> None:
        """Nothing more comes for now."""
        self._standing.give_up_waiting()

    def _stand(self, now_ns: int) -> None:
        doubt = self._still or self._time.rate_doubt
        self._standing.update(doubt, now_ns, known=self._time.rate_known)

    def hand_on(self, first: int, rows: bytes, seen_ns: int, *, restarted: bool) -> None:
        """Make a block of consecutive samples.

        Args:
            first: index of the first one.
            rows: their registers, sample by sample.
            seen_ns: when the device was seen to have them, host monotonic.
            restarted: whether ``first`` is estimated from the clock.
        """
        raw = np.frombuffer(rows, np.uint8).reshape(-1, 2 * self._record.registers)
        samples = np.ascontiguousarray(self._record.decode(raw))
        index = first + np.arange(len(samples), dtype=np.int64)
        anew = self._time.learn(index, np.full(len(samples), seen_ns, np.int64), restarted=restarted)
        self._stand(seen_ns)
        if anew and (self._new_base_logged_ns is None or seen_ns - self._new_base_logged_ns >= QUIET_NS):
            self._new_base_logged_ns = seen_ns
            logger.warning(
                "stream %r: its samples do not arrive at the times that its clock predicts; its "
                "time base begins again",
                self._name,
                extra=coded(TIME_UNSURE),
            )
        lost = 0 if self._next is None else first - self._next
        self._next = first + len(samples)
        quality = Quality.GOOD if self._time.settled else Quality.TIME_UNSETTLED
        samples = note_received(self.counters, self._name, samples)
        if restarted:
            quality |= Quality.PLACE_ESTIMATED
        if lost:
            quality |= Quality.AFTER_LOSS
            if restarted:
                quality |= Quality.LOSS_ESTIMATED
            note_gap(self.counters, self._name, lost, first)
        self._deliver(
            SampleBlock(
                self._name,
                first,
                samples,
                self._time.time_of(first),
                self._time.period_ns,
                lost,
                quality,
                self._time.error_at(first),
            )
        )


class CountedReader(PollingReader, Generic[CountedT]):
    """A reader of samples that the device counts.

    It keeps two figures of the next sample: its count in the device, which begins again now and then, and
    its index, which never does.
    """

    def __init__(self, spec: StreamSpec[CountedT], port: BusPort) -> None:
        super().__init__([spec.name], port.clock)
        self._name = spec.name
        self._layout: CountedT = spec.layout
        self._poll_ns = spec.layout.poll_ns(spec.rate_hz)
        self._sample_bytes = 2 * spec.layout.sample_registers
        self._per_read = spec.layout.samples_per_read
        self._modulus = spec.layout.count.modulus
        self._sample_clock = SampleClock(spec.rate_hz)
        self._rows = CountedRows(spec, port)
        self._next: int | None = None
        self._index = 0
        self._restarted = False
        self._restart_logged_ns: int | None = None

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `Reader.streams`."""
        return {self._name: (self._rows.counters, self._rows.time_base)}

    @abstractmethod
    def flush(self) -> None:
        """See `Reader.flush`."""

    async def _pause_after_failure(self) -> None:
        await self._clock.sleep_ns(self._poll_ns)

    def _begin_again(self, index: int) -> None:
        """Go on at an index that is estimated from the clock, since the count does not show it any more."""
        now_ns = self._clock.monotonic_ns()
        if self._restart_logged_ns is None or now_ns - self._restart_logged_ns >= QUIET_NS:
            self._restart_logged_ns = now_ns
            logger.warning(
                "stream %r: the device has restarted its count, or has not counted for a while; how many "
                "samples are missing is estimated from the clock",
                self._name,
                extra=coded(TIME_UNSURE),
            )
        self._index = max(self._index, index)
        self._restarted = True

    def _hand_on(self, rows: bytes, seen_ns: int) -> None:
        """Hand on the next samples."""
        assert self._next is not None  # noqa: S101 - there is a next sample once one has been placed
        taken = len(rows) // self._sample_bytes
        self._rows.hand_on(self._index, rows, seen_ns, restarted=self._restarted)
        self._restarted = False
        self._skip(taken)

    def _skip(self, samples: int) -> None:
        assert self._next is not None  # noqa: S101 - as above
        self._index += samples
        self._next = (self._next + samples) % self._modulus
