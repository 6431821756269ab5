"""What has to be known of a rotor before a recording of it can be judged, and above all its speed.

That is what a recording is cut into revolutions by; the recording must agree with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.dsp.quality import RefusedError
from daqsvc.dsp.speed.keyphasor import EdgeFinder, KeyphasorProbe
from daqsvc.dsp.speed.orbit import AT_THE_EDGE, estimate_speed, refuse_elsewhere
from daqsvc.dsp.speed.steadiness import Trend, trend_of_orbit, trend_of_pulses
from daqsvc.rotor.synchronous.baseline import LEAST_REVOLUTIONS
from daqsvc.rotor.synchronous.watch import WatchRules
from daqsvc.rounding import rounded_up

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.dsp.quality.recorded import DataQuality
    from daqsvc.dsp.quality.unit import LengthUnit
    from daqsvc.dsp.speed.keyphasor import Edge
    from daqsvc.recording.recording import Recording
    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration

    Floats = NDArray[np.float64]

LEAST_JUDGED = 3
"""Revolutions that must be left to judge after those that calibrate."""
LEAST_SAMPLES = 8
"""Samples of a revolution that is fitted (`daqsvc.rotor.synchronous.vectors`)."""

_NEARLY = 0.02
_FIXED_SPEED_TURN = 0.05
"""What a wrong speed may turn the angle by during calibration, in revolutions."""
_SIGNIFICANT = 5.0
"""Standard deviations from which on a speed differs."""
_RELEVANT_TURN = 0.001
"""What it must turn the angle by, to the end of the recording, for a difference to matter."""
_HYSTERESIS = 0.2
"""Of the keyphasor's range from low to high."""
_LEAST_PULSES = 4
_OFF_NOMINAL = 0.02
"""Share by which the keyphasor's speed may differ from the stated one until that is reported."""
_ROUNDING = 0.5
"""Part of a revolution that the interpolation of the first and the last pulse may cost."""


@dataclass(frozen=True, slots=True)
class KeyphasorChannel:
    """The keyphasor of a recording.

    Attributes:
        name: its channel.
        threshold: level that marks the edge, in the unit of the channel; None: half way between the lowest
            and the highest value.
        edge: the edge that marks angle zero.
        hysteresis: how far the signal must return before there can be another edge; None: a fifth of its
            range.
    """

    name: str
    threshold: float | None = None
    edge: Edge = "rising"
    hysteresis: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class RotorSetup:
    """What `daqsvc.detectors.rotor_synchronous.recorded.analyse` needs to know.

    No copy of a table: made of several, of calibration files, and of options beside the machine file.

    Attributes:
        probes: names of the two channels.
        rotor: what is known about the rotor.
        probe_angles_deg: where they point, from +x anticlockwise.
        speed_rpm: shaft speed, negative if the shaft turns clockwise; may be None with a keyphasor.
        speed_step_rpm: step of the stated speed's last digit, which it is rounded to; 0: it is exact.
        unit: unit of the probes' samples.
        keyphasor: the keyphasor, if there is one.
        follow_orbit: take speed and angle from the orbit's own 1X, about ``speed_rpm``.
        rules: of calibration, departure and naming.
        calibrations: healthy states of an earlier time, each at another speed, of which the measured speed
            chooses; without any the first revolutions are the healthy state.
        ac_coupled: whether the probes lack their mean position.

    Raises:
        ValueError: the speed comes from nowhere.
    """

    probes: tuple[str, str]
    rotor: LavalRotor
    speed_rpm: float | None
    probe_angles_deg: tuple[float, float] = (0.0, 90.0)
    speed_step_rpm: float = 0.0
    unit: LengthUnit = "um"
    keyphasor: KeyphasorChannel | None = None
    follow_orbit: bool = False
    rules: WatchRules = field(default_factory=lambda: WatchRules(retry=False))
    calibrations: tuple[Calibration, ...] = ()
    ac_coupled: bool = False

    def __post_init__(self) -> None:
        if self.speed_rpm is None and self.keyphasor is None:
            raise ValueError(
                "the speed is not known: give it with --speed-rpm, or name a keyphasor with --keyphasor"
            )

    @property
    def unmarked(self) -> Literal["orbit", "fixed"]:
        """What gives the shaft angle where no keyphasor does."""
        return "orbit" if self.follow_orbit else "fixed"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels, in the order of their columns."""
        return self.probes if self.keyphasor is None else (*self.probes, self.keyphasor.name)


@dataclass(frozen=True, slots=True)
class Speed:
    """Speed that the detector starts from.

    Attributes:
        rpm: the speed.
        keyphasor: the keyphasor's threshold and hysteresis, if there is one.
        uncertainty: relative standard deviation of the speed, where the angle rests on it.
    """

    rpm: float
    keyphasor: KeyphasorProbe | None = None
    uncertainty: float = 0.0


def speed_of(
    recording: Recording, setup: RotorSetup, samples: Floats, quality: DataQuality
) -> tuple[Speed, DataQuality]:
    """Speed to start from.

    Args:
        recording: the recording.
        setup: what is known.
        samples: float64 ``[n, 2 or 3]``, probes in um and keyphasor, NaN where missing.
        quality: what is known against the samples so far.

    Returns:
        The speed, and the quality with what was found beside it.

    Raises:
        RefusedError: the recording is too short, the orbit contradicts a stated speed, or the keyphasor has
            no pulses.
    """
    if setup.keyphasor is not None:
        return _keyphasor_speed(recording, setup, setup.keyphasor, samples[:, 2], quality)
    assert setup.speed_rpm is not None  # noqa: S101 - see RotorSetup
    refuse_coarse(60.0 * recording.rate_hz / abs(setup.speed_rpm), recording.rate_hz)
    revolutions = len(samples) * abs(setup.speed_rpm) / 60.0 / recording.rate_hz
    needed = LEAST_JUDGED + (0 if setup.calibrations else setup.rules.calibrate_revolutions)
    if revolutions < needed:
        raise RefusedError(too_short(revolutions, needed, setup))
    if setup.calibrations:
        quality = quality.with_problem(
            "without a keyphasor the phase of 1X is that of the first revolutions: a change of phase since "
            "the calibration cannot be seen"
        )
    if setup.follow_orbit:
        trend = trend_of_orbit(_calibrating(recording, setup, samples), recording.rate_hz)
        if trend is not None:
            _refuse_trend(trend_of_orbit(samples[:, :2], recording.rate_hz) or trend)
        return Speed(setup.speed_rpm), quality
    return _fixed_speed(recording, setup, setup.speed_rpm, samples, quality)


def refuse_coarse(period_samples: float, rate_hz: float) -> None:
    """Refuse a recording with too few samples a revolution for mean, 1X and 2X and what noise leaves.

    Args:
        period_samples: samples per revolution.
        rate_hz: sampling rate.

    Raises:
        RefusedError: there are too few.
    """
    if period_samples < LEAST_SAMPLES * (1.0 - _NEARLY):
        raise RefusedError(
            f"a revolution has {period_samples:.3g} samples ({rate_hz:.6g} Hz at "
            f"{60.0 * rate_hz / period_samples:.1f} rpm); 1X and 2X need {LEAST_SAMPLES}: sample at "
            f"{rounded_up(LEAST_SAMPLES * rate_hz / period_samples, 6)} Hz or faster"
        )


def too_short(revolutions: float, needed: int, setup: RotorSetup) -> str:
    """Why a recording of so many revolutions is refused."""
    made_of = (
        "to judge"
        if setup.calibrations
        else f"{setup.rules.calibrate_revolutions} to calibrate and {LEAST_JUDGED} to judge"
    )
    fewer = setup.rules.calibrate_revolutions > LEAST_REVOLUTIONS and not setup.calibrations
    return (
        f"the recording is too short: {revolutions:.1f} revolutions, at least {needed} are needed "
        f"({made_of}); give a longer one" + (", or calibrate on fewer" if fewer else "")
    )


def _refuse_trend(trend: Trend | None) -> None:
    """Refuse a run-up or coast-down."""
    if trend is not None:
        raise RefusedError(
            f"{trend.describe()}: a run-up cannot be judged; learn the rotor from it with daqsvc calibrate "
            "(--keyphasor or --sweep-rpm), or give a recording at steady speed"
        )


def _calibrating(recording: Recording, setup: RotorSetup, samples: Floats) -> Floats:
    """The samples whose speed must be steady: of calibration, or all where that was before."""
    assert setup.speed_rpm is not None  # noqa: S101 - asked by those who follow no keyphasor
    if setup.calibrations:
        return samples[:, :2]
    turns = setup.rules.calibrate_revolutions
    return samples[: math.ceil(turns * 60.0 * recording.rate_hz / abs(setup.speed_rpm)), :2]


def _fixed_speed(
    recording: Recording, setup: RotorSetup, stated_rpm: float, samples: Floats, quality: DataQuality
) -> tuple[Speed, DataQuality]:
    """The stated speed if the orbit of the first revolutions has it, made exact where that is significant."""
    calibrating = setup.rules.calibrate_revolutions
    begin = math.ceil(calibrating * 60.0 * recording.rate_hz / abs(stated_rpm))
    first = samples[:begin, :2]
    try:
        estimate = estimate_speed(first, recording.rate_hz, stated_rpm)
    except ValueError as error:
        _refuse_trend(trend_of_orbit(samples[:, :2], recording.rate_hz))
        refuse_elsewhere(first, recording.rate_hz, stated_rpm, None)
        raise RefusedError(f"{error} (looked for in the first {calibrating} revolutions)") from None
    off = estimate.speed_rpm / stated_rpm - 1.0
    significant = abs(estimate.speed_rpm - stated_rpm) > _SIGNIFICANT * estimate.uncertainty_rpm
    wrong = significant and abs(off) * calibrating > _FIXED_SPEED_TURN
    if wrong:
        _refuse_trend(trend_of_orbit(samples[:, :2], recording.rate_hz))
    refuse_elsewhere(
        first, recording.rate_hz, stated_rpm, None if abs(off) > AT_THE_EDGE else estimate.speed_rpm
    )
    if wrong:
        raise RefusedError(
            f"the shaft turns at {abs(estimate.speed_rpm):.2f} rpm and not at {abs(stated_rpm):.2f} rpm "
            f"({100.0 * off:+.2f} %): 1X is not locked to the angle; correct the speed, use a keyphasor, or "
            "follow the orbit (--speed-rpm orbit:N)"
        )
    revolutions = len(samples) * abs(stated_rpm) / 60.0 / recording.rate_hz
    if significant and abs(off) * revolutions > _RELEVANT_TURN:
        quality = quality.with_problem(
            f"the speed is {abs(estimate.speed_rpm):.3f} rpm by the orbit, not {abs(stated_rpm):.3f} rpm; "
            "the former is used"
        )
        return Speed(
            estimate.speed_rpm, uncertainty=estimate.uncertainty_rpm / abs(estimate.speed_rpm)
        ), quality
    # A rounded figure and an estimate with its own uncertainty, weighed.
    stated = (setup.speed_step_rpm / math.sqrt(12.0)) ** 2
    weight = stated / (stated + estimate.uncertainty_rpm**2) if stated > 0.0 else 0.0
    rpm = stated_rpm + weight * (estimate.speed_rpm - stated_rpm)
    return Speed(rpm, uncertainty=math.sqrt((1.0 - weight) * stated) / abs(rpm)), quality


def _keyphasor_speed(
    recording: Recording, setup: RotorSetup, keyphasor: KeyphasorChannel, marker: Floats, quality: DataQuality
) -> tuple[Speed, DataQuality]:
    low, high = (float(value) for value in np.nanpercentile(marker, [0.1, 99.9]))
    threshold = (low + high) / 2.0 if keyphasor.threshold is None else keyphasor.threshold
    hysteresis = _HYSTERESIS * (high - low) if keyphasor.hysteresis is None else keyphasor.hysteresis
    edges = EdgeFinder(threshold, hysteresis, keyphasor.edge).find(marker)
    if len(edges) < _LEAST_PULSES:
        raise RefusedError(
            f"keyphasor {keyphasor.name}: {len(edges)} pulses cross {threshold:.4g}; the channel lies "
            f"between {low:.4g} and {high:.4g}: correct --keyphasor-threshold, or name another channel"
        )
    places = np.array([sample + fraction for sample, fraction in edges])
    measured_rpm = 60.0 * recording.rate_hz / float(np.median(np.diff(places)))
    rpm = measured_rpm if setup.speed_rpm is None else math.copysign(measured_rpm, setup.speed_rpm)
    calibrating = setup.rules.calibrate_revolutions
    needed = LEAST_JUDGED + (0 if setup.calibrations else calibrating)
    # Pulses may be missing, whose revolutions are there all the same.
    revolutions = (places[-1] - places[0]) * measured_rpm / 60.0 / recording.rate_hz
    if revolutions < needed - _ROUNDING:
        raise RefusedError(too_short(revolutions, needed, setup))
    if calibrating:
        trend = trend_of_pulses(
            places if setup.calibrations else places[: calibrating + 1], recording.rate_hz
        )
        if trend is not None:
            _refuse_trend(trend_of_pulses(places, recording.rate_hz) or trend)
    if setup.speed_rpm is not None and abs(rpm / setup.speed_rpm - 1.0) > _OFF_NOMINAL:
        quality = quality.with_problem(
            f"keyphasor {keyphasor.name} gives {abs(rpm):.1f} rpm, not {abs(setup.speed_rpm):.1f} rpm; "
            "the keyphasor decides"
        )
    probe = KeyphasorProbe(keyphasor.name, 2, threshold, hysteresis, keyphasor.edge)
    return Speed(rpm, probe), quality
