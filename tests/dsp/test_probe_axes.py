"""Two probes make an orbit, whichever way they look and the shaft turns."""

from __future__ import annotations

import math

import numpy as np
import pytest

from daqsvc.dsp.probes import probes_to_xy, shaft_axes_deg


def seen(xy, angles_deg):
    angles = np.radians(angles_deg)
    return xy @ np.vstack((np.cos(angles), np.sin(angles)))


@pytest.mark.parametrize("angles_deg", [(0.0, 90.0), (45.0, 135.0), (-20.0, 40.0), (200.0, 90.0)])
def test_probes_come_back_as_x_and_y(angles_deg):
    xy = np.random.default_rng(0).standard_normal((50, 2))
    np.testing.assert_allclose(seen(xy, angles_deg) @ probes_to_xy(angles_deg), xy, atol=1e-12)


@pytest.mark.parametrize("angles_deg", [(0.0, 90.0), (30.0, 110.0)])
def test_a_clockwise_shaft_turns_from_x_to_y_and_still_hangs_down(angles_deg):
    turn = -2.0 * math.pi * np.arange(64) / 64.0
    xy = np.column_stack((np.cos(turn), np.sin(turn) - 3.0))
    axes = shaft_axes_deg(angles_deg, clockwise=True)
    x, y = (seen(xy, angles_deg) @ probes_to_xy(axes)).T
    np.testing.assert_allclose(x, -xy[:, 0], atol=1e-12)
    np.testing.assert_allclose(y, xy[:, 1], atol=1e-12)
    assert (np.diff(np.unwrap(np.angle(x + 1j * (y + 3.0)))) > 0.0).all()
    assert shaft_axes_deg(angles_deg, clockwise=False) == angles_deg
