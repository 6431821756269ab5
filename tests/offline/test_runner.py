"""The runner, and the machine file that options make for it."""

from __future__ import annotations

import argparse
import pickle
from typing import TYPE_CHECKING

import pytest
from support.machine_files import MACHINES
from support.orbit_files import SPEED_RPM, Orbit

from daqsvc.commands.recording_options import add_analyze_options
from daqsvc.detectors.bearing.recorded import RecordedBearings
from daqsvc.detectors.rotor_synchronous.recorded import RecordedRotor
from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous
from daqsvc.diagnosis.recorded import RecordingOptions
from daqsvc.offline.machine_options import bearing_machine, recording_options, rotor_machine
from daqsvc.offline.runner import Runner
from daqsvc.settings import load_machine_file

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.settings import MachineFile

made: list[int] = []


def counted() -> MachineFile:
    made.append(1)
    return load_machine_file(MACHINES / "rotor-synchronous.toml")


def told(*options: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_analyze_options(parser)
    return parser.parse_args(["a.npz", *options])


ROTOR = ("--natural-frequency-hz", "60", "--damping-ratio", "0.1")


def test_another_process_makes_the_machine_file_once_for_all_its_recordings(tmp_path: Path) -> None:
    made.clear()
    runner = Runner(counted, RecordingOptions(rate_hz=1000.0))
    runner.prepare()
    there = pickle.loads(pickle.dumps(runner))  # noqa: S301 - made here
    assert len(made) == 1
    outcomes = [there.judge(Orbit(30, seed=seed).save(tmp_path / f"{seed}.npz"), None) for seed in range(3)]
    assert [outcome.refused for outcome in outcomes] == [True, True, True]
    assert len(made) == 2


def test_options_of_probes_are_the_table_of_the_calibrated_rotor() -> None:
    options = told("--probes", "x,y", "--keyphasor", "k", *ROTOR, "--map", "k=pulses", "--ac-coupled")
    machine = rotor_machine(options)
    given = machine.pipeline.table(RotorSynchronous)
    assert given is not None
    assert (given.probes, given.reference, given.calibrate_revolutions) == (("x", "y"), "keyphasor", 50)
    assert [sensor.channel for sensor in machine.sensors] == ["x", "y", "pulses"]
    detectors = Runner(lambda: machine, recording_options(options, in_memory=True)).detectors
    assert list(detectors) == ["rotor_synchronous"]
    rotor = detectors["rotor_synchronous"]
    assert isinstance(rotor, RecordedRotor)
    # What the recording has to tell is not known yet.
    assert rotor.setup.speed_rpm is None
    assert rotor.setup.keyphasor is not None
    assert (rotor.setup.keyphasor.threshold, rotor.setup.keyphasor.hysteresis) == (None, None)
    assert rotor.setup.ac_coupled
    assert rotor.setup.rotor.natural_frequency_tolerance == 0.2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--keyphasor", "k", "--speed-rpm", "orbit:600"), "either from the keyphasor or from the orbit"),
        (("--speed-rpm", "600", "--map", "x=a,y=a"), "different channels of the recording"),
    ],
)
def test_options_that_contradict_each_other_make_no_machine(options: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rotor_machine(told("--probes", "x,y", *ROTOR, *options))


def test_options_of_bearings_are_a_bearing_for_each_channel() -> None:
    options = told(
        "--channels", "de,nde", "--bearing", "6205-2RS", "--speed-rpm", f"-{SPEED_RPM}", "--unit", "V"
    )
    machine = bearing_machine(options)
    given = recording_options(options, in_memory=True, patterns=True)
    [bearings] = Runner(lambda: machine, given).detectors.values()
    assert isinstance(bearings, RecordedBearings)
    verdict = bearings.not_judged("a.npz", "for a test")
    assert (verdict.setup.channels, verdict.setup.unit) == (("de", "nde"), "V")
    assert verdict.setup.speed_rpm == SPEED_RPM
    assert verdict.setup.bearings["nde"].inner == pytest.approx(5.415, abs=0.01)
    assert verdict.setup.designations == {"de": "6205-2RS", "nde": "6205-2RS"}
