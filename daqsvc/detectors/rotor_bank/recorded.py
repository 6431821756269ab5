"""The rotor's model bank over a recording: its verdict, in the words of `RotorVerdict`."""

from __future__ import annotations

import math
from collections import defaultdict
from functools import partial
from typing import TYPE_CHECKING, cast

from daqsvc.detectors.rotor_bank.build import bank_detector
from daqsvc.detectors.rotor_bank.settings import RotorBank
from daqsvc.detectors.shaft.verdict import Instant, ModeStep, RotorVerdict
from daqsvc.diagnosis.recorded import Evaluated, RecordedDetector, statements_of
from daqsvc.dsp.quality.recorded import complaints, known_against
from daqsvc.rotor.synchronous.signatures import FAULTS

if TYPE_CHECKING:
    from collections.abc import Container, Mapping, Sequence

    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.diagnosis.recorded import Progress, Recorded, Statements
    from daqsvc.recording.recording import Recording
    from daqsvc.rotor.synchronous.nonsynchronous import NonsynchronousLine
    from daqsvc.rotor.synchronous.signatures import RotorFault


_CLOSED_LIST = (
    "the rotor bank knows its modes and nothing else: on a machine that does not follow its model closely, "
    "the nearest mode may be the wrong one; [pipeline.rotor_synchronous] can report unmodelled"
)


class RecordedBank(RecordedDetector[RotorBank]):
    """The model bank in recordings; see `RecordedDetector`."""

    part = "rotor"

    @property
    def sensors(self) -> tuple[str, ...]:
        """See `RecordedDetector.sensors`."""
        return self.settings.sensors

    def as_recorded(self, sensors: Container[str]) -> RotorBank | None:
        """See `RecordedDetector.as_recorded`."""
        return self.settings if all(name in sensors for name in self.settings.sensors) else None

    def not_judged(self, recording: str, why: str) -> RotorVerdict:
        """See `RecordedDetector.not_judged`."""
        return RotorVerdict.not_judged(recording, why)

    def evaluate(self, recorded: Recorded, settings: RotorBank, progress: Progress | None) -> Evaluated:
        """See `RecordedDetector.evaluate`."""
        del progress
        detector = bank_detector(recorded.machine, settings)
        (statements,) = statements_of(detector, recorded)
        return Evaluated(
            (statements,),
            bank_verdict(
                recorded.recording,
                statements,
                detector.faults,
                closed=not detector.knows_other_faults,
                lines=detector.lines,
            ),
            partial(_draw, recorded.recording, statements, tuple(detector.faults)),
        )


def _draw(recording: Recording, statements: Statements, modes: tuple[str, ...], prefix: str) -> None:
    from daqsvc.detectors.rotor_bank.plots import draw_bank  # noqa: PLC0415 - brings matplotlib

    draw_bank(recording, statements, modes, f"{prefix}-bank")


def bank_verdict(
    recording: Recording,
    statements: Statements,
    faults: Mapping[str, str],
    *,
    closed: bool,
    lines: Sequence[NonsynchronousLine] = (),
) -> RotorVerdict:
    """What a recording reports about a rotor by its bank alone.

    Modes become the faults that they represent; levels of one fault are one verdict.

    Args:
        recording: the recording.
        statements: all that the bank stated.
        faults: the fault that each mode represents.
        closed: whether the bank knows its modes and nothing else.
        lines: that it leaves out at the end, the largest first.
    """
    quality = known_against(recording)
    source = str(recording.source)
    judged = [one for one in statements.diagnoses if one.quality == "good"]
    poor = [one for one in statements.diagnoses if one.quality != "good"]
    for complaint in complaints(one.reason for one in poor):
        quality = quality.with_problem(complaint.describe())
    if not statements.diagnoses:
        return RotorVerdict.not_judged(
            source, "the recording is too short for the rotor bank: not one revolution", quality
        )
    if len(poor) > len(judged):
        return RotorVerdict.not_judged(source, poor[-1].reason, quality)
    last = judged[-1]
    group = _faults(last, faults)
    if not group:
        return RotorVerdict.not_judged(
            source,
            f"the bank has not decided in {last.revolutions or 0.0:.0f} revolutions; give a longer recording",
            quality,
        )
    steps, departed, onset, named = _history(judged, faults)
    chances: dict[RotorFault, float] = defaultdict(float)
    for mode, probability in last.probabilities.items():
        chances[cast("RotorFault", faults.get(mode, mode))] += probability
    changed = group[0] != "normal" and departed is not None
    if changed and closed:
        quality = quality.with_problem(_CLOSED_LIST)
    return RotorVerdict(
        recording=source,
        quality=quality,
        verdict=group[0],
        group=group,
        named=_fault(last.decision, faults) is not None,
        probabilities=chances,
        evidence=cast("dict[RotorFault, float]", dict(last.evidence)),
        left_out=tuple(lines),
        onset=_instant(onset, recording.rate_hz, last) if changed and onset is not None else None,
        departure=_instant(departed.end_index, recording.rate_hz, departed) if changed and departed else None,
        declaration=_instant(named.end_index, recording.rate_hz, named) if changed and named else None,
        threshold_nats=last.thresholds.get("cusum"),
        speed_rpm=last.statistics.get("speed"),
        revolutions=math.floor(last.revolutions or 0.0),
        history=steps,
    )


def _faults(diagnosis: Diagnosis, faults: Mapping[str, str]) -> tuple[RotorFault, ...]:
    """The faults that a statement leaves, the decision first."""
    named = [_fault(name, faults) for name in (diagnosis.decision, *diagnosis.group)]
    return tuple(dict.fromkeys(fault for fault in named if fault is not None))


def _fault(name: str, faults: Mapping[str, str]) -> RotorFault | None:
    """The fault of a mode, or one that the bank has no mode of; None while there is no name."""
    return cast("RotorFault | None", faults.get(name, name if name in FAULTS else None))


def _history(
    judged: Sequence[Diagnosis], faults: Mapping[str, str]
) -> tuple[tuple[ModeStep, ...], Diagnosis | None, int | None, Diagnosis | None]:
    """Changes of the verdict; the statements that raised the alarm and gave the last name, and the onset."""
    steps: list[ModeStep] = []
    departed = named = None
    onset: int | None = None
    for diagnosis in judged:
        group = _faults(diagnosis, faults)
        if not group:
            continue
        settled = _fault(diagnosis.decision, faults) is not None
        if group[0] == "normal":  # a fault may look like it
            departed = named = onset = None
        elif departed is None:
            departed, onset = diagnosis, diagnosis.first_index
        if settled and group[0] != "normal" and (named is None or set(_faults(named, faults)) != set(group)):
            named = diagnosis
        step = ModeStep(math.floor(diagnosis.revolutions or 0.0), group[0], group, settled)
        if not steps or (steps[-1].group, steps[-1].named) != (step.group, step.named):
            steps.append(step)
    return tuple(steps), departed, onset, named


def _instant(sample: int, rate_hz: float, diagnosis: Diagnosis) -> Instant:
    """A sample, with the revolution counted back from a statement at the speed it knows."""
    speed_rpm = diagnosis.statistics.get("speed", math.nan)
    turns = (diagnosis.revolutions or 0.0) - (diagnosis.end_index - sample) / rate_hz * speed_rpm / 60.0
    return Instant(sample, sample / rate_hz, math.floor(turns) if math.isfinite(turns) else 0)
