"""Physical and normalised quantities of the rotor and of its modes, both ways, at any speed and its sign."""

from __future__ import annotations

import cmath
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.rotor_runs import physical_rotor

from daqsvc.detectors.rotor_bank.modes import RotorMode, bank_modes
from daqsvc.rotor.model import NormalisedRotor

pytestmark = pytest.mark.property
POSITIVE = st.floats(1e-2, 1e2)
ROTORS = st.builds(
    NormalisedRotor,
    w=st.floats(0.1, 3.0).flatmap(lambda w: st.sampled_from((w, -w))),
    e=st.floats(1e-3, 0.5),
    zeta=st.floats(1e-3, 1.0),
    k=st.floats(0.3, 3.0),
    g=st.floats(-1.0, 1.0),
    load_x=st.floats(-1.0, 1.0),
    contact_stiffness=st.floats(0.0, 1e4),
    alpha=st.floats(1.0, 2.0),
    mu=st.floats(0.0, 0.5),
    heavy_spot_rad=st.floats(-math.pi, math.pi),
    contact_radius=st.floats(1.0, 1e4),
)


@given(rotor=ROTORS, natural_frequency_hz=POSITIVE, clearance_um=POSITIVE)
def test_physical_rotor_is_the_same_rotor(rotor, natural_frequency_hz, clearance_um):
    physical = physical_rotor(rotor, natural_frequency_hz=natural_frequency_hz, clearance_um=clearance_um)
    speed_rpm = 60.0 * natural_frequency_hz * rotor.w
    again = physical.normalised(speed_rpm)
    # Its own natural frequency has become the unit of time: lengths stay, times are sqrt(k) longer.
    assert again.w * math.sqrt(rotor.k) == pytest.approx(rotor.w)
    assert again.k == 1.0
    assert again.zeta * math.sqrt(rotor.k) == pytest.approx(rotor.zeta)
    assert again.contact_stiffness * rotor.k == pytest.approx(rotor.contact_stiffness)
    assert again.contact_radius == pytest.approx(rotor.contact_radius)
    assert physical.contact_radius_um == pytest.approx(rotor.contact_radius * clearance_um)
    assert (again.alpha, again.mu) == (rotor.alpha, rotor.mu)
    assert cmath.isclose(again.orbit(), rotor.orbit(), rel_tol=1e-9)
    assert cmath.isclose(again.rest, rotor.rest, rel_tol=1e-9, abs_tol=1e-12)


@given(
    rotor=ROTORS,
    clearance_um=POSITIVE,
    damping_ratio=st.floats(1e-3, 1.0),
    unbalance_ratio=st.floats(0.0, 5.0),
    stiffness_ratio=st.floats(0.3, 1.5),
    load=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
)
def test_modes_move_what_their_fault_moves(
    rotor, clearance_um, damping_ratio, unbalance_ratio, stiffness_ratio, load
):
    physical = physical_rotor(rotor, natural_frequency_hz=10.0, clearance_um=clearance_um)
    modes = [
        RotorMode("N"),
        RotorMode("U", unbalance_ratio=unbalance_ratio),
        RotorMode("D", damping_ratio),
        RotorMode("K", stiffness_ratio=stiffness_ratio),
        RotorMode("L", static_load_um=(load[0] * clearance_um, load[1] * clearance_um)),
    ]
    healthy, unbalanced, damped, soft, loaded = (
        mode.rotor for mode in bank_modes(modes, physical, 600.0 * rotor.w)
    )
    assert healthy == physical.normalised(600.0 * rotor.w)
    assert cmath.isclose(unbalanced.orbit(), unbalance_ratio * healthy.orbit(), rel_tol=1e-9, abs_tol=1e-300)
    assert unbalanced.rest == healthy.rest
    assert (damped.zeta, damped.e, damped.rest) == (damping_ratio, healthy.e, healthy.rest)
    # The weight bends a softer shaft farther.
    assert cmath.isclose(soft.rest * stiffness_ratio, healthy.rest, rel_tol=1e-9, abs_tol=1e-12)
    assert cmath.isclose(loaded.rest - healthy.rest, complex(*load), rel_tol=1e-9, abs_tol=1e-9)
    assert loaded.orbit() == healthy.orbit()


@given(rotor=ROTORS)
def test_other_direction_of_rotation_is_the_mirror_image(rotor):
    mirrored = NormalisedRotor(
        w=-rotor.w, e=rotor.e, zeta=rotor.zeta, k=rotor.k, heavy_spot_rad=-rotor.heavy_spot_rad
    )
    assert cmath.isclose(mirrored.orbit(), rotor.orbit().conjugate(), rel_tol=1e-9)
