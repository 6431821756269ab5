"""From evidence to a word: significance and size, and what cannot be told apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.bearing.race.verdict import PARTS, PartEvidence

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.bearing.race.baseline import RaceBaseline
    from daqsvc.bearing.race.rules import RaceRules
    from daqsvc.bearing.race.verdict import Part, RaceWord

STEEPNESS = 4.0
"""Odds grow with this power of the factor by which a limit is passed: a convention, not a measurement."""


@dataclass(frozen=True, slots=True)
class Decision:
    """The word, what it cannot be told from, the shares of belief, and how thin it is."""

    verdict: RaceWord
    group: tuple[str, ...]
    probability: Mapping[str, float]
    margin: float


def decide(
    evidence: Mapping[Part, PartEvidence],
    rules: RaceRules,
    baseline: RaceBaseline | None = None,
    change_db: tuple[float, float] | None = None,
) -> Decision:
    """Weigh the parts.

    Args:
        evidence: of each part.
        rules: the rules of the test.
        baseline: of the same machine in good order.
        change_db: level over the baseline, of the whole and of the band that changed most.
    """
    changed = change_db is not None and (
        abs(change_db[0]) >= rules.changed_db or abs(change_db[1]) >= rules.changed_band_db
    )
    passed: dict[Part, float] = {}
    for part in PARTS:
        passed[part] = _passed(part, evidence[part], rules)
        if baseline is not None:
            passed[part] = _against(
                part, evidence[part], baseline.evidence[part], passed[part], rules, changed
            )
    weight = {
        part: evidence[part].severity * (rules.ball_weight if part == "ball" else 1.0) for part in PARTS
    }
    candidates = [part for part in PARTS if passed[part] >= 1.0]
    sure = max(passed.values())
    fault = sure**STEEPNESS / (1.0 + sure**STEEPNESS)
    if not candidates:
        word: RaceWord = "changed" if changed else "normal"
        probability = {"normal": 1.0 - fault}
        if changed:
            probability = {"normal": 0.0, "changed": 1.0 - fault}
        total = sum(max(p, 1e-9) ** STEEPNESS for p in passed.values())
        probability |= {part: fault * max(passed[part], 1e-9) ** STEEPNESS / total for part in PARTS}
        return Decision(word, (word,), probability, 1.0 / max(sure, 1e-3))
    best = max(candidates, key=weight.__getitem__)
    others = [part for part in candidates if part != best]
    rival = max((weight[part] for part in others), default=0.0)
    margin = passed[best] if rival == 0.0 else min(passed[best], weight[best] / rival)
    total = sum(weight[part] ** STEEPNESS for part in candidates)
    probability = {"normal": 1.0 - fault}
    probability |= {part: fault * weight[part] ** STEEPNESS / total for part in candidates}
    near = weight[best] / rules.group_factor
    group = tuple(part for part in PARTS if part in candidates and weight[part] >= near)
    if "inner" in group and "outer" in group:
        return Decision("inner_or_outer", group, probability, margin)
    return Decision(best, group, probability, margin)


def weight_of(part: Part, e: PartEvidence, rules: RaceRules) -> float:
    """What a part counts against the others."""
    return e.severity * (rules.ball_weight if part == "ball" else 1.0)


def _passed(part: Part, e: PartEvidence, rules: RaceRules) -> float:
    """The smallest factor by which a part passes its limits; at least 1 for a candidate."""
    if not e.testable:
        return 0.0
    if part == "ball":
        return max(0.0, min(e.z / e.z_limit, e.depth / rules.ball_depth_limit, e.severity / e.limit))
    # Squared: between knocks and strikes this ratio spans far less than the others do.
    steady = (e.steadiness / rules.steadiness_limit) ** 2
    return max(0.0, min(e.z / e.z_limit, e.depth / rules.depth_limit, e.severity / e.limit, steady))


def _against(
    part: Part,
    e: PartEvidence,
    before: PartEvidence,
    passed: float,
    rules: RaceRules,
    changed: bool,  # noqa: FBT001
) -> float:
    """The same against a baseline: a line that was there must have grown; a changed level needs less size."""
    if not e.testable:
        return 0.0
    if before.z >= before.z_limit:
        passed = min(passed, e.depth / max(rules.line_growth * before.depth, 1e-9))
    if changed:
        least = rules.changed_ball_depth if part == "ball" else rules.changed_depth
        depth = max(least, rules.changed_growth * before.depth)
        grown = (e.z - max(0.0, before.z)) / rules.z_growth
        passed = max(passed, min(e.z / e.z_limit, grown, e.depth / depth))
    return max(0.0, passed)
