"""Sensors on a simulated machine: white noise at a stated ratio, and a keyphasor probe."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

KEYPHASOR_REST_V = -10.0
KEYPHASOR_PULSE_V = -2.0
KEYPHASOR_WIDTH_REV = 1 / 16


def noise_sigma(amplitude: float, snr_db: float) -> float:
    """Standard deviation of the sensor noise at a signal-to-noise ratio.

    The ratio is that of the AC power of a harmonic, ``amplitude**2 / 2``, to the noise's variance in
    the whole band from 0 to half the sampling rate. Taken once, from the healthy orbit: sensors do
    not become noisier because the machine does.

    Args:
        amplitude: of the healthy 1X vibration in one channel, in any unit.
        snr_db: ratio in dB.

    Returns:
        The standard deviation in the unit of ``amplitude``.
    """
    return amplitude / math.sqrt(2.0) * math.pow(10.0, -snr_db / 20.0)


def keyphasor_voltage(revolution: Floats) -> Floats:
    """What a keyphasor probe sees of the mark on the shaft, in volts.

    One raised-cosine pulse a revolution, from -10 V up to -2 V, a sixteenth of a revolution wide. Its
    rising edge crosses the middle, -6 V, exactly at shaft angle zero, and is smooth enough for that
    crossing to be interpolated between samples.

    Args:
        revolution: float64 ``[n]``, shaft angle in revolutions.

    Returns:
        float64 ``[n]`` in volts.
    """
    # The pulse is half way up a quarter of its width before its top.
    from_top = np.mod(revolution - KEYPHASOR_WIDTH_REV / 4 + 0.5, 1.0) - 0.5
    height = 0.5 + 0.5 * np.cos(2 * np.pi * from_top / KEYPHASOR_WIDTH_REV)
    height[np.abs(from_top) > KEYPHASOR_WIDTH_REV / 2] = 0.0
    return KEYPHASOR_REST_V + (KEYPHASOR_PULSE_V - KEYPHASOR_REST_V) * height
