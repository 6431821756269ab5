"""Detection on the total residual: a generalised likelihood ratio after Whittle, band by band.

On the healthy machine the two residuals are a stationary Gaussian process, whose cross-spectrum is learnt per
band of frequency. A fault adds energy, of a spectrum that nobody knows. In band b, whitened by the healthy
cross-spectrum, let r_b be the mean energy with n_b degrees of freedom; the likelihood ratio of "more energy
here" to "none" is n_b (r_b - 1 - ln r_b) / 2 where r_b > 1, else 0. The statistic is the sum over the bands.
Under the healthy machine r_b is an F variate: both the window and what was learnt are finite. The limit is
the quantile of the sum at the stated rate of false alarms, by a seeded simulation of those variates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from daqsvc.bearing.model import Complexes, Floats

FRAME = 512
"""Samples of a periodogram, Hann windowed, half overlapping."""
BANDS = 24
DRAWS = 20_000
_INDEPENDENT = 1.0 / ((1.0 + 2.0 / 36.0) * (1.0 + 2.0 * (4.0 / 9.0 + 1.0 / 36.0)))
"""Of the lines of half-overlapping Hann frames: frames correlate by 1/6, lines by 2/3 and 1/6."""


@dataclass(frozen=True, slots=True)
class Detection:
    """What the likelihood ratio says of a window.

    Attributes:
        detected: whether the statistic is above the limit.
        statistic: logarithm of the likelihood ratio in nats.
        limit: above which a fault is detected.
        false_alarm_rate: per window, for which the limit stands.
        energy_ratios: float64 ``[bands]``, whitened energy over the healthy one.
    """

    detected: bool
    statistic: float
    limit: float
    false_alarm_rate: float
    energy_ratios: Floats


class WhittleDetector:
    """Tells whether the total residual holds more than that of the healthy machine.

    Args:
        healthy: float64 ``[n, 2]``, residual of the healthy machine; NaN rows end or begin a stretch.
        false_alarm_rate: per window.

    Raises:
        ValueError: the healthy residual is too short, without noise, or the rate is not between 0 and 0.5.
    """

    def __init__(self, healthy: Floats, *, false_alarm_rate: float = 0.003) -> None:
        if not 0.0 < false_alarm_rate < 0.5:
            raise ValueError(
                f"bearing detection: a false-alarm rate of {false_alarm_rate:g}; it must be between 0 and 0.5"
            )
        spectra = _frames(healthy)
        if len(spectra) < BANDS:
            raise ValueError(
                f"bearing detection: the healthy residual has {len(spectra)} frames of {FRAME} samples; "
                f"{BANDS} are needed: record the healthy machine for longer"
            )
        self.false_alarm_rate = false_alarm_rate
        # Band edges leave out the lines at zero and at the Nyquist frequency.
        self._edges = np.linspace(1, FRAME // 2, BANDS + 1).round().astype(np.int64)
        covariance = np.einsum("tfi,tfj->fij", spectra, spectra.conj()) / len(spectra)
        if not np.linalg.det(covariance).real.min() > 0.0:
            raise ValueError("bearing detection: the healthy residual is constant or its parts are alike")
        self._learnt_frames = len(spectra)
        # The inverse of a covariance that was learnt from few frames is too large on average (Wishart).
        frames = self._learnt_frames / (1.0 + 2.0 / 36.0)
        self._whitening = np.linalg.inv(covariance) * (frames - 2.0) / frames
        self._limits: dict[int, float] = {}

    def judge(self, residual: Floats) -> Detection:
        """Hold a window against the healthy machine.

        Args:
            residual: float64 ``[n, 2]``; frames with NaN are left out.

        Raises:
            ValueError: there is no whole frame in it.
        """
        spectra = _frames(residual)
        if not len(spectra):
            raise ValueError(
                f"bearing detection: no {FRAME} consecutive residuals among {len(residual)}; "
                "use longer windows"
            )
        lines = np.einsum("tfi,fij,tfj->f", spectra.conj(), self._whitening, spectra).real
        energies = np.add.reduceat(lines[: self._edges[-1]], self._edges[:-1])
        ratios = energies / (2.0 * len(spectra) * np.diff(self._edges))
        statistic = float(_likelihood_ratio(ratios, self._degrees(len(spectra))))
        limit = self._limit(len(spectra))
        return Detection(statistic > limit, statistic, limit, self.false_alarm_rate, ratios)

    def _degrees(self, frames: int) -> Floats:
        """Degrees of freedom of each band: two channels, two quadratures."""
        return np.asarray(4.0 * _INDEPENDENT * frames * np.diff(self._edges))

    def _limit(self, frames: int) -> float:
        if frames not in self._limits:
            rng = np.random.default_rng(frames)
            window, learnt = self._degrees(frames), self._degrees(self._learnt_frames)
            ratios = rng.f(window, learnt, size=(DRAWS, BANDS))
            drawn = _likelihood_ratio(ratios, window)
            self._limits[frames] = float(np.quantile(drawn, 1.0 - self.false_alarm_rate))
        return self._limits[frames]


def _likelihood_ratio(ratios: Floats, degrees: Floats) -> Floats:
    above = np.maximum(ratios, 1.0)
    return np.asarray((degrees / 2.0 * (above - 1.0 - np.log(above))).sum(axis=-1))


def _frames(residual: Floats) -> Complexes:
    """Spectra of the whole frames, complex128 ``[t, f, 2]``."""
    if len(residual) < FRAME:
        return np.zeros((0, FRAME // 2 + 1, 2), dtype=np.complex128)
    cut = np.lib.stride_tricks.sliding_window_view(residual, FRAME, axis=0)[:: FRAME // 2]
    cut = cut[np.isfinite(cut).all(axis=(1, 2))]
    spectra = np.fft.rfft(cut * np.hanning(FRAME), axis=2)
    return np.asarray(spectra.swapaxes(1, 2), dtype=np.complex128)
