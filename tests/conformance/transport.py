"""What a transport brings to the conformance suite: a wire, a device on it, and a driver that reads it.

The suite in ``test_conformance.py`` runs unchanged over every transport. A transport is a module
``tests/conformance/<name>_transport.py`` with a table

    TRANSPORTS: dict[str, Callable[[Path], Transport]] = {"virtual CAN": VirtualCan, ...}

whose values take an empty folder for whatever files the transport needs. A module that needs hardware or
a kernel feature says so by ``NEEDS = "DAQSVC_HIL"``: its transports are collected only where that
environment variable is ``1``, and there they fail, and never skip, if what they need is missing.

The device samples `CHANNELS` channels at ``rate_hz`` and sends ``samples_per_frame`` samples of each at a
time. A *frame* is what the transport moves at once and the driver counts in ``frames_received``: a CAN
frame, a serial frame, a line of a log, the entries of a sample FIFO that a poll reads. The values are
whole numbers within +-32 000, so that 16-bit fields with scale 1 carry them exactly.

What a transport cannot do physically is named in `Transport.cannot` with the reason: the tests of that are
reported as skipped with this very text. Nothing else is ever skipped.

A transport of a package outside this tree is a module with such a table that can be imported; the environment
variable ``DAQSVC_TRANSPORTS`` names it, or several with a colon between them.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Literal, Protocol

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock, SystemClock

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import Driver, StartPolicy

CHANNELS = ("x", "y")
STREAM = "shaft"
"""The name of the one stream that the driver of a transport delivers."""

Ability = Literal["drop", "duplicate", "reorder", "corrupt", "reset counter", "overflow", "be absent"]
"""The last: a device that is not there can be told from one that is silent, e.g. by a refused connection."""


class Time(Protocol):
    """The time of a test: a clock, and how to let it pass."""

    clock: Clock
    exact: bool
    """Whether arrivals are stamped when the device sends, to the nanosecond."""

    @property
    def somebody_waits(self) -> bool:
        """Whether anybody waits for this time to pass, rather than works."""
        ...

    async def pass_ns(self, duration_ns: int) -> None:
        """Let ``duration_ns`` pass for the device and for the driver."""
        ...


class SimulatedTime:
    """Passes as soon as it is asked to; for drivers that stamp arrivals by their clock."""

    exact = True

    def __init__(self) -> None:
        self.clock = DrivenClock()

    @property
    def somebody_waits(self) -> bool:
        """See `Time.somebody_waits`."""
        return any(not wake.done() for _, _, wake in self.clock._sleepers)

    async def pass_ns(self, duration_ns: int) -> None:
        """See `Time.pass_ns`; whoever wakes has run once when this returns."""
        self.clock.advance_to(self.clock.monotonic_ns() + duration_ns)
        await asyncio.sleep(0)


class RealTime:
    """Passes as it does; for drivers whose arrivals are stamped by something else, e.g. the kernel."""

    exact = False

    def __init__(self) -> None:
        self.clock = SystemClock()

    @property
    def somebody_waits(self) -> bool:
        """See `Time.somebody_waits`."""
        return True

    async def pass_ns(self, duration_ns: int) -> None:
        """See `Time.pass_ns`."""
        await asyncio.sleep(duration_ns / NS_PER_S)


class Device(Protocol):
    """The device, and what a test does to the frames it sends.

    Faults hit the next frames that are sent and then are over. They are armed one kind at a time.
    """

    frames_on_wire: int
    """Frames that the driver is to count in ``frames_received`` once it has taken in what was sent."""

    samples_on_wire: int
    """Samples that a driver which has taken in everything delivers: what was put on the wire whole, once."""

    async def send(self, first_index: int, samples: NDArray[np.float32]) -> None:
        """Encode samples and put them on the wire, in the order of the device.

        While the device is silent, or the wire is gone, they are lost.

        Args:
            first_index: the device's own count of the first sample, a multiple of ``samples_per_frame``.
                The device sends it as far as its counter is wide, less what `reset_counter` took off.
            samples: float32 ``[n, channels]``, ``n`` a multiple of ``samples_per_frame``.
        """
        ...

    def flood(self, first_index: int, samples: NDArray[np.float32]) -> None:
        """Send as `send` does, but at once and without a turn of the event loop.

        What the wire does not take is lost, as in a device whose transmit buffer overflows.
        """
        ...

    def drop(self, frames: int = 1) -> None:
        """Lose the next frames on the way."""
        ...

    def duplicate(self) -> None:
        """Deliver the next frame twice."""
        ...

    def reorder(self) -> None:
        """Deliver the next frame after the one that follows it."""
        ...

    def corrupt(self) -> None:
        """Flip bits in the samples of the next frame, so that its checksum does not match."""
        ...

    def reset_counter(self) -> None:
        """Restart the device's counter: the next frame counts from 0 again."""
        ...

    def silence(self) -> None:
        """Send nothing, while the wire is there, until `speak`."""
        ...

    def speak(self) -> None:
        """Send again."""
        ...

    def go_away(self) -> None:
        """Take the wire away: it is unplugged, its interface goes down, the server is gone."""
        ...

    def come_back(self) -> None:
        """Put the wire back. What was not read before is gone."""
        ...


class Transport(Protocol):
    """One kind of bus, ready to be tested."""

    name: str
    rate_hz: float
    samples_per_frame: int
    counter_modulus: int
    """Samples after which the device's counter begins again; at least 4096 frames."""

    jitter_ns: int
    """Stated bound of how far the time of a sample, once settled, may lie from when it was taken, apart from
    a constant latency; with `Time.exact` the bound for arrivals that are not delayed."""

    latency_ns: int
    """Stated bound of that constant latency, e.g. one poll period; 0 where arrivals are stamped as sent."""

    poll_ns: int
    """Steps in which time passes while the driver is waited for, for a driver that polls; 0 for one that is
    woken by what is sent."""

    overflow_frames: int
    """More frames than wire and driver can hold together while the event loop does not turn."""

    cannot: Mapping[Ability, str]
    """What is physically impossible on this transport, and why."""

    time: Time
    device: Device

    async def start(self) -> None:
        """Put up the wire and the device; the wire is there, and the device sends when it is told to."""
        ...

    async def stop(self) -> None:
        """Take everything down again."""
        ...

    def driver(self, deliver: Callable[[SampleBlock], None], *, start: StartPolicy = "retry") -> Driver:
        """A new driver, not yet running, whose one stream is `STREAM`, on the clock of ``time``.

        The stream's reorder window is that of two frames at least.
        """
        ...
