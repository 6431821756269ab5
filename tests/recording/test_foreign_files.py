"""TDMS, MDF 4, UFF 58 and HDF5 files, written by the libraries of these formats."""

from __future__ import annotations

import os
import sys

import asammdf
import h5py
import nptdms
import numpy as np
import pytest
from support.foreign_files import WRITERS, write_uff_of

from daqsvc.confined.limits import Budget, ResourceLimits
from daqsvc.recording import RecordingError
from daqsvc.recording.formats import READERS
from daqsvc.recording.formats.hdf5 import read_hdf5
from daqsvc.recording.recording import list_channels, load_all, load_recording

RATE_HZ = 51_200.0
SAMPLES = np.random.default_rng(8).normal(size=(300, 2)).astype(np.float32)
CHANNELS = {"de": SAMPLES[:, 0], "fe": SAMPLES[:, 1]}


@pytest.mark.parametrize("ending", WRITERS)
def test_what_a_library_writes_is_read(tmp_path, ending):
    path = tmp_path / f"rig{ending}"
    WRITERS[ending](path, CHANNELS, RATE_HZ, "m/s2")
    folder = "run/" if ending == ".h5" else ""
    recording = load_recording(path, {"a": f"{folder}de", "b": f"{folder}fe"})
    assert np.array_equal(recording.samples, SAMPLES)
    assert recording.rate_hz == pytest.approx(RATE_HZ, rel=1e-9)
    assert recording.units == {"a": "m/s2", "b": "m/s2"}
    assert recording.texts["start_time"].startswith(("2026-01-31T12:00:00", "31-Jan-26 12:00:00"[:9]))
    assert load_recording(path).names == (f"{folder}de", f"{folder}fe")
    assert list(list_channels(path)) == [f"{folder}de", f"{folder}fe"]
    with pytest.raises(
        RecordingError, match=r"51200 Hz .* by the file and 25600 Hz as given: leave --fs out"
    ):
        load_recording(path, rate_hz=25_600.0)


NEEDED = {
    ".tdms": "nptdms",
    ".mf4": "asammdf",
    ".uff": "pyuff",
    ".unv": "pyuff",
    ".h5": "h5py",
    ".hdf5": "h5py",
}


@pytest.mark.parametrize("ending", NEEDED)
def test_a_library_that_is_missing_is_named(tmp_path, monkeypatch, ending):
    monkeypatch.setitem(sys.modules, NEEDED[ending], None)
    path = tmp_path / f"rig{ending}"
    path.write_bytes(b"MDF     4.10    ")
    with pytest.raises(RecordingError) as refused:
        READERS[ending](path, None)
    assert str(refused.value) == (
        f"{path} needs {NEEDED[ending]}; install it with: pip install 'daqsvc[formats]'"
    )


# TDMS.


def test_tdms_channels_of_one_name_are_told_apart_by_their_groups(tmp_path):
    path = tmp_path / "rig.tdms"
    with nptdms.TdmsWriter(path) as writer:
        for group, step in (("fast", 1e-4), ("slow", 1e-2)):
            samples = SAMPLES[: 200 if group == "fast" else 20, 0]
            writer.write_segment([nptdms.ChannelObject(group, "x", samples, {"wf_increment": step})])
    assert list_channels(path) == {"fast/x": 200, "slow/x": 20}
    assert load_recording(path).rate_hz == 10_000.0
    assert load_recording(path, {"x": "slow/x"}).rate_hz == 100.0


def test_a_tdms_index_beside_the_file_is_not_believed(tmp_path):
    other, path = tmp_path / "other.tdms", tmp_path / "rig.tdms"
    WRITERS[".tdms"](other, {"y": np.zeros(7)}, 10.0, "V")
    WRITERS[".tdms"](path, CHANNELS, RATE_HZ, "V")
    other.rename(tmp_path / "rig.tdms_index")
    assert load_recording(path).names == ("de", "fe")


def test_tdms_channels_of_text_are_no_channels(tmp_path):
    path = tmp_path / "rig.tdms"
    with nptdms.TdmsWriter(path) as writer:
        note = nptdms.ChannelObject("run", "note", ["a", "b", "c"])
        writer.write_segment([nptdms.ChannelObject("run", "x", SAMPLES[:, 0]), note])
    assert load_recording(path, rate_hz=100.0).names == ("x",)


# MDF 4.


def test_mdf_samples_that_are_invalid_are_missing(tmp_path):
    path = tmp_path / "rig.mf4"
    invalid = np.zeros(300, bool)
    invalid[10:13] = True
    times = np.arange(300) / RATE_HZ
    with asammdf.MDF(version="4.10") as mdf:
        mdf.append([asammdf.Signal(SAMPLES[:, 0], times, name="x", invalidation_bits=invalid)])
        mdf.save(path)
    recording = load_recording(path)
    assert np.flatnonzero(np.isnan(recording.samples[:, 0])).tolist() == [10, 11, 12]
    assert "read as seconds" in recording.rate_source


def test_mdf_conversions_and_groups_at_several_rates(tmp_path):
    path = tmp_path / "rig.mf4"
    counts = np.arange(300, dtype=np.int16)
    with asammdf.MDF(version="4.10") as mdf:
        mdf.append([asammdf.Signal(counts, np.arange(300) / 1e4, "g", "x", conversion={"a": 0.5, "b": -3.0})])
        mdf.append([asammdf.Signal(counts, np.arange(300) / 1e2, "g", "x")])
        mdf.save(path)
    recording = load_recording(path, {"x": "group 0/x"})
    assert np.array_equal(recording.samples[:, 0], counts * 0.5 - 3.0)
    assert recording.rate_hz == pytest.approx(1e4)
    assert load_recording(path, {"x": "group 1/x"}).rate_hz == pytest.approx(1e2)


def test_mdf_files_that_are_unfinished_or_older_are_told(tmp_path):
    path = tmp_path / "rig.mf4"
    WRITERS[".mf4"](path, CHANNELS, RATE_HZ, "V")
    content = path.read_bytes()
    path.write_bytes(b"UnFinMF " + content[8:])
    with pytest.raises(RecordingError, match="the logger has not finished it"):
        load_recording(path)
    path.write_bytes(b"MDF     3.30" + content[12:])
    with pytest.raises(RecordingError, match="is not an MDF 4 file"):
        load_recording(path)


# UFF 58.


@pytest.mark.parametrize(("binary", "force"), [(0, "ASCII"), (1, "binary")])
def test_uff_ascii_and_binary(tmp_path, binary, force):
    path = tmp_path / "rig.unv"
    write_uff_of(path, CHANNELS, RATE_HZ, "g", binary=binary)
    recording = load_recording(path)
    assert np.allclose(recording.samples, SAMPLES, rtol=1e-7), force
    assert recording.rate_hz == RATE_HZ


def test_uff_with_uneven_abscissa_has_gaps(tmp_path):
    path = tmp_path / "rig.uff"
    kept = np.r_[0:100, 103:300]
    write_uff_of(path, {"x": SAMPLES[kept, 0]}, RATE_HZ, "g", binary=1, abscissa_spacing=0, x=kept / RATE_HZ)
    recording = load_recording(path)
    assert np.flatnonzero(np.isnan(recording.samples[:, 0])).tolist() == [100, 101, 102]


def test_uff_functions_that_share_a_header_are_named_by_node_and_direction(tmp_path):
    path = tmp_path / "rig.uff"
    write_uff_of(path, CHANNELS, RATE_HZ, "g", id1="run 3", rsp_dir=-2)
    assert load_recording(path).names == ("1-Y", "2-Y")


def test_uff_spectra_are_no_channels(tmp_path):
    path = tmp_path / "rig.uff"
    write_uff_of(path, CHANNELS, RATE_HZ, "g", func_type=2, abscissa_spec_data_type=18)
    with pytest.raises(RecordingError, match=r"no numeric channel; it holds de \(not numeric\)"):
        load_recording(path)


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize(("part", "cut"), [(0.3, 1), (0.8, 2), (1.0, 2)])
def test_a_uff_that_is_cut_is_said_to_be(tmp_path, binary, part, cut):
    path = tmp_path / "rig.uff"
    write_uff_of(path, CHANNELS, RATE_HZ, "g", binary=binary)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole)) - 2])
    with pytest.raises(RecordingError, match=f"data set {cut} of it begins and does not end; it is cut"):
        load_recording(path)


# HDF5.


def test_hdf5_scales_records_and_matrices(tmp_path):
    path = tmp_path / "rig.hdf5"
    times = np.arange(300) / 2e3
    table = np.rec.fromarrays([SAMPLES[:, 0], np.arange(300)], names="x,n")
    with h5py.File(path, "w") as file:
        file["a/clock"] = times
        file["a/x"] = SAMPLES[:, 0]
        file["a/clock"].make_scale("t")
        file["a/x"].dims[0].attach_scale(file["a/clock"])
        file["b/time"] = times / 2
        file["b/pair"] = SAMPLES
        file["table"] = table
        file["table"].attrs["dt"] = 1e-3
        file["cube"] = np.zeros((3, 3, 3))
    assert load_recording(path, {"x": "a/x"}).rate_hz == pytest.approx(2e3)
    pair = load_recording(path, {"x": "b/pair[1]"})
    assert pair.rate_hz == pytest.approx(4e3)
    assert np.array_equal(pair.samples[:, 0], SAMPLES[:, 1])
    assert load_recording(path, {"x": "table.x"}).rate_hz == 1e3
    assert "cube" not in list_channels(path)
    assert "a/clock" not in list_channels(path)


def test_hdf5_reads_no_other_file(tmp_path):
    """What lies in other files, as raw bytes or behind a link, stays there."""
    secret = tmp_path / "secret"
    secret.write_bytes(np.arange(64.0).tobytes())
    other, path = tmp_path / "other.h5", tmp_path / "rig.h5"
    with h5py.File(other, "w") as file:
        file["x"] = np.arange(64.0)
    layout = h5py.VirtualLayout((64,), "f8")
    layout[:] = h5py.VirtualSource(str(other), "x", (64,))
    with h5py.File(path, "w") as file:
        file.create_dataset("raw", (64,), "f8", external=[(str(secret), 0, 512)])
        file.create_virtual_dataset("virtual", layout)
        file["link"] = h5py.ExternalLink(str(other), "x")
        file["own"] = np.arange(64.0)
    assert list(list_channels(path)) == ["own"]


def test_hdf5_that_says_more_than_it_holds_takes_no_memory(tmp_path):
    path = tmp_path / "rig.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("x", (10**11,), "f8", chunks=(1000,))
    with pytest.raises(RecordingError, match="claims to unpack to 800 GB"):
        load_recording(path, rate_hz=RATE_HZ)


def test_hdf5_that_nobody_wants_may_say_more_than_it_holds(tmp_path):
    path = tmp_path / "rig.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("huge", (10**11,), "f8", chunks=(1000,))
        file.create_dataset("table", (10**11,), [("x", "f4"), ("y", "f4")], chunks=(1000,))
        file.create_dataset("square", (10**9, 2), "f8", chunks=(1000, 2))
        file["run/accel"] = SAMPLES
        file["run/time"] = np.arange(len(SAMPLES)) / RATE_HZ
    there = list_channels(path)
    assert (there["huge"], there["table.x"], there["square[1]"]) == (10**11, 10**11, 10**9)
    assert there["run/accel[1]"] == len(SAMPLES)
    recording = load_recording(path, {"x": "run/accel[1]"})
    assert np.array_equal(recording.samples[:, 0], SAMPLES[:, 1])
    assert recording.rate_hz == pytest.approx(RATE_HZ)
    (stream,), notes = load_all(path, {"x": "run/accel[1]"})
    assert stream.names == ("run/accel[0]", "x")
    assert notes == ["left out huge, square[0], square[1], table.x, table.y: too large to be read"]
    with pytest.raises(RecordingError, match="claims to unpack to 800 GB"):
        load_recording(path, {"x": "huge"})


def test_hdf5_loads_no_code_to_unpack_what_it_holds(tmp_path, monkeypatch):
    monkeypatch.delenv("HDF5_PLUGIN_PRELOAD", raising=False)
    path = tmp_path / "rig.h5"
    WRITERS[".h5"](path, CHANNELS, RATE_HZ, "V")
    read_hdf5(path, Budget.of(path, ResourceLimits()))
    assert os.environ["HDF5_PLUGIN_PRELOAD"] == "::"
