"""The rotor's model: units both ways, its orbit against an independent plant, and the paper's signs."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.rotor_runs import physical_rotor

from daqsvc.rotor import discretise, kernels
from daqsvc.rotor.discretise import BankMode
from daqsvc.rotor.model import NormalisedRotor, RotorParameters
from sim_hw.plants import rotor as plant

PAPER = RotorParameters(
    natural_frequency_hz=10.0,
    damping_ratio=0.18,
    eccentricity_um=10.0,
    heavy_spot_deg=20.0,
    clearance_um=100.0,
    static_sag_um=10.0,
    static_load_x_um=4.0,
    contact_stiffness=30.0,
)


def test_paper_values_in_normalised_units():
    rotor = PAPER.normalised(600.0)
    assert rotor.w == pytest.approx(1.0)
    assert rotor.e == pytest.approx(0.1)
    assert rotor.g == pytest.approx(0.1)
    assert rotor.load_x == pytest.approx(0.04)
    assert rotor.rest == pytest.approx(0.04 - 0.1j)
    assert rotor.zeta == 0.18
    assert PAPER.normalised(-300.0, damping_ratio=0.02).w == pytest.approx(-0.5)
    assert PAPER.normalised(600.0, damping_ratio=0.02).zeta == 0.02


def test_orbit_at_resonance_is_e_over_two_zeta():
    orbit = NormalisedRotor(w=1.0, e=0.1, zeta=0.18).orbit()
    assert abs(orbit) == pytest.approx(0.1 / 0.36)
    assert math.degrees(np.angle(orbit)) == pytest.approx(-90.0)


def test_normalising_is_undone():
    rotor = PAPER.normalised(540.0)
    back = physical_rotor(rotor, natural_frequency_hz=10.0, clearance_um=100.0)
    for name in (
        "natural_frequency_hz",
        "damping_ratio",
        "eccentricity_um",
        "heavy_spot_deg",
        "clearance_um",
    ):
        assert getattr(back, name) == pytest.approx(getattr(PAPER, name)), name
    assert back.static_sag_um == pytest.approx(PAPER.static_sag_um)
    assert back.static_load_x_um == pytest.approx(PAPER.static_load_x_um)
    assert back.contact_stiffness == pytest.approx(PAPER.contact_stiffness)
    assert back.contact_radius_um == pytest.approx(PAPER.contact_radius_um)


def test_softer_shaft_has_its_own_frequency_but_the_same_orbit():
    soft = NormalisedRotor(w=0.9, e=0.1, zeta=0.1, k=0.8, g=0.1, load_x=-0.03, contact_stiffness=30.0)
    physical = physical_rotor(soft, natural_frequency_hz=10.0, clearance_um=100.0)
    assert physical.natural_frequency_hz == pytest.approx(10.0 * math.sqrt(0.8))
    again = physical.normalised(0.9 * 600.0)
    assert again.orbit() == pytest.approx(soft.orbit())
    assert again.rest == pytest.approx(soft.rest)


@pytest.mark.parametrize("name", ["natural_frequency_hz", "damping_ratio", "clearance_um"])
@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_impossible_rotor_is_refused_by_name(name, value):
    figures = {
        "natural_frequency_hz": 10.0,
        "damping_ratio": 0.1,
        "eccentricity_um": 10.0,
        "clearance_um": 100.0,
    }
    with pytest.raises(ValueError, match=name):
        RotorParameters(**{**figures, name: value})


def test_impossible_contact_is_refused():
    with pytest.raises(ValueError, match="alpha"):
        NormalisedRotor(w=1.0, e=0.1, zeta=0.1, alpha=0.5)
    with pytest.raises(ValueError, match="mu"):
        NormalisedRotor(w=1.0, e=0.1, zeta=0.1, mu=-0.1)


@pytest.mark.parametrize("speed_ratio", [0.7, 1.0, 1.4])
def test_orbit_is_where_the_plant_settles(speed_ratio):
    parameters = plant.PlantParameters(
        damping_ratio=0.18,
        stiffness=0.9,
        speed_ratio=speed_ratio,
        heavy_spot_deg=35.0,
        side_load=0.05,
        contact_stiffness=0.0,
    )
    motion = plant.simulate(parameters, revolutions=30.0, samples_per_rev=32.0, initial=np.zeros(4))
    rotor = NormalisedRotor(
        w=speed_ratio, e=0.1, zeta=0.18, k=0.9, g=0.1, load_x=0.05, heavy_spot_rad=math.radians(35.0)
    )
    z = rotor.orbit() * np.exp(2j * math.pi * motion.revolution) + rotor.rest
    settled = motion.revolution > 20.0
    assert np.abs(motion.x + 1j * motion.y - z)[settled].max() < 1e-6


def rub_observers():
    healthy = NormalisedRotor(w=1.0, e=0.1, zeta=0.18, g=0.1)
    rub = NormalisedRotor(
        w=1.0, e=0.1, zeta=0.02, g=0.1, contact_stiffness=30.0, alpha=1.5, mu=0.3, contact_radius=500.0
    )
    modes = [BankMode("N", healthy), BankMode("R", rub, process_noise=1e-3, rub=True)]
    return discretise.discretise(modes, noise=0.1, duration=2 * math.pi / 64), rub


def open_loop(observers, rub, revolutions):
    """Positions of the rub model left to itself from the healthy orbit, samples 1 to the end."""
    states = np.zeros((2, 4))
    states[1] = np.nan
    n = revolutions * 64
    path = np.empty(n, dtype=complex)
    scores = np.empty((2, 1))
    for k in range(n):
        angle = 2 * math.pi * k / 64
        at = np.array([math.cos(angle)]), np.array([math.sin(angle)])
        z = rub.orbit() * np.exp(1j * angle) + rub.rest
        path[k] = z + states[1, 0] + 1j * states[1, 2]
        kernels.run_free(np.zeros((1, 2)), np.zeros(1, dtype=bool), *at, observers, states, scores)
    return path[1:]


def test_rub_model_follows_the_plant_with_its_own_integrator(monkeypatch):
    monkeypatch.setattr(discretise, "_MIN_SUBSTEPS_PER_REV", 1024)
    observers, rub = rub_observers()
    motion = plant.simulate(
        plant.PlantParameters(damping_ratio=0.02),
        revolutions=8.0,
        initial=plant.PlantParameters().steady_state(),
    )
    z = motion.x + 1j * motion.y
    assert np.abs(z).max() > 1.02, "the plant must touch its housing for this test to mean anything"
    assert np.abs(open_loop(observers, rub, 8) - z[1:]).max() < 1e-3


def test_paper_sign_of_the_contact_throws_the_disc_out():
    observers, rub = rub_observers()
    assert np.abs(open_loop(observers, rub, 40)).max() < 1.3
    observers["impulse"] *= -1.0
    assert np.abs(open_loop(observers, rub, 40)).max() > kernels.ESCAPE_RADIUS


def test_friction_that_drives_the_whirl_runs_away():
    observers, rub = rub_observers()
    observers["mu"] *= -1.0
    assert np.abs(open_loop(observers, rub, 60)).max() > kernels.ESCAPE_RADIUS


def test_matched_observer_stays_on_the_rubbing_plant(monkeypatch):
    # Noise-free, alpha and mu as in the plant, 8 sub-steps a sample: only integration errors are left.
    monkeypatch.setattr(discretise, "_MIN_SUBSTEPS_PER_REV", 512)
    observers, _ = rub_observers()
    assert observers["substeps"].tolist() == [0, 8]
    motion = plant.simulate(
        plant.PlantParameters(damping_ratio=0.02),
        revolutions=100.0,
        initial=plant.PlantParameters().steady_state(),
    )
    xy = np.column_stack((motion.x, motion.y))
    angle = 2 * math.pi * motion.revolution
    scores = np.empty((2, len(xy)))
    states = np.array([[0.0] * 4, [np.nan] * 4])
    everything = np.ones(len(xy), dtype=bool)
    kernels.run_free(xy, everything, np.cos(angle), np.sin(angle), observers, states, scores)
    tracked = scores[1, 20 * 64 :]
    innovation = np.sqrt(
        np.maximum(0.0, -2.0 * (tracked + observers["log_norm"][1]) / observers["precision"][1])
    )
    assert innovation.max() < 1e-4
