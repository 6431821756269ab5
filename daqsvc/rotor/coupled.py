"""Observers of a rotor with two modes: what `discretise` makes for the paper's, with both axes coupled.

Supports that are softer in one direction, oil films and gyroscopic moments couple the axes. So an observer
is one recursion over (x, x', y, y') instead of the same one twice, and its reference orbit is an ellipse.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from daqsvc.rotor.discretise import rubs_apart

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.discretise import BankMode
    from daqsvc.rotor.model import NormalisedRotor

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]
    Observers = NDArray[np.void]
    Couplings = NDArray[np.void]

COUPLED = np.dtype(
    [
        # the part of the reference orbit that turns against the shaft
        ("back_a", np.float64), ("back_b", np.float64),
        # update: constant Kalman gain, inverse of the innovations' covariance, ln det(2 pi S) / 2
        ("gain", np.float64, (4, 2)), ("precision", np.float64, (2, 2)), ("log_norm", np.float64),
        # prediction over a sample, over half a sub-step of the contact, and over a whole one
        ("flow", np.float64, (4, 4)), ("half", np.float64, (4, 4)), ("full", np.float64, (4, 4)),
        # of a rub observer: square of how far from the centre its estimate has been recently
        # and what is left of it from one sample to the next
        ("reach_squared", np.float64), ("forgetting", np.float64),
    ]
)  # fmt: skip
"""What an observer of coupled axes adds to `discretise.OBSERVER`; of that, its orbit and contact hold."""

_REACH_REVOLUTIONS = 3.0
"""Time for which the largest distance of an estimate from the centre is kept: a rub is once a revolution."""

_POSITIONS = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
_ACCELERATED = np.diag([0.0, 1.0, 0.0, 1.0])


def state_matrix(rotor: NormalisedRotor, w: float) -> Floats:
    """A of the motion without contact, of (x, x', y, y').

    Args:
        rotor: the rotor.
        w: normalised speed; the gyroscopic moment goes with it.

    Returns:
        float64 ``[4, 4]``.
    """
    q, d = rotor.anisotropy, rotor.damping_anisotropy
    kappa, zeta, gyroscopic = rotor.cross_stiffness, rotor.zeta, rotor.gyroscopic * w
    return np.array(
        [
            [0.0, 1.0, 0.0, 0.0],
            [-rotor.k - q.real, -2.0 * zeta - d.real, kappa - q.imag, -gyroscopic - d.imag],
            [0.0, 0.0, 0.0, 1.0],
            [-kappa - q.imag, gyroscopic - d.imag, -rotor.k + q.real, -2.0 * zeta + d.real],
        ]
    )


def process_covariance(rotor: NormalisedRotor, process_noise: float, w: float, duration: float) -> Floats:
    """Covariance that white acceleration noise leaves after a time (Van Loan 1978).

    Args:
        rotor: the rotor.
        process_noise: power spectral density q of either axis, normalised.
        w: normalised speed.
        duration: normalised time.

    Returns:
        float64 ``[4, 4]``.
    """
    A = state_matrix(rotor, w)
    block = np.block([[-A, process_noise * _ACCELERATED], [np.zeros((4, 4)), A.T]])
    exponential = expm(block * duration)
    return np.asarray(exponential[4:, 4:].T @ exponential[:4, 4:], dtype=np.float64)


def couple(
    modes: Sequence[BankMode],
    observers: Observers,
    *,
    noise: float,
    duration: float,
    variance_factor: float = 1.0,
) -> Couplings:
    """Constants of coupled axes for a bank; none if every mode is the paper's rotor.

    Args:
        modes: the hypotheses; all are observed alike.
        observers: ``[M]`` of `discretise.OBSERVER`, of the same modes.
        noise: standard deviation of the measured position in clearances.
        duration: normalised time between samples, omega_s dt.
        variance_factor: see `discretise.discretise`.

    Returns:
        Array ``[M]`` of `COUPLED`, or ``[0]``.

    Raises:
        ValueError: a mode whose motion grows without bound, so that there is nothing to observe.
    """
    if all(mode.rotor.isotropic for mode in modes):
        return np.zeros(0, dtype=COUPLED)
    couplings = np.zeros(len(modes), dtype=COUPLED)
    w = modes[0].rotor.w
    couplings["forgetting"] = math.exp(-abs(w * duration) / (math.tau * _REACH_REVOLUTIONS))
    for coupling, mode in zip(couplings, modes, strict=True):
        grows = growth(mode.rotor, w)
        if grows >= 0.0:
            raise ValueError(
                f"rotor bank: in mode {mode.name!r} the whirl grows by itself (by a factor of "
                f"{math.exp(grows * math.tau / abs(w)):.3g} in a revolution): no machine runs so; give the "
                "mode more damping or stiffness"
            )
        flow = expm(state_matrix(mode.rotor, w) * duration)
        Q = process_covariance(mode.rotor, mode.process_noise, w, duration)
        P = solve_discrete_are(flow.T, _POSITIONS.T, Q, noise**2 * np.eye(2))
        S = _POSITIONS @ P @ _POSITIONS.T + noise**2 * np.eye(2)
        coupling["gain"] = np.linalg.solve(S, _POSITIONS @ P).T
        S = S * variance_factor
        coupling["precision"] = np.linalg.inv(S)
        coupling["log_norm"] = 0.5 * math.log(np.linalg.det(2.0 * math.pi * S))
    return couplings_at_speed(couplings, observers, modes, w, duration=duration)


def growth(rotor: NormalisedRotor, w: float) -> float:
    """Normalised rate at which the fastest free motion of a rotor grows; negative if all of them die out."""
    return float(np.linalg.eigvals(state_matrix(rotor, w)).real.max())


def couplings_at_speed(
    couplings: Couplings, observers: Observers, modes: Sequence[BankMode], w: float, *, duration: float
) -> Couplings:
    """The same at another speed: backward orbits and gyroscopic moments change, gains do not.

    Args:
        couplings: ``[M]`` or ``[0]`` of `COUPLED`.
        observers: ``[M]`` of `discretise.OBSERVER`, of the same modes.
        modes: the modes.
        w: normalised shaft speed.
        duration: normalised time between samples.

    Returns:
        A new array.
    """
    moved = couplings.copy()
    for coupling, observer, mode in zip(moved, observers, modes, strict=False):
        backward = mode.rotor.backward_orbit(w)
        coupling["back_a"], coupling["back_b"] = backward.real, backward.imag
        A = state_matrix(mode.rotor, w)
        coupling["flow"] = expm(A * duration)
        if substeps := int(observer["substeps"]):
            coupling["half"] = expm(A * (duration / substeps / 2.0))
            coupling["full"] = expm(A * (duration / substeps))
    return moved


def _innovation_gain(couplings: Couplings, turn_rad: float) -> Complexes:
    """What is left of a harmonic deviation in the innovations, complex128 ``[M, 2, 2]``; see `discretise`."""
    flow, gain = couplings["flow"], couplings["gain"]
    closed = flow @ (np.eye(4) - gain @ _POSITIONS)
    response = np.linalg.solve(np.exp(1j * turn_rad) * np.eye(4) - closed, flow @ gain)
    return np.asarray(np.eye(2) - _POSITIONS @ response, dtype=np.complex128)


def coupled_evidence(couplings: Couplings, observers: Observers, duration: float) -> Floats:
    """Nats a revolution of the row's steady orbit against the column's mode, `discretise.steady_evidence`.

    Args:
        couplings: ``[M]`` of `COUPLED`.
        observers: ``[M]`` of `discretise.OBSERVER`.
        duration: normalised time between samples.

    Returns:
        float64 ``[M, M]``.
    """
    speed = float(observers["speed"][0])
    forward = observers["a"] + 1j * observers["b"]
    backward = couplings["back_a"] + 1j * couplings["back_b"]
    turning = np.stack((forward + backward.conj(), -1j * (forward - backward.conj())), axis=1)
    resting = np.stack((observers["rest_x"], observers["rest_y"]), axis=1)
    samples_per_rev = 2.0 * math.pi / abs(speed * duration)
    evidence = np.zeros((len(couplings), len(couplings)))
    for gain, amplitudes, share in (
        (_innovation_gain(couplings, speed * duration), turning, 0.25),
        (_innovation_gain(couplings, 0.0), resting, 0.5),
    ):
        apart = amplitudes[:, np.newaxis] - amplitudes
        seen = np.einsum("jab,ijb->ija", gain, apart)
        energy = np.einsum("ija,jab,ijb->ij", seen.conj(), couplings["precision"], seen).real
        evidence += share * samples_per_rev * energy
    reach = np.abs(forward) + np.abs(backward) + np.hypot(observers["rest_x"], observers["rest_y"])
    return rubs_apart(evidence, observers, reach)
