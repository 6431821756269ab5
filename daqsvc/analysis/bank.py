"""The verdict of a rotor bank over a recording, in the words of `RotorAnalysis`."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING, cast

from daqsvc.analysis.quality import complaints, known_against
from daqsvc.analysis.result import Instant, RotorAnalysis, Step

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.analysis.statements import Statements
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.recording.recording import Recording
    from daqsvc.rotor.synchronous.signatures import RotorFault


_CLOSED_LIST = (
    "the rotor bank knows its modes and nothing else: on a machine that does not follow its model closely, "
    "the nearest mode may be the wrong one; [pipeline.rotor_synchronous] can say unmodelled"
)


def bank_analysis(recording: Recording, said: Statements) -> RotorAnalysis:
    """What a recording says about a rotor by its bank alone.

    Modes become the faults that they stand for; levels of one fault are one verdict.

    Args:
        recording: the recording.
        said: all that the bank said, with the fault of each mode.
    """
    quality = known_against(recording)
    source = str(recording.source)
    judged = [one for one in said.diagnoses if one.quality == "good"]
    poor = [one for one in said.diagnoses if one.quality != "good"]
    for complaint in complaints(one.reason for one in poor):
        quality = quality.with_problem(complaint.describe())
    if not said.diagnoses:
        return RotorAnalysis.not_judged(
            source, "the recording is too short for the rotor bank: not one revolution", quality
        )
    if len(poor) > len(judged):
        return RotorAnalysis.not_judged(source, poor[-1].reason, quality)
    last = judged[-1]
    group = _faults(last, said)
    if not group:
        return RotorAnalysis.not_judged(
            source,
            f"the bank has not decided in {last.revolutions or 0.0:.0f} revolutions; give a longer recording",
            quality,
        )
    steps, departed, onset, named = _history(judged, said)
    chances: dict[RotorFault, float] = defaultdict(float)
    for mode, probability in last.probabilities.items():
        chances[cast("RotorFault", said.faults.get(mode, mode))] += probability
    changed = group[0] != "normal" and departed is not None
    if changed:
        quality = quality.with_problem(_CLOSED_LIST)
    return RotorAnalysis(
        recording=source,
        quality=quality,
        verdict=group[0],
        group=group,
        named=last.decision in said.faults,
        probabilities=chances,
        evidence=cast("dict[RotorFault, float]", dict(last.evidence)),
        onset=_instant(onset, recording.rate_hz, last) if changed and onset is not None else None,
        departure=_instant(departed.end_index, recording.rate_hz, departed) if changed and departed else None,
        declaration=_instant(named.end_index, recording.rate_hz, named) if changed and named else None,
        threshold_nats=last.thresholds.get("cusum"),
        speed_rpm=last.statistics.get("speed"),
        revolutions=math.floor(last.revolutions or 0.0),
        history=steps,
    )


def _faults(said: Diagnosis, bank: Statements) -> tuple[RotorFault, ...]:
    """The faults that a statement leaves, the decision first."""
    modes = [mode for mode in (said.decision, *said.group) if mode in bank.faults]
    return tuple(dict.fromkeys(cast("RotorFault", bank.faults[mode]) for mode in modes))


def _history(
    judged: Sequence[Diagnosis], bank: Statements
) -> tuple[tuple[Step, ...], Diagnosis | None, int | None, Diagnosis | None]:
    """Changes of the verdict; the statements that raised the alarm and gave the last name, and the onset."""
    steps: list[Step] = []
    departed = named = None
    onset: int | None = None
    for said in judged:
        group = _faults(said, bank)
        if not group:
            continue
        settled = said.decision in bank.faults
        if group == ("normal",):
            departed = named = onset = None
        elif departed is None:
            departed, onset = said, said.first_index
        if settled and group != ("normal",) and (named is None or set(_faults(named, bank)) != set(group)):
            named = said
        step = Step(math.floor(said.revolutions or 0.0), group[0], group, settled)
        if not steps or (steps[-1].group, steps[-1].named) != (step.group, step.named):
            steps.append(step)
    return tuple(steps), departed, onset, named


def _instant(sample: int, rate_hz: float, said: Diagnosis) -> Instant:
    """A sample, with the revolution counted back from a statement at the speed it knows."""
    speed_rpm = said.statistics.get("speed", math.nan)
    turns = (said.revolutions or 0.0) - (said.end_index - sample) / rate_hz * speed_rpm / 60.0
    return Instant(sample, sample / rate_hz, math.floor(turns) if math.isfinite(turns) else 0)
