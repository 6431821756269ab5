"""What drivers have in common whose samples are placed by the device's counter: subclass it, write `read`."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from inspect import isawaitable
from typing import TYPE_CHECKING, cast

import numpy as np

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.link import Link
from daqsvc.settings.answers import short
from daqsvc.settings.failures import BrokenContractError
from drivers.base import BusCounters
from drivers.reconnect import Attempt, CannotOpenError, run_with_reconnect

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.base import BusPort, StreamSpec
    from drivers.fields import Payloads
    from drivers.frames import FrameLayout

_TICK_NS = 20_000_000


class StreamDriver(ABC):
    """A driver that reads frames on the event loop; one that must read in a thread is written without it.

    Args:
        port: streams with a `FrameLayout` each, clock and where to deliver.
        link_name: what a person calls the link, e.g. ``"logger 'fan' (192.0.2.10:4001)"``.

    Attributes:
        name: of the bus in the machine file.
        port: what was given: `read` takes the streams from ``port.streams``, the time from ``port.clock``.
        link: whether the device is there: `read` states ``link.up()``, and why it is lost by what it returns.
        counters: what is no frame of a stream: `read` adds to ``counters.frames_unknown``. A frame of a
            stream that is too short or too long goes to ``streams[name][0].frames_wrong_length``. All else
            (losses, repeats, checksums) is counted by `take`.
    """

    def __init__(self, port: BusPort, link_name: str) -> None:
        self.name = port.name
        self.link = Link(link_name)
        self.counters = BusCounters()
        self.port = port
        self._assemblers = {spec.name: assembler_of(spec, port) for spec in port.streams}

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `drivers.base.Driver.streams`."""
        return {name: (a.counters, a.time_base) for name, a in self._assemblers.items()}

    async def run(self) -> None:
        """See `drivers.base.Driver.run`."""
        try:
            await run_with_reconnect(self.link, self.port, self._attempt)
        finally:
            self.link.stop()
            for assembler in self._assemblers.values():
                assembler.flush()

    @abstractmethod
    async def read(self) -> str:
        """Open the link, call ``self.link.up()``, and `take` frames until it is lost.

        It closes whatever it has opened, also when it is cancelled.

        Returns:
            Why it was lost, to be read after the name of the link.

        Raises:
            OSError: the link cannot be opened, or broke.
            CannotOpenError: it cannot be opened, in words of the driver's own.
        """

    def take(self, spec: StreamSpec[FrameLayout], payloads: Payloads) -> None:
        """Take in frames of one stream, in the order in which they came.

        Args:
            spec: the stream, of ``self.port.streams``.
            payloads: uint8 ``[n, spec.layout.length]``.

        Raises:
            ValueError: the stream is none of them, or the payloads are of another kind or shape.
        """
        if getattr(spec, "name", None) not in self._assemblers:
            raise ValueError(f"take() is given the stream {spec!r:.60}; give it one of self.port.streams")
        array = payloads if isinstance(cast("object", payloads), np.ndarray) else None
        if array is None or array.dtype != np.uint8 or array.shape[1:] != (spec.layout.length,):
            what = short(payloads) if array is None else f"{array.dtype} {list(array.shape)}"
            raise ValueError(
                f"take() is given {what}; give it an array of uint8 [n, {spec.layout.length}] of {spec.name}"
            )
        if len(payloads):
            arrival_ns = np.full(len(payloads), self.port.clock.monotonic_ns())
            self._assemblers[spec.name].accept(*spec.layout.decode(payloads, arrival_ns))

    @property
    def _frames(self) -> int:
        return sum(a.counters.frames_received for a in self._assemblers.values())

    async def _attempt(self) -> Attempt:
        before = self._frames
        ticking = asyncio.create_task(self._tick(), name=f"tick of {self.link.name}")
        try:
            reading = self.read()
            if not isawaitable(reading):
                raise BrokenContractError(self.read, "it is not async")
            reason = await reading
            if not isinstance(reason, str):
                raise BrokenContractError(self.read, f"it returns {reason!r:.60}, not why the link was lost")
        except CannotOpenError:
            self.counters.open_failures += 1
            raise
        except OSError as error:
            if self.link.state != "up":
                self.counters.open_failures += 1
                raise CannotOpenError(f"it cannot be opened: {error}") from error
            reason = f"it broke: {error}"
        finally:
            ticking.cancel()
            await asyncio.gather(ticking, return_exceptions=True)
        # A device that answers but sends nothing is not back.
        return Attempt(present=True, useful=self._frames > before, reason=reason)

    async def _tick(self) -> None:
        """Let the assemblers give up on frames that do not come, also while nothing else does."""
        while True:
            await self.port.clock.sleep_ns(_TICK_NS)
            for assembler in self._assemblers.values():
                assembler.tick(self.port.clock.monotonic_ns())


def assembler_of(spec: StreamSpec[FrameLayout], port: BusPort) -> StreamAssembler:
    """What places the samples of a stream of frames, and counts what is lost.

    Args:
        spec: the stream.
        port: where to deliver.
    """
    return StreamAssembler(
        spec.name,
        spec.rate_hz,
        counter_bits=spec.layout.counter_bits,
        samples_per_frame=spec.layout.samples_per_frame,
        counts_per_frame=spec.layout.counts_per_frame,
        deliver=port.deliver,
        reorder_window_ns=spec.reorder_window_ns,
        tell=port.tell,
    )
