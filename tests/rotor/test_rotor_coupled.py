"""Observers with coupled axes: exact on their own machine, the paper's where nothing couples."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from support import rotor_runs as runs

from daqsvc.rotor import coupled_kernels
from daqsvc.rotor.adaptation import SteadyMotion, adapted
from daqsvc.rotor.bank import ModelBank
from daqsvc.rotor.coupled import couple, coupled_evidence
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.discretise import BankMode, discretise, steady_evidence
from daqsvc.rotor.model import NormalisedRotor

PER_REV = 64
DURATION = math.tau / PER_REV
NOISE = 0.03
PAPER = NormalisedRotor(w=1.0, e=0.05, zeta=0.12, g=0.1, contact_stiffness=30.0, mu=0.1)
OVAL = replace(
    PAPER,
    anisotropy=0.08 + 0.03j,
    damping_anisotropy=0.02 - 0.01j,
    cross_stiffness=0.02,
    gyroscopic=0.05,
    higher_modes=0.1 - 0.02j,
    heavy_spot_rad=0.7,
    load_x=0.02,
)


def softer(rotor, part):
    return replace(
        rotor,
        k=part * rotor.k,
        anisotropy=part * rotor.anisotropy,
        cross_stiffness=part * rotor.cross_stiffness,
    )


def modes(rotor):
    return [
        BankMode("N", rotor),
        BankMode("U", replace(rotor, e=1.6 * rotor.e)),
        BankMode("D", replace(rotor, zeta=0.5 * rotor.zeta)),
        BankMode("K", softer(rotor, 0.9)),
        BankMode("L", replace(rotor, load_x=rotor.load_x + 0.1)),
        BankMode("R", replace(rotor, e=8.0 * rotor.e), process_noise=0.1, rub=True),
    ]


def acceleration(r, z, v, theta):
    """Of the equation of motion in `daqsvc.rotor.model`, without contact."""
    force = r.e * r.w**2 * np.exp(1j * (theta + r.heavy_spot_rad)) + complex(r.load_x, -r.g)
    damped = complex(2.0 * r.zeta, -r.gyroscopic * r.w) * v + r.damping_anisotropy * np.conj(v)
    sprung = complex(r.k, r.cross_stiffness) * z + r.anisotropy * np.conj(z)
    return force - damped - sprung


def steady(rotor, angle):
    turn = np.exp(1j * angle)
    return rotor.orbit() * turn + rotor.backward_orbit() / turn + rotor.rest


def course(rotors, revolutions, seed=0, noise=NOISE, start=0.3):
    """A machine that goes from one rotor to the next, by numerical integration; xy, cos, sin."""
    rng = np.random.default_rng(seed)
    z, v = steady(rotors[0], start), 0j
    turn = np.exp(1j * start)
    v = 1j * rotors[0].w * (rotors[0].orbit() * turn - rotors[0].backward_orbit() / turn)
    seen, angles, begun = [], [], start
    for rotor, revs in zip(rotors, revolutions, strict=True):
        angle = begun + rotor.w * DURATION * np.arange(revs * PER_REV + 1)
        bare = replace(rotor, higher_modes=0j, runout=(0j, 0j, 0j))
        beside = steady(rotor, angle) - steady(bare, angle)

        def flow(t, y, bare=bare, begun=begun):
            z, v = complex(y[0], y[1]), complex(y[2], y[3])
            a = acceleration(bare, z, v, begun + bare.w * t)
            return [v.real, v.imag, a.real, a.imag]

        if not seen:
            z -= beside[0]
            v = 1j * bare.w * (bare.orbit() * turn - bare.backward_orbit() / turn)
        times = DURATION * np.arange(len(angle))
        solved = solve_ivp(
            flow, (0.0, times[-1]), [z.real, z.imag, v.real, v.imag], t_eval=times, rtol=1e-9, atol=1e-11
        )
        path = solved.y[0] + 1j * solved.y[1]
        seen.append((path + beside)[:-1])
        angles.append(angle[:-1])
        z, v, begun = path[-1], complex(solved.y[2, -1], solved.y[3, -1]), float(angle[-1])
    z, angle = np.concatenate(seen), np.concatenate(angles)
    xy = np.column_stack((z.real, z.imag)) + noise * rng.standard_normal((len(z), 2))
    return xy, np.cos(angle), np.sin(angle)


def bank_of(made, **rules):
    return ModelBank(
        made, noise=NOISE, duration=DURATION, decision=0, rules=DecisionRules(settle_revolutions=4.0, **rules)
    )


small = st.floats(-0.2, 0.2)


@given(small, small, small, small, small, small, st.floats(0.4, 1.8), st.floats(0.0, math.tau))
def test_the_steady_orbit_obeys_the_equation_of_motion(q, p, d, kappa, gamma, load, w, theta):
    rotor = replace(
        PAPER,
        w=w,
        anisotropy=complex(q, p),
        damping_anisotropy=complex(d, 0.0),
        cross_stiffness=kappa,
        gyroscopic=gamma,
        load_x=load,
    )
    turn = np.exp(1j * theta)
    forward, backward = rotor.orbit() * turn, rotor.backward_orbit() / turn
    z, v = forward + backward + rotor.rest, 1j * w * (forward - backward)
    found = acceleration(rotor, z, v, theta)
    assert found == pytest.approx(-(w**2) * (forward + backward), abs=1e-9)
    assert rotor.load_for(rotor.rest) == pytest.approx(complex(rotor.load_x, -rotor.g), abs=1e-12)


def test_where_nothing_couples_the_bank_is_the_papers():
    nothing = replace(PAPER, gyroscopic=1e-13)
    assert not nothing.isotropic
    xy, cos, sin = course([PAPER, replace(PAPER, zeta=0.06)], [10, 30])
    said = []
    for rotor in (PAPER, nothing):
        bank = ModelBank(modes(rotor)[:5], noise=NOISE, duration=DURATION, decision=0)
        report = bank.process(xy, cos, sin)
        said.append((report.declarations, report.probabilities, report.lead_nats, report.cusum_nats))
    assert said[0][0] == said[1][0]
    for one, other in zip(said[0][1:], said[1][1:], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    observers = discretise(modes(PAPER), noise=NOISE, duration=DURATION)
    couplings = couple(modes(nothing), observers, noise=NOISE, duration=DURATION)
    np.testing.assert_allclose(
        coupled_evidence(couplings, observers, DURATION), steady_evidence(observers, DURATION), rtol=1e-6
    )


def test_an_observer_knows_the_next_position_of_its_own_machine():
    made = modes(OVAL)[:5]
    observers = discretise(made, noise=NOISE, duration=DURATION)
    couplings = couple(made, observers, noise=NOISE, duration=DURATION)
    xy, cos, sin = course([OVAL, made[3].rotor], [2, 4], noise=0.0)
    states, scores = np.zeros((5, 4)), np.empty((5, len(xy)))
    coupled_kernels.run_free(xy, cos, sin, observers, couplings, states, scores)
    perfect = -couplings["log_norm"]
    np.testing.assert_allclose(scores[0, : 2 * PER_REV], perfect[0], atol=1e-6)
    # From the change on the healthy one is wrong, and what is true converges to nothing left.
    assert scores[0, 3 * PER_REV :].mean() < perfect[0] - 0.1
    np.testing.assert_allclose(scores[3, -PER_REV:], perfect[3], atol=0.02)


def test_evidence_is_what_the_observers_gather():
    made = modes(OVAL)[:5]
    observers = discretise(made, noise=NOISE, duration=DURATION)
    couplings = couple(made, observers, noise=NOISE, duration=DURATION)
    expected = coupled_evidence(couplings, observers, DURATION)
    for truth in range(5):
        angle = DURATION * np.arange(40 * PER_REV)
        z = steady(made[truth].rotor, angle)
        states, scores = np.zeros((5, 4)), np.empty((5, len(z)))
        xy = np.column_stack((z.real, z.imag))
        coupled_kernels.run_free(xy, np.cos(angle), np.sin(angle), observers, couplings, states, scores)
        gathered = -(scores[:, 20 * PER_REV :].mean(axis=1) + couplings["log_norm"]) * PER_REV
        np.testing.assert_allclose(gathered, expected[truth], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("fault", [1, 2, 3, 4])
@pytest.mark.parametrize("rule", ["cusum", "paper"])
def test_a_fault_is_named(fault, rule):
    made = modes(OVAL)
    found, late = [], []
    for seed in range(4):
        xy, cos, sin = course([OVAL, made[fault].rotor], [20, 40], seed=seed, start=float(seed))
        report = bank_of(made, rule=rule).process(xy, cos, sin)
        found.append(report.decision)
        late.append(report.declarations[0].sample / PER_REV - 20.0)
    assert found == [fault] * 4
    assert min(late) > 0.0
    assert max(late) < 12.0


def test_a_healthy_machine_stays_healthy():
    xy, cos, sin = course([OVAL], [300])
    assert bank_of(modes(OVAL)).process(xy, cos, sin).declarations == ()


def test_a_rub_is_one_only_where_the_shaft_comes_near_the_housing():
    made = modes(OVAL)
    # Moved by what no mode has: the noisy observer of the rub alone follows, far from the housing.
    moved = replace(OVAL, load_x=OVAL.load_x - 0.25, g=OVAL.g - 0.2)
    xy, cos, sin = course([OVAL, moved], [10, 40])
    report = bank_of(made).process(xy, cos, sin)
    assert made[report.decision].name != "R"
    assert all(made[change.mode].name != "R" for change in report.declarations)
    # The same distance, with the orbit of the rub: its own observer's machine.
    observers = discretise(made, noise=NOISE, duration=DURATION)
    couplings = couple(made, observers, noise=NOISE, duration=DURATION)
    n = 40 * PER_REV
    angle = 0.2 + DURATION * np.arange(n)
    state, z = (0.0, 0.0, 0.0, 0.0), np.empty(n, np.complex128)
    for k in range(n):
        c, s = math.cos(angle[k]), math.sin(angle[k])
        x, _, y, _ = coupled_kernels.orbit(observers[5], couplings[5], c, s)
        z[k] = complex(x + state[0], y + state[2])
        state = coupled_kernels.predict(observers[5], couplings[5], c, s, state)
    rng = np.random.default_rng(1)
    xy = np.column_stack((z.real, z.imag)) + NOISE * rng.standard_normal((n, 2))
    assert made[bank_of(made).process(xy, np.cos(angle), np.sin(angle)).decision].name == "R"


def test_another_speed_moves_the_orbit_and_not_the_estimate():
    rotor = OVAL
    bank = bank_of(modes(rotor))
    xy, cos, sin = course([rotor], [20], noise=0.0)
    bank.process(xy, cos, sin)
    for step in range(1, 6):
        w = 1.0 + 0.004 * step
        moved = replace(rotor, w=w)
        angle = 0.3 + w * DURATION * np.arange(12 * PER_REV)
        bank.retune(w, float(angle[0]))
        z = steady(moved, angle)
        noisy = np.column_stack((z.real, z.imag))
        noisy += NOISE * np.random.default_rng(step).standard_normal(noisy.shape)
        assert bank.process(noisy, np.cos(angle), np.sin(angle)).declarations == ()
    assert bank.decision == 0


def test_missing_samples_are_no_evidence():
    made = modes(OVAL)
    xy, cos, sin = course([OVAL, made[1].rotor], [20, 60])
    blind = xy.copy()
    blind[15 * PER_REV : 40 * PER_REV] = np.nan
    report = bank_of(made).process(blind[: 40 * PER_REV], cos[: 40 * PER_REV], sin[: 40 * PER_REV])
    assert report.declarations == ()
    bank = bank_of(made)
    whole = bank.process(blind, cos, sin)
    assert [change.mode for change in whole.declarations] == [1]
    assert whole.declarations[0].sample > 40 * PER_REV


def test_the_healthy_motion_that_was_measured_goes_into_every_mode():
    made = modes(OVAL)
    motion = SteadyMotion(0.2 * np.exp(1j), 0.05 * np.exp(2j), 0.3 - 0.2j, 4000)
    fitted = adapted(made, motion, 1.0)
    healthy = fitted[0].rotor
    assert healthy.orbit() == pytest.approx(motion.forward)
    assert healthy.backward_orbit() == pytest.approx(motion.backward)
    assert healthy.rest == pytest.approx(motion.rest)
    # A load moves the rest by as much as before, and twice the unbalance is twice the model's own part.
    assert fitted[4].rotor.rest - healthy.rest == pytest.approx(made[4].rotor.rest - made[0].rotor.rest)
    assert fitted[1].rotor.orbit() == pytest.approx(1.6 * motion.forward)
    assert len({mode.rotor.runout for mode in fitted}) == 1


def test_a_mode_that_whirls_by_itself_is_refused():
    wild = replace(OVAL, zeta=0.005, cross_stiffness=-0.3)
    with pytest.raises(ValueError, match="mode 'W' the whirl grows by itself"):
        bank_of([*modes(OVAL), BankMode("W", wild)])


def test_the_papers_bank_has_no_couplings():
    bank = ModelBank(runs.models(), noise=runs.sigma(0.0), duration=runs.DURATION)
    assert len(bank.couplings) == 0
