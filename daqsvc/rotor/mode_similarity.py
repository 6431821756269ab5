"""Which modes look alike: steady evidence between them, computed from their models before any data.

More unbalance and less damping make the same steady orbit at resonance; only the transient of a few
revolutions differs, and the side that it falls on by chance is no diagnosis. Such modes are one group.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Complex = NDArray[np.complex128]
    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]
    Observers = NDArray[np.void]


def innovation_gain(observers: Observers, turn_rad: float) -> Complex:
    """What is left of a harmonic deviation in the innovations of each observer, once it is steady.

    A constant-gain observer on its own orbit is x+ = F (x + K (u - C x)) with the deviation u as input;
    the innovation is e = u - C x, so that e / u = 1 - C (z I - F (I - K C))^-1 F K at z = exp(i turn).

    Args:
        observers: ``[M]`` of `discretise.OBSERVER`.
        turn_rad: angle that the deviation turns by from sample to sample, with its sign; 0 if it rests.

    Returns:
        complex128 ``[M]``.
    """
    flow = np.array([[observers["xx"], observers["xv"]], [observers["vx"], observers["vv"]]]).transpose(
        2, 0, 1
    )
    gain = np.column_stack((observers["gain_x"], observers["gain_v"]))[:, :, np.newaxis]
    C = np.array([[1.0, 0.0]])
    closed = flow @ (np.eye(2) - gain @ C)
    response = np.linalg.solve(np.exp(1j * turn_rad) * np.eye(2) - closed, flow @ gain)
    return np.asarray(1.0 - response[:, 0, 0], dtype=np.complex128)


def steady_evidence(observers: Observers, duration: float) -> Floats:
    """Nats a revolution that the steady orbit of the row's mode brings against the column's mode.

    It is the mean part of the log-likelihood ratio, from the difference of the orbits and of the rests as
    the column's observer sees it. What differs in the spread of the innovations alone is left out: it says
    more about the assumed noise than about the machine.

    Args:
        observers: ``[M]`` of `discretise.OBSERVER`, at the speed in question.
        duration: normalised time between samples.

    Returns:
        float64 ``[M, M]``, 0 on the diagonal; infinite where a rub observer's orbit meets the housing,
        which no other orbit resembles.
    """
    speed = float(observers["speed"][0])
    orbit = observers["a"] + 1j * observers["b"]
    rest = observers["rest_x"] + 1j * observers["rest_y"]
    turning = np.abs(innovation_gain(observers, speed * duration) * np.subtract.outer(orbit, orbit))
    resting = np.abs(innovation_gain(observers, 0.0) * np.subtract.outer(rest, rest))
    samples_per_rev = 2.0 * math.pi / abs(speed * duration)
    evidence = 0.5 * samples_per_rev * (turning**2 + resting**2) * observers["precision"]
    rubs = (observers["substeps"] > 0) & (np.abs(orbit) + np.abs(rest) > 1.0)
    evidence[rubs[:, np.newaxis] != rubs] = math.inf
    np.fill_diagonal(evidence, 0.0)
    return np.asarray(evidence, dtype=np.float64)


def alike(observers: Observers, duration: float, limit_nats: float) -> Flags:
    """Pairs of modes that the steady orbit cannot tell apart, whichever of the two is true.

    Args:
        observers: ``[M]`` of `discretise.OBSERVER`, at the speed in question.
        duration: normalised time between samples.
        limit_nats: evidence a revolution below which it cannot.

    Returns:
        bool ``[M, M]``, symmetric, false on the diagonal.
    """
    evidence = steady_evidence(observers, duration)
    pairs = np.maximum(evidence, evidence.T) < limit_nats
    np.fill_diagonal(pairs, val=False)
    return np.asarray(pairs, dtype=np.bool_)
