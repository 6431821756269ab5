"""What a rotor's bank can tell apart on this machine, and how soon: known before anything breaks.

Between linear modes every figure is computed. Where a mode rubs, it is simulated with fixed seeds and
marked so (`evidence`). Evidence is counted in nats, natural logarithms of likelihood ratios: 3 nats are
odds of 20 to 1, 16 nats of nine million to one.

The mean path of the evidence passes a threshold later than half of the real ones do. They climb with noise,
about five nats at a threshold of 16, and need to touch it only once. So the distribution of the CUSUM is
carried forward over a grid, reflected at 0 and absorbed at the threshold.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from daqsvc.rotor.coupled import growth
from daqsvc.rotor.detectability.coupled import CoupledBank, evidence_of
from daqsvc.rotor.detectability.evidence import (
    Axis,
    Observation,
    growth_after,
    orbit_noise,
    simulate_rubs,
    steady_growth,
)
from daqsvc.rotor.misfit import differs_from
from daqsvc.rotor.synchronous.departure import threshold_for

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.detectability.evidence import Growth, RubPair
    from daqsvc.rotor.discretise import BankMode
    from daqsvc.rotor.model import NormalisedRotor

    Floats = NDArray[np.float64]


_STEP_SPREAD = 0.25
"""Samples are taken together until the variance of their evidence is this much, nats squared."""
_FINEST_CELL = 0.15
_MOST_CELLS = 400
_STEPS_BEFORE = 64
_MOST_STEPS = 4000
_DECAYED = 8.0
"""A transient is over when it has fallen by exp(-8)."""
_LONGEST_TRANSIENT = 400_000


def delay_samples(before: Axis, after: Axis, w: float, threshold_nats: float, quantile: float = 0.5) -> float:
    """Samples from an abrupt change until the CUSUM of its evidence passes a threshold.

    Args:
        before: the mode that the machine was in for long.
        after: the mode that it changed to.
        w: normalised shaft speed.
        threshold_nats: the threshold.
        quantile: part of all changes that are past the threshold by then, in (0, 1).

    Returns:
        Samples after the change; infinite if the evidence does not lead to the threshold.
    """
    cusum = _Cusum(threshold_nats)
    quiet = _steps_of(steady_growth(before, after, before, w))
    for samples, drift, spread in itertools.islice(quiet, _STEPS_BEFORE):
        cusum.advance(samples * drift, samples * spread)
    cusum.forget_alarms()
    # The slowest of both modes rules the transient.
    transient = min(_LONGEST_TRANSIENT, math.ceil(_DECAYED / min(before.decay, after.decay)))
    growing = _changing_steps(growth_after(before, after, w, transient))
    lasting = steady_growth(after, after, before, w)
    steady = _steps_of(lasting) if lasting.drift[0] > 0.0 else ()
    time = passed = 0.0
    for samples, drift, spread in itertools.islice(itertools.chain(growing, steady), _MOST_STEPS):
        before_step, passed = passed, cusum.advance(samples * drift, samples * spread)
        if passed >= quantile:
            return time + samples * (quantile - before_step) / (passed - before_step)
        time += samples
    return math.inf


class _Cusum:
    """Distribution of a CUSUM over cells from 0 to its threshold.

    Args:
        threshold_nats: the threshold.
    """

    def __init__(self, threshold_nats: float) -> None:
        count = min(_MOST_CELLS, max(100, math.ceil(threshold_nats / _FINEST_CELL)))
        self._weight = np.zeros(count)
        self._weight[0] = 1.0
        # Cells are centred on their values, and the last one ends at the threshold.
        cell = threshold_nats / (count - 0.5)
        self._edges = (np.arange(1 - count, count + 1) - 0.5) * cell
        self._passed = 0.0
        self._step = (math.nan, math.nan)
        self._moves = self._exits = self._weight

    def forget_alarms(self) -> None:
        """Keep to the runs that have not passed yet."""
        self._weight /= self._weight.sum()
        self._passed = 0.0

    def advance(self, drift: float, spread: float) -> float:
        """One step by a normal increment of that mean and variance; the part of all runs that has passed."""
        if self._step != (drift, spread):
            self._step = (drift, spread)
            below = ndtr((self._edges - drift) / math.sqrt(max(spread, 1e-12)))
            self._moves = below[1:] - below[:-1]
            self._exits = 1.0 - below[: len(self._weight) - 1 : -1]
        count = len(self._weight)
        moved = np.convolve(self._weight, self._moves)[count - 1 : 2 * count - 1]
        self._passed += float(self._weight @ self._exits)
        moved[0] = max(0.0, 1.0 - self._passed - float(moved[1:].sum()))
        self._weight = moved
        return self._passed


def _steps_of(growth: Growth) -> Iterator[tuple[int, float, float]]:
    """Samples taken together, and drift and spread of each, again and again; none if nothing drives it."""
    drift, spread = float(growth.drift[0]), float(growth.spread[0])
    if spread > 0.0:
        samples = max(1, math.floor(_STEP_SPREAD / spread))
        yield from itertools.repeat((samples, drift, spread))


def _changing_steps(growth: Growth) -> Iterator[tuple[int, float, float]]:
    """Samples taken together, and the mean drift and spread of each."""
    bins = np.floor(np.cumsum(growth.spread) / _STEP_SPREAD)
    begins = np.flatnonzero(np.diff(bins, prepend=-1.0))
    samples = np.diff(begins, append=len(bins))
    drift = np.add.reduceat(growth.drift, begins) / samples
    spread = np.add.reduceat(growth.spread, begins) / samples
    yield from zip(samples.tolist(), drift.tolist(), spread.tolist(), strict=True)


Fault = Literal["unbalance", "damping_loss", "stiffness_loss", "static_load"]

FAULTS: tuple[Fault, ...] = ("unbalance", "damping_loss", "stiffness_loss", "static_load")
VECTOR_THRESHOLD_NATS = threshold_for(0.1)
"""Departure test of the synchronous vector, for one false alarm in 10,000 revolutions."""
_VECTOR_FLOOR = 0.002
"""Part of |1X| that the synchronous vector's baseline is never taken to be better than."""
_LOG_TOLERANCE = 0.005
_BEYOND_DOUBT = 1e12
"""Criterion of a change that nobody misses."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SmallestChange:
    """The smallest change of one kind that can be seen.

    Attributes:
        fault: the kind: ``unbalance`` (eccentricity over the healthy one), ``damping_loss`` (damping
            ratio), ``stiffness_loss`` (stiffness over the healthy one), ``static_load`` (further sag, in
            clearances).
        healthy: the quantity of the healthy machine.
        by_bank: the quantity that a matching mode of the bank finds in the stated delay; None: it never does.
        by_vector: the quantity that the synchronous vector finds, however long it may take; None: never.
    """

    fault: Fault
    healthy: float
    by_bank: float | None
    by_vector: float | None


@dataclass(frozen=True, slots=True)
class _Kind:
    """A kind of fault: its quantity and the rotor with it, by severity from 0, and the worst severity."""

    fault: Fault
    quantity: Callable[[NormalisedRotor, float], float]
    rotor: Callable[[NormalisedRotor, float], NormalisedRotor]
    worst: float


def _loaded(rotor: NormalisedRotor, sag: float) -> NormalisedRotor:
    load = rotor.load_for(complex(0.0, -sag))
    return replace(rotor, load_x=rotor.load_x + load.real, g=rotor.g - load.imag)


_MILDEST = 1e-4
_KINDS = (
    _Kind("unbalance", lambda _, x: 1.0 + x, lambda r, x: replace(r, e=r.e * (1.0 + x)), 30.0),
    _Kind(
        "damping_loss",
        lambda r, x: r.zeta * (1.0 - x),
        lambda r, x: replace(r, zeta=r.zeta * (1.0 - x), damping_anisotropy=r.damping_anisotropy * (1.0 - x)),
        0.98,
    ),
    _Kind(
        "stiffness_loss",
        lambda _, x: 1.0 - x,
        lambda r, x: replace(
            r,
            k=r.k * (1.0 - x),
            cross_stiffness=r.cross_stiffness * (1.0 - x),
            anisotropy=r.anisotropy * (1.0 - x),
        ),
        0.98,
    ),
    _Kind("static_load", lambda _, x: x, _loaded, 3.0),
)


def smallest_changes(
    healthy: BankMode,
    axis: Callable[[BankMode], Axis],
    *,
    threshold_nats: float,
    within_rev: float,
    calibration_rev: float,
    ac_coupled: bool = False,
    faults: Sequence[Fault] = FAULTS,
) -> tuple[SmallestChange, ...]:
    """The smallest visible change of every kind, at the healthy mode's speed.

    Args:
        healthy: the healthy mode.
        axis: what makes an axis of a mode, at this machine's noise and sampling.
        threshold_nats: evidence that declares a change.
        within_rev: revolutions in which half of all changes are to be declared by a matching mode.
        calibration_rev: revolutions of the synchronous vector's baseline.
        ac_coupled: whether the probes show no static position.
        faults: the kinds to look for.
    """
    before = axis(healthy)
    rotor = healthy.rotor
    needed = within_rev * 2.0 * math.pi / abs(rotor.w) / before.duration

    def haste(changed: NormalisedRotor) -> float:
        after = axis(replace(healthy, rotor=changed))
        return needed / max(1.0, delay_samples(before, after, rotor.w, threshold_nats))

    def clarity(changed: NormalisedRotor) -> float:
        return _vector_evidence(before, changed, calibration_rev) / VECTOR_THRESHOLD_NATS

    def smallest(kind: _Kind, criterion: Callable[[NormalisedRotor], float]) -> float | None:
        if ac_coupled and kind.fault == "static_load":
            return None
        severity = _mildest(lambda x: criterion(kind.rotor(rotor, x)), kind.worst)
        return None if severity is None else kind.quantity(rotor, severity)

    return tuple(
        SmallestChange(
            fault=kind.fault,
            healthy=kind.quantity(rotor, 0.0),
            by_bank=smallest(kind, haste),
            by_vector=smallest(kind, clarity),
        )
        for kind in _KINDS
        if kind.fault in faults
    )


def _mildest(criterion: Callable[[float], float], worst: float) -> float | None:
    """The severity at which a criterion passes 1; None if not even the worst one does."""

    def short_of(log_severity: float) -> float:
        # Both criteria go with the square of a small severity: a line in logarithms, all but one.
        return math.log(max(criterion(math.exp(log_severity)), 1e-12))

    mildest, worst = math.log(_MILDEST), math.log(worst)
    if short_of(worst) < 0.0:
        return None
    if short_of(mildest) >= 0.0:
        return _MILDEST
    return math.exp(float(brentq(short_of, mildest, worst, xtol=_LOG_TOLERANCE)))


def _vector_evidence(before: Axis, changed: NormalisedRotor, calibration_rev: float) -> float:
    """Evidence of a change in the synchronous vector after long enough, nats.

    With sensor noise alone this is ``nc N SNR delta^2``: the baseline's nc revolutions are the limit, not
    the time. The orbit's own noise is not white and adds what it has at rest and at 1X.
    """
    rotor = before.rotor
    w, revolution = rotor.w, 2.0 * math.pi / abs(rotor.w)
    white = 2.0 * before.noise**2 * before.duration / revolution
    variance = white + orbit_noise(rotor, before.process_noise, w) / revolution
    variance = variance / calibration_rev + (_VECTOR_FLOOR * abs(rotor.orbit())) ** 2
    moved = np.array([changed.rest - rotor.rest, changed.orbit() - rotor.orbit()])
    return float(np.sum(np.abs(moved) ** 2 / variance))


AMBIGUOUS_NATS_PER_REV = 0.1
"""Below this the evidence of a hundred revolutions is no more than a hint: two modes look the same."""
OPEN_NATS_PER_REV = 1.0
"""From here on two modes are told apart within tens of revolutions."""

_SPEED_RANGE = 0.3
_SPEED_STEP = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class PairEvidence:
    """How clearly the true mode differs from one rival.

    Attributes:
        truth: name of the mode that the machine is in.
        rival: name of the other mode.
        nats_per_rev: expected evidence of the truth over the rival in a revolution, steady state.
        delay_rev: revolutions in which half of all abrupt changes from the rival to the truth have gathered a
            threshold of evidence; infinite if they never do, or if the two are alike.
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
        opens_at_w: nearest normalised speed within 30 % that separates them; None if there is none, or
            if one of them rubs and no other speed was simulated.
        open_nats_per_rev: the weaker direction there.
        by_steady_1x: whether a bank from a run-up sees the one in its steady 1X, as a change from the other,
            the healthy mode, which its observers take for the same.
    """

    modes: tuple[str, str]
    nats_per_rev: float
    opens_at_w: float | None
    open_nats_per_rev: float | None
    by_steady_1x: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class BankDetectability:
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
) -> BankDetectability:
    """What a bank can tell apart, and how soon.

    The delay counts the transient: a change shows only as the orbits drift apart, so that the evidence grows
    with the third power of time first. It is that of one mode against the other; the bank names the mode
    when it also leads all the rest.

    Args:
        modes: the hypotheses, healthiest first; all at the speed of the first one.
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
    if not all(mode.rotor.isotropic for mode in modes):
        return _of_two_modes(
            modes,
            noise=noise,
            duration=duration,
            thresholds=np.broadcast_to(np.asarray(threshold_nats, np.float64), (len(modes), len(modes))),
            variance_factor=variance_factor,
            process_noise=q,
            ac_coupled=ac_coupled,
            within_rev=within_rev,
            calibration_rev=calibration_rev,
            faults=faults,
            seed=seed,
        )

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
    return BankDetectability(
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


def _of_two_modes(
    modes: Sequence[BankMode],
    *,
    noise: float,
    duration: float,
    thresholds: Floats,
    variance_factor: float,
    process_noise: float,
    ac_coupled: bool,
    within_rev: float,
    calibration_rev: float,
    faults: Sequence[Fault],
    seed: int,
) -> BankDetectability:
    """The same of a bank whose rotor has two modes; see `coupled`."""
    w = modes[0].rotor.w
    bank = CoupledBank(modes, noise=noise, duration=duration, variance_factor=variance_factor)
    rates, delays = bank.changes(thresholds, process_noise, seed)
    steady = bank.steady()
    rubs = np.array([mode.rub for mode in modes])
    computed = ~(rubs | rubs[:, np.newaxis])
    rates[computed] = steady[computed]
    weakest = np.minimum(rates, rates.T)
    ambiguities = []
    speeds = [w * (1.0 + sign * step * 0.02) for step in range(1, 16) for sign in (-1.0, 1.0)]
    elsewhere = [(speed, np.minimum(at, at.T)) for speed in speeds for at in (bank.steady(speed),)]
    for i, j in itertools.combinations(range(len(modes)), 2):
        if weakest[i, j] >= AMBIGUOUS_NATS_PER_REV:
            continue
        delays[i, j] = delays[j, i] = math.inf
        opens = next(
            (
                (speed, float(at[i, j]))
                for speed, at in elsewhere
                if computed[i, j] and at[i, j] >= OPEN_NATS_PER_REV
            ),
            None,
        )
        ambiguities.append(
            Ambiguity(
                modes=(modes[i].name, modes[j].name),
                nats_per_rev=float(weakest[i, j]),
                opens_at_w=opens and opens[0],
                open_nats_per_rev=opens and opens[1],
                by_steady_1x=i == 0 and not modes[j].rub and differs_from(modes[0].rotor, modes[j].rotor, w),
            )
        )

    needed = float(thresholds[0, 1:].max()) / within_rev
    per_rev = 2.0 * math.pi / (abs(w) * duration)
    rotor = modes[0].rotor
    white = 2.0 * noise**2 / per_rev
    variance = white / calibration_rev + (_VECTOR_FLOOR * abs(rotor.orbit())) ** 2

    def smallest(kind: _Kind, *, by_bank: bool) -> float | None:
        if ac_coupled and kind.fault == "static_load":
            return None

        def clarity(severity: float) -> float:
            changed = kind.rotor(rotor, severity)
            if growth(changed, w) >= 0.0:
                return _BEYOND_DOUBT  # it whirls by itself, and the more so the worse the fault is
            seen = evidence_of(
                modes[0],
                changed,
                noise=noise,
                duration=duration,
                variance_factor=variance_factor,
            )
            if by_bank:
                return seen.nats_per_rev / needed
            return sum(abs(part) ** 2 for part in seen.moved) / variance / VECTOR_THRESHOLD_NATS

        severity = _mildest(clarity, kind.worst)
        return None if severity is None else kind.quantity(rotor, severity)

    return BankDetectability(
        modes=tuple(mode.name for mode in modes),
        w=w,
        samples_per_rev=per_rev,
        noise=noise,
        process_noise=process_noise,
        pairs=tuple(
            PairEvidence(
                truth=modes[j].name,
                rival=modes[i].name,
                nats_per_rev=float(rates[j, i]),
                delay_rev=float(delays[j, i]),
                threshold_nats=float(thresholds[i, j]),
                simulated=not computed[i, j],
            )
            for j, i in itertools.permutations(range(len(modes)), 2)
        ),
        ambiguities=tuple(ambiguities),
        smallest=tuple(
            SmallestChange(
                fault=kind.fault,
                healthy=kind.quantity(rotor, 0.0),
                by_bank=smallest(kind, by_bank=True),
                by_vector=smallest(kind, by_bank=False),
            )
            for kind in _KINDS
            if kind.fault in faults
        ),
        within_rev=within_rev,
        calibration_rev=calibration_rev,
        false_alarms_per_1000_rev=1000.0 * per_rev * float(np.exp(-thresholds[0, 1:]).sum()),
        touching=tuple(
            mode.name
            for mode in modes
            if not mode.rub
            and abs(mode.rotor.orbit()) + abs(mode.rotor.backward_orbit()) + abs(mode.rotor.rest) >= 1.0
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
    ambiguities = []
    for i, j in itertools.combinations(range(len(modes)), 2):
        rubs = modes[i].rub or modes[j].rub
        w = modes[0].rotor.w
        weakest = float(min(rates[i, j], rates[j, i])) if rubs else _dependable_rate(axes[i], axes[j], w)
        if weakest >= AMBIGUOUS_NATS_PER_REV:
            continue
        opening = None if rubs else _opening(axes[i], axes[j])
        ambiguities.append(
            Ambiguity(
                modes=(modes[i].name, modes[j].name),
                nats_per_rev=weakest,
                opens_at_w=None if opening is None else opening[0],
                open_nats_per_rev=None if opening is None else opening[1],
            )
        )
    return ambiguities


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
