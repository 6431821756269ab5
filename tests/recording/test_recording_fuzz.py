"""Whatever a recording is made of, the answer is one line in bounded memory, and the others are judged."""

from __future__ import annotations

import json
from pathlib import Path

import can
import numpy as np
import pytest
from support import damaged_recordings
from support.examples import ALL, first_of
from support.fuzz_bytes import mutated
from support.orbit_files import OPTIONS, Orbit
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.offline.can_logs import load_can_log
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import load_recording, shared, stop_reading
from daqsvc.settings import load_machine_file
from drivers.can.plugin import frame_layout

pytestmark = pytest.mark.property
MACHINE = ROOT / "config" / "machines" / "rotor-synchronous.toml"
MOST_MB = 450
"""Of the process that reads, with NumPy, SciPy and Arrow in it."""
LOGS = [".blf", ".asc", ".log", ".trc"]


def answer(path):
    """Why a file is refused; empty if it is not. Any other exception than that fails the test."""
    try:
        recording = load_recording(path, rate_hz=damaged_recordings.RATE_HZ)
    except RecordingError as error:
        message = str(error)
    else:
        assert recording.samples.dtype == np.float64
        return ""
    assert "\n" not in message
    assert message.startswith((str(path), f"the sampling rate of {path}"))
    assert len(message) < 6000
    return message


def largest_mb():
    if shared._running is None:
        return 0.0
    status = Path(f"/proc/{shared._running.process.pid}/status").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1e3


def fuzz(folder, ending, tries, seed):
    rng = np.random.default_rng(seed)
    path = folder / f"spoilt{ending}"
    refused = 0
    for _ in range(tries):
        path.write_bytes(damaged_recordings.spoilt(rng, ending))
        refused += bool(answer(path))
        assert largest_mb() < MOST_MB
    assert refused > tries // 4


@pytest.mark.parametrize("ending", damaged_recordings.SOUND)
def test_spoilt_recordings(tmp_path, ending):
    fuzz(tmp_path, ending, 150, 11)


@pytest.mark.long
@pytest.mark.marathon
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("ending", damaged_recordings.SOUND)
def test_many_spoilt_recordings(tmp_path, ending):
    fuzz(tmp_path, ending, 5_000, 12)


STRUCTURES = damaged_recordings.structures()


@pytest.mark.parametrize("name", STRUCTURES)
def test_structures_that_lie(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(STRUCTURES[name])
    assert answer(path) or name in {"nan.csv", "nulls.parquet", "ragged.csv"}
    assert largest_mb() < MOST_MB


def test_no_pickle_is_loaded(tmp_path):
    trace = tmp_path / "trace"
    for name, content in damaged_recordings.pickles(trace).items():
        path = tmp_path / name
        path.write_bytes(content)
        answer(path)
        assert not trace.exists(), name


@pytest.mark.parametrize("jobs", first_of(2, 1))
def test_damaged_recordings_cost_a_line_each(tmp_path, capsys, jobs):
    stop_reading()
    sound = Orbit().save(tmp_path / "sound.npz")
    spoilt = []
    for name in [*STRUCTURES][:: 1 if ALL else 3]:
        spoilt.append(tmp_path / name)
        spoilt[-1].write_bytes(STRUCTURES[name])
    files = [*spoilt[:10], sound, *spoilt[10:]]
    code = main(["analyze", *map(str, files), *OPTIONS, "--json", "--jobs", str(jobs)])
    captured = capsys.readouterr()
    said = [json.loads(line) for line in captured.out.splitlines()]
    assert (code, captured.err) == (3, "")
    assert [one["recording"] for one in said] == list(map(str, files))
    assert [one["recording"] for one in said if one["refused"] is None] == [str(sound)]
    assert said[10]["verdict"] == "normal"


def frames():
    """A second of a healthy machine's bus."""
    layout = frame_layout(load_machine_file(MACHINE), "shaft")
    samples = np.random.default_rng(3).normal(size=(160, 10, 3)).astype(np.float32)
    payloads = layout.encode(10 * np.arange(160), samples)
    return [
        can.Message(
            timestamp=1.7e9 + k / 160,
            arbitration_id=layout.frame_id,
            is_extended_id=False,
            is_fd=True,
            channel="can0",
            data=payload.tobytes(),
        )
        for k, payload in enumerate(payloads)
    ]


def fuzz_log(folder, ending, tries, seed):
    machine = load_machine_file(MACHINE)
    sound = damaged_recordings.can_log(ending, frames(), folder)
    path = folder / f"spoilt{ending}"
    rng = np.random.default_rng(seed)
    for _ in range(tries):
        path.write_bytes(mutated(rng, sound))
        try:
            samples = load_can_log(machine, str(path)).samples
        except RecordingError as error:
            message = str(error)
        else:
            assert samples.nbytes < 10e6
            continue
        assert "\n" not in message
        assert str(path) in message


@pytest.mark.parametrize("ending", LOGS)
def test_spoilt_can_logs(tmp_path, ending):
    fuzz_log(tmp_path, ending, 30, 13)


@pytest.mark.long
@pytest.mark.marathon
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("ending", LOGS)
def test_many_spoilt_can_logs(tmp_path, ending):
    fuzz_log(tmp_path, ending, 2000, 14)
