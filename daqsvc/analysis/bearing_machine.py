"""Recordings of a machine whose file names its bearings: judged by the detector that watches them live."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.analysis.bearing_checks import accelerometer_quality, with_offsets
from daqsvc.analysis.bearing_result import BearingAnalysis
from daqsvc.analysis.bearing_setup import BearingSetup
from daqsvc.analysis.quality import DataQuality
from daqsvc.analysis.statements import Statements
from daqsvc.bearing.identify_change import ChangeRules
from daqsvc.bearing.identify_file import load_bearing_baseline
from daqsvc.detectors.bearing.build import bearing_detector, orders_of
from daqsvc.detectors.bearing.finding import BearingFinding
from daqsvc.detectors.bearing.persistence import UNDETERMINED
from daqsvc.detectors.bearing.settings import Bearing
from daqsvc.diagnosis.detector import Window

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.analysis.acceleration import AccelerationUnit
    from daqsvc.bearing.race.verdict import RaceWord
    from daqsvc.detectors.bearing.detector import BearingDetector
    from daqsvc.detectors.bearing.evaluation import Evaluation
    from daqsvc.detectors.bearing.persistence import ConfirmedState
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.recording.recording import Recording
    from daqsvc.settings.models import MachineFile

    Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MachineBearings:
    """What the detector makes of a recording.

    Attributes:
        analysis: the verdict.
        statements: all that it said.
    """

    analysis: BearingAnalysis
    statements: Statements


def present(given: Bearing | None, sensors: tuple[str, ...]) -> Bearing | None:
    """The bearings whose accelerometers a recording has; None if there is none.

    Args:
        given: the bearings of the machine file.
        sensors: names of the sensors that the recording has.
    """
    if given is None:
        return None
    bearings = tuple(
        bearing
        if bearing.rotor_sensor is None or bearing.rotor_sensor in sensors
        else bearing.model_copy(update={"rotor_sensor": None, "model": None})
        for bearing in given.bearings
        if bearing.sensor in sensors
    )
    keyphasor = given.keyphasor if given.keyphasor in sensors else None
    return given.model_copy(update={"bearings": bearings, "keyphasor": keyphasor}) if bearings else None


def check_bearings(machine: MachineFile, calibration: Path | None) -> None:
    """See whether the bearings of a machine file are known, and its calibration can be read.

    Args:
        machine: the machine file with ``[pipeline.bearing]``.
        calibration: file with the healthy machine, in place of what the machine file names.

    Raises:
        ValueError: they are not, or it cannot.
    """
    given = machine.pipeline.table(Bearing)
    assert given is not None  # noqa: S101 - the caller has looked
    for index, bearing in enumerate(given.bearings):
        orders_of(bearing, index)
    if calibration is None and given.calibration is not None:
        calibration = machine.resolve(given.calibration)
    if calibration is not None:
        load_bearing_baseline(calibration)


def analyse_machine_bearings(
    machine: MachineFile,
    recording: Recording,
    samples: Floats,
    calibration: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> MachineBearings:
    """Have the live detector watch a recording from its first sample to its last.

    Args:
        machine: the machine file with ``[pipeline.bearing]``, as far as the recording has its sensors, and
            with its rate.
        recording: the recording.
        samples: float64 ``[n, channels]``, its samples as the stream of the bearings has them.
        calibration: file with the healthy machine, in place of what the machine file names.
        progress: told the samples done and to do.

    Raises:
        ValueError: a bearing is not known, or the calibration cannot be used.
    """
    given = machine.pipeline.table(Bearing)
    assert given is not None  # noqa: S101 - the caller has looked
    detector = bearing_detector(machine, given, None, calibration)
    said: list[Diagnosis] = []
    looks: list[Evaluation] = []
    for statements in _watch(detector, samples, recording.rate_hz, progress):
        said += statements
        if detector.seen is not None and (not looks or detector.seen is not looks[-1]):
            looks.append(detector.seen)
    everything = Statements(detector.name, tuple(said), recording.rate_hz)
    return MachineBearings(_analysis(machine, recording, detector, said, looks), everything)


def _watch(
    detector: BearingDetector,
    samples: Floats,
    rate_hz: float,
    progress: Callable[[int, int], None] | None,
) -> Iterator[Sequence[Diagnosis]]:
    """Have the detector see a recording block by block, so that no look is missed; what it says each time."""
    period_ns = NS_PER_S / rate_hz
    whole = len(samples) // detector.block * detector.block
    for begin in range(0, whole, detector.block):
        end = begin + detector.block
        window = Window(begin, samples[begin:end].astype(np.float32), round((end - 1) * period_ns), period_ns)
        yield detector.process(window)
        if progress is not None:
            progress(end, len(samples))
    last = detector.finish(samples[whole:].astype(np.float32), round((len(samples) - 1) * period_ns))
    if last is not None:
        yield [last]


def _analysis(
    machine: MachineFile,
    recording: Recording,
    detector: BearingDetector,
    said: list[Diagnosis],
    looks: list[Evaluation],
) -> BearingAnalysis:
    """What the detector stands by at the end, with the figures of the look that shows it most."""
    setup = _setup(machine)
    columns = [recording.names.index(bearing.sensor) for bearing in detector.bearings]
    quality = accelerometer_quality(setup.channels, recording.samples[:, columns], setup.unit)
    good = [one for one in said if one.quality == "good"]
    poor = [one for one in said if one.quality != "good"]
    for reason in dict.fromkeys(one.reason for one in poor):
        quality = quality.with_problem(reason)
    analysis = BearingAnalysis(
        recording=str(recording.source),
        baseline=None if detector.baseline is None else detector.baseline.source or None,
        setup=setup,
        quality=quality,
    )
    standing = detector.standing
    look = _decisive(looks, standing)
    if len(poor) > len(good):
        return replace(analysis, refused=poor[-1].reason)
    if look is None or look.finding is None or standing.decision == UNDETERMINED:
        return replace(
            analysis,
            refused=f"the recording is too short: {len(recording.samples) / recording.rate_hz:.3g} s are not "
            "enough for two looks that agree; give 10 s or more",
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
    return replace(
        analysis,
        finding=BearingFinding(
            verdict=finding.verdict,
            group=finding.group,
            where=where,
            probabilities=finding.probabilities,
            severity=finding.severity,
        ),
        quality=with_offsets(quality, look.races),
        races=look.races,
        healthy=healthy,
        change=look.change,
    )


def _decisive(looks: list[Evaluation], standing: ConfirmedState) -> Evaluation | None:
    """The look that a standing verdict rests on: the strongest that found the same, or else the last."""
    same = [
        look
        for look in looks
        if look.finding is not None
        and (look.finding.verdict, look.finding.where) == (standing.decision, standing.where)
    ]
    if not same:
        return looks[-1] if looks else None
    if standing.decision == "changed":
        return max(same, key=lambda look: 0.0 if look.change is None else look.change.departure)
    return max(same, key=lambda look: 0.0 if look.finding is None else look.finding.severity)


def bearings_not_judged(machine: MachineFile, recording: str, why: str) -> BearingAnalysis:
    """The verdict about a recording that cannot be judged.

    Args:
        machine: the machine file with ``[pipeline.bearing]``.
        recording: its path.
        why: it cannot.
    """
    return BearingAnalysis(
        recording=recording, baseline=None, setup=_setup(machine), quality=DataQuality(0), refused=why
    )


def _setup(machine: MachineFile) -> BearingSetup:
    """What the machine file says, in the words of an analysis; its channels are the bearings."""
    given = machine.pipeline.table(Bearing)
    assert given is not None  # noqa: S101 - the caller has looked
    unit = machine.sensor(given.bearings[0].sensor).unit
    return BearingSetup(
        channels=tuple(bearing.name for bearing in given.bearings),
        speed_rpm=abs(machine.machine.speed_rpm),
        bearings={bearing.name: orders_of(bearing, i) for i, bearing in enumerate(given.bearings)},
        designations={bearing.name: bearing.type for bearing in given.bearings if bearing.type is not None},
        unit=cast("AccelerationUnit", unit),
        change=ChangeRules(
            false_alarm_probability=given.false_alarm_probability, repeatability_db=given.repeatability_db
        ),
    )
