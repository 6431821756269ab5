"""Takes in the statements of detectors, a second at a time, and writes it down every few seconds.

Whatever the disk does, nothing else waits for it: what cannot be written waits in memory, within bounds, and
what exceeds them is counted.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections import deque
from concurrent.futures import wait
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff, Link
from daqsvc.errors.code import coded
from daqsvc.errors.outputs import HISTORY_DAMAGED
from daqsvc.errors.service import DISK_REFUSES
from daqsvc.history.file import NAME, SETTLED_S, HistoryFile, Keeping, NewerHistoryError, Series, events_of
from daqsvc.history.points import DAY_S, HOUR_S, MOST, RECORD, Step
from daqsvc.outbox.files import FileError, free_bytes, is_corrupt, remedy, set_aside
from daqsvc.outbox.limits import MIB
from daqsvc.outbox.messages import OutboxError
from daqsvc.publish.output import Output
from daqsvc.threads import call_in_thread

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    from daqsvc.diagnosis.reading import Reading
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.outbox.messages import OutboxMessage
    from daqsvc.publish.history.settings import History
    from daqsvc.publish.output import OutputPort

T = TypeVar("T")

log = logging.getLogger(__name__)

WRITE_EVERY_S = 10.0
"""Time of which at most data are lost in a power failure."""
WAITING_SECONDS = 600
"""Seconds of all figures that may wait in memory for a disk that takes none."""
LEAST_WAITING = 20_000
EVENTS_AT_ONCE = 500
LEAST_WAIT_S = 1.0
OVER_S = 2.0
"""A second is over so long after it, even if the detector states nothing more."""
PAUSE_S = 0.02
"""Between the figures that are packed: there is no hurry, and others have something to do."""
END_S = 0.5


class NoRoomError(Exception):
    """Less room on the disk than is left to the alarms."""


class _Second(NamedTuple):
    """A second of a figure: see `daqsvc.history.points.RECORD`."""

    series: Series
    t_s: int
    n: int
    low: float
    mean: float
    high: float


class _Figures:
    """The figures of one detector, and their values within the present second.

    Args:
        machine: name of the machine.
        readings: of the detector.
    """

    def __init__(self, machine: str, readings: list[Reading]) -> None:
        self._known = [
            (r.kind == "probabilities", r.key, Series(machine, r.detector, r.kind, r.key, r.unit))
            for r in readings
        ]
        self._t_s = 0
        self._by_series: dict[Series, list[float]] = {}

    def add(self, diagnosis: Diagnosis, t_s: int) -> list[_Second]:
        """Take in a statement; returns the second before, if that is over."""
        over = self.finish() if t_s != self._t_s else []
        self._t_s = t_s
        for is_probability, key, series in self._known:
            value = (diagnosis.probabilities if is_probability else diagnosis.statistics).get(key)
            if value is not None and math.isfinite(value) and abs(value) < MOST:
                self._by_series.setdefault(series, []).append(value)
        return over

    def is_over(self, now_s: float) -> bool:
        """Whether the present second is over by the wall clock, which may have been set back."""
        return bool(self._by_series) and abs(now_s - self._t_s) > OVER_S

    def finish(self) -> list[_Second]:
        """The values of the present second, which is over."""
        by_series, self._by_series = self._by_series, {}
        return [
            _Second(series, self._t_s, len(values), min(values), math.fsum(values) / len(values), max(values))
            for series, values in by_series.items()
        ]


class HistoryOutput(Output):
    """Keeps the history of all machines in one file in the store.

    Args:
        settings: the table.
        port: what it works with.
        reserve_mb: room on the disk that it leaves to the alarms.
    """

    def __init__(self, settings: History, port: OutputPort, *, reserve_mb: int) -> None:
        self._port = port
        self._path = port.store / NAME
        self._reserve_mb = reserve_mb
        self._keeping = Keeping(
            spans={
                Step.SECOND: math.ceil(settings.seconds_keep_days * DAY_S / Step.SECOND.span_s),
                Step.MINUTE: math.ceil(settings.minutes_keep_days * DAY_S / Step.MINUTE.span_s),
                Step.HOUR: math.ceil(settings.hours_keep_days * DAY_S / Step.HOUR.span_s),
            },
            max_bytes=settings.max_mb * MIB,
        )
        self._by_detector = {
            (name, detector): _Figures(name, [r for r in watched.readings if r.detector == detector])
            for name, watched in port.machines.items()
            for detector in {reading.detector for reading in watched.readings}
        }
        figures = sum(len(watched.readings) for watched in port.machines.values())
        self._waiting: deque[_Second] = deque()
        self._most_waiting = max(LEAST_WAITING, WAITING_SECONDS * min(figures, LEAST_WAITING // 60))
        self._link = Link(f"history in {self._path}")
        self._ends = asyncio.Event()
        self._file: HistoryFile | None = None
        self._packed_hour: int | None = None
        self._last_event = 0
        self._busy: Future[Any] | None = None
        self._handed: tuple[Future[None], list[_Second]] | None = None
        """Seconds of which it is not known yet whether they are on the disk."""
        self._has_ended = asyncio.Event()
        self._written = self._lost = self._events = self._damaged = 0

    def report(self, diagnosis: Diagnosis) -> None:
        """See `Output.report`. What is not good is no figure of the machine, and is left out."""
        figures = self._by_detector.get((diagnosis.machine, diagnosis.detector))
        if figures is None or diagnosis.quality != "good":
            return
        clock = self._port.clock
        t_ns = clock.wall_ns() - (clock.monotonic_ns() - diagnosis.t_ns)
        self._wait_for_disk(figures.add(diagnosis, t_ns // NS_PER_S))

    def _wait_for_disk(self, seconds: list[_Second]) -> None:
        self._waiting.extend(seconds)
        while len(self._waiting) > self._most_waiting:
            self._waiting.popleft()
            self._lost += 1

    async def run(self) -> None:
        """Write, and try again where that is impossible, until `stop` or until cancelled."""
        backoff = Backoff()
        try:
            while True:
                is_last = self._ends.is_set()
                wait_s = WRITE_EVERY_S
                try:
                    await self._write(everything=is_last)
                    backoff.reset()
                    self._link.up()
                    self.reason = ""
                except (*FileError, NoRoomError, NewerHistoryError) as error:
                    await self._failed(error)
                    wait_s = max(backoff.next_ns() / NS_PER_S, LEAST_WAIT_S)
                if is_last:
                    return
                with suppress(TimeoutError):
                    async with asyncio.timeout(wait_s):
                        await self._ends.wait()
        finally:
            await self._close()
            self._link.stop()
            self._has_ended.set()

    async def stop(self, deadline_s: float) -> None:
        """See `Output.stop`."""
        self._ends.set()
        with suppress(TimeoutError):
            async with asyncio.timeout(deadline_s):
                await self._has_ended.wait()

    def figures(self) -> dict[str, Any]:
        """See `Output.figures`."""
        return {
            "seconds_written": self._written,
            "seconds_waiting": len(self._waiting),
            "seconds_lost": self._lost,
            "alarm_events": self._events,
            "chunks_damaged": self._damaged,
        }

    async def _write(self, *, everything: bool) -> None:
        """Write what there is.

        Raises:
            sqlite3.Error: the disk takes no writes, or the file is damaged; all waits for the next time.
            OSError: as above.
            NoRoomError: the rest of the disk is for alarms.
            NewerHistoryError: the file was written by a newer version.
        """
        await self._see_through()
        if self._file is None:
            self._file = await self._in_thread(lambda: HistoryFile(self._path))
            self._last_event = await self._in_thread(lambda: _open(self._file).last_sequence)
        now_s = self._port.clock.wall_ns() / NS_PER_S
        for figures in self._by_detector.values():
            if everything or figures.is_over(now_s):
                self._wait_for_disk(figures.finish())
        messages = await self._new_events()
        file, seconds = self._file, list(self._waiting)
        self._waiting.clear()
        self._busy = call_in_thread(lambda: self._write_to(file, seconds, messages), name="history")
        self._handed = self._busy, seconds
        await self._see_through()
        if messages:
            self._last_event = messages[-1].sequence
        hour = int((now_s - SETTLED_S) // HOUR_S)
        if hour != self._packed_hour and not everything:
            self._damaged += await self._in_thread(lambda: _tidy(file, now_s, self._keeping))
            self._packed_hour = hour

    async def _see_through(self) -> None:
        """See what becomes of the seconds that were handed to a thread; it goes on if this is cancelled.

        Raises:
            Exception: what has kept them from the disk; they wait again.
        """
        if self._handed is None:
            return
        busy, seconds = self._handed
        try:
            await asyncio.wrap_future(busy)
        except Exception:
            self._handed = None
            self._waiting.extendleft(reversed(seconds))
            self._wait_for_disk([])
            raise
        self._handed = None
        self._written += len(seconds)

    async def _new_events(self) -> list[OutboxMessage]:
        """Alarm events that are not in the file yet; none while the journal cannot be read."""
        try:
            return await self._port.outbox.following(self._last_event, EVENTS_AT_ONCE)
        except OutboxError:
            return []

    def _write_to(self, file: HistoryFile, seconds: list[_Second], messages: list[OutboxMessage]) -> None:
        """On a thread."""
        if free_bytes(self._path.parent) < self._reserve_mb * MIB:
            raise NoRoomError(f"less than {self._reserve_mb} MB are free, which are left to the alarms")
        of_series: dict[Series, list[tuple[int, int, float, float, float]]] = {}
        for one in seconds:
            of_series.setdefault(one.series, []).append((one.t_s, one.n, one.low, one.mean, one.high))
        events = events_of((message.sequence, message.payload) for message in messages)
        file.write({series: np.array(points, RECORD) for series, points in of_series.items()}, events)
        self._events += len(events)

    async def _failed(self, error: Exception) -> None:
        """Say it, once; a damaged file is set aside, and another begun."""
        if is_corrupt(error):
            await self._close()
            try:
                aside = await self._in_thread(lambda: set_aside(self._path, self._port.clock.wall_ns()))
                log.error(
                    "the history %s is damaged (%s): it is now %s, and a new one is begun",
                    self._path,
                    error,
                    aside.name,
                    extra=coded(HISTORY_DAMAGED),
                )
            except OSError as second:
                error = second
        elif isinstance(error, NewerHistoryError):
            self._waiting.clear()
        hint = "" if isinstance(error, NewerHistoryError) else f"; {remedy(self._path.parent)}"
        self.reason, self.code = f"{error}{hint}", DISK_REFUSES
        self._link.down(self.reason)

    async def _close(self) -> None:
        """Release the file; one that a thread is busy with is closed by the next call of that thread."""
        file, self._file = self._file, None
        if file is not None:
            busy = self._busy

            def close() -> None:
                if busy is not None:
                    wait([busy])
                file.close()

            await asyncio.wait({asyncio.ensure_future(asyncio.to_thread(close))}, timeout=END_S)

    async def _in_thread(self, call: Callable[[], T]) -> T:
        """What a call that may block returns; it goes on if this is cancelled."""
        self._busy = call_in_thread(call, name="history")
        return await asyncio.wrap_future(self._busy)


def _open(file: HistoryFile | None) -> HistoryFile:
    assert file is not None  # noqa: S101 - it has just been opened
    return file


def _tidy(file: HistoryFile, now_s: float, keeping: Keeping) -> int:
    """Pack what is over and delete what is old; returns how many chunks were damaged. It takes its time."""
    damaged = 0
    for more in file.pack(now_s):
        damaged += more
        time.sleep(PAUSE_S)
    file.keep(keeping)
    return damaged
