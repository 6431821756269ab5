from __future__ import annotations

import numpy as np
import pytest
from support.machine_files import MACHINES

from daqsvc.settings import load_machine_file
from daqsvc.settings.sensors import Accelerometer
from sim_hw.link_faults import LinkFaults
from sim_hw.node_faults import EVER
from sim_hw.scenario import (
    BearingScenario,
    RaceDamage,
    ScenarioError,
    builtin_scenarios,
    load_any_scenario,
    load_scenario,
)
from sim_hw.sim_signals import BearingSignals

SCENARIOS = MACHINES.parent / "scenarios"
ACCELEROMETER = Accelerometer(name="a", stream="s", channel="c", type="accelerometer", unit="m/s2")
PLANT = '[plant]\nkind = "rotor"\n'
SHORT = f"""
title = "A short one"
revolutions = 12.0
dither_rev = 0.4
{PLANT}
[[onset]]
mode = "worn"
at_rev = 4.0
change = {{ damping_ratio = 0.1 }}
[[onset]]
mode = "loaded"
at_rev = 8.0
change = {{ static_load = 0.2 }}
"""


@pytest.fixture
def scenario_file(tmp_path):
    def write(text):
        path = tmp_path / "scenario.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_the_paper_in_numbers():
    paper = load_scenario("paper")
    plant = paper.plant.rotor
    assert [onset.mode for onset in paper.onset] == ["F1", "F1L2", "F1L3"]
    assert [onset.change for onset in paper.onset] == [{"damping_ratio": z} for z in (0.10, 0.06, 0.02)]
    assert [2 * np.pi * onset.at_rev for onset in paper.onset] == pytest.approx([170, 340, 510], abs=0.05)
    assert (plant.damping_ratio, plant.eccentricity, plant.gravity, plant.stiffness) == (0.18, 0.1, 0.1, 1.0)
    assert (plant.contact_stiffness, plant.contact_exponent, plant.friction) == (30.0, 1.5, 0.3)
    machine = paper.simulate()
    assert machine.rate_hz == 640.0
    assert len(machine) == 10_315
    assert machine.noise_um == pytest.approx(19.64, abs=0.01)
    assert [onset.mode for onset in machine.onsets] == ["N", "F1", "F1L2", "F1L3"]
    assert machine.onsets[0][1:] == (0.0, 0)
    # Rub impact in the last mode, through all the noise: clearance 100 um.
    rubbing = np.hypot(machine.channels["x_um"], machine.channels["y_um"])[machine.onsets[3].sample :]
    assert np.percentile(rubbing, 99) > 110


@pytest.mark.parametrize("name", builtin_scenarios())
def test_every_scenario_that_comes_along_runs(name):
    scenario = load_scenario(name)
    machine = scenario.simulate()
    assert scenario.title
    assert len(machine) == np.ceil(scenario.revolutions * scenario.samples_per_rev)
    assert all(
        np.isfinite(values).all() and len(values) == len(machine) for values in machine.channels.values()
    )


def test_link_faults_scenario_is_the_paper_over_a_bad_link():
    paper, faulty = load_scenario("paper"), load_scenario("link-faults")
    assert faulty.model_dump(exclude={"title", "link_faults"}) == paper.model_dump(
        exclude={"title", "link_faults"}
    )
    assert paper.node_faults() is None
    faults = faulty.node_faults(seed=9)
    assert faults is not None
    ((window, link),) = faults.link
    assert window == EVER
    assert link == LinkFaults(
        drop=0.01, duplicate=0.01, reorder=0.01, corrupt=0.01, seed=9, reorder_within_ns=5_000_000
    )


def test_onsets_are_dithered_by_seed_and_reported_as_they_were(scenario_file):
    scenario = load_scenario(scenario_file(SHORT))
    times = []
    for seed in range(20):
        machine = scenario.simulate(seed, snr_db=400.0)
        (_, worn, loaded) = machine.onsets
        assert abs(worn.at_rev - 4.0) <= 0.4
        assert abs(loaded.at_rev - 8.0) <= 0.4
        times.append(worn.at_rev)
        # Without noise, the first sample after the onset is the first off the healthy orbit.
        phase = np.exp(2j * np.pi * np.arange(len(machine)) / 64)
        healthy = 100 * (scenario.plant.rotor.orbit_1x * phase + scenario.plant.rotor.rest)
        moved = np.abs(machine.channels["x_um"] + 1j * machine.channels["y_um"] - healthy) > 1e-5
        assert worn.sample - 1 <= np.flatnonzero(moved)[0] <= worn.sample + 1
        assert worn.sample == np.ceil(worn.at_rev * 64)
    assert np.ptp(times) > 0.4
    assert len(set(times)) == 20


def test_a_seed_fixes_everything(scenario_file):
    scenario = load_scenario(scenario_file(SHORT))
    one, same, other = scenario.simulate(3), scenario.simulate(3), scenario.simulate(4)
    for name, values in one.channels.items():
        assert np.array_equal(values, same.channels[name])
        assert not np.array_equal(values, other.channels[name])
    assert one.onsets == same.onsets != other.onsets
    assert np.array_equal(
        scenario.simulate().channels["x_um"], scenario.simulate(scenario.seed).channels["x_um"]
    )


def test_noise_is_one_sigma_for_the_whole_run():
    paper = load_scenario("paper")
    clean, noisy = paper.simulate(5, snr_db=400.0), paper.simulate(5, snr_db=-5.0)
    assert noisy.onsets == clean.onsets
    for name in ("x_um", "y_um"):
        noise = noisy.channels[name] - clean.channels[name]
        sigma = [noise[a:b].std() for a, b in ((0, 1700), (1800, 3400), (3600, 5000), (5400, 10_000))]
        assert sigma == pytest.approx([34.93] * 4, rel=0.05)
        assert noise.mean() == pytest.approx(0.0, abs=1.5)
    assert np.corrcoef(noisy.channels["x_um"] - clean.channels["x_um"], noise)[0, 1] == pytest.approx(
        0, abs=0.05
    )
    assert np.array_equal(noisy.channels["keyphasor_v"], clean.channels["keyphasor_v"])


def test_process_noise_moves_the_machine(scenario_file):
    quiet = load_scenario(scenario_file(SHORT)).simulate(1, snr_db=400.0)
    shaken = load_scenario(scenario_file(SHORT.replace(PLANT, PLANT + "process_noise = 1e-4\n"))).simulate(
        1, snr_db=400.0
    )
    assert shaken.onsets == quiet.onsets
    assert 0.1 < (shaken.channels["x_um"] - quiet.channels["x_um"]).std() < 5.0


@pytest.mark.parametrize(
    ("text", "messages"),
    [
        ("titel = 3\n" + SHORT, ["titel: no such key"]),
        (SHORT.replace("kind", "king"), ["plant.kind: Field required", "plant.king: no such key"]),
        (SHORT.replace('"rotor"', '"bearing"'), ["plant.kind: Input should be 'rotor'"]),
        (
            SHORT.replace("damping_ratio", "zeta"),
            ["onset.0: zeta: no such parameter", "damping_ratio, stiffness"],
        ),
        (SHORT.replace("= 0.1 }", "= -0.1 }"), ["onset 'worn': rotor parameter damping_ratio is -0.1"]),
        (SHORT.replace("static_load", "speed_ratio"), ["'loaded' changes speed_ratio"]),
        (SHORT.replace("at_rev = 8.0", "at_rev = 4.5"), ["4 and 4.5 are too close", "more than 0.8 apart"]),
        (SHORT.replace("at_rev = 4.0", "at_rev = 0.3"), ["0 and 0.3 are too close", "more than 0.4 apart"]),
        (SHORT.replace("at_rev = 8.0", "at_rev = 12.5"), ["12.5 and 12 are too close"]),
        (SHORT.replace(PLANT, PLANT + "rotor = { mass = 3 }\n"), ["mass: no such parameter of the rotor"]),
        (
            SHORT.replace(PLANT, PLANT + "rotor = { friction = -1 }\n"),
            ["plant.rotor: rotor parameter friction"],
        ),
        (SHORT.replace(PLANT, PLANT + "rotor = { eccentricity = 0 }\n"), ["no signal-to-noise"]),
        (SHORT + "[link_faults]\ndrop = 2\n", ["link_faults: link fault drop = 2.0"]),
        (SHORT.replace("12.0", "-1"), ["revolutions: Input should be greater than 0"]),
        ("title = [", ["cannot be read: this is not TOML: Invalid value"]),
    ],
)
def test_what_is_wrong_in_a_file_is_said(scenario_file, text, messages):
    with pytest.raises(ScenarioError) as error:
        load_scenario(scenario_file(text))
    for message in messages:
        assert message in str(error.value)


def test_an_unknown_name_is_answered_with_the_known_ones():
    with pytest.raises(ScenarioError, match=r"no scenario 'papper'.*healthy, link-faults, paper"):
        load_scenario("papper")
    with pytest.raises(ScenarioError, match="cannot be read"):
        load_scenario("/")


def test_a_bearing_that_stays_healthy_and_one_whose_damage_lies_beyond_the_end():
    healthy = BearingScenario.model_validate(
        {"title": "", "duration_s": 0.5, "plant": {"kind": "bearing"}, "damage": []}
    )
    run = healthy.accelerations(2000.0)
    assert len(run.rotor_m_s2) == len(run.housing_m_s2) == 1000
    damaged = healthy.model_copy(update={"damage": (RaceDamage(part="inner", at_s=0.3),)})
    spalled = damaged.accelerations(2000.0)
    onset = 600
    assert np.array_equal(spalled.rotor_m_s2[:onset], run.rotor_m_s2[:onset])
    assert not np.array_equal(spalled.rotor_m_s2[onset:], run.rotor_m_s2[onset:])
    assert len(BearingSignals(damaged, 0.3).of(ACCELEROMETER, 2000.0)) == onset, "played to before the damage"


@pytest.mark.parametrize("seed", [1, 7])
def test_the_example_of_a_damaged_bearing_fits_the_machine_file_that_it_names(seed):
    """No alarm while the bearing is healthy; with the damage both, and nothing is clipped."""
    file = SCENARIOS / "bearing-damage.toml"
    scenario = load_any_scenario(file)
    played = next(line for line in file.read_text().splitlines() if "daqsvc sim" in line).split()
    assert played[-1] == "config/scenarios/bearing-damage.toml"
    machine = load_machine_file(MACHINES.parents[1] / played[3])
    sensor, stream = machine.sensor("accel-de"), machine.streams["drive-end"]
    signal = BearingSignals(scenario, seed=seed).of(sensor, stream.rate_hz)
    (channel,) = stream.layout.channels
    assert np.abs(signal).max() < 0.1 * 2**15 * channel.scale
    assert machine.pipeline.levels is not None
    windows = signal.reshape(-1, round(machine.pipeline.levels.window_s * stream.rate_hz))
    (damage,) = scenario.damage
    healthy = round(damage.at_s / machine.pipeline.levels.window_s)
    measured = {
        "rms": np.sqrt(np.square(windows - windows.mean(axis=1, keepdims=True)).mean(axis=1)),
        "peak": np.abs(windows - windows.mean(axis=1, keepdims=True)).max(axis=1),
    }
    assert sorted(alarm.measure for alarm in machine.alarms) == sorted(measured)
    for alarm in machine.alarms:
        of_measure = measured[alarm.measure]
        assert of_measure[:healthy].max() < 0.9 * alarm.alert
        assert of_measure[healthy:].min() > 1.05 * alarm.alert
