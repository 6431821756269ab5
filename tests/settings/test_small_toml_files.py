"""Calibrations, healthy states of bearings and scenarios, spoilt by people and disks: one message each."""

from __future__ import annotations

import os
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from support.fuzz_bytes import mutated
from support.orbit_files import RATE_HZ, SPEED_RPM, Orbit
from support.race_signals import BEARING, strikes

import sim_hw.scenario
from daqsvc.bearing.baseline import BaselineFileError, load_bearing_baseline, save_bearing_baseline
from daqsvc.detectors.bearing.calibrating import HealthyRun
from daqsvc.detectors.bearing.verdict import BearingSetup
from daqsvc.detectors.rotor_synchronous.recorded import analyse
from daqsvc.detectors.rotor_synchronous.recorded_speed import KeyphasorChannel, RotorSetup
from daqsvc.recording.recording import Recording
from daqsvc.rotor.calibration.file import CalibrationFileError, load_record, save_calibration
from daqsvc.rotor.laval import LavalRotor
from sim_hw.scenario import ScenarioError, load_any_scenario

pytestmark = pytest.mark.property
SCENARIO = Path(sim_hw.scenario.__file__).parent / "scenarios" / "paper.toml"


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A sound file of each kind, how it is read, and the one error that may come."""
    folder = tmp_path_factory.mktemp("sound")
    orbit = Orbit(60)
    recording = Recording(
        ("x", "y", "k"), np.column_stack([orbit.x, orbit.y, orbit.keyphasor]), RATE_HZ, folder, 0
    )
    rotor = LavalRotor(natural_frequency_hz=60.0, damping_ratio=0.1)
    setup = RotorSetup(probes=("x", "y"), rotor=rotor, speed_rpm=SPEED_RPM, keyphasor=KeyphasorChannel("k"))
    save_calibration(analyse(recording, setup).calibration, folder / "rotor.toml")
    bearing = BearingSetup(channels=("de",), speed_rpm=1797.0, bearings={"de": BEARING})
    healthy = Recording(("de",), strikes(None, 12.0)[:, None], 12_000.0, folder, 0)
    save_bearing_baseline(HealthyRun(bearing, healthy).at(healthy.rate_hz), folder / "bearing.toml")
    return {
        "rotor": ((folder / "rotor.toml").read_bytes(), load_record, CalibrationFileError),
        "bearing": ((folder / "bearing.toml").read_bytes(), load_bearing_baseline, BaselineFileError),
        "scenario": (SCENARIO.read_bytes(), load_any_scenario, ScenarioError),
    }


KINDS = ["rotor", "bearing", "scenario"]


def spoilt(rng, content):
    """A value of another kind or size in place of one, or damaged bytes."""
    if rng.random() < 0.3:
        return mutated(rng, content)
    places = [match.span(1) for match in re.finditer(rb"= ?([^\n=,{}\[\]]+)", content)]
    begin, end = places[int(rng.integers(len(places)))]
    values = [
        b"0",
        b"-1",
        b"1e308",
        b"-1e-320",
        b"inf",
        b"nan",
        b'"x"',
        b"[]",
        b"{}",
        b"true",
        b"9" * 400,
        b"1979-05-27",
    ]
    return content[:begin] + values[int(rng.integers(len(values)))] + content[end:]


def read(path, load, error):
    try:
        load(path)
    except error as caught:
        message = str(caught)
    else:
        return ""
    assert str(path) in message
    assert message.count("\n") < 100
    return message


def fuzz(sound, kind, tmp_path, tries, seed):
    content, load, error = sound[kind]
    path = tmp_path / "spoilt.toml"
    rng = np.random.default_rng(seed)
    refused = 0
    for _ in range(tries):
        path.write_bytes(spoilt(rng, content))
        refused += bool(read(path, load, error))
    assert refused > tries // 4


@pytest.mark.parametrize("kind", KINDS)
def test_spoilt_files(sound, kind, tmp_path):
    fuzz(sound, kind, tmp_path, 150, 1)


@pytest.mark.long
@pytest.mark.marathon
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", KINDS)
def test_many_spoilt_files(sound, kind, tmp_path):
    fuzz(sound, kind, tmp_path, 10_000, 2)


HOSTILE = {
    "key of parts": b"a" + b".a" * 100_000 + b" = 1\n",
    "header of parts": b"[a" + b".a" * 100_000 + b"]\n",
    "brackets": b"a = " + b"[" * 100_000,
    "tables": b"a = " + b"{b = " * 900 + b"1" + b"}" * 900,
    "depth": b"a = " + b"[" * 40 + b"]" * 40,
    "digits": b"schema_version = " + b"9" * 100_000,
    "blanks": b" " * 9_000_000,
    "no text": bytes(range(256)),
    "nothing": b"",
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files(sound, kind, name, tmp_path):
    _, load, error = sound[kind]
    path = tmp_path / "hostile.toml"
    path.write_bytes(HOSTILE[name])
    tracemalloc.start()
    try:
        assert read(path, load, error)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_file(sound, kind, tmp_path):
    _, load, error = sound[kind]
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "absent", Path("/dev/zero")):
        assert read(path, load, error)
