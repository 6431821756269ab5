"""What a healthy machine's vibration predicts of itself: an innovations model from its own recording.

One accelerometer gives an autoregressive model, two give its vector form. What the model cannot predict, the
innovations, is white on the healthy machine; a change of the machine makes them larger or coloured
(`compare_residual`). Identified by Whittle's recursion on the autocovariance (P. Whittle,
Biometrika 50, 1963): every order up to the highest in one pass, each of them stable.

Innovations of windows of half a second are measured as a whole and in bands, in dB over the healthy machine.
How much these figures scatter from window to window while the machine is healthy makes the limit. A change is
significant at a stated probability of a false alarm, and of a size that matters. That innovations have grown
shows that something has changed, not what.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from scipy.fft import next_fast_len
from scipy.special import chdtrc, stdtrit

from daqsvc import heap
from daqsvc.errors.recordings import NOT_HEALTHY

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

    code = NOT_HEALTHY


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
        innovations = np.fft.irfft(spectrum, size, axis=0)[p:n]
        innovations = np.linalg.solve(np.linalg.cholesky(self.covariance), innovations.T).T
        if not there.all():
            lost = np.convolve(~there, np.ones(p + 1))[p:n] > 0.5
            innovations[lost] = np.nan
        return np.asarray(innovations, dtype=np.float64)


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
    # Of long recordings each step takes some hundred MB for a moment.
    heap.give_back()
    residual = model.innovations(np.where(there[:, np.newaxis], centred, np.nan))
    del centred
    heap.give_back()
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
        lags: how many lags are examined.
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
    # Even white noise seems to be predicted this much by its own sample correlations.
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
    covariances = np.empty((lags + 1, m, m))
    for i in range(m):
        for j in range(m):
            product = spectrum[:, j].conj()
            product *= spectrum[:, i]
            cross = np.fft.irfft(product, size)[: lags + 1].copy()
            covariances[:, i, j] = cross / count / np.maximum(pairs, _LEAST_PAIRS)
    covariances[0] += _WHITE_NOISE * np.diag(np.diag(covariances[0]))
    return covariances


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


WINDOW_S = 0.5
LEAST_WINDOWS = 8
BANDS = 8
LOWEST_HZ = 400.0
"""Below lie the shaft's own orders: a change of these shows nothing about the bearing."""
_WINDOWS_OF_SHORT = 16
"""A recording of less than as many windows is cut into so many shorter ones."""
_LEAST_WINDOW_SAMPLES = 1024
HIGHEST = 0.48
"""Of the sampling rate: above, the anti-aliasing filter."""
_LOWEST = 0.08
"""Of the sampling rate: where that is below `LOWEST_HZ`."""
_MOST_MISSING = 0.25
_UNSTEADY_DB = 3.0
"""No half second of a healthy machine is so far from the median one, nor its first half from its second."""
_UNSTEADY_SPREADS = 6.0
_FIRST_QUARTILE = 0.6745


@dataclass(frozen=True, slots=True)
class ChangeRules:
    """What counts as a change.

    Attributes:
        false_alarm_probability: of one judgement of an unchanged machine, at most.
        least_db: growth of all innovations that matters.
        least_band_db: the same in one band.
        repeatability_db: standard deviation from run to run that no single recording of the healthy machine
            shows: temperature, load, how the sensor is mounted.
        stopped_db: a machine so much quieter than the healthy one stands still, or its sensor is loose.
        gain_db: a rise by so much that is the same in all bands is one of the gain or the unit.
    """

    false_alarm_probability: float = 1e-3
    least_db: float = 2.0
    least_band_db: float = 3.0
    repeatability_db: float = 0.8
    stopped_db: float = -10.0
    gain_db: float = 12.0

    def __post_init__(self) -> None:
        if not 0.0 < self.false_alarm_probability < 0.5:
            raise ValueError(
                f"false_alarm_probability = {self.false_alarm_probability} is no probability below 0.5"
            )


@dataclass(frozen=True, slots=True)
class HealthyResidual:
    """The healthy machine: its innovations model, and how large the innovations are, window by window.

    Attributes:
        model: the innovations model.
        window_samples: length of a window.
        edges_hz: float64 ``[BANDS + 1]``, edges of the bands.
        mean_db: float64 ``[1 + BANDS]``, mean over the windows: all bands together, then each.
        spread_db: float64 ``[1 + BANDS]``, standard deviation from window to window.
        windows: how many there were.
        rms: float64 ``[m]``, of each accelerometer, in its unit, without the mean.
    """

    model: InnovationsModel
    window_samples: int
    edges_hz: Floats
    mean_db: Floats
    spread_db: Floats
    windows: int
    rms: Floats

    def levels_db(self, samples: Floats) -> Floats:
        """Innovations of windows in dB, all together and by band.

        Args:
            samples: float64 ``[n, m]``; NaN where missing.

        Returns:
            float64 ``[windows, 1 + BANDS]``; NaN where more than a quarter of a window is missing.
        """
        length, order = self.window_samples, self.model.order
        count = len(samples) // length
        rows = np.full((count, 1 + BANDS), np.nan)
        place = np.searchsorted(np.fft.rfftfreq(length - order, 1.0 / self.model.rate_hz), self.edges_hz)
        taper = np.hanning(length - order)[:, np.newaxis]
        for row in range(count):
            part = samples[row * length : (row + 1) * length]
            there = complete(part)
            if there.sum() < (1.0 - _MOST_MISSING) * length:
                continue
            innovations = self.model.innovations(part - part[there].mean(axis=0))
            known = np.isfinite(innovations)
            if known.mean() < 1.0 - _MOST_MISSING:
                continue
            weight = float(np.square(taper * known).sum()) / self.model.channels
            density = np.abs(np.fft.rfft(np.where(known, innovations, 0.0) * taper, axis=0)) ** 2 / weight
            power = density.mean(axis=1)
            bands = np.add.reduceat(power[: place[-1]], place[:-1])
            means = np.concatenate(([bands.sum() / (place[-1] - place[0])], bands / np.diff(place)))
            rows[row] = 10.0 * np.log10(np.maximum(means, 1e-30))
        return rows

    def limits_db(self, rules: ChangeRules) -> Floats:
        """What each level must rise by to count as a change, float64 ``[1 + BANDS]``.

        By Student's distribution for one window beside those that were learnt from, all levels together.
        """
        spread = np.hypot(self.spread_db, rules.repeatability_db)
        each = rules.false_alarm_probability / (1 + BANDS)
        quantile = float(stdtrit(self.windows - 1, 1.0 - each))
        sizes = np.array([rules.least_db] + [rules.least_band_db] * BANDS)
        return np.asarray(np.maximum(sizes, quantile * math.sqrt(1.0 + 1.0 / self.windows) * spread))


class ResidualChange(NamedTuple):
    """How the innovations differ from those of the healthy machine.

    Attributes:
        changed: whether one of the levels has risen beyond its limit.
        rise_db: float64 ``[1 + BANDS]``, of all bands together and of each.
        limit_db: float64 ``[1 + BANDS]``, what they are compared with.
        windows: windows that it is the median of.
        quiet: whether the machine seems to stand still.
        gain: whether all bands have risen alike, so that a gain or a unit is wrong.
    """

    changed: bool
    rise_db: Floats
    limit_db: Floats
    windows: int
    quiet: bool
    gain: bool

    @property
    def ratio(self) -> float:
        """Root-mean-square innovations over those of the healthy machine."""
        return float(10.0 ** (self.rise_db[0] / 20.0))

    @property
    def departure(self) -> float:
        """Largest rise over its limit; changed from 1 on."""
        return float((self.rise_db / self.limit_db).max())


def learn_healthy(
    samples: Floats,
    rate_hz: float,
    *,
    window_s: float = WINDOW_S,
    most_order: int = MOST_ORDER,
    highest: float = HIGHEST,
) -> HealthyResidual:
    """Learn the healthy machine from a recording of it.

    Args:
        samples: float64 ``[n, m]`` of one or two accelerometers; NaN where missing.
        rate_hz: sampling rate.
        window_s: length of a window; of short recordings less.
        most_order: highest order of the model.
        highest: where the bands end, as a part of the sampling rate.

    Raises:
        NotIdentifiableError: the recording is too short or not steady, or the model cannot be made.
    """
    n = len(samples)
    window = max(_LEAST_WINDOW_SAMPLES, min(round(window_s * rate_hz), n // _WINDOWS_OF_SHORT))
    if n < LEAST_WINDOWS * window:
        raise NotIdentifiableError(
            f"{n} samples ({n / rate_hz:.3g} s) are too few to see how steady the healthy machine is; give "
            f"{LEAST_WINDOWS * window} or more"
        )
    most_order = min(most_order, window // 8)
    model = identify(samples, rate_hz, most_order)
    low_hz = min(LOWEST_HZ, _LOWEST * rate_hz)
    blank = np.zeros(1 + BANDS)
    healthy = HealthyResidual(
        model=model,
        window_samples=window,
        edges_hz=np.geomspace(low_hz, highest * rate_hz, BANDS + 1),
        mean_db=blank,
        spread_db=blank,
        windows=0,
        rms=np.nanstd(np.where(np.isfinite(samples), samples, np.nan), axis=0),
    )
    levels = healthy.levels_db(samples)
    usable = np.flatnonzero(complete(levels))
    if len(usable) < LEAST_WINDOWS:
        raise NotIdentifiableError(
            f"only {len(usable)} of {len(levels)} windows of {window / rate_hz:.3g} s are complete enough to "
            f"learn the healthy machine from, {LEAST_WINDOWS} are needed; give a recording without gaps"
        )
    _refuse_unsteady(levels[usable], usable * window / rate_hz)
    return replace(
        healthy,
        mean_db=levels[usable].mean(axis=0),
        spread_db=levels[usable].std(axis=0, ddof=1),
        windows=len(usable),
    )


def _refuse_unsteady(levels: Floats, begin_s: Floats) -> None:
    """Refuse windows among which one stands out, or through which the level goes up or down."""
    total = levels[:, 0]
    off = total - np.median(total)
    usual = float(np.median(np.abs(off))) / _FIRST_QUARTILE
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > max(_UNSTEADY_DB, _UNSTEADY_SPREADS * usual):
        raise NotIdentifiableError(
            f"the machine is not steady: at {begin_s[worst]:.3g} s its innovations differ by "
            f"{off[worst]:+.1f} dB from the median; learn from a recording of the healthy machine without "
            "impacts, starts or changes of load"
        )
    half = len(total) // 2
    drift = float(total[-half:].mean() - total[:half].mean())
    if abs(drift) > _UNSTEADY_DB / 2.0:
        raise NotIdentifiableError(
            f"the machine is not steady: its innovations change by {drift:+.1f} dB from the first half of "
            "the recording to the second; learn from one at steady speed, load and temperature"
        )


def compare_residual(
    healthy: HealthyResidual, levels_db: Floats, rules: ChangeRules | None = None
) -> ResidualChange:
    """Judge windows by their median against the healthy machine.

    Args:
        healthy: the healthy machine.
        levels_db: float64 ``[windows, 1 + BANDS]`` of `HealthyResidual.levels_db`.
        rules: what counts as a change.

    Raises:
        ValueError: no window can be used.
    """
    rules = rules or ChangeRules()
    usable = levels_db[complete(levels_db)]
    if not len(usable):
        raise ValueError(
            f"no window of {healthy.window_samples / healthy.model.rate_hz:.3g} s is complete; "
            "give a longer recording without gaps"
        )
    rise = np.median(usable, axis=0) - healthy.mean_db
    limit = healthy.limits_db(rules)
    alike = float(np.ptp(rise)) < rules.least_band_db
    return ResidualChange(
        changed=bool((rise >= limit).any()),
        rise_db=rise,
        limit_db=limit,
        windows=len(usable),
        quiet=bool(rise[0] <= rules.stopped_db),
        gain=bool(rise[0] >= rules.gain_db and alike),
    )
