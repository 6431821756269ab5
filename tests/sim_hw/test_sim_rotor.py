from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import odeint, solve_ivp

from sim_hw.plants.rotor import (
    ESCAPE_RADIUS,
    Change,
    PlantParameters,
    RotorEscapeError,
    contact_force,
    keyphasor_voltage,
    noise_sigma,
    simulate,
    state_derivative,
)

N = PlantParameters()
F1 = replace(N, damping_ratio=0.10)
F1L2 = replace(N, damping_ratio=0.06)
F1L3 = replace(N, damping_ratio=0.02)
FROM_REST = np.zeros(4)


def harmonics(motion, revolutions):
    """Forward 1X amplitude, backward 1X amplitude and mean of x + iy over the last whole revolutions."""
    n = 64 * revolutions
    z = (motion.x + 1j * motion.y)[-n:]
    turn = np.exp(2j * np.pi * motion.revolution[-n:])
    return abs(np.mean(z / turn)), abs(np.mean(z * turn)), np.mean(z)


@pytest.mark.parametrize(
    ("rotor", "amplitude", "settling_rev"),
    [(N, 0.1 / 0.36, 25), (F1, 0.5, 40), (F1L2, 0.1 / 0.12, 70)],
)
def test_steady_orbit_is_that_of_the_linear_rotor(rotor, amplitude, settling_rev):
    motion = simulate(rotor, revolutions=settling_rev, initial=FROM_REST)
    forward, backward, rest = harmonics(motion, 2)
    assert forward == pytest.approx(amplitude, abs=1e-6)
    assert backward < 1e-6
    assert rest == pytest.approx(-0.1j, abs=1e-6)


@pytest.mark.parametrize(
    ("rotor", "expected"),
    [
        (replace(N, static_load=0.05), -0.15j),
        (replace(N, side_load=0.2), 0.2 - 0.1j),
        (replace(N, stiffness=0.9), -0.1j / 0.9),
    ],
)
def test_static_loads_move_the_shaft_on_its_spring(rotor, expected):
    assert harmonics(simulate(rotor, revolutions=25, initial=FROM_REST), 2)[2] == pytest.approx(
        expected, abs=1e-6
    )


def test_a_run_starts_on_the_steady_orbit_of_its_heavy_spot():
    rotor = replace(N, heavy_spot_deg=40.0, speed_ratio=0.8, stiffness=0.9, static_load=0.03)
    motion = simulate(rotor, revolutions=20)
    z = motion.x + 1j * motion.y
    expected = rotor.orbit_1x * np.exp(2j * np.pi * motion.revolution) + rotor.rest
    assert np.abs(z - expected).max() < 1e-8
    # At resonance the orbit lags the heavy spot by a quarter of a turn.
    assert math.degrees(np.angle(N.orbit_1x)) == pytest.approx(-90.0)


def test_the_rotor_does_not_touch_before_its_damping_is_almost_gone():
    changes = [Change(27.06, F1), Change(54.11, F1L2)]
    soft = simulate(N, changes, revolutions=81.17)
    radius = np.hypot(soft.x, soft.y)
    assert radius.max() == pytest.approx(0.933, abs=2e-3)
    hard = [Change(c.at_rev, replace(c.parameters, contact_stiffness=1e5)) for c in changes]
    assert np.array_equal(simulate(replace(N, contact_stiffness=1e5), hard, revolutions=81.17).x, soft.x)


@pytest.mark.parametrize(
    ("contact_stiffness", "max_r"), [(1.0, 1.50), (10.0, 1.20), (30.0, 1.13), (100.0, 1.08)]
)
def test_rub_is_bounded_by_the_housing(contact_stiffness, max_r):
    hard = {"contact_stiffness": contact_stiffness}
    motion = simulate(replace(F1L2, **hard), [Change(5.0, replace(F1L3, **hard))], revolutions=85.0)
    radius = np.hypot(motion.x, motion.y)
    assert radius[20 * 64 :].max() == pytest.approx(max_r, abs=0.015)
    assert radius[20 * 64 :].min() < 1.0  # impacts, not a continuous full annular rub


def run_away(force_sign, drag_sign):
    """Revolutions until a rotor in F1L3 under another contact law is 3 clearances out; None if it stays."""

    free = replace(F1L3, contact_stiffness=0.0)

    def derivative(tau, state):
        x, vx, y, vy = state
        if x * x + y * y > 100.0:
            return [0.0, 0.0, 0.0, 0.0]
        _, ax, _, ay = state_derivative(tau, [x, vx, y, vy], free)
        fx, fy = contact_force(x, vx, y, vy, 30.0, 1.5, 0.3, drag_sign * 500.0)
        return [vx, ax + force_sign * fx, vy, ay + force_sign * fy]

    revolution = np.arange(0, 100, 1 / 64)
    course = odeint(derivative, F1L2.steady_state(), 2 * np.pi * revolution, tfirst=True, mxstep=5000)
    out = np.flatnonzero(~(np.hypot(course[:, 0], course[:, 2]) < 3.0))
    return revolution[out[0]] if len(out) else None


def test_signs_of_the_contact_law(monkeypatch):
    monkeypatch.setattr("sim_hw.plants.rotor.ESCAPE_RADIUS", math.inf)
    assert run_away(+1, +1) is None
    assert run_away(-1, +1) < 5.0  # as the state equation of the paper is printed
    assert run_away(+1, -1) < 100.0  # friction that drives the rim


def test_agrees_with_another_integrator_through_impacts_and_an_onset_between_samples():
    start = F1L2.steady_state()
    onset = 1.234567
    motion = simulate(F1L2, [Change(onset, F1L3)], revolutions=12.0, initial=start)
    tau = 2 * np.pi * motion.revolution
    middle = 2 * np.pi * onset
    state, parts = start, []
    for rotor, span in ((F1L2, (0.0, middle)), (F1L3, (middle, 2 * np.pi * 12.0))):
        at = tau[(tau >= span[0]) & (tau < span[1])]
        solved = solve_ivp(
            state_derivative, span, state, "DOP853", [*at, span[1]], rtol=1e-12, atol=1e-14, args=(rotor,)
        )
        parts.append(solved.y[:, :-1])
        state = solved.y[:, -1]
    x, _, y, _ = np.concatenate(parts, axis=1)
    assert np.hypot(x, y).max() > 1.05
    assert np.abs(motion.x - x).max() < 1e-7
    assert np.abs(motion.y - y).max() < 1e-7


def test_motion_does_not_depend_on_the_sampling():
    coarse = simulate(N, [Change(3.3, F1)], revolutions=8.0, samples_per_rev=32)
    fine = simulate(N, [Change(3.3, F1)], revolutions=8.0, samples_per_rev=160)
    assert np.abs(coarse.x - fine.x[::5]).max() < 1e-8
    uneven = simulate(N, revolutions=8.0, samples_per_rev=50.5)
    assert len(uneven.x) == 404
    assert uneven.revolution[101] == pytest.approx(2.0)


def test_process_noise_has_the_stated_density():
    # A damped oscillator under white acceleration of density q has the variance q / (4 zeta k).
    rotor = replace(N, eccentricity=0.0, gravity=0.0)
    motion = simulate(
        rotor, revolutions=400, samples_per_rev=8, process_noise=0.01, rng=np.random.default_rng(7)
    )
    settled = np.concatenate([motion.x[80:], motion.y[80:]])
    assert settled.var() == pytest.approx(0.01 / (4 * 0.18), rel=0.15)


def test_process_noise_follows_its_seed_and_starts_on_any_onset():
    def run(seed, at_rev):
        return simulate(
            N, [Change(at_rev, F1)], revolutions=4, process_noise=1e-4, rng=np.random.default_rng(seed)
        )

    assert np.array_equal(run(1, 2.0).x, run(1, 2.0).x)
    assert not np.array_equal(run(1, 2.0).x, run(2, 2.0).x)
    # An onset on a sample and one just past it are the same to the eye.
    assert np.abs(run(1, 2.0).x - run(1, 2.0 + 1e-9).x).max() < 1e-6


def test_escape_names_what_to_change():
    with pytest.raises(RotorEscapeError, match=r"damping_ratio=0.01.*contact_stiffness=0,.*raise damping"):
        simulate(replace(N, damping_ratio=0.01, contact_stiffness=0.0), revolutions=60, initial=FROM_REST)
    assert ESCAPE_RADIUS == 3.0


@pytest.mark.parametrize(
    ("changes", "options", "message"),
    [
        ([Change(0.0, F1)], {}, "must rise"),
        ([Change(3.0, F1), Change(2.0, F1L2)], {}, "must rise"),
        ([Change(10.0, F1)], {}, "end before"),
        ([Change(3.0, replace(N, speed_ratio=0.9))], {}, "speed_ratio to 0.9"),
        ([], {"samples_per_rev": 2}, "more than 2"),
        ([], {"process_noise": -1.0}, "negative"),
        ([], {"process_noise": 1.0}, "rng"),
    ],
)
def test_a_schedule_that_cannot_be_is_refused(changes, options, message):
    with pytest.raises(ValueError, match=message):
        simulate(N, changes, revolutions=10.0, **options)


@pytest.mark.parametrize(
    "bad",
    [
        {"damping_ratio": 0.0},
        {"stiffness": -1.0},
        {"friction": -0.1},
        {"contact_exponent": 0.5},
        {"gravity": math.nan},
    ],
)
def test_parameters_out_of_range_are_named(bad):
    (name,) = bad
    with pytest.raises(ValueError, match=name):
        PlantParameters(**bad)


def test_keyphasor_rises_through_its_middle_at_shaft_angle_zero():
    revolution = np.arange(0.5, 20.5, 1 / 61.7)
    volts = keyphasor_voltage(revolution)
    assert volts.min() == -10.0
    assert keyphasor_voltage(np.array([3.0, 3.0 + 1 / 64]))[:] == pytest.approx([-6.0, -2.0])
    before = np.flatnonzero((volts[:-1] < -6.0) & (volts[1:] >= -6.0))
    fraction = (-6.0 - volts[before]) / (volts[before + 1] - volts[before])
    crossing = revolution[before] + fraction / 61.7
    assert len(crossing) == 20
    assert np.abs(crossing - np.arange(1, 21)).max() < 0.1 / 61.7


def test_noise_sigma_is_a_ratio_of_powers():
    assert noise_sigma(abs(N.orbit_1x), 0.0) == pytest.approx(0.196, abs=5e-4)
    assert noise_sigma(abs(N.orbit_1x), -5.0) == pytest.approx(0.349, abs=5e-4)
    assert noise_sigma(10.0, 20.0) == pytest.approx(10 / math.sqrt(2) / 10)


def test_motion_in_micrometres():
    motion = simulate(N, revolutions=1)
    x_um, y_um = motion.in_um(100.0)
    assert np.array_equal(x_um, 100 * motion.x)
    assert np.array_equal(y_um, 100 * motion.y)
