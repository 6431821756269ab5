"""What a detector states about a whole recording: what it is given, its statements condensed, its verdict."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Generic,
    NotRequired,
    TypeAlias,
    TypedDict,
    TypeVar,
)

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.confined.spilled import let_go
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.statements import window_statements
from daqsvc.dsp.quality.unit import UM_PER_UNIT
from daqsvc.errors.code import with_code
from daqsvc.errors.recordings import NOT_JUDGED
from daqsvc.rounding import with_unit
from daqsvc.settings.failures import one_line
from daqsvc.settings.hooks import Hooks, contract, may_raise
from daqsvc.settings.models import ProximityProbe
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.section import Section

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.dsp.quality.recorded import DataQuality
    from daqsvc.errors.code import Code
    from daqsvc.recording.recording import Recording
    from daqsvc.settings.models import MachineFile

    Floats: TypeAlias = NDArray[np.float64]
    Progress: TypeAlias = Callable[[int, int], None]

SettingsT = TypeVar("SettingsT", bound=Section)
FiniteT = TypeVar("FiniteT")

_SEVERITIES = ("normal", "alert", "danger")
_BLOCKS = 256
"""Blocks handed over at a time."""

_MOST_ROWS = 1 << 18
"""Samples of a channel that are handed over at a time at most, unless a block has more."""
_LONGEST_NAME = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingOptions:
    """What is stated of recordings beside the machine file.

    Attributes:
        channels: which variable of a recording is which sensor or channel.
        rate_hz: sampling rate; None: what the recording states.
        unit: unit of the samples in the recording; None: those of the sensors.
        calibration: file with the healthy machine, in place of what the machine file names.
        in_memory: whether the machine file was made of options: its sensors are then called in the file as
            ``channels`` states, or as they are, and a figure that the recording has to show is NaN.
        patterns: whether a channel may be named by a pattern, or by what its name in the file ends with.
        speed_step_rpm: step of the stated speed's last digit, which it is rounded to; 0: it is exact.
        healthy: a recording of the healthy machine that others are compared with; None without one.
        healthy_channels: what its variables are called, where that is not as in ``channels``.
        healthy_rate_hz: its sampling rate, where that is not ``rate_hz``.
    """

    channels: Mapping[str, str] = field(default_factory=dict)
    rate_hz: float | None = None
    unit: str | None = None
    calibration: Path | None = None
    in_memory: bool = False
    patterns: bool = False
    speed_step_rpm: float = 0.0
    healthy: str | None = None
    healthy_channels: Mapping[str, str] = field(default_factory=dict)
    healthy_rate_hz: float | None = None


@dataclass(frozen=True, slots=True)
class Recorded:
    """A recording of a machine.

    Attributes:
        machine: the machine file with the sensors that the recording has, and its rate for all streams.
        recording: its channels, by the names of the sensors.
        options: what was stated of it.
    """

    machine: MachineFile
    recording: Recording
    options: RecordingOptions

    def samples_of(self, stream: str) -> Floats:
        """The recording in columns and units of a stream or grid, float64 ``[n, channels]``; NaN: missing."""
        return self.blocks_of(stream)[:]

    def blocks_of(self, stream: str) -> Blocks:
        """The same, made piece by piece: a long recording is not held twice."""
        # A recording has all channels of a grid on one grid already.
        grids = {grid.name: tuple(grid.streams) for grid in self.machine.grids}
        return Blocks(self, grids.get(stream, (stream,)))

    def _stream(self, stream: str, rows: slice) -> Floats:
        recording, unit = self.recording, self.options.unit
        names = self.machine.streams[stream].layout.channel_names
        taken = recording.samples[rows].astype(np.float64, copy=False)
        samples = np.full((len(taken), len(names)), np.nan)
        for sensor in self.machine.sensors:
            if sensor.stream == stream:
                column = taken[:, recording.names.index(sensor.name)]
                if isinstance(sensor, ProximityProbe) and unit is not None:
                    column = column * UM_PER_UNIT[unit] / UM_PER_UNIT[sensor.unit]
                samples[:, names.index(sensor.channel)] = column
        return np.where(np.isfinite(samples), samples, np.nan)


class Blocks:
    """The samples of streams of a recording; a slice of it is float64 ``[n, channels]``, NaN: missing.

    Args:
        recorded: the recording.
        streams: whose channels stand side by side.
    """

    def __init__(self, recorded: Recorded, streams: Sequence[str]) -> None:
        self._recorded = recorded
        self._streams = streams

    def __len__(self) -> int:
        return len(self._recorded.recording.samples)

    def __getitem__(self, rows: slice) -> Floats:
        streams = [self._recorded._stream(name, rows) for name in self._streams]  # noqa: SLF001
        let_go(self._recorded.recording.samples)
        return streams[0] if len(streams) == 1 else np.concatenate(streams, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict(ABC):
    """What a recording reports about a part of a machine; each detector that gives one adds what it rests on.

    Attributes:
        recording: name of the recording.
        quality: what is known against its samples.
        refused: why it cannot be judged; None if it can.
        code: of the kind of reason; None where `NOT_JUDGED` states it, and for one that was judged.
    """

    part: ClassVar[str]
    """What it is about: ``"rotor"``, ``"bearing"``. Of one part only one detector gives the verdict."""

    recording: str
    quality: DataQuality
    refused: str | None = None
    code: Code | None = None

    @property
    def refusal(self) -> str:
        """Why it cannot be judged, with the code of the kind of reason."""
        return with_code(f"{self.refused}", self.code or NOT_JUDGED)

    @property
    def refusal_code(self) -> str | None:
        """The code of the kind of reason; None for a recording that was judged."""
        return None if self.refused is None else (self.code or NOT_JUDGED).id

    @abstractmethod
    def as_json(self) -> dict[str, Any]:
        """A JSON object: all figures finite."""

    @abstractmethod
    def describe(self) -> str:
        """A few lines for a person."""


@dataclass(frozen=True, slots=True)
class Evaluated:
    """What a detector brings forward about a recording.

    Attributes:
        statements: what it stated, condensed.
        verdict: what that comes to; None if it gives none by itself.
        draw: writes figures, whose names begin with what it is called with; None if there is nothing to draw.
    """

    statements: tuple[Statements, ...] = ()
    verdict: Verdict | None = None
    draw: Callable[[str], object] | None = None


@contract
class RecordedDetector(Hooks, Generic[SettingsT]):
    """A detector of a machine file over recordings of its machine.

    Args:
        machine: the machine file.
        given: the detector's table.
        options: what is stated of the recordings.

    Attributes:
        part: what its verdicts are about; empty if it gives none. Of several detectors of one part the last
            in the order of their places gives the verdict.
        takes_fewer: whether it judges a recording that has some of its sensors only; else such a one is
            refused, if the verdict is this detector's.
    """

    part: ClassVar[str] = ""
    takes_fewer: ClassVar[bool] = False

    def __init__(self, machine: MachineFile, settings: SettingsT, options: RecordingOptions) -> None:
        self.machine = machine
        self.settings = settings
        self.options = options

    @property
    def sensors(self) -> tuple[str, ...]:
        """Sensors that its verdict rests on, all sampled at one rate."""
        return ()

    def as_recorded(self, sensors: Container[str]) -> SettingsT | None:
        """The table as far as a recording has its sensors; None if it has too few of them.

        Args:
            sensors: names of the sensors that the recording has.
        """
        known = {sensor.name for sensor in self.machine.sensors}
        named = known.intersection(_texts(self.settings.model_dump()))
        return self.settings if all(name in sensors for name in named) else None

    def left_out(self, sensors: Container[str]) -> str:
        """What a recording does not show of the machine, in a sentence; empty if there is nothing.

        Args:
            sensors: names of the sensors that the recording has.
        """
        del sensors
        return ""

    def not_judged(self, recording: str, why: str) -> Verdict | None:
        """The verdict about a recording that cannot be judged; None if this detector gives none.

        Args:
            recording: its path.
            why: it cannot.
        """
        del recording, why
        return None

    @may_raise(AssemblyError, ValueError)
    def evaluate(self, recorded: Recorded, settings: SettingsT, progress: Progress | None) -> Evaluated:
        """Process a recording.

        Args:
            recorded: the recording, with the machine as far as it has its sensors.
            settings: what `as_recorded` made of the table.
            progress: called with the samples done and to do, now and then.

        Raises:
            ValueError: it cannot be judged; the message states why.
            AssemblyError: the detector cannot be made.
        """
        raise NotImplementedError


class RecordedLive(RecordedDetector[SettingsT]):
    """What live detectors state of a recording, condensed, without a verdict.

    Args:
        machine: see `RecordedDetector`.
        given: as above.
        options: as above.
        build: `DetectorPlugin.build`.
    """

    def __init__(
        self,
        machine: MachineFile,
        settings: SettingsT,
        options: RecordingOptions,
        build: Callable[[MachineFile, SettingsT, Path | None], Iterable[Detector]],
    ) -> None:
        super().__init__(machine, settings, options)
        self._build = build

    def evaluate(self, recorded: Recorded, settings: SettingsT, progress: Progress | None) -> Evaluated:
        """See `RecordedDetector.evaluate`."""
        del progress
        detectors = self._build(recorded.machine, settings, None)
        return Evaluated(tuple(s for detector in detectors for s in statements_of(detector, recorded)))


def _texts(value: object) -> Iterator[str]:
    """Every text in a table."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)


def known(figure: float) -> float | None:
    """A figure of a machine file; None if it is left to the recording (`RecordingOptions.in_memory`)."""
    return None if math.isnan(figure) else figure


class StatementStepJson(TypedDict):
    """A statement of a detector that differs from the one before.

    Attributes:
        sample: samples before the end of its window.
        seconds: time before the end of its window, in s.
        revolution: revolutions before the end of its window; null if they are not known.
        onset_sample: samples before the begin of its window.
        decision: what the detector decided.
        severity: how bad that is.
        quality: whether the samples and sensors are good, samples are missing, or a sensor is not OK.
    """

    sample: int
    seconds: float
    revolution: float | None
    onset_sample: int
    decision: str
    severity: str
    quality: str


class StatementsJson(TypedDict):
    """All statements of one detector, condensed; of one without a statement some keys are absent.

    Attributes:
        decision: what the detector decided last; null if it gave no statement.
        severity: how bad that is.
        group: modes that the evidence cannot tell apart from the decision.
        probabilities: of the modes.
        evidence: of the modes, in nats.
        statistics: figures of the detector, by name.
        units: unit of each of these that has one.
        thresholds: where a figure becomes a decision.
        quality: whether the samples and sensors were good at the end.
        reason: why not; empty if they were.
        sensors: names of the sensors that the last statement rests on.
        worst: the first of the most severe statements that rest on good data; null without any.
        history: the statements that differ from the one before.
    """

    decision: str | None
    severity: NotRequired[str]
    group: NotRequired[list[str]]
    probabilities: NotRequired[dict[str, float | None]]
    evidence: NotRequired[dict[str, float | None]]
    statistics: NotRequired[dict[str, float | None]]
    units: NotRequired[dict[str, str]]
    thresholds: NotRequired[dict[str, float | None]]
    quality: str
    reason: str
    sensors: NotRequired[list[str]]
    worst: StatementStepJson | None
    history: list[StatementStepJson]


@dataclass(frozen=True, slots=True)
class Statements:
    """All that a detector stated.

    Attributes:
        detector: its name.
        diagnoses: in order.
        rate_hz: sampling rate of the recording.
    """

    detector: str
    diagnoses: tuple[Diagnosis, ...]
    rate_hz: float

    @property
    def last(self) -> Diagnosis | None:
        """The last statement; None if there is none."""
        return self.diagnoses[-1] if self.diagnoses else None

    @property
    def worst(self) -> Diagnosis | None:
        """The first of its most severe statements that rest on good data; None without any."""
        sound = [one for one in self.diagnoses if one.quality == "good"]
        return max(sound, key=lambda one: _SEVERITIES.index(one.severity), default=None)

    def changes(self) -> Iterator[Diagnosis]:
        """The statements that differ from the one before."""
        before: tuple[str, str, str] | None = None
        for diagnosis in self.diagnoses:
            now = (diagnosis.decision, diagnosis.severity, diagnosis.quality)
            if now != before:
                yield diagnosis
            before = now

    def as_json(self) -> StatementsJson:
        """For the output."""
        last = self.last
        if last is None:
            return {
                "decision": None,
                "quality": "missing",
                "reason": "it gave no statement",
                "worst": None,
                "history": [],
            }
        worst = self.worst
        document: StatementsJson = {
            "decision": last.decision,
            "severity": last.severity,
            "group": list(last.group),
            "probabilities": dict(last.probabilities),
            "evidence": dict(last.evidence),
            "statistics": dict(last.statistics),
            "units": dict(last.units),
            "thresholds": dict(last.thresholds),
            "quality": last.quality,
            "reason": last.reason,
            "sensors": list(last.sensors),
            "worst": None if worst is None else self._step(worst),
            "history": [self._step(change) for change in self.changes()],
        }
        return finite(document)

    def describe(self) -> str:
        """One line for a person."""
        last = self.last
        if last is None:
            return f"{self.detector}: the recording is too short for it"
        doubt = f" (data {last.quality}: {last.reason})" if last.quality != "good" else ""
        figures = ", ".join(
            f"{name} {with_unit(value, last.units.get(name, ''))}"
            for name, value in last.statistics.items()
            if not name.startswith("paper.")
        )
        worst = self.worst
        before = ""
        if worst is not None and worst.severity != last.severity:
            before = f", {worst.severity} at {worst.first_index / self.rate_hz:.3f} s"
        return one_line(f"{self.detector}: {last.decision} ({last.severity}{before}){doubt}; {figures}")

    def _step(self, diagnosis: Diagnosis) -> StatementStepJson:
        return {
            "sample": diagnosis.end_index,
            "seconds": diagnosis.end_index / self.rate_hz,
            "revolution": diagnosis.revolutions,
            "onset_sample": diagnosis.first_index,
            "decision": diagnosis.decision,
            "severity": diagnosis.severity,
            "quality": diagnosis.quality,
        }


def statements_of(detector: Detector, recorded: Recorded) -> tuple[Statements, ...]:
    """What a new detector states about a recording, apart by whom it is about.

    Args:
        detector: of ``recorded.machine``.
        recorded: the recording.
    """
    rate_hz = recorded.recording.rate_hz
    return by_name(detector.name, listen(detector, recorded.blocks_of(detector.stream), rate_hz), rate_hz)


def by_name(detector: str, diagnoses: Iterable[Diagnosis], rate_hz: float) -> tuple[Statements, ...]:
    """What a detector stated, by whom it is about: a level detector is about each of its sensors.

    Args:
        detector: its name.
        diagnoses: in order.
        rate_hz: sampling rate of the recording.
    """
    by: dict[str, list[Diagnosis]] = {}
    for diagnosis in diagnoses:
        by.setdefault(diagnosis.detector, []).append(diagnosis)
    return tuple(
        Statements(name, tuple(of_name), rate_hz) for name, of_name in (by or {detector: []}).items()
    )


def worst(statements: Iterable[Statements]) -> str:
    """The most severe of what several detectors stated, in words; empty if all is normal."""
    candidates = [(one.detector, one.worst, one.rate_hz) for one in statements if one.worst is not None]
    alarmed = [one for one in candidates if one[1].severity != "normal"]
    if not alarmed:
        return ""
    name, diagnosis, rate_hz = max(alarmed, key=lambda one: _SEVERITIES.index(one[1].severity))
    return f"{name}, {diagnosis.severity} from {diagnosis.first_index / rate_hz:.3f} s on"


def listen(
    detector: Detector, samples: Floats | Blocks, rate_hz: float, blocks: int = _BLOCKS
) -> Iterator[Diagnosis]:
    """Have a detector process a recording.

    Args:
        detector: a new one.
        samples: float64 ``[n, channels]`` in the units and columns of its stream; NaN where missing.
        rate_hz: sampling rate.
        blocks: how many blocks are handed over at a time.

    Yields:
        What it states.
    """
    period_ns = NS_PER_S / rate_hz
    length = detector.block * max(1, min(blocks, _MOST_ROWS // detector.block))
    for begin in range(0, len(samples), length):
        part = samples[begin : begin + length].astype(np.float32)
        whole = len(part) // detector.block * detector.block
        if whole:
            end_ns = round((begin + whole - 1) * period_ns)
            yield from window_statements(detector, Window(begin, part[:whole], end_ns, period_ns))


def finite(document: FiniteT) -> FiniteT:
    """The same with every NaN and infinity as None, and NumPy's numbers as Python's."""
    cleaned: FiniteT = _finite(document)
    return cleaned


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def shortened(name: str) -> str:
    """A file's name as a title has room for it."""
    return (
        name
        if len(name) <= _LONGEST_NAME
        else f"{name[: _LONGEST_NAME // 2]}...{name[-_LONGEST_NAME // 2 :]}"
    )
