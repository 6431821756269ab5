"""Which fault a change is: the name, the group, or that it is none of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.signatures import RotorFault, likelihoods

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.rotor.synchronous.transient import Comparison

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

_GENERIC_RUB_MARGIN_NATS = 12.0
_ENERGY_NATS = 12.0
_MOST_ENERGY_NATS = 100.0
_RIVALS = frozenset(("rub", "unmodelled"))


@dataclass(frozen=True, slots=True, kw_only=True)
class NamingRules:
    """Margins of a name.

    Attributes:
        margin_nats: lead over every other hypothesis that a name takes: odds of 150 to 1.
        rub_margin_nats: lead of rub over "unmodelled": a crack at half speed looks much like a rub.
        least_severity: part of the healthy whirl below which a change is small and gets no name.
    """

    margin_nats: float = 5.0
    rub_margin_nats: float = 5.0
    least_severity: float = 0.05


@dataclass(frozen=True, slots=True)
class Energy:
    """What the non-harmonic energy says of a segment.

    Attributes:
        excess: variance of the complex residual of a sample above the healthy one, um^2.
        nats: evidence that it is more than chance.
    """

    excess: float = 0.0
    nats: float = 0.0


@dataclass(frozen=True, slots=True)
class Identification:
    """What a change of the synchronous vector is.

    Attributes:
        verdict: the name, or the most likely member of the group.
        group: all that cannot be told apart, the most likely first; the verdict alone if it stands alone.
        named: whether two looks in a row agreed on the group.
        evidence: nats of every hypothesis over "normal".
        probabilities: posterior of every verdict, hypotheses equally likely before.
        change: complex128 ``[5]``, d in um.
        severity: size of the change, its non-harmonic energy included, over the healthy whirl's amplitude.
        excess: variance of a complex sample that does not repeat with the shaft, above the healthy one, um^2.
        candidates: verdict and group of this look alone.
    """

    verdict: RotorFault
    group: tuple[RotorFault, ...]
    named: bool
    evidence: Mapping[RotorFault, float]
    probabilities: Mapping[RotorFault, float]
    change: Complexes
    severity: float
    candidates: tuple[RotorFault, ...] = field(default=())
    excess: float = 0.0


def identify(
    change: Complexes,
    variance: Floats,
    healthy: Calibration,
    *,
    previous: Identification | None,
    rules: NamingRules,
    may_name: bool = True,
    comparison: Comparison | None = None,
    energy: Energy | None = None,
) -> Identification:
    """Weigh the hypotheses.

    Args:
        change: complex128 ``[5]``, mean synchronous vector of the present segment less the baseline, um.
        variance: float64 ``[5]``, its variance, um^2.
        healthy: the baseline.
        previous: the look before; a name takes two that agree.
        rules: margins.
        may_name: whether the rotor has settled enough for a name.
        comparison: what the transient says of unbalance and loss of damping, if it was abrupt.
        energy: of the present segment; motion that does not repeat with the shaft (whirl, repeated
            impacts) is what no linear fault makes.
    """
    scores = likelihoods(change, variance, healthy.healthy, healthy.baseline + change)
    told = comparison is not None and comparison.holds(complex(change[1]))
    if comparison is not None and told:
        scores["damping_loss"] += min(0.0, comparison.damping_nats)
        scores["unbalance"] += min(0.0, -comparison.damping_nats)
    amplitude = healthy.healthy.amplitude_um
    square = float(np.sum(np.abs(change) ** 2))
    if (
        energy is not None
        and energy.nats > _ENERGY_NATS
        and energy.excess > (rules.least_severity * amplitude) ** 2
    ):
        square += energy.excess
        unexplained = min(energy.nats, _MOST_ENERGY_NATS)
        # A rub shakes the rotor besides; but what leaves no mark of a rub on the vector is noise or whirl.
        explained = {"unmodelled"} if scores["rub"] < rules.margin_nats else {"unmodelled", "rub"}
        for name in scores.keys() - explained:
            scores[name] -= unexplained
    size = math.sqrt(square)
    # The typical component: that of the mean position may be drift of the probes, or not there at all.
    deviation = math.sqrt(float(np.median(variance)))
    best = max(scores, key=lambda name: scores[name])
    probabilities = _posterior(scores)
    candidates: tuple[RotorFault, ...]
    if best != "normal" and size < rules.least_severity * amplitude + 2.0 * deviation:
        candidates = ("small_change",)
        probabilities = {"normal": probabilities["normal"], "small_change": 1.0 - probabilities["normal"]}
    else:
        candidates = _group(scores, best, healthy, rules)
    agreed = previous is not None and (
        set(previous.candidates) == set(candidates) or (told and set(candidates) < set(previous.candidates))
    )
    # That the machine may be healthy again is for the watch to decide; until then a name stands.
    named = may_name and agreed and "normal" not in candidates
    group = candidates
    if previous is not None and previous.named and not named:
        # One look does not take a name away.
        group = previous.group
        named = True
    return Identification(
        verdict=group[0],
        group=group,
        named=named,
        evidence=scores,
        probabilities=probabilities,
        change=change,
        severity=size / max(amplitude, 1e-12),
        candidates=candidates,
        excess=energy.excess if energy is not None and energy.nats > _ENERGY_NATS else 0.0,
    )


def _group(
    scores: Mapping[RotorFault, float], best: RotorFault, healthy: Calibration, rules: NamingRules
) -> tuple[RotorFault, ...]:
    """All hypotheses within the margin of the best one, the best first."""
    # Without a Laval rotor any change of both senses of 1X would be a loss of damping.
    alone = best == "damping_loss" and scores[best] - scores["unbalance"] > rules.margin_nats

    def margin(name: RotorFault) -> float:
        if name == "unmodelled" and alone and not healthy.laval:
            return math.inf
        if {name, best} == _RIVALS:
            return rules.rub_margin_nats if healthy.laval else _GENERIC_RUB_MARGIN_NATS
        return rules.margin_nats

    close = [name for name in scores if scores[best] - scores[name] < margin(name)]
    if "normal" in close and best != "normal":
        close.remove("normal")
    return tuple(sorted(close, key=lambda name: -scores[name]))


def _posterior(scores: Mapping[RotorFault, float]) -> dict[RotorFault, float]:
    top = max(scores.values())
    weights = {name: math.exp(score - top) for name, score in scores.items()}
    total = math.fsum(weights.values())
    return {name: weight / total for name, weight in weights.items()}
