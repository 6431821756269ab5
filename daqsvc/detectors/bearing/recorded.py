"""From a recording of accelerometers to a verdict about the bearings of a machine.

With a machine file the live detector watches the recording from its first sample to its last. What options
name is judged at once (`analyse_bearings`), by the tests inside the detector, unless it is too long for
that: then it is watched, too.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.bearing.baseline import load_bearing_baseline
from daqsvc.bearing.identify import ChangeRules, NotIdentifiableError, compare_residual
from daqsvc.bearing.race.judge import race_test
from daqsvc.detectors.bearing.build import bearing_detector, healthy_machine
from daqsvc.detectors.bearing.calibrating import HealthyRun
from daqsvc.detectors.bearing.finding import UNDETERMINED, BearingFinding, find
from daqsvc.detectors.bearing.kinematics import orders_of
from daqsvc.detectors.bearing.recorded_checks import (
    ball_order_problem,
    meant_in_hz,
    stated_speed_problem,
    with_offsets,
    with_repairs,
    with_speed,
)
from daqsvc.detectors.bearing.settings import Bearing
from daqsvc.detectors.bearing.verdict import BearingSetup, BearingVerdict
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.recorded import Evaluated, RecordedDetector, Statements
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.clipped import ClippedError, refuse_clipped
from daqsvc.dsp.quality.recorded import DataQuality
from daqsvc.dsp.quality.unit import accelerometer_quality, refuse_no_machine, unit_problems
from daqsvc.errors.recordings import UNFIT_SAMPLES
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import load_matching

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.baseline import BearingBaseline
    from daqsvc.bearing.identify import HealthyResidual, ResidualChange
    from daqsvc.bearing.race.verdict import RaceVerdict, RaceWord
    from daqsvc.detectors.bearing.detector import BearingDetector
    from daqsvc.detectors.bearing.evaluation import Evaluation
    from daqsvc.detectors.bearing.finding import ConfirmedState
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.diagnosis.recorded import Blocks, Progress, Recorded, RecordingOptions
    from daqsvc.dsp.quality.unit import AccelerationUnit
    from daqsvc.errors.code import Code
    from daqsvc.recording.recording import Recording
    from daqsvc.settings.models import MachineFile

    Floats = NDArray[np.float64]
    Judge = Callable[[BearingBaseline | None], BearingVerdict]
    """Judges one recording against a healthy machine, or by itself."""

MOST_AT_ONCE = 1 << 22
"""Samples of all channels that are judged at one go; that takes some 55 bytes for each."""


class RecordedBearings(RecordedDetector[Bearing]):
    """The bearings of a machine in recordings; see `RecordedDetector`.

    Raises:
        ValueError: a bearing is not known, or what they are compared with cannot be used.
    """

    part = "bearing"
    takes_fewer = True

    def __init__(self, machine: MachineFile, settings: Bearing, options: RecordingOptions) -> None:
        super().__init__(machine, settings, options)
        self._setup = setup_of(machine, settings)
        calibration = options.calibration
        if calibration is None and settings.calibration is not None:
            calibration = machine.resolve(settings.calibration)
        if calibration is not None:
            load_bearing_baseline(calibration)
        self._healthy = None if options.healthy is None else self._load_healthy(options.healthy)

    def _load_healthy(self, path: str) -> HealthyRun:
        options = self.options
        names = {**options.channels, **options.healthy_channels}
        rate_hz = options.rate_hz if options.healthy_rate_hz is None else options.healthy_rate_hz
        try:
            wanted = {name: names.get(name, name) for name in self._setup.channels}
            healthy = HealthyRun(self._setup, load_matching(path, wanted, rate_hz))
            healthy.at(healthy.recording.rate_hz)
        except (RecordingError, NotIdentifiableError) as error:
            raise ValueError(f"healthy run {path}: {error}") from error
        return healthy

    @property
    def sensors(self) -> tuple[str, ...]:
        """See `RecordedDetector.sensors`."""
        return self.settings.sensors

    def as_recorded(self, sensors: Container[str]) -> Bearing | None:
        """The bearings whose accelerometers a recording has; None if there is none."""
        settings = self.settings
        bearings = tuple(
            bearing
            if bearing.rotor_sensor is None or bearing.rotor_sensor in sensors
            else bearing.model_copy(update={"rotor_sensor": None, "model": None})
            for bearing in settings.bearings
            if bearing.sensor in sensors
        )
        keyphasor = settings.keyphasor if settings.keyphasor in sensors else None
        return (
            settings.model_copy(update={"bearings": bearings, "keyphasor": keyphasor}) if bearings else None
        )

    def left_out(self, sensors: Container[str]) -> str:
        """See `RecordedDetector.left_out`."""
        missing = [bearing for bearing in self.settings.bearings if bearing.sensor not in sensors]
        if not missing:
            return ""
        bearings, accelerometers = (
            ", ".join(texts) for texts in zip(*((b.name, b.sensor) for b in missing), strict=True)
        )
        why = f"the recording has no channel for {accelerometers} of {self.machine.path}"
        return f"{bearings}: not judged, as {why}"

    def not_judged(self, recording: str, why: str) -> BearingVerdict:
        """See `RecordedDetector.not_judged`."""
        return BearingVerdict(
            recording=recording,
            baseline=None if self._healthy is None else str(self._healthy.recording.source),
            setup=self._setup,
            quality=DataQuality(0),
            refused=why,
        )

    def evaluate(self, recorded: Recorded, settings: Bearing, progress: Progress | None) -> Evaluated:
        """See `RecordedDetector.evaluate`."""
        del progress  # a recording takes a tenth of a second
        statements: tuple[Statements, ...] = ()
        setup = setup_of(recorded.machine, settings)
        if self.options.in_memory:
            recording = recorded.recording
            if recording.samples.size <= MOST_AT_ONCE:
                judge = partial(analyse_bearings, recording, setup)
            else:
                judge = partial(_watched_against, recorded, settings, setup)
            verdict = self._judged(recorded, settings, setup, judge)
        else:
            detector = bearing_detector(recorded.machine, settings, None, self.options.calibration)
            diagnoses, looks = _watched(detector, recorded)
            statements = (Statements(detector.name, tuple(diagnoses), recorded.recording.rate_hz),)
            verdict = _concluded(setup, recorded.recording, detector, diagnoses, looks)
        draw = partial(_draw, verdict) if verdict.races else None
        return Evaluated(statements=statements, verdict=verdict, draw=draw)

    def _judged(
        self, recorded: Recorded, settings: Bearing, setup: BearingSetup, judge: Judge
    ) -> BearingVerdict:
        """Judge a recording against the healthy machine, if options name one."""
        path = self.options.calibration
        if path is None:
            return _against(recorded.recording.rate_hz, judge, self._healthy)
        baseline = healthy_machine(recorded.machine, settings, path)
        if len(setup.channels) > 1 and setup.channels not in baseline.residuals:
            lacking = f"nothing of {' and '.join(setup.channels)} together"
            raise ValueError(f"{path}: holds {lacking}; calibrate with --channels {','.join(setup.channels)}")
        return judge(baseline)


def setup_of(machine: MachineFile, settings: Bearing) -> BearingSetup:
    """What the bearings of a machine are judged by, in the words of an analysis.

    Raises:
        ValueError: a bearing is not known.
    """
    unit = machine.sensor(settings.bearings[0].sensor).unit
    return BearingSetup(
        channels=tuple(bearing.name for bearing in settings.bearings),
        speed_rpm=abs(machine.machine.speed_rpm),
        bearings={bearing.name: orders_of(bearing, i) for i, bearing in enumerate(settings.bearings)},
        designations={
            bearing.name: bearing.type for bearing in settings.bearings if bearing.type is not None
        },
        unit=cast("AccelerationUnit", unit),
        change=ChangeRules(
            false_alarm_probability=settings.false_alarm_probability,
            repeatability_db=settings.repeatability_db,
        ),
    )


def _draw(verdict: BearingVerdict, prefix: str) -> None:
    from daqsvc.detectors.bearing.plots import draw_envelopes  # noqa: PLC0415 - brings matplotlib

    draw_envelopes(verdict, prefix)


def _watched_against(
    recorded: Recorded, settings: Bearing, setup: BearingSetup, baseline: BearingBaseline | None = None
) -> BearingVerdict:
    """What the live detector states about a recording whose healthy machine, if any, is known."""
    detector = bearing_detector(recorded.machine, settings, None, healthy=baseline)
    diagnoses, looks = _watched(detector, recorded)
    return _concluded(setup, recorded.recording, detector, diagnoses, looks)


def _watched(detector: BearingDetector, recorded: Recorded) -> tuple[list[Diagnosis], _Looks]:
    """Have the detector see a recording block by block, so that none is missed: statements, evaluations."""
    diagnoses: list[Diagnosis] = []
    looks = _Looks()
    for statements in _watch(detector, recorded.blocks_of(detector.stream), recorded.recording.rate_hz):
        diagnoses += statements
        if detector.seen is not None and detector.seen is not looks.last:
            looks.add(detector.seen)
    return diagnoses, looks


class _Looks:
    """The evaluations of a recording that a verdict may rest on: the strongest of each finding, and the last.

    Attributes:
        last: None before the first.
    """

    def __init__(self) -> None:
        self.last: Evaluation | None = None
        self._severe: dict[tuple[str, str], Evaluation] = {}
        self._departed: dict[tuple[str, str], Evaluation] = {}

    def add(self, look: Evaluation) -> None:
        """Take in the next one."""
        self.last = look
        if look.finding is None:
            return
        key = look.finding.verdict, look.finding.where
        for strongest, size in ((self._severe, _severity), (self._departed, _departure)):
            before = strongest.get(key)
            if before is None or size(look) > size(before):
                strongest[key] = look

    def decisive(self, standing: ConfirmedState) -> Evaluation | None:
        """The strongest that found what stands, or else the last."""
        strongest = self._departed if standing.decision == "changed" else self._severe
        return strongest.get((standing.decision, standing.where), self.last)


def _severity(look: Evaluation) -> float:
    return 0.0 if look.finding is None else look.finding.severity


def _departure(look: Evaluation) -> float:
    return 0.0 if look.change is None else look.change.departure


def _watch(detector: BearingDetector, samples: Blocks, rate_hz: float) -> Iterator[Sequence[Diagnosis]]:
    period_ns = NS_PER_S / rate_hz
    whole = len(samples) // detector.block * detector.block
    for begin in range(0, whole, detector.block):
        end = begin + detector.block
        yield detector.process(
            Window(begin, samples[begin:end].astype(np.float32), round((end - 1) * period_ns), period_ns)
        )
    last = detector.finish(samples[whole:].astype(np.float32), round((len(samples) - 1) * period_ns))
    if last is not None:
        yield [last]


def _concluded(
    setup: BearingSetup,
    recording: Recording,
    detector: BearingDetector,
    diagnoses: list[Diagnosis],
    looks: _Looks,
) -> BearingVerdict:
    """The confirmed state at the end, with the figures of the evaluation that shows it most."""
    columns = [recording.names.index(bearing.sensor) for bearing in detector.bearings]
    in_turn = columns == list(range(columns[0], columns[0] + len(columns)))
    chosen = slice(columns[0], columns[0] + len(columns)) if in_turn else columns  # the former copies nothing
    quality = accelerometer_quality(setup.channels, recording.samples[:, chosen], setup.unit)
    good = [one for one in diagnoses if one.quality == "good"]
    poor = [one for one in diagnoses if one.quality != "good"]
    for reason in dict.fromkeys(one.reason for one in poor):
        quality = quality.with_problem(reason)
    analysis = BearingVerdict(
        recording=str(recording.source),
        baseline=None if detector.baseline is None else detector.baseline.source or None,
        setup=setup,
        quality=quality,
    )
    standing = detector.standing
    look = looks.decisive(standing)
    if len(poor) > len(good):
        return replace(analysis, refused=poor[-1].reason)
    if look is None or look.finding is None or standing.decision == UNDETERMINED:
        return replace(
            analysis,
            refused=f"the recording is too short: {len(recording.samples) / recording.rate_hz:.3g} s are not "
            "enough for two evaluations that agree; give 10 s or more",
        )
    where = standing.where if standing.where in look.races else look.finding.where
    finding = look.finding
    if standing.decision != finding.verdict:
        word = cast("RaceWord", standing.decision)
        finding = replace(finding, verdict=word, group=standing.group or (word,), where=where)
    change_at = max(look.changes, key=lambda name: look.changes[name].departure, default=None)
    healthy = None
    if detector.baseline is not None and change_at is not None:
        sensors = next(bearing.sensors for bearing in detector.bearings if bearing.name == change_at)
        healthy = detector.baseline.residuals[sensors]
    quality = with_offsets(quality, look.races)
    if detector.keyphasor is None:
        quality = with_speed(quality, look.races, setup.speed_rpm)
    return replace(
        analysis,
        finding=BearingFinding(
            verdict=finding.verdict,
            group=finding.group,
            where=where,
            probabilities=finding.probabilities,
            severity=finding.severity,
        ),
        quality=quality,
        races=look.races,
        healthy=healthy,
        change=look.change,
    )


def _against(rate_hz: float, judge: Judge, healthy: HealthyRun | None) -> BearingVerdict:
    """Judge against the healthy run, unless that is none: it must not hide anything."""
    if healthy is None:
        return judge(None)
    source = healthy.recording.source
    damage, doubt = healthy.against
    if damage:
        return judge(None).with_problem(
            f"the healthy run {source} is not used: {damage}; give one of the machine in good order"
        )
    try:
        baseline = healthy.at(rate_hz)
    except NotIdentifiableError as error:
        alone = judge(None)
        return alone.with_problem(f"the healthy run {source} is not used: {error}")
    analysis = judge(baseline)
    if not doubt:
        return analysis
    if analysis.leading is not None and analysis.leading.speed_seen:
        return judge(None).with_problem(
            f"the healthy run {source} is not used: {doubt}, as those of the recording do; correct "
            "--baseline-fs, or give one at this speed"
        )
    return analysis.with_problem(
        f"the healthy run {source}: {doubt}; check whether its rate and speed are right"
    )


def analyse_bearings(
    recording: Recording, setup: BearingSetup, baseline: BearingBaseline | None = None
) -> BearingVerdict:
    """State which bearing of a machine is damaged, and where.

    Args:
        recording: to be judged.
        setup: what is known.
        baseline: the healthy machine at the recording's rate, learnt by the same setup.
    """
    quality = _quality(recording, setup)
    source = None if baseline is None else baseline.source
    races: dict[str, RaceVerdict] = {}
    unfit: dict[str, str] = {}
    for name in recording.names:
        column = _finite(recording.samples[:, recording.names.index(name)])
        before = None if baseline is None else baseline.races[name]
        try:
            refuse_clipped(column)
            race = race_test(
                column, recording.rate_hz, setup.speed_rpm, setup.bearings[name], setup.race, before
            )
            seen = race.speed_seen or race.verdict != "normal"
            refuse_no_machine(column, setup.unit, seen=seen)
        except ClippedError as error:
            unfit[name] = str(error)
            quality = replace(quality, clipped={**quality.clipped, name: error.samples})
        except UnfitError as error:
            unfit[name] = str(error)
        else:
            races[name] = race

    def refuse(why: str, code: Code | None = None) -> BearingVerdict:
        return BearingVerdict(
            recording=str(recording.source),
            baseline=source,
            setup=setup,
            quality=quality,
            refused=why,
            code=code,
            unfit=unfit,
        )

    if not any(race.speed_seen for race in races.values()) and (wrong := meant_in_hz(recording, setup)):
        return refuse(wrong)
    if not races:
        return refuse("; ".join(f"{name}: {why}" for name, why in unfit.items()), UNFIT_SAMPLES)
    healthy = None if baseline is None else baseline.residuals[tuple(races)]
    change: ResidualChange | None = None
    if healthy is not None:
        try:
            change = _change(healthy, _finite(recording.samples), recording, setup, tuple(races))
        except ValueError as error:
            return refuse(str(error))
    return BearingVerdict(
        recording=str(recording.source),
        baseline=source,
        setup=setup,
        quality=with_speed(with_repairs(quality, races), races, setup.speed_rpm),
        finding=find(races, change, setup.change.false_alarm_probability),
        races=races,
        unfit=unfit,
        healthy=healthy,
        change=change,
    )


def _finite(samples: Floats) -> Floats:
    """Samples as float64, NaN where they are not finite."""
    return np.where(np.isfinite(samples), samples, np.nan).astype(np.float64, copy=False)


def _quality(recording: Recording, setup: BearingSetup) -> DataQuality:
    """What is known against a recording before it is judged."""
    quality = accelerometer_quality(recording.names, recording.samples, setup.unit)
    quality = replace(quality, problems=(*recording.notes, *quality.problems))
    orders = dict.fromkeys(ball_order_problem(setup.bearings[name]) for name in recording.names)
    speed = stated_speed_problem(recording, setup.speed_rpm)
    for problem in (speed, *unit_problems(recording.names, recording.samples, setup.unit), *orders):
        quality = quality.with_problem(problem) if problem else quality
    return quality


def _change(
    healthy: HealthyResidual,
    samples: Floats,
    recording: Recording,
    setup: BearingSetup,
    names: tuple[str, ...],
) -> ResidualChange:
    """How the innovations of the channels differ from the healthy machine's.

    Raises:
        ValueError: they cannot be compared, or what differs is no matter of the machine.
    """
    columns = samples[:, [recording.names.index(name) for name in names]]
    change = compare_residual(healthy, healthy.levels_db(columns), setup.change)
    if change.quiet:
        raise ValueError(
            f"{', '.join(names)}: {-change.rise_db[0]:.1f} dB quieter than in the healthy run: the machine "
            "stands still, a sensor is loose, or the unit differs; give recordings at one speed and unit"
        )
    if change.gain:
        raise ValueError(
            f"{', '.join(names)}: {change.rise_db[0]:.1f} dB louder than in the healthy run in all bands "
            f"alike (a factor of {change.ratio:.3g}): gain or unit differs; give both in one unit"
        )
    return change
