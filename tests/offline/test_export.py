"""``daqsvc export``: libraries of the formats read what it writes, and daqsvc reads it as the original."""

from __future__ import annotations

import csv
import json
import signal
import struct
import subprocess
import sys
import time
from datetime import UTC, datetime

import asammdf
import can
import numpy as np
import pyarrow.parquet as pq
import pytest
import pyuff
from scipy.io import loadmat, wavfile
from support.formats import fits
from support.given_codes import had
from support.orbit_files import OPTIONS, RATE_HZ, UNBALANCE, Orbit
from support.small_disks import mounted
from support.snapshot_files import BLOCK_ROWS, Sampled, write_snapshot

from daqsvc.cli import main
from daqsvc.recording.recording import load_all, load_recording
from daqsvc.recording.writers import WRITERS

pytestmark = pytest.mark.integration
START_NS = 1_795_445_911_123_456_789
START = "2026-11-23T14:58:31.123456789Z"
SUFFIXES = list(WRITERS)
SENSORS = {"x": "um", "y": "um", "keyphasor": "V"}
SLOW = {"oil-temp": "degC"}
SLOW_HZ = 10.0


def orbit_samples(orbit):
    return np.column_stack([orbit.x, orbit.y, orbit.keyphasor]).astype(np.float32)


@pytest.fixture(scope="module")
def samples():
    return orbit_samples(Orbit(change=UNBALANCE))


@pytest.fixture
def snapshot(tmp_path, samples):
    """One stream without gaps."""
    return write_snapshot(tmp_path / "run.mcap", {"shaft": Sampled(RATE_HZ, SENSORS, samples)}, START_NS)


@pytest.fixture
def gapped(tmp_path):
    """Two streams; of the fast one a block is missing, and the slow one begins later."""
    fast = orbit_samples(Orbit(20))
    fast[2 * BLOCK_ROWS : 3 * BLOCK_ROWS] = np.nan
    slow = np.arange(64, dtype=np.float32)[:, None] / 3
    streams = {
        "shaft": Sampled(RATE_HZ, SENSORS, fast),
        "oil": Sampled(SLOW_HZ, SLOW, slow, behind_ns=25_000_000),
    }
    return write_snapshot(tmp_path / "two.mcap", streams, START_NS), fast, slow[:, 0]


def export(*arguments):
    try:
        return main(["export", *map(str, arguments)])
    except SystemExit as stopped:
        return stopped.code


def figures(found):
    """What is found, without the name of the file and where its rate comes from."""
    return {key: value for key, value in found.items() if key != "recording"}


# daqsvc reads what it has written.


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_verdict_is_that_of_the_original(verb, analyze, snapshot, tmp_path, suffix):
    target = tmp_path / f"export{suffix}"
    assert verb("export", snapshot, "--to", target)[0] == 0
    code, (expected, found), err = analyze(snapshot, target, *OPTIONS, "--jobs", 1)
    assert (code, expected["verdict"]) == (0, "unbalance"), err
    if suffix in {
        ".mf4",
        ".csv",
    }:  # whose times tell the rate, whose numbers their values to some digits only
        assert found["verdict"] == expected["verdict"]
        assert found["departure"]["sample"] == expected["departure"]["sample"]
    else:
        assert figures(found) == figures(expected)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_names_units_rate_begin_and_samples_come_back(snapshot, samples, tmp_path, suffix):
    target = tmp_path / f"export{suffix}"
    assert export(snapshot, "--to", target) == 0
    (stream,), notes = load_all(target)
    assert notes == []
    assert stream.names == tuple(SENSORS)
    assert stream.units == tuple(SENSORS.values())
    assert stream.rate_hz == pytest.approx(RATE_HZ, rel=1e-9)
    assert stream.start_ns == START_NS
    assert np.array_equal(stream.samples.astype(np.float32), samples)
    recording = load_recording(target)
    assert recording.units == SENSORS
    assert recording.rate_hz == pytest.approx(RATE_HZ, rel=1e-9)


@pytest.mark.parametrize("suffix", [".mat", ".uff", ".mf4"])
def test_streams_of_several_rates_are_in_one_file(gapped, tmp_path, capsys, suffix):
    snapshot, fast, slow = gapped
    target = tmp_path / f"two{suffix}"
    assert export(snapshot, "--to", target) == 0
    (shaft, oil), _ = load_all(target)
    err = capsys.readouterr().err
    if suffix == ".uff":
        assert f"stream shaft lacks {BLOCK_ROWS} samples, 0 in the file, as a UFF file" in err
        fast = np.nan_to_num(fast)
    else:
        assert err == ""
    assert np.array_equal(shaft.samples.astype(np.float32), fast, equal_nan=True)
    assert np.array_equal(oil.samples[:, 0].astype(np.float32), slow)
    assert (shaft.names, oil.names, oil.units) == (tuple(SENSORS), tuple(SLOW), ("degC",))
    assert (shaft.rate_hz, oil.rate_hz) == pytest.approx((RATE_HZ, SLOW_HZ), rel=1e-9)
    assert shaft.start_ns == START_NS
    if suffix == ".mf4":
        assert (shaft.name, oil.name) == ("shaft", "oil")
        assert oil.start_ns == pytest.approx(START_NS + 25_000_000, abs=100)


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".wav"])
def test_streams_of_several_rates_are_a_file_each(gapped, tmp_path, capsys, suffix):
    snapshot, fast, slow = gapped
    assert export(snapshot, "--to", tmp_path / f"two{suffix}", "--json") == 0
    out, err = capsys.readouterr()
    document = fits("daqsvc.export/1", json.loads(out))
    assert [one["file"] for one in document["files"]] == [
        str(tmp_path / f"two-shaft{suffix}"),
        str(tmp_path / f"two-oil{suffix}"),
    ]
    (shaft,), (oil,) = (one["streams"] for one in document["files"])
    assert shaft == {
        "stream": "shaft",
        "channels": list(SENSORS),
        "units": list(SENSORS.values()),
        "rate_hz": RATE_HZ,
        "start_time": START,
        "samples": len(fast),
        "missing": BLOCK_ROWS,
    }
    assert oil["start_time"] == "2026-11-23T14:58:31.148456789Z"
    (read,), _ = load_all(tmp_path / f"two-shaft{suffix}")
    (read_oil,), _ = load_all(tmp_path / f"two-oil{suffix}")
    assert np.array_equal(read_oil.samples[:, 0].astype(np.float32), slow)
    if suffix == ".wav":
        assert f"stream shaft lacks {BLOCK_ROWS} samples, 0 in the file, as a WAV file" in err
        assert not read.samples[2 * BLOCK_ROWS : 3 * BLOCK_ROWS].any()
    else:
        assert err == ""
        assert np.array_equal(read.samples.astype(np.float32), fast, equal_nan=True)
    assert not (tmp_path / f"two{suffix}").exists()


def test_one_stream_by_its_name(gapped, tmp_path, capsys):
    snapshot = gapped[0]
    assert export(snapshot, "--to", tmp_path / "oil.csv", "--stream", "oil") == 0
    assert capsys.readouterr().out == f"{tmp_path / 'oil.csv'}: oil, oil-temp at 10 Hz, 6.4 s\n"
    assert export(snapshot, "--to", tmp_path / "x.csv", "--stream", "oli") == 2
    assert "has no stream 'oli'; did you mean \"oil\"? There are: oil, shaft" in capsys.readouterr().err


# The libraries of the formats read it.


def test_parquet_has_times_and_units(gapped, tmp_path):
    snapshot, fast, _ = gapped
    assert export(snapshot, "--to", tmp_path / "a.parquet", "--stream", "shaft") == 0
    table = pq.read_table(tmp_path / "a.parquet", page_checksum_verification=True)
    assert table.column_names == ["time", *SENSORS]
    assert str(table.schema.field("time").type) == "timestamp[ns, tz=UTC]"
    times = table["time"].to_numpy().astype(np.int64)
    assert times[0] == START_NS
    assert np.array_equal(times, START_NS + np.rint(np.arange(len(fast)) * 1e9 / RATE_HZ).astype(np.int64))
    for column, (name, unit) in enumerate(SENSORS.items()):
        assert table.schema.field(name).metadata == {b"unit": unit.encode()}
        assert np.array_equal(table[name].to_numpy(), fast[:, column], equal_nan=True)
    said = {key.decode(): text.decode() for key, text in table.schema.metadata.items()}
    assert said["fs_hz"] == repr(RATE_HZ)
    assert (said["start_time"], said["machine"], said["stream"]) == (START, "rig", "shaft")


def test_csv_has_one_header_below_its_comments(gapped, tmp_path):
    snapshot, fast, _ = gapped
    assert export(snapshot, "--to", tmp_path / "a.csv", "--stream", "shaft") == 0
    lines = (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()
    comments = [line for line in lines if line.startswith("#")]
    assert "# fs_hz = 3200.0" in comments
    assert "# unit of keyphasor = V" in comments
    rows = list(csv.reader(lines[len(comments) :]))
    assert rows[0] == ["time", *SENSORS]
    assert rows[1][0] == START
    read = np.array([[float(cell) for cell in row[1:]] for row in rows[1:]], np.float32)
    assert np.array_equal(read, fast, equal_nan=True)


def test_wav_is_float_in_the_units_of_the_sensors(snapshot, samples, tmp_path):
    assert export(snapshot, "--to", tmp_path / "a.wav") == 0
    rate, read = wavfile.read(tmp_path / "a.wav")
    assert (rate, read.dtype) == (RATE_HZ, np.float32)
    assert np.array_equal(read, samples)
    content = (tmp_path / "a.wav").read_bytes()
    assert struct.unpack_from("<I", content, 4) == (len(content) - 8,)
    at = content.index(b"ICMT")
    said = fits("daqsvc.wav/1", json.loads(content[at + 8 : content.index(b"\0", at + 8)]))
    assert (said["channels"], said["units"], said["start_time"]) == (
        list(SENSORS),
        list(SENSORS.values()),
        START,
    )


def test_mat_has_a_struct_for_each_stream(gapped, tmp_path):
    snapshot, fast, slow = gapped
    assert export(snapshot, "--to", tmp_path / "a.mat") == 0
    read = loadmat(tmp_path / "a.mat", squeeze_me=True, struct_as_record=False)
    shaft, oil = read["shaft"], read["oil"]
    assert (shaft.fs_hz, shaft.start_time) == (RATE_HZ, START)
    assert list(shaft.names) == list(SENSORS)
    assert list(shaft.units) == list(SENSORS.values())
    assert np.array_equal(shaft.x, fast[:, 0], equal_nan=True)
    assert (str(oil.names), str(oil.fields)) == ("oil-temp", "oil_temp")
    assert np.array_equal(oil.oil_temp, slow)
    assert read["about"].machine == "rig"


def test_uff_has_a_data_set_for_each_channel(gapped, tmp_path):
    snapshot, fast, slow = gapped
    assert export(snapshot, "--to", tmp_path / "a.uff") == 0
    sets = pyuff.UFF(str(tmp_path / "a.uff")).read_sets()
    assert [one["id1"] for one in sets] == [*SENSORS, *SLOW]
    assert [one["ordinate_axis_units_lab"] for one in sets] == [*SENSORS.values(), "degC"]
    assert {one["id3"] for one in sets} == {"23-Nov-26 14:58:31"}
    assert [one["abscissa_inc"] for one in sets] == pytest.approx([1 / RATE_HZ] * 3 + [1 / SLOW_HZ], rel=1e-5)
    assert np.array_equal(sets[1]["data"], np.nan_to_num(fast[:, 1]))
    assert np.array_equal(sets[3]["data"], slow)


def test_mdf_has_a_group_for_each_stream(gapped, tmp_path):
    snapshot, fast, slow = gapped
    assert export(snapshot, "--to", tmp_path / "a.mf4") == 0
    with asammdf.MDF(tmp_path / "a.mf4") as mdf:
        assert [group.channel_group.acq_name for group in mdf.groups] == ["shaft", "oil"]
        assert mdf.header.abs_time == START_NS
        assert mdf.start_time == datetime(2026, 11, 23, 14, 58, 31, 123457, tzinfo=UTC)
        y, temp = mdf.get("y"), mdf.get("oil-temp")
    assert (y.unit, temp.unit) == ("um", "degC")
    assert np.array_equal(y.samples, fast[:, 1], equal_nan=True)
    assert np.array_equal(temp.samples, slow)
    assert y.timestamps[[0, -1]] == pytest.approx([0.0, (len(fast) - 1) / RATE_HZ])
    assert temp.timestamps[0] == pytest.approx(0.025)


# What nobody knows is not made up.


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_recording_that_has_no_begin_and_no_units_gets_none(tmp_path, capsys, suffix):
    source = Orbit(20).save(tmp_path / "run.npz")
    target = tmp_path / f"run{suffix}"
    assert export(source, "--to", target) == 0
    (stream,), _ = load_all(target)
    assert stream.units == ("", "", "")
    assert stream.names == tuple(SENSORS)
    assert stream.rate_hz == pytest.approx(RATE_HZ, rel=1e-9)
    if suffix == ".mf4":
        assert "begins in 1970, as the recording does not state when it began" in capsys.readouterr().err
    else:
        assert stream.start_ns is None
    exact = np.float32 if suffix == ".wav" else np.float64
    assert np.array_equal(stream.samples[:, 0].astype(exact), Orbit(20).x.astype(exact))


def test_channels_get_the_names_and_units_of_a_machine_file(tmp_path, samples):
    machine = tmp_path / "machine.toml"
    assert main(["example", "rotor-synchronous", "--out", str(machine)]) == 0
    np.savez(tmp_path / "run.npz", a=samples[:, 0], other=samples[:, 1], fs=RATE_HZ)
    target = tmp_path / "run.parquet"
    assert export(machine, tmp_path / "run.npz", "--map", "probe-x=a", "--to", target) == 0
    (stream,), _ = load_all(target)
    assert (stream.names, stream.units) == (("probe-x", "other"), ("um", ""))


def test_names_that_matlab_does_not_take_come_back(tmp_path):
    names = ["shaft x", "shaft-x", "9", "names", "é", "a" * 70]
    np.savez(tmp_path / "run.npz", **{name: np.arange(9.0) + k for k, name in enumerate(names)}, fs=100.0)
    assert export(tmp_path / "run.npz", "--to", tmp_path / "run.mat") == 0
    (stream,), _ = load_all(tmp_path / "run.mat")
    assert list(stream.names) == names
    assert stream.samples[0].tolist() == list(range(len(names)))


# Refused, in one sentence.


def test_nothing_is_written_over(snapshot, tmp_path, capsys):
    target = tmp_path / "a.csv"
    target.write_text("mine")
    assert export(snapshot, "--to", target) == 2
    assert capsys.readouterr().err == (
        f"daqsvc export: {target} is there already; give another name, or --overwrite to replace it [C11]\n"
    )
    assert target.read_text() == "mine"
    assert export(snapshot, "--to", target, "--overwrite") == 0
    assert target.read_text().startswith("#")


def test_force_does_not_replace_the_recording_itself(tmp_path, capsys):
    source, link = tmp_path / "de.csv", tmp_path / "link.csv"
    source.write_text("# fs = 100\nx\n1\n2\n")
    link.symlink_to(source)
    for target in (source, link):
        assert export(source, "--to", target, "--overwrite") == 2
        assert capsys.readouterr().err == (
            f"daqsvc export: {target} is the recording itself, which nothing replaces; "
            "give another name [C11]\n"
        )
    assert source.read_text() == "# fs = 100\nx\n1\n2\n"
    assert link.is_symlink()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.paquet", r"a.paquet ends in .paquet, which selects no format: did you mean .parquet?"),
        ("a.mp3", "take one of .parquet, .csv, .wav, .mat, .uff, .mf4"),
        ("a", "has no suffix"),
        ("none/a.csv", "there is no folder"),
    ],
)
def test_a_target_that_says_no_format_is_refused(snapshot, tmp_path, capsys, name, message):
    assert export(snapshot, "--to", tmp_path / name) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("suffix", [".parquet", ".uff", ".mf4"])
def test_a_library_that_is_missing_is_named(snapshot, tmp_path, capsys, monkeypatch, suffix):
    library, extra = WRITERS[suffix].library, WRITERS[suffix].extra
    real = __import__("importlib.util").util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == library else real(name))
    assert export(snapshot, "--to", tmp_path / f"a{suffix}") == 2
    err = capsys.readouterr().err
    had("C12", err)
    assert err == (
        f"daqsvc export: {suffix} files need {library}; install it with: pip install 'daqsvc[{extra}]' "
        "[C12]\n"
    )


def test_what_cannot_be_read_ends_with_3(tmp_path, capsys):
    damaged = tmp_path / "a.mcap"
    damaged.write_bytes(b"\x89MCAP0\r\nnonsense")
    log = tmp_path / "a.blf"
    log.write_bytes(b"LOGG")
    for source in (damaged, log, tmp_path / "absent.npz", tmp_path):
        assert export(source, "--to", tmp_path / "b.csv") == 3
        err = capsys.readouterr().err
        assert err.startswith("daqsvc export: ")
        assert err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.blf", "a.mcap"]


def test_a_rate_that_wav_cannot_say_is_refused(tmp_path, capsys):
    np.savez(tmp_path / "run.npz", x=np.arange(9.0), fs=100.5)
    assert export(tmp_path / "run.npz", "--to", tmp_path / "run.wav") == 3
    assert "has 100.5 samples a second, and a WAV file holds whole numbers only" in capsys.readouterr().err
    assert not (tmp_path / "run.wav").exists()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_full_disk_leaves_nothing_half(snapshot, tmp_path, capsys, suffix):
    with mounted(tmp_path / "small", "64k") as disk:
        disk.fill()
        target = disk.directory / f"a{suffix}"
        assert export(snapshot, "--to", target) == 1
        assert (
            capsys.readouterr().err
            == f"daqsvc export: {target} is not written: No space left on device [C09]\n"
        )
        assert [path.name for path in disk.directory.iterdir()] == ["somebody-else"]


def test_a_kill_leaves_nothing_half_under_the_name(tmp_path):
    source = tmp_path / "long.npz"
    np.savez(source, x=np.zeros(3_000_000, np.float32), fs=1000.0)
    target = tmp_path / "long.csv"
    running = subprocess.Popen([sys.executable, "-m", "daqsvc", "export", source, "--to", target])
    try:
        while running.poll() is None and not any(
            file.stat().st_size for file in tmp_path.glob(".daqsvc-export-*/long.csv")
        ):
            time.sleep(0.005)
    finally:
        running.kill()
        running.wait()
    assert running.returncode == -signal.SIGKILL  # it was at it, and had not ended by itself
    (half,) = tmp_path.glob(".daqsvc-export-*/long.csv")
    assert 0 < half.stat().st_size < 3_000_000 * len("0.0,0\n")
    assert not target.exists()


# CAN logs: see tests/offline/test_recorded_by_daqsvc.py.


def test_a_log_needs_its_machine_file(tmp_path, capsys):
    log = tmp_path / "a.log"
    with can.Logger(log) as logger:
        logger.on_message_received(can.Message(arbitration_id=1, timestamp=1.0))
    assert export(log, "--to", tmp_path / "a.csv") == 3
    assert "only the layouts of a machine file make sense of" in capsys.readouterr().err
