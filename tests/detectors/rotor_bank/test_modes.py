"""What a mode is called, and whether it is one fault alone."""

from __future__ import annotations

import pytest

from daqsvc.detectors.rotor_bank.modes import RotorMode, fault_of, is_one_fault
from daqsvc.rotor.model import RotorParameters

ROTOR = RotorParameters(
    natural_frequency_hz=10.0, damping_ratio=0.1, eccentricity_um=10.0, clearance_um=100.0
)


@pytest.mark.parametrize(
    ("mode", "fault"),
    [
        (RotorMode("U", unbalance_ratio=1.5), "unbalance"),
        (RotorMode("D", damping_ratio=0.05), "damping_loss"),
        (RotorMode("K", stiffness_ratio=0.8), "stiffness_loss"),
        (RotorMode("L", static_load_um=(0.0, -5.0)), "static_load"),
        (RotorMode("R", rub=True, unbalance_ratio=4.0, damping_ratio=0.02), "rub"),
    ],
)
def test_a_mode_of_one_fault(mode, fault):
    assert fault_of(mode, ROTOR) == fault
    assert is_one_fault(mode, ROTOR)


@pytest.mark.parametrize(
    "mode",
    [
        RotorMode("UD", unbalance_ratio=1.5, damping_ratio=0.05),
        RotorMode("KL", stiffness_ratio=0.8, static_load_um=(0.0, -5.0)),
        RotorMode("named otherwise", unbalance_ratio=1.5, fault="stiffness_loss"),
        RotorMode("stiffer", stiffness_ratio=1.2),
        RotorMode("more damped", unbalance_ratio=1.5, damping_ratio=0.2),
        RotorMode("as healthy"),
    ],
)
def test_a_mode_of_several_faults_or_of_none(mode):
    assert not is_one_fault(mode, ROTOR)
