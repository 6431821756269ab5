"""The bank says the same however its samples are cut into blocks, and whatever the samples are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples
from support.rotor_runs import physical_rotor

from daqsvc.rotor.bank import ModelBank
from daqsvc.rotor.decision import DecisionRules
from daqsvc.rotor.discretise import BankMode
from daqsvc.rotor.model import NormalisedRotor, RotorParameters

pytestmark = pytest.mark.property
PER_REV = 64
LENGTH = 12 * PER_REV


def bank(rule):
    rotors = {
        name: NormalisedRotor(w=1.0, e=0.1, zeta=zeta, g=0.1, contact_stiffness=30.0, mu=0.1)
        for name, zeta in (("N", 0.18), ("F1", 0.1), ("F1L2", 0.06), ("F1L3", 0.02))
    }
    modes = [
        BankMode(name, rotor, 0.1 if name == "F1L3" else 1e-4, rub=name == "F1L3")
        for name, rotor in rotors.items()
    ]
    return ModelBank(modes, noise=0.1, duration=2 * math.pi / PER_REV, rules=DecisionRules(rule=rule))


def samples(seed):
    """A healthy orbit that jumps to that of F1L2, with a gap of a random length in it."""
    rng = np.random.default_rng(seed)
    angle = 2 * math.pi * np.arange(LENGTH) / PER_REV
    zeta = np.where(np.arange(LENGTH) < rng.integers(3 * PER_REV, 8 * PER_REV), 0.18, 0.06)
    z = 0.1 / (2j * zeta) * np.exp(1j * angle) - 0.1j
    xy = np.column_stack((z.real, z.imag)) + 0.1 * rng.standard_normal((LENGTH, 2))
    begin = rng.integers(0, LENGTH)
    xy[begin : begin + rng.integers(0, 3 * PER_REV)] = np.nan
    return xy, np.cos(angle), np.sin(angle)


def outcome(subject, data, cuts):
    """Declarations by absolute sample, and everything that is said at the end."""
    declared, report = [], None
    for begin, end in zip([0, *cuts], [*cuts, LENGTH], strict=True):
        report = subject.process(*(array[begin:end] for array in data))
        declared += [(d.sample + begin, d.onset + begin, d.previous, d.mode) for d in report.declarations]
    return declared, report


@settings(max_examples=examples(25), deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    rule=st.sampled_from(["cusum", "paper"]),
    cuts=st.lists(st.integers(0, LENGTH), max_size=12).map(sorted),
)
def test_cutting_changes_nothing(seed, rule, cuts):
    data = samples(seed)
    whole, end_whole = outcome(bank(rule), data, [])
    pieces, end_pieces = outcome(bank(rule), data, cuts)
    assert pieces == whole
    assert end_pieces.decision == end_whole.decision
    assert end_pieces.group == end_whole.group
    np.testing.assert_array_equal(end_pieces.probabilities, end_whole.probabilities)
    np.testing.assert_array_equal(end_pieces.cusum_nats, end_whole.cusum_nats)
    np.testing.assert_array_equal(end_pieces.lead_nats, end_whole.lead_nats)


@settings(max_examples=examples(40), deadline=None)
@given(
    xy=st.lists(st.tuples(st.floats(width=32), st.floats(width=32)), min_size=1, max_size=60),
    known=st.booleans(),
)
def test_whatever_comes_the_statements_stay_finite(xy, known):
    subject = bank("cusum")
    subject.process(*samples(1))
    n = len(xy)
    angle = np.arange(n) / 10.0 if known else np.full(n, np.nan)
    report = subject.process(np.array(xy), np.cos(angle), np.sin(angle))
    assert np.isfinite(report.probabilities).all()
    assert np.isfinite(report.cusum_nats).all()
    report = subject.process(*samples(2))
    assert np.isfinite(report.probabilities).all()
    assert abs(report.probabilities.sum() - 1.0) < 1e-9


@given(
    natural_frequency_hz=st.floats(1.0, 500.0),
    damping_ratio=st.floats(1e-3, 0.9),
    eccentricity_um=st.floats(0.0, 1e3),
    clearance_um=st.floats(1.0, 1e4),
    heavy_spot_deg=st.floats(-180.0, 180.0),
    static_sag_um=st.floats(-1e3, 1e3),
    contact_stiffness=st.floats(0.0, 1e5),
    speed_rpm=st.floats(-30_000.0, 30_000.0),
)
def test_normalising_is_undone(speed_rpm, **figures):
    rotor = RotorParameters(**figures)
    normalised = rotor.normalised(speed_rpm)
    back = physical_rotor(
        normalised, natural_frequency_hz=rotor.natural_frequency_hz, clearance_um=rotor.clearance_um
    )
    for name, value in figures.items():
        assert math.isclose(getattr(back, name), value, rel_tol=1e-12, abs_tol=1e-9), name
    assert math.isclose(
        normalised.w * rotor.natural_frequency_hz * 60.0, speed_rpm, rel_tol=1e-12, abs_tol=1e-9
    )
