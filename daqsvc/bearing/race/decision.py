"""From evidence to a word: significance and size, what cannot be told apart, and how sure "normal" may be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from daqsvc.bearing.race.verdict import PARTS, PartEvidence

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.bearing.race.baseline import RaceBaseline
    from daqsvc.bearing.race.rules import RaceRules
    from daqsvc.bearing.race.verdict import Part, RaceWord


STEEPNESS = 4.0
"""Odds grow with this power of the factor by which a limit is passed: a convention, not a measurement."""

LEAST_FACTOR = 1e-3

RACES: tuple[Part, ...] = ("inner", "outer")


@dataclass(frozen=True, slots=True)
class Decision:
    """The word, what it cannot be told from, the shares of belief, and how thin it is.

    ``both``: both races are in the group because each has lines of its own, though they can be told apart.
    """

    verdict: RaceWord
    group: tuple[str, ...]
    probability: Mapping[str, float]
    margin: float
    both: bool = False


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
        if baseline is not None and passed[part] > 0.0:
            before = baseline.evidence[part]
            passed[part] = _against(evidence[part], before, rules, passed[part])
            if changed:
                passed[part] = max(passed[part], _grown(part, evidence[part], before, rules))
    _overshadow(passed, evidence, rules)
    sure = max(passed.values())
    open_to = _belief_strength(passed, evidence, rules)
    fault = max(_odds_share(max(open_to.values())), _regular(evidence, rules))
    candidates = tuple(part for part in PARTS if passed[part] >= 1.0)
    rest: RaceWord = "changed" if changed else "normal"
    if not candidates:
        belief = {rest: 1.0 - fault} | _shares(open_to, fault)
        return Decision(rest, (rest,), belief, 1.0 / max(sure, LEAST_FACTOR))
    weight = {part: weight_of(part, evidence[part], rules) for part in candidates}
    belief = {rest: 1.0 - fault} | _shares(weight, fault)
    best = max(candidates, key=weight.__getitem__)
    rivals = [weight[best] / weight[part] for part in candidates if part != best]
    margin = min([passed[best], *rivals])
    if best != "ball" and all(passed[race] >= rules.both_factor for race in RACES):
        other: Part = "outer" if best == "inner" else "inner"
        return Decision(best, (best, other), belief, margin, both=True)
    group = tuple(part for part in candidates if weight[part] * rules.group_factor >= weight[best])
    open_race = all(race in group for race in RACES)
    return Decision("inner_or_outer" if open_race else best, group, belief, margin)


def _belief_strength(
    passed: Mapping[Part, float], evidence: Mapping[Part, PartEvidence], rules: RaceRules
) -> dict[Part, float]:
    """By which factor each part passes, or would at most be on the fence if it were testable."""
    return {
        part: passed[part] if e.testable else min(1.0, _passed(part, replace(e, testable=True), rules))
        for part, e in evidence.items()
    }


def _odds_share(factor: float) -> float:
    """Belief in a fault by the factor that its limits are passed by."""
    odds = float(factor**STEEPNESS)
    return odds / (1.0 + odds)


def _regular(evidence: Mapping[Part, PartEvidence], rules: RaceRules) -> float:
    """Least belief in a fault: lines that no noise makes are no good order, however small."""
    return rules.regular_doubt if any(e.z >= rules.regular_z for e in evidence.values()) else 0.0


def _overshadow(passed: dict[Part, float], evidence: Mapping[Part, PartEvidence], rules: RaceRules) -> None:
    """Name no part beside a stronger one that cannot be named: what made its lines may have made these."""
    weight = {part: weight_of(part, evidence[part], rules) for part in PARTS}
    for part in PARTS:
        for other in PARTS:
            strong = evidence[other].z >= rules.strong_z and weight[other] > weight[part]
            if strong and passed[other] < 1.0 <= passed[part]:
                passed[part] = max(passed[other], weight[part] / weight[other])


def weight_of(part: Part, e: PartEvidence, rules: RaceRules) -> float:
    """What a part counts against the others."""
    return e.severity * (rules.ball_weight if part == "ball" else 1.0)


def _shares(strength: Mapping[Part, float], whole: float) -> dict[str, float]:
    """Shares of a belief by strength."""
    odds = {part: max(value, LEAST_FACTOR) ** STEEPNESS for part, value in strength.items()}
    total = sum(odds.values())
    return {part: whole * value / total for part, value in odds.items()}


def _passed(part: Part, e: PartEvidence, rules: RaceRules, ease: float = 1.0) -> float:
    """The smallest factor by which a part passes its limits; at least 1 for a candidate.

    Args:
        part: the part.
        e: its evidence.
        rules: the rules of the test.
        ease: share of the limit of severity that is needed.
    """
    if not e.testable:
        return 0.0
    depth_limit = rules.ball_depth_limit if part == "ball" else rules.depth_limit
    least = min(e.z / e.z_limit, e.depth / depth_limit, e.severity / (ease * e.limit))
    if e.steadiness_limit > 0.0:
        # Squared: between knocks and strikes this ratio spans far less than the others do.
        least = min(least, (e.steadiness / e.steadiness_limit) ** 2)
    return max(0.0, least)


def _against(e: PartEvidence, before: PartEvidence, rules: RaceRules, passed: float) -> float:
    """The same where the machine had such lines in good order: they must have grown."""
    if before.z < before.z_limit:
        return passed
    return min(passed, e.depth / max(rules.line_growth * before.depth, LEAST_FACTOR))


def _grown(part: Part, e: PartEvidence, before: PartEvidence, rules: RaceRules) -> float:
    """The same where the level has changed: lines that have grown much need less severity."""
    significance = (e.z - max(0.0, before.z)) / rules.z_growth
    size = e.depth / max(rules.changed_growth * before.depth, LEAST_FACTOR)
    return max(0.0, min(_passed(part, e, rules, rules.changed_ease), significance, size))


MOST_MARGIN = 10.0
"""A limit missed by more is no less missed."""
NOTE_DOUBT, REPAIR_DOUBT = 0.01, 0.1
"""Of each thing that weakens the test, and of each kind of defect of its samples: a convention."""
MOST_DOUBT = 0.5


def doubted(probability: Mapping[str, float], notes: int, repairs: int, lost: float) -> dict[str, float]:
    """Shares of belief in which "normal" gives to the parts what was perhaps not seen.

    Args:
        probability: share of belief per word, by the evidence alone.
        notes: number of other things that weaken the test.
        repairs: kinds of defects that were put right.
        lost: share of the record in which nothing could be seen.
    """
    doubt = min(NOTE_DOUBT * notes + REPAIR_DOUBT * repairs + lost, MOST_DOUBT)
    shares = dict(probability)
    given = doubt * shares.get("normal", 0.0)
    if given > 0.0:
        shares["normal"] -= given
        for part in PARTS:
            shares[part] = shares.get(part, 0.0) + given / len(PARTS)
    return shares
