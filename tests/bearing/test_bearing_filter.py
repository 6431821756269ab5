"""The detection filters: the paper's error and its cure, and the generator that runs."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples
from test_bearing_model import random_parameters

from daqsvc.bearing.model import BearingModel, transfer
from daqsvc.bearing.residual import DELAY, TwoSensorResidual
from sim_hw.reproduce.bearing.design import (
    S1,
    S2,
    S3,
    fixed_eigenvalues,
    paper_gain,
    residual_transfer,
    separating_gain,
    separation_deg,
)

EVERY = [S1, S2, S3]
RATE_HZ = 48_000.0
AUDIBLE_HZ = np.geomspace(10.0, 10_000.0, 300)


def leak(response: np.ndarray) -> float:
    """Largest share of a fault that shows in the other's residual."""
    own = np.abs(response[:, [0, 1], [0, 1]])
    other = np.abs(response[:, [1, 0], [0, 1]])
    return float((other / own).max())


@pytest.mark.parametrize("parameters", EVERY)
def test_the_gain_of_the_paper_makes_the_fault_maps_eigenvectors(parameters):
    model = BearingModel(parameters)
    closed = model.A + paper_gain(model, (-50.0, -80.0)) @ model.C
    expected = model.F * [-50.0, -80.0]
    # F is itself of the order of 1e9; its products with A of 1e16.
    assert np.abs(closed @ model.F - expected).max() <= 1e-12 * np.abs(model.A).max() * np.abs(model.F).max()


@pytest.mark.parametrize("parameters", EVERY)
def test_the_filter_of_the_paper_separates_its_own_error_equation_only(parameters):
    """e' = (A + LC) e - F u keeps each fault in a fixed direction; real y adds L D u, and both look alike."""
    model = BearingModel(parameters)
    gain = paper_gain(model, (-1.0, -2.0))
    slow_hz = np.geomspace(30.0, 1000.0, 50)
    literal = transfer(model.A + gain @ model.C, -model.F, model.C, model.D, slow_hz)
    expected = model.D - (model.C @ model.F) / (2j * np.pi * slow_hz[:, None, None] + [1.0, 2.0])
    assert (np.abs(literal - expected) / np.abs(expected).max()).max() < 1e-6
    assert separation_deg(residual_transfer(model, gain, slow_hz)).max() < 2.5


@pytest.mark.parametrize("parameters", EVERY)
def test_the_separating_gain_separates_at_every_frequency(parameters):
    model = BearingModel(parameters)
    eigenvalues = (-100.0, -200.0)
    response = residual_transfer(model, separating_gain(model, eigenvalues), AUDIBLE_HZ)
    assert leak(response) <= 1e-9
    assert separation_deg(response).min() > 90.0 - 1e-6
    s = 2j * np.pi * AUDIBLE_HZ
    for i in (0, 1):
        np.testing.assert_allclose(response[:, i, i], model.D[i, i] * s / (s - eigenvalues[i]), rtol=1e-9)


@pytest.mark.parametrize("parameters", EVERY)
def test_the_separating_gain_leaves_four_eigenvalues_at_the_origin(parameters):
    model = BearingModel(parameters)
    closed = model.A + separating_gain(model, (-100.0, -200.0)) @ model.C
    eigenvalues = np.sort(np.abs(np.linalg.eigvals(closed)))
    # A fourfold eigenvalue is only found to the fourth root of the rounding.
    assert (eigenvalues[:4] < 1e-3 * np.abs(closed).max() ** 0.5).all()
    assert eigenvalues[4:] == pytest.approx([100.0, 200.0], rel=0.2)


def test_no_filter_of_the_paper_is_ever_unstable():
    rng = np.random.default_rng(1)
    for _ in range(2000):
        model = BearingModel(random_parameters(rng))
        fixed = fixed_eigenvalues(model)
        a3, a2, a1, a0 = fixed.cubic
        assert a2 * a1 > a3 * a0
        assert fixed.slowest_per_s > 0.0


@pytest.mark.parametrize("parameters", EVERY)
def test_the_fixed_eigenvalues_are_those_of_the_closed_loop(parameters):
    model = BearingModel(parameters)
    closed = model.A + paper_gain(model, (-31.0, -57.0)) @ model.C
    eigenvalues = np.linalg.eigvals(closed)
    for root in fixed_eigenvalues(model).roots:
        assert np.abs(eigenvalues - root).min() < 1e-6 * np.abs(root)


def test_an_eigenvalue_that_does_not_decay_is_refused():
    with pytest.raises(ValueError, match="eigenvalue 3"):
        separating_gain(BearingModel(S1), (-1.0, 3.0))


def separated(generator: TwoSensorResidual, frequency_hz: np.ndarray) -> np.ndarray:
    plant = BearingModel(generator.parameters).fault_transfer_by_stiffness(frequency_hz)
    return generator.sampled_response(frequency_hz)[:, :, :2] @ plant


@pytest.mark.parametrize("parameters", EVERY)
def test_the_generator_is_the_inverse_of_the_faults_under_a_high_pass(parameters):
    generator, model = TwoSensorResidual(parameters, RATE_HZ), BearingModel(parameters)
    frequency_hz = np.geomspace(100.0, 20_000.0, 200)
    response = generator.response(frequency_hz)[:, :, :2] @ model.fault_transfer_by_stiffness(frequency_hz)
    high_pass = (1j * frequency_hz / (1j * frequency_hz + 300.0)) ** 6
    expected = high_pass[:, None, None] * model.D
    assert (np.abs(response - expected) / np.abs(expected).max(axis=(1, 2), keepdims=True)).max() < 1e-8


@pytest.mark.parametrize("parameters", EVERY)
def test_the_sampled_generator_separates(parameters):
    """To a fiftieth of a displacement up to 10 kHz at 48 kHz, two samples late."""
    generator, model = TwoSensorResidual(parameters, RATE_HZ), BearingModel(parameters)
    frequency_hz = np.geomspace(300.0, 10_000.0, 200)
    displacement = np.linalg.inv(model.D) @ separated(generator, frequency_hz)
    assert leak(displacement) <= 0.02
    delay = np.exp(-2j * np.pi * frequency_hz * DELAY / RATE_HZ)
    high_pass = (1j * frequency_hz / (1j * frequency_hz + 300.0)) ** 6
    for i in (0, 1):
        assert np.abs(displacement[:, i, i] / (high_pass * delay) - 1.0).max() < 0.02


@pytest.mark.parametrize("parameters", EVERY)
@pytest.mark.parametrize("shaft_hz", [10.0, 30.0, 300.0, 3000.0])
def test_a_healthy_machine_with_known_unbalance_leaks_little(parameters, shaft_hz):
    generator, model = TwoSensorResidual(parameters, RATE_HZ), BearingModel(parameters)
    n = np.arange(round(0.5 * RATE_HZ))
    turning = np.exp(2j * np.pi * shaft_hz * n / RATE_HZ)
    y = np.outer(turning, transfer(model.A, model.B, model.C, model.E, np.array([shaft_hz]))[0, :, 0]).real
    residual = generator.process(y, turning.real)[generator.settling :]
    assert np.abs(residual).max() <= 0.01 * np.abs(y).max()


def test_an_offset_of_a_sensor_does_not_show():
    generator = TwoSensorResidual(S1, RATE_HZ)
    y = np.tile([9.81, -3.0], (20_000, 1))
    assert np.nanmax(np.abs(generator.process(y))) < 1e-6


@settings(max_examples=examples(30), deadline=None)
@given(cuts=st.lists(st.integers(0, 3000), max_size=8), missing=st.lists(st.integers(0, 2999), max_size=3))
def test_blocks_may_be_cut_anywhere(cuts, missing):
    y = np.random.default_rng(2).standard_normal((3000, 2))
    y[missing, 1] = np.nan
    v = np.random.default_rng(3).standard_normal(3000)
    whole = TwoSensorResidual(S3, RATE_HZ).process(y, v)
    generator = TwoSensorResidual(S3, RATE_HZ)
    edges = [0, *sorted(cuts), 3000]
    parts = [generator.process(y[a:b], v[a:b]) for a, b in itertools.pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_after_missing_samples_the_residual_is_missing_until_settled():
    generator = TwoSensorResidual(S3, RATE_HZ)
    y = np.random.default_rng(4).standard_normal((6000, 2))
    y[2000:2010] = np.nan
    missing = np.isnan(generator.process(y)).any(axis=1)
    assert missing[: generator.settling].all()
    assert not missing[generator.settling : 2000].any()
    assert missing[2000 : 2010 + generator.settling].all()
    assert not missing[2010 + generator.settling :].any()


def test_inputs_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"\[100, 3\]"):
        TwoSensorResidual(S1, RATE_HZ).process(np.zeros((100, 3)))
    with pytest.raises(ValueError, match="corner of 30000 Hz"):
        TwoSensorResidual(S1, RATE_HZ, corner_hz=30_000.0)
