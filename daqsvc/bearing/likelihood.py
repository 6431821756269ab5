"""Detection on the total residual: a generalised likelihood ratio after Whittle.

On the healthy machine the residual is a stationary Gaussian process with the covariance S_0(f), learnt from a
record of it. Impacts add their energy: in every line along the direction in which displacements of the races
stand out best against S_0, with the spectrum s(f) of a short dip, and of unknown size a. Let e(t, f) be the
whitened energy of frame t in that direction, 1 on average on the healthy machine, and l(f) the ratio of s to
the noise there. A frame that holds an impact is then likelier by

    L(t, a) = sum over f of  e a l / (1 + a l) - ln(1 + a l)

nats. Not every frame holds one: a spall is loaded for a part of the revolution, and rolling elements come at
their own pace. With p the share of frames that do, the logarithm of the likelihood ratio of a window is

    max over a of  sum over t of  ln(1 - p + p exp L(t, a))

Where impacts come in bursts it is larger than that of the mean energy, and in steady noise it is not. The
limit is the quantile at the stated rate of false alarms, by a seeded simulation of Gaussian frames that are
compared with a healthy machine learnt from as many frames as this one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from daqsvc.bearing import impact
from daqsvc.bearing.model import BearingModel
from daqsvc.bearing.residual import CORNER_HZ

if TYPE_CHECKING:
    from daqsvc.bearing.impact import HealthySpectrum
    from daqsvc.bearing.model import BearingParameters, Floats

FRAME_S = 384 / 48_000
"""Length of a frame: the ringing that is left in the residual, and the lines fine enough for it."""
HIGHEST_PER_NYQUIST = 0.85
LEAST_FRAMES = 24
STRUCK = 0.3
"""Share of the frames that hold an impact, if there are any."""
DRAWN_FRAMES = 200_000
"""In all the windows that the limit is simulated with."""
_TAIL = 0.05
"""The likelihood ratio falls off exponentially beyond this quantile."""
_EXACT_FRAMES, _PER_OCTAVE = 256, 16
"""Longer windows share a limit with those that are at most a sixteenth of an octave longer."""
_FRAMES_AT_A_TIME = 128
_COUNTS = 1e-3
"""Lines in which impacts show less against the noise than by this share of the best decide nothing."""
_SIZES = 10.0 ** np.arange(-3.0, 3.0, 0.25)
_LARGEST_NATS = 500.0
_BEFORE = 3.0 - math.sqrt(8.0)
"""Of the frame before in a frame: half-overlapping Hann frames correlate by 1/6."""


@dataclass(frozen=True, slots=True)
class Detection:
    """What the likelihood ratio states about a window.

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


def detection_spectrum(residual: Floats, rate_hz: float) -> HealthySpectrum:
    """What `WhittleDetector` has to know of the healthy machine.

    Args:
        residual: float64 ``[n, 2]``, of the healthy machine with the usual corner, in m/s^2; frames with NaN
            are left out.
        rate_hz: sampling rate.

    Raises:
        ValueError: the residual is too short.
    """
    frame, _, kept = impact.frame_lines(rate_hz, FRAME_S, HIGHEST_PER_NYQUIST)
    return impact.healthy_spectrum(residual, rate_hz, frame, kept, LEAST_FRAMES, "detection")


class WhittleDetector:
    """Tests whether the residual holds more than that of the healthy machine.

    Args:
        parameters: of the healthy bearing.
        rate_hz: sampling rate.
        healthy: of the healthy machine, by `detection_spectrum`.
        false_alarm_rate: per window.
        repeatability_db: standard deviation of the healthy machine's level from run to run, which no single
            record of it shows: a rise that such a change explains at the stated rate is no fault.

    Raises:
        ValueError: the healthy residual is singular or of another rate, or a rate is not between 0 and 0.5.
    """

    def __init__(
        self,
        parameters: BearingParameters,
        rate_hz: float,
        healthy: HealthySpectrum,
        *,
        false_alarm_rate: float = 0.003,
        repeatability_db: float = 0.0,
    ) -> None:
        if not 0.0 < false_alarm_rate < 0.5:
            raise ValueError(
                f"bearing detection: a false-alarm rate of {false_alarm_rate:g}; it must be between 0 and 0.5"
            )
        self.false_alarm_rate = false_alarm_rate
        self._frame, frequency_hz, self._kept = impact.frame_lines(rate_hz, FRAME_S, HIGHEST_PER_NYQUIST)
        self._learnt = healthy.frames
        noise = healthy.covariance
        if len(noise) != self._kept.sum():
            raise ValueError(
                f"bearing detection: a healthy spectrum of {len(noise)} lines; there are {self._kept.sum()} "
                f"at {rate_hz:g} samples a second: learn it at this rate"
            )
        if not np.linalg.det(noise).real.min() > 0.0:
            raise ValueError(
                "bearing detection: the two components of the healthy residual are constant or alike; check "
                "that both accelerometers are alive and not the same"
            )
        along, best = impact.best_direction(noise, np.diag(BearingModel(parameters).D))
        ratio = impact.power(frequency_hz, CORNER_HZ) * best
        shows = ratio >= _COUNTS * ratio.max()
        self._kept[self._kept] = shows
        # A direction that was learnt from k frames finds 2 / k more in others than in its own.
        allowed_db = -float(ndtri(false_alarm_rate)) * repeatability_db
        expected = (1.0 + 2.0 / self._learnt) * 10.0 ** (allowed_db / 10.0)
        self._along = along[shows].conj() / math.sqrt(expected)
        sizes = _SIZES[:, None] * ratio[shows] / ratio.max()
        self._weights, self._costs = sizes / (1.0 + sizes), np.log1p(sizes).sum(axis=1)
        self._limits: dict[int, float] = {}

    def judge(self, residual: Floats) -> Detection:
        """Hold a window against the healthy machine.

        Args:
            residual: float64 ``[n, 2]`` in m/s^2; frames with NaN are left out.

        Raises:
            ValueError: there is no whole frame in it.
        """
        frames = impact.spectra(residual, self._frame)[:, self._kept]
        if not len(frames):
            raise ValueError(
                f"bearing detection: no {self._frame} consecutive residuals among {len(residual)}; "
                "use longer windows"
            )
        statistic = float(self._nats(np.abs(np.einsum("tfi,fi->tf", frames, self._along)) ** 2).max())
        limit = self._limit(len(frames))
        return Detection(statistic > limit, statistic, limit, self.false_alarm_rate)

    def _nats(self, energies: Floats) -> Floats:
        """Logarithm of the likelihood ratio, float64 ``[sizes]``, of frames of energies ``[t, f]``."""
        struck = impact.INDEPENDENT * (energies @ self._weights.T - self._costs)
        nats = np.log1p(STRUCK * np.expm1(np.minimum(struck, _LARGEST_NATS)))
        return np.asarray((nats + np.maximum(struck - _LARGEST_NATS, 0.0)).sum(axis=0))

    def _limit(self, frames: int) -> float:
        if frames > _EXACT_FRAMES:
            frames = math.ceil(2.0 ** (math.ceil(_PER_OCTAVE * math.log2(frames)) / _PER_OCTAVE))
        if frames not in self._limits:
            drawn = np.array(self._drawn(frames))
            ordinary = float(np.quantile(drawn, 1.0 - _TAIL))
            if self.false_alarm_rate >= _TAIL:
                self._limits[frames] = float(np.quantile(drawn, 1.0 - self.false_alarm_rate))
            else:
                excess = float((drawn[drawn > ordinary] - ordinary).mean())
                self._limits[frames] = ordinary + excess * math.log(_TAIL / self.false_alarm_rate)
        return self._limits[frames]

    def _drawn(self, frames: int) -> list[float]:
        """Statistics of simulated windows of the healthy machine."""
        rng = np.random.default_rng(frames)
        lines = len(self._along)
        alike = np.linalg.cholesky(impact.energy_correlation(lines))
        deviation = math.sqrt((1.0 + 2.0 / 36.0) / self._learnt)
        power = 2.0 * (1.0 + _BEFORE**2) * (1.0 + 2.0 * 0.5**2)
        parts = [
            len(part) for part in np.array_split(np.arange(frames), math.ceil(frames / _FRAMES_AT_A_TIME))
        ]
        drawn = []
        for _ in range(math.ceil(DRAWN_FRAMES / frames)):
            nats = np.zeros(len(_SIZES))
            learnt = power * np.exp(deviation * (alike @ rng.standard_normal(lines)))
            for part in parts:
                noise = rng.standard_normal((2, part + 1, lines + 2), dtype=np.float32)  # real, imaginary
                noise = noise[:, 1:] + _BEFORE * noise[:, :-1]
                # A Hann window makes a line of three.
                seen = noise[..., 1:-1] - 0.5 * (noise[..., :-2] + noise[..., 2:])
                nats += self._nats(np.square(seen).sum(axis=0) / learnt)
            drawn.append(float(nats.max()))
        return drawn
