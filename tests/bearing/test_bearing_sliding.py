"""Sliding-mode units: two states against the scalar form, chatter, and who leaves the surface."""

from __future__ import annotations

import numpy as np
import pytest

from daqsvc.bearing.sliding_mode import RatioRule, SlidingGains, SlidingPair, UnitEnergies
from sim_hw.reproduce.bearing.design import S3
from sim_hw.reproduce.bearing.experiment import INNER_SLOPE, OUTER_SLOPE, PaperUnit

INNER = PaperUnit(INNER_SLOPE, (2.0 / 5**0.5, 1.0 / 5**0.5))
OUTER = PaperUnit(OUTER_SLOPE, (6.0 / 37**0.5, 1.0 / 37**0.5))


def scalar_distance(unit: PaperUnit, residual: np.ndarray, step: float) -> np.ndarray:
    """s+ = soft(s + h n.r, h K) / (1 + h mu), the implicit step of the scalar form."""
    s, path = 0.0, []
    for r in residual:
        s += step * (r[1] - unit.slope * r[0])
        s = np.sign(s) * max(abs(s) - step * unit.pull, 0.0) / (1.0 + step * unit.decay)
        path.append(s)
    return np.array(path)


@pytest.mark.parametrize("unit", [INNER, OUTER])
@pytest.mark.parametrize("step", [1e-3, 0.1])
def test_two_states_and_one_scalar_are_the_same_unit(unit, step):
    residual = 6.0 * np.random.default_rng(0).standard_normal((3000, 2))
    two = unit.distance(unit.run(residual, step))
    one = scalar_distance(unit, residual, step)
    assert np.abs(one).max() > 0.01
    np.testing.assert_allclose(two, one, rtol=0.0, atol=1e-12 * max(1.0, np.abs(one).max()))


def test_the_pair_of_the_service_is_the_scalar_form():
    residual = np.random.default_rng(1).standard_normal((2000, 2))
    gains = SlidingGains(inner=0.8, outer=1.3, leak=0.1)
    distance = SlidingPair(gains).process(residual)
    s = np.zeros(2)
    for n, r in enumerate(residual[:, ::-1]):
        s = s + r
        s = np.sign(s) * np.maximum(np.abs(s) - [0.8, 1.3], 0.0) / 1.1
        np.testing.assert_allclose(distance[n], s, rtol=0.0, atol=1e-12)


def test_the_slopes_are_eigenvectors_with_the_rates_of_the_other():
    assert INNER.decay == pytest.approx(6.0)
    assert OUTER.decay == pytest.approx(2.0)
    assert PaperUnit(2.0, (0.0, 1.0)).decay is None


@pytest.mark.parametrize("step", [1e-3, 1e-2, 0.1])
@pytest.mark.parametrize("unit", [INNER, OUTER])
def test_the_implicit_step_does_not_chatter_and_the_explicit_one_does(unit, step):
    rest = np.zeros((round(40.0 / step), 2))
    late = slice(len(rest) // 2, None)
    implicit = unit.distance(unit.run(rest, step, start=(1.0, 2.0)))[late]
    explicit = unit.distance(unit.run(rest, step, start=(1.0, 2.0), implicit=False))[late]
    assert np.abs(implicit).max() < 1e-12
    assert np.abs(explicit).max() > 0.1 * step * unit.pull


@pytest.mark.parametrize("amplitude", [1.0, 1000.0])
@pytest.mark.parametrize("unit", [INNER, OUTER])
def test_the_matched_unit_stays_for_any_amplitude(unit, amplitude):
    along = np.array([1.0, unit.slope]) / np.hypot(1.0, unit.slope)
    drive = amplitude * np.sin(np.arange(20_000) * 1e-3 * 3.0)[:, None] * along
    assert np.abs(unit.distance(unit.run(drive, 1e-3))).max() < 1e-10 * amplitude


def test_the_unmatched_unit_leaves_from_its_pull_on():
    other = np.array([1.0, OUTER_SLOPE]) / np.hypot(1.0, OUTER_SLOPE)
    across = abs(other[1] - INNER_SLOPE * other[0])
    steady = np.ones((20_000, 1)) * other * INNER.pull / across
    assert np.abs(INNER.distance(INNER.run(0.99 * steady, 1e-3))).max() < 1e-12
    assert np.abs(INNER.distance(INNER.run(1.01 * steady, 1e-3))).max() > 1e-4


def test_a_missing_residual_puts_the_units_back():
    residual = np.ones((300, 2))
    residual[100:110] = np.nan
    distance = SlidingPair(SlidingGains(inner=0.5, outer=0.5)).process(residual)
    assert np.isnan(distance[100:110]).all()
    np.testing.assert_array_equal(distance[110:210], distance[:100])


def test_gains_come_from_the_healthy_residual():
    healthy = np.random.default_rng(2).standard_normal((50_000, 2)) * [1.0, 3.0]
    gains = SlidingGains.from_healthy(healthy, nu=2.0)
    assert gains.inner == pytest.approx(6.0, rel=0.02)
    assert gains.outer == pytest.approx(2.0, rel=0.02)
    with pytest.raises(ValueError, match="none of the 10 healthy residuals"):
        SlidingGains.from_healthy(np.full((10, 2), np.nan))
    with pytest.raises(ValueError, match=r"inner is 0\.0"):
        SlidingGains.from_healthy(np.zeros((10, 2)))


def test_a_unit_whose_gain_pushes_off_is_refused():
    with pytest.raises(ValueError, match="pulls the state away"):
        PaperUnit(-2.0, (-1.0, 1.0))


def energies(inner: float, outer: float) -> UnitEnergies:
    """Of the units, for energies of the races' displacements in units of one."""
    d_in, d_out = S3.k_s / S3.m_r, S3.k_c / S3.m_h
    return UnitEnergies(inner_unit=1.0 + outer * d_out**2, outer_unit=1.0 + inner * d_in**2)


@pytest.mark.parametrize("size", [1e-12, 1e-9, 1e-6])
def test_the_ratio_rule_does_not_depend_on_the_size_of_the_fault(size):
    """A fault of one race that leaks a tenth into the other stays one, however large; a ball is both."""
    rule = RatioRule(S3, UnitEnergies(1.0, 1.0))
    assert rule.judge(energies(size, 0.1 * size)) == "inner"
    assert rule.judge(energies(0.1 * size, size)) == "outer"
    assert rule.judge(energies(size, size)) == "ball"
    assert rule.judge(energies(0.0, 0.0)) == "inner_or_outer"


def test_the_ratio_rule_refuses_an_energy_that_is_none():
    with pytest.raises(ValueError, match="healthy energy of the inner unit is nan"):
        RatioRule(S3, UnitEnergies(float("nan"), 1.0))
