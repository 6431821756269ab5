"""When the speed of a machine has come to another step."""

from __future__ import annotations

import math

HYSTERESIS = 0.25
"""Steps by which the speed goes beyond a boundary, or back over it, before that counts."""


class SpeedSteps:
    """Follows the speed over steps of equal height.

    A speed that wanders about a boundary is on the step where it came from.

    Args:
        every_rpm: their height.
    """

    def __init__(self, every_rpm: float) -> None:
        self._every_rpm = every_rpm
        self._step: int | None = None

    def is_new(self, speed_rpm: float) -> bool:
        """Whether the speed is on another step than the last time; of either direction of rotation."""
        if not math.isfinite(speed_rpm):
            return False
        steps = abs(speed_rpm) / self._every_rpm
        if self._step is None:
            self._step = math.floor(steps)
            return False
        if self._step - HYSTERESIS <= steps < self._step + 1 + HYSTERESIS:
            return False
        self._step = math.floor(steps)
        return True
