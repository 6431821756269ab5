"""What is known of an impact beforehand: its spectrum, frames of the residual, and whether these show bursts.

A race is named by which side the excess is on, and any excess is on some side. A noisier sensor, a changed
gain and steady forces look like one race or the other, too. But they are stationary, and impacts are not. In
frames as short as an impact, the energies of stationary Gaussian noise scatter in a known way, whatever its
level and spectrum. Those of impacts scatter more, for some frames hold one and others do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.bearing.model import BearingModel
from daqsvc.bearing.residual import ORDER
from daqsvc.rounding import rounded_up

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.bearing.model import Complexes, Floats

    Mask: TypeAlias = NDArray[np.bool_]
    from daqsvc.bearing.model import BearingParameters


LOWEST_HZ = 250.0
DIP_HZ = 2_500.0
"""Bandwidth of the displacement as a rolling element passes a spall."""
INDEPENDENT = 1.0 / ((1.0 + 2.0 / 36.0) * (1.0 + 2.0 * (4.0 / 9.0 + 1.0 / 36.0)))
"""Of the lines of half-overlapping Hann frames: frames correlate by 1/6, lines by 2/3 and 1/6."""


@dataclass(frozen=True, slots=True)
class HealthySpectrum:
    """What the frames of the healthy machine were like.

    Attributes:
        covariance: complex128 ``[f, 2, 2]``, mean cross-spectrum of the two components, line by line.
        frames: half-overlapping frames that it is the mean of.
    """

    covariance: Complexes
    frames: int


def power(frequency_hz: Floats, corner_hz: float) -> Floats:
    """Power spectrum of the dips of an impact in the residual, up to its size.

    Args:
        frequency_hz: float64 ``[n]``.
        corner_hz: of the residual generator's high-pass.
    """
    s = 1j * frequency_hz
    high_pass = np.abs(s / (s + corner_hz)) ** (2 * ORDER)
    return np.asarray(high_pass / (1.0 + (frequency_hz / DIP_HZ) ** 2) ** 3, dtype=np.float64)


def frame_lines(rate_hz: float, frame_s: float, highest_per_nyquist: float) -> tuple[int, Floats, Mask]:
    """Samples of a frame, frequencies of the lines of its spectrum that are used, and which of all these are.

    Args:
        rate_hz: sampling rate.
        frame_s: length of a frame.
        highest_per_nyquist: where the lines end, as a part of half the sampling rate.
    """
    frame = 2 * round(frame_s * rate_hz / 2.0)
    frequency_hz = np.asarray(np.fft.rfftfreq(frame, 1.0 / rate_hz), dtype=np.float64)
    kept = (frequency_hz > LOWEST_HZ) & (frequency_hz < highest_per_nyquist * rate_hz / 2.0)
    return frame, frequency_hz[kept], kept


def spectra(residual: Floats, frame: int) -> Complexes:
    """Spectra of the whole half-overlapping Hann frames of a residual, those with NaN left out.

    Args:
        residual: float64 ``[n, 2]``.
        frame: samples.

    Returns:
        complex128 ``[t, frame // 2 + 1, 2]``.
    """
    if len(residual) < frame:
        return np.zeros((0, frame // 2 + 1, 2), dtype=np.complex128)
    cut = np.lib.stride_tricks.sliding_window_view(residual, frame, axis=0)[:: frame // 2]
    cut = cut[np.isfinite(cut).all(axis=(1, 2))]
    return np.asarray(np.fft.rfft(cut * np.hanning(frame), axis=2).swapaxes(1, 2), dtype=np.complex128)


def healthy_spectrum(
    residual: Floats, rate_hz: float, frame: int, kept: Mask, least: int, purpose: str
) -> HealthySpectrum:
    """What the frames of the residual of a healthy machine are like.

    Args:
        residual: float64 ``[n, 2]``.
        rate_hz: its sampling rate.
        frame: samples.
        kept: bool ``[frame // 2 + 1]``, lines that are examined.
        least: frames that are needed.
        purpose: of the spectrum, for people.

    Raises:
        ValueError: there are fewer frames without NaN.
    """
    learnt = spectra(residual, frame)[:, kept]
    if len(learnt) < least:
        raise ValueError(
            f"bearing {purpose}: {len(residual) / rate_hz:.2f} s of healthy residual; "
            f"{rounded_up(((least - 1) * (frame // 2) + frame) / rate_hz)} s or more without gaps are needed"
        )
    return HealthySpectrum(covariance(learnt), len(learnt))


def best_direction(noise: Complexes, D: Floats) -> tuple[Complexes, Floats]:
    """Where displacements of the races stand out best against noise: the first of two whitened directions.

    Args:
        noise: complex128 ``[f, 2, 2]``, its covariance.
        D: float64 ``[2]``, accelerations of unit displacements.

    Returns:
        complex128 ``[f, 2]``, whose inner product with a spectrum has a mean square of 1 on noise; float64
        ``[f]``, mean square of unit displacements in it.
    """
    precision = np.linalg.inv(noise)
    strengths, directions = np.linalg.eigh(D[:, None] * precision * D)
    best = np.asarray(strengths[:, 1])
    along = np.einsum("fij,fj->fi", precision * D, directions[:, :, 1]) / np.sqrt(best)[:, None]
    return np.asarray(along, dtype=np.complex128), best


def energy_correlation(lines: int) -> Floats:
    """Of the energies of neighbouring lines under a Hann window: float64 ``[lines, lines]``."""
    apart = np.abs(np.subtract.outer(np.arange(lines), np.arange(lines)))
    return np.where(apart < 3, np.take([1.0, 4.0 / 9.0, 1.0 / 36.0], apart, mode="clip"), 0.0)


def covariance(frames: Complexes) -> Complexes:
    """Mean cross-spectrum of frames: complex128 ``[f, 2, 2]``."""
    return np.asarray(np.einsum("tfi,tfj->fij", frames, frames.conj()) / len(frames), dtype=np.complex128)


STEADY = 2.0
"""Scatter of the energies over that of stationary noise, below which there are no impacts. Half a second of
it has 0.8 to 1.3, a fault at -5 dB 5 and more."""
_LEAST_FRAMES = 32


class BurstMeter:
    """Measures how a residual scatters.

    Args:
        parameters: of the healthy bearing.
        healthy: of the healthy machine, by `daqsvc.bearing.isolation.isolation_spectrum`.
        frame: samples of a frame of that.
        kept: bool ``[frame // 2 + 1]``, its lines.
    """

    def __init__(
        self, parameters: BearingParameters, healthy: HealthySpectrum, frame: int, kept: Mask
    ) -> None:
        self._frame, self._kept = frame, kept
        along, _ = best_direction(healthy.covariance, np.diag(BearingModel(parameters).D))
        self._along = along.conj()
        self._alike = energy_correlation(len(along))

    def measure(self, residual: Floats) -> float:
        """Variance of the frames' energies over that of stationary noise; NaN if too little is there.

        Every line counts by what it holds beyond the healthy machine's noise.

        Args:
            residual: float64 ``[n, 2]`` in m/s^2; frames with NaN are left out.
        """
        frames = spectra(residual, self._frame)[:, self._kept]
        if len(frames) < _LEAST_FRAMES:
            return math.nan
        energies = np.abs(np.einsum("tfi,fi->tf", frames, self._along)) ** 2
        mean = energies.mean(axis=0)
        weight = np.maximum(1.0 - 1.0 / mean, 0.0)
        stationary = weight @ self._alike @ weight
        if not stationary > 0.0:
            return math.nan
        return float((energies / mean @ weight).var() / stationary)
