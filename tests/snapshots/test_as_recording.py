"""A snapshot as a recording: which streams are read, and what is said of one that is cut or damaged."""

from __future__ import annotations

import numpy as np
import pytest
from support.snapshot_files import Sampled, write_snapshot

from daqsvc.acquisition.samples import SampleBlock
from daqsvc.confined.limits import ResourceLimits
from daqsvc.confined.process import ConfinedProcess
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import list_channels, load_all, load_recording
from daqsvc.snapshots.contents import SCHEMA, Entry
from daqsvc.snapshots.mcap import MAGIC, Damage
from daqsvc.snapshots.reading import SnapshotError, notes_of, read_snapshot
from daqsvc.snapshots.writing import SnapshotWriter

START_NS = 1_795_445_911_000_000_000
DATA_END = b"\x0f\x04" + bytes(7)
CUT = "was cut before any sample was written in it"
X = np.arange(640.0)[:, None]
Y = -np.arange(320.0)[:, None]


@pytest.fixture(scope="module")
def process():
    """Reads the snapshots of all these tests, as it is not begun in no time."""
    with ConfinedProcess() as one:
        yield one


@pytest.fixture
def several(tmp_path):
    """Streams of two rates without a grid."""
    streams = {"a": Sampled(1000.0, {"probe-x": "um"}, X), "b": Sampled(500.0, {"probe-y": "um"}, Y)}
    return write_snapshot(tmp_path / "two.mcap", streams, START_NS)


def write_with_grid(path):
    """The same with the grid that the service makes of them, and a third one that is not on it."""

    def facts(rate_hz, channels, sensors):
        units = ["um" if one else "" for one in sensors]
        return {"rate_hz": rate_hz, "channels": channels, "sensors": sensors, "units": units}

    streams = {
        "a": facts(1000.0, ["c", "d"], ["probe-x", ""]),
        "b": facts(500.0, ["c"], ["probe-y"]),
        "t": facts(10.0, ["c"], ["oil"]),
        "a+b": facts(1000.0, ["a.c", "a.d", "b.c"], ["", "", ""]),
    }
    about = {"schema": SCHEMA, "begin_ns": 0, "streams": streams, "wall_ns_at_0": START_NS}
    writer = SnapshotWriter(path, about, {}, START_NS)
    widths = {name: (one["rate_hz"], len(one["channels"])) for name, one in streams.items()}
    writer.write(
        Entry(0, SampleBlock(name, 0, np.full((int(hz), width), ord(name[-1]), np.float32), 0, 1e9 / hz))
        for name, (hz, width) in widths.items()
    )
    writer.finish()
    return path


def test_of_several_rates_the_fastest_are_read_unless_others_are_named(several):
    assert list_channels(several) == {"probe-x": 640}
    assert load_recording(several).names == ("probe-x",)
    slow = load_recording(several, {"y": "probe-y"})
    assert (slow.names, slow.rate_hz, slow.units) == (("y",), 500.0, {"y": "um"})
    assert np.array_equal(slow.samples, Y)
    assert slow.notes == (
        (
            "probe-x left out: sampled at 1000 Hz, and the slower streams are read, at 500 Hz; "
            "daqsvc replay judges all of them"
        ),
    )
    assert load_recording(several).notes == (
        (
            "probe-y left out: sampled at 500 Hz, and the fastest streams are read, at 1000 Hz; "
            "daqsvc replay judges all of them"
        ),
    )


def test_a_stream_of_another_rate_is_called_so(several):
    why = (
        "probe-y of .*two.mcap is sampled at 500 Hz, and the fastest streams are read, at 1000 Hz; "
        "daqsvc replay judges all of them"
    )
    with pytest.raises(RecordingError, match=why):
        list_channels(several, ["probe-x", "probe-y"])
    with pytest.raises(RecordingError, match=why):
        load_recording(several, {"probe-x": "probe-x", "probe-y": "probe-y"})


def test_streams_on_a_grid_are_read_from_there(tmp_path):
    path = write_with_grid(tmp_path / "grid.mcap")
    assert list_channels(path) == {"probe-x": 1000, "a.d": 1000, "probe-y": 1000}
    recording = load_recording(path, {"probe-x": "probe-x", "probe-y": "probe-y"})
    assert (recording.rate_hz, recording.units) == (1000.0, {"probe-x": "um", "probe-y": "um"})
    assert (recording.samples == ord("b")).all()
    assert [note.partition(":")[0] for note in recording.notes] == ["oil left out"]
    assert load_recording(path, {"oil": "oil"}).rate_hz == 10.0
    with pytest.raises(RecordingError, match=r"oil of .* at 10 Hz, and the grid a\+b is read, at 1000 Hz"):
        list_channels(path, ["oil"])


def test_what_is_wrong_with_it_is_told(several):
    data = several.read_bytes()
    several.write_bytes(data[: data.rindex(DATA_END)])
    cut = "the snapshot ends early: it was cut, or is still being written"
    assert load_recording(several).notes[0] == cut
    assert load_all(several)[1][0] == cut


def test_damaged_parts_are_counted_in_words():
    assert notes_of(Damage(damaged_chunks=1)) == ["1 part of the snapshot is damaged and left out"]
    assert notes_of(Damage(damaged_chunks=2)) == ["2 parts of the snapshot are damaged and left out"]


@pytest.mark.parametrize("length", [3, len(MAGIC), 20, 300, 700])
def test_one_that_is_cut_at_its_begin_is_called_so(several, length, process):
    assert several.stat().st_size > 3000
    several.write_bytes(several.read_bytes()[:length])
    with pytest.raises(RecordingError, match=f"^{several} {CUT}"):
        load_recording(several)
    with pytest.raises(SnapshotError, match=f"^{several} {CUT}"):
        read_snapshot(several, ResourceLimits(), process)
