"""What speaks for damage of each part: its comb's significance and its lines' size, in two envelopes.

Lines of one part at the stated speed are those of another part at another speed: which speed is true is
asked at the end (`refuse_rivals`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.race.combs import best_comb, fundamental, part_lines
from daqsvc.bearing.race.decision import weight_of
from daqsvc.bearing.race.lines import (
    REVOLUTIONS,
    LineEvidence,
    ModulationDepth,
    false_alarm_probability,
    line_evidence,
    sharpest,
    significance,
)
from daqsvc.bearing.race.verdict import PARTS, PLACES, Part, PartEvidence
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.speed.harmonics import REMEDY

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.geometry import BearingOrders
    from daqsvc.bearing.race.rules import RaceRules
    from daqsvc.dsp.speed.harmonics import ShaftRate

    Real = NDArray[np.float64]
    from collections.abc import Mapping


SHARPEN_SHARE = 0.01
"""How far the deepest lines may be from the most significant comb, as a share."""
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


def view_of(phases: Real, sizes: Real, revolutions: float) -> EnvelopeView:
    """Look at an envelope's spectrum.

    Args:
        phases: line power of the band with unit amplitudes, ``[bins]``.
        sizes: that of the band with clipped amplitudes, ``[bins]``.
        revolutions: of the shaft in the record: bins per order.
    """
    lines = line_evidence(phases, revolutions)
    return EnvelopeView(lines, ModulationDepth(sizes, lines.notched, revolutions), sizes)


class Scales:
    """Weighs the parts of a bearing.

    Args:
        square: view of the squared envelope.
        log: view of its logarithm. What fools the one does not fool the other: a few hard knocks are nothing
            to the logarithm, a faint steady modulation nothing to the square.
        bearing: fault orders.
        shaft: rate of the shaft.
        revolutions: of the shaft in the record.
        rules: settings of the test.
    """

    def __init__(
        self,
        square: EnvelopeView,
        log: EnvelopeView,
        bearing: BearingOrders,
        shaft: ShaftRate,
        revolutions: float,
        rules: RaceRules,
    ) -> None:
        self._square = square
        self._log = log
        self._bearing = bearing
        self._revolutions = revolutions
        self._rules = rules
        # A speed that is not known sharply shifts every line: the search grows by that, and is paid for.
        self._slip = rules.slip if shaft.sharp else rules.slip + rules.speed_tolerance
        self._seen = shaft.seen
        self._elsewhere = shaft.elsewhere
        self._caution = 1.0 if shaft.seen else rules.unseen_caution

    def weigh(self) -> dict[Part, PartEvidence]:
        """Evidence for all parts; lines that the foremost part explains do not speak for another one."""
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
        """Evidence for a part without the lines at some orders."""
        rules = self._rules
        looks = [view.without(explained) if explained else view for view in (self._square, self._log)]
        order = fundamental(self._bearing, part)
        gap = abs(order - round(order))
        comb = best_comb([look.lines for look in looks], self._bearing, part, self._slip)
        z = significance(comb.score, part, self._revolutions, self._slip)
        # Never across a harmonic of the shaft: what lies beyond it is not this part.
        reach = min(SHARPEN_SHARE, 0.5 * gap / order)
        depths = [look.depth for look in looks]
        found = sharpest(depths, comb.order, reach, self._revolutions)
        by_square, by_log = (float(depth.comb(np.array([found]))[0]) for depth in depths)
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
            order=found,
        )
        away = gap * self._revolutions
        if away < rules.unresolved_bins:
            e = replace(e, z_limit=rules.z_limit + rules.z_unresolved)
        harmonic = round(found)
        if abs(found - harmonic) <= rules.smear_share * found:
            mirrored = min(depth.mirrored(found) for depth in depths)
            if mirrored >= rules.smear_mirrored and z >= rules.z_limit:
                e = replace(e, testable=False, reason=_smeared(part, found))
        if part == "ball":
            # A ball's marks come and go with its own tumbling: its lines are too weak for the logarithm.
            e = replace(e, depth=by_square, severity=max(z, 0.0) * by_square)
            caution = 1.0 if self._seen else rules.unseen_ball_caution
            if self._elsewhere:
                caution = rules.elsewhere_ball_caution
            e = replace(e, limit=caution * rules.ball_severity_limit, steadiness_limit=0.0)
            if away < rules.ball_testable_bins:
                e = replace(e, testable=False, reason=_why_not(order, gap, rules))
        return e


def _smeared(part: Part, order: float) -> str:
    """Why a part is not testable beside a smeared harmonic of the shaft."""
    return (
        f"its lines at order {order:.3f} stand on both sides of {round(order)}X, as the shaft makes them "
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
    """Refuse to name a part that only a doubtful speed makes of these lines.

    Harmonics may be too few to confirm the stated speed, and yet more of them may speak for the speed at
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
