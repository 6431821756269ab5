"""What files may say of themselves: `daqsvc export` writes it, or refuses it in one sentence."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import asammdf
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.snapshot_files import Sampled, write_snapshot

from daqsvc.acquisition.samples import SampleBlock
from daqsvc.cli import main
from daqsvc.recording import NamesError, RecordingError
from daqsvc.recording.recording import load_all
from daqsvc.recording.streams import FIRST_NS, LAST_NS, RecordedStream, checked, iso_ns, unique
from daqsvc.recording.writers import WRITERS
from daqsvc.snapshots import writing
from daqsvc.snapshots.contents import SCHEMA, Entry
from daqsvc.snapshots.writing import SnapshotWriter

pytestmark = pytest.mark.integration
SUFFIXES = list(WRITERS)
OUTSIDE = "states a begin outside of the years 1678 to 2261, and it is left out"
FACTS = {"rate_hz": 100.0, "channels": ["c0"], "sensors": ["x"], "units": ["um"]}


def export(*arguments):
    return main(["export", *map(str, arguments)])


def exported(capsys, *arguments):
    """Exit code and lines of stderr."""
    code = export(*arguments)
    return code, capsys.readouterr().err.splitlines()


@pytest.fixture
def two(tmp_path):
    np.savez(tmp_path / "two.npz", a=np.arange(100.0), b=np.arange(100.0) + 1000, fs=100.0)
    return tmp_path / "two.npz"


# Channels and streams: each is written, under its own name.


@pytest.mark.parametrize(("mapped", "taken"), [("b=a", "b"), ("a=b", "a"), ("b=a,c=b,d=a", "both b and d")])
@pytest.mark.parametrize("suffix", [".wav", ".csv", ".mat"])
def test_a_channel_gets_no_name_that_another_has(two, tmp_path, capsys, suffix, mapped, taken):
    target = tmp_path / f"out{suffix}"
    code, lines = exported(capsys, two, "--to", target, "--map", mapped)
    assert (code, len(lines)) == (2, 1)
    assert f"cannot be {taken}" in lines[0] or f"cannot be called {taken}, as another channel" in lines[0]
    assert not target.exists()


def test_channels_may_change_their_names(two, tmp_path):
    assert export(two, "--to", tmp_path / "out.csv", "--map", "b=a,a=b") == 0
    (stream,), _ = load_all(tmp_path / "out.csv")
    assert (stream.names, stream.samples[0].tolist()) == (("b", "a"), [0.0, 1000.0])
    with pytest.raises(NamesError):
        load_all(two, {"b": "a"})


def test_a_column_may_be_mapped_to_its_own_name_by_its_number(tmp_path):
    (tmp_path / "in.csv").write_text("# fs_hz = 100\na,b\n" + "1,2\n" * 50)
    assert export(tmp_path / "in.csv", "--to", tmp_path / "out.csv", "--map", "a=0") == 0
    (stream,), _ = load_all(tmp_path / "out.csv")
    assert stream.names == ("a", "b")


TWINS = """schema_version = 1
site = "lab"
box = "edge-1"
[machine]
name = "pump"
speed_rpm = 1500.0
[buses.can0]
driver = "can"
interface = "virtual"
channel = "can0"
""" + "".join(
    f"""[streams.s{k}]
bus = "can0"
rate_hz = 100.0
[streams.s{k}.layout]
id = 0x10{k}
length = 8
byte_order = "little"
counter = {{ byte = 0, bits = 16, counts = "samples" }}
first_byte = 2
samples_per_frame = 1
channels = [ {{ name = "x", type = "int16", scale = 0.1 }} ]
[[sensors]]
name = "left-{k}"
type = "trend"
stream = "s{k}"
channel = "x"
unit = "degC"
"""
    for k in (1, 2)
)


def test_a_channel_that_may_be_two_sensors_is_asked_about(tmp_path, capsys):
    machine = tmp_path / "machine.toml"
    machine.write_text(TWINS)
    np.savez(tmp_path / "run.npz", x=np.arange(100.0), y=np.arange(100.0), fs=100.0)
    code, lines = exported(capsys, machine, tmp_path / "run.npz", "--to", tmp_path / "a.csv")
    assert (code, len(lines)) == (2, 1)
    assert "channel x may be left-1 or left-2 of" in lines[0]
    assert "--map left-1=x" in lines[0]
    options = ["--to", tmp_path / "a.csv", "--map", "left-2=x"]
    assert export(machine, tmp_path / "run.npz", *options) == 0
    (stream,), _ = load_all(tmp_path / "a.csv")
    assert (stream.names, stream.units) == (("left-2", "y"), ("degC", ""))


def test_streams_get_files_of_their_own(tmp_path, capsys):
    names = ["Rack 1", "Rack-1", "rack-1", "r" * 300]
    with asammdf.MDF(version="4.10") as mdf:
        for number, name in enumerate(names):
            signal = asammdf.Signal(np.arange(100.0) + 1000 * number, np.arange(100) / 100, "V", f"u{number}")
            mdf.append([signal], acq_name=name, common_timebase=True)
        mdf.save(tmp_path / "in.mf4")
    assert export(tmp_path / "in.mf4", "--to", tmp_path / "g.csv", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    files = [Path(one["file"]) for one in document["files"]]
    assert [one.name for one in files] == [
        "g-Rack-1.csv",
        "g-Rack-1_2.csv",
        "g-rack-1_3.csv",
        f"g-{'r' * 120}.csv",
    ]
    assert [load_all(file)[0][0].names for file in files] == [(f"u{number}",) for number in range(4)]


def test_names_are_made_unique():
    assert unique(["a", "a", "a_2", "b"], ["b"]) == ["a", "a_3", "a_2", "b_2"]


# Begins, rates, names and counts.


@pytest.mark.long
@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("year", ["9999-12-31", "0001-01-01", "2262-02-01", "1677-12-01"])
def test_a_begin_of_no_such_year_is_left_out(tmp_path, capsys, suffix, year):
    np.savez(tmp_path / "f.npz", x=np.arange(100.0), fs=100.0, start_time=f"{year}T00:00:00Z")
    code, lines = exported(capsys, tmp_path / "f.npz", "--to", tmp_path / f"out{suffix}")
    assert (code, OUTSIDE in lines[0]) == (0, True)
    (stream,), _ = load_all(tmp_path / f"out{suffix}")
    assert stream.start_ns == (0 if suffix == ".mf4" else None)


def test_a_column_of_dates_of_no_such_year_is_left_out(tmp_path, capsys):
    """Nanoseconds would take it for one of another year."""
    dates = np.datetime64("9999-01-01", "us") + np.arange(50) * np.timedelta64(1_000_000, "us")
    pq.write_table(pa.table({"time": dates, "x": np.arange(50.0)}), tmp_path / "in.parquet")
    code, lines = exported(capsys, tmp_path / "in.parquet", "--to", tmp_path / "out.csv")
    assert (code, OUTSIDE in lines[0]) == (0, True)
    dates -= np.timedelta64(8000 * 365, "D")
    pq.write_table(pa.table({"time": dates, "x": np.arange(50.0)}), tmp_path / "in.parquet")
    (stream,), _ = load_all(tmp_path / "in.parquet")
    assert stream.start_ns == dates[0].astype("datetime64[ns]").astype(np.int64)


def write_hostile(path, facts, monkeypatch, **about):
    """A snapshot that says what no recorder writes."""
    monkeypatch.setattr(writing, "to_json", lambda document, **_: json.dumps(document).encode())
    said = {
        "schema": SCHEMA,
        "site": "lab",
        "box": "b",
        "machine": "rig",
        "begin_ns": 5,
        "wall_ns_at_0": 1_795_445_911_123_456_789,
        "streams": {"s": {**FACTS, **facts}},
        **about,
    }
    writer = SnapshotWriter(path, said, {}, 5)
    rows = np.ones((64, len(said["streams"]["s"]["channels"])), np.float32)
    writer.write([Entry(10, SampleBlock("s", 0, rows, 10, 1e7, lost_before=0, t_error_ns=1.0))])
    writer.finish()
    return path


WRITTEN = {
    "a begin of long after": ({}, {"wall_ns_at_0": 10**30}),
    "a slow stream": ({"rate_hz": 0.2}, {}),
    "a fast stream": ({"rate_hz": 1e12}, {}),
    "a name that is no text": ({"sensors": ["x\ud800\n"]}, {}),
    "a machine that is no text": ({}, {"machine": "x\ud800\n"}),
    "a unit that is no text": ({"units": ["um\ud800\n# fs_hz = 7"]}, {}),
    "two sensors of one name": (
        {"channels": ["c0", "c1"], "sensors": ["x", "x"], "units": ["um", "V"]},
        {},
    ),
}
REFUSED = {
    "no rate": {"rate_hz": float("inf")},
    "few units": {"units": []},
    "many units": {"units": ["um", "um"]},
}


@pytest.mark.long
@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("what", WRITTEN)
def test_what_a_snapshot_may_say_is_written(tmp_path, capsys, monkeypatch, what, suffix):
    facts, about = WRITTEN[what]
    source = write_hostile(tmp_path / "in.mcap", facts, monkeypatch, **about)
    code, lines = exported(capsys, source, "--to", tmp_path / f"out{suffix}", "--json")
    if suffix == ".wav" and "stream" in what:
        assert (code, len(lines)) == (3, 1)
        assert "samples a second" in lines[0]
        return
    assert code == 0
    assert all(line.startswith("daqsvc export: ") for line in lines)
    if "stream" not in what:  # whose rates nothing that is read may have
        (stream,), _ = load_all(tmp_path / f"out{suffix}")
        assert len(stream.names) == len(facts.get("channels", "x"))
        if what == "two sensors of one name":
            assert stream.names == ("x", "x_2")


@pytest.mark.long
@pytest.mark.parametrize("what", REFUSED)
def test_what_no_format_can_say_is_refused(tmp_path, capsys, monkeypatch, what):
    source = write_hostile(tmp_path / "in.mcap", REFUSED[what], monkeypatch)
    for suffix in SUFFIXES:
        code, lines = exported(capsys, source, "--to", tmp_path / f"out{suffix}")
        assert (code, len(lines)) == (3, 1)
        assert "cannot be read: stream s" in lines[0]


def test_a_slow_stream_beside_a_fast_one_is_named_with_the_remedy(tmp_path, capsys):
    streams = {
        "a": Sampled(1000.0, {"pa": "um"}, np.ones((640, 1))),
        "t": Sampled(0.2, {"temp": "degC"}, np.ones((64, 1))),
    }
    source = write_snapshot(tmp_path / "slow.mcap", streams, 1_795_445_911_123_456_789)
    code, lines = exported(capsys, source, "--to", tmp_path / "a.wav")
    assert (code, len(lines)) == (3, 1)
    assert "or another stream alone with --stream" in lines[0]
    assert export(source, "--to", tmp_path / "a.wav", "--stream", "a") == 0
    assert export(source, "--to", tmp_path / "t.csv") == 0


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_name_of_a_recording_may_be_any_bytes(two, tmp_path, capsys, suffix):
    source = os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.npz")
    two.rename(source)
    code, lines = exported(capsys, source, "--to", tmp_path / f"out{suffix}")
    assert code == 0
    assert not [line for line in lines if "1970" not in line]


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_channel_called_time_gets_another_name(tmp_path, capsys, suffix):
    uneven = np.sort(np.random.default_rng(1).random(100))
    start = "2026-01-01T00:00:00Z"
    np.savez(tmp_path / "t.npz", time=uneven, x=np.arange(100.0), fs=100.0, start_time=start)
    code, lines = exported(capsys, tmp_path / "t.npz", "--to", tmp_path / f"o{suffix}", "--fs", 100)
    assert code == 0
    assert "channel time of stream t is the column time_2, as time is the time of each sample" in lines[-1]
    (stream,), _ = load_all(tmp_path / f"o{suffix}")
    assert stream.names == ("time_2", "x")
    assert np.array_equal(stream.samples[:, 0], uneven)


@pytest.mark.parametrize("error", [ValueError("a\nb"), OverflowError("too large"), KeyError(), MemoryError()])
def test_whatever_a_library_says_is_one_sentence(two, tmp_path, capsys, monkeypatch, error):
    def refuse(*_):
        raise error

    monkeypatch.setitem(WRITERS, ".csv", replace(WRITERS[".csv"], write=refuse))
    code, lines = exported(capsys, two, "--to", tmp_path / "a.csv")
    assert (code, len(lines)) == (3, 1)
    assert lines[0].startswith("daqsvc export: a.csv ")
    assert [path.name for path in tmp_path.iterdir()] == ["two.npz"]


def stream_of(**facts):
    given = {"rate_hz": 100.0, "names": ("x",), "units": ("um",), "samples": np.zeros((100, 1)), **facts}
    return RecordedStream("s", **given)


def test_begins_are_of_the_years_that_nanoseconds_hold():
    assert (iso_ns(FIRST_NS), iso_ns(LAST_NS)) == (
        "1678-01-01T00:00:00.000000000Z",
        "2262-01-01T00:00:00.000000000Z",
    )
    for start_ns, kept in ((FIRST_NS, True), (FIRST_NS - 1, False), (LAST_NS, False)):
        stream, notes = checked(stream_of(start_ns=start_ns), "a.npz")
        assert ((stream.start_ns is not None), not notes) == (kept, kept)
        stream.times_ns(0, 100)


@pytest.mark.parametrize(
    "facts", [{"rate_hz": 0.0}, {"rate_hz": float("nan")}, {"rate_hz": 1e-12}, {"names": ()}]
)
def test_a_stream_that_is_none_is_refused(facts):
    with pytest.raises(RecordingError, match=r"a\.npz cannot be read: stream s"):
        checked(stream_of(**facts), "a.npz")
