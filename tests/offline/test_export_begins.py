"""Streams that begin one after another keep their begins in what `daqsvc export` writes."""

from __future__ import annotations

import asammdf
import numpy as np
import pytest
from support.snapshot_files import Sampled, write_snapshot

from daqsvc.cli import main
from daqsvc.confined.process import shared
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import get_limits, load_all, load_recording, load_streams
from daqsvc.recording.streams import ns_of_iso
from daqsvc.recording.writers import WRITERS

pytestmark = pytest.mark.integration
START_NS = 1_795_445_911_123_456_789
RATE_HZ, TONE_HZ, BEHIND_NS = 1000.0, 5.0, 40_000_000
FORMATS = [".mat", ".uff", ".mf4"]


def tone(behind_ns=0, rows=640):
    """What a sensor feels from then on."""
    t_s = np.arange(rows) / RATE_HZ + behind_ns / 1e9
    return np.sin(2 * np.pi * TONE_HZ * t_s).astype(np.float32)[:, None]


@pytest.fixture
def late(tmp_path):
    """Two streams of one rate that feel the same; the second begins later."""
    streams = {
        "a": Sampled(RATE_HZ, {"pa": "um"}, tone()),
        "b": Sampled(RATE_HZ, {"pb": "um"}, tone(BEHIND_NS), behind_ns=BEHIND_NS),
    }
    return write_snapshot(tmp_path / "late.mcap", streams, START_NS)


def export(*arguments):
    return main(["export", *map(str, arguments)])


@pytest.mark.parametrize("suffix", FORMATS)
def test_streams_of_one_rate_stay_in_step(late, tmp_path, suffix):
    target = tmp_path / f"late{suffix}"
    assert export(late, "--to", target) == 0
    expected = load_recording(late, {"pa": "pa", "pb": "pb"})
    for channels in ({"pa": "pa", "pb": "pb"}, None):
        found = load_recording(target, channels)
        assert np.array_equal(found.samples, expected.samples)
        assert found.samples[:, 0] == pytest.approx(found.samples[:, 1], abs=1e-5)
    begun_ns = ns_of_iso(found.texts["start_time"])
    assert begun_ns == pytest.approx(START_NS + BEHIND_NS, abs=100)
    alone = load_recording(target, {"pa": "pa"})
    assert len(alone.samples) == 640
    [(replayed, _)] = load_streams(target, [({"pa": "pa", "pb": "pb"}, RATE_HZ)], get_limits(), shared)
    assert np.array_equal(replayed, expected.samples)


@pytest.mark.parametrize("suffix", FORMATS)
def test_each_stream_keeps_its_begin(late, tmp_path, suffix):
    target = tmp_path / f"late{suffix}"
    assert export(late, "--to", target) == 0
    streams, notes = load_all(target)
    assert notes == []
    assert [one.names for one in streams] == [("pa",), ("pb",)]
    assert [one.start_ns for one in streams] == pytest.approx([START_NS, START_NS + BEHIND_NS], abs=100)
    assert [len(one.samples) for one in streams] == [640, 640]


@pytest.mark.parametrize("suffix", [".mat", ".uff"])
def test_streams_of_two_rates_keep_their_begins(tmp_path, suffix):
    streams = {
        "a": Sampled(RATE_HZ, {"pa": "um"}, tone()),
        "b": Sampled(10.0, {"pb": "um"}, tone()[:64], behind_ns=BEHIND_NS),
    }
    source = write_snapshot(tmp_path / "rates.mcap", streams, START_NS)
    assert export(source, "--to", tmp_path / f"rates{suffix}") == 0
    found, _ = load_all(tmp_path / f"rates{suffix}")
    assert [one.start_ns for one in found] == [START_NS, START_NS + BEHIND_NS]


@pytest.mark.parametrize("suffix", FORMATS)
def test_streams_without_a_time_in_common_are_refused_together(tmp_path, suffix):
    far_ns = 3_600_000_000_000
    streams = {
        "a": Sampled(RATE_HZ, {"pa": "um"}, tone()),
        "b": Sampled(RATE_HZ, {"pb": "um"}, tone(), behind_ns=far_ns),
    }
    source = write_snapshot(tmp_path / "far.mcap", streams, START_NS)
    target = tmp_path / f"far{suffix}"
    assert export(source, "--to", target) == 0
    with pytest.raises(RecordingError, match="one begins after another has ended"):
        load_recording(target, {"pa": "pa", "pb": "pb"})
    assert len(load_recording(target, {"pb": "pb"}).samples) == 640


def test_groups_of_a_loggers_mdf_file_stay_in_step(tmp_path):
    """Not written by daqsvc; a begin that is less than half a sample later shifts nothing."""
    target = tmp_path / "logger.mf4"
    with asammdf.MDF(version="4.10") as mdf:
        for name, behind_s in (("pa", 0.0), ("pb", 0.04), ("pc", 0.0004)):
            samples = tone(round(behind_s * 1e9))[:, 0]
            times = behind_s + np.arange(len(samples)) / RATE_HZ
            mdf.append([asammdf.Signal(samples, times, "um", name)], acq_name=name, common_timebase=True)
        mdf.save(target)
    found = load_recording(target, {"pa": "pa", "pb": "pb"}).samples
    assert found[:, 0] == pytest.approx(found[:, 1], abs=1e-5)
    near = load_recording(target, {"pa": "pa", "pc": "pc"}).samples
    assert np.array_equal(near, np.column_stack([tone()[:, 0], tone(400_000)[:, 0]]))


def test_a_begin_before_1970_is_said_to_be_lost_in_mdf(tmp_path, capsys):
    np.savez(tmp_path / "old.npz", x=np.arange(100.0), fs=100.0, start_time="1969-07-20T20:17:40Z")
    for suffix in WRITERS:
        assert export(tmp_path / "old.npz", "--to", tmp_path / f"old{suffix}") == 0
        (stream,), _ = load_all(tmp_path / f"old{suffix}")
        assert stream.start == ("1970-01-01" if suffix == ".mf4" else "1969-07-20") + stream.start[10:]
    assert "old.mf4: begins in 1970, as no MDF file begins before" in capsys.readouterr().err
