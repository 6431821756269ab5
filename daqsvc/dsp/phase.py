"""Angles that go round: how far two phases are apart."""

from __future__ import annotations


def deviation_deg(phase_deg: float, reference_deg: float) -> float:
    """How far two phases are apart the shorter way round, in degrees, 0 to 180."""
    return abs((phase_deg - reference_deg + 180.0) % 360.0 - 180.0)
