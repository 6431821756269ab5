"""The three-mass model and its checks against figures that were derived by other means."""

from __future__ import annotations

import numpy as np
import pytest

from daqsvc.bearing.model import BearingModel, BearingParameters, transfer
from sim_hw.plants.bearing import BearingMachine
from sim_hw.reproduce.bearing.design import (
    S1,
    S2,
    S2_EIGENVALUE,
    S3,
    check,
    fault_space_condition,
    invariant_zeros,
    observability,
)

FREQUENCY_HZ = np.geomspace(1.0, 20_000.0, 300)
EVERY = [S1, S2, S3]


def random_parameters(rng: np.random.Generator) -> BearingParameters:
    """Any machine: masses over two decades, stiffnesses and dampings over three."""
    low = np.array([0.3, 0.01, 0.2, 1e6, 1e7, 1e6, 10.0, 10.0, 10.0])
    names = ("m_r", "m_b", "m_h", "k_s", "k_c", "k_h", "c_s", "c_c", "c_h")
    spread = np.array([100.0] * 3 + [1000.0] * 6)
    return BearingParameters(**dict(zip(names, (low * spread ** rng.uniform(size=9)).tolist(), strict=True)))


@pytest.mark.parametrize("parameters", EVERY)
def test_the_state_equations_are_the_dynamic_stiffness(parameters):
    model = BearingModel(parameters)
    by_states = model.fault_transfer(FREQUENCY_HZ)
    by_stiffness = model.fault_transfer_by_stiffness(FREQUENCY_HZ)
    scale = np.linalg.norm(model.D)
    assert np.abs(by_states - by_stiffness).max() / max(scale, np.abs(by_stiffness).max()) <= 1e-12


@pytest.mark.parametrize("parameters", EVERY)
def test_the_simulated_machine_answers_alike(parameters):
    p = parameters
    plant = BearingMachine(
        masses=(p.m_r, p.m_b, p.m_h), stiffnesses=(p.k_s, p.k_c, p.k_h), dampings=(p.c_s, p.c_c, p.c_h)
    ).accelerance(FREQUENCY_HZ)
    model = BearingModel(p)
    mine = np.concatenate(
        (model.fault_transfer(FREQUENCY_HZ), transfer(model.A, model.B, model.C, model.E, FREQUENCY_HZ)),
        axis=2,
    )
    largest = np.abs(plant).max(axis=(0, 1))
    assert (np.abs(plant - mine) / largest).max() < 1e-11


def test_c_and_d_are_the_printed_ones():
    p, model = S1, BearingModel(S1)
    rotor = [-p.k_s / p.m_r, -p.c_s / p.m_r, p.k_s / p.m_r, p.c_s / p.m_r, 0.0, 0.0]
    housing = [0.0, 0.0, p.k_c / p.m_h, p.c_c / p.m_h, (-p.k_h - p.k_c) / p.m_h, (-p.c_h - p.c_c) / p.m_h]
    np.testing.assert_allclose(model.C, [rotor, housing], rtol=1e-15)
    np.testing.assert_allclose(model.D, np.diag([p.k_s / p.m_r, p.k_c / p.m_h]), rtol=1e-15)


def test_the_second_set_has_the_directions_of_the_paper():
    model = BearingModel(S2)
    directions = model.D - model.C @ model.F / abs(S2_EIGENVALUE)
    inner, outer = directions[1] / directions[0]
    assert inner == pytest.approx(2.0, abs=1e-4)
    assert outer == pytest.approx(6.0, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("m_b", 0.0, "m_b is 0.0; it must be a finite number above 0"),
        ("k_c", float("nan"), "k_c is nan"),
        ("c_h", -1.0, "c_h is -1.0; it must be a finite number 0 or more"),
    ],
)
def test_a_parameter_out_of_range_is_named(name, value, words):
    figures = {f: getattr(S1, f) for f in S1.__slots__} | {name: value}
    with pytest.raises(ValueError, match=words):
        BearingParameters(**figures)


def test_a_bearing_without_contact_and_housing_damping_is_refused():
    figures = {f: getattr(S1, f) for f in S1.__slots__} | {"c_c": 0.0, "c_h": 0.0}
    with pytest.raises(ValueError, match="fall together"):
        BearingParameters(**figures)


def test_random_machines_are_observable_and_have_all_zeros_at_the_origin():
    rng = np.random.default_rng(0)
    for _ in range(50):
        model = BearingModel(random_parameters(rng))
        assert observability(model).min() > 1e-6
        assert invariant_zeros(model) == 6


def test_the_fault_spaces_fall_together_as_the_shaft_loses_its_damping():
    figures = {f: getattr(S1, f) for f in S1.__slots__}
    damped, hardly = (
        fault_space_condition(BearingModel(BearingParameters(**figures | {"c_s": c}))) for c in (200.0, 2e-4)
    )
    # Columns are of unit length, so that it is their directions that count, not the size of c_s.
    inner, outer = (BearingModel(BearingParameters(**figures | {"c_s": 2e-4})).C @ BearingModel(S1).F).T
    assert abs(inner[0] / inner[1]) < 1e-6
    assert abs(outer[0] / outer[1]) < 1e-6
    assert hardly > 1e5 * damped


def test_the_checks_say_from_where_on_the_races_differ():
    by_name = {one.name: one for one in check(S1)}
    assert all(one.passed for one in by_name.values())
    assert "2948 Hz on" in by_name["separation"].explanation
    assert "12860 Hz" in by_name["separation"].explanation
    slow = {one.name: one for one in check(S1, highest_hz=2000.0)}["separation"]
    assert not slow.passed
    assert "inner_or_outer" in slow.explanation
