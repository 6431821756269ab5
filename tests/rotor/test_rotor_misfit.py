"""What the steady motion after a change excludes, and what it leaves together, where no model is exact."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from daqsvc.rotor.adaptation import SteadyFit, SteadyMotion
from daqsvc.rotor.bank import ModelBank
from daqsvc.rotor.coupled import couple, couplings_at_speed
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.discretise import BankMode, at_speed, discretise
from daqsvc.rotor.misfit import (
    SteadyChange,
    SteadyMotions,
    differs_from,
    hunting,
    misfit,
    steady_change,
    swing,
)
from daqsvc.rotor.model import NormalisedRotor

PER_REV = 64
DURATION = math.tau / PER_REV
NOISE = 0.01
NATS = 5.0
ROTOR = NormalisedRotor(
    w=0.8, e=0.1, zeta=0.12, g=0.1, contact_stiffness=2.0, mu=0.1, anisotropy=0.08 + 0.03j, gyroscopic=0.05
)
FAULTS = ("normal", "unbalance", "unbalance", "static_load", "stiffness_loss")
MOTIONS = np.array(
    [[0.2, 0.02, -0.1j], [0.3, 0.03, -0.1j], [0.5, 0.05, -0.1j], [0.2, 0.02, -0.3j], [0.24, 0.02, -0.2j]]
)
MANY = 10**6


def names(flags):
    return {fault for fault, flag in zip(FAULTS, flags, strict=True) if flag}


def off(moved, exact=()):
    change = SteadyChange(np.array(moved, complex), MANY)
    return misfit(change, MOTIONS, FAULTS, noise=NOISE, nats=NATS, exact=exact)


@pytest.mark.parametrize("size", [0.3, 1.0, 2.0, 5.0])
def test_a_fault_of_any_size_is_met_and_excludes_the_others(size):
    found = off(size * (MOTIONS[1] - MOTIONS[0]))
    assert found.part[1] == pytest.approx(0.0, abs=1e-12)
    assert found.part[2] == found.part[1]
    assert found.part[0] == pytest.approx(1.0)
    assert names(found.excluded) == {"normal", "static_load", "stiffness_loss"}
    assert not found.pairs.any()


def test_what_the_best_one_misses_is_what_the_others_may_miss():
    load, softer = MOTIONS[3] - MOTIONS[0], MOTIONS[4] - MOTIONS[0]
    exact = off(load)
    assert names(exact.excluded) == {"normal", "unbalance", "stiffness_loss"}
    # The same with a backward whirl that no mode has: nothing of the kind tells a load from a softer support.
    beside = np.linalg.norm(load) * np.array([0.0, 0.4, 0.0])
    strange = off(load + beside)
    assert strange.part[3] == pytest.approx(np.linalg.norm(beside) / np.linalg.norm(load + beside))
    pairs = strange.pairs
    assert names(pairs[3]) == {"stiffness_loss"}
    assert names(pairs[4]) == {"static_load"}
    assert (pairs == pairs.T).all()
    assert "stiffness_loss" not in names(strange.excluded)
    assert {"normal"} <= names(strange.excluded)
    assert off(softer).part[4] == pytest.approx(0.0, abs=1e-12)


def test_a_fault_that_the_model_knows_exactly_is_given_no_error_of_the_model():
    # A little nearer to the load than to a softer support, and not quite either: 1X has moved.
    between = 0.55 * (MOTIONS[3] - MOTIONS[0]) + 0.45 * 2.0 * (MOTIONS[4] - MOTIONS[0])
    assert "static_load" not in names(off(between).excluded)
    known = off(between, exact={"static_load"})
    assert "static_load" in names(known.excluded)
    assert "stiffness_loss" not in names(known.excluded)
    assert not known.pairs.any()
    load = off(MOTIONS[3] - MOTIONS[0], exact={"static_load"})
    assert "static_load" not in names(load.excluded)
    assert "stiffness_loss" in names(load.excluded)


def test_levels_of_one_fault_and_the_healthy_mode_are_in_no_pair():
    found = off([0.0, 0.3, 0.0])
    pairs = found.pairs
    assert not pairs[0].any()
    assert not pairs[1, 2]
    assert pairs[1, 3]


def test_noise_excludes_nothing_that_it_may_have_made():
    softer = MOTIONS[4] - MOTIONS[0]
    rng = np.random.default_rng(0)
    kept = 0
    for _ in range(200):
        noise = NOISE * 10.0 / math.sqrt(64) * (rng.standard_normal(3) + 1j * rng.standard_normal(3))
        found = misfit(SteadyChange(softer + noise, 64), MOTIONS, FAULTS, noise=10.0 * NOISE, nats=NATS)
        kept += "stiffness_loss" not in names(found.excluded)
    # The truth is 5 nats behind by chance with three complex parts in fewer than 2 % of the runs.
    assert kept >= 196


def test_a_motion_that_is_not_known_is_neither_excluded_nor_near():
    motions = np.vstack((MOTIONS, np.full(3, np.nan)))
    change = SteadyChange(MOTIONS[3] - MOTIONS[0], MANY)
    found = misfit(change, motions, (*FAULTS, "rub"), noise=NOISE, nats=NATS)
    assert math.isnan(found.part[-1])
    assert not found.excluded[-1]
    assert not found.pairs[-1].any()


def revolutions(*parts):
    return [SteadyMotion(*motion, PER_REV) for motion, count in parts for _ in range(count)]


def test_a_change_is_steady_as_long_as_its_halves_agree():
    before, after = MOTIONS[0], MOTIONS[3]
    assert steady_change(revolutions((before, 20), (after, 4)), MOTIONS[0], NOISE) is None
    assert steady_change(revolutions((after, 7)), MOTIONS[0], NOISE) is None
    some = steady_change(revolutions((before, 20), (after, 12)), MOTIONS[0], NOISE)
    assert some is not None
    assert some.samples == 8 * PER_REV
    np.testing.assert_allclose(some.moved, after - before)
    long = steady_change(revolutions((after, 32)), MOTIONS[0], NOISE)
    assert long is not None
    assert long.samples == 32 * PER_REV


def test_a_machine_that_went_and_came_back_is_not_steady_for_as_long():
    before, after = MOTIONS[0], MOTIONS[3]
    back = steady_change(revolutions((before, 32), (after, 64), (before, 32)), before, NOISE)
    assert back is not None
    assert back.samples == 32 * PER_REV
    np.testing.assert_allclose(back.moved, np.zeros(3), atol=1e-12)


def test_a_change_that_noise_hides_is_a_steady_one_of_nothing():
    rng = np.random.default_rng(1)
    sigma = NOISE / math.sqrt(PER_REV)
    motions = [
        SteadyMotion(*(MOTIONS[0] + sigma * (rng.standard_normal(3) + 1j * rng.standard_normal(3))), PER_REV)
        for _ in range(32)
    ]
    change = steady_change(motions, MOTIONS[0], NOISE)
    assert change is not None
    assert np.linalg.norm(change.moved) < 5.0 * sigma
    found = misfit(change, MOTIONS, FAULTS, noise=NOISE, nats=NATS)
    assert not found.excluded.any()
    assert found.pairs[1, 3]


def test_where_no_fault_explains_the_change_none_is_preferred():
    # Backward whirl that no mode has: unbalance, load and softer support are as far from it.
    found = off([0.02, 0.3, 0.05])
    assert np.nanmin(found.part) > 0.5
    assert not found.excluded.any()
    assert found.pairs[1, 3]
    assert found.pairs[3, 4]


def bank_modes(rub_unbalance=6.0):
    return [
        BankMode("N", ROTOR),
        BankMode("U", replace(ROTOR, e=2.0 * ROTOR.e)),
        BankMode("L", replace(ROTOR, load_x=0.1)),
        BankMode("R", replace(ROTOR, e=rub_unbalance * ROTOR.e), process_noise=0.1, rub=True),
    ]


def motions_of(modes):
    observers = discretise(modes, noise=NOISE, duration=DURATION)
    couplings = couple(modes, observers, noise=NOISE, duration=DURATION)
    return SteadyMotions(DURATION).of(observers, couplings)


def test_modes_without_contact_end_on_their_orbits():
    for mode, motion in zip(bank_modes()[:3], motions_of(bank_modes()), strict=False):
        rotor = mode.rotor
        np.testing.assert_allclose(motion[:3], [rotor.orbit(), rotor.backward_orbit(), rotor.rest])
        assert not motion[3:].any()


def test_a_rub_ends_where_its_equation_of_motion_does():
    rotor = replace(ROTOR, e=6.0 * ROTOR.e)

    def flow(t, y):
        z, v = complex(y[0], y[1]), complex(y[2], y[3])
        force = rotor.e * rotor.w**2 * np.exp(1j * rotor.w * t) + complex(rotor.load_x, -rotor.g)
        sprung = complex(rotor.k, rotor.cross_stiffness) * z + rotor.anisotropy * np.conj(z)
        a = force - complex(2.0 * rotor.zeta, -rotor.gyroscopic * rotor.w) * v - sprung
        if abs(z) > 1.0:
            slip = rotor.w * rotor.contact_radius + (np.conj(z) * v).imag / abs(z)
            push = rotor.contact_stiffness * (abs(z) - 1.0) ** rotor.alpha * z / abs(z)
            a -= push * (1.0 + 1j * rotor.mu * np.sign(slip))
        return [v.real, v.imag, a.real, a.imag]

    n = 80 * PER_REV
    angle = math.tau / PER_REV * np.arange(n)
    path = solve_ivp(
        flow, (0.0, angle[-1] / rotor.w), np.zeros(4), t_eval=angle / rotor.w, rtol=1e-8, atol=1e-9
    )
    fit, part = SteadyFit(), slice(60 * PER_REV, None)
    fit.add(path.y[:2, part].T, np.cos(angle[part]), np.sin(angle[part]))
    expected = fit.solve()
    assert np.hypot(*path.y[:2, part]).max() > 1.0
    found = motions_of(bank_modes())[3]
    np.testing.assert_allclose(found[:3], [expected.forward, expected.backward, expected.rest], atol=0.01)


def test_a_rub_is_simulated_again_where_the_speed_has_changed():
    modes = bank_modes()
    observers = discretise(modes, noise=NOISE, duration=DURATION)
    couplings = couple(modes, observers, noise=NOISE, duration=DURATION)
    steady = SteadyMotions(DURATION)
    before = steady.of(observers, couplings)
    for times, again in ((1.01, False), (1.03, True)):
        moved = at_speed(observers, modes, times * ROTOR.w, duration=DURATION)
        coupled = couplings_at_speed(couplings, moved, modes, times * ROTOR.w, duration=DURATION)
        after = steady.of(moved, coupled)
        assert after[1, 0] == pytest.approx(modes[1].rotor.orbit(times * ROTOR.w))
        assert (after[3] != before[3]).all() == again


def test_a_rub_that_does_not_touch_is_none():
    assert np.isnan(motions_of(bank_modes(rub_unbalance=1.5))[3]).all()


def course(rotor, revs, seed=0):
    angle = DURATION * rotor.w * np.arange(round(revs * PER_REV / rotor.w))
    turn = np.exp(1j * angle)
    z = rotor.orbit() * turn + rotor.backward_orbit() / turn + rotor.rest
    noise = NOISE * np.random.default_rng(seed).standard_normal((len(z), 2))
    return np.column_stack((z.real, z.imag)) + noise, np.cos(angle), np.sin(angle)


def test_the_decision_leaves_a_mode_that_is_excluded_and_comes_back():
    modes = bank_modes()[:3]
    bank = ModelBank(modes, noise=NOISE, duration=DURATION, decision=0, rules=DecisionRules())
    none, no_pairs = np.zeros(3, bool), np.zeros((3, 3), bool)
    assert bank.process(*course(modes[1].rotor, 20)).decision == 1
    bank.exclude(np.array([True, True, False]), no_pairs)
    excluded = bank.process(*course(modes[1].rotor, 20, seed=1))
    assert excluded.decision == 2
    bank.retune(1.001 * bank.speed, 0.0)
    assert bank.process(*course(modes[1].rotor, 2, seed=2)).decision == 2
    bank.retune(bank.speed / 1.001, 0.0)
    bank.exclude(none, no_pairs)
    assert bank.process(*course(modes[1].rotor, 20, seed=3)).decision == 1


def test_modes_that_are_not_told_apart_are_one_group_and_do_not_change():
    modes = bank_modes()[:3]
    bank = ModelBank(modes, noise=NOISE, duration=DURATION, decision=0, rules=DecisionRules())
    pairs = np.zeros((3, 3), bool)
    pairs[1, 2] = pairs[2, 1] = True
    assert bank.process(*course(modes[1].rotor, 20)).group == ()
    bank.exclude(np.array([True, False, False]), pairs)
    report = bank.process(*course(modes[2].rotor, 20, seed=1))
    assert report.decision == 1
    assert report.group == (1, 2)


@pytest.mark.parametrize("w", [0.8, -0.8])
def test_the_healthy_machine_nearby_is_the_one_of_the_observers(w):
    rotor = replace(ROTOR, w=w)
    modes = [BankMode("N", rotor)]
    observers = discretise(modes, noise=NOISE, duration=DURATION)
    couplings = couple(modes, observers, noise=NOISE, duration=DURATION)
    nearby = hunting(rotor, w)
    healthy = SteadyMotions(DURATION).of(observers, couplings)[0]
    assert nearby[len(nearby) // 2] == pytest.approx(healthy[:3])


RESONANT = replace(ROTOR, w=1.0, zeta=0.04, anisotropy=0.0, cross_stiffness=0.001)


def certain(forward, w=1.0, noise=1e-4):
    moved = np.array([forward - RESONANT.orbit(w), 0.0, 0.0])
    return SteadyChange(moved, samples=640).is_certain(hunting(RESONANT, w), noise)


def test_a_machine_moves_along_its_own_curve_while_it_hunts():
    orbit, hunted = RESONANT.orbit(1.0), RESONANT.orbit(1.015)
    turned = abs(hunted - orbit)
    assert turned > 0.3 * abs(orbit)
    assert not certain(hunted)
    # As far, but grown; and further along the curve than hunting takes it.
    assert certain(orbit * (1.0 + turned / abs(orbit)))
    assert certain(RESONANT.orbit(1.05))


def test_a_change_of_a_tenth_of_the_orbit_above_the_noise_is_certain():
    w = 0.5
    orbit = RESONANT.orbit(w)
    # Below the critical speed the orbit grows with the speed, and hardly turns.
    turned = orbit * (1.0 + 0.11j)
    assert certain(turned, w)
    assert not certain(orbit * (1.0 + 0.09j), w)
    # Six standard deviations of a vector from 640 samples.
    as_large = 0.11 * abs(orbit) / 6.0 / math.sqrt(4.0 / 640)
    assert certain(turned, w, noise=0.97 * as_large)
    assert not certain(turned, w, noise=1.01 * as_large)


def test_where_the_speed_hunts_a_machine_may_be_off_its_curve():
    orbit = RESONANT.orbit(1.0)
    swings = swing(RESONANT, 0.99, 1.01)
    assert swings == pytest.approx(abs(RESONANT.orbit(1.01) - RESONANT.orbit(0.99)))
    change = SteadyChange(np.array([0.2 * orbit, 0.0, 0.0]), samples=640)
    nearby = hunting(RESONANT, 1.0)
    assert change.is_certain(nearby, 1e-4)
    assert not change.is_certain(nearby, 1e-4, swings)
    assert SteadyChange(2.0 * change.moved, samples=640).is_certain(nearby, 1e-4, swings)


def test_which_faults_the_steady_motion_tells_from_healthy():
    grown = replace(RESONANT, e=1.2 * RESONANT.e)
    loaded = replace(RESONANT, g=3.0 * RESONANT.g)
    assert differs_from(RESONANT, grown, 1.0)
    assert not differs_from(RESONANT, replace(RESONANT, e=1.05 * RESONANT.e), 1.0)
    # The mean position also drifts with the probes; and 1 % of stiffness is half a percent of speed.
    assert not differs_from(RESONANT, loaded, 1.0)
    assert not differs_from(RESONANT, replace(RESONANT, k=0.99), 1.0)
