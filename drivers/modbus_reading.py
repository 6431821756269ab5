"""What all ways of polling samples share: going on after a failed request, and from rows to blocks."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from daqsvc.acquisition.assembler import StreamAssembler
from drivers.modbus_outcomes import LineLostError, NoReplyError, RefusedError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.base import StreamSpec
    from drivers.modbus_line import ModbusLine
    from drivers.registers import RegisterRecord

logger = logging.getLogger(__name__)


class Reader(Protocol):
    """Reads one stream, or several that share their requests."""

    async def run(self, line: ModbusLine) -> None:
        """Read until the line is lost; keeps its place for the next line."""
        ...

    def flush(self) -> None:
        """Hand over what is held back."""
        ...

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """Counters and clock of each stream, by name."""
        ...


class PollingReader(ABC):
    """A reader that looks again and again, and goes on after a request that failed.

    Args:
        streams: names of what it reads.
        clock: the service's clock.
    """

    def __init__(self, streams: Sequence[str], clock: Clock) -> None:
        self._who = f"stream{'s' if len(streams) > 1 else ''} {' and '.join(map(repr, streams))}"
        self._clock = clock
        self._said = ""

    async def run(self, line: ModbusLine) -> None:
        """See `Reader.run`."""
        while True:
            try:
                await self._look(line)
            except LineLostError:
                return
            except (NoReplyError, RefusedError) as error:
                if isinstance(error, RefusedError) and f"{error}" != self._said:
                    self._said = f"{error}"
                    logger.warning(
                        "%s: %s; compare the register map of the device with the layout", self._who, error
                    )
                await self._pause_after_failure()

    @abstractmethod
    async def _look(self, line: ModbusLine) -> None:
        """Read what there is, and wait until it is worth looking again."""

    @abstractmethod
    async def _pause_after_failure(self) -> None:
        """Wait until it is worth asking again."""


class RowAssembler:
    """From the registers of counted samples to the blocks of their stream.

    Args:
        spec: the stream.
        clock: the service's clock.
        deliver: called with each block.
        counter_bits: width of the count, the device's or that of the schedule.
    """

    def __init__(
        self,
        spec: StreamSpec[Any],
        clock: Clock,
        deliver: Callable[[SampleBlock], None],
        counter_bits: int,
    ) -> None:
        self._clock = clock
        self._assembler = StreamAssembler(
            spec.name,
            spec.rate_hz,
            counter_bits=counter_bits,
            samples_per_frame=1,
            counts_per_frame=1,
            deliver=deliver,
            reorder_window_ns=0,  # one request at a time: nothing overtakes anything
        )

    @property
    def counters(self) -> StreamCounters:
        """Of the stream."""
        return self._assembler.counters

    @property
    def time_base(self) -> TimeBaseState:
        """What is known about the clock of the samples."""
        return self._assembler.time_base

    def accept(
        self, record: RegisterRecord, counts: NDArray[np.int64], rows: bytes, arrival_ns: NDArray[np.int64]
    ) -> None:
        """Take in samples.

        Args:
            record: what their registers hold.
            counts: int64 ``[n]``, as many bits of them as the counter has.
            rows: their registers, sample by sample.
            arrival_ns: int64 ``[n]``, host monotonic, not decreasing.
        """
        raw = np.frombuffer(rows, np.uint8).reshape(len(counts), -1)
        samples = record.decode(raw)[:, None, :]
        self._assembler.accept(counts, samples, np.ones(len(counts), np.bool_), arrival_ns)
        self._assembler.tick(self._clock.monotonic_ns())

    def flush(self) -> None:
        """Hand over what is held back."""
        self._assembler.flush()
