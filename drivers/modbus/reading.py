"""What all ways of polling samples share: going on after a failed request."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Protocol

from daqsvc.errors.buses import REGISTER_REFUSED
from daqsvc.errors.code import coded
from drivers.modbus.replies import OTHER_REMEDY, REMEDIES, LineLostError, NoReplyError, RequestRefusedError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.modbus.line import ModbusLine

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

    @property
    def faults(self) -> dict[str, str]:
        """By stream, why the last request for it has failed, in a clause."""
        ...


class PollingReader(ABC):
    """A reader that polls, and goes on after a request that failed.

    Args:
        streams: names of what it reads.
        clock: the service's clock.

    Attributes:
        faults: by stream, why the last request for it has failed, in a clause; without those that work.
    """

    def __init__(self, streams: Sequence[str], clock: Clock) -> None:
        self._names = streams
        self._who = streams_in_words(streams)
        self._clock = clock
        self.faults: dict[str, str] = {}
        self._logged: set[str] = set()

    async def run(self, line: ModbusLine) -> None:
        """See `Reader.run`."""
        while True:
            try:
                await self._look(line)
            except LineLostError:
                return
            except (NoReplyError, RequestRefusedError) as error:
                self._stand(self._faults_of(error))
                await self._pause_after_failure()
            else:
                self._stand({})

    def _faults_of(self, error: NoReplyError | RequestRefusedError) -> dict[str, str]:
        """By stream, why it gets no sample; a refusal is logged once."""
        return self._faults_by_stream(error, self._names)

    def _faults_by_stream(
        self, error: NoReplyError | RequestRefusedError, streams: Sequence[str]
    ) -> dict[str, str]:
        """The same, of streams that one request was for."""
        fault = f"{error}"
        if isinstance(error, RequestRefusedError):
            remedy = REMEDIES.get(error.code, OTHER_REMEDY)
            self._tell(streams, fault, remedy)
            fault = f"{fault}; {remedy}"
        return dict.fromkeys(streams, fault)

    def _stand(self, faults: Mapping[str, str]) -> None:
        self.faults.clear()
        self.faults.update(faults)

    def _tell(self, streams: Sequence[str], refusal: str, remedy: str) -> None:
        """Log each refusal once; the counters of the bus have how often there were such."""
        if (message := f"{streams_in_words(streams)}: {refusal}") not in self._logged:
            self._logged.add(message)
            logger.warning(
                "%s, which is counted from now on; %s", message, remedy, extra=coded(REGISTER_REFUSED)
            )

    @abstractmethod
    async def _look(self, line: ModbusLine) -> None:
        """Read what there is, and wait until it is worth looking again."""

    @abstractmethod
    async def _pause_after_failure(self) -> None:
        """Wait until it is worth asking again."""


def streams_in_words(names: Sequence[str]) -> str:
    """Streams as a person would name them, e.g. ``"streams 'a', 'b' and 'c'"``."""
    *others, last = map(repr, names)
    return f"streams {', '.join(others)} and {last}" if others else f"stream {last}"
