"""What a change of 1X to 3X between two recordings comes of, without a phase and a model of the rotor.

Unbalance acts at 1X; what its 2X and 3X add comes of supports that are not quite linear, and stays a part of
the 1X. Any other cause may move each order by itself. Sizes are not known: they are integrated over.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from daqsvc.dsp.speed.lines import ORDERS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]
    Complexes: TypeAlias = NDArray[np.complex128]

Cause = Literal["unbalance", "damping_loss", "unmodelled"]

_SCALES = 2.0 ** np.arange(-3, 7)
"""How large a change may be, as multiples of the healthy level: integrated over."""
_HARMONIC_SHARES = (0.0, 0.02, 0.1, 0.3, 0.6)
"""2X and 3X that unbalance brings along, over its 1X, as velocity: integrated over."""
_OPEN_NATS = -6.0
"""An unmodelled change explains everything; it must explain it better by so much."""


def surprise(change: Complexes, variance: Floats, freedom: Floats) -> Floats:
    """-ln of the probability of a larger change by chance: Exp(1) of an unchanged component.

    |change|^2 / variance is F with 2 and 2 nu degrees of freedom, and its survival a power.
    """
    return np.asarray(freedom * np.log1p(np.abs(change) ** 2 / (freedom * variance)))


def cause_evidence(
    change: Complexes, variance: Floats, freedom: Floats, level: float, *, growing: bool
) -> dict[Cause, float]:
    """Log marginal likelihood of the causes over "normal", amplitudes integrated over.

    Args:
        change: complex128 ``[3, channels]``, as velocity.
        variance: of it.
        freedom: complex degrees of freedom of the variance.
        level: length of the healthy vector, as velocity.
        growing: whether 1X is longer now.
    """

    def gain(order: int, sizes: Floats) -> Floats:
        """Nats of a change of this order that is CN(0, size^2), for each size."""
        power, noise = np.abs(change[order]) ** 2, variance[order]
        total = noise + sizes[:, np.newaxis] ** 2
        normal = (1.0 + 1.0 / freedom[order]) * surprise(change[order], noise, freedom[order])
        return np.asarray((normal - power / total - np.log(total / noise)).sum(axis=1))

    sizes: Floats = np.asarray(_SCALES * level, dtype=np.float64)
    unbalance = 0.0
    if growing:
        terms = [
            gain(0, sizes) + sum((gain(order, share * sizes) for order in (1, 2)), np.zeros(len(sizes)))
            for share in _HARMONIC_SHARES
        ]
        unbalance = _log_mean(np.concatenate(terms))
    alone = [_log_mean(gain(order, sizes)) for order in range(len(ORDERS))]
    # 1X that grows alone is what unbalance does: no need of an unknown cause.
    subsets = [
        sum(alone[row] for row in rows)
        for count in range(1, len(ORDERS) + 1)
        for rows in itertools.combinations(range(len(ORDERS)), count)
        if not (growing and rows == (0,))
    ]
    return {
        "unbalance": unbalance,
        "damping_loss": unbalance,
        "unmodelled": _log_mean(np.array(subsets)) + _OPEN_NATS,
    }


def _log_mean(nats: Floats) -> float:
    """Logarithm of the mean of exponentials."""
    most = float(nats.max())
    return most + math.log(float(np.exp(nats - most).mean()))
