"""What all ways of polling samples share: going on after a failed request."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Protocol

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


class PollingReader(ABC):
    """A reader that looks again and again, and goes on after a request that failed.

    Args:
        streams: names of what it reads.
        clock: the service's clock.
    """

    def __init__(self, streams: Sequence[str], clock: Clock) -> None:
        self._who = streams_in_words(streams)
        self._clock = clock
        self._said: set[str] = set()

    async def run(self, line: ModbusLine) -> None:
        """See `Reader.run`."""
        while True:
            try:
                await self._look(line)
            except LineLostError:
                return
            except (NoReplyError, RequestRefusedError) as error:
                if isinstance(error, RequestRefusedError):
                    self._tell(error)
                await self._pause_after_failure()

    def _tell(self, error: RequestRefusedError, who: str = "") -> None:
        """Tell each refusal once; how often there are such, the counters of the bus say.

        Args:
            error: what is refused.
            who: gets no sample of it; all streams if left out.
        """
        if (message := f"{who or self._who}: {error}") not in self._said:
            self._said.add(message)
            remedy = REMEDIES.get(error.code, OTHER_REMEDY)
            logger.warning("%s, which is counted from now on; %s", message, remedy)

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
