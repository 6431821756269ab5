"""What one evaluation of the bearings of a machine has found, and its figures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from daqsvc.bearing.impact import STEADY
from daqsvc.bearing.race.verdict import PARTS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from daqsvc.bearing.identify import ResidualChange
    from daqsvc.bearing.race.verdict import RaceVerdict
    from daqsvc.detectors.bearing.direction import Direction
    from daqsvc.detectors.bearing.finding import BearingFinding
    from daqsvc.dsp.quality import Quality

LARGE = 10.0
"""Multiple of the healthy machine's innovations from which on it is danger."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What one evaluation has found.

    Attributes:
        races: of each bearing that could be judged, by name.
        changes: of the innovations at each of them; empty without a healthy machine.
        directions: what two accelerometers show, of each bearing that has two.
        quality: what the samples are worth.
        reason: why they are not good.
        finding: what the bearings show together; None if none could be judged.
    """

    races: Mapping[str, RaceVerdict]
    changes: Mapping[str, ResidualChange]
    quality: Quality
    reason: str
    finding: BearingFinding | None
    directions: Mapping[str, Direction] = field(default_factory=dict)

    @property
    def change(self) -> ResidualChange | None:
        """Of the bearing where the innovations have grown most."""
        return max(self.changes.values(), key=lambda one: one.departure, default=None)


_UNITS = {"speed": "rpm", "residual.rise": "dB", "line.frequency": "Hz"}
_DIRECTION_UNITS = {"direction": "dB", "direction.change": "nat"}
"""Of figures that begin with the name of a bearing."""


def units_of(figures: Iterable[str]) -> dict[str, str]:
    """Unit of each figure that has one."""
    units = {key: _UNITS.get(key) or _DIRECTION_UNITS.get(key.partition(".")[2], "") for key in figures}
    return {key: unit for key, unit in units.items() if unit}


def figures_of(evaluated: Evaluation, where: str) -> dict[str, float]:
    """What was measured: of the bearing that the statement is about, and the size of every other."""
    figures: dict[str, float] = {}
    if evaluated.change is not None:
        figures |= {
            "residual.ratio": evaluated.change.ratio,
            "residual.rise": float(evaluated.change.rise_db[0]),
            "residual.departure": evaluated.change.departure,
        }
    for name, direction in evaluated.directions.items():
        figures[f"{name}.direction.change"] = direction.change_nats
        if math.isfinite(direction.bursts):
            figures[f"{name}.direction.bursts"] = direction.bursts
        if math.isfinite(direction.ratio_db):
            figures[f"{name}.direction"] = direction.ratio_db
    for name, race in evaluated.races.items():
        for part in PARTS:
            evidence = race.evidence[part]
            figures[f"{name}.{part}.z"] = evidence.z
            figures[f"{name}.{part}.size"] = evidence.depth
            figures[f"{name}.{part}.severity"] = evidence.severity
    race_there = evaluated.races.get(where)
    if race_there is not None:
        figures["speed"] = race_there.speed_rpm
        lines = [line for line in race_there.lines if line.part in race_there.group]
        if lines:
            figures |= {"line.frequency": lines[0].frequency_hz, "line.order": lines[0].order}
    return figures


def thresholds_of(evaluated: Evaluation, where: str) -> dict[str, float]:
    """What the figures are compared with."""
    thresholds: dict[str, float] = {}
    if evaluated.change is not None:
        thresholds |= {"residual.departure": 1.0, "residual.ratio.danger": LARGE}
    if where in evaluated.races:
        for part, evidence in evaluated.races[where].evidence.items():
            thresholds[f"{where}.{part}.z"] = evidence.z_limit
            thresholds[f"{where}.{part}.severity"] = evidence.limit
    for name, direction in evaluated.directions.items():
        thresholds[f"{name}.direction.change"] = direction.limit_nats
        if math.isfinite(direction.bursts):
            thresholds[f"{name}.direction.bursts"] = STEADY
    return thresholds


def evidence_of(evaluated: Evaluation, where: str) -> dict[str, float]:
    """Log-likelihood ratio of each part in nats: of its lines against noise, or, if more, of its impacts.

    A ball's impacts are those of both races: the fewer of them are evidence for it.
    """
    if where not in evaluated.races:
        return {}
    lines = evaluated.races[where].lines
    evidence: dict[str, float] = {
        part: float(sum(line.evidence for line in lines if line.part == part)) for part in PARTS
    }
    if where in evaluated.directions and evaluated.directions[where].group:
        direction = evaluated.directions[where]
        inner, outer = direction.inner_nats, direction.outer_nats
        hits = {"inner": inner, "outer": outer, "ball": min(inner, outer)}
        return {part: max(nats, hits[part]) for part, nats in evidence.items()}
    return evidence
