"""The verdict about the bearings of a recording, as data, as a JSON object and in words."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, NotRequired, TypedDict

from daqsvc.bearing.identify import ChangeRules
from daqsvc.bearing.race.verdict import PARTS, RaceRules
from daqsvc.detectors.bearing.finding import WORDS, severity_of
from daqsvc.diagnosis.recorded import Verdict, finite
from daqsvc.dsp.quality.recorded import DataQualityJson  # noqa: TC001 - the page of formats reads the types

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.identify import HealthyResidual, ResidualChange
    from daqsvc.bearing.race.verdict import RaceLine, RaceVerdict
    from daqsvc.detectors.bearing.finding import BearingFinding
    from daqsvc.dsp.drive_lines import DriveLines
    from daqsvc.dsp.quality.unit import AccelerationUnit

_LISTED_LINES = 4


class RaceEvidenceJson(TypedDict):
    """The evidence for damage of one part.

    Attributes:
        z: significance of its kinematic lines, in standard deviations of noise.
        z_limit: the significance from which the part may be named.
        size: modulation by its lines in the whitened envelope.
        severity: `z` times `size`.
        severity_limit: the severity from which the part is named.
        steadiness: size in the logarithm of the envelope over size in its square; small for a few transients.
        steadiness_limit: the steadiness from which a race may be named; 0 for a ball.
        false_alarm_probability: chance of such a `z` or a larger one in noise.
        order: its events in a revolution of the shaft, as found.
        testable: whether the recording is long enough to tell its lines from harmonics of the shaft.
        reason: why the part is not testable; null if it is.
    """

    z: float | None
    z_limit: float | None
    size: float | None
    severity: float | None
    severity_limit: float | None
    steadiness: float | None
    steadiness_limit: float | None
    false_alarm_probability: float | None
    order: float | None
    testable: bool
    reason: str | None


class RaceLineJson(TypedDict):
    """A kinematic line that stands out of the envelope spectrum.

    Attributes:
        part: the part whose damage makes such a line.
        harmonic: multiple of the part's fundamental; 0 for a line of the cage alone.
        sideband: offset in multiples of the modulating rate; 0 for the harmonic itself.
        frequency_hz: where it was found.
        order: the same for each revolution of the shaft.
        evidence_nats: evidence against noise.
        size: modulation by the line in the whitened envelope.
    """

    part: str
    harmonic: int
    sideband: int
    frequency_hz: float
    order: float
    evidence_nats: float
    size: float


class DriveJson(TypedDict):
    """A gear or a motor whose lines stand out, and are taken for no part's.

    Attributes:
        kind: what it is.
        frequency_hz: its fundamental.
        order: the same for each revolution of the shaft.
        teeth: teeth of the gear on this shaft; null if it is not one.
        mate_teeth: teeth of the other gear; null if they are not known.
        sideband_spacing: distance of the sidebands, for each revolution of the shaft; null without sidebands.
        poles: poles of the motor; null if it is not one.
    """

    kind: str
    frequency_hz: float
    order: float
    teeth: int | None
    mate_teeth: int | None
    sideband_spacing: float | None
    poles: int | None


class ResidualBandJson(TypedDict):
    """A band of frequencies.

    Attributes:
        low_hz: its lower end.
        high_hz: its upper end.
        rise_db: how much more is in it than in the healthy machine.
        limit_db: the rise from which on it is a change.
    """

    low_hz: float
    high_hz: float
    rise_db: float | None
    limit_db: float | None


class ResidualJson(TypedDict):
    """What the model of the healthy bearing does not predict.

    Attributes:
        changed: whether it is more than chance.
        ratio: its level over that of the healthy machine.
        rise_db: the same in dB.
        limit_db: the rise from which on it is a change.
        departure: how far it is from the healthy machine.
        bands: the same by bands of frequencies.
        windows: windows of the recording that were compared.
        model_order: order of the model.
        healthy_windows: windows that the limits were learned from.
    """

    changed: bool
    ratio: float | None
    rise_db: float | None
    limit_db: float | None
    departure: float | None
    bands: list[ResidualBandJson]
    windows: int
    model_order: int
    healthy_windows: int


class BearingOrdersJson(TypedDict):
    """Events of the bearing in a revolution of the shaft.

    Attributes:
        name: designation of the bearing; null if it is not known.
        bpfi: passes of balls over the inner race.
        bpfo: passes of balls over the outer race.
        bsf: revolutions of a ball.
        ftf: revolutions of the cage.
    """

    name: str | None
    bpfi: float
    bpfo: float
    bsf: float
    ftf: float


class BearingChannelJson(TypedDict):
    """The verdict of one channel by itself; of one that is refused some keys are absent.

    Attributes:
        bearing: the bearing that the channel is at.
        verdict: the verdict as one word; null if the channel is refused.
        group: parts that the evidence cannot tell apart, the verdict among them.
        severity: how bad it is; null if the channel is refused.
        margin: how far the decision is from another, as a factor of severity, 10 at most.
        evidence: by part.
        lines: kinematic lines that were found, the strongest first.
        level_db: level over that of the healthy machine; null without one.
        speed_rpm: speed of the shaft by its harmonics.
        notes: what a person should know, in sentences.
        refused: why the channel cannot be judged; null if it can.
    """

    bearing: BearingOrdersJson
    verdict: str | None
    group: list[str]
    severity: float | None
    margin: NotRequired[float | None]
    evidence: NotRequired[dict[str, RaceEvidenceJson]]
    lines: NotRequired[list[RaceLineJson]]
    level_db: NotRequired[float | None]
    speed_rpm: NotRequired[float]
    notes: NotRequired[list[str]]
    refused: str | None


class BearingVerdictJson(TypedDict):
    """The verdict about the bearings.

    Attributes:
        recording: name of the recording.
        baseline: name of the healthy recording; null without one.
        verdict: the verdict as one word; null if the recording is refused.
        group: parts that the evidence cannot tell apart, the verdict among them.
        channel: the channel that the verdict is about; null if the recording is refused.
        probabilities: of each verdict.
        severity: how bad it is; null if the recording is refused.
        margin: how far the decision is from another, as a factor of severity, 10 at most.
        evidence: by part, of that channel.
        lines: kinematic lines that were found, the strongest first, of that channel.
        residual: what the model of the healthy bearing does not predict; null without one.
        false_alarm_probability: chance of a false alarm that the test of the residual is set for.
        race_false_alarm_probability: chance of a false alarm that the test of the races is set for.
        channels: by channel the verdict of each by itself.
        speed_rpm: speed of the shaft by its harmonics; null if the recording is refused.
        speed_stated_rpm: speed by the machine file or `--speed-rpm`.
        speed_seen: whether harmonics of the shaft stand out; null if the recording is refused.
        revolutions: revolutions of the shaft in the evidence.
        unit: unit of the samples.
        notes: what a person should know, in sentences.
        drives: gears and motors whose lines stand out.
        data_quality: what is known against the samples.
        refused: why the recording cannot be judged; null if it can.
        code: code of that reason; null if there is none.
    """

    recording: str
    baseline: str | None
    verdict: str | None
    group: list[str]
    channel: str | None
    probabilities: dict[str, float]
    severity: float | None
    margin: float | None
    evidence: dict[str, RaceEvidenceJson]
    lines: list[RaceLineJson]
    residual: ResidualJson | None
    false_alarm_probability: float
    race_false_alarm_probability: float | None
    channels: dict[str, BearingChannelJson]
    speed_rpm: float | None
    speed_stated_rpm: float | None
    speed_seen: bool | None
    revolutions: float
    unit: str
    notes: list[str]
    drives: list[DriveJson]
    data_quality: DataQualityJson
    refused: str | None
    code: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingSetup:
    """What a recording of bearings is judged by.

    Attributes:
        channels: accelerometers on the bearings' housings, or the bearings where these have names.
        speed_rpm: shaft speed, right to about 1 %.
        bearings: fault orders of the bearing at each channel.
        designations: of the bearings; those that were given by their orders have none.
        unit: of the samples; ``"V"`` if the sensors' sensitivity is not known.
        change: what counts as a change of the healthy machine.
        race: settings of the race test.
    """

    channels: tuple[str, ...]
    speed_rpm: float
    bearings: Mapping[str, BearingOrders]
    designations: Mapping[str, str] = field(default_factory=dict)
    unit: AccelerationUnit = "g"
    change: ChangeRules = field(default_factory=ChangeRules)
    race: RaceRules = field(default_factory=RaceRules)


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingVerdict(Verdict):
    """What a recording reports about a machine's bearings; see `Verdict`.

    Attributes:
        baseline: name of the healthy run; None without one.
        setup: what it was judged by.
        finding: the verdict; None if refused.
        races: what each channel shows, of those that could be judged.
        unfit: why the others could not.
        healthy: what the innovations were compared with; None if they were not.
        change: how they differ; None if they were not compared.
    """

    part: ClassVar[str] = "bearing"

    baseline: str | None
    setup: BearingSetup
    finding: BearingFinding | None = None
    races: Mapping[str, RaceVerdict] = field(default_factory=dict)
    unfit: Mapping[str, str] = field(default_factory=dict)
    healthy: HealthyResidual | None = None
    change: ResidualChange | None = None

    def with_problem(self, problem: str) -> BearingVerdict:
        """The same with one more problem of data quality."""
        return replace(self, quality=self.quality.with_problem(problem))

    @property
    def leading(self) -> RaceVerdict | None:
        """The channel that the verdict is about."""
        return None if self.finding is None else self.races[self.finding.where]

    def as_json(self) -> dict[str, Any]:
        """A JSON object: all figures finite."""
        finding, race = self.finding, self.leading
        document: BearingVerdictJson = {
            "recording": self.recording,
            "baseline": self.baseline,
            "verdict": None if finding is None else finding.verdict,
            "group": [] if finding is None else list(finding.group),
            "channel": None if finding is None else finding.where,
            "probabilities": {} if finding is None else {word: finding.probabilities[word] for word in WORDS},
            "severity": None if finding is None else finding.severity,
            "margin": None if race is None else race.margin,
            "evidence": {} if race is None else evidence_json(race),
            "lines": [] if race is None else [line_json(line) for line in race.lines],
            "residual": self._residual(),
            "false_alarm_probability": self.setup.change.false_alarm_probability,
            "race_false_alarm_probability": None if race is None else race.false_alarm_probability,
            "channels": {name: self._judged(name) for name in self.setup.channels},
            "speed_rpm": None if race is None else race.speed_rpm,
            "speed_stated_rpm": self.setup.speed_rpm,
            "speed_seen": None if race is None else race.speed_seen,
            "revolutions": 0 if race is None else race.revolutions,
            "unit": self.setup.unit,
            "notes": [] if race is None else list(race.notes),
            "drives": [] if race is None else [drive_json(drive) for drive in race.drives],
            "data_quality": self.quality.as_json(),
            "refused": self.refused,
            "code": self.refusal_code,
        }
        return {**finite(document)}

    def _bearing(self, name: str) -> BearingOrdersJson:
        orders = self.setup.bearings[name]
        return {
            "name": self.setup.designations.get(name),
            "bpfi": orders.inner,
            "bpfo": orders.outer,
            "bsf": orders.ball,
            "ftf": orders.cage,
        }

    def _judged(self, name: str) -> BearingChannelJson:
        """What one channel states by itself."""
        race = self.races.get(name)
        if race is None:
            return {
                "bearing": self._bearing(name),
                "verdict": None,
                "group": [],
                "severity": None,
                "refused": self.unfit.get(name, self.refused),
            }
        return {
            "bearing": self._bearing(name),
            "verdict": race.verdict,
            "group": list(race.group),
            "severity": severity_of(race),
            "margin": race.margin,
            "evidence": evidence_json(race),
            "lines": [line_json(line) for line in race.lines],
            "level_db": race.level_db,
            "speed_rpm": race.speed_rpm,
            "notes": list(race.notes),
            "refused": None,
        }

    def _residual(self) -> ResidualJson | None:
        if self.change is None or self.healthy is None:
            return None
        change, healthy = self.change, self.healthy
        return {
            "changed": change.changed,
            "ratio": change.ratio,
            "rise_db": change.rise_db[0],
            "limit_db": change.limit_db[0],
            "departure": change.departure,
            "bands": [
                {"low_hz": low, "high_hz": high, "rise_db": rise, "limit_db": limit}
                for low, high, rise, limit in zip(
                    healthy.edges_hz[:-1],
                    healthy.edges_hz[1:],
                    change.rise_db[1:],
                    change.limit_db[1:],
                    strict=True,
                )
            ],
            "windows": change.windows,
            "model_order": healthy.model.order,
            "healthy_windows": healthy.windows,
        }

    def describe(self) -> str:
        """A few lines for a person."""
        finding, race = self.finding, self.leading
        if finding is None or race is None:
            return f"{self.recording}: not judged: {self.refusal}"
        lines = [f"{self.recording}: {self._headline(finding, race)}"]
        lines.append(
            ", ".join(
                f"{part} z {e.z:.1f} size {e.depth:.2f}" + ("" if e.testable else " (not testable)")
                for part, e in ((part, race.evidence[part]) for part in PARTS)
            )
        )
        shown_lines = [line for line in race.lines if line.part in finding.group][:_LISTED_LINES]
        lines += [
            f"{_line_name(line)} at {line.frequency_hz:.2f} Hz ({line.order:.3f} per revolution), modulation "
            f"{line.depth:.2f}"
            for line in shown_lines
        ]
        if self.change is not None:
            change = self.change
            lines.append(
                f"what the healthy machine of {self.baseline} does not predict is {change.ratio:.2f} times "
                f"what it was ({change.rise_db[0]:+.1f} dB, limit {change.limit_db[0]:.1f} dB; largest rise "
                f"of a band {change.rise_db[1:].max():+.1f} dB)"
            )
        seen = "by its harmonics" if race.speed_seen else "not confirmed by its harmonics"
        lines.append(f"{race.speed_rpm:.1f} rpm {seen}, {race.revolutions:.0f} revolutions")
        lines += [drive.describe() for drive in race.drives]
        lines += [f"{name}: not judged: {why}" for name, why in self.unfit.items()]
        # Those about the samples are problems of the data.
        lines += [
            note
            for note in race.notes
            if not any(note in shown_lines for shown_lines in self.quality.problems)
        ]
        return "\n  ".join([*lines, *self.quality.problems])

    @staticmethod
    def _headline(finding: BearingFinding, race: RaceVerdict) -> str:
        words = {
            "normal": "normal",
            "changed": "changed, cause not known",
            "inner": "inner race",
            "outer": "outer race",
            "ball": "ball",
            "inner_or_outer": "inner or outer race (cannot be told apart)",
        }
        sentence = words[finding.verdict]
        others = [words[name] for name in finding.group if name != finding.verdict and name in words]
        if finding.verdict not in {"normal", "changed", "inner_or_outer"} and others:
            conjunction = "and perhaps" if race.both else "or"
            sentence += f" {conjunction} {' or '.join(others)}"
        if finding.verdict in {"normal", "changed"}:
            blind = [part for part in PARTS if not race.evidence[part].testable]
            return (
                f"{sentence} as far as it can be tested ({', '.join(blind)} not testable)"
                if blind
                else sentence
            )
        return f"{sentence} at {finding.where}, severity {finding.severity:.1f}"


def evidence_json(race: RaceVerdict) -> dict[str, RaceEvidenceJson]:
    """The evidence for each part, for the output."""
    return {
        part: {
            "z": e.z,
            "z_limit": e.z_limit,
            "size": e.depth,
            "severity": e.severity,
            "severity_limit": e.limit,
            "steadiness": e.steadiness,
            "steadiness_limit": e.steadiness_limit,
            "false_alarm_probability": e.false_alarm_probability,
            "order": e.order,
            "testable": e.testable,
            "reason": e.reason or None,
        }
        for part, e in race.evidence.items()
    }


def line_json(line: RaceLine) -> RaceLineJson:
    """A line, for the output."""
    return {
        "part": line.part,
        "harmonic": line.harmonic,
        "sideband": line.sideband,
        "frequency_hz": line.frequency_hz,
        "order": line.order,
        "evidence_nats": line.evidence,
        "size": line.depth,
    }


def drive_json(drive: DriveLines) -> DriveJson:
    """A gear or a motor, for the output."""
    return {
        "kind": drive.kind,
        "frequency_hz": drive.frequency_hz,
        "order": drive.order,
        "teeth": drive.teeth,
        "mate_teeth": drive.mate_teeth,
        "sideband_spacing": drive.spacing,
        "poles": drive.poles,
    }


def _line_name(line: RaceLine) -> str:
    """``2 x BPFO``, ``BPFI - shaft``, ``2 x BSF + cage``."""
    base = {"inner": "BPFI", "outer": "BPFO", "ball": "2 BSF"}[line.part]
    by = "cage" if line.part == "ball" else "shaft"
    if line.harmonic == 0:
        return f"{abs(line.sideband)} x {by}"
    name = base if line.harmonic == 1 else f"{line.harmonic} x {base}"
    if not line.sideband:
        return name
    apart = by if abs(line.sideband) == 1 else f"{abs(line.sideband)} x {by}"
    return f"{name} {'+' if line.sideband > 0 else '-'} {apart}"
