"""Units of accelerometers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

if TYPE_CHECKING:
    from collections.abc import Mapping

AccelerationUnit = Literal["g", "m/s2", "V"]

ACCELERATION_UNITS: tuple[AccelerationUnit, ...] = get_args(AccelerationUnit)

M_S2_PER_UNIT: Mapping[AccelerationUnit, float] = {"g": 9.80665, "m/s2": 1.0}
"""Volts are missing: what they mean only the sensor's sensitivity tells."""
