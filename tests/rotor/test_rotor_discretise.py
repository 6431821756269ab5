"""Discretisation: flow, process noise, gain and sub-steps against independent arithmetic."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from daqsvc.rotor.discretise import (
    BankMode,
    at_speed,
    axis_flow,
    axis_process_covariance,
    constant_gain,
    contact_substeps,
    discretise,
)
from daqsvc.rotor.model import NormalisedRotor

DURATION = 2 * math.pi / 64
ROTOR = NormalisedRotor(w=1.0, e=0.1, zeta=0.18, k=0.9, g=0.1)


def test_flow_is_the_solution_of_the_homogeneous_equation():
    for column, start in enumerate(np.eye(2)):
        solution = solve_ivp(
            lambda _, s: (s[1], -ROTOR.k * s[0] - 2 * ROTOR.zeta * s[1]),
            (0.0, DURATION),
            start,
            rtol=1e-12,
            atol=1e-14,
        )
        np.testing.assert_allclose(axis_flow(ROTOR, DURATION)[:, column], solution.y[:, -1], atol=1e-11)


def test_process_covariance_is_the_integral_of_the_noise():
    q = 1e-3

    def integrand(t, i, j):
        column = axis_flow(ROTOR, t)[:, 1]
        return q * column[i] * column[j]

    expected = [[quad(integrand, 0.0, DURATION, args=(i, j))[0] for j in range(2)] for i in range(2)]
    np.testing.assert_allclose(axis_process_covariance(ROTOR, q, DURATION), expected, rtol=1e-8)


@pytest.mark.parametrize("q", [1e-4, 0.1])
def test_gain_is_where_the_riccati_recursion_settles(q):
    noise = 0.196
    F, Q = axis_flow(ROTOR, DURATION), axis_process_covariance(ROTOR, q, DURATION)
    P = np.eye(2)
    for _ in range(20_000):
        S = P[0, 0] + noise**2
        K = P[:, 0] / S
        P = F @ (P - np.outer(K, P[0])) @ F.T + Q
    gain, variance = constant_gain(ROTOR, q, noise, DURATION)
    np.testing.assert_allclose(gain, K, rtol=1e-7)
    assert variance == pytest.approx(S, rel=1e-9)


def test_figures_without_a_gain_are_refused():
    with pytest.raises(ValueError, match="sensor noise is 0"):
        constant_gain(ROTOR, 1e-4, 0.0, DURATION)
    with pytest.raises(ValueError, match="process noise is nan"):
        constant_gain(ROTOR, math.nan, 0.1, DURATION)


@pytest.mark.parametrize("contact_stiffness", [3.0, 30.0, 1e3, 1e4, 1e5])
def test_substeps_resolve_the_contact_and_the_turn(contact_stiffness):
    rotor = NormalisedRotor(w=1.0, e=0.1, zeta=0.02, contact_stiffness=contact_stiffness, alpha=1.5)
    per_rev = 64 * contact_substeps(rotor, DURATION)
    contact_frequency = math.sqrt(1.5 * contact_stiffness)
    assert per_rev >= 128
    assert per_rev >= 4 * math.pi * contact_frequency
    assert per_rev <= max(128, 4 * math.pi * math.sqrt(1.0 + contact_frequency**2)) + 64


def modes(w=1.0):
    healthy = NormalisedRotor(w=w, e=0.1, zeta=0.18, g=0.1)
    rub = NormalisedRotor(w=w, e=0.1, zeta=0.02, g=0.1, contact_stiffness=30.0, mu=0.1)
    return [BankMode("N", healthy), BankMode("R", rub, process_noise=0.1, rub=True)]


def test_substep_tables_make_up_a_sample():
    observer = discretise(modes(), noise=0.2, duration=DURATION)[1]
    half = np.array([[observer["half_xx"], observer["half_xv"]], [observer["half_vx"], observer["half_vv"]]])
    full = np.array([[observer["full_xx"], observer["full_xv"]], [observer["full_vx"], observer["full_vv"]]])
    whole = np.array([[observer["xx"], observer["xv"]], [observer["vx"], observer["vv"]]])
    substeps = int(observer["substeps"])
    np.testing.assert_allclose(half @ half, full, atol=1e-14)
    np.testing.assert_allclose(np.linalg.matrix_power(full, substeps), whole, atol=1e-14)
    turn = complex(observer["full_cos"], observer["full_sin"])
    assert turn**substeps == pytest.approx(complex(math.cos(DURATION), math.sin(DURATION)))
    assert complex(observer["half_cos"], observer["half_sin"]) ** 2 == pytest.approx(turn)


def test_another_speed_is_the_same_as_made_for_it():
    moved = at_speed(discretise(modes(1.0), noise=0.2, duration=DURATION), modes(), 0.93, duration=DURATION)
    made = discretise(modes(0.93), noise=0.2, duration=DURATION)
    assert moved["substeps"].tolist() == made["substeps"].tolist()
    for name in ("a", "b", "speed", "gain_x", "xx", "half_sin", "full_cos", "surface_speed"):
        np.testing.assert_allclose(moved[name], made[name], err_msg=name)


def test_rub_observer_cannot_be_the_healthy_one():
    with pytest.raises(ValueError, match="first mode"):
        discretise(modes()[::-1], noise=0.2, duration=DURATION)
