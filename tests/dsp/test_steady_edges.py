"""A keyphasor with sharp flanks: known to half a sample from one edge, far better from the last sixteen."""

from __future__ import annotations

import numpy as np
import pytest

from daqsvc.dsp.speed.revolutions import KeyphasorCutter


def cut(turns, period, block=None):
    """Revolutions of a shaft at these turns of every sample, with pulses as sharp as the samples allow."""
    marker = np.where(turns % 1.0 < 0.1, 5.0, 0.0)
    cutter = KeyphasorCutter(threshold=2.5, hysteresis=0.5, period_samples=period)
    xy = np.column_stack((np.cos(2.0 * np.pi * turns), np.sin(2.0 * np.pi * turns)))
    parts = [slice(i, i + (block or len(turns))) for i in range(0, len(turns), block or len(turns))]
    return [cutter.process(xy[part], marker[part]) for part in parts]


def errors(found, period, begin=20):
    """Errors of the angle in samples, after the first revolutions."""
    angle = found.angle_rad / (2.0 * np.pi)
    true = (np.arange(len(angle)) + found.first_index) / period
    error = (angle - true + 0.5) % 1.0 - 0.5
    return error[int(begin * period) :] * period


@pytest.mark.parametrize("period", [64.0, 61.37, 17.9, 333.3])
def test_the_angle_is_known_far_better_than_half_a_sample(period):
    (found,) = cut(np.arange(int(200 * period)) / period, period)
    assert found.trusted.all()
    error = errors(found, period)
    assert error.std() < 0.1
    assert np.abs(error - error.mean()).max() < 0.3


def test_rounding_of_the_pulses_does_not_make_the_shaft_jump():
    """Edges on a sample's very time fall before or after it by rounding alone, some for revolutions."""
    angle = 2.0 * np.pi * np.arange(120 * 64) / 64
    (found,) = cut(angle / (2.0 * np.pi), 64.0)
    error = errors(found, 64.0)
    assert np.ptp(error) < 0.6
    assert (np.abs(np.diff(error[::64])) > 0.12).sum() <= 2


def test_a_change_of_speed_is_followed():
    sample = np.arange(400 * 64)
    turns = sample / 64.0 + 0.3 * np.sin(2.0 * np.pi * sample / (100 * 64))
    (found,) = cut(turns, 64.0)
    true = turns[found.first_index : found.first_index + len(found.angle_rad)]
    error = (found.angle_rad / (2.0 * np.pi) - true + 0.5) % 1.0 - 0.5
    error = 64.0 * error[20 * 64 :]
    assert np.abs(error - error.mean()).max() < 1.05


def test_blocks_make_no_difference():
    turns = np.arange(3000) / 61.37
    (whole,) = cut(turns, 61.37)
    parts = cut(turns, 61.37, block=97)
    np.testing.assert_array_equal(np.concatenate([part.angle_rad for part in parts]), whole.angle_rad)
