"""The replay driver: a recording in place of a device.

It plays CAN logs and tables of samples through the same decoders and assemblers as a live bus, so that
a machine file can be tried on what was recorded. Time stamps are those of the recording, moved so that
its first one is now: the jitter of the day is played too, the jitter of this machine is not added.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Link
from daqsvc.confined.limits import GIGABYTE, ResourceLimits
from daqsvc.confined.process import ConfinedProcess
from daqsvc.errors.buses import DRIVER_FAILED, PLAYED_OTHERWISE
from daqsvc.errors.code import coded
from drivers.base import BusCounters, BusPort
from drivers.can.adapter import batch_of
from drivers.can.batches import FrameDemultiplexer
from drivers.frames import FrameLayout
from drivers.reconnect import Attempt, CannotOpenError, in_thread, run_with_reconnect
from drivers.replay.can_log import STEP_BACK_NS, CanLog
from drivers.replay.files import (
    TABLE_COUNTER_BITS,
    RecordedLogError,
    SampleTable,
    words,
)
from drivers.replay.growing import GrowingCandump, Place
from drivers.stream_driver import assembler_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import can
    from numpy.typing import NDArray

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.acquisition.timebase import TimeBaseState
    from drivers.base import StreamSpec
    from drivers.frames import DecodedBatch
    from drivers.replay.files import RecordedLog
    from drivers.replay.settings import ReplayBus, TableLayout


logger = logging.getLogger(__name__)

REMEMBERED_CHANNELS = 16


class ChannelChoice:
    """Takes the frames of one channel, the first one that comes unless another is wanted.

    Args:
        link_name: what a person calls the bus.
        wanted: the channel, as the log calls it; None for the first one.
    """

    def __init__(self, link_name: str, wanted: str | None) -> None:
        self._link_name = link_name
        self._wanted = wanted
        self._chosen = wanted
        self._is_there = False
        self._others: list[str] = []

    @property
    def missed(self) -> str:
        """The message about a log that has no frame of the wanted channel; empty if it has some."""
        if self._wanted is None or self._is_there or not self._others:
            return ""
        return (
            f"it has no frame of channel {self._wanted!r}; write another of its channels as channel: "
            f"{', '.join(self._others)}"
        )

    def of(self, messages: Sequence[can.Message]) -> list[int]:
        """Which of the messages to take: those of the chosen channel, and those whose channel is not named.

        Other channels are logged once each.
        """
        names = [None if message.channel is None else str(message.channel) for message in messages]
        named = dict.fromkeys(name for name in names if name is not None)
        if self._chosen is None:
            self._chosen = next(iter(named), None)
        self._is_there = self._is_there or self._chosen in named
        for name in named:
            if name != self._chosen and name not in self._others:
                self._tell_of(name)
        return [k for k, name in enumerate(names) if name is None or name == self._chosen]

    def _tell_of(self, name: str) -> None:
        if len(self._others) >= REMEMBERED_CHANNELS:
            return
        self._others.append(name)
        logger.warning(
            "%s: the log has frames of channel %s too, and only those of %s are played; others are counted "
            "(frames_other_channel). Write channel = %r to play these, on a separate bus if both are",
            self._link_name,
            name,
            self._chosen,
            name,
            extra=coded(PLAYED_OTHERWISE),
        )


POLL_NS = NS_PER_S // 20
SPAN_NS = NS_PER_S // 20
UNPACED_SPAN_NS = NS_PER_S
REMAP_NS = 2 * NS_PER_S
"""A growing log whose times are off by more than this is from another clock than before."""

LEAP_NS = 3600 * NS_PER_S
"""A recording whose time leaps ahead by more is played on at once: a damaged time stamp must not stop it."""

REMEMBERED_IDS = 64
END_OF_FILE = "end of file"


@dataclass(slots=True)
class ReplayCounters(BusCounters):
    """What happened on a replayed bus; every figure only grows.

    Attributes:
        frames_malformed: lines of a log that are no frames.
        frames_other_channel: frames of other channels than the one that is played.
        time_leaps: how often the recorded time has leapt back, or ahead by more than an hour.
        passes: how often the recording has been played to its end.
        passes_damaged: how often it has been played as far as it could be read, which was not its end.
    """

    frames_malformed: int = 0
    frames_other_channel: int = 0
    time_leaps: int = 0
    passes: int = 0
    passes_damaged: int = 0


class Ending(NamedTuple):
    """Why nothing more comes of a recording.

    Attributes:
        reason: in words.
        readable: whether all that can be read of it has been played; else its reader failed.
    """

    reason: str
    readable: bool


class ReplayDriver:
    """Plays one recording.

    Once it has been played to its end and is not to be played again, the link is down with the reason "end of
    file". Played as fast as the receiver takes it, the samples' times run ahead of the clock.

    A CAN log takes streams with a `drivers.frames.FrameLayout`, a table of samples streams with a
    `TableLayout`. When a recording is played again its samples are counted on, and nothing is lost. What can
    be read of one that is damaged is played, and that is its end.

    Args:
        bus: its table in the machine file.
        port: streams, clock and where to deliver.
    """

    def __init__(self, bus: ReplayBus, port: BusPort) -> None:
        self.name = port.name
        self._path = bus.file
        self._is_table = bus.is_table
        self._at_end = bus.at_end
        self._paced = bus.pace == "recorded"
        self.link = Link(f"replayed bus {port.name!r} ({self._path})")
        self.counters = ReplayCounters()
        self._port = port
        self._assemblers = {spec.name: _assembler(spec, port) for spec in port.streams}
        frames = [spec for spec in port.streams if isinstance(spec.layout, FrameLayout)]
        self._sorter = FrameDemultiplexer(frames)
        self._channel = ChannelChoice(self.link.name, bus.channel)
        self._place = Place()
        self._reader = ConfinedProcess()
        memory_gb = bus.max_memory_gb
        self._limits = ResourceLimits() if memory_gb is None else ResourceLimits(round(memory_gb * GIGABYTE))
        self._first_index: dict[str, int] = {}
        self._to_its_end = False
        self._shift_ns: int | None = None
        self._newest_ns: int | None = None
        self._at_end_ns: int | None = None
        self._logged: set[str] = set()

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `drivers.base.Driver.streams`."""
        return {name: (a.counters, a.time_base) for name, a in self._assemblers.items()}

    async def run(self) -> None:
        """See `drivers.base.Driver.run`; also ends at the end of a recording that is played once."""
        try:
            await run_with_reconnect(self.link, self._port, self._attempt)
        finally:
            self.link.stop()
            for assembler in self._assemblers.values():
                assembler.flush()

    async def _attempt(self) -> Attempt | None:
        while True:
            recording = await self._open()
            self.link.up()
            before = self._frames
            ending = await self._play(recording)
            played = self._frames > before
            if self._at_end == "stop":
                self.link.end(ending.reason)
                return None
            if self._at_end == "wait" or not ending.readable or not played:
                return Attempt(present=True, useful=played, reason=ending.reason)

    @property
    def _frames(self) -> int:
        return sum(a.counters.frames_received for a in self._assemblers.values())

    async def _open(self) -> RecordedLog:
        self._reader.close()  # it may have ended just before it was stopped
        try:
            return await in_thread(self._open_file, undo=self._close, abort=self._reader.abort)
        except RecordedLogError as error:
            self.counters.open_failures += 1
            raise CannotOpenError(f"{error}") from error
        except Exception as error:
            self.counters.open_failures += 1
            raise CannotOpenError(f"it cannot be opened: {words(error)}") from error

    def _open_file(self) -> RecordedLog:
        if self._is_table:
            return SampleTable(self._path, self._port.streams, self._first_index, self._limits, self._reader)
        if not self._path.exists():
            raise RecordedLogError(
                f"there is no file {self._path}; correct the bus's file, or record it first"
            )
        if self._at_end == "wait":
            return GrowingCandump(self._path, self._sort, self._place)
        return CanLog(self._path, self._sort)

    def _close(self, recording: RecordedLog) -> None:
        try:
            recording.close()
        except Exception as error:  # noqa: BLE001 - readers of formats raise what they like
            logger.info("closing %s: %s", self.link.name, words(error))

    def _sort(self, messages: list[can.Message], t_ns: NDArray[np.int64]) -> DecodedBatch:
        chosen = self._channel.of(messages)
        batch = batch_of([messages[k] for k in chosen], t_ns[chosen].tolist())
        decoded = self._sorter.sort(batch, 0)
        decoded.note("frames_other_channel", len(messages) - len(chosen))
        return decoded

    async def _play(self, recording: RecordedLog) -> Ending:
        """Play until there is no more; returns why."""
        if self._at_end != "wait":
            self._begin_anew(recording)
        try:
            while True:
                asked_ns = self._port.clock.monotonic_ns()
                piece = await in_thread(recording.read, SPAN_NS if self._paced else UNPACED_SPAN_NS)
                if piece is None:
                    self.counters.passes += 1
                    self._to_its_end = True
                    return Ending(self._channel.missed or END_OF_FILE, readable=True)
                if piece.notes.get("frames_malformed"):
                    self._say_once(
                        f"what is no frame in {self._path} is counted (frames_malformed) and left out, first "
                        f"{recording.first_malformed}"
                    )
                if not (piece.frames or piece.unknown or piece.wrong_length or any(piece.notes.values())):
                    self._at_end_ns = asked_ns
                await self._accept(piece)
        except RecordedLogError as error:
            if self._at_end != "wait":
                self.counters.passes_damaged += 1
                self._say_once(f"{error}")
            return Ending(f"{error}", readable=True)
        except Exception as error:
            logger.exception("the reader of %s failed", self.link.name, extra=coded(DRIVER_FAILED))
            self.counters.reader_failures += 1
            return Ending(f"its reader failed: {words(error)}", readable=False)
        finally:
            await in_thread(self._close, recording)

    def _say_once(self, what: str) -> None:
        if what not in self._logged:
            self._logged.add(what)
            logger.warning("replayed bus %r: %s", self.name, what, extra=coded(PLAYED_OTHERWISE))

    def _begin_anew(self, recording: RecordedLog) -> None:
        """The recording is played from its beginning: nothing is missing between this and what was before."""
        seamless = False
        if isinstance(recording, SampleTable):
            seamless = recording.seamless and self._to_its_end
            for note in recording.notes:
                self._say_once(note)
        if not seamless:
            for assembler in self._assemblers.values():
                assembler.begin_afresh()
        self._to_its_end = False
        self._shift_ns = None

    async def _accept(self, piece: DecodedBatch) -> None:
        clock = self._port.clock
        for name, count in piece.notes.items():
            setattr(self.counters, name, getattr(self.counters, name) + count)
        for name, count in piece.unknown.items():
            if name in self.counters.unknown_ids or len(self.counters.unknown_ids) < REMEMBERED_IDS:
                self.counters.unknown_ids[name] = self.counters.unknown_ids.get(name, 0) + count
        for stream, (count, _) in piece.wrong_length.items():
            self._assemblers[stream].counters.frames_wrong_length += count
        if piece.frames:
            await self._place_frames(piece)
        elif self._at_end == "wait":
            await clock.sleep_ns(POLL_NS)
        if self._paced:
            for assembler in self._assemblers.values():
                assembler.tick(clock.monotonic_ns())

    async def _place_frames(self, piece: DecodedBatch) -> None:
        """Deliver a piece, when its last frame is due."""
        clock = self._port.clock
        now_ns = clock.monotonic_ns()
        first_ns = min(int(frames.arrival_ns[0]) for frames in piece.frames.values())
        last_ns = max(int(frames.arrival_ns.max()) for frames in piece.frames.values())
        if (
            self._shift_ns is None
            or (self._at_end == "wait" and self._is_of_another_clock(first_ns + self._shift_ns, now_ns))
            or self._leaps(first_ns + self._shift_ns)
        ):
            self._shift_ns = self._next_ns(now_ns) - first_ns
        due_ns = last_ns + self._shift_ns
        floor_ns, self._newest_ns = self._newest_ns or 0, max(self._newest_ns or 0, due_ns)
        if self._paced and due_ns > now_ns:
            await clock.sleep_ns(due_ns - now_ns)
        else:
            await asyncio.sleep(0)
        for stream, frames in piece.frames.items():
            # Logs of several interfaces may step back a little; an arrival never does.
            arrival_ns = np.maximum.accumulate(np.maximum(frames.arrival_ns + self._shift_ns, floor_ns))
            self._assemblers[stream].accept(*frames._replace(arrival_ns=arrival_ns))

    def _is_of_another_clock(self, due_ns: int, now_ns: int) -> bool:
        """Whether a growing log goes on with times of another clock: of the future, or before it was written.

        That it is read late, because the process did not run, shows nothing of its clock.
        """
        if self._newest_ns is None:
            return False
        written_ns = max(self._newest_ns, self._at_end_ns or self._newest_ns)
        return due_ns > now_ns + REMAP_NS or due_ns < written_ns - REMAP_NS

    def _leaps(self, due_ns: int) -> bool:
        """Whether the recorded time has leapt, and what comes now is to be played at once."""
        if self._at_end == "wait" or self._newest_ns is None:
            return False
        leap_ns = due_ns - self._newest_ns
        if -STEP_BACK_NS <= leap_ns <= LEAP_NS:
            return False
        self.counters.time_leaps += 1
        self._say_once(
            "its time stamps leap back, or ahead by more than an hour; such leaps are counted (time_leaps) "
            "and it is played on without a pause"
        )
        return True

    def _next_ns(self, now_ns: int) -> int:
        """When the first frame of what is played now comes: never before what was played has ended."""
        if self._newest_ns is None:
            return now_ns
        if self._at_end == "wait":
            return max(now_ns, self._newest_ns)
        period_ns = min(_frame_ns(spec) for spec in self._port.streams)
        next_ns = self._newest_ns + period_ns
        # It takes a moment to begin again, which is no part of the recording.
        return next_ns if now_ns - next_ns < REMAP_NS else now_ns


def _frame_ns(spec: StreamSpec[FrameLayout | TableLayout]) -> int:
    """Nominal time from frame to frame."""
    samples = spec.layout.samples_per_frame if isinstance(spec.layout, FrameLayout) else 1
    return round(samples * NS_PER_S / spec.rate_hz)


def _assembler(spec: StreamSpec[FrameLayout | TableLayout], port: BusPort) -> StreamAssembler:
    if isinstance(spec.layout, FrameLayout):
        return assembler_of(cast("StreamSpec[FrameLayout]", spec), port)
    return StreamAssembler(
        spec.name,
        spec.rate_hz,
        counter_bits=TABLE_COUNTER_BITS,
        samples_per_frame=1,
        counts_per_frame=1,
        deliver=port.deliver,
        reorder_window_ns=spec.reorder_window_ns,
        tell=port.tell,
    )
