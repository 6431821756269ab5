"""The shaft angle of every sample of a stream, by the pulses of its keyphasor."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.quality.unit import beyond_any_unit
from daqsvc.dsp.speed.keyphasor import KeyphasorTracker

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.diagnosis.detector import Window
    from daqsvc.dsp.speed.keyphasor import KeyphasorProbe

    Floats = NDArray[np.float64]

_SPEED_RATIO = 10.0
"""A shaft is followed from this part of its stated speed on, and up to this multiple, as in a run-up."""
_SHORTEST_PERIOD = 3.0
_SILENT_REVOLUTIONS = 4.0
"""After so long without a pulse the angle is a guess: the shaft stands still, or the keyphasor is lost."""


class ShaftAngle:
    """Follows the keyphasor of a stream, window by window.

    Args:
        keyphasor: the keyphasor, by its column of the stream.
        period_samples: samples per revolution at the stated speed.

    Raises:
        ValueError: too few samples make a revolution for its pulse to be seen.
    """

    def __init__(self, keyphasor: KeyphasorProbe, period_samples: float) -> None:
        self.name = keyphasor.name
        self._column = keyphasor.column
        shortest = max(period_samples / _SPEED_RATIO, min(_SHORTEST_PERIOD, 0.8 * period_samples))
        self._tracker = KeyphasorTracker(
            threshold=keyphasor.threshold_v,
            hysteresis=keyphasor.hysteresis_v,
            edge=keyphasor.edge,
            period_samples=period_samples,
            period_range=(shortest, _SPEED_RATIO * period_samples),
        )
        self._next_index: int | None = None

    def of(self, window: Window) -> Floats:
        """Float64 ``[n]``, rad from the mark in the direction of rotation; NaN where it is not known."""
        return np.concatenate([self._of_part(part) for part in window.parts()])

    def _of_part(self, part: Window) -> Floats:
        if part.first_index != self._next_index or part.breaks or part.snapshot:
            self._tracker.reset(keep_speed=True)
        self._next_index = part.first_index + len(part.samples)
        volts = part.samples[:, self._column].astype(np.float64)
        if beyond_any_unit(part.samples[:, self._column]):
            self._tracker.reset(keep_speed=True)
            return np.full(len(volts), math.nan)
        angle_rad = self._tracker.process(volts).angle_rad
        if self._tracker.revolutions_since_edge > _SILENT_REVOLUTIONS:
            angle_rad[:] = math.nan
        return angle_rad
