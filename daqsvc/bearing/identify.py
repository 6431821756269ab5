"""What a healthy machine's vibration predicts of itself: an innovations model from its own recording.

One accelerometer gives an autoregressive model, two give its vector form. What the model cannot predict, the
innovations, is white on the healthy machine; a change of the machine makes them larger or coloured
(`daqsvc.bearing.identify_change`). Identified by Whittle's recursion on the autocovariance (P. Whittle,
Biometrika 50, 1963): every order up to the highest in one pass, each of them stable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from scipy.fft import next_fast_len
from scipy.special import chdtrc

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Flags: TypeAlias = NDArray[np.bool_]
    Floats: TypeAlias = NDArray[np.float64]

MOST_ORDER = 128
LEAST_SAMPLES = 2048
"""A model of a few dozen coefficients needs some dozens of samples for each."""
_SAMPLES_PER_ORDER = 40
_LEAST_PAIRS = 0.02
"""Share of a lag's pairs that is taken to be there at least."""
_WHITE_NOISE = 1e-8
"""Part of the power that is added as white noise: above the anti-aliasing filter there may be none at all."""
_GOOD_ENOUGH = 0.01
"""An order is high enough if its one-step error is within this part of that of the best one."""
_WHITENESS_LAGS = 40


class NotIdentifiableError(ValueError):
    """Samples from which no healthy machine can be learnt; the message names thing, value and remedy."""


class Whiteness(NamedTuple):
    """How white the innovations are.

    Attributes:
        p_value: of Hosking's portmanteau test over the first `_WHITENESS_LAGS` lags; long recordings of any
            real machine fail it.
        predictable: part of the innovations' power that a further model of that order would predict; what
            matters in practice.
    """

    p_value: float
    predictable: float


@dataclass(frozen=True, slots=True)
class InnovationsModel:
    """A vector autoregressive model: x[t] = sum_k A_k x[t - k] + e[t].

    Attributes:
        coefficients: float64 ``[order, m, m]``, A_1 and so on.
        covariance: float64 ``[m, m]`` of the innovations, in units of the samples squared.
        rate_hz: sampling rate.
        whiteness: of the innovations on the samples that it was made of.
    """

    coefficients: Floats
    covariance: Floats
    rate_hz: float
    whiteness: Whiteness

    @property
    def order(self) -> int:
        """How many samples back it looks."""
        return len(self.coefficients)

    @property
    def channels(self) -> int:
        """How many accelerometers it is about."""
        return len(self.covariance)

    @property
    def spectral_radius(self) -> float:
        """Largest modulus of a pole; the model is stable below 1."""
        p, m = self.order, self.channels
        if p == 0:
            return 0.0
        companion = np.eye(p * m, k=-m)
        companion[:m] = self.coefficients.transpose(1, 0, 2).reshape(m, p * m)
        return float(np.abs(np.linalg.eigvals(companion)).max())

    def innovations(self, samples: Floats) -> Floats:
        """Innovations, whitened between the channels: unit covariance on the healthy machine.

        Args:
            samples: float64 ``[n, m]`` without their mean, n above the order; NaN where missing.

        Returns:
            float64 ``[n - order, m]``; NaN where a sample that is needed is missing.
        """
        p, n = self.order, len(samples)
        there = complete(samples)
        known = np.where(there[:, np.newaxis], samples, 0.0)
        size = next_fast_len(n + p, real=True)
        taps = np.concatenate((np.eye(self.channels)[np.newaxis], -self.coefficients))
        spectrum = np.einsum("fij,fj->fi", np.fft.rfft(taps, size, axis=0), np.fft.rfft(known, size, axis=0))
        found = np.fft.irfft(spectrum, size, axis=0)[p:n]
        found = np.linalg.solve(np.linalg.cholesky(self.covariance), found.T).T
        if not there.all():
            lost = np.convolve(~there, np.ones(p + 1))[p:n] > 0.5
            found[lost] = np.nan
        return np.asarray(found, dtype=np.float64)


def identify(samples: Floats, rate_hz: float, most_order: int = MOST_ORDER) -> InnovationsModel:
    """Learn the innovations model of a healthy machine.

    The order is the lowest one whose one-step error is within 1 % of that of the order that Schwarz's
    criterion (BIC) takes.

    Args:
        samples: float64 ``[n, m]`` of one or two accelerometers; NaN where missing.
        rate_hz: sampling rate.
        most_order: highest order that is tried.

    Raises:
        NotIdentifiableError: there are too few samples, a channel does not move, or no stable model exists.
    """
    n, m = samples.shape
    there = complete(samples)
    if int(there.sum()) < LEAST_SAMPLES:
        raise NotIdentifiableError(
            f"{int(there.sum())} samples are too few to learn the healthy machine from; "
            f"give {LEAST_SAMPLES} or more"
        )
    centred = np.where(there[:, np.newaxis], samples - samples[there].mean(axis=0), 0.0)
    scale = centred.std(axis=0)
    if not (scale > 0.0).all():
        raise NotIdentifiableError(
            f"channel {int(np.argmin(scale)) + 1} does not move at all; check the sensor and its cable"
        )
    most = max(1, min(most_order, int(there.sum()) // (_SAMPLES_PER_ORDER * m)))
    # Channels of very different size would spoil the conditioning: unit variance first, and back at the end.
    ladder = _sound(_whittle(_autocovariance(centred / scale, most, int(there.sum()), there)))
    errors = np.array([np.linalg.slogdet(step.covariance)[1] for step in ladder])
    criterion = errors + np.arange(len(ladder)) * m * m * np.log(n) / n
    best = int(np.argmin(criterion))
    order = int(np.flatnonzero(errors <= errors[best] + m * _GOOD_ENOUGH)[0])
    step = ladder[order]
    coefficients = scale[:, np.newaxis] * step.coefficients / scale
    covariance = scale[:, np.newaxis] * step.covariance * scale
    model = InnovationsModel(coefficients, covariance, rate_hz, Whiteness(1.0, 0.0))
    residual = model.innovations(np.where(there[:, np.newaxis], centred, np.nan))
    model = InnovationsModel(coefficients, covariance, rate_hz, whiteness(residual))
    if not model.spectral_radius < 1.0:
        raise NotIdentifiableError(
            f"the model of order {order} is not stable (pole at {model.spectral_radius:.6f}): the signal is "
            "no stationary vibration; give a recording at steady speed, unclipped"
        )
    return model


def whiteness(innovations: Floats, lags: int = _WHITENESS_LAGS) -> Whiteness:
    """How white innovations are.

    Args:
        innovations: float64 ``[n, m]``; NaN where missing.
        lags: how many lags are looked at.
    """
    there = complete(innovations)
    n, m = int(there.sum()), innovations.shape[1]
    known = np.where(there[:, np.newaxis], innovations - innovations[there].mean(axis=0), 0.0)
    covariances = _autocovariance(known, lags, n)
    root = np.linalg.inv(np.linalg.cholesky(covariances[0]))
    correlations = np.einsum("ij,kjl,ml->kim", root, covariances[1:], root)
    # Hosking (JASA 75, 1980); each lag has n - k products.
    statistic = n * n * float(((correlations**2).sum(axis=(1, 2)) / (n - np.arange(1, lags + 1))).sum())
    ladder = _whittle(covariances)
    gained = np.linalg.slogdet(ladder[0].covariance)[1] - np.linalg.slogdet(ladder[-1].covariance)[1]
    # So much even white noise seems to be predicted by its own sample correlations.
    by_chance = lags * m * m / n
    return Whiteness(
        float(chdtrc(m * m * lags, statistic)), float(-np.expm1(-max(0.0, gained - by_chance) / m))
    )


def complete(samples: Floats) -> Flags:
    """Rows of ``[n, m]`` in which nothing is missing, bool ``[n]``."""
    return np.asarray(np.isfinite(samples).all(axis=1))


class _Step(NamedTuple):
    """The best predictor of one order: float64 ``[order, m, m]`` and the covariance of its error."""

    coefficients: Floats
    covariance: Floats


def _sound(ladder: list[_Step]) -> list[_Step]:
    """The predictors up to the first whose error is none: lags that lack samples need not fit each other."""
    sound = [np.linalg.eigvalsh(step.covariance)[0] > 0.0 for step in ladder]
    return ladder if all(sound) else ladder[: sound.index(False)]


def _autocovariance(samples: Floats, lags: int, count: int, there: Flags | None = None) -> Floats:
    """E[x(t + k) x(t)'] for k = 0 to ``lags``, float64 ``[lags + 1, m, m]``; positive definite as a whole.

    Args:
        samples: float64 ``[n, m]`` without their mean; 0 where missing.
        lags: how many.
        count: how many samples are not missing.
        there: bool ``[n]``, which are. If given, a lag with fewer pairs is not the smaller for it, and the
            whole may fall short of positive definite.
    """
    n, m = samples.shape
    size = next_fast_len(n + lags, real=True)
    pairs = np.ones(lags + 1)
    if there is not None and not there.all():
        power = np.abs(np.fft.rfft(there, size)) ** 2
        # Of a whole recording each lag has n - k pairs, and is divided by n all the same.
        pairs = np.fft.irfft(power, size)[: lags + 1] / (n - np.arange(lags + 1)) * (n / count)
    spectrum = np.fft.rfft(samples, size, axis=0)
    found = np.empty((lags + 1, m, m))
    for i in range(m):
        for j in range(m):
            cross = np.fft.irfft(spectrum[:, i] * spectrum[:, j].conj(), size)
            found[:, i, j] = cross[: lags + 1] / count / np.maximum(pairs, _LEAST_PAIRS)
    found[0] += _WHITE_NOISE * np.diag(np.diag(found[0]))
    return found


def _whittle(covariances: Floats) -> list[_Step]:
    """Best predictors of order 0, 1 and so on (Whittle 1963).

    Args:
        covariances: float64 ``[orders + 1, m, m]``.
    """
    m = covariances.shape[1]
    forward = np.zeros((0, m, m))
    backward = np.zeros((0, m, m))
    ahead = behind = covariances[0]
    ladder = [_Step(forward, ahead)]
    for order in range(len(covariances) - 1):
        left = covariances[order + 1] - np.einsum("kij,kjl->il", forward, covariances[order:0:-1])
        last_forward = np.linalg.solve(behind, left.T).T  # both covariances are symmetric
        last_backward = np.linalg.solve(ahead, left).T
        forward, backward = (
            np.concatenate((forward - last_forward @ backward[::-1], last_forward[np.newaxis])),
            np.concatenate((backward - last_backward @ forward[::-1], last_backward[np.newaxis])),
        )
        ahead = ahead - last_forward @ left.T
        behind = behind - last_backward @ left
        ahead, behind = 0.5 * (ahead + ahead.T), 0.5 * (behind + behind.T)
        ladder.append(_Step(forward, ahead))
    return ladder
