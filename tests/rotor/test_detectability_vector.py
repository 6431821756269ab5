"""What ``daqsvc detectability`` foretells of the synchronous vector, held to the departure test itself."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from support.formats import fits
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.rotor.calibration.file import save_calibration
from daqsvc.rotor.detectability.vector import stated_calibration, vector_detectability
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.departure import DepartureTest, threshold_for
from daqsvc.rotor.synchronous.signatures import damping_misfit

CONFIG = ROOT / "config" / "machines"
MACHINE = CONFIG / "rotor-synchronous.toml"
ROTOR = LavalRotor(natural_frequency_hz=31.0, damping_ratio=0.1, static_sag_um=10.0, clearance_um=100.0)
HEALTHY = stated_calibration(
    ROTOR, speed_rpm=1500.0, samples_per_rev=64.0, noise_um=1.0, eccentricity_um=5.0, revolutions=50
)
THRESHOLD_NATS = threshold_for(0.1)
FOUND = vector_detectability(HEALTHY, THRESHOLD_NATS)


def seen_after(change, seed):
    """Revolutions until the departure test sees a change that begins after the calibration; inf if never."""
    rng = np.random.default_rng(seed)
    deviation = np.sqrt(HEALTHY.variance / 2.0)
    test = DepartureTest(
        HEALTHY.spread,
        threshold_nats=THRESHOLD_NATS,
        energy_threshold_nats=math.inf,
        least_reference=HEALTHY.revolutions,
    )
    for revolution in range(HEALTHY.revolutions + 128):
        noise = deviation * (rng.standard_normal(5) + 1j * rng.standard_normal(5))
        shift = change if revolution >= HEALTHY.revolutions else 0.0
        if test.add(noise + shift, HEALTHY.noise, np.zeros(3)).departed:
            return revolution - HEALTHY.revolutions + 1
    return math.inf


def delays(change, seeds=40):
    return np.array([seen_after(change, seed) for seed in range(seeds)])


@pytest.mark.long
def test_the_smallest_change_is_seen_at_last_and_half_of_it_is_not():
    assert FOUND.smallest_um[0] == pytest.approx(
        math.sqrt(THRESHOLD_NATS * (2.0 / 64.0 * (1 / 50 + 1 / 128) + (0.002 * HEALTHY.amplitude_um) ** 2))
    )
    for component in (0, 1, 4):
        change = np.zeros(5, dtype=np.complex128)
        change[component] = FOUND.smallest_um[component]
        assert np.isfinite(delays(change)).mean() > 0.5
        assert np.isfinite(delays(0.5 * change)).mean() < 0.1


@pytest.mark.parametrize("fault", ["unbalance", "static_load"])
def test_the_delay_is_that_of_the_departure_test(fault):
    (one,) = (one for one in FOUND.faults if one.fault == fault)
    for delay in one.delays:
        change = np.zeros(5, dtype=np.complex128)
        if fault == "unbalance":
            change[1] = (delay.size - 1.0) * HEALTHY.baseline[1]
        else:
            change[0] = delay.size
        # The window that sees it on average; noise helps as the largest of many windows is taken.
        assert 0.5 * delay.revolutions - 1.0 <= np.median(delays(change)) <= delay.revolutions + 1.0


def test_every_fault_moves_what_physics_moves():
    by_fault = {one.fault: one for one in FOUND.faults}
    assert by_fault["unbalance"].change_um == pytest.approx(
        (by_fault["unbalance"].smallest - 1.0) * HEALTHY.amplitude_um, rel=1e-3
    )
    assert by_fault["static_load"].smallest == pytest.approx(FOUND.smallest_um[0], rel=0.01)
    assert by_fault["damping_loss"].healthy == 0.1
    assert 0.05 < by_fault["damping_loss"].smallest < 0.1
    assert 0.9 < by_fault["stiffness_loss"].smallest < 1.0
    coupled = vector_detectability(HEALTHY, THRESHOLD_NATS, ac_coupled=True)
    assert coupled.faults[-1].smallest is None
    assert coupled.faults[2].smallest < by_fault["stiffness_loss"].smallest


def test_the_group_opens_where_no_loss_of_damping_can_do_it():
    assert FOUND.one_group
    assert FOUND.opens_at_rpm is not None
    assert 1050.0 <= FOUND.opens_at_rpm <= 1950.0
    for speed_rpm, open_there in ((1500.0, False), (FOUND.opens_at_rpm, True)):
        there = stated_calibration(
            ROTOR,
            speed_rpm=speed_rpm,
            samples_per_rev=64.0,
            noise_um=1.0,
            eccentricity_um=5.0,
            revolutions=50,
        )
        change = np.array([0.0, there.baseline[1], 0.0, 0.0, 0.0])
        variance = there.spread.of_means(50.0, 50.0)
        assert (damping_misfit(change, variance, there.healthy) >= 5.0) is open_there
        assert vector_detectability(there, THRESHOLD_NATS).one_group is not open_there
    known = replace(ROTOR, natural_frequency_tolerance=0.01, damping_tolerance=0.05)
    assert not FOUND.told_by_transient
    assert vector_detectability(replace(HEALTHY, rotor=known), THRESHOLD_NATS).told_by_transient


def test_the_command_asks_for_what_is_not_known(capsys):
    assert main(["detectability", str(MACHINE)]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert "give --noise-um and --eccentricity-um, or calibrate the machine" in err
    assert main(["detectability", str(MACHINE), "--noise-um", "1", "--process-noise", "1"]) == 2
    assert "--process-noise: there is no [pipeline.rotor_bank]" in capsys.readouterr().err
    assert main(["detectability", str(CONFIG / "laval-rig.toml"), "--noise-um", "1"]) == 2
    assert "pipeline.rotor_bank.noise_um" in capsys.readouterr().err
    for name in ("laval-rig", "rotor-synchronous"):
        file = str(CONFIG / f"{name}.toml")
        assert main(["detectability", file, "--false-alarms-per-1000-rev", "1e9"]) == 2
        errors = capsys.readouterr().err
        assert errors.strip() == (
            "daqsvc detectability: --false-alarms-per-1000-rev = 1e+09: give a rate from 1e-09 to 10 [C02]"
        )


def test_the_command_tells_stated_noise_in_text_and_json(capsys):
    arguments = ["detectability", str(MACHINE), "--noise-um", "1", "--eccentricity-um", "5"]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    assert "noise 1 um, 50 revolutions of calibration; a change is an alarm at 21.1 nats" in text
    assert f"one group at 1500 rpm; at {FOUND.opens_at_rpm:.6g} rpm a grown unbalance is told from it" in text
    assert main([*arguments, "--json"]) == 0
    output = fits("daqsvc detectability", json.loads(capsys.readouterr().out, parse_constant=pytest.fail))
    assert output["smallest_um"]["1"] == pytest.approx(FOUND.smallest_um[1])
    assert output["ambiguous"][0]["opens_at_rpm"] == pytest.approx(FOUND.opens_at_rpm)
    assert [one["fault"] for one in output["smallest_change"]] == [one.fault for one in FOUND.faults]
    assert main([*arguments, "--json", "--false-alarms-per-1000-rev", "1"]) == 0
    assert json.loads(capsys.readouterr().out)["smallest_um"]["1"] < output["smallest_um"]["1"]


def test_a_calibration_tells_noise_and_variance(tmp_path, capsys):
    noisier = replace(HEALTHY, variance=4.0 * HEALTHY.variance, revolutions=200)
    save_calibration(noisier, tmp_path / "healthy.toml")
    text = MACHINE.read_text().replace("calibrate_revolutions = 50", 'calibration = "healthy.toml"')
    (tmp_path / "machine.toml").write_text(re.sub(r"clearance_um = [\d.]+", "clearance_um = 100.0", text))
    assert main(["detectability", str(tmp_path / "machine.toml"), "--json"]) == 0
    output = fits("daqsvc detectability", json.loads(capsys.readouterr().out))
    assert output["calibration_rev"] == 200
    expected = vector_detectability(noisier, THRESHOLD_NATS).smallest_um[1]
    assert output["smallest_um"]["1"] == pytest.approx(expected)
