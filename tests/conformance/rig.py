"""A driver that runs on a transport, the device that it reads, and the books of both."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from dataclasses import asdict
from typing import TYPE_CHECKING, Self

import numpy as np
from conformance.transport import CHANNELS, STREAM
from support.waiting import PATIENCE_S

from daqsvc.acquisition.clock import NS_PER_S

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conformance.transport import Transport
    from numpy.typing import NDArray

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.samples import SampleBlock
    from drivers.base import Driver, StartPolicy

LOOK_S = 0.0005
WRAP = 30_000


def samples_of(numbers: NDArray[np.int64]) -> NDArray[np.float32]:
    """The samples with these numbers: each is told from every other by its two values."""
    return np.stack([numbers % WRAP, numbers // WRAP], axis=1).astype(np.float32)


def numbers_of(samples: NDArray[np.float32]) -> NDArray[np.int64]:
    """The numbers of samples, from their values."""
    assert samples.shape[1] == len(CHANNELS)
    return samples[:, 0].astype(np.int64) + WRAP * samples[:, 1].astype(np.int64)


def open_files() -> int:
    """File descriptors of this process."""
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - the folder of the process, counted


def lasting_threads() -> set[threading.Thread]:
    """Threads but for those of the event loop's pool, which lives on by design."""
    return {t for t in threading.enumerate() if not t.name.startswith("asyncio_")}


class Rig:
    """Sends numbered samples over a transport and keeps what comes out at the other end.

    Attributes:
        late_ns: how long after its last sample a frame was taken in at most: a busy computer is in no hurry.

    Args:
        transport: started.
        start: policy for a device that is absent.
        first_index: where the device's count of samples begins.
    """

    def __init__(self, transport: Transport, *, start: StartPolicy = "retry", first_index: int = 0) -> None:
        self.transport = transport
        self.device = transport.device
        self.blocks: list[SampleBlock] = []
        self.driver: Driver = transport.driver(self.blocks.append, start=start)
        self.sent = 0
        self.late_ns = 0
        self._forgotten_samples = 0
        self._forgotten_lost = 0
        self._first_index = first_index
        self._on_wire_before = self.device.frames_on_wire
        self._origin_ns = transport.time.clock.monotonic_ns()
        self._task: asyncio.Task[None] | None = None

    @property
    def counters(self) -> StreamCounters:
        return self.driver.streams[STREAM][0]

    @property
    def period_ns(self) -> int:
        """Time between samples."""
        return round(NS_PER_S / self.transport.rate_hz)

    async def __aenter__(self) -> Self:
        self.begin()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.end()

    def begin(self) -> asyncio.Task[None]:
        """Let the driver run."""
        self._task = asyncio.create_task(self.driver.run(), name="driver under test")
        return self._task

    async def end(self) -> None:
        """Cancel the driver, once, and wait for its end."""
        assert self._task is not None
        self._task.cancel()
        async with asyncio.timeout(PATIENCE_S):
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    async def until(self, true: Callable[[], bool], what: str, step_ns: int = 0) -> None:
        """Wait until something is true, while time passes in steps of at least ``step_ns``."""
        step_ns = max(step_ns, self.transport.poll_ns)
        try:
            async with asyncio.timeout(PATIENCE_S):
                while not true():
                    assert self._task is None or not self._task.done(), f"the driver ended: {self._task}"
                    # While a thread works no time passes: the outcome must not depend on its speed.
                    if step_ns and self.transport.time.somebody_waits:
                        await self.transport.time.pass_ns(step_ns)
                    await asyncio.sleep(LOOK_S)
        except TimeoutError:
            raise AssertionError(
                f"{self.transport.name}: not within {PATIENCE_S:g} s: {what}; link {self.driver.link.state} "
                f"({self.driver.link.reason}), {asdict(self.counters)}, {asdict(self.driver.counters)}"
            ) from None

    async def until_up(self) -> None:
        """Wait until the link is up; every back-off passes."""
        await self.until(lambda: self.driver.link.state == "up", "the link is up", NS_PER_S // 50)
        self.skip_to_now()

    async def until_down(self) -> None:
        """Wait until the driver has noticed that the wire is gone."""
        await self.until(lambda: self.driver.link.state == "down", "the link is down", NS_PER_S // 50)
        self.skip_to_now()

    def skip_to_now(self) -> None:
        """Leave out the frames that the device should have sent by now: it samples on, whoever listens."""
        per_frame = self.transport.samples_per_frame
        taken = (self.transport.time.clock.monotonic_ns() - self._origin_ns) // self.period_ns
        self.sent = max(self.sent, taken // per_frame * per_frame)

    def restart_time(self) -> None:
        """The device begins to sample now."""
        self._origin_ns = self.transport.time.clock.monotonic_ns()

    async def until_gone(self, before: set[threading.Thread]) -> None:
        """Wait until no thread is left but those that were there before."""
        async with asyncio.timeout(PATIENCE_S):
            while lasting_threads() - before:
                await asyncio.sleep(LOOK_S)

    async def until_closed(self, before: int) -> None:
        """Wait until no more files are open than before: the far end is in this process, too."""
        async with asyncio.timeout(PATIENCE_S):
            while open_files() > before:
                await asyncio.sleep(LOOK_S)

    def taken_ns(self, number: NDArray[np.int64]) -> NDArray[np.int64]:
        """When the device took the samples with these numbers."""
        return self._origin_ns + number * self.period_ns

    def next_samples(self, frames: int) -> tuple[int, NDArray[np.float32]]:
        """The device's next samples, and its own count of the first."""
        first = self.sent
        self.sent += frames * self.transport.samples_per_frame
        return self._first_index + first, samples_of(np.arange(first, self.sent))

    async def send(self, frames: int, *, at_once: int = 1, to_be_continued: bool = False) -> None:
        """Let the device sample and send; the driver takes in what was sent before the next is.

        Args:
            frames: how many.
            at_once: how many of them leave the device together.
            to_be_continued: leave it to the next `send` to wait for a driver that polls.
        """
        for done in range(0, frames, at_once):
            n = min(at_once, frames - done)
            last = self.sent + n * self.transport.samples_per_frame - 1
            due_ns = self._origin_ns + last * self.period_ns
            wait_ns = due_ns - self.transport.time.clock.monotonic_ns()
            if wait_ns > 0:
                await self.transport.time.pass_ns(wait_ns)
            await self.device.send(*self.next_samples(n))
            if not self.transport.poll_ns:
                await self.settle()
            else:
                # A driver that polls sees it when it is time to; the device does not wait for that.
                await self.rest()
            self._note_lateness()
        if not to_be_continued:
            await self.settle()
            self._note_lateness()

    def _note_lateness(self) -> None:
        """Remember how long after its last sample the device's frame was taken in, or may have been."""
        due_ns = self._origin_ns + (self.sent - 1) * self.period_ns
        self.late_ns = max(self.late_ns, self.transport.time.clock.monotonic_ns() - due_ns)

    async def rest(self) -> None:
        """Wait until the driver has nothing to do before more time has passed."""
        async with asyncio.timeout(PATIENCE_S):
            while not self.transport.time.somebody_waits:
                await asyncio.sleep(LOOK_S)

    async def settle(self) -> None:
        """Wait until the driver has taken in all that is on the wire."""
        on_wire = self.device.frames_on_wire - self._on_wire_before
        await self.until(
            lambda: self.counters.frames_received >= on_wire, f"all of {on_wire} frames received"
        )

    @property
    def stored(self) -> NDArray[np.int64]:
        """The numbers of the samples that were delivered, in order."""
        if not self.blocks:
            return np.empty(0, np.int64)
        return np.concatenate([numbers_of(block.samples) for block in self.blocks])

    def check_books(self, *, estimated: int = 0) -> None:
        """What was sent is stored or counted as lost, each sample once, in order, in its place.

        Args:
            estimated: by how many samples the loss may be off, where a restarted counter left only the
                clock to tell it.
        """
        counters, stored = self.counters, self.stored
        assert len(stored), "nothing was delivered"
        assert (np.diff(stored) > 0).all(), "samples are out of order, or there twice"
        lost = sum(block.lost_before for block in self.blocks[1:])
        assert len(stored) + self._forgotten_samples == counters.samples_received
        assert self._forgotten_lost + self.blocks[0].lost_before + lost == counters.samples_lost
        for before, block in zip(self.blocks, self.blocks[1:], strict=False):
            assert block.first_index == before.end_index + block.lost_before
        within = int(stored[-1]) - int(stored[0]) + 1
        assert abs(within - len(stored) - lost) <= estimated, (
            f"{within} sent, {len(stored)} stored, {lost} counted as lost"
        )

    def forget(self) -> None:
        """Check the books, and keep the last block only."""
        self.check_books()
        self.check_indices()
        self._forgotten_samples += sum(len(block.samples) for block in self.blocks[:-1])
        self._forgotten_lost += sum(block.lost_before for block in self.blocks[:-1])
        del self.blocks[:-1]

    def check_indices(self) -> None:
        """Every sample has the index that the device gave it."""
        for block in self.blocks:
            np.testing.assert_array_equal(
                numbers_of(block.samples) + self._first_index,
                np.arange(block.first_index, block.end_index),
            )


def transports_of(module: object) -> dict[str, Callable[[Path], Transport]]:
    """The transports that a module brings, if what they need is promised to be there."""
    needs = getattr(module, "NEEDS", None)
    if needs is not None and os.environ.get(needs) != "1":
        return {}
    found: dict[str, Callable[[Path], Transport]] = module.TRANSPORTS  # type: ignore[attr-defined]
    return found
