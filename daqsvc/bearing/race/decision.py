"""What indicates damage of each part, and the verdict that it makes.

First each part's significance of its comb and size of its lines, in two envelopes. Lines of one part at the
stated speed are those of another part at another speed: which speed is true is asked at the end
(`refuse_rivals`). Then the decision (`decide`): what cannot be told apart, and how sure "normal" may be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.lines import (
    HALF_WIDTH,
    HARMONICS,
    NOTCH_BINS,
    REVOLUTIONS,
    LineEvidence,
    ModulationDepth,
    best_comb,
    false_alarm_probability,
    fundamental,
    line_evidence,
    part_lines,
    sharpest,
    significance,
)
from daqsvc.bearing.race.unknown import unknown_strikes
from daqsvc.bearing.race.verdict import PARTS, PLACES, Part, PartEvidence
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.speed.harmonics import REMEDY

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.unknown import UnknownStrikes
    from daqsvc.bearing.race.verdict import RaceBaseline, RaceRules, RaceWord
    from daqsvc.dsp.drive_lines import DriveLines
    from daqsvc.dsp.speed.harmonics import ShaftRate

    Real = NDArray[np.float64]


SHARPEN_SHARE = 0.01
"""How far the deepest lines may be from the most significant comb, as a share."""
LEAST_LINE_NATS = 3.0
"""Evidence from which on a line stands out."""
FAINT_SHARE = 0.02
"""Evidence for a harmonic, over that for the strongest one, below which the part does not make it."""
SIDEBAND_SHARE = 0.03
"""The same of sidebands."""
CLEAR_NATS = 100.0
"""Evidence for a ball's line from which on its sidebands would stand out, too."""
PLACE_SHARE = 0.002
"""How far the deepest lines may be beyond the slip that is searched, as a share."""
LEAST_KEPT = 0.25
"""Share of its weight that a part keeps at least when it is asked which part explains the others."""


@dataclass(frozen=True, slots=True)
class EnvelopeView:
    """One non-linearity of the envelope: evidence by the phases alone, sizes by clipped amplitudes.

    Attributes:
        lines: evidence for lines.
        depth: their modulation depth.
        power: squared modulation indices, ``[bins]``.
    """

    lines: LineEvidence
    depth: ModulationDepth
    power: Real

    def without(self, orders: Iterable[float]) -> EnvelopeView:
        """The same with nothing at some orders."""
        explained = self.lines.about(orders)
        return EnvelopeView(self.lines.without(explained), self.depth.without(explained), self.power)


def view_of(phases: Real, sizes: Real, revolutions: float, others: Sequence[float] = ()) -> EnvelopeView:
    """Look at an envelope's spectrum.

    Args:
        phases: line power of the band with unit amplitudes, ``[bins]``.
        sizes: that of the band with clipped amplitudes, ``[bins]``.
        revolutions: of the shaft in the record: bins per order.
        others: orders of lines, besides the harmonics of the shaft, that are no bearing's.
    """
    lines = line_evidence(phases, revolutions, others)
    return EnvelopeView(lines, ModulationDepth(sizes, lines.notched, revolutions), sizes)


class Scales:
    """Weighs the parts of a bearing.

    Args:
        square: view of the squared envelope.
        log: view of its logarithm. What fools the one does not fool the other: a few strong transients are
            nothing to the logarithm, a faint steady modulation nothing to the square.
        bearing: fault orders.
        shaft: rate of the shaft.
        revolutions: of the shaft in the record.
        rules: settings of the test.
        drives: gears and motors whose lines stand out; both views are without theirs.
    """

    def __init__(
        self,
        square: EnvelopeView,
        log: EnvelopeView,
        bearing: BearingOrders,
        shaft: ShaftRate,
        revolutions: float,
        rules: RaceRules,
        drives: Sequence[DriveLines] = (),
    ) -> None:
        self._square = square
        self._log = log
        self._bearing = bearing
        self._revolutions = revolutions
        self._rules = rules
        self._drives = drives
        self.covered: set[Part] = set()
        """Parts that are not testable, as a gear or a motor has a line where theirs are looked for."""
        self.unknown: UnknownStrikes | None = None
        """Strikes that fit no part; None if none stand out, or before `weigh`."""
        self.struck: set[Part] = set()
        """Parts that are not testable, as these strikes make their lines."""
        # A speed that is not known sharply shifts every line: the search grows by that, and is paid for.
        self._slip = rules.slip if shaft.sharp else rules.slip + rules.speed_tolerance
        self._seen = shaft.seen
        self._elsewhere = shaft.rival_hz is not None
        self._caution = 1.0 if shaft.seen else rules.unseen_caution

    def weigh(self) -> dict[Part, PartEvidence]:
        """Evidence for all parts; lines that the foremost part explains are no evidence for another one."""
        evidence = {part: self._alone(part) for part in PARTS}
        self.unknown = unknown_strikes(
            [view.lines for view in (self._square, self._log)],
            [view.depth for view in (self._square, self._log)],
            self._bearing,
            evidence,
            self._revolutions,
            self._rules.smear_mirrored,
        )
        if self.unknown is not None:
            evidence = {part: self._part(part) for part in PARTS}
        significant = [part for part in PARTS if evidence[part].z >= evidence[part].z_limit]
        if len(significant) < 2:
            return evidence
        lines = {p: part_lines(p, evidence[p].order, self._bearing) for p in significant}
        apart = {p: {q: self._part(p, lines[q]) for q in significant if q != p} for p in significant}

        def foremost(one: Part, other: Part) -> Part:
            """Of two parts the one that has more left where the other one keeps its lines."""
            # A sideband of one part may lie where another is looked for. Where both explain each other, none
            # has anything left, and what they were before decides.
            own = {
                p: weight_of(p, evidence[p], self._rules) * max(LEAST_KEPT, apart[p][q].z / evidence[p].z)
                for p, q in ((one, other), (other, one))
            }
            return max(own, key=own.__getitem__)

        first = reduce(foremost, significant)
        return evidence | {p: apart[p][first] for p in significant if p != first}

    def _part(self, part: Part, explained: Sequence[float] = ()) -> PartEvidence:
        """Evidence for a part without the lines at some orders, and without those of stronger strikes."""
        e = self._alone(part, explained)
        strikes = self.unknown
        if strikes is None or not e.testable or not e.z_limit <= e.z < strikes.z:
            return e
        left = self._alone(part, [*explained, *strikes.lines(self._bearing)])
        # A ball's comb has so many places, by the cage too, that strikes leave lines in more than their own.
        doubtful = part == "ball" or not self._may_be(part, left)
        if self._may_be(part, e) and doubtful:
            self.struck.add(part)
            return replace(left, testable=False, reason=_struck(strikes))
        return left

    def _may_be(self, part: Part, e: PartEvidence) -> bool:
        """Whether a part may be named, if the level of the machine has changed, too."""
        return e.z >= e.z_limit and _passed(part, e, self._rules) >= self._rules.changed_ease

    def _alone(self, part: Part, explained: Sequence[float] = ()) -> PartEvidence:
        """Evidence for a part without the lines at some orders."""
        rules = self._rules
        views = [view.without(explained) if explained else view for view in (self._square, self._log)]
        stated = fundamental(self._bearing, part)
        gap = abs(stated - round(stated))
        comb = best_comb([view.lines for view in views], self._bearing, part, self._slip)
        z = significance(comb.score, part, self._revolutions, self._slip)
        # Never across a harmonic of the shaft: what lies beyond it is not this part.
        reach = min(SHARPEN_SHARE, 0.5 * gap / stated)
        depths = [view.depth for view in views]
        order = sharpest(depths, comb.order, reach, self._revolutions)
        by_square, by_log = (float(depth.comb(np.array([order]))[0]) for depth in depths)
        steady_z = rules.steady_z * math.sqrt(self._revolutions / REVOLUTIONS)
        e = PartEvidence(
            z=z,
            depth=min(by_square, by_log),
            steadiness=by_log / max(by_square, 1e-9),
            severity=max(z, 0.0) * min(by_square, by_log),
            z_limit=rules.z_limit,
            steadiness_limit=rules.steadiness_limit * min(1.0, steady_z / max(z, 1.0)),
            limit=self._caution * rules.severity_limit,
            false_alarm_probability=false_alarm_probability(z),
            order=order,
        )
        away = gap * self._revolutions
        if away < rules.unresolved_bins:
            e = replace(e, z_limit=rules.z_limit + rules.z_unresolved)
        harmonic = round(order)
        if abs(order - harmonic) <= rules.smear_share * order:
            mirrored = min(depth.mirrored(order) for depth in depths)
            if mirrored >= rules.smear_mirrored and z >= rules.z_limit:
                e = replace(e, testable=False, reason=_smeared(part, order))
        if e.z < e.z_limit and (drive := self._drive_at(stated)) is not None:
            e = replace(e, testable=False, reason=_covered(stated, drive))
            self.covered.add(part)
        if part == "ball":
            # A ball's marks come and go with its own tumbling: its lines are too weak for the logarithm.
            e = replace(e, depth=by_square, severity=max(z, 0.0) * by_square)
            caution = 1.0 if self._seen else rules.unseen_ball_caution
            if self._elsewhere:
                caution = rules.elsewhere_ball_caution
            e = replace(e, limit=caution * rules.ball_severity_limit, steadiness_limit=0.0)
            if away < rules.ball_testable_bins:
                e = replace(e, testable=False, reason=_why_not(stated, gap, rules))
        # Only of a part that may be named: of others nobody asks what made their lines.
        if self._may_be(part, e) and (reason := self._anothers(part, comb.order, order)):
            e = replace(e, testable=False, reason=reason)
        return e

    def _anothers(self, part: Part, comb: float, order: float) -> str:
        """Why lines where a part's are looked for are something else's; empty if they are not.

        Args:
            part: the part.
            comb: its order as its comb was found.
            order: its order by the deepest lines.
        """
        nats = {h: self._nats(h * comb) for h in HARMONICS}
        least = max(LEAST_LINE_NATS, FAINT_SHARE * max(nats.values()))
        factor = math.gcd(*(h for h in HARMONICS if nats[h] >= least))
        if factor > 1:
            return _multiples(order, factor)
        stated = fundamental(self._bearing, part)
        own = max(nats[1], self._nats(order))
        sides = max(self._sidebands(part, order), self._sidebands(part, comb))
        modulated = sides >= max(LEAST_LINE_NATS, SIDEBAND_SHARE * own)
        if part == "ball" and own >= CLEAR_NATS and not modulated:
            return _unmodulated(order)
        # Lines that are modulated as this part's are its own, though its dimensions are others.
        near = abs(order / stated - 1.0) <= self._slip + PLACE_SHARE
        return "" if near or modulated else _misplaced(order, stated)

    def _sidebands(self, part: Part, order: float) -> float:
        """The most evidence for a line at the rate that modulates a part's strikes, or beside them by it."""
        if part == "outer":
            return 0.0
        cage = self._bearing.cage
        if part == "inner":
            return max(self._nats(h * order + side) for h in (1, 2) for side in (-1.0, 1.0))
        places = [h * order + side * cage for h in (1, 2) for side in (-1, 1)]
        places += [1.0 - cage, 1.0 + cage, *(h * cage for h in HARMONICS)]
        return max(
            self._nats(place * at) for place in places for at in (1.0 - PLACE_SHARE, 1.0, 1.0 + PLACE_SHARE)
        )

    def _nats(self, order: float) -> float:
        """Evidence for a line in both envelopes, whatever explains it."""
        return min(view.lines.at(order) for view in (self._square, self._log))

    def _drive_at(self, order: float) -> DriveLines | None:
        """The gear or motor that has a line where a part's is looked for."""
        reach = max(NOTCH_BINS / self._revolutions, HALF_WIDTH * order)
        for drive in self._drives:
            if any(abs(other - order) < reach for other in drive.explained(order + 1.0)):
                return drive
        return None


def _multiples(order: float, factor: int) -> str:
    """Why a part is not testable whose own order has no line."""
    return (
        f"only lines at multiples of order {factor * order:.3f} stand out, {factor} times its own "
        f"{order:.3f}: something else strikes so often"
    )


def _unmodulated(order: float) -> str:
    """Why a ball is not testable whose strikes are all alike."""
    return (
        f"strikes at order {order:.3f} are not modulated by the cage, as those of a ball are: something else "
        "strikes so often"
    )


def _misplaced(order: float, stated: float) -> str:
    """Why a part is not testable whose lines are too far from their place."""
    return (
        f"lines at order {order:.3f} are {abs(order / stated - 1.0):.1%} from its own {stated:.3f}, farther "
        "than slip: check bearing and speed, or what else strikes so often"
    )


def _struck(strikes: UnknownStrikes) -> str:
    """Why a part is not testable beside stronger strikes that fit none."""
    return f"stronger strikes at order {strikes.order:.3f}, which fit no part, may make its lines"


def _covered(order: float, drive: DriveLines) -> str:
    """Why a part is not testable where something else has a line."""
    return f"its line at order {order:.3f} is where the {drive.kind} has one; test it at another speed"


def _smeared(part: Part, order: float) -> str:
    """Why a part is not testable beside a smeared harmonic of the shaft."""
    return (
        f"its lines at order {order:.3f} are on both sides of {round(order)}X, as the shaft makes them "
        f"where its speed wanders; record at a steady speed to test the {PLACES[part]}"
    )


def _why_not(order: float, gap: float, rules: RaceRules) -> str:
    """Why a ball is not testable."""
    needed = rules.ball_testable_bins / max(gap, 1e-6)
    return (
        f"2 BSF = {order:.3f} is too close to {round(order)}X; a record of {needed:.0f} revolutions "
        "or more would tell them apart"
    )


def refuse_rivals(
    evidence: Mapping[Part, PartEvidence], bearing: BearingOrders, shaft: ShaftRate, slip: float
) -> None:
    """Refuse to name a part that has these lines only at a doubtful speed.

    Harmonics may be too few to confirm the stated speed, and yet more of them may indicate the speed at
    which the same lines are those of another part.

    Args:
        evidence: of each part.
        bearing: its fault orders.
        shaft: rate of the shaft.
        slip: how far the lines of a part may be from their place, as a share.

    Raises:
        UnfitError: they do.
    """
    if shaft.seen:
        return
    for part in PARTS:
        e = evidence[part]
        if e.z < e.z_limit or e.severity < e.limit:
            continue
        for other in PARTS:
            rival_hz = shaft.rate_hz * e.order / fundamental(bearing, other)
            if other != part and shaft.outvoted(rival_hz, slip):
                here, there = 60.0 * shaft.rate_hz, 60.0 * rival_hz
                raise UnfitError(
                    "shaft speed or sample rate",
                    f"is in doubt: the lines of the {PLACES[part]} at {here:.0f} rpm are those of the "
                    f"{PLACES[other]} at {there:.0f} rpm, where more harmonics of a shaft stand out",
                    REMEDY,
                )


STEEPNESS = 4.0
"""Odds grow with this power of the factor by which a limit is passed: a convention, not a measurement."""

LEAST_FACTOR = 1e-3

RACES: tuple[Part, ...] = ("inner", "outer")


@dataclass(frozen=True, slots=True)
class Decision:
    """The word, what it cannot be told from, the shares of belief, and how thin it is.

    ``both``: the parts of the group have their own lines each, and can be told apart: all may be damaged.
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
    best = max(candidates, key=weight.__getitem__)
    rivals = [weight[best] / weight[part] for part in candidates if part != best]
    margin = min([passed[best], *rivals])
    besides = [part for part in PARTS if part != best and _damaged_besides(part, evidence, passed, rules)]
    weight |= {part: weight_of(part, evidence[part], rules) for part in besides}
    belief = {rest: 1.0 - fault} | _shares(weight, fault)
    if besides and passed[best] >= rules.both_factor:
        # Of two damaged parts each may leave lines where the third is looked for.
        second = max(besides, key=weight.__getitem__)
        return Decision(best, (best, second), belief, margin, both=True)
    group = tuple(part for part in candidates if weight[part] * rules.group_factor >= weight[best])
    open_race = all(race in group for race in RACES)
    return Decision("inner_or_outer" if open_race else best, group, belief, margin)


def _damaged_besides(
    part: Part, evidence: Mapping[Part, PartEvidence], passed: Mapping[Part, float], rules: RaceRules
) -> bool:
    """Whether a part that is not the foremost has lines that the foremost one does not explain."""
    if part != "ball":
        return passed[part] >= rules.both_factor
    # A race's strikes make those of the ball small against the rest of the envelope, and no less regular.
    return passed[part] >= rules.beside_ball_factor and evidence[part].z >= rules.beside_ball_z


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
    return rules.regular_least_damage if any(e.z >= rules.regular_z for e in evidence.values()) else 0.0


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
        # Squared: between transients and strikes this ratio spans far less than the others do.
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
NOTE_UNCERTAINTY, REPAIR_UNCERTAINTY = 0.01, 0.1
"""Of each thing that weakens the test, and of each kind of defect of its samples: a convention."""
MOST_UNCERTAINTY = 0.5


def less_confident(
    probability: Mapping[str, float], notes: int, repairs: int, lost: float
) -> dict[str, float]:
    """Shares of belief in which "normal" gives to the parts what was perhaps not seen.

    Args:
        probability: share of belief per word, by the evidence alone.
        notes: number of other things that weaken the test.
        repairs: kinds of defects that were put right.
        lost: share of the record in which nothing could be seen.
    """
    uncertainty = min(NOTE_UNCERTAINTY * notes + REPAIR_UNCERTAINTY * repairs + lost, MOST_UNCERTAINTY)
    shares = dict(probability)
    normal_share = uncertainty * shares.get("normal", 0.0)
    if normal_share > 0.0:
        shares["normal"] -= normal_share
        for part in PARTS:
            shares[part] = shares.get(part, 0.0) + normal_share / len(PARTS)
    return shares


SHARED_UNCERTAINTY = 0.3
"""Of a part whose order a gear seems to have, too: a convention."""


def shared_belief(probability: Mapping[str, float], part: str) -> dict[str, float]:
    """Shares of belief in which a part gives to "normal" what a gear may have made.

    Args:
        probability: share of belief per word.
        part: whose lines a gear may have made.
    """
    given = SHARED_UNCERTAINTY * probability.get(part, 0.0)
    return dict(probability) | {
        part: probability.get(part, 0.0) - given,
        "normal": probability.get("normal", 0.0) + given,
    }
