"""One revolution in five complex numbers: exact for whatever samples are there."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.rotor_orbits import HEALTHY, orbits

from daqsvc.dsp.speed.revolutions import Revolutions
from daqsvc.rotor.synchronous.vectors import HARMONICS, SynchronousVectors, synchronous_vectors

VECTORS = np.array(
    [[3 - 4j, 20 + 1j, 2 - 1j, 0.5j, -0.25], [3 - 4j, 25j, 1 + 1j, 0.1, 0.2j], [1 + 1j, 5.0, -5.0, 2.0, 1.0]]
)


def test_whole_revolutions_are_recovered_exactly():
    fitted = synchronous_vectors(orbits(VECTORS))
    np.testing.assert_allclose(fitted.vectors, VECTORS, atol=1e-12)
    np.testing.assert_allclose(fitted.noise, 0.0, atol=1e-12)
    assert fitted.samples.tolist() == [64.0, 64.0, 64.0]
    assert fitted.end_index.tolist() == [64, 128, 192]


@pytest.mark.parametrize("period", [17.3, 50.77, 333.31])
def test_revolutions_of_a_broken_number_of_samples_are_recovered_exactly(period):
    """With harmonics taken as orthogonal, the mean position would leak into 1X by about 1 / period."""
    count = int(5 * period)
    index = np.arange(count)
    turns = index / period
    z = np.exp(2j * math.pi * np.outer(turns, HARMONICS)) @ VECTORS[0]
    revolution = np.floor(turns).astype(int)
    starts = np.searchsorted(revolution, np.arange(revolution[-1]))
    keep = revolution < revolution[-1]
    cut = Revolutions(
        first_index=100,
        xy=np.column_stack((z.real, z.imag))[keep],
        angle_rad=(2.0 * math.pi * turns % (2.0 * math.pi))[keep],
        starts=starts,
        period_samples=np.full(len(starts), period),
        trusted=np.ones(len(starts), dtype=bool),
    )
    fitted = synchronous_vectors(cut)
    np.testing.assert_allclose(fitted.vectors, np.tile(VECTORS[0], (len(starts), 1)), atol=1e-9)
    assert fitted.end_index[-1] == 100 + keep.sum()


def test_3x_in_both_senses_is_kept_besides_and_moves_nothing_else():
    vectors = np.hstack((VECTORS, [[0.3, -0.2j], [0.0, 0.1], [1.0, 1j]]))
    cut = orbits(vectors)
    cut.xy[5:8] = np.nan
    fitted = synchronous_vectors(cut)
    np.testing.assert_allclose(fitted.thrice[1:], vectors[1:, 5:], atol=1e-9)
    np.testing.assert_allclose(fitted.thrice[0], vectors[0, 5:], atol=0.05)
    np.testing.assert_allclose(fitted.vectors[1:], VECTORS[1:], atol=1e-9)


def test_too_few_samples_in_a_revolution_have_no_3x():
    fitted = synchronous_vectors(orbits(VECTORS, per_rev=12))
    assert fitted.usable.all()
    assert np.isnan(fitted.thrice).all()


def test_missing_samples_change_nothing_but_the_count():
    cut = orbits(VECTORS)
    cut.xy[64 + 5 : 64 + 12] = np.nan
    fitted = synchronous_vectors(cut)
    np.testing.assert_allclose(fitted.vectors, VECTORS, atol=1e-9)
    assert fitted.samples.tolist() == [64.0, 57.0, 64.0]


def test_a_revolution_with_too_little_of_it_there_is_not_fitted():
    cut = orbits(VECTORS)
    cut.xy[64 : 64 + 20] = np.nan
    fitted = synchronous_vectors(cut)
    assert fitted.usable.tolist() == [True, False, True]
    assert np.isnan(fitted.vectors[1]).all()
    np.testing.assert_allclose(fitted.vectors[[0, 2]], VECTORS[[0, 2]], atol=1e-9)


def test_a_revolution_whose_angle_is_not_trusted_is_not_fitted():
    cut = orbits(VECTORS)
    cut.trusted[2] = False
    assert synchronous_vectors(cut).usable.tolist() == [True, True, False]


def test_the_residual_is_the_noise_of_a_sample():
    fitted = synchronous_vectors(orbits(np.tile(HEALTHY, (400, 1)), noise_um=3.0))
    assert fitted.noise.mean() == pytest.approx(2.0 * 3.0**2, rel=0.02)
    scatter = np.var(fitted.vectors[:, 1])
    assert scatter == pytest.approx(fitted.noise.mean() / 64, rel=0.15)


def test_no_revolutions_make_no_vectors():
    fitted = synchronous_vectors(orbits(np.empty((0, 5))))
    assert len(fitted) == 0
    assert fitted.vectors.shape == (0, 5)


def test_parts_are_joined_in_order():
    whole = synchronous_vectors(orbits(VECTORS))
    parts = SynchronousVectors.joined([whole[:1], whole[1:]])
    np.testing.assert_array_equal(parts.vectors, whole.vectors)
    np.testing.assert_array_equal(parts.end_index, whole.end_index)
