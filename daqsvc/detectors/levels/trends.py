"""Trend values: levels that a device has measured itself, such as an RMS velocity or a temperature.

What comes is compared with the setpoints as it is. A value that stands still is no dead sensor here: the
temperature of a steady machine does not move for hours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.detectors.levels.statements import Evidence, LevelStatements
from daqsvc.diagnosis.record import silence_reason
from daqsvc.dsp.quality.misread import Misread
from daqsvc.dsp.quality.missing import BRIDGED, MOST_MISSING, not_judged, nothing_known, partly_missing
from daqsvc.dsp.quality.unit import RESCALE, beyond_any_value
from daqsvc.rounding import unit_behind
from daqsvc.settings.units import unit_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.detectors.levels.statements import Limits
    from daqsvc.diagnosis.detector import Window
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.dsp.quality import Quality
    from daqsvc.dsp.quality.missing import Bounds

VALUE = "value"
"""The one measure of a trend value."""


LEAST_RMS_MM_S = 1.0
"""A velocity RMS so far below 0 is no offset of an analogue input."""
MOST_RMS_MM_S = 1000.0
"""A hundred times where zone D begins: no machine stands that, and few sensors measure it."""
MOST_RPM = 1_000_000.0
"""No shaft turns faster; a machine file states no such speed either."""


@dataclass(frozen=True, slots=True)
class TrendChannel:
    """One trend value as its detector sees it.

    Attributes:
        sensor: its name.
        column: its column in the stream.
        unit: its unit.
        limits: its setpoints.
        ok_between: OK limits, in its unit; beyond them the sensor is not believed. None: there are none.
        number_keys: the keys of its layout that state how bytes become a number, e.g. ``"order and type"``;
            empty where there are no such keys.
    """

    sensor: str
    column: int
    unit: str
    limits: Sequence[Limits] = ()
    ok_between: tuple[float, float] | None = None
    number_keys: str = ""

    @property
    def remedy(self) -> str:
        """What to do about values that no sensor measures."""
        if not self.number_keys:
            return RESCALE
        return f"correct {self.number_keys} of its channel in the layout, or its scale or unit"


class TrendDetector:
    """The value of every trend channel of a stream: one by one if slow, else averaged; a snapshot always is.

    Emits one `Diagnosis` per sensor and value, as detector ``levels/<sensor>``.

    Args:
        machine: name of the machine.
        stream: name of the stream.
        rate_hz: its sampling rate.
        channels: the trend values.
        window_s: time that values are averaged over; where fewer than two samples come in it, none is.
    """

    def __init__(
        self,
        machine: str,
        stream: str,
        rate_hz: float,
        channels: Sequence[TrendChannel],
        *,
        window_s: float = 0.5,
    ) -> None:
        self.name = f"trends/{stream}"
        self.stream = stream
        self.block = max(1, round(window_s * rate_hz))
        self._channels = tuple(channels)
        self._statements = LevelStatements(machine, stream, "trends/1")
        self._missed = dict.fromkeys((channel.sensor for channel in self._channels), 0)
        self._misread = {channel.sensor: Misread() for channel in self._channels}
        self._next_index = 0

    def warm(self) -> None:
        """See `daqsvc.diagnosis.detector.Detector.warm`; there is nothing to compile."""

    def process(self, window: Window) -> list[Diagnosis]:
        """See `daqsvc.diagnosis.detector.Detector.process`."""
        diagnoses = [self._skipped(channel, window) for channel in self._channels if window.skipped]
        self._next_index = window.first_index + len(window.samples)
        block = len(window.samples) if window.snapshot else self.block
        for start in range(0, len(window.samples), block):
            part = window.samples[start : start + block]
            after = len(window.samples) - start - len(part)
            first_index = window.first_index + start
            t_ns = window.t_end_ns - round(after * window.period_ns)
            evidence = Evidence(first_index, first_index + len(part), t_ns)
            for channel in self._channels:
                judged = self._judge(channel, part[:, channel.column], evidence)
                if judged is not None:
                    diagnoses.append(judged)
        return diagnoses

    def silent(self, silence_s: float, t_ns: int) -> list[Diagnosis]:
        """See `daqsvc.diagnosis.detector.Detector.silent`."""
        reason = silence_reason(self.stream, silence_s)
        nothing = Evidence(self._next_index, self._next_index, t_ns)
        return [self._missing(channel, nothing, reason) for channel in self._channels]

    def _skipped(self, channel: TrendChannel, window: Window) -> Diagnosis:
        """What lies between two windows is not known: no delay continues over it."""
        t_ns = window.t_end_ns - round(len(window.samples) * window.period_ns)
        unseen = Evidence(window.first_index - window.skipped, window.first_index, t_ns)
        return self._statements.state(
            channel.sensor,
            channel.limits,
            unseen,
            {},
            {},
            "missing",
            not_judged(channel.sensor, window.skipped),
            1.0,
            nothing_known([VALUE]),
        )

    def _judge(
        self, channel: TrendChannel, samples: NDArray[np.float32], evidence: Evidence
    ) -> Diagnosis | None:
        """The statement about the next value; None while the last one still represents a missing one."""
        known = samples[np.isfinite(samples)]
        if not len(known):
            self._missed[channel.sensor] += 1
            if self._missed[channel.sensor] <= BRIDGED:
                return None
            missed = self._missed[channel.sensor]
            reason = (
                f"the last {missed} values of {channel.sensor} did not arrive, or the device had none; check "
                "sensor, device and bus"
            )
            return self._missing(channel, evidence, reason)
        self._missed[channel.sensor] = 0
        misread = self._misread[channel.sensor].update(known)
        if (
            wrong := misread
            or beyond_any_value(known)
            or _no_rms(channel, known)
            or _no_speed(channel, known)
        ):
            reason = f"{channel.sensor} {wrong}; {channel.remedy}"
            share = 1.0 - len(known) / len(samples)
            return self._statements.state(
                channel.sensor, channel.limits, evidence, {}, {}, "not_ok", reason, share
            )
        missing, value = len(samples) - len(known), _as_read(known)
        bounds: Bounds = {}
        if reason := _beyond_ok(channel, known):
            quality: Quality = "not_ok"
        else:
            bounds = _bounds(value, known, missing)
            quality = "missing" if bounds else "good"
            reason = partly_missing(channel.sensor, missing, len(samples), bounds)
        return self._statements.state(
            channel.sensor,
            channel.limits,
            evidence,
            {VALUE: value},
            {VALUE: channel.unit} if channel.unit else {},
            quality,
            reason,
            missing / len(samples),
            bounds,
        )

    def _missing(self, channel: TrendChannel, evidence: Evidence, reason: str) -> Diagnosis:
        return self._statements.state(channel.sensor, channel.limits, evidence, {}, {}, "missing", reason)


def _bounds(value: float, known: NDArray[np.float32], missing: int) -> Bounds:
    """Between what an average lies of which values are missing, if these lie among those that are known."""
    share = missing / (missing + len(known))
    if missing <= BRIDGED or share <= MOST_MISSING:
        return {}
    off = share * float(known.max() - known.min())
    return {VALUE: (value - off, value + off)}


def _as_read(known: NDArray[np.float32]) -> float:
    """The average to the seven digits of float32: 2.8 must reach a limit of 2.8, and 2.79999995 is less."""
    return float(f"{known.mean(dtype=np.float64):.7g}")


def _no_rms(channel: TrendChannel, known: NDArray[np.float32]) -> str:
    """Why values are no velocity RMS of a machine, in a clause; empty if they may be, or are something else.

    Only where zones of a standard show that it is one: such a value is never negative, and never so large.
    """
    if all(limits.zones is None for limits in channel.limits):
        return ""
    worst = float(known[np.argmax(np.abs(known))])
    if worst < -LEAST_RMS_MM_S or worst > MOST_RMS_MM_S:
        return f"reads {worst:.4g} {channel.unit}, which is no velocity RMS of a machine"
    return ""


def _no_speed(channel: TrendChannel, known: NDArray[np.float32]) -> str:
    """Why values are the speed of no shaft, in a clause; empty if they may be, or are something else."""
    worst = float(known[np.argmax(np.abs(known))])
    if abs(worst) <= MOST_RPM or (unit := unit_of(channel.unit)) is None or unit.name != "rpm":
        return ""
    return f"reads {worst:.4g} {channel.unit}, and no shaft turns faster than {MOST_RPM:,.0f} rpm"


def _beyond_ok(channel: TrendChannel, known: NDArray[np.float32]) -> str:
    if channel.ok_between is None:
        return ""
    low, high = np.array(channel.ok_between, np.float32)
    unit = unit_behind(channel.unit)
    # One such value is enough: in an average with it, the others would be believed in vain.
    beyond = known[(known < low) | (known > high)]
    if not len(beyond):
        return ""
    return (
        f"{channel.sensor} reads {beyond[-1]:.6g}{unit}, outside its OK limits {low:g} to {high:g}{unit}; "
        "check sensor, cable and supply"
    )
