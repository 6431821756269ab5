"""The verdict about the rotor of a recording, as data, as a JSON object and in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypedDict, get_args

from daqsvc.diagnosis.recorded import Verdict, finite
from daqsvc.dsp.quality.recorded import DataQuality, DataQualityJson
from daqsvc.rotor.synchronous.signatures import RotorFault
from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.rotor.synchronous.nonsynchronous import NonsynchronousLine
    from daqsvc.rotor.synchronous.signatures import Identification
    from daqsvc.rotor.synchronous.vectors import SynchronousVectors
    from daqsvc.rotor.synchronous.watch import WatchReport

VERDICTS: tuple[RotorFault, ...] = get_args(RotorFault)
_CLEAR = 0.9
"""Probability from which on the others of a group are only not excluded."""


class InstantJson(TypedDict):
    """A place in the recording.

    Attributes:
        sample: samples before it.
        seconds: time before it, in s.
        revolution: whole revolutions before it.
    """

    sample: int
    seconds: float
    revolution: int


class RotorAlarmJson(TypedDict):
    """A departure, and what came of it.

    Attributes:
        departure: where the alarm was raised.
        onset: estimated begin of the change.
        declaration: where its last group was first named; null if it never was.
        returned: where the machine was found healthy again; null if it was not.
        verdict: the most likely fault; null if it was over before there was an evaluation.
        group: all faults that could not be told apart, the most likely first.
    """

    departure: InstantJson | None
    onset: InstantJson | None
    declaration: InstantJson | None
    returned: InstantJson | None
    verdict: str | None
    group: list[str]


class ModeStepJson(TypedDict):
    """A change of the verdict, at the end of a revolution.

    Attributes:
        revolution: number of the revolution.
        verdict: the most likely fault; null between a departure and the first evaluation.
        group: all faults that cannot be told apart.
        named: whether two evaluations agree.
    """

    revolution: int
    verdict: str | None
    group: list[str]
    named: bool


class CalibrationJson(TypedDict):
    """The healthy machine that the verdict rests on.

    Attributes:
        revolutions: healthy revolutions that were measured.
        speed_rpm: mean speed of the shaft then.
        amplitude_um: amplitude of forward 1X.
        phase_deg: phase of forward 1X.
        ellipticity: backward over forward 1X.
        noise_um: noise of a sample, standard deviation.
        snr_db: whirl over noise.
        laval: whether the machine is like a Laval rotor.
        reference_revolutions: healthy revolutions that the baseline has grown to.
        smallest_change_um: the smallest change that can be seen.
        verdict: what the machine is like, in words.
    """

    revolutions: int
    speed_rpm: float
    amplitude_um: float
    phase_deg: float
    ellipticity: float
    noise_um: float
    snr_db: float | None
    laval: bool
    reference_revolutions: int
    smallest_change_um: float | None
    verdict: str


class LineJson(TypedDict):
    """A line at no harmonic of the shaft: it came with a change, or the bank has left it out.

    Attributes:
        frequency_hz: where it is.
        order: the same per revolution of the shaft.
        amplitude_um: root mean square radius of its motion.
        forward: whether the shaft goes around with its rotation or against it; null: back and forth.
        mains: 1 if cables pick up the mains, 2 if it is twice the mains; 0 otherwise.
        modulates: harmonic that has such a line on either side; null if it is alone.
        poles: of the induction motor whose poles pass as often as the harmonic is modulated; null if unknown.
        is_the_change: whether nothing else has changed, so that no fault is named.
    """

    frequency_hz: float
    order: float
    amplitude_um: float
    forward: bool | None
    mains: int
    modulates: int | None
    poles: int | None
    is_the_change: bool


class RotorVerdictJson(TypedDict):
    """The verdict about the rotor, by the calibrated rotor or by the bank; lengths in um.

    Attributes:
        recording: name of the recording.
        verdict: the most likely fault; null if the recording is refused, or is not about the rotor.
        group: all faults that the evidence cannot tell apart, the most likely first.
        named: whether two evaluations in a row agreed, or the machine is normal.
        probabilities: of every fault; empty if there was no evaluation.
        evidence: of every fault over normal, in nats.
        severity: size of the change over the amplitude of the healthy whirl; null if healthy.
        level: by fault of the group how large it would be, in its own terms.
        change_um: by order the change of the vector, real and imaginary part; null if healthy.
        line: beside the shaft's harmonics, that came with the change, or is left out; null if none stands
            out.
        onset: estimated begin of the change; null if there is none.
        departure: where the alarm was raised; null if it was not.
        declaration: where the last group was first named; null if it was not.
        alarms: every alarm that was raised, those that returned included.
        false_alarms_per_1000_rev: the rate of false alarms that the threshold is set for; null if not known.
        threshold_nats: evidence for an alarm; null if not known.
        calibration: the healthy machine; null if there is none.
        speed_rpm: mean speed of the shaft, negative if clockwise; null if not known.
        revolutions: whole revolutions in the recording.
        data_quality: what is known against the samples.
        refused: why the recording cannot be judged; null if it can.
        code: code of that reason; null if there is none.
        history: every change of the verdict.
    """

    recording: str
    verdict: str | None
    group: list[str]
    named: bool
    probabilities: dict[str, float]
    evidence: dict[str, float | None]
    severity: float | None
    level: dict[str, dict[str, float | None]]
    change_um: dict[str, list[float]] | None
    line: LineJson | None
    onset: InstantJson | None
    departure: InstantJson | None
    declaration: InstantJson | None
    alarms: list[RotorAlarmJson]
    false_alarms_per_1000_rev: float | None
    threshold_nats: float | None
    calibration: CalibrationJson | None
    speed_rpm: float | None
    revolutions: int
    data_quality: DataQualityJson
    refused: str | None
    code: str | None
    history: list[ModeStepJson]


@dataclass(frozen=True, slots=True)
class Instant:
    """A place in a recording.

    Attributes:
        sample: samples before it.
        seconds: time before it.
        revolution: whole revolutions before it.
    """

    sample: int
    seconds: float
    revolution: int

    def as_json(self) -> InstantJson:
        """For the output."""
        return {"sample": self.sample, "seconds": self.seconds, "revolution": self.revolution}


@dataclass(frozen=True, slots=True)
class RotorAlarm:
    """A departure, and what came of it until the next one or until the machine was healthy again.

    Attributes:
        onset: estimated begin of the change.
        departure: where the alarm was raised.
        declaration: where its last group was first named; None if it never was.
        verdict: the most likely fault by its last evaluation; None if it was over before there was one.
        group: all that could not be told apart, the most likely first.
        returned: where the machine was found healthy again; None if it was not.
    """

    onset: Instant
    departure: Instant
    declaration: Instant | None
    verdict: RotorFault | None
    group: tuple[RotorFault, ...]
    returned: Instant | None

    def as_json(self) -> RotorAlarmJson:
        """For the output."""
        return {
            "departure": _json_of(self.departure),
            "onset": _json_of(self.onset),
            "declaration": _json_of(self.declaration),
            "returned": _json_of(self.returned),
            "verdict": self.verdict,
            "group": list(self.group),
        }

    def describe(self) -> str:
        """One line for a person."""
        what = " or ".join(words(name) for name in self.group) or "a change that was not evaluated"
        named = (
            "not named" if self.declaration is None else f"named at revolution {self.declaration.revolution}"
        )
        after = "" if self.returned is None else f"; healthy again at {place_of(self.returned)}"
        return (
            f"alarm at {place_of(self.departure)}: {what}, changed at revolution {self.onset.revolution}, "
            f"{named}{after}"
        )


@dataclass(frozen=True, slots=True)
class ModeStep:
    """A change of what is stated about the machine, at the end of a revolution.

    Attributes:
        revolution: the revolution.
        verdict: most likely; None between a departure and the first look at it.
        group: all that cannot be told apart.
        named: whether two evaluations agree.
        probabilities: of that evaluation.
    """

    revolution: int
    verdict: RotorFault | None
    group: tuple[RotorFault, ...] = ()
    named: bool = False
    probabilities: Mapping[RotorFault, float] = field(default_factory=dict)

    def as_json(self) -> ModeStepJson:
        """For the output."""
        return {
            "revolution": self.revolution,
            "verdict": self.verdict,
            "group": list(self.group),
            "named": self.named,
        }


@dataclass(frozen=True, slots=True)
class Trace:
    """What the verdict was made of, for figures.

    Attributes:
        vectors: of all revolutions.
        reports: one for each revolution that could be fitted.
    """

    vectors: SynchronousVectors
    reports: tuple[WatchReport, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RotorVerdict(Verdict):
    """What a recording reports about a rotor; see `Verdict`.

    Attributes:
        verdict: the fault, the most likely one of ``group``; None if refused.
        group: all that the evidence cannot tell apart, the most likely first.
        named: whether two evaluations in a row agreed, or the machine is normal.
        probabilities: of every verdict.
        evidence: nats of every hypothesis over "normal".
        severity: modulus of the change over the healthy whirl's amplitude.
        level: how large each fault of the group would be, in its own terms
            (`daqsvc.rotor.synchronous.severity`).
        identification: what the last evaluation saw; None while the machine is healthy.
        left_out: lines that the bank leaves out of the positions at the end, the largest first.
        onset: estimated begin of the change.
        departure: where the alarm is raised.
        declaration: where the final group was first named.
        alarms: every alarm that was raised, those that went away again included.
        false_alarms_per_1000_rev: the rate that the threshold is set for.
        threshold_nats: of the departure test.
        calibration: the healthy baseline; None if there is none.
        reference_revolutions: healthy revolutions that the baseline has grown to.
        speed_rpm: mean shaft speed, negative if clockwise; None if not known.
        revolutions: whole revolutions in the recording.
        history: every change of what was stated.
        trace: what it was made of; None if refused before.
    """

    part: ClassVar[str] = "rotor"

    verdict: RotorFault | None = None
    group: tuple[RotorFault, ...] = ()
    named: bool = False
    probabilities: Mapping[RotorFault, float] = field(default_factory=dict)
    evidence: Mapping[RotorFault, float] = field(default_factory=dict)
    severity: float | None = None
    level: Mapping[RotorFault, Mapping[str, float]] = field(default_factory=dict)
    identification: Identification | None = None
    left_out: tuple[NonsynchronousLine, ...] = ()
    onset: Instant | None = None
    departure: Instant | None = None
    declaration: Instant | None = None
    alarms: tuple[RotorAlarm, ...] = ()
    false_alarms_per_1000_rev: float | None = None
    threshold_nats: float | None = None
    calibration: Calibration | None = None
    reference_revolutions: int | None = None
    speed_rpm: float | None = None
    revolutions: int = 0
    history: tuple[ModeStep, ...] = ()
    trace: Trace | None = None

    @classmethod
    def not_judged(cls, recording: str, why: str, quality: DataQuality | None = None) -> RotorVerdict:
        """The verdict about a recording that cannot be judged."""
        return cls(recording=recording, quality=quality or DataQuality(0), refused=why)

    def as_json(self) -> dict[str, Any]:
        """A JSON object: all figures finite, lengths in um."""
        change = None if self.identification is None else self.identification.change
        document: RotorVerdictJson = {
            "recording": self.recording,
            "verdict": self.verdict,
            "group": list(self.group),
            "named": self.named,
            "probabilities": {name: self.probabilities.get(name, 0.0) for name in VERDICTS}
            if self.probabilities
            else {},
            "evidence": {str(name): nats for name, nats in self.evidence.items()},
            "severity": self.severity,
            "level": {fault: {**level} for fault, level in self.level.items()},
            "change_um": None
            if change is None
            else {
                str(order): [value.real, value.imag]
                for order, value in zip(HARMONICS, change.tolist(), strict=True)
            },
            "line": self._line(),
            "onset": _json_of(self.onset),
            "departure": _json_of(self.departure),
            "declaration": _json_of(self.declaration),
            "alarms": [alarm.as_json() for alarm in self.alarms],
            "false_alarms_per_1000_rev": self.false_alarms_per_1000_rev,
            "threshold_nats": self.threshold_nats,
            "calibration": None
            if self.calibration is None
            else calibration_json(self.calibration, self.reference_revolutions),
            "speed_rpm": self.speed_rpm,
            "revolutions": self.revolutions,
            "data_quality": self.quality.as_json(),
            "refused": self.refused,
            "code": self.refusal_code,
            "history": [step.as_json() for step in self.history],
        }
        return {**finite(document)}

    def describe(self) -> str:
        """A few lines for a person."""
        lines = [f"{self.recording}: {self._headline()}"]
        if self.departure is not None and self.onset is not None:
            lines.append(
                f"changed at {place_of(self.onset)}; alarm at {place_of(self.departure)}" + self._named()
            )
        if len(self.alarms) > 1 or any(alarm.returned is not None for alarm in self.alarms):
            lines += [alarm.describe() for alarm in self.alarms]
        if self.identification is not None and self.calibration is not None:
            lines.append(self._change())
            if sentence := self.identification.describe_line():
                lines.append(sentence)
            lines += [
                f"{words(fault)}: {', '.join(_figure(key, value) for key, value in level.items())}"
                for fault, level in self.level.items()
                if level
            ]
        lines += [line.describe(left_out=True) for line in self.left_out]
        if self.calibration is not None:
            was = self.calibration
            lines.append(
                f"healthy: 1X {was.amplitude_um:.4g} um at {_degrees(was.baseline[1]):z.0f} degrees, "
                f"{was.revolutions} revolutions at {abs(was.speed_rpm):.1f} rpm, noise {was.noise_um:.3g} um "
                f"({was.snr_db:.0f} dB)"
            )
            lines.append(f"the machine {_grown(was, self.reference_revolutions).describe()}")
        bad = [
            f"{count} {what} {'sample' if count == 1 else 'samples'} of {name}"
            for what, counts in (("missing", self.quality.missing), ("infinite", self.quality.infinite))
            for name, count in counts.items()
            if count
        ]
        if self.quality.unusable_revolutions and self.refused is None:
            bad.append(f"{self.quality.unusable_revolutions} of {self.revolutions} revolutions unusable")
        if bad:
            lines.append(f"data: {', '.join(bad)}")
        lines += self.quality.problems
        return "\n  ".join(lines)

    def _headline(self) -> str:
        if self.refused is not None:
            return f"not judged: {self.refusal}"
        if self.verdict is None and self.departure is None:
            return "no detector of a rotor fault in the machine file"
        if self.verdict is None:
            return "changed, but no revolution after the change can be judged"
        modes = " or ".join(words(name) for name in self.group)
        chance = self.probabilities.get(self.verdict, 0.0)
        if self.verdict == "normal" and self.alarms:
            count = len(self.alarms)
            raised = "an alarm was" if count == 1 else f"{count} alarms were"
            return (
                f"normal at the end of {self.revolutions} revolutions, but {raised} raised and cleared before"
            )
        if self.verdict == "normal":
            # Until a line was known it was taken for a fault: the history has it.
            through = "at the end of" if self.left_out else "through"
            without = ", without a line that is left out" if self.left_out else ""
            return f"normal {through} {self.revolutions} revolutions{without}"
        if not self.named:
            modes += " (not yet settled)"
        elif len(self.group) > 1 and chance >= _CLEAR:
            others = " and ".join(words(name) for name in self.group[1:])
            excluded = "is" if len(self.group) == 2 else "are"
            modes += f" ({words(self.verdict)} {_percent(chance)}, but {others} {excluded} not excluded)"
        elif len(self.group) > 1:
            modes += f" (cannot be told apart; {words(self.verdict)} {_percent(chance)})"
        else:
            modes += f" ({_percent(chance)})"
        return modes

    def _line(self) -> LineJson | None:
        now = self.identification
        if self.left_out:
            return _line_json(self.left_out[0], is_the_change=self.verdict == "normal")
        return None if now is None or now.line is None else _line_json(now.line, is_the_change=now.by_line)

    def _named(self) -> str:
        return f"; named at {place_of(self.declaration)}" if self.declaration is not None else "; not named"

    def _change(self) -> str:
        assert self.identification is not None  # noqa: S101 - asked before
        assert self.calibration is not None  # noqa: S101 - asked before
        change, now = self.identification.change, self.calibration.baseline + self.identification.change
        return (
            f"severity {self.identification.severity:.3g} of the healthy whirl; 1X is "
            f"{abs(now[1]):.4g} um at {_degrees(now[1]):z.0f} degrees, the mean position moved by "
            f"{abs(change[0]):.3g} um, backward 1X by {abs(change[2]):.3g}, 2X by {abs(change[3]):.3g} um"
        )


def calibration_json(calibration: Calibration, reference_revolutions: int | None = None) -> CalibrationJson:
    """A calibration for the output.

    Args:
        calibration: the calibration.
        reference_revolutions: healthy revolutions that its baseline has grown to; None: it has not.
    """
    grown = _grown(calibration, reference_revolutions)
    return {
        "revolutions": calibration.revolutions,
        "speed_rpm": calibration.speed_rpm,
        "amplitude_um": calibration.amplitude_um,
        "phase_deg": _degrees(calibration.baseline[1]),
        "ellipticity": calibration.ellipticity,
        "noise_um": calibration.noise_um,
        "snr_db": calibration.snr_db,
        "laval": calibration.laval,
        "reference_revolutions": grown.revolutions,
        "smallest_change_um": grown.smallest_change_um,
        "verdict": grown.describe(),
    }


def _grown(calibration: Calibration, revolutions: int | None) -> Calibration:
    return calibration if revolutions is None else replace(calibration, revolutions=revolutions)


def _json_of(instant: Instant | None) -> InstantJson | None:
    return None if instant is None else instant.as_json()


def _line_json(line: NonsynchronousLine, *, is_the_change: bool) -> LineJson:
    return {
        "frequency_hz": line.frequency_hz,
        "order": line.order,
        "amplitude_um": line.amplitude_um,
        "forward": line.forward,
        "mains": line.mains,
        "modulates": line.modulates,
        "poles": line.poles,
        "is_the_change": is_the_change,
    }


def place_of(instant: Instant) -> str:
    """A place in words."""
    return f"revolution {instant.revolution} (sample {instant.sample}, {instant.seconds:.3f} s)"


def _degrees(vector: complex) -> float:
    return math.degrees(math.atan2(vector.imag, vector.real))


def words(name: str) -> str:
    """A verdict in words."""
    return name.replace("_", " ")


def _percent(probability: float) -> str:
    return "above 99.9 %" if probability > 0.999 else f"{100.0 * probability:.1f} %"


_UNITS = {"_um": " um", "_deg": " degrees", "_percent": " %"}


def _figure(key: str, value: float) -> str:
    """A figure whose name ends in its unit, in words: ``change_um`` 3.0 is ``change 3 um``."""
    for ending, unit in _UNITS.items():
        if key.endswith(ending):
            return f"{words(key.removesuffix(ending))} {value:z.3g}{unit}"
    return f"{words(key)} {value:.3g}"
