"""What a rotor's bank can tell apart on this machine, and how soon: known before anything breaks.

Between linear modes every figure is computed (`evidence`); where a mode rubs it is simulated with fixed
seeds (`rub_evidence`) and marked so. Evidence is counted in nats, natural logarithms of likelihood
ratios: 3 nats are odds of 20 to 1, 16 nats of nine million to one.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.detectability.evidence import Axis, Observation
from daqsvc.rotor.detectability.rub_evidence import simulate_rubs
from daqsvc.rotor.detectability.visible_change import FAULTS, delay_samples, smallest_changes

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.detectability.rub_evidence import RubPair
    from daqsvc.rotor.detectability.visible_change import Fault, SmallestChange
    from daqsvc.rotor.discretise import BankMode

    Floats = NDArray[np.float64]

AMBIGUOUS_NATS_PER_REV = 0.1
"""Below this the evidence of a hundred revolutions is no more than a doubt: two modes look the same."""
OPEN_NATS_PER_REV = 1.0
"""From here on two modes are told apart within tens of revolutions."""

_SPEED_RANGE = 0.3
_SPEED_STEP = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class PairEvidence:
    """How well the truth stands out against one rival.

    Attributes:
        truth: name of the mode that the machine is in.
        rival: name of the other mode.
        nats_per_rev: expected evidence of the truth over the rival in a revolution, steady state.
        delay_rev: revolutions in which half of all abrupt changes from the rival to the truth have gathered a
            threshold of evidence; infinite if they never do, or if the two look the same.
        threshold_nats: that threshold.
        simulated: whether these two figures are from simulated runs or computed.
    """

    truth: str
    rival: str
    nats_per_rev: float
    delay_rev: float
    threshold_nats: float
    simulated: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Ambiguity:
    """Two modes that look the same at this speed.

    Attributes:
        modes: their names.
        nats_per_rev: the weaker of the two directions of evidence.
        opens_at_w: nearest normalised speed within 30 % that tells them apart; None if there is none, or
            if one of them rubs and no other speed was simulated.
        open_nats_per_rev: the weaker direction there.
    """

    modes: tuple[str, str]
    nats_per_rev: float
    opens_at_w: float | None
    open_nats_per_rev: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Detectability:
    """What a bank can tell apart at one speed and noise.

    Attributes:
        modes: names of the modes, healthiest first.
        w: normalised speed.
        samples_per_rev: samples in a revolution.
        noise: standard deviation of the measured position, in clearances.
        process_noise: power spectral density q that the machine is taken to shake with, normalised.
        pairs: every ordered pair of modes.
        ambiguities: pairs that look the same at this speed.
        smallest: the smallest visible change of each kind of fault asked for, from the healthy mode.
        within_rev: the delay that `SmallestChange.by_bank` is for, revolutions.
        calibration_rev: revolutions that the synchronous vector's baseline is taken from.
        false_alarms_per_1000_rev: bound on the false alarms of the healthy mode: a CUSUM of log-likelihood
            ratios passes h nats by chance at most once in exp(h) samples (Lorden 1971), for each rival.
        touching: names of the modes without rub whose orbits nevertheless reach the housing.
    """

    modes: tuple[str, ...]
    w: float
    samples_per_rev: float
    noise: float
    process_noise: float
    pairs: tuple[PairEvidence, ...]
    ambiguities: tuple[Ambiguity, ...]
    smallest: tuple[SmallestChange, ...]
    within_rev: float
    calibration_rev: float
    false_alarms_per_1000_rev: float
    touching: tuple[str, ...]

    def pair(self, truth: str, rival: str) -> PairEvidence:
        """The figures of one ordered pair.

        Raises:
            KeyError: there are no such modes, or they are the same.
        """
        for pair in self.pairs:
            if (pair.truth, pair.rival) == (truth, rival):
                return pair
        raise KeyError(f"no pair of {truth!r} and {rival!r}; the modes are {', '.join(self.modes)}")


def detectability(
    modes: Sequence[BankMode],
    *,
    noise: float,
    duration: float,
    threshold_nats: float | Floats,
    variance_factor: float = 1.0,
    process_noise: float | None = None,
    ac_coupled: bool = False,
    within_rev: float = 100.0,
    calibration_rev: float = 50.0,
    faults: Sequence[Fault] = FAULTS,
    seed: int = 0,
) -> Detectability:
    """What a bank can tell apart, and how soon.

    The delay counts the transient: a change shows only as the orbits drift apart, so that the evidence grows
    with the third power of time first. It is that of one mode against the other; the bank names the mode
    when it also leads all the rest.

    Args:
        modes: the hypotheses, healthiest first; the first one's speed is everybody's.
        noise: standard deviation of the measured position, in clearances.
        duration: normalised time between samples, omega_s dt.
        threshold_nats: evidence that changes the decision: one figure, or float64 ``[M, M]`` from the
            row's mode to the column's, as `DecisionRules.thresholds` gives it.
        variance_factor: how much larger the bank takes the variance of its innovations to be.
        process_noise: power spectral density q of the machine's own acceleration noise, normalised; that
            of the healthy mode's observer if not given, which is mostly more than a machine has.
        ac_coupled: whether the probes show no static position, so that a static load cannot be seen.
        within_rev: delay for which the smallest visible change is computed, revolutions.
        calibration_rev: revolutions of the synchronous vector's baseline.
        faults: kinds of fault to look for the smallest visible change of.
        seed: seed of the simulated runs of modes that rub.

    Raises:
        ValueError: figures that cannot make a bank.
    """
    w = modes[0].rotor.w if modes else 0.0
    if w == 0.0 or len(modes) < 2 or modes[0].rub:
        raise ValueError(
            "detectability: there must be two modes or more, a healthy one first, on a turning shaft"
        )
    q = modes[0].process_noise if process_noise is None else process_noise
    per_rev = 2.0 * math.pi / (abs(w) * duration)

    def axis(mode: BankMode) -> Axis:
        return Axis(mode, noise=noise, duration=duration, process_noise=q, variance_factor=variance_factor)

    axes = [axis(mode) for mode in modes]
    rubs = simulate_rubs(
        modes,
        noise=noise,
        duration=duration,
        process_noise=q,
        variance_factor=variance_factor,
        seed=seed,
    )
    rates = _steady_rates(modes, axes, rubs, per_rev)
    thresholds = np.broadcast_to(np.asarray(threshold_nats, dtype=np.float64), rates.shape)
    delays = _delays(modes, axes, rubs, thresholds, per_rev)
    ambiguities = tuple(_ambiguities(modes, axes, rates))
    names = [mode.name for mode in modes]
    for ambiguity in ambiguities:
        i, j = (names.index(name) for name in ambiguity.modes)
        delays[i, j] = delays[j, i] = math.inf
    pairs = tuple(
        PairEvidence(
            truth=modes[j].name,
            rival=modes[i].name,
            nats_per_rev=float(rates[j, i]),
            delay_rev=float(delays[j, i]),
            threshold_nats=float(thresholds[i, j]),
            simulated=modes[i].rub or modes[j].rub,
        )
        for j, i in itertools.permutations(range(len(modes)), 2)
    )
    return Detectability(
        modes=tuple(names),
        w=w,
        samples_per_rev=per_rev,
        noise=noise,
        process_noise=q,
        pairs=pairs,
        ambiguities=ambiguities,
        smallest=smallest_changes(
            modes[0],
            axis,
            threshold_nats=float(thresholds[0, 1:].max()),
            within_rev=within_rev,
            calibration_rev=calibration_rev,
            ac_coupled=ac_coupled,
            faults=faults,
        ),
        within_rev=within_rev,
        calibration_rev=calibration_rev,
        false_alarms_per_1000_rev=1000.0 * per_rev * float(np.exp(-thresholds[0, 1:]).sum()),
        touching=tuple(
            mode.name
            for mode in modes
            if not mode.rub and abs(mode.rotor.orbit()) + abs(mode.rotor.rest) >= 1.0
        ),
    )


def _linear_pairs(modes: Sequence[BankMode]) -> Iterator[tuple[int, int]]:
    """Ordered pairs of modes of which none rubs."""
    return itertools.permutations((i for i, mode in enumerate(modes) if not mode.rub), 2)


def _steady_rates(
    modes: Sequence[BankMode], axes: Sequence[Axis], rubs: Sequence[RubPair], per_rev: float
) -> Floats:
    """Steady evidence of the row's mode, the truth, over the column's, nats per revolution."""
    rates = np.zeros((len(modes), len(modes)))
    for j, i in _linear_pairs(modes):
        rates[j, i] = per_rev * _steady_rate(axes[j], axes[i], modes[0].rotor.w)
    for pair in rubs:
        rates[pair.other, pair.rub], rates[pair.rub, pair.other] = pair.nats_per_rev()
    return rates


def _steady_rate(truth: Axis, rival: Axis, w: float) -> float:
    return Observation(truth, truth).steady_log_likelihood(w) - Observation(
        truth, rival
    ).steady_log_likelihood(w)


def _delays(
    modes: Sequence[BankMode],
    axes: Sequence[Axis],
    rubs: Sequence[RubPair],
    thresholds: Floats,
    per_rev: float,
) -> Floats:
    """Revolutions from a change, column's mode to row's, until it is declared."""
    delays = np.zeros(thresholds.shape)
    for j, i in _linear_pairs(modes):
        delays[j, i] = delay_samples(axes[i], axes[j], modes[0].rotor.w, float(thresholds[i, j])) / per_rev
    for pair in rubs:
        i, j = pair.other, pair.rub
        delays[j, i] = pair.delay_to_rub_rev(float(thresholds[i, j]))
        delays[i, j] = pair.delay_from_rub_rev(float(thresholds[j, i]))
    return delays


def _ambiguities(modes: Sequence[BankMode], axes: Sequence[Axis], rates: Floats) -> list[Ambiguity]:
    found = []
    for i, j in itertools.combinations(range(len(modes)), 2):
        rubs = modes[i].rub or modes[j].rub
        w = modes[0].rotor.w
        weakest = float(min(rates[i, j], rates[j, i])) if rubs else _dependable_rate(axes[i], axes[j], w)
        if weakest >= AMBIGUOUS_NATS_PER_REV:
            continue
        opening = None if rubs else _opening(axes[i], axes[j])
        found.append(
            Ambiguity(
                modes=(modes[i].name, modes[j].name),
                nats_per_rev=weakest,
                opens_at_w=None if opening is None else opening[0],
                open_nats_per_rev=None if opening is None else opening[1],
            )
        )
    return found


def _dependable_rate(one: Axis, other: Axis, w: float) -> float:
    """Evidence between two modes that holds in either direction and however the machine shakes, nats/rev.

    Modes whose orbits are the same still differ in how they answer to process noise. How much of that a
    machine has is a guess, so that evidence from it can point to either of them.
    """
    per_rev = 2.0 * math.pi / abs(w) / one.duration
    directions = ((one, other), (other, one))
    orbits = min(Observation(truth, rival).steady_misfit(w) for truth, rival in directions)
    return per_rev * min(orbits, *(_steady_rate(truth, rival, w) for truth, rival in directions))


def _opening(one: Axis, other: Axis) -> tuple[float, float] | None:
    """Nearest speed at which two modes are told apart, and the evidence there, nats per revolution."""
    w = one.rotor.w
    for step in range(1, round(_SPEED_RANGE / _SPEED_STEP) + 1):
        speeds = (w * (1.0 - step * _SPEED_STEP), w * (1.0 + step * _SPEED_STEP))
        nats_per_rev, speed = max((_dependable_rate(one, other, speed), speed) for speed in speeds)
        if nats_per_rev >= OPEN_NATS_PER_REV:
            return speed, nats_per_rev
    return None
