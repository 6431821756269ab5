"""CAN logs as recordings: decoded and put together as the service does it live."""

from __future__ import annotations

import gzip
import heapq
import re
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.diagnosis.snapshots import alignment
from daqsvc.dsp.quality.rate import SAME_RATE
from daqsvc.errors.recordings import GAPS, NOT_FOUND, NOT_IN_LOG, NOT_TOGETHER, RATE_CONTRADICTED
from daqsvc.recording import RecordingError
from daqsvc.recording.formats import CAN_LOGS, named_as_can_log
from daqsvc.recording.rate import MOST_STRETCHED
from daqsvc.recording.recording import Recording
from daqsvc.recording.streams import LongGapsError, RecordedStream, ns_of_iso, of_blocks
from drivers.base import StreamSpec
from drivers.can.adapter import batch_of
from drivers.can.batches import FrameDemultiplexer
from drivers.can.plugin import frame_layout
from drivers.can.settings import DbcLayout, PlainLayout
from drivers.frames import DecodedBatch, joined
from drivers.replay.can_log import CanLog
from drivers.replay.files import RecordedLogError as LogError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import can
    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.settings import MachineFile
    from drivers.frames import FrameLayout

    Floats: TypeAlias = NDArray[np.float64]

_SPAN_NS = NS_PER_S // 20
_NS_PER_MS = 1_000_000
_MOST_OFF_RATE = 0.05
_SURELY_SINCE_1970_NS = 10**17
"""Times of 1973 and later; others count from somewhere else."""
_LONG_ENOUGH_S = 1.0
"""A shorter log does not show the rate of a stream."""
_NAMED_IDS = 8
_HEAD_BYTES = 1 << 16
"""Of an ASC log, in which its header ends."""
_ASC_DATE = re.compile(r"\s*(?:date|begin\s+triggerblock)\s+\w+\.?\s+(?P<date>.+)", re.IGNORECASE)
_ASC_FRAME = re.compile(r"\s*\d+\.\d+\s+(?:CANFD|\d+\s+(?:\w+\s+[TR]x|ErrorFrame))", re.ASCII | re.IGNORECASE)
_ASC_WRITTEN = re.compile(
    r"(?P<month>\w+)\.?\s+(?P<day>\d{1,2})\s+(?P<hour>\d{1,2}):(?P<rest>\d\d:\d\d(?:\.\d{1,9})?)\s+"
    r"(?:(?P<half>[ap]m)\s+)?(?P<year>\d{4})",
    re.IGNORECASE,
)
_ENGLISH = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_MONTHS = dict(zip(_ENGLISH, range(1, 13), strict=True)) | {"mär": 3, "mai": 5, "okt": 10, "dez": 12}
"""Of the tools of Vector, which write English or German."""
_LAYOUTS = "ids and lengths of its layouts"


def load_can_log(machine: MachineFile, path: str, rate_hz: float | None = None) -> Recording:
    """The first recording of `load_can_rates`; its notes also state what has another rate and is left out."""
    first, *others = load_can_rates(machine, path, rate_hz)
    left_out = (f"{', '.join(one.names)} ({one.rate_hz:g} Hz)" for one in others)
    notes = [f"left out, as one rate is read ({first.rate_hz:g} Hz): {', '.join(left_out)}"] if others else []
    return replace(first, notes=(*first.notes, *notes))


def load_can_rates(
    machine: MachineFile, path: str, rate_hz: float | None = None, watched: Sequence[str] = ()
) -> list[Recording]:
    """The sensors of a machine in a CAN log, or in all logs of a folder: its buses, and the parts of each.

    The frames go through the decoders and assemblers of the live service, and streams that the detectors take
    together through its grid.

    Args:
        machine: the machine file.
        path: the log or folder.
        rate_hz: what the user states about the rate of the first recording.
        watched: sensors that the verdict rests on.

    Returns:
        A recording for each rate and each grid. The first has the sensors that are watched; without any, it
        is the grid or has the highest rate. Its notes state what of a log is damaged.

    Raises:
        RecordingError: it cannot be read, holds no samples of the machine, or not at the rates that the
            machine file states.
    """
    playing = _played(machine, path)
    first, *others = _groups(machine, path, playing, watched)
    recordings = [_recording(machine, path, playing, first, rate_hz)]
    notes = list(playing.notes)
    for group in others:
        try:
            recordings.append(_recording(machine, path, playing, group))
        except RecordingError as error:
            notes.append(f"left out {', '.join(group.streams)} ({group.rate_hz:g} Hz): {error}")
    recordings[0] = replace(recordings[0], notes=tuple(notes))
    return recordings


def _played(machine: MachineFile, path: str) -> _Playing:
    """All logs of a recording, decoded.

    Raises:
        RecordingError: see `load_can_rates`.
    """
    playing = _Playing(machine, path)
    playing.play()
    if not playing.blocks:
        why = (
            playing.notes[0]
            if playing.notes
            else f"give the log of this machine's bus, or correct {_LAYOUTS}"
        )
        raise RecordingError(
            f"{path} has no frame of a stream of {machine.path}{playing.seen_instead()}; {why}", NOT_IN_LOG
        )
    playing.check_rates()
    return playing


def load_can_streams(machine: MachineFile, path: str) -> tuple[list[RecordedStream], list[str]]:
    """All streams of a machine in a CAN log, or in all logs of a folder, each at its own rate.

    Args:
        machine: the machine file.
        path: the log or folder.

    Returns:
        The streams in the order of the machine file, in the units of the sensors; and what of a log is
        damaged. Channels without a sensor have their own names.

    Raises:
        RecordingError: see `load_can_rates`.
    """
    playing = _played(machine, path)
    sensors = {(one.stream, one.channel): one for one in machine.sensors}
    begun_ns = _log_begin_ns(path)
    streams = []
    for name, stream in machine.streams.items():
        if name not in playing.blocks:
            continue
        try:
            samples, t_ns, period_ns = of_blocks(playing.blocks[name], MOST_STRETCHED)
        except LongGapsError as error:
            raise RecordingError(
                f"{path} {error} of stream {name!r}; give the logs of one time without long gaps between",
                GAPS,
            ) from None
        channels = stream.layout.channel_names
        known = [sensors.get((name, channel)) for channel in channels]
        # Times of some formats count from the first frame; a date that they state is in their header.
        start_ns = t_ns if t_ns > _SURELY_SINCE_1970_NS else None if begun_ns is None else begun_ns + t_ns
        streams.append(
            RecordedStream(
                name,
                stream.rate_hz,
                tuple(c if s is None else s.name for s, c in zip(known, channels, strict=True)),
                tuple("" if s is None else s.unit for s in known),
                samples,
                start_ns,
                NS_PER_S / period_ns,
            )
        )
    notes = list(playing.notes)
    if any(one.start_ns is None for one in streams):
        notes.append(f"{path} does not state when it began, so the result does not either")
    return streams, notes


def _log_begin_ns(path: str) -> int | None:
    """When a log in ASC format began, by its header; None of any other, or if it does not state it.

    The header names no zone. It is taken as UTC, so that a log begins at one time wherever it is read.
    """
    log = Path(path)
    zipped = log.suffix.lower() == ".gz"
    if (log.with_suffix("") if zipped else log).suffix.lower() != ".asc":
        return None
    try:
        with gzip.open(log) if zipped else log.open("rb") as file:
            head = file.read(_HEAD_BYTES).decode("utf-8", errors="replace")
    except (OSError, EOFError, zlib.error):
        return None  # the frames that could be read are taken all the same
    begin_ns = None
    for line in head.splitlines():
        if _ASC_FRAME.match(line):
            break
        # Where the logger waited for a trigger, times count from there.
        if dated := _ASC_DATE.match(line):
            begin_ns = _ns_of_asc(dated["date"]) or begin_ns
    return begin_ns


def _ns_of_asc(text: str) -> int | None:
    """A date as ASC logs have it, ``Nov 23 02:58:31.123 pm 2026``, ns since the Unix epoch in UTC."""
    written = _ASC_WRITTEN.fullmatch(text.strip())
    month = _MONTHS.get(written["month"].lower()) if written else None
    if written is None or month is None:
        return None
    hour, half = int(written["hour"]), (written["half"] or "").lower()
    if half and not 1 <= hour <= 12:
        return None
    if half:
        hour = hour % 12 + (12 if half == "pm" else 0)
    date = f"{written['year']}-{month:02}-{int(written['day']):02}T{hour:02}:{written['rest']}"
    return ns_of_iso(date)


@dataclass(slots=True)
class _Bus:
    name: str
    channel: str
    sorter: FrameDemultiplexer


class _Playing:
    """All logs of a recording, played in the order of their frames."""

    def __init__(self, machine: MachineFile, path: str) -> None:
        self._machine = machine
        self._path = path
        self.blocks: dict[str, list[SampleBlock]] = {}
        self.notes: list[str] = []
        self.spans_ns: dict[str, tuple[int, int]] = {}
        self.unknown: dict[str, int] = {}
        self._specs = _specs(machine)
        if not self._specs:
            raise RecordingError(
                f"{path} is a CAN log, and no stream of {machine.path} comes in CAN frames; give a table of "
                "samples, or the machine file with the layout of the frames",
                NOT_IN_LOG,
            )
        self.assemblers = {
            spec.name: StreamAssembler(
                spec.name,
                spec.rate_hz,
                counter_bits=spec.layout.counter_bits,
                samples_per_frame=spec.layout.samples_per_frame,
                counts_per_frame=spec.layout.counts_per_frame,
                deliver=self._deliver,
                reorder_window_ns=spec.reorder_window_ns,
            )
            for specs in self._specs.values()
            for spec in specs
        }
        self._alignment = alignment(machine, None, self._keep)

    def play(self) -> None:
        """Play them."""
        files = [Path(self._path)]
        if files[0].is_dir():
            files = sorted(file for file in files[0].iterdir() if named_as_can_log(file) and file.is_file())
            if not files:
                raise RecordingError(
                    f"{self._path} is a folder without a CAN log ({', '.join(CAN_LOGS)}); give that of "
                    "the logs",
                    NOT_FOUND,
                )
        logs = [_Log(file, self._buses(), self.notes) for file in files]
        for piece in heapq.merge(*(log.pieces() for log in logs), key=_first_ns):
            self._take(piece)
        for assembler in self.assemblers.values():
            assembler.flush()
        for log in logs:
            if not log.taken and len(logs) > 1:
                self.notes.append(f"{log.path.name} has no frame of a stream of {self._machine.path}")

    def _buses(self) -> list[_Bus]:
        return [
            _Bus(
                name,
                str(getattr(self._machine.buses[name], "channel", None) or name),
                FrameDemultiplexer(specs),
            )
            for name, specs in self._specs.items()
        ]

    def _take(self, piece: DecodedBatch) -> None:
        for name, count in piece.unknown.items():
            self.unknown[name] = self.unknown.get(name, 0) + count
        newest_ns = 0
        for stream, frames in piece.frames.items():
            first_ns, last_ns = self.spans_ns.get(stream, (int(frames.arrival_ns[0]), 0))
            # Logs of several interfaces may step back a little; an arrival never does.
            arrival_ns = np.maximum.accumulate(np.maximum(frames.arrival_ns, last_ns))
            newest_ns = max(newest_ns, int(arrival_ns[-1]))
            self.spans_ns[stream] = first_ns, int(arrival_ns[-1])
            self.assemblers[stream].accept(*frames._replace(arrival_ns=arrival_ns))
        if newest_ns:
            for assembler in self.assemblers.values():
                assembler.tick(newest_ns)

    def _deliver(self, block: SampleBlock) -> None:
        self._keep(block)
        self._alignment.accept(block)

    def _keep(self, block: SampleBlock) -> None:
        self.blocks.setdefault(block.stream, []).append(block)

    def seen_instead(self) -> str:
        """What the log holds that no stream has, in words."""
        ids = sorted(self.unknown, key=lambda name: -self.unknown[name])[:_NAMED_IDS]
        return f", but frames of {', '.join(ids)}" if ids else ""

    def check_rates(self) -> None:
        """See whether samples come as fast as the machine file states.

        Raises:
            RecordingError: they do not.
        """
        for name, (first_ns, last_ns) in self.spans_ns.items():
            counters, stated_hz = self.assemblers[name].counters, self._machine.streams[name].rate_hz
            span_s = (last_ns - first_ns) / NS_PER_S
            if span_s < _LONG_ENOUGH_S:
                continue
            seen_hz = counters.samples_received / span_s
            too_few = seen_hz < stated_hz * (1.0 - _MOST_OFF_RATE)
            if seen_hz > stated_hz * (1.0 + _MOST_OFF_RATE) or (too_few and not counters.samples_lost):
                raise RecordingError(
                    f"{self._path}: stream {name!r} comes at {seen_hz:.4g} Hz, and {self._machine.path} "
                    f"states {stated_hz:g} Hz; correct its rate_hz",
                    RATE_CONTRADICTED,
                )


def _specs(machine: MachineFile) -> dict[str, list[StreamSpec[FrameLayout]]]:
    """By bus, its streams that come in CAN frames."""
    specs: dict[str, list[StreamSpec[FrameLayout]]] = {}
    for name, stream in machine.streams.items():
        if isinstance(stream.layout, PlainLayout | DbcLayout):
            window_ns = round(stream.reorder_window_ms * _NS_PER_MS)
            spec = StreamSpec(name, frame_layout(machine, name), stream.rate_hz, window_ns)
            specs.setdefault(stream.bus, []).append(spec)
    return specs


class _Log:
    """One log; which bus each of its channels is shows in the frames and the names."""

    def __init__(self, path: Path, buses: Sequence[_Bus], notes: list[str]) -> None:
        self.path = path
        self.taken = False
        self._buses = buses
        self._notes = notes
        self._chosen: dict[str, _Bus] = {}

    def pieces(self) -> Iterator[DecodedBatch]:
        """What it holds, piece by piece; ends at what is damaged.

        Raises:
            RecordingError: it cannot be read at all.
        """
        try:
            log = CanLog(self.path, self._sort)
        except LogError as error:
            raise RecordingError(f"{error}", error.code) from None
        malformed = 0
        try:
            while (piece := log.read(_SPAN_NS)) is not None:
                malformed += piece.notes.get("frames_malformed", 0)
                if piece.frames or piece.unknown:
                    yield piece
        except LogError as error:
            self._notes.append(f"{error}".replace("have been played", "are taken"))
        finally:
            log.close()
        if malformed:
            self._notes.append(
                f"{malformed} lines of {self.path.name} are no frames, first {log.first_malformed}"
            )

    def _sort(self, messages: list[can.Message], t_ns: NDArray[np.int64]) -> DecodedBatch:
        decoded = DecodedBatch()
        channels = ["" if message.channel is None else str(message.channel) for message in messages]
        for channel in dict.fromkeys(channels):
            rows = [k for k, name in enumerate(channels) if name == channel]
            batch = batch_of([messages[k] for k in rows], t_ns[rows].tolist())
            bus = self._chosen.get(channel)
            if bus is None:
                bus = self._choose(channel, {b.name: b.sorter.sort(batch, 0) for b in self._buses})
            part = (bus or self._buses[0]).sorter.sort(batch, 0)
            if bus is not None:
                for stream, frames in part.frames.items():
                    known = decoded.frames.get(stream)
                    # Two channels may be the same bus.
                    decoded.frames[stream] = frames if known is None else joined(known, frames)
                self.taken = self.taken or bool(part.frames)
            for name, count in part.unknown.items():
                decoded.unknown[name] = decoded.unknown.get(name, 0) + count
        return decoded

    def _choose(self, channel: str, parts: Mapping[str, DecodedBatch]) -> _Bus | None:
        """The bus that a channel is; None while that does not show.

        Raises:
            RecordingError: it may be several.
        """
        counts = {name: sum(len(f.arrival_ns) for f in part.frames.values()) for name, part in parts.items()}
        fitting = [bus for bus in self._buses if counts[bus.name]]
        named = [
            bus
            for bus in fitting
            if channel in {bus.name, bus.channel}
            or self.path.name.startswith((f"{bus.name}-", f"{bus.name}."))
        ]
        best = [bus for bus in fitting if counts[bus.name] == max(counts.values())]
        candidates = named or best
        if len(candidates) > 1:
            raise RecordingError(
                f"the frames of {self.path} may be of {' or '.join(bus.name for bus in candidates)}; let its "
                f"name begin with that of the bus, e.g. {candidates[0].name}-{self.path.name}",
                NOT_IN_LOG,
            )
        if candidates:
            self._chosen[channel] = candidates[0]
        return candidates[0] if candidates else None


def _first_ns(piece: DecodedBatch) -> int:
    return min((int(frames.arrival_ns[0]) for frames in piece.frames.values()), default=0)


@dataclass(slots=True)
class _Rows:
    """Samples of a stream or grid in their places.

    Attributes:
        samples: float64 ``[n, channels]``.
        t_first_ns: when the first was taken.
    """

    samples: Floats
    t_first_ns: float


def _rows(path: str, name: str, blocks: Sequence[SampleBlock]) -> _Rows:
    first, end = blocks[0].first_index, blocks[-1].end_index
    there = sum(len(block.samples) for block in blocks)
    if end - first > MOST_STRETCHED * there:
        raise RecordingError(
            f"{path} lacks {end - first - there:,} of {end - first:,} samples of stream {name!r}; give the "
            "logs of one time without long gaps between",
            GAPS,
        )
    samples = np.full((end - first, blocks[0].samples.shape[1]), np.nan)
    for block in blocks:
        samples[block.first_index - first : block.end_index - first] = block.samples
    last = blocks[-1]
    return _Rows(samples, last.t_first_ns - (last.first_index - first) * last.period_ns)


@dataclass(frozen=True, slots=True)
class _Group:
    """What is one recording: a grid, or streams of one rate.

    Attributes:
        streams: the grid or the streams; for each the stream and channel of each of its columns.
        rate_hz: samples per second.
        sensors: the names of its sensors.
    """

    streams: dict[str, list[tuple[str, str]]]
    rate_hz: float
    sensors: frozenset[str]


def _recording(
    machine: MachineFile, path: str, playing: _Playing, group: _Group, given_hz: float | None = None
) -> Recording:
    rate_hz = group.rate_hz
    if given_hz is not None and abs(given_hz / rate_hz - 1.0) > SAME_RATE:
        raise RecordingError(
            f"the sampling rate of {path} is {rate_hz:g} Hz by {machine.path} and {given_hz:g} Hz as given: "
            "leave --fs out, or correct it",
            RATE_CONTRADICTED,
        )
    names, columns = [], []
    rows = {name: _rows(path, name, playing.blocks[name]) for name in group.streams}
    begun_ns = min(one.t_first_ns for one in rows.values())
    shifts = {n: round((one.t_first_ns - begun_ns) * rate_hz / NS_PER_S) for n, one in rows.items()}
    length = max(shifts[name] + len(one.samples) for name, one in rows.items())
    for sensor in machine.sensors:
        for name, channels in group.streams.items():
            if (sensor.stream, sensor.channel) in channels:
                column = np.full(length, np.nan)
                values = rows[name].samples[:, channels.index((sensor.stream, sensor.channel))]
                column[shifts[name] : shifts[name] + len(values)] = values
                names.append(sensor.name)
                columns.append(column)
    samples = np.column_stack(columns)
    return Recording(
        names=tuple(names),
        samples=samples,
        rate_hz=rate_hz,
        source=Path(path),
        nan_count=int(np.isnan(samples).sum()),
        infinity_count=int(np.isinf(samples).sum()),
        rate_source=f"of {machine.path}",
    )


def _groups(machine: MachineFile, path: str, playing: _Playing, watched: Sequence[str]) -> list[_Group]:
    """What is read together: each grid, and streams of each rate; first what most watched sensors are in.

    Raises:
        RecordingError: there is a grid, and nothing could be put on it; or no sensor has any samples.
    """
    sensors = {(sensor.stream, sensor.channel): sensor.name for sensor in machine.sensors}
    groups: list[_Group] = []

    def add(streams: dict[str, list[tuple[str, str]]], rate_hz: float) -> None:
        there = (sensors.get(column) for columns in streams.values() for column in columns)
        groups.append(_Group(streams, rate_hz, frozenset(filter(None, there))))

    on_grids: set[str] = set()
    for grid in machine.grids:
        if grid.name in playing.blocks:
            columns = [(name, c) for name, s in grid.streams.items() for c in s.layout.channel_names]
            add({grid.name: columns}, next(iter(grid.streams.values())).rate_hz)
            on_grids |= set(grid.streams)
        elif not set(grid.streams) - set(playing.spans_ns):
            raise RecordingError(
                f"the streams {', '.join(grid.streams)} could not be put on one grid: they are too short, or "
                "of different times; give logs of some 10 s and more, of the same time",
                NOT_TOGETHER,
            )
    single = [name for name in machine.streams if name in playing.blocks and name not in on_grids]
    for rate_hz in sorted({machine.streams[name].rate_hz for name in single}, reverse=True):
        of_rate = [name for name in single if machine.streams[name].rate_hz == rate_hz]
        add({n: [(n, c) for c in machine.streams[n].layout.channel_names] for n in of_rate}, rate_hz)
    groups = [group for group in groups if group.sensors]
    if not groups:
        raise RecordingError(
            f"{path} holds no samples of a sensor of {machine.path}; give the log of this machine's bus, or "
            "add [[sensors]] for its channels",
            NOT_IN_LOG,
        )
    return sorted(groups, key=lambda group: -len(group.sensors & set(watched)))
