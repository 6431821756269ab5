"""What `daqsvc export` writes: all streams of a recording, whatever kind of file it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daqsvc import __version__
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.errors.recordings import DAMAGED, GAPS, NEEDS_MACHINE_FILE, NO_SUCH_CHANNEL, TOO_SHORT
from daqsvc.recording import NamesError, RecordingError
from daqsvc.recording.formats import named_as_can_log
from daqsvc.recording.rate import MOST_STRETCHED
from daqsvc.recording.recording import get_limits, list_channels, load_all, matching
from daqsvc.recording.streams import NS_PER_S, LongGapsError, RecordedStream, checked, of_blocks, printable
from daqsvc.recording.writers import ExportUsageError
from daqsvc.snapshots.contents import SUFFIX
from daqsvc.snapshots.reading import SnapshotError, read_snapshot

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from daqsvc.settings import MachineFile
    from daqsvc.snapshots.contents import Document, Snapshot

ABOUT_MACHINE: tuple[str, ...] = ("site", "box", "machine")
"""What a snapshot states of where it is from."""


@dataclass(frozen=True, slots=True)
class Exported:
    """What a recording holds.

    Attributes:
        streams: its streams.
        about: what is stated of all of them: names of fields, and their texts.
        notes: what is wrong with it, in sentences.
    """

    streams: list[RecordedStream]
    about: Mapping[str, str]
    notes: list[str]


def read_streams(
    recording: str,
    machine: MachineFile | None = None,
    channels: Mapping[str, str] | None = None,
    rate_hz: float | None = None,
) -> Exported:
    """Read all streams of a recording.

    Args:
        recording: path of a file, of a CAN log, or of a folder of CAN logs.
        machine: the layouts of the frames of a CAN log; of another file, the names and units of its channels.
        channels: what some channels of a file are called from now on, and in the file.
        rate_hz: samples per second of a file that does not state it.

    Raises:
        ExportUsageError: two of its channels would have one name, or one of them two.
        RecordingError: it cannot be read.
    """
    path = Path(recording)
    read = _read(path, recording, machine, channels or {}, rate_hz)
    streams, notes = [], list(read.notes)
    for one in read.streams:
        stream, noted = checked(one, printable(str(path)))
        streams.append(stream)
        notes += [note for note in noted if note not in notes]
    about = {"recording": path.name, "written_by": f"daqsvc {__version__}", **read.about}
    return Exported(streams, {key: printable(text) for key, text in about.items()}, notes)


def _read(
    path: Path,
    recording: str,
    machine: MachineFile | None,
    channels: Mapping[str, str],
    rate_hz: float | None,
) -> Exported:
    """What a recording holds, as it states itself; see `read_streams`.

    Raises:
        ExportUsageError: names for its channels do not fit.
        RecordingError: it cannot be read.
    """
    of_machine = {} if machine is None else {"machine": machine.machine.name}
    is_can_log = path.is_dir() or named_as_can_log(path)
    is_snapshot = path.name.lower().endswith(SUFFIX)
    if (is_can_log or is_snapshot) and (channels or rate_hz is not None):
        kind, who = ("CAN log", "the machine file") if is_can_log else ("snapshot", "itself")
        raise RecordingError(
            f"{path} is a {kind}, of which {who} states channels and rate: leave out --map and --fs",
            NEEDS_MACHINE_FILE,
        )
    if is_can_log and machine is not None:
        from daqsvc.offline.can_logs import load_can_streams  # noqa: PLC0415 - brings python-can and kernels

        streams, notes = load_can_streams(machine, recording)
        return Exported(streams, of_machine, notes)
    if path.is_dir():
        raise RecordingError(
            f"{path} is a folder, of which only CAN logs are read, by the layouts of a machine file: name "
            "that first",
            NEEDS_MACHINE_FILE,
        )
    if is_snapshot:
        try:
            snapshot = read_snapshot(path, get_limits())
        except SnapshotError as error:
            raise RecordingError(f"{error}", error.code) from None
        about = snapshot.about
        of_snapshot = {key: str(about[key]) for key in ABOUT_MACHINE if key in about}
        return Exported(_of_snapshot(path, snapshot), of_snapshot, list(snapshot.notes))
    streams, notes = _of_table(recording, machine, channels, rate_hz)
    return Exported(streams, of_machine, notes)


def _of_snapshot(path: Path, snapshot: Snapshot) -> list[RecordedStream]:
    """Streams with sensors; a grid has none, which is made of them."""
    blocks: dict[str, list[SampleBlock]] = {}
    for entry in snapshot.entries:
        if isinstance(entry.what, SampleBlock):
            blocks.setdefault(entry.what.stream, []).append(entry.what)
    try:
        streams = [
            _stream(name, facts, blocks[name], snapshot.about.get("wall_ns_at_0"))
            for name, facts in snapshot.about["streams"].items()
            if name in blocks and any(facts["sensors"])
        ]
    except LongGapsError as error:
        raise RecordingError(f"{path} {error}; give a snapshot of a shorter time", GAPS) from None
    except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(
            f"{path} cannot be read: {error}; it may be damaged: copy it again", DAMAGED
        ) from None
    if not streams:
        raise RecordingError(f"{path} holds no samples of any sensor; give another snapshot", TOO_SHORT)
    return streams


def _stream(name: str, facts: Document, blocks: list[SampleBlock], wall_ns: Any) -> RecordedStream:
    samples, t_ns, period_ns = of_blocks(blocks, MOST_STRETCHED)
    names = [str(s or c) for s, c in zip(facts["sensors"], facts["channels"], strict=True)]
    rate_hz = float(facts["rate_hz"])
    if len(names) != samples.shape[1] or not rate_hz > 0.0:
        raise ValueError(f"stream {name!r:.60} is not what its samples are")
    start_ns = wall_ns + t_ns if isinstance(wall_ns, int) else None
    units = tuple(map(str, facts["units"]))
    return RecordedStream(name, rate_hz, tuple(names), units, samples, start_ns, NS_PER_S / period_ns)


def _of_table(
    recording: str, machine: MachineFile | None, channels: Mapping[str, str], rate_hz: float | None
) -> tuple[list[RecordedStream], list[str]]:
    """A file of another kind; by a machine file, its sensors have their names, and units if it has none."""
    wanted, units = dict(channels), {}
    if machine is not None:
        there = list_channels(recording)
        # A number is that of a column, and no end of a name.
        wanted = {
            name: variable if variable.isdecimal() else matching(recording, variable, there)
            for name, variable in channels.items()
        }
        units = _add_sensors(wanted, machine, there)
    try:
        streams, notes = load_all(recording, wanted, rate_hz)
    except NamesError as error:
        raise ExportUsageError(f"{error}", error.code) from None
    in_units = [
        replace(
            one,
            units=tuple(unit or units.get(name, "") for name, unit in zip(one.names, one.units, strict=True)),
        )
        for one in streams
    ]
    return in_units, notes


def _add_sensors(wanted: dict[str, str], machine: MachineFile, there: Collection[str]) -> dict[str, str]:
    """Add the sensors of a machine that a file has, and state their units.

    Args:
        wanted: channels of the file by their names from now on; sensors come to it.
        machine: the machine file.
        there: the channels of the file.

    Raises:
        ExportUsageError: a channel may be several sensors.
    """
    sensors = {one.name: wanted.get(one.name, one.name) for one in machine.sensors}
    sensors = {name: one for name, one in sensors.items() if name in wanted or one in there}
    for channel in dict.fromkeys(one.channel for one in machine.sensors):
        rivals = [s.name for s in machine.sensors if s.channel == channel and s.name not in sensors]
        variable = wanted.get(channel, channel)
        if not rivals or variable in sensors.values() or (channel not in wanted and channel not in there):
            continue
        if len(rivals) > 1:
            raise ExportUsageError(
                f"channel {variable} may be {' or '.join(rivals)} of {machine.path}: choose one with "
                f"--map {rivals[0]}={variable}",
                NO_SUCH_CHANNEL,
            )
        wanted.pop(channel, None)
        sensors[rivals[0]] = variable
    wanted |= sensors
    return {sensor.name: sensor.unit for sensor in machine.sensors if sensor.name in sensors}
