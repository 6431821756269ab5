"""From a recording of two proximity probes and what is known about the rotor to a verdict.

`analyse` is a pure function: it reads nothing but its arguments and keeps nothing. The detector inside is
the one that watches the machine live.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, cast

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.detectors.rotor_synchronous.build import healthy_rotor
from daqsvc.detectors.rotor_synchronous.detector import RotorSynchronousDetector
from daqsvc.detectors.rotor_synchronous.recorded_speed import (
    LEAST_JUDGED,
    KeyphasorChannel,
    RotorSetup,
    refuse_coarse,
    speed_of,
    too_short,
)
from daqsvc.detectors.rotor_synchronous.revolutions import RevolutionStream
from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous
from daqsvc.detectors.shaft.verdict import Instant, ModeStep, RotorAlarm, RotorVerdict, Trace
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.recorded import Evaluated, RecordedDetector, known
from daqsvc.dsp.probes import Probe
from daqsvc.dsp.quality import RefusedError
from daqsvc.dsp.quality import recorded as checks
from daqsvc.dsp.quality.recorded import ClippedProbeError, Complaint, DataQuality
from daqsvc.dsp.quality.unit import doubt_size, refuse_size, to_um
from daqsvc.rotor.calibration.file import baseline_at
from daqsvc.rotor.synchronous.baseline import Calibration, begun_at, compensated
from daqsvc.rotor.synchronous.departure import threshold_for
from daqsvc.rotor.synchronous.severity import levels
from daqsvc.rotor.synchronous.signatures import likelihoods
from daqsvc.rotor.synchronous.vectors import SynchronousVectors
from daqsvc.rotor.synchronous.watch import WatchRules

if TYPE_CHECKING:
    from collections.abc import Container, Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.diagnosis.recorded import Progress, Recorded, RecordingOptions
    from daqsvc.dsp.quality.unit import LengthUnit
    from daqsvc.recording.recording import Recording
    from daqsvc.rotor.synchronous.signatures import Identification, RotorFault
    from daqsvc.rotor.synchronous.watch import WatchReport
    from daqsvc.settings.models import Keyphasor, MachineFile, ProximityProbe

    Floats = NDArray[np.float64]

_WINDOW_REVOLUTIONS = 256
"""Revolutions handed to the detector at a time: often enough to see its progress."""
_NO_MEAN = (
    "no mean position: AC-coupled probes? Static load and half of the evidence for stiffness loss cannot be "
    "seen"
)
_MOST_REFERENCE = 2000
"""Revolutions that the baseline grows to (`daqsvc.rotor.synchronous.departure`)."""
_SEEN = 128
"""Revolutions that show what a healthy machine looks like at the end."""


class RecordedRotor(RecordedDetector[RotorSynchronous]):
    """The calibrated rotor in recordings; see `RecordedDetector`.

    Attributes:
        setup: what is known of it.

    Raises:
        ValueError: its figures contradict each other, or its calibration cannot be used.
    """

    part = "rotor"

    def __init__(self, machine: MachineFile, settings: RotorSynchronous, options: RecordingOptions) -> None:
        super().__init__(machine, settings, options)
        self.setup = _setup(machine, settings, options)

    @property
    def sensors(self) -> tuple[str, ...]:
        """See `RecordedDetector.sensors`."""
        return self.settings.sensors

    def as_recorded(self, sensors: Container[str]) -> RotorSynchronous:
        """See `RecordedDetector.as_recorded`: without one of its sensors a recording is refused."""
        del sensors
        return self.settings

    def not_judged(self, recording: str, why: str) -> RotorVerdict:
        """See `RecordedDetector.not_judged`."""
        rate = self.setup.rules.false_alarms_per_1000_rev
        verdict = RotorVerdict.not_judged(recording, why)
        if not self.options.in_memory:
            return verdict
        return replace(verdict, false_alarms_per_1000_rev=rate, threshold_nats=threshold_for(rate))

    def evaluate(
        self, recorded: Recorded, settings: RotorSynchronous, progress: Progress | None
    ) -> Evaluated:
        """See `RecordedDetector.evaluate`."""
        del settings
        setup = replace(self.setup, ac_coupled=recorded.machine.ac_coupled)
        verdict = analyse(recorded.recording, setup, progress)
        draw = None if verdict.trace is None else partial(_draw, recorded.recording, setup, verdict)
        return Evaluated(verdict=verdict, draw=draw)


def _draw(recording: Recording, setup: RotorSetup, verdict: RotorVerdict, prefix: str) -> None:
    from daqsvc.detectors.rotor_synchronous.plots import draw  # noqa: PLC0415 - brings matplotlib

    draw(recording, setup, verdict, prefix)


def _setup(machine: MachineFile, settings: RotorSynchronous, options: RecordingOptions) -> RotorSetup:
    """The calibrated rotor of a machine file, as `analyse` wants it.

    Raises:
        ValueError: its figures contradict each other, or its calibration cannot be used.
    """
    x, y = (cast("ProximityProbe", machine.sensor(name)) for name in settings.probes)
    keyphasor = None
    if settings.reference == "keyphasor" and settings.keyphasor is not None:
        sensor = cast("Keyphasor", machine.sensor(settings.keyphasor))
        keyphasor = KeyphasorChannel(
            sensor.name, known(sensor.threshold_v), sensor.edge, known(sensor.hysteresis_v)
        )
    rules = WatchRules(
        calibrate_revolutions=settings.calibrate_revolutions,
        false_alarms_per_1000_rev=settings.false_alarms_per_1000_rev,
        probe_drift_um=settings.probe_drift_um,
        retry=False,
    )
    threshold_for(rules.false_alarms_per_1000_rev)
    rotor, calibrations = healthy_rotor(machine, settings, options.calibration)
    return RotorSetup(
        probes=(x.name, y.name),
        probe_angles_deg=(x.angle_deg or 0.0, 90.0 if y.angle_deg is None else y.angle_deg),
        rotor=rotor,
        speed_rpm=known(machine.machine.speed_rpm),
        speed_step_rpm=options.speed_step_rpm,
        unit=cast("LengthUnit", options.unit or x.unit),
        keyphasor=keyphasor,
        follow_orbit=settings.reference == "orbit",
        rules=rules,
        calibrations=calibrations,
        ac_coupled=machine.ac_coupled,
    )


@dataclass(slots=True)
class _Watched:
    """What the detector states of every revolution that it could fit."""

    reports: list[WatchReport] = field(default_factory=list)
    vectors: list[SynchronousVectors] = field(default_factory=list)

    def add(self, report: WatchReport, vectors: SynchronousVectors) -> None:
        """The detector's listener."""
        self.reports.append(report)
        self.vectors.append(vectors)


def analyse(recording: Recording, setup: RotorSetup, progress: Progress | None = None) -> RotorVerdict:
    """Judge a recording.

    The first revolutions are the healthy machine, unless ``setup`` has a calibration.

    Args:
        recording: with the channels of ``setup.names``, by their names there.
        setup: what is known.
        progress: called with the samples done and to do, now and then.

    Returns:
        The verdict; a recording that cannot be judged has ``refused`` state why. Never raises on bad data.
    """
    quality = checks.known_against(recording)
    watched = _Watched()
    try:
        return _judge(recording, setup, quality, watched, progress)
    except RefusedError as error:
        if isinstance(error, ClippedProbeError):
            quality = error.quality
        return RotorVerdict(
            recording=str(recording.source),
            quality=quality,
            refused=str(error),
            code=error.code,
            false_alarms_per_1000_rev=setup.rules.false_alarms_per_1000_rev,
            threshold_nats=threshold_for(setup.rules.false_alarms_per_1000_rev),
            speed_rpm=setup.speed_rpm,
            revolutions=len(watched.reports),
        )


def samples_of(recording: Recording, setup: RotorSetup) -> Floats:
    """The samples float64 ``[n, channels]`` of ``setup.names``: probes in um, NaN where missing.

    Raises:
        RefusedError: a channel holds nothing, or one value only.
    """
    samples = np.where(np.isfinite(recording.samples), recording.samples, np.nan).astype(
        np.float64, copy=False
    )
    samples = samples[:, [recording.names.index(name) for name in setup.names]].astype(np.float64)
    samples[:, :2] = to_um(samples[:, :2], setup.unit)
    checks.refuse_unreadable(setup.names, samples)
    return samples


def _judge(
    recording: Recording,
    setup: RotorSetup,
    quality: DataQuality,
    watched: _Watched,
    progress: Progress | None,
) -> RotorVerdict:
    samples = samples_of(recording, setup)
    refuse_size(samples[:, :2], setup.rotor.clearance_um, setup.unit)
    speed, quality = speed_of(recording, setup, samples, quality)
    period = 60.0 * recording.rate_hz / abs(speed.rpm)
    refuse_coarse(period, recording.rate_hz)
    quality = doubt_size(quality, samples[:, :2], setup.rotor.clearance_um, setup.unit)
    quality = checks.refuse_stuck(quality, setup.probes, samples[:, :2], period)
    healthy = _healthy_state(setup, speed.rpm)
    if healthy is None and setup.calibrations:
        quality = quality.with_problem(_learnt_anew(setup, speed.rpm))
    probes = (
        Probe(setup.probes[0], 0, setup.probe_angles_deg[0]),
        Probe(setup.probes[1], 1, setup.probe_angles_deg[1]),
    )
    if healthy is not None and speed.keyphasor is None:
        first = samples[: math.ceil(setup.rules.calibrate_revolutions * period), :2]
        healthy = _begun_with(first, healthy, setup, probes, speed.rpm, recording.rate_hz)
    setup = replace(setup, calibrations=() if healthy is None else (healthy,))
    detector = RotorSynchronousDetector(
        machine="recording",
        stream=str(recording.source),
        rate_hz=recording.rate_hz,
        speed_rpm=speed.rpm,
        probes=probes,
        reference=speed.keyphasor or setup.unmarked,
        rotor=setup.rotor,
        rules=replace(setup.rules, speed_uncertainty=speed.uncertainty),
        calibration=healthy,
        ac_coupled=setup.ac_coupled or checks.lacks_mean(samples[:, :2]),
        listener=watched.add,
    )
    complaints = _feed(detector, samples, recording.rate_hz, period, progress)
    revolutions = detector.watch.revolutions
    checks.refuse_gaps(revolutions - len(watched.reports), revolutions, complaints)
    if detector.ac_coupled and not setup.ac_coupled:
        quality = quality.with_problem(_NO_MEAN)
    vectors = SynchronousVectors.joined(watched.vectors)
    conclusion = _Conclusion(recording, setup, detector, tuple(watched.reports), vectors, complaints)
    return conclusion.verdict(quality)


def _healthy_state(setup: RotorSetup, speed_rpm: float) -> Calibration | None:
    """The calibration that the recording is compared with; None to make one of its first revolutions."""
    if not setup.calibrations:
        return None
    try:
        return baseline_at(setup.calibrations, speed_rpm)
    except ValueError as error:
        if all(one.fit_error is not None for one in setup.calibrations):
            return None  # a run-up shows the rotor at any speed
        raise RefusedError(str(error)) from None


def _begun_with(
    first: Floats,
    healthy: Calibration,
    setup: RotorSetup,
    probes: tuple[Probe, Probe],
    speed_rpm: float,
    rate_hz: float,
) -> Calibration:
    """The calibration with the shaft angle of a recording that has no keyphasor, by its first samples."""
    turns = RevolutionStream(
        machine="recording", rate_hz=rate_hz, speed_rpm=speed_rpm, probes=probes, reference=setup.unmarked
    ).process(first.astype(np.float32), 0)
    if not turns:
        return healthy
    return begun_at(healthy, SynchronousVectors.joined([turn.vector for turn in turns]), rate_hz)


def _learnt_anew(setup: RotorSetup, speed_rpm: float) -> str:
    """Why the first revolutions are the healthy machine in spite of a calibration."""
    known = ", ".join(f"{one.speed_rpm:.1f}" for one in setup.calibrations)
    return (
        f"the calibration has no baseline at {abs(speed_rpm):.1f} rpm, but at {known} rpm: the rotor is that "
        f"of its run-up, the first {setup.rules.calibrate_revolutions} revolutions are the healthy machine"
    )


def _feed(
    detector: RotorSynchronousDetector,
    samples: Floats,
    rate_hz: float,
    period_samples: float,
    progress: Progress | None,
) -> tuple[Complaint, ...]:
    """Hand the recording to the detector in windows; what it complains of, each kind once."""
    reasons: list[str] = []
    length = max(1, round(_WINDOW_REVOLUTIONS * period_samples / detector.block)) * detector.block
    period_ns = NS_PER_S / rate_hz
    for begin in range(0, len(samples), length):
        part = samples[begin : begin + length].astype(np.float32)
        end = begin + len(part)
        diagnoses = detector.process(Window(begin, part, round((end - 1) * period_ns), period_ns))
        reasons += [one.reason for one in diagnoses if one.quality != "good"]
        if progress is not None:
            progress(end, len(samples))
        if detector.refused:
            raise RefusedError(detector.refused)
    return checks.complaints(reasons)


@dataclass(frozen=True, slots=True)
class _Conclusion:
    """A recording, and what the detector has found in it."""

    recording: Recording
    setup: RotorSetup
    detector: RotorSynchronousDetector
    reports: tuple[WatchReport, ...]
    vectors: SynchronousVectors
    complaints: tuple[Complaint, ...]

    def verdict(self, quality: DataQuality) -> RotorVerdict:
        watch = self.detector.watch
        unusable = watch.revolutions - len(self.vectors)
        quality = replace(
            quality,
            unusable_revolutions=unusable,
            keyphasor=self.detector.edges if self.setup.keyphasor is not None else None,
        )
        for complaint in self.complaints:
            quality = quality.with_problem(complaint.describe())
        calibration = watch.calibration
        calibrated = 0 if self.setup.calibrations else self.setup.rules.calibrate_revolutions
        if calibration is None:
            raise RefusedError(too_short(len(self.vectors), calibrated + LEAST_JUDGED, self.setup))
        last = self._last_look()
        steps = history(self.reports, last)
        departed = self._departed()
        places = Places(self.reports, self.vectors.period_samples, self.recording.rate_hz)
        threshold = threshold_for(self.setup.rules.false_alarms_per_1000_rev)
        analysis = RotorVerdict(
            recording=str(self.recording.source),
            quality=quality,
            verdict="normal",
            group=("normal",),
            named=True,
            false_alarms_per_1000_rev=self.setup.rules.false_alarms_per_1000_rev,
            threshold_nats=threshold,
            alarms=rotor_alarms(places, last),
            calibration=calibration,
            reference_revolutions=self._reference_revolutions(calibration, departed),
            speed_rpm=math.copysign(
                60.0 * self.recording.rate_hz / float(self.vectors.period_samples.mean()),
                self.setup.speed_rpm or 1.0,
            ),
            revolutions=watch.revolutions,
            history=steps,
            trace=Trace(self.vectors, self.reports),
        )
        if departed is None or (last is not None and last.verdict == "normal"):
            evidence = self._healthy_evidence(calibration, calibrated)
            chances = posterior(
                {name: nats - threshold * (name != "normal") for name, nats in evidence.items()}
            )
            return replace(analysis, evidence=evidence, probabilities=chances)
        analysis = replace(analysis, onset=places.onset(departed), departure=places.end_of(departed))
        if last is None:
            return replace(analysis, verdict=None, group=(), named=False)
        return replace(
            analysis,
            verdict=last.verdict,
            group=last.group,
            named=last.named,
            probabilities=last.probabilities,
            evidence=last.evidence,
            severity=last.severity,
            level=levels(last, calibration),
            identification=last,
            declaration=declared_at(places, self.reports[self.reports.index(departed) :], last),
        )

    def _departed(self) -> WatchReport | None:
        """The report that raised the alarm which is still up."""
        departed = None
        for report in self.reports:
            if report.state != "departed":
                departed = None
            elif report.departed and departed is None:
                departed = report
        return departed

    def _last_look(self) -> Identification | None:
        """The last evaluation; one more at the end of the recording, unless the last revolution had one."""
        if not self.reports or self.reports[-1].state != "departed":
            return None
        if self.reports[-1].looked:
            return self.reports[-1].identification
        return self.detector.watch.finish()

    def _reference_revolutions(self, calibration: Calibration, departed: WatchReport | None) -> int:
        """Healthy revolutions that the baseline has grown to, before the change if there is one."""
        watched, before = 0, "watching" if self.setup.calibrations else "calibrating"
        for report in self.reports:
            if report is departed:
                watched -= report.revolution - (report.onset_revolution or report.revolution)
                break
            # What begins again begins with the revolutions of its calibration.
            watched = watched + 1 if report.state == before == "watching" else 0
            before = report.state
        return min(_MOST_REFERENCE, calibration.revolutions + max(0, watched))

    def _healthy_evidence(self, calibration: Calibration, calibrated: int) -> Mapping[RotorFault, float]:
        """What the last revolutions of a machine that has not departed show for every hypothesis."""
        recent = self.vectors[max(calibrated, len(self.vectors) - _SEEN) :]
        if not len(recent):
            return {}
        rate_hz = self.recording.rate_hz
        moved, terms = compensated(
            recent, calibration.rotor, calibration.speed_rad_s, rate_hz, calibration.law
        )
        change = moved.mean(axis=0) - calibration.baseline
        variance = calibration.spread.of_means(
            float(len(recent)), calibration.revolutions, terms.mean(axis=0)
        )
        return likelihoods(change, variance, calibration.healthy, calibration.baseline + change)


def history(reports: Sequence[WatchReport], last: Identification | None) -> tuple[ModeStep, ...]:
    """Every change of what the watch stated, and at the end the last evaluation if it differs."""
    steps: list[ModeStep] = []
    for report in reports:
        before = steps[-1] if steps else None
        identification = report.identification
        if report.departed and (before is None or before.verdict == "normal"):
            steps.append(ModeStep(report.revolution, None))
        elif report.state == "watching" and before is not None and before.verdict != "normal":
            steps.append(ModeStep(report.revolution, "normal", ("normal",), named=True))
        elif report.looked and identification is not None:
            _add_look(steps, report.revolution, identification)
    if last is not None and reports:
        _add_look(steps, reports[-1].revolution, last)
    return tuple(steps)


def _add_look(steps: list[ModeStep], revolution: int, identification: Identification) -> None:
    before = steps[-1] if steps else None
    if before is None or (before.verdict, before.group, before.named) != (
        identification.verdict,
        identification.group,
        identification.named,
    ):
        steps.append(
            ModeStep(
                revolution,
                identification.verdict,
                identification.group,
                identification.named,
                identification.probabilities,
            )
        )


def posterior(evidence: Mapping[RotorFault, float]) -> dict[RotorFault, float]:
    """Probabilities of hypotheses, equally likely before, with this evidence in nats."""
    top = max(evidence.values(), default=0.0)
    weights = {name: math.exp(nats - top) for name, nats in evidence.items()}
    return {name: weight / math.fsum(weights.values()) for name, weight in weights.items()}


@dataclass(frozen=True, slots=True)
class Places:
    """Where the revolutions of a recording lie.

    Attributes:
        reports: one for each revolution that could be fitted.
        period_samples: float64, samples in each of them.
        rate_hz: sampling rate.
    """

    reports: Sequence[WatchReport]
    period_samples: NDArray[np.float64]
    rate_hz: float

    def onset(self, departed: WatchReport) -> Instant:
        """Where the revolution begins that the change is estimated to begin with."""
        first = departed.onset_revolution or departed.revolution
        place = bisect.bisect_left(self.reports, first, key=lambda report: report.revolution)
        place = min(place, len(self.reports) - 1)
        begin = self.reports[place].end_index - round(float(self.period_samples[place]))
        return self._instant(max(0, begin), first - 1)

    def end_of(self, report: WatchReport) -> Instant:
        """Where a revolution ends."""
        return self._instant(report.end_index, report.revolution)

    def _instant(self, sample: int, revolution: int) -> Instant:
        return Instant(sample, sample / self.rate_hz, revolution)


def rotor_alarms(places: Places, last: Identification | None) -> tuple[RotorAlarm, ...]:
    """Every alarm of a recording, in order.

    The departure that takes a machine back to its healthy state is no alarm, but the end of the one before.

    Args:
        places: the recording.
        last: the evaluation at its end; None if the machine is healthy then.
    """
    alarms: list[RotorAlarm] = []
    segment: list[WatchReport] = []
    up = 0  # alarms before those that are up

    def clear(at: WatchReport) -> None:
        nonlocal up
        closing = _alarm(places, segment)
        # The way back to health is a change, too: the end of the alarm before and not one of its own.
        if len(alarms) == up or set(closing.group) not in ({*alarms[-1].group}, set()):
            alarms.append(closing)
        alarms[up:] = [replace(alarm, returned=places.end_of(at)) for alarm in alarms[up:]]
        up = len(alarms)
        segment.clear()

    for report in places.reports:
        if report.departed:
            if segment:
                alarms.append(_alarm(places, segment))
            segment = [report]
        elif segment and report.state == "watching":
            clear(report)
        elif segment:
            segment.append(report)
    if segment and last is not None and last.verdict == "normal":
        clear(segment[-1])
    elif segment:
        alarms.append(_alarm(places, segment, last))
    return tuple(alarms)


def declared_at(
    places: Places, reports: Sequence[WatchReport], last: Identification | None
) -> Instant | None:
    """Where a group was first named.

    Args:
        places: the recording.
        reports: among which to look, in order.
        last: the evaluation that names it; None if none does.
    """
    if last is None or not last.named:
        return None
    for report in reports:
        identification = report.identification
        if (
            report.looked
            and identification is not None
            and identification.named
            and set(identification.group) == set(last.group)
        ):
            return places.end_of(report)
    return places.end_of(places.reports[-1])


def _alarm(places: Places, segment: Sequence[WatchReport], last: Identification | None = None) -> RotorAlarm:
    looks = [report.identification for report in segment if report.looked and report.identification]
    # A name is kept through one evaluation that sees a healthy machine: it shows nothing of the fault.
    faulty = [look for look in looks if look.verdict != "normal" and "normal" not in look.candidates]
    seen = last or (faulty[-1] if faulty else None)
    return RotorAlarm(
        onset=places.onset(segment[0]),
        departure=places.end_of(segment[0]),
        declaration=declared_at(places, segment, seen),
        verdict=None if seen is None else seen.verdict,
        group=() if seen is None else seen.group,
        returned=None,
    )
