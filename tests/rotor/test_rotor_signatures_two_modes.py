"""With the two modes of a run-up, faults part that one speed and a stated Laval rotor leave in one group."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.rotor_orbits import orbits
from support.two_mode_rotors import Machine, fitted, run_up, touching, vector_of

from daqsvc.rotor.laval import LavalRotor, unbalance_response
from daqsvc.rotor.synchronous.signatures import likelihoods
from daqsvc.rotor.synchronous.vectors import Healthy, synchronous_vectors
from daqsvc.rotor.synchronous.watch import RotorWatch

if TYPE_CHECKING:
    from daqsvc.rotor.calibration.two_modes import TwoModeFit

MACHINE = Machine()
STATED = LavalRotor(natural_frequency_hz=29.0, damping_ratio=0.1, static_sag_um=-MACHINE.rest.imag)
SPEEDS_HZ = [20.0, 28.0, 38.0]


@cache
def identified() -> TwoModeFit:
    return fitted(*run_up(MACHINE, 8.0, 50.0, 25.0))[1]


def leads(
    fault: str,
    after: np.ndarray,
    speed_hz: float,
    *,
    run_up_seen: bool = True,
    known: int = 7,
    shifted_um: complex = 0.0,
) -> dict[str, float]:
    """How far a fault is ahead of each other one, nats, in noise that leaves 40 dB of the whirl."""
    before = vector_of(MACHINE, speed_hz)
    shift = np.append(shifted_um, np.zeros(6))
    change, position = (after - before)[:known], (after + shift)[:5]
    rotor = identified().beside(STATED) if run_up_seen else STATED
    healthy = Healthy((before + shift)[:5], math.tau * speed_hz, rotor, laval=False)
    variance = np.full(known, (0.01 * healthy.amplitude_um) ** 2)
    scores = likelihoods(change, variance, healthy, position)
    return {name: scores[fault] - score for name, score in scores.items() if name != fault}


@pytest.mark.long
@pytest.mark.parametrize("speed_hz", SPEEDS_HZ)
def test_softer_supports_are_no_load(speed_hz):
    after = vector_of(MACHINE.softened(0.6), speed_hz)
    assert min(leads("stiffness_loss", after, speed_hz).values()) > 5.0


@pytest.mark.parametrize("speed_hz", SPEEDS_HZ)
def test_a_load_is_no_softer_support(speed_hz):
    heavier = replace(MACHINE, load=1.5 * MACHINE.load)
    after = vector_of(heavier, speed_hz)
    assert min(leads("static_load", after, speed_hz).values()) > 5.0


def test_without_a_run_up_the_two_are_one_group():
    after = vector_of(replace(MACHINE, load=1.5 * MACHINE.load), 28.0)
    assert leads("static_load", after, 28.0, run_up_seen=False)["stiffness_loss"] < 5.0


@pytest.mark.parametrize("speed_hz", SPEEDS_HZ)
def test_weaker_dampers_are_no_unbalance(speed_hz):
    after = vector_of(MACHINE.damped(0.5), speed_hz)
    ahead = leads("damping_loss", after, speed_hz)
    assert ahead["unbalance"] > 2.0
    assert min(lead for name, lead in ahead.items() if name != "unbalance") > 5.0


def test_modes_beyond_the_run_up_leave_open_which_damper_is_weaker():
    """The first mode loses damping, and the two modes predict another way of 1X."""
    known = identified().beside(STATED)
    speed_hz = 50.0
    shape = known.two_modes
    hidden = replace(shape, two_modes=replace(shape.two_modes, higher_modes=-0.16 + 0.06j, support_lag=1.9))
    ratio, before = speed_hz / known.natural_frequency_hz, np.zeros(5, dtype=complex)
    before[1] = -40.0 - 19.0j
    less, was = (unbalance_response(ratio, known.damping_ratio * left) for left in (0.4, 1.0))
    change = np.zeros(5, dtype=complex)
    change[1] = before[1] * (less / was - 1.0)
    behind = []
    for rotor in (replace(known, two_modes=hidden), known):
        machine = Healthy(before, math.tau * speed_hz, rotor, laval=False)
        variance = np.full(5, (0.002 * machine.amplitude_um) ** 2)
        scores = likelihoods(change, variance, machine, before + change)
        behind.append(scores["unbalance"] - scores["damping_loss"])
    assert behind[0] < 3.5 < behind[1]


@pytest.mark.parametrize("speed_hz", SPEEDS_HZ)
def test_unbalance_is_no_loss_of_damping(speed_hz):
    turned = replace(MACHINE, eccentricity_um=MACHINE.eccentricity_um * (1.0 + 0.5j))
    after = vector_of(turned, speed_hz)
    assert min(leads("unbalance", after, speed_hz).values()) > 3.0


@pytest.mark.parametrize("direction_deg", [0.0, -60.0, 200.0])
@pytest.mark.parametrize("speed_hz", SPEEDS_HZ)
def test_a_wall_that_is_touched_is_a_rub(speed_hz, direction_deg):
    after = at_a_wall(speed_hz, direction_deg)
    assert min(leads("rub", after, speed_hz).values()) > 3.0
    assert min(leads("rub", after, speed_hz, known=5).values()) > 3.0


def at_a_wall(speed_hz: float, direction_deg: float) -> np.ndarray:
    direction = np.exp(1j * math.radians(direction_deg))
    theta = math.tau * np.arange(256) / 256.0
    forward, backward = MACHINE.orbit(speed_hz)
    orbit = MACHINE.rest + forward * np.exp(1j * theta) + backward * np.exp(-1j * theta)
    reach = float((orbit * direction.conjugate()).real.max())
    wall = (reach - 0.3 * abs(forward)) * direction
    return touching(MACHINE, speed_hz, wall, 1.0)


@pytest.mark.parametrize("direction_deg", [0.0, -60.0, 200.0])
def test_with_3x_it_is_one_wherever_the_probes_take_the_centre_to_be(direction_deg):
    """The mean position is that of the gaps: where the clearance has its centre, they do not say."""
    after = at_a_wall(28.0, direction_deg)
    behind = -20.0 * abs(after[1]) * np.exp(1j * math.radians(direction_deg))
    ahead = leads("rub", after, 28.0, shifted_um=behind)
    assert min(ahead.values()) > 3.0
    assert leads("rub", after, 28.0, shifted_um=behind, known=5)["unmodelled"] < ahead["unmodelled"] - 8.0


def test_a_watch_names_it_by_3x():
    speed_hz = 28.0
    after = at_a_wall(speed_hz, 0.0)
    behind = np.append(-20.0 * abs(after[1]), np.zeros(6))
    life = np.vstack([np.tile(vector_of(MACHINE, speed_hz), (120, 1)), np.tile(after, (120, 1))]) + behind
    ahead = []
    for per_rev in (64, 12):
        watch = RotorWatch(identified().beside(STATED), per_rev * speed_hz)
        noise_um = 0.02 * abs(after[1]) * math.sqrt(per_rev / 64)
        watch.evaluate(synchronous_vectors(orbits(life, noise_um, per_rev=per_rev)))
        found = watch.finish()
        assert found is not None
        assert found.group == ("rub",)
        ahead.append(found.evidence["rub"] - found.evidence["unmodelled"])
    assert ahead[0] > ahead[1] + 5.0  # 12 samples in a revolution are too few for 3X
