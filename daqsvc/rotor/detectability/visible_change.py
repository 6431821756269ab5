"""When a change is seen, and the smallest change of each kind of fault that is.

The mean path of the evidence passes a threshold later than half of the real ones do: they climb with
noise of their own, about five nats at a threshold of 16, and need to touch it only once. So the
distribution of the CUSUM is carried forward over a grid, reflected at 0 and absorbed at the threshold.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from daqsvc.rotor.detectability.evidence import growth_after, orbit_noise, steady_growth

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.detectability.evidence import Axis, Growth
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
VECTOR_THRESHOLD_NATS = 20.0
"""Departure test of the synchronous vector: about one false alarm in 10,000 revolutions."""
_VECTOR_FLOOR = 0.002
"""Part of |1X| that the synchronous vector's baseline is never believed better than."""
_LOG_TOLERANCE = 0.005


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


_MILDEST = 1e-4
_KINDS = (
    _Kind("unbalance", lambda _, x: 1.0 + x, lambda r, x: replace(r, e=r.e * (1.0 + x)), 30.0),
    _Kind(
        "damping_loss",
        lambda r, x: r.zeta * (1.0 - x),
        lambda r, x: replace(r, zeta=r.zeta * (1.0 - x)),
        0.98,
    ),
    _Kind("stiffness_loss", lambda _, x: 1.0 - x, lambda r, x: replace(r, k=r.k * (1.0 - x)), 0.98),
    _Kind("static_load", lambda _, x: x, lambda r, x: replace(r, g=r.g + r.k * x), 3.0),
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
    patience. The orbit's own noise is not white and adds what it has at rest and at 1X.
    """
    rotor = before.rotor
    w, revolution = rotor.w, 2.0 * math.pi / abs(rotor.w)
    white = 2.0 * before.noise**2 * before.duration / revolution
    variance = white + orbit_noise(rotor, before.process_noise, w) / revolution
    variance = variance / calibration_rev + (_VECTOR_FLOOR * abs(rotor.orbit())) ** 2
    moved = np.array([changed.rest - rotor.rest, changed.orbit() - rotor.orbit()])
    return float(np.sum(np.abs(moved) ** 2 / variance))
