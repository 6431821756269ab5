"""On oil films, a load and a support that gives way part: by how 1X follows the mean position."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.oil_film_rotors import FilmMachine
from support.two_mode_rotors import fitted

from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.synchronous.by_two_modes import stiffness_left
from daqsvc.rotor.synchronous.signatures import likelihoods
from daqsvc.rotor.synchronous.vectors import Healthy

if TYPE_CHECKING:
    from daqsvc.rotor.calibration.two_modes import TwoModeFit

MACHINE = FilmMachine()
SOFTER = replace(MACHINE, pedestals=(3.0, 5.4))
AWAY_FROM_CRITICAL_HZ = [20.0, 38.0]


@cache
def identified() -> TwoModeFit:
    return fitted(*MACHINE.run_up(8.0, 50.0, 25.0))[1]


def leads(
    fault: str, after: FilmMachine, speed_hz: float, *, plain_bearings: bool | None = None
) -> dict[str, float]:
    """How far a fault is ahead of each other one, nats, in noise that leaves 40 dB of the whirl."""
    before = MACHINE.vector(speed_hz)
    stated = LavalRotor(
        natural_frequency_hz=29.0,
        damping_ratio=0.1,
        static_sag_um=-before[0].imag,
        plain_bearings=plain_bearings,
    )
    healthy = Healthy(before[:5], math.tau * speed_hz, identified().beside(stated), laval=False)
    variance = np.full(7, (0.01 * healthy.amplitude_um) ** 2)
    vector = after.vector(speed_hz)
    scores = likelihoods(vector - before, variance, healthy, vector[:5])
    return {name: scores[fault] - score for name, score in scores.items() if name != fault}


def loaded(part: float, turned: complex = 1.0) -> FilmMachine:
    """With a further load, in parts of the weight; it points down if it is not turned."""
    return replace(MACHINE, load=MACHINE.load * (1.0 + part * turned))


def test_the_run_up_shows_the_oil_film():
    assert abs(identified().modes.cross_stiffness) > 0.2


@pytest.mark.parametrize("speed_hz", [20.0, 28.0, 38.0])
def test_pedestals_that_give_way_are_no_load(speed_hz):
    assert min(leads("stiffness_loss", SOFTER, speed_hz).values()) > 10.0


@pytest.mark.parametrize("speed_hz", AWAY_FROM_CRITICAL_HZ)
def test_a_load_that_stiffens_the_film_is_no_softer_support(speed_hz):
    assert min(leads("static_load", loaded(0.3), speed_hz).values()) > 5.0


@pytest.mark.parametrize("speed_hz", AWAY_FROM_CRITICAL_HZ)
def test_a_load_from_the_side_turns_the_film(speed_hz):
    assert min(leads("static_load", loaded(0.3, np.exp(-1.2j)), speed_hz).values()) > 3.0


def test_a_stated_film_needs_no_sign_of_one():
    """Above .05 across the deflection a film is taken for one; what is stated is believed first."""
    stated = leads("stiffness_loss", SOFTER, 28.0, plain_bearings=True)
    denied = leads("stiffness_loss", SOFTER, 28.0, plain_bearings=False)
    assert stated == leads("stiffness_loss", SOFTER, 28.0)
    assert min(stated.values()) > min(denied.values()) + 5.0


def test_on_springs_a_load_moves_no_1x():
    """What follows a load is the film; without one, 1X that has moved shows another fault."""
    denied = leads("static_load", loaded(0.3), 28.0, plain_bearings=False)
    assert denied["stiffness_loss"] < -50.0


def test_an_upright_shaft_has_no_weight_that_a_load_could_be_compared_with():
    before = MACHINE.vector(20.0)
    stated = LavalRotor(natural_frequency_hz=29.0, damping_ratio=0.1, static_sag_um=0.0, plain_bearings=True)
    healthy = Healthy(before[:5], math.tau * 20.0, identified().beside(stated), laval=False)
    variance = np.full(7, (0.01 * healthy.amplitude_um) ** 2)
    pushed = before + np.array([30.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    scores = likelihoods(pushed - before, variance, healthy, pushed[:5])
    assert max(scores, key=lambda name: scores[name]) == "static_load"


@pytest.mark.parametrize("speed_hz", AWAY_FROM_CRITICAL_HZ)
def test_what_is_left_of_the_stiffness_is_found(speed_hz):
    before = MACHINE.vector(speed_hz)
    stated = LavalRotor(natural_frequency_hz=29.0, damping_ratio=0.1, static_sag_um=-before[0].imag)
    rotor = identified().beside(stated)
    healthy = Healthy(before[:5], math.tau * speed_hz, rotor, laval=False)
    assert rotor.two_modes is not None
    left = stiffness_left((SOFTER.vector(speed_hz) - before)[:5], healthy, rotor.two_modes)
    # Compliance of shaft and pedestals; what the films add differs with the speed.
    given = 1.0 / MACHINE.shaft + (1.0 / 5.0 + 1.0 / 9.0) / 2.0
    more = (1.0 / 3.0 - 1.0 / 5.0 + 1.0 / 5.4 - 1.0 / 9.0) / 2.0
    assert left == pytest.approx(1.0 / (1.0 + more / given), abs=0.05)
