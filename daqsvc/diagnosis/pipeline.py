"""The pipeline: one task per detector takes windows from a ring and has them processed off the loop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.ring import RingClosed, RingReader
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.silence import Patience

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.ring import Chunk, SampleRing
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.record import Diagnosis

logger = logging.getLogger(__name__)

MOST_BLOCKS = 64
"""Blocks in one window at most: a detector that is behind catches up in long strides."""

LOOK_NS = NS_PER_S // 2


@dataclass(slots=True)
class DetectorCounters:
    """What a detector has done; every figure only grows.

    Attributes:
        windows: windows processed.
        samples: samples in them.
        samples_skipped: samples it was too slow for, exactly; what never arrived is none.
        failures: windows in which it raised, against its contract.
        busy_ns: time its kernels took, on the host's clock.
    """

    windows: int = 0
    samples: int = 0
    samples_skipped: int = 0
    failures: int = 0
    busy_ns: int = 0


class Pipeline:
    """Runs detectors over rings until the rings are closed.

    Args:
        rings: by stream name.
        detectors: each names its stream.
        report: called on the event loop with each diagnosis, per detector in order.
        clock: tells how long a stream has been silent.
        threads: kernels that may run at a time.
        settling_ns: by stream, how long its first sample may be in coming without the stream being silent.
        patience: by stream, how long it may be silent; whatever is not named is fast.
    """

    def __init__(
        self,
        rings: Mapping[str, SampleRing],
        detectors: Sequence[Detector],
        report: Callable[[Diagnosis], None],
        clock: Clock,
        threads: int = 2,
        settling_ns: Mapping[str, int] | None = None,
        patience: Mapping[str, Patience] | None = None,
    ) -> None:
        self.counters = {detector.name: DetectorCounters() for detector in detectors}
        self.detectors = tuple(detectors)
        self._readers = {d.name: RingReader(rings[d.stream]) for d in detectors}
        self._rings = rings
        self._settling_ns = settling_ns or {}
        self._patience = {name: Patience() for name in rings} | dict(patience or {})
        self._silent_until_ns = dict.fromkeys(rings, -1)
        self._report = report
        self._clock = clock
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="kernel")

    @property
    def behind_samples(self) -> int:
        """Samples that the slowest detector has not read yet."""
        return max((reader.behind for reader in self._readers.values()), default=0)

    async def warm(self) -> None:
        """Compile every kernel before the first sample comes.

        May be cancelled at any time: compiling cannot be interrupted, but the process need not wait.
        """
        loop = asyncio.get_running_loop()
        warmed: asyncio.Future[None] = loop.create_future()

        def settle(error: Exception | None) -> None:
            if not warmed.done():
                warmed.set_result(None) if error is None else warmed.set_exception(error)

        def compile_all() -> None:
            failure: Exception | None = None
            try:
                for detector in self.detectors:
                    detector.warm()
            except Exception as error:  # noqa: BLE001 - raised again where it is awaited
                failure = error
            # Whoever waited may be gone, and the loop with them.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(settle, failure)

        threading.Thread(target=compile_all, name="kernel-warming", daemon=True).start()
        await warmed

    async def run(self) -> None:
        """Process until every ring is closed and every whole block in it is processed."""
        listening = asyncio.create_task(self._listen_for_silence(), name="silence")
        try:
            async with asyncio.TaskGroup() as group:
                for detector in self.detectors:
                    group.create_task(self._follow(detector), name=f"detector {detector.name}")
        finally:
            listening.cancel()
            # A cancelled task may have left a kernel running; nothing is left behind, nor the loop held up.
            await asyncio.shield(asyncio.to_thread(self._pool.shutdown))

    async def _listen_for_silence(self) -> None:
        """Have detectors say, once, that their stream has fallen silent: a window never comes to say it.

        A process that was suspended has not listened: what came meanwhile still waits to be read.
        """
        ends = {name: ring.end_index for name, ring in self._rings.items()}
        looked_ns = self._clock.monotonic_ns()
        since_ns = {name: looked_ns + self._settling_ns.get(name, 0) for name in self._rings}
        said: set[str] = set()
        while True:
            await self._clock.sleep_ns(LOOK_NS)
            now_ns = self._clock.monotonic_ns()
            late_ns, looked_ns = now_ns - looked_ns - LOOK_NS, now_ns
            if late_ns > LOOK_NS:
                since_ns = {name: heard_ns + late_ns for name, heard_ns in since_ns.items()}
            for name, ring in self._rings.items():
                if ring.end_index != ends[name]:
                    if name not in said:
                        self._patience[name].heard_after(now_ns - since_ns[name])
                    ends[name], since_ns[name] = ring.end_index, now_ns
                    said.discard(name)
                elif name not in said and now_ns - since_ns[name] >= self._patience[name].ns:
                    said.add(name)
                    self._silent_until_ns[name] = now_ns
                    silence_s = (now_ns - since_ns[name]) / NS_PER_S
                    for detector in self.detectors:
                        if detector.stream == name:
                            for diagnosis in detector.silent(silence_s, now_ns):
                                self._report(diagnosis)

    async def _follow(self, detector: Detector) -> None:
        reader, counters = self._readers[detector.name], self.counters[detector.name]
        loop = asyncio.get_running_loop()
        while True:
            try:
                chunk = await reader.take(detector.block, MOST_BLOCKS)
            except RingClosed:
                return
            if missed := chunk.skipped - chunk.lost:
                counters.samples_skipped += missed
                logger.warning(
                    "detector %s was too slow and has missed %d samples of %r from index %d on",
                    detector.name,
                    missed,
                    detector.stream,
                    chunk.first_index - chunk.skipped,
                )
            window = _window(reader.ring, chunk)
            said = await loop.run_in_executor(self._pool, _process, detector, window, counters)
            for diagnosis in said:
                # What lies before a silence that has been told is history: it must not speak after it.
                if diagnosis.t_ns > self._silent_until_ns[detector.stream]:
                    self._report(diagnosis)


def _window(ring: SampleRing, chunk: Chunk) -> Window:
    last = chunk.first_index + len(chunk.samples) - 1
    return Window(
        chunk.first_index,
        chunk.samples,
        ring.time_of(last),
        ring.period_at(last),
        chunk.skipped,
        chunk.snapshot,
    )


def _process(detector: Detector, window: Window, counters: DetectorCounters) -> Sequence[Diagnosis]:
    # The kernels' load on the host is a matter of the host's clock, whatever clock the samples have.
    begun_ns = time.perf_counter_ns()
    try:
        return detector.process(window)
    except Exception:
        counters.failures += 1
        if counters.failures == 1:
            logger.exception(
                "detector %s failed on samples %d to %d of %r; it goes on with the next window",
                detector.name,
                window.first_index,
                window.first_index + len(window.samples),
                detector.stream,
            )
        return []
    finally:
        counters.windows += 1
        counters.samples += len(window.samples)
        counters.busy_ns += time.perf_counter_ns() - begun_ns
