"""Two modes from a run-up: what they are, and that faults derived from them come true."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.two_mode_rotors import RATE_HZ, UNIT_HZ, Machine, fitted, run_up

from daqsvc.rotor.calibration.run_up import revolutions_of
from daqsvc.rotor.calibration.two_modes import TwoModeFit, fit_two_modes
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.model import Film, Pedestal, RotorParameters
from daqsvc.rotor.synchronous.baseline import NotCalibratableError
from daqsvc.rotor.synchronous.by_two_modes import damping_left
from daqsvc.rotor.synchronous.vectors import Healthy, synchronous_vectors

MACHINE = Machine()
KNOWN = RotorParameters(
    natural_frequency_hz=1.0, damping_ratio=0.1, eccentricity_um=1.0, clearance_um=200.0, static_sag_um=40.0
)


@cache
def identified(noise_um: float = 0.0) -> TwoModeFit:
    position, angle = run_up(MACHINE, 8.0, 50.0, 25.0)
    rng = np.random.default_rng(3)
    noise = noise_um * (rng.standard_normal(len(position)) + 1j * rng.standard_normal(len(position)))
    return fitted(position + noise, angle)[1]


def off(machine: Machine, speed_hz: float, **fault: object) -> float:
    """How far a derived orbit is from the true one, in parts of that."""
    fit = identified()
    rotor = fit.rotor(KNOWN).faulty(60.0 * speed_hz, **fault)
    forward, backward = machine.orbit(speed_hz)
    return math.hypot(
        abs(KNOWN.clearance_um * rotor.orbit() - forward),
        abs(KNOWN.clearance_um * rotor.backward_orbit() - backward),
    ) / math.hypot(abs(forward), abs(backward))


@pytest.mark.long
def test_one_laval_rotor_does_not_explain_what_two_modes_do():
    nearest, fit = fitted(*run_up(MACHINE, 8.0, 50.0, 25.0))
    assert not nearest.laval
    assert nearest.fit_error > 0.15
    assert fit.fit_error < 0.01
    assert fit.explains
    assert "two modes explain 1X from 4" in fit.describe()


@pytest.mark.parametrize("noise_um", [0.0, 2.0])
def test_the_figures_are_those_of_the_machine(noise_um):
    fit = identified(noise_um)
    support = sum(MACHINE.supports) / 2.0
    static = 1.0 / (1.0 / MACHINE.shaft + 1.0 / support)
    assert fit.natural_frequency_hz == pytest.approx(UNIT_HZ * math.sqrt(static), rel=0.02)
    assert fit.modes.support_share == pytest.approx(MACHINE.shaft / (MACHINE.shaft + support), abs=0.04)
    lag = MACHINE.dampers[0] / support * fit.natural_frequency_hz / UNIT_HZ
    assert fit.modes.support_lag == pytest.approx(lag, rel=0.15)
    uneven = (MACHINE.supports[0] - MACHINE.supports[1]) / 2.0 / support
    assert fit.modes.anisotropy == pytest.approx(uneven, abs=0.03)
    assert abs(fit.modes.damping_anisotropy) < 0.03
    assert abs(fit.eccentricity_um) == pytest.approx(abs(MACHINE.eccentricity_um), rel=0.03)


@pytest.mark.long
@pytest.mark.parametrize("speed_hz", [20.0, 28.0, 38.0])
def test_orbits_of_derived_faults_come_true(speed_hz):
    assert off(MACHINE, speed_hz) < 0.02
    damping = identified().damping_ratio
    assert off(MACHINE.damped(0.5), speed_hz, damping_ratio=0.5 * damping) < 0.02
    # Supports at .6 of their stiffness, and what is left of the static one with the shaft in series.
    share = MACHINE.shaft / (MACHINE.shaft + sum(MACHINE.supports) / 2.0)
    left = 1.0 / (1.0 - share + share / 0.6)
    assert off(MACHINE.softened(0.6), speed_hz, stiffness_ratio=left) < 0.05


@pytest.mark.parametrize("speed_hz", [20.0, 28.0, 38.0])
def test_what_gives_way_in_series_leaves_the_dampers_as_they_are(speed_hz):
    softer = replace(MACHINE, shaft=1.2)
    static = 1.0 / MACHINE.shaft + 2.0 / sum(MACHINE.supports)
    more = Pedestal((1.0 / softer.shaft - 1.0 / MACHINE.shaft) / static)
    assert off(softer, speed_hz, pedestal=more) < 0.02
    beside = {"stiffness_ratio": 1.0 / (1.0 + more.compliance)}
    assert off(softer, speed_hz, **beside) > 2.0 * off(softer, speed_hz, pedestal=more)


@pytest.mark.parametrize("speed_hz", [20.0, 28.0, 38.0])
def test_films_that_stiffen_and_turn_come_true(speed_hz):
    films = Film(stiffness=1.3, damping=1.1, turned_rad=math.pi / 2.0)
    (x, y), (dx, dy) = MACHINE.supports, MACHINE.dampers
    turned = replace(MACHINE, supports=(1.3 * y, 1.3 * x), dampers=(1.1 * dy, 1.1 * dx))
    assert off(turned, speed_hz, film=films) < 0.03
    assert off(turned, speed_hz) > 0.1


def test_damping_alone_would_be_far_off():
    # Without the supports' share a weaker damper leaves the frequency where it was.
    fit = identified()
    rotor = fit.rotor(KNOWN)
    alone = rotor.faulty(60.0 * 28.0)
    halved = replace(alone, zeta=0.5 * alone.zeta, damping_anisotropy=0.5 * alone.damping_anisotropy)
    forward, _ = MACHINE.damped(0.5).orbit(28.0)
    naive = abs(KNOWN.clearance_um * halved.orbit() - forward) / abs(forward)
    derived = off(MACHINE.damped(0.5), 28.0, damping_ratio=0.5 * fit.damping_ratio)
    assert naive > 3.0 * derived


def test_weight_rests_on_the_static_stiffness():
    rotor = identified().rotor(KNOWN)
    assert rotor.faulty(1500.0).rest == pytest.approx(-40.0j / 200.0)
    assert rotor.faulty(1500.0, damping_ratio=0.4 * rotor.damping_ratio).rest == pytest.approx(-0.2j)
    assert rotor.faulty(1500.0, stiffness_ratio=0.8).rest == pytest.approx(-0.25j)
    assert rotor.faulty(1500.0, pedestal=Pedestal(0.25, 0.2)).rest == pytest.approx(-0.24j)
    assert rotor.faulty(1500.0, static_load_um=20.0 + 0j).rest == pytest.approx(0.1 - 0.2j)


def test_a_shaft_that_turns_clockwise_has_the_mirrored_orbit():
    fit = identified()
    against, clockwise = fit.rotor(KNOWN), fit.rotor(KNOWN, clockwise=True)
    for fault in ({}, {"stiffness_ratio": 0.8}, {"unbalance_ratio": 2.0}):
        one, other = against.faulty(1500.0, **fault), clockwise.faulty(-1500.0, **fault)
        for angle in (0.0, 0.7, 2.0):
            turn = np.exp(1j * angle)
            z = one.orbit() * turn + one.backward_orbit() / turn
            mirrored = other.orbit() / turn + other.backward_orbit() * turn
            assert mirrored == pytest.approx(-np.conj(z), abs=1e-9)


@pytest.mark.long
def test_a_laval_rotor_is_one_of_two_modes():
    alike = Machine(supports=(3.0, 3.0))
    nearest, fit = fitted(*run_up(alike, 8.0, 50.0, 25.0))
    assert nearest.laval
    assert fit.fit_error < 0.01
    assert abs(fit.modes.anisotropy) < 0.01
    assert abs(fit.modes.runout_um[1]) < 0.2


@pytest.mark.long
def test_what_no_two_modes_make_is_said():
    position, angle = run_up(MACHINE, 8.0, 50.0, 25.0)
    strange = position + 30.0 * np.exp(1j * (angle + 3.0 * np.sin(angle / 40.0)))
    _, fit = fitted(strange, angle)
    assert not fit.explains
    assert "a rotor bank cannot be made" in fit.describe()


def test_too_few_revolutions_are_refused():
    position, angle = run_up(MACHINE, 8.0, 50.0, 25.0)
    vectors = synchronous_vectors(revolutions_of(position, angle))
    with pytest.raises(NotCalibratableError, match="only 10 revolutions"):
        fit_two_modes(vectors[:10], RATE_HZ, natural_frequency_hz=28.0, damping_ratio=0.1)


STIFF = Machine(shaft=1.0, supports=(8.0, 8.4), dampers=(7.0, 7.0))
"""Its supports take a ninth of the deflection, and their dampers are near those that damp most."""


@cache
def alike(speed_hz: float) -> list[RotorParameters]:
    """What its run-up shows, and rotors that whirl the same at a speed."""
    known = fitted(*run_up(STIFF, 8.0, 50.0, 25.0))[1].rotor(KNOWN)
    w = speed_hz / known.natural_frequency_hz
    others = [
        replace(known, two_modes=modes, natural_frequency_hz=known.natural_frequency_hz * math.sqrt(square))
        for over_least in (1.01, 1.08, 1.2, 1.8)
        for modes, square in known.two_modes.alike_at(w, over_least)
    ]
    return [known, *others]


@pytest.mark.parametrize("speed_hz", [24.0, 28.0, 33.0])
def test_rotors_whose_supports_take_another_part_whirl_the_same(speed_hz):
    known, *others = (rotor.faulty(60.0 * speed_hz) for rotor in alike(speed_hz))
    assert len(others) == 8
    for other in others:
        assert abs(other.orbit() - known.orbit()) < 0.02 * abs(known.orbit())
        assert abs(other.backward_orbit() - known.backward_orbit()) < 0.02 * abs(known.orbit())


@pytest.mark.parametrize("speed_hz", [24.0, 28.0, 33.0])
@pytest.mark.parametrize("fault", ["weaker dampers", "softer supports"])
def test_one_of_them_predicts_what_a_fault_does_and_the_run_up_does_not(fault, speed_hz):
    """Even without noise: what parts them is in the run-up by less than what no model fits."""
    # Supports of 8 become 4.8, in series with a shaft of 1.
    static = (1.0 + 1.0 / 8.0) / (1.0 + 1.0 / 4.8)
    changed = STIFF.damped(0.5) if fault == "weaker dampers" else STIFF.softened(0.6)
    moved = changed.orbit(speed_hz)[0] - STIFF.orbit(speed_hz)[0]
    off_by = []
    for rotor in alike(speed_hz):
        weak = {"damping_ratio": 0.5 * rotor.damping_ratio}
        after = rotor.faulty(60.0 * speed_hz, **(weak if "dampers" in fault else {"stiffness_ratio": static}))
        predicted = KNOWN.clearance_um * (after.orbit() - rotor.faulty(60.0 * speed_hz).orbit())
        off_by.append(abs(predicted - moved) / abs(moved))
    assert off_by[0] > 0.5
    assert min(off_by) < 0.2


@pytest.mark.parametrize(("speed_hz", "left"), [(28.0, 0.7), (28.0, 0.5), (33.0, 0.5)])
def test_what_is_left_of_the_damping_is_by_the_rotor_that_explains_it(speed_hz, left):
    known = alike(speed_hz)[0]
    healthy, weaker = (
        np.array([0.0, *machine.orbit(speed_hz), 0.0, 0.0]) for machine in (STIFF, STIFF.damped(left))
    )
    rotor = LavalRotor(
        natural_frequency_hz=known.natural_frequency_hz, damping_ratio=known.damping_ratio, two_modes=known
    )
    machine = Healthy(healthy, 2.0 * math.pi * speed_hz, rotor, laval=False)
    assert damping_left(weaker - healthy, machine, known) == pytest.approx(left, abs=0.06)


def test_no_supports_are_taken_that_drive_the_shaft_in_a_direction():
    uneven = replace(alike(28.0)[0].two_modes, anisotropy=0.6 + 0j, damping_anisotropy=-0.05 + 0j)
    found = [modes for over in (1.01, 1.2, 1.8, 4.0) for modes, _ in uneven.alike_at(1.0, over)]
    assert 0 < len(found) < 8
    for modes in found:
        assert abs(modes.anisotropy) < 1.0
        assert abs(modes.damping_anisotropy) < modes.support_lag


def test_supports_that_damp_nothing_are_left_as_they_are():
    known = alike(28.0)[0].two_modes
    assert replace(known, support_lag=0.0).alike_at(1.0, 1.2) == []
    # The deflection has no part above its whole.
    assert known.alike_at(1.0, 1000.0) == []
