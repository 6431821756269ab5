"""The level detector: how strong the vibration at each sensor is, and whether the sensor can be believed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from daqsvc.detectors.levels.statements import NO_BOUNDS, Evidence, LevelStatements
from daqsvc.diagnosis.record import silence_reason
from daqsvc.dsp.levels import band_rms, gapped_band_rms, kurtosis, levels
from daqsvc.dsp.quality.missing import (
    LEAST_KNOWN_ERROR,
    MIN_PRESENT,
    MOST_ERROR,
    MOST_MISSING,
    level_bounds,
    not_judged,
    nothing_known,
    partly_missing,
)
from daqsvc.dsp.quality.stuck import StandstillWatch
from daqsvc.dsp.quality.unit import M_S2_PER_UNIT, RESCALE, beyond_any_unit
from daqsvc.dsp.window_orders import phase_lag_deg, steady_angle, window_orders
from daqsvc.rounding import unit_behind
from daqsvc.settings.measures import (
    AMPLITUDES,
    ISO_BAND_HZ,
    KURTOSIS,
    NOT_1X,
    OF_THE_SHAFT,
    ON_REQUEST,
    PHASES,
    SLOW_BAND_HZ,
    SLOW_VELOCITY,
    UNITS,
    VELOCITY,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.detectors.levels.shaft_angle import ShaftAngle
    from daqsvc.detectors.levels.statements import Limits
    from daqsvc.diagnosis.detector import Window
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.dsp.quality import Quality
    from daqsvc.dsp.quality.missing import Bounds
    from daqsvc.dsp.quality.stuck import Standstill

_LEAST_SAMPLES = 4
"""Fewer make no spectrum."""

_GLITCH = 2
"""Samples beyond the gap limits within a window, up to which they are interference and not the probe."""

SensorUnit = Literal["um", "mm", "mil", "g", "m/s2", "mg", "mm/s2", "mm/s"]

_ANY = (0.0, math.inf)
"""Bounds of a size of which nothing is known."""

# How a band velocity in mm/s comes from the samples: factor, and whether to integrate.
_TO_VELOCITY: Mapping[str, tuple[float, bool]] = {
    **{unit: (1000.0 * m_s2, True) for unit, m_s2 in M_S2_PER_UNIT.items()},
    "mm/s": (1.0, False),
}


class GapCheck(NamedTuple):
    """OK limits of a proximity probe (API 670): its gap voltage must lie between them all the time.

    Attributes:
        volts_per_unit: gap voltage per unit of displacement.
        zero_v: gap voltage at displacement zero.
        low_v: lower limit.
        high_v: upper limit.
    """

    volts_per_unit: float
    zero_v: float
    low_v: float
    high_v: float


@dataclass(frozen=True, slots=True)
class LevelChannel:
    """One sensor as the level detector sees it.

    Attributes:
        sensor: its name.
        column: its column in the stream.
        unit: unit of its samples.
        limits: setpoints of its measures.
        gap: OK limits, for a proximity probe.
        listed: measures of `ON_REQUEST` that are made of it whether or not they have setpoints.
    """

    sensor: str
    column: int
    unit: SensorUnit
    limits: Sequence[Limits] = ()
    gap: GapCheck | None = None
    listed: frozenset[str] = frozenset()

    @property
    def on_request(self) -> list[str]:
        """The measures of `ON_REQUEST` that are made of it, in that order."""
        watched = {limit.measure for limit in self.limits}
        return [name for name in ON_REQUEST if name in self.listed or name in watched]


class _Measured(NamedTuple):
    """What a window states of one sensor.

    Attributes:
        statistics: its measures.
        bounds: of those that are uncertain, or not known at all.
        unknown: those of the latter that have setpoints although the samples of the sensor are there.
        reason: why these are not known.
    """

    statistics: dict[str, float]
    bounds: dict[str, tuple[float, float]]
    unknown: tuple[str, ...] = ()
    reason: str = ""


class LevelDetector:
    """RMS, peak, peak-to-peak, crest factor and band velocity of every sensor of a stream, window by window.

    And of those that are asked for it kurtosis, velocity from 2 Hz on, 1X and 2X, and what is not 1X.

    Emits one `Diagnosis` per sensor and window, as detector ``levels/<sensor>``. A snapshot is a window by
    itself, whatever its length.

    Where samples are missing the levels are those of the samples that are there, and the band velocity is
    estimated from these (`gapped_band_rms`). Above `MOST_MISSING` they are uncertain (`Diagnosis.bounds`),
    below `MIN_PRESENT` not given at all.

    Args:
        machine: name of the machine.
        stream: name of the stream.
        rate_hz: its sampling rate.
        channels: the sensors.
        window_s: length of a window.
        velocity_band_hz: band of the velocity, in Hz; None: its RMS is not measured.
        speed_rpm: stated speed of the shaft, for 1X and 2X; its sign does not matter.
        shaft: the keyphasor of the stream; None: 1X is looked for near the stated speed, and has no phase.
    """

    def __init__(
        self,
        machine: str,
        stream: str,
        rate_hz: float,
        channels: Sequence[LevelChannel],
        *,
        window_s: float = 0.5,
        velocity_band_hz: tuple[float, float] | None = ISO_BAND_HZ,
        speed_rpm: float | None = None,
        shaft: ShaftAngle | None = None,
    ) -> None:
        self.name = f"levels/{stream}"
        self.stream = stream
        self.block = max(_LEAST_SAMPLES, round(window_s * rate_hz))
        self._statements = LevelStatements(machine, stream, "levels/1")
        self._rate_hz = rate_hz
        self._channels = tuple(channels)
        self._bands_hz = {SLOW_VELOCITY: SLOW_BAND_HZ}
        if velocity_band_hz is not None:
            self._bands_hz[VELOCITY] = velocity_band_hz
        known = speed_rpm is not None and math.isfinite(speed_rpm)
        self._turns_per_sample = abs(speed_rpm) / 60.0 / rate_hz if known and speed_rpm else None
        self._shaft = shaft
        self._standstills = {channel.sensor: StandstillWatch() for channel in self._channels}
        self._next_index = 0

    def change_setpoints(self, limits: Mapping[str, Sequence[Limits]]) -> None:
        """Judge the next window, and what follows, by other setpoints of each sensor, by its name."""
        self._channels = tuple(replace(channel, limits=limits[channel.sensor]) for channel in self._channels)

    def warm(self) -> None:
        """Make the taper and the band's weights; there is nothing to compile."""
        for channel in self._channels:
            self._measure(channel, np.sin(np.arange(self.block, dtype=np.float32)), 0.0, None)

    def process(self, window: Window) -> list[Diagnosis]:
        """See `daqsvc.diagnosis.detector.Detector.process`."""
        diagnoses = [self._skipped(channel, window) for channel in self._channels if window.skipped]
        self._next_index = window.first_index + len(window.samples)
        angle_rad = self._angle(window)
        block = len(window.samples) if window.snapshot else self.block
        for start in range(0, len(window.samples), block):
            part = window.samples[start : start + block]
            after = len(window.samples) - start - len(part)
            t_ns = window.t_end_ns - round(after * window.period_ns)
            turned = None if angle_rad is None else angle_rad[start : start + block]
            diagnoses += [
                self._judge(c, part[:, c.column], window.first_index + start, t_ns, turned)
                for c in self._channels
            ]
        return diagnoses

    def _angle(self, window: Window) -> NDArray[np.float64] | None:
        """The shaft angle of every sample by the keyphasor, if anything that needs it is asked for."""
        asked = any(name in OF_THE_SHAFT for channel in self._channels for name in channel.on_request)
        return self._shaft.of(window) if self._shaft is not None and asked and len(window.samples) else None

    def silent(self, silence_s: float, t_ns: int) -> list[Diagnosis]:
        """See `daqsvc.diagnosis.detector.Detector.silent`."""
        reason = silence_reason(self.stream, silence_s)
        nothing = Evidence(self._next_index, self._next_index, t_ns)
        return [self._state(c, nothing, {}, "missing", reason) for c in self._channels]

    def _skipped(self, channel: LevelChannel, window: Window) -> Diagnosis:
        """What lies between two windows is not known: no delay continues over it."""
        first = window.first_index - window.skipped
        t_ns = window.t_end_ns - round(len(window.samples) * window.period_ns)
        unseen = Evidence(first, window.first_index, t_ns)
        measures = ["mean", "rms", "peak", "peak_to_peak", "crest_factor"]
        measures += ["gap_voltage"] * (channel.gap is not None)
        measures += [VELOCITY] * (channel.unit in _TO_VELOCITY and VELOCITY in self._bands_hz)
        measures += channel.on_request
        reason = not_judged(channel.sensor, window.skipped)
        return self._state(channel, unseen, {}, "missing", reason, 1.0, nothing_known(measures))

    def _judge(
        self,
        channel: LevelChannel,
        samples: NDArray[np.float32],
        first_index: int,
        t_ns: int,
        angle_rad: NDArray[np.float64] | None,
    ) -> Diagnosis:
        present = np.isfinite(samples)
        count = int(present.sum())
        evidence = Evidence(first_index, first_index + len(samples), t_ns)
        share = 1.0 - count / len(samples)
        if count < max(MIN_PRESENT * len(samples), _LEAST_SAMPLES):
            reason = (
                f"only {count} of {len(samples)} samples of {channel.sensor} are there, the others were lost "
                "or the device had none; check bus, device and sensor"
            )
            return self._state(channel, evidence, {}, "missing", reason, share)
        known = samples[present]
        if wrong := beyond_any_unit(known):
            return self._state(channel, evidence, {}, "not_ok", f"{channel.sensor} {wrong}; {RESCALE}", share)
        statistics, bounds, unknown, why = self._measure(channel, samples, share, angle_rad)
        still = self._standstills[channel.sensor].push(known)
        if reason := _beyond_gap(channel, statistics, known) or _dead(channel, len(known), still):
            return self._state(channel, evidence, statistics, "not_ok", reason, share)
        held = {name: between for name, between in bounds.items() if name not in unknown}
        reason = partly_missing(channel.sensor, len(samples) - count, len(samples), held) or why
        quality: Quality = "missing" if reason else "good"
        return self._state(channel, evidence, statistics, quality, reason, share, bounds, unknown)

    def _state(
        self,
        channel: LevelChannel,
        evidence: Evidence,
        statistics: dict[str, float],
        quality: Quality,
        reason: str,
        missing_share: float = 1.0,
        bounds: Bounds = NO_BOUNDS,
        unknown: tuple[str, ...] = (),
    ) -> Diagnosis:
        units = {name: unit for name in statistics if (unit := UNITS.get(name, channel.unit))}
        return self._statements.state(
            channel.sensor,
            channel.limits,
            evidence,
            statistics,
            units,
            quality,
            reason,
            missing_share,
            bounds,
            unknown,
        )

    def _measure(
        self,
        channel: LevelChannel,
        samples: NDArray[np.float32],
        share: float,
        angle_rad: NDArray[np.float64] | None,
    ) -> _Measured:
        """The measures of a window that lacks a ``share`` of its samples."""
        measured = levels(samples)
        known = samples[np.isfinite(samples)]
        bounds = level_bounds(measured, float(known.min()), float(known.max()), share)
        statistics = {
            "mean": measured.mean,
            "rms": measured.rms,
            "peak": measured.peak,
            "peak_to_peak": measured.peak_to_peak,
            "crest_factor": measured.crest_factor,
        }
        if channel.gap is not None:
            gap = channel.gap
            statistics["gap_voltage"] = gap.zero_v + measured.mean * gap.volts_per_unit
            if "mean" in bounds:
                volts = sorted(gap.zero_v + end * gap.volts_per_unit for end in bounds["mean"])
                bounds["gap_voltage"] = (volts[0], volts[1])
        asked = channel.on_request
        if channel.unit in _TO_VELOCITY:
            if VELOCITY in self._bands_hz:
                self._add_velocity(channel, VELOCITY, samples, share, statistics, bounds)
            if SLOW_VELOCITY in asked:
                self._add_velocity(channel, SLOW_VELOCITY, samples, share, statistics, bounds)
        if KURTOSIS in asked:
            statistics[KURTOSIS] = kurtosis(samples)
        reason = ""
        if of_the_shaft := [name for name in asked if name in OF_THE_SHAFT]:
            orders, reason = self._orders(channel.sensor, samples.astype(np.float64), angle_rad)
            statistics |= {name: orders[name] for name in of_the_shaft if name in orders}
        if share > MOST_MISSING:
            # As of a crest factor: what is missing may hold anything.
            bounds |= dict.fromkeys(
                (name for name in asked if name in statistics and name not in bounds), _ANY
            )
        watched = {limit.measure for limit in channel.limits}
        unknown = tuple(name for name in asked if name in watched and name not in statistics | bounds)
        bounds |= nothing_known(unknown)
        return _Measured(statistics, bounds, unknown, reason if unknown else "")

    def _add_velocity(
        self,
        channel: LevelChannel,
        name: str,
        samples: NDArray[np.float32],
        share: float,
        statistics: dict[str, float],
        bounds: dict[str, tuple[float, float]],
    ) -> None:
        factor, integrate = _TO_VELOCITY[channel.unit]
        values, band_hz = samples.astype(np.float64), self._bands_hz[name]
        if not share:
            statistics[name] = factor * band_rms(values, self._rate_hz, *band_hz, integrate=integrate)
            return
        about = gapped_band_rms(values, self._rate_hz, *band_hz, integrate=integrate)
        if about.error <= LEAST_KNOWN_ERROR:
            statistics[name] = factor * about.rms
        if share > MOST_MISSING or about.error > MOST_ERROR:
            bounds[name] = (factor * about.low, factor * about.high)

    def _orders(
        self, sensor: str, samples: NDArray[np.float64], angle_rad: NDArray[np.float64] | None
    ) -> tuple[dict[str, float], str]:
        """What a window shows of 1X and 2X, and why it does not show the rest."""
        by_pulses = angle_rad is not None
        if angle_rad is None:
            if self._turns_per_sample is None:
                return {}, f"1X of {sensor} is not known: the speed of the shaft is not stated"
            angle_rad = steady_angle(samples, self._turns_per_sample)
        orders = window_orders(samples, angle_rad)
        if orders is None and by_pulses and self._shaft is not None and not np.isfinite(angle_rad[-1]):
            return {}, (
                f"1X of {sensor} is not known: {self._shaft.name} has no pulses that tell the angle of the "
                "shaft; it stands still, or check keyphasor and threshold_v"
            )
        if orders is None:
            return {}, (
                f"1X of {sensor} is not known: no whole revolution of the window has enough samples; "
                "sample faster, or write a longer window_s"
            )
        phases: dict[str, float] = {}
        if by_pulses:
            lags = [phase_lag_deg(one, orders.deviation) for one in (orders.first, orders.second)]
            phases = {name: lag for name, lag in zip(PHASES, lags, strict=True) if lag is not None}
        sizes = dict(zip(AMPLITUDES, (abs(orders.first), abs(orders.second)), strict=True))
        rest = dict(zip(NOT_1X, (orders.rest_rms, orders.rest_peak_to_peak), strict=True))
        weak = f"1X or 2X of {sensor} does not stand out of its noise, so that it has no phase"
        return sizes | phases | rest, weak


def _beyond_gap(channel: LevelChannel, statistics: Mapping[str, float], known: NDArray[np.float32]) -> str:
    gap = channel.gap
    if gap is None:
        return ""
    volts = gap.zero_v + known.astype(np.float64) * gap.volts_per_unit
    beyond = (volts < gap.low_v) | (volts > gap.high_v)
    count, mean_v = int(beyond.sum()), statistics["gap_voltage"]
    within = gap.low_v <= mean_v <= gap.high_v
    # A gap that leaves its limits at the end of a window, or comes back at its beginning, is no glitch: the
    # step would be taken for vibration.
    if within and count <= _GLITCH and not (beyond[0] or beyond[-1]):
        return ""
    limits = f"its OK limits {gap.low_v:g} to {gap.high_v:g} V; check probe, cable and driver"
    if not within:
        return f"gap voltage of {channel.sensor} is {mean_v:.2f} V, outside {limits}"
    farthest = volts[np.abs(volts - (gap.low_v + gap.high_v) / 2).argmax()]
    return (
        f"gap voltage of {channel.sensor} reached {farthest:.2f} V, for {count} of {len(known)} samples "
        f"outside {limits}"
    )


def _dead(channel: LevelChannel, count: int, still: Standstill | None) -> str:
    if still is None:
        return ""
    value = f"{round(still.value, 6) + 0.0:g}{unit_behind(channel.unit)}"  # + 0.0: no "-0"
    if still.samples == count:
        return (
            f"{channel.sensor} does not move at all ({value}): dead or disconnected; "
            "check sensor, cable and supply"
        )
    return (
        f"{channel.sensor} was stuck at {value} for {still.samples} of {count} samples: dead or "
        "disconnected for a part of the time; check sensor, cable and supply"
    )
