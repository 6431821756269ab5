"""Detection on the total residual: a generalised likelihood ratio after Whittle.

On the healthy machine the residual is a stationary Gaussian process with the covariance S_0(f), learnt from a
record of it. Hits add their energy: in every line along the direction in which displacements of the races
stand out best against S_0, with the spectrum s(f) of a short dip, and of unknown size a. Let q(f) be the mean
over frames of the whitened energy in that direction, 1 on the healthy machine, and l(f) the ratio of s to the
noise there. The logarithm of the likelihood ratio is then

    max over a of  n sum over f of  q a l / (1 + a l) - ln(1 + a l)

with n independent frames. On the healthy machine q is an F variate: both the window and what was learnt are
finite. The limit is the quantile at the stated rate of false alarms, by a seeded simulation of those.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing import hit
from daqsvc.bearing.model import BearingModel
from daqsvc.bearing.residual import CORNER_HZ

if TYPE_CHECKING:
    from daqsvc.bearing.model import BearingParameters, Floats

FRAME_S = 384 / 48_000
"""Length of a frame: the ringing that is left in the residual, and the lines fine enough for it."""
LOWEST_HZ, HIGHEST_PER_NYQUIST = 250.0, 0.85
LEAST_FRAMES = 24
DRAWS = 8_000
_CHUNK = 500
_SIZES = 10.0 ** np.arange(-3.0, 3.0, 0.25)


@dataclass(frozen=True, slots=True)
class Detection:
    """What the likelihood ratio says of a window.

    Attributes:
        detected: whether the statistic is above the limit.
        statistic: logarithm of the likelihood ratio in nats.
        limit: above which a fault is detected.
        false_alarm_rate: per window, for which the limit stands.
    """

    detected: bool
    statistic: float
    limit: float
    false_alarm_rate: float


class WhittleDetector:
    """Tells whether the residual holds more than that of the healthy machine.

    Args:
        parameters: of the healthy bearing.
        rate_hz: sampling rate.
        healthy: float64 ``[n, 2]``, residual of the healthy machine with the usual corner, in m/s^2; frames
            with NaN are left out.
        false_alarm_rate: per window.

    Raises:
        ValueError: the healthy residual is too short or singular, or the rate is not between 0 and 0.5.
    """

    def __init__(
        self,
        parameters: BearingParameters,
        rate_hz: float,
        healthy: Floats,
        *,
        false_alarm_rate: float = 0.003,
    ) -> None:
        if not 0.0 < false_alarm_rate < 0.5:
            raise ValueError(
                f"bearing detection: a false-alarm rate of {false_alarm_rate:g}; it must be between 0 and 0.5"
            )
        self.false_alarm_rate = false_alarm_rate
        self._frame = 2 * round(FRAME_S * rate_hz / 2.0)
        frequency_hz = np.asarray(np.fft.rfftfreq(self._frame, 1.0 / rate_hz), dtype=np.float64)
        self._kept = (frequency_hz > LOWEST_HZ) & (frequency_hz < HIGHEST_PER_NYQUIST * rate_hz / 2.0)
        learnt = hit.spectra(healthy, self._frame)[:, self._kept]
        if len(learnt) < LEAST_FRAMES:
            raise ValueError(
                f"bearing detection: {len(healthy) / rate_hz:.2f} s of healthy residual; "
                f"{(LEAST_FRAMES + 1) * self._frame / 2.0 / rate_hz:.2f} s or more without gaps are needed"
            )
        self._learnt = len(learnt)
        noise = hit.covariance(learnt)
        if not np.linalg.det(noise).real.min() > 0.0:
            raise ValueError(
                "bearing detection: the two components of the healthy residual are constant or alike; check "
                "that both accelerometers are alive and not the same"
            )
        # Displacements of the races along D: what stands out best is the first of two whitened directions.
        precision = np.linalg.inv(noise)
        D = np.diag(BearingModel(parameters).D)
        strengths, directions = np.linalg.eigh(D[:, None] * precision * D)
        best = strengths[:, 1]
        self._along = np.einsum("fij,fj->fi", precision * D, directions[:, :, 1]) / np.sqrt(best)[:, None]
        # A direction that was learnt from k frames finds 2 / k more in others than in its own.
        self._along /= np.sqrt(1.0 + 2.0 / self._learnt)
        ratio = hit.power(frequency_hz[self._kept], CORNER_HZ) * best
        sizes = _SIZES[:, None] * ratio / ratio.max()
        self._weights, self._costs = sizes / (1.0 + sizes), np.log1p(sizes).sum(axis=1)
        self._limits: dict[int, float] = {}

    def judge(self, residual: Floats) -> Detection:
        """Hold a window against the healthy machine.

        Args:
            residual: float64 ``[n, 2]`` in m/s^2; frames with NaN are left out.

        Raises:
            ValueError: there is no whole frame in it.
        """
        frames = hit.spectra(residual, self._frame)[:, self._kept]
        if not len(frames):
            raise ValueError(
                f"bearing detection: no {self._frame} consecutive residuals among {len(residual)}; "
                "use longer windows"
            )
        energies = np.abs(np.einsum("tfi,fi->tf", frames, self._along.conj())) ** 2
        statistic = float(self._statistic(energies.mean(axis=0), len(frames)))
        limit = self._limit(len(frames))
        return Detection(statistic > limit, statistic, limit, self.false_alarm_rate)

    def _statistic(self, energies: Floats, frames: int) -> Floats:
        likelihood = energies @ self._weights.T - self._costs
        return np.asarray(hit.INDEPENDENT * frames * likelihood.max(axis=-1))

    def _limit(self, frames: int) -> float:
        if frames not in self._limits:
            rng = np.random.default_rng(frames)
            window, learnt = (2.0 * hit.INDEPENDENT * n for n in (frames, self._learnt))
            lines = int(self._kept.sum())
            drawn = [
                self._statistic(rng.f(window, learnt, (_CHUNK, lines)), frames)
                for _ in range(DRAWS // _CHUNK)
            ]
            self._limits[frames] = float(np.quantile(np.concatenate(drawn), 1.0 - self.false_alarm_rate))
        return self._limits[frames]
