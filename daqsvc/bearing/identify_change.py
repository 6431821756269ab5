"""Whether a machine still vibrates as it did when its innovations model was learnt.

The innovations of windows of half a second are measured as a whole and in bands, in dB over the healthy
machine. How much these figures scatter from window to window while the machine is healthy makes the limit: a
change is significant at a stated probability of a false alarm, and of a size that matters. That innovations
have grown says that something has changed, not what.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from scipy.special import stdtrit

from daqsvc.bearing.identify import MOST_ORDER, InnovationsModel, NotIdentifiableError, complete, identify

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

WINDOW_S = 0.5
LEAST_WINDOWS = 8
BANDS = 8
LOWEST_HZ = 400.0
"""Below, the shaft's own orders are: how they change is no matter of the bearing."""
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
        limit_db: float64 ``[1 + BANDS]``, what they are held against.
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
            "knocks, starts or changes of load"
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
