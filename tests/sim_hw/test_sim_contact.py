from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hw.plants.rotor import contact_force

pytestmark = pytest.mark.property
angles = st.floats(-math.pi, math.pi)
speeds = st.floats(-50, 50)


@given(
    angles, st.floats(1.001, 3.0), speeds, speeds, st.floats(0, 1e5), st.floats(1, 3), st.floats(0, 1), speeds
)
def test_the_housing_pushes_inwards_and_friction_opposes_the_sliding_rim(
    angle, r, v_radial, v_tangential, stiffness, exponent, friction, rim_speed
):
    cos, sin = math.cos(angle), math.sin(angle)
    vx, vy = v_radial * cos - v_tangential * sin, v_radial * sin + v_tangential * cos
    fx, fy = contact_force(r * cos, vx, r * sin, vy, stiffness, exponent, friction, rim_speed)
    normal = stiffness * (r - 1) ** exponent
    assert fx * cos + fy * sin == pytest.approx(-normal, rel=1e-9, abs=1e-9)
    tangential = -fx * sin + fy * cos
    sliding_speed = rim_speed + v_tangential
    if abs(sliding_speed) > 1e-9:
        assert tangential == pytest.approx(
            -math.copysign(friction * normal, sliding_speed), rel=1e-9, abs=1e-9
        )


@given(angles, st.floats(0.0, 0.999), speeds, speeds)
def test_no_force_inside_the_clearance(angle, r, vx, vy):
    force = contact_force(r * math.cos(angle), vx, r * math.sin(angle), vy, 30.0, 1.5, 0.3, 500.0)
    assert force == (0.0, 0.0)
