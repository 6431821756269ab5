"""What `daqsvc export` writes: all streams of a recording, whatever kind of file it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daqsvc import __version__
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.recording import RecordingError
from daqsvc.recording.formats import named_as_can_log
from daqsvc.recording.rate import MOST_STRETCHED
from daqsvc.recording.recording import get_limits, list_channels, load_all, matching
from daqsvc.recording.streams import NS_PER_S, LongGapsError, RecordedStream, of_blocks
from daqsvc.snapshots.contents import SUFFIX
from daqsvc.snapshots.reading import SnapshotError, read_snapshot

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.settings import MachineFile
    from daqsvc.snapshots.contents import Document, Snapshot


@dataclass(frozen=True, slots=True)
class Exported:
    """What a recording holds.

    Attributes:
        streams: its streams.
        about: what is said of all of them: names of fields, and their texts.
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
        rate_hz: samples per second of a file that does not say it.

    Raises:
        RecordingError: it cannot be read.
    """
    path = Path(recording)
    about = {"recording": path.name, "written_by": f"daqsvc {__version__}"}
    of_machine = {} if machine is None else {"machine": machine.machine.name}
    is_can_log = path.is_dir() or named_as_can_log(path)
    is_snapshot = path.name.lower().endswith(SUFFIX)
    if (is_can_log or is_snapshot) and (channels or rate_hz is not None):
        kind, who = ("CAN log", "the machine file") if is_can_log else ("snapshot", "itself")
        raise RecordingError(
            f"{path} is a {kind}, of which {who} says channels and rate: leave out --map and --fs"
        )
    if is_can_log and machine is not None:
        from daqsvc.offline.can_logs import load_can_streams  # noqa: PLC0415 - brings python-can and kernels

        streams, notes = load_can_streams(machine, recording)
        return Exported(streams, about | of_machine, notes)
    if path.is_dir():
        raise RecordingError(
            f"{path} is a folder, of which only CAN logs are read, by the layouts of a machine file: name "
            "that first"
        )
    if is_snapshot:
        try:
            snapshot = read_snapshot(path, get_limits())
        except SnapshotError as error:
            raise RecordingError(f"{error}") from None
        said = {key: str(snapshot.about[key]) for key in ("site", "box", "machine") if key in snapshot.about}
        return Exported(_of_snapshot(path, snapshot), about | said, list(snapshot.notes))
    streams, notes = _of_table(recording, machine, channels or {}, rate_hz)
    return Exported(streams, about | of_machine, notes)


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
        raise RecordingError(f"{path} {error}; give a snapshot of a shorter time") from None
    except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise RecordingError(f"{path} cannot be read: {error}; it may be damaged: copy it anew") from None
    if not streams:
        raise RecordingError(f"{path} holds no samples of any sensor; give another snapshot")
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
    """A file of another kind; by a machine file, its sensors have their names, and units if it says none."""
    if machine is None:
        return load_all(recording, channels, rate_hz)
    there = list_channels(recording)
    wanted = {name: matching(recording, variable, there) for name, variable in channels.items()}
    units = {}
    for sensor in machine.sensors:
        mapped = wanted.pop(sensor.channel, None) if sensor.name not in wanted else wanted[sensor.name]
        variable = mapped or next((one for one in (sensor.name, sensor.channel) if one in there), None)
        if variable is not None:
            wanted[sensor.name], units[sensor.name] = variable, sensor.unit
    streams, notes = load_all(recording, wanted, rate_hz)
    in_units = [
        replace(
            one,
            units=tuple(unit or units.get(name, "") for name, unit in zip(one.names, one.units, strict=True)),
        )
        for one in streams
    ]
    return in_units, notes
