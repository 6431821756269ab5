"""The measures that alarms with setpoints watch: their names, their units, and what each of them needs."""

from __future__ import annotations

from typing import Literal

Measure = Literal[
    "rms",
    "peak",
    "peak_to_peak",
    "crest_factor",
    "kurtosis",
    "velocity_rms",
    "velocity_rms_2_1000",
    "1x_amplitude",
    "1x_phase_lag",
    "2x_amplitude",
    "2x_phase_lag",
    "not_1x_rms",
    "not_1x_peak_to_peak",
    "gap_voltage",
    "value",
]

ListedMeasure = Literal[
    "kurtosis",
    "velocity_rms_2_1000",
    "1x_amplitude",
    "1x_phase_lag",
    "2x_amplitude",
    "2x_phase_lag",
    "not_1x_rms",
    "not_1x_peak_to_peak",
]
"""Those that are made of a sensor only if a file lists them, or an alarm watches them: `ON_REQUEST`."""

KURTOSIS = "kurtosis"
VELOCITY = "velocity_rms"
SLOW_VELOCITY = "velocity_rms_2_1000"
SLOW_BAND_HZ = (2.0, 1000.0)
"""Of machines that turn at `SLOW_RPM` or less (ISO 20816-3)."""
SLOW_RPM = 600.0
VELOCITIES = (VELOCITY, SLOW_VELOCITY)
ISO_BAND_HZ = (10.0, 1000.0)
"""Of the velocity whose zones ISO 20816-3 has, above `SLOW_RPM`."""
SAMPLES_PER_PERIOD = 2.56
"""How fast a device must sample, beside the highest frequency that counts: the usual figure of analysers."""

AMPLITUDES = ("1x_amplitude", "2x_amplitude")
PHASES = ("1x_phase_lag", "2x_phase_lag")
PHASE_OF = dict(zip(AMPLITUDES, PHASES, strict=True))
NOT_1X = ("not_1x_rms", "not_1x_peak_to_peak")
OF_THE_SHAFT = (*AMPLITUDES, *PHASES, *NOT_1X)
"""Measures that need the angle of the shaft, or its speed."""

ON_REQUEST = (KURTOSIS, SLOW_VELOCITY, *OF_THE_SHAFT)


def highest_hz(rate_hz: float) -> float:
    """Up to where samples show a vibration for certain, in Hz: filters end before half the rate does."""
    return float(f"{0.4 * rate_hz:.3g}")


def shows_1x(rate_hz: float, speed_rpm: float, low_hz: float) -> bool:
    """Whether a velocity RMS from ``low_hz`` on, of samples at this rate, can hold 1X of the machine.

    Args:
        rate_hz: sampling rate.
        speed_rpm: of the machine; its sign does not matter.
        low_hz: where the band of the velocity begins.
    """
    return highest_hz(rate_hz) > low_hz and highest_hz(rate_hz) >= abs(speed_rpm) / 60.0


UNITS = {
    VELOCITY: "mm/s",
    SLOW_VELOCITY: "mm/s",
    "gap_voltage": "V",
    "crest_factor": "",
    KURTOSIS: "",
    **dict.fromkeys(PHASES, "deg"),
}
"""Units of measures that are not in that of the sensor; empty for a pure number."""
