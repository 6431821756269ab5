"""What ``daqsvc sim`` can be asked for, and what it says to what it cannot do."""

from __future__ import annotations

import argparse
import re
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from support.machine_files import MACHINES, MOTOR
from support.sim_processes import DOCUMENTATION, PER_FRAME, SCENARIOS, VIRTUAL_RIG

from daqsvc.cli import main
from daqsvc.recording.recording import Recording
from daqsvc.settings import load_machine_file
from sim_hw.scenario import Scenario, builtin_scenarios, load_any_scenario, load_scenario
from sim_hw.sim_command import SimCommand, _misuse, _script
from sim_hw.sim_signals import (
    BearingSignals,
    RecordedSignals,
    RotorSignals,
    SignalError,
    resampled,
    stream_samples,
)

pytestmark = pytest.mark.integration


def test_every_scenario_that_comes_along_can_be_read_and_says_what_goes_wrong() -> None:
    every = {path.stem: load_any_scenario(path) for path in SCENARIOS.glob("*.toml")}
    assert set(every) == {"bad-bus", "bearing-damage"}
    faults = every["bad-bus"].node_faults()
    assert faults is not None
    counts = faults.plan(19_200, 640.0, samples_per_frame=PER_FRAME, length=64).injected()
    nothing = [name for name, count in asdict(counts).items() if not count]
    assert not nothing
    # The documentation has each of them.
    table = DOCUMENTATION.read_text().split("| `kind` |")[1]
    named = re.findall(r"^\| `([a-z-]+)` \|", table, flags=re.MULTILINE)
    assert sorted(named) == sorted({fault.kind for fault in every["bad-bus"].fault})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "name a machine file or a scenario to play, or a bus to run"),
        (("paper", "--fs", "100"), "--fs goes with a recording"),
        (("paper", "--port", "70000"), "70000 is not a TCP port"),
        (
            ("nothing",),
            "there is no scenario 'nothing': neither a file nor one of healthy",
        ),
        ((VIRTUAL_RIG, "--stream", "wave"), "has no stream 'wave'; there are shaft"),
        ((SCENARIOS / "bearing-damage.toml",), "a bearing needs sensors"),
        (
            (VIRTUAL_RIG, "--scenario", SCENARIOS / "bearing-damage.toml"),
            "sensor 'probe-x' is of type 'proximity', and a bearing scenario gives accelerometers",
        ),
        (
            (MOTOR,),
            "sensor 'accel-de' is of type 'accelerometer', and a rotor scenario gives proximity probes",
        ),
        ((VIRTUAL_RIG, "--bus", "/nowhere/can0", "--duration", "1"), "no bus can be made at /nowhere/can0"),
        ((VIRTUAL_RIG, "--bus", "can-short", "--duration", "0.005"), "4 samples do not fill one frame 0x101"),
        ((MOTOR, "--recording", "nothing.npz", "--seed", "3"), "name a scenario too with --scenario"),
    ],
)
def test_what_cannot_be_played_says_why(
    arguments: tuple[object, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code: object = main(["sim", *map(str, arguments)])
    except SystemExit as usage:
        code = usage.code
    assert code in {1, 2}
    output, errors = capsys.readouterr()
    assert message in errors
    assert "Traceback" not in errors
    assert output == ""


@pytest.mark.parametrize("machine", sorted(MACHINES.glob("*.toml")), ids=lambda path: path.stem)
def test_any_machine_plays_any_scenario_or_says_in_a_sentence_what_to_do(machine: Path) -> None:
    described = load_machine_file(machine)
    for name in [*builtin_scenarios(), *sorted(SCENARIOS.glob("*.toml"))]:
        scenario = load_any_scenario(name)
        rotor = isinstance(scenario, Scenario)
        signals = RotorSignals(scenario, 0.5) if rotor else BearingSignals(scenario, 0.5)
        played, refused = [], "with --stream"
        try:
            played = [stream_samples(described, stream, signals) for stream in described.streams]
        except SignalError as error:
            refused = str(error)
        assert "with --stream" in refused, name
        assert "\n" not in refused
        for stream in played:
            assert len(stream.samples) == 0.5 * stream.rate_hz
            assert np.isfinite(stream.samples).all()


def test_a_seed_draws_the_faults_of_a_recording_anew(tmp_path: Path) -> None:
    np.savez(tmp_path / "motor.npz", de=np.zeros(1200))
    recording = ("--recording", tmp_path / "motor.npz", "--map", "accel-de=de", "--fs", "12000")
    faults = ("--scenario", SCENARIOS / "bad-bus.toml", "--seed", "7")
    parser = argparse.ArgumentParser()
    SimCommand().add_arguments(parser)
    arguments = parser.parse_args([str(given) for given in (MOTOR, *recording, *faults)])
    assert _misuse(arguments) is None
    _, _, drawn, _ = _script(arguments)
    assert drawn is not None
    assert drawn.seed == 7


def test_a_shaft_that_a_stream_is_too_slow_for_is_refused() -> None:
    """The rig's shaft turns at 600 rpm; two samples a revolution tell nothing of it."""
    probe, *_ = load_machine_file(VIRTUAL_RIG).sensors
    with pytest.raises(SignalError, match=r"'shaft' is sampled at 20 Hz, too slowly .* rate_hz above 20"):
        RotorSignals(load_scenario("healthy"), 0.5).of(probe, 20.0)


def test_a_rotor_that_leaves_its_housing_is_refused() -> None:
    scenario = load_scenario("healthy")
    wild = replace(scenario.plant.rotor, eccentricity=5.0, contact_stiffness=0.0)
    plant = scenario.plant.model_copy(update={"rotor": wild})
    signals = RotorSignals(scenario.model_copy(update={"plant": plant}), 0.5)
    with pytest.raises(SignalError, match="cannot be played: the rotor left its housing"):
        stream_samples(load_machine_file(VIRTUAL_RIG), "shaft", signals)


def test_streams_of_two_rates_are_played_from_one_recording(caplog: pytest.LogCaptureFixture) -> None:
    t_s = np.arange(4000) / 2000.0
    recording = Recording(
        ("probe-x", "probe-y", "keyphasor"),
        np.column_stack([np.sin(2 * np.pi * 20.0 * t_s), np.full(4000, -9.0), np.zeros(4000)]),
        2000.0,
        Path("run.npz"),
        0,
    )
    machine = load_machine_file(VIRTUAL_RIG)
    played = stream_samples(machine, "shaft", RecordedSignals(recording))
    n = len(played.samples)
    assert (n, played.rate_hz) == (2 * 640, 640.0)
    middle = slice(64, n - 64)
    expected = np.sin(2 * np.pi * 20.0 * np.arange(n) / 640.0)
    np.testing.assert_allclose(played.samples[middle, 0], expected[middle], atol=2e-3)
    np.testing.assert_allclose(played.samples[:, 1], -9.0, atol=1e-3)
    assert (
        caplog.text.count("stream 'shaft' is sampled at 640 Hz and run.npz at 2000 Hz: it is resampled") == 1
    )


def test_what_is_missing_in_a_recording_is_missing_at_another_rate() -> None:
    column = np.ones(1000)
    column[500:520] = np.nan
    moved = resampled(column, 1000.0, 250.0)
    assert np.flatnonzero(np.isnan(moved)).tolist() == [125, 126, 127, 128, 129]
    np.testing.assert_allclose(moved[~np.isnan(moved)], 1.0, atol=1e-3)
    assert np.isnan(resampled(np.full(10, np.nan), 10.0, 20.0)).all()
