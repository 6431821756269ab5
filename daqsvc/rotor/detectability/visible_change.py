"""The smallest change of each kind of fault that can be seen on this machine."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.optimize import brentq

from daqsvc.rotor.detectability.evidence import orbit_noise
from daqsvc.rotor.detectability.passage import delay_samples

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from daqsvc.rotor.detectability.evidence import Axis
    from daqsvc.rotor.discretise import BankMode
    from daqsvc.rotor.model import NormalisedRotor

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
