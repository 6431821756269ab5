"""The smallest change of each kind of fault that can be seen on this machine."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.rotor.evidence import orbit_noise
from daqsvc.rotor.passage import delay_samples

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.discretise import BankMode
    from daqsvc.rotor.evidence import Axis
    from daqsvc.rotor.model import NormalisedRotor

    Floats = NDArray[np.float64]

Fault = Literal["unbalance", "damping_loss", "stiffness_loss", "static_load"]

VECTOR_THRESHOLD_NATS = 20.0
"""Departure test of the synchronous vector: about one false alarm in 10,000 revolutions."""
_VECTOR_FLOOR = 0.002
"""Part of |1X| that the synchronous vector's baseline is never believed better than."""


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
    """A kind of fault: the rotor at a quantity, the healthy quantity, and the quantities to look at."""

    fault: Fault
    healthy: Callable[[NormalisedRotor], float]
    rotor: Callable[[NormalisedRotor, float], NormalisedRotor]
    quantities: Callable[[NormalisedRotor], Floats]


_RISE = np.geomspace(1e-4, 30.0, 30)
_LOSS = np.geomspace(1e-4, 0.98, 30)
_KINDS = (
    _Kind("unbalance", lambda _: 1.0, lambda r, x: replace(r, e=r.e * x), lambda _: 1.0 + _RISE),
    _Kind(
        "damping_loss", lambda r: r.zeta, lambda r, x: replace(r, zeta=x), lambda r: r.zeta * (1.0 - _LOSS)
    ),
    _Kind("stiffness_loss", lambda _: 1.0, lambda r, x: replace(r, k=r.k * x), lambda _: 1.0 - _LOSS),
    _Kind("static_load", lambda _: 0.0, lambda r, x: replace(r, g=r.g + r.k * x), lambda _: _RISE / 10.0),
)


def smallest_changes(
    healthy: BankMode,
    axis: Callable[[BankMode], Axis],
    *,
    threshold_nats: float,
    within_rev: float,
    calibration_rev: float,
    ac_coupled: bool = False,
) -> tuple[SmallestChange, ...]:
    """The smallest visible change of every kind, at the healthy mode's speed.

    Args:
        healthy: the healthy mode.
        axis: what makes an axis of a mode, at this machine's noise and sampling.
        threshold_nats: evidence that declares a change.
        within_rev: revolutions in which half of all changes are to be declared by a matching mode.
        calibration_rev: revolutions of the synchronous vector's baseline.
        ac_coupled: whether the probes show no static position.
    """
    before = axis(healthy)
    rotor = healthy.rotor
    needed = within_rev * 2.0 * math.pi / abs(rotor.w) / before.duration
    found = []
    for kind in _KINDS:
        if ac_coupled and kind.fault == "static_load":
            found.append(SmallestChange(fault=kind.fault, healthy=0.0, by_bank=None, by_vector=None))
            continue
        quantities, normal = kind.quantities(rotor), kind.healthy(rotor)
        changed = [kind.rotor(rotor, float(quantity)) for quantity in quantities]
        afters = [axis(replace(healthy, rotor=candidate)) for candidate in changed]
        delays = [delay_samples(before, after, rotor.w, threshold_nats) for after in afters]
        haste = needed / np.maximum(delays, 1.0)
        evidence = _vector_evidence(before, changed, calibration_rev)
        found.append(
            SmallestChange(
                fault=kind.fault,
                healthy=normal,
                by_bank=_first_crossing(quantities, haste, normal),
                by_vector=_first_crossing(quantities, evidence / VECTOR_THRESHOLD_NATS, normal),
            )
        )
    return tuple(found)


def _vector_evidence(before: Axis, changed: Sequence[NormalisedRotor], calibration_rev: float) -> Floats:
    """Evidence of changes in the synchronous vector after long enough, float64 ``[len(changed)]``, nats.

    With sensor noise alone this is ``nc N SNR delta^2``: the baseline's nc revolutions are the limit, not
    patience. The orbit's own noise is not white and adds what it has at rest and at 1X.
    """
    rotor = before.rotor
    w, revolution = rotor.w, 2.0 * math.pi / abs(rotor.w)
    white = 2.0 * before.noise**2 * before.duration / revolution
    variance = white + orbit_noise(rotor, before.process_noise, w) / revolution
    variance = variance / calibration_rev + (_VECTOR_FLOOR * abs(rotor.orbit())) ** 2
    moved = np.array([(r.rest - rotor.rest, r.orbit() - rotor.orbit()) for r in changed])
    return np.asarray(np.sum(np.abs(moved) ** 2 / variance, axis=1), dtype=np.float64)


def _first_crossing(quantities: Floats, ratios: Floats, healthy: float) -> float | None:
    """The quantity nearest the healthy one where a ratio passes 1, between two of a grid in logarithms."""
    if not (above := ratios >= 1.0).any():
        return None
    first = int(above.argmax())
    if first == 0 or ratios[first - 1] <= 0.0:
        return float(quantities[first])
    distance = np.log(np.abs(quantities[first - 1 : first + 1] - healthy))
    height = np.log(ratios[first - 1 : first + 1])
    step = math.exp(float(np.interp(0.0, height, distance)))
    return healthy + math.copysign(step, float(quantities[first]) - healthy)
