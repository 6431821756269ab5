"""From the continuous rotor to what the kernels step with.

Tables and loop counts are made together and travel together (`OBSERVER`). With a sub-step propagator that
does not fit its loop count, an observer would be wrong without an error.

The shaft is isotropic, so the two axes decouple and every observer is a 2 x 2 recursion per axis on
the deviation from its own reference orbit. The forcing needs no integration at all. The contact is
stepped by Strang splitting: exact linear flow over half a sub-step, a kick by the contact force,
flow over the other half.

Some modes have the same steady orbit: at resonance more unbalance and less damping do. Only the transient of
a few revolutions differs, and a decision by chance is no diagnosis. Such modes are one group (`alike`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import expm, solve_discrete_are

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.model import NormalisedRotor

    Floats = NDArray[np.float64]
    Observers = NDArray[np.void]
    Complex = NDArray[np.complex128]
    Flags = NDArray[np.bool_]


_MIN_SUBSTEPS_PER_REV = 128
_MAX_STEP_TIMES_CONTACT_FREQUENCY = 0.5


@dataclass(frozen=True, slots=True)
class BankMode:
    """One hypothesis about the machine.

    Attributes:
        name: name of the mode, e.g. ``"F1L2"``.
        rotor: the rotor as it is in this mode.
        process_noise: power spectral density q of the acceleration noise, normalised.
        rub: whether the observer of this mode includes the contact.
    """

    name: str
    rotor: NormalisedRotor
    process_noise: float = 1e-4
    rub: bool = False


OBSERVER = np.dtype(
    [
        # orbit: reference orbit (a + ib) exp(i theta) + rest, and the speed w along it
        ("a", np.float64), ("b", np.float64), ("rest_x", np.float64), ("rest_y", np.float64),
        ("speed", np.float64),
        # update: constant Kalman gain on position and velocity, 1 / S and ln(2 pi S) of the innovations
        ("gain_x", np.float64), ("gain_v", np.float64), ("precision", np.float64), ("log_norm", np.float64),
        # prediction: flow of one axis over a sample, over half a sub-step and over a whole one
        ("xx", np.float64), ("xv", np.float64), ("vx", np.float64), ("vv", np.float64),
        ("half_xx", np.float64), ("half_xv", np.float64), ("half_vx", np.float64), ("half_vv", np.float64),
        ("full_xx", np.float64), ("full_xv", np.float64), ("full_vx", np.float64), ("full_vv", np.float64),
        # contact: sub-steps per sample (0: none, a linear observer). Then the shaft's turn in half a sub-step
        # and in a whole one, K* times the duration of a sub-step, alpha, mu, speed of the rubbing surface
        ("substeps", np.int64),
        ("half_cos", np.float64), ("half_sin", np.float64),
        ("full_cos", np.float64), ("full_sin", np.float64),
        ("impulse", np.float64), ("alpha", np.float64), ("mu", np.float64), ("surface_speed", np.float64),
    ]
)  # fmt: skip
"""The constants of one observer; the kernels take an array of these, one for each mode."""


def axis_flow(rotor: NormalisedRotor, duration: float) -> Floats:
    """Exact transition matrix of (position, velocity) of one axis without contact.

    Args:
        rotor: the rotor; its k and zeta make A of the paper's state equation.
        duration: normalised time.

    Returns:
        float64 ``[2, 2]``.
    """
    A = np.array([[0.0, 1.0], [-rotor.k, -2.0 * rotor.zeta]])
    return np.asarray(expm(A * duration), dtype=np.float64)


def axis_process_covariance(rotor: NormalisedRotor, process_noise: float, duration: float) -> Floats:
    """Covariance that white acceleration noise leaves on one axis after a time (Van Loan 1978).

    Args:
        rotor: the rotor.
        process_noise: power spectral density q, normalised.
        duration: normalised time.

    Returns:
        float64 ``[2, 2]``.
    """
    A = np.array([[0.0, 1.0], [-rotor.k, -2.0 * rotor.zeta]])
    block = np.zeros((4, 4))
    block[:2, :2] = -A
    block[1, 3] = process_noise
    block[2:, 2:] = A.T
    exponential = expm(block * duration)
    return np.asarray(exponential[2:, 2:].T @ exponential[:2, 2:], dtype=np.float64)


def constant_gain(
    rotor: NormalisedRotor, process_noise: float, noise: float, duration: float
) -> tuple[Floats, float]:
    """Steady Kalman gain of one axis and the innovation variance that goes with it.

    Args:
        rotor: the rotor.
        process_noise: power spectral density q, normalised.
        noise: standard deviation of the measured position, in clearances.
        duration: normalised time between samples.

    Returns:
        The gain in filter form, float64 ``[2]``, and the innovation variance S.

    Raises:
        ValueError: a noise figure is not above 0; the Riccati equation then has no stabilising solution.
    """
    for name, value in (("process noise", process_noise), ("sensor noise", noise)):
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"rotor bank: the {name} is {value}; an observer needs a finite value above 0")
    flow = axis_flow(rotor, duration)
    C = np.array([[1.0, 0.0]])
    Q = axis_process_covariance(rotor, process_noise, duration)
    P = solve_discrete_are(flow.T, C.T, Q, np.array([[noise**2]]))
    S = float(P[0, 0]) + noise**2
    return np.asarray(P[:, 0] / S, dtype=np.float64), S


def contact_substeps(rotor: NormalisedRotor, duration: float) -> int:
    """Contact sub-steps in a sample: h w_c <= 1/2 and at least 128 a revolution.

    The contact is stiffest where it is deepest; one clearance of penetration bounds it, so that
    w_c^2 = k + alpha K*.

    Args:
        rotor: the rotor.
        duration: normalised time between samples.
    """
    contact_frequency = math.sqrt(rotor.k + rotor.alpha * rotor.contact_stiffness)
    step = _MAX_STEP_TIMES_CONTACT_FREQUENCY / contact_frequency
    if rotor.w:
        step = min(step, 2.0 * math.pi / abs(rotor.w) / _MIN_SUBSTEPS_PER_REV)
    # The tolerance keeps 64 samples a revolution at 2 sub-steps, whatever the last bit is.
    return max(1, math.ceil(duration / step * (1.0 - 1e-9)))


def discretise(
    modes: Sequence[BankMode], *, noise: float, duration: float, variance_factor: float = 1.0
) -> Observers:
    """Constants of a bank for one sampling interval, at the speed of its first mode.

    Args:
        modes: the hypotheses; the first is the healthy one and linear.
        noise: standard deviation of the measured position in clearances, one figure for all modes: if
            the noise differed by mode, it would decide.
        duration: normalised time between samples, omega_s dt.
        variance_factor: how much larger than their own figure the innovations' variance is taken to be, for
            models that are known to be wrong by a little; the gains do not change.

    Returns:
        Array ``[M]`` of `OBSERVER`.

    Raises:
        ValueError: no modes, a rub observer first, a noise figure not above 0, or a factor below 1.
    """
    if not modes or modes[0].rub:
        raise ValueError("rotor bank: the first mode must be the healthy one, without rub")
    if not (math.isfinite(variance_factor) and variance_factor >= 1.0):
        raise ValueError(f"rotor bank: the variance factor is {variance_factor}; it must be 1 or more")
    observers = np.zeros(len(modes), dtype=OBSERVER)
    for observer, mode in zip(observers, modes, strict=True):
        rotor = mode.rotor
        gain, variance = constant_gain(rotor, mode.process_noise, noise, duration)
        variance *= variance_factor
        observer["gain_x"], observer["gain_v"] = gain
        observer["precision"] = 1.0 / variance
        observer["log_norm"] = math.log(2.0 * math.pi * variance)
        observer["rest_x"], observer["rest_y"] = rotor.rest.real, rotor.rest.imag
        _set_flow(observer, "", axis_flow(rotor, duration))
        if mode.rub:
            substeps = contact_substeps(rotor, duration)
            step = duration / substeps
            observer["substeps"] = substeps
            observer["impulse"] = step * rotor.contact_stiffness
            observer["alpha"], observer["mu"] = rotor.alpha, rotor.mu
            _set_flow(observer, "half_", axis_flow(rotor, step / 2.0))
            _set_flow(observer, "full_", axis_flow(rotor, step))
    return at_speed(observers, modes, modes[0].rotor.w, duration=duration)


def at_speed(observers: Observers, modes: Sequence[BankMode], speed: float, *, duration: float) -> Observers:
    """The same observers at another shaft speed: orbits, turn and slip change, gains do not.

    Args:
        observers: what `discretise` made of the modes.
        modes: the same modes.
        speed: normalised shaft speed w.
        duration: normalised time between samples, omega_s dt.

    Returns:
        A new array ``[M]`` of `OBSERVER`.
    """
    moved = observers.copy()
    for observer, mode in zip(moved, modes, strict=True):
        radius = mode.rotor.orbit(speed)
        observer["a"], observer["b"], observer["speed"] = radius.real, radius.imag, speed
        if observer["substeps"]:
            turn = speed * duration / int(observer["substeps"])
            observer["half_cos"], observer["half_sin"] = math.cos(turn / 2.0), math.sin(turn / 2.0)
            observer["full_cos"], observer["full_sin"] = math.cos(turn), math.sin(turn)
            observer["surface_speed"] = speed * mode.rotor.contact_radius
    return moved


def _set_flow(observer: np.void, prefix: str, flow: Floats) -> None:
    for name, value in zip(("xx", "xv", "vx", "vv"), flow.ravel().tolist(), strict=True):
        observer[prefix + name] = value


def innovation_gain(observers: Observers, turn_rad: float) -> Complex:
    """What is left of a harmonic deviation in the innovations of each observer, once it is steady.

    A constant-gain observer on its own orbit is x+ = F (x + K (u - C x)) with the deviation u as input.
    The innovation is e = u - C x, so that e / u = 1 - C (z I - F (I - K C))^-1 F K at z = exp(i turn).

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
    the column's observer sees it. What differs in the spread of the innovations alone is left out: it shows
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
    return rubs_apart(evidence, observers, np.abs(orbit) + np.abs(rest))


def rubs_apart(evidence: Floats, observers: Observers, reach: Floats) -> Floats:
    """Evidence of modes of which one meets the housing is infinite: no other orbit resembles that.

    Args:
        evidence: float64 ``[M, M]``, changed in place.
        observers: ``[M]`` of `OBSERVER`.
        reach: float64 ``[M]``, how far from the centre the orbit comes, in clearances.

    Returns:
        The same array, 0 on the diagonal.
    """
    rubs = (observers["substeps"] > 0) & (reach > 1.0)
    evidence[rubs[:, np.newaxis] != rubs] = math.inf
    np.fill_diagonal(evidence, 0.0)
    return evidence


def alike(observers: Observers, duration: float, limit_nats: float) -> Flags:
    """Pairs of modes that the steady orbit cannot tell apart, whichever of the two is true.

    Args:
        observers: ``[M]`` of `discretise.OBSERVER`, at the speed in question.
        duration: normalised time between samples.
        limit_nats: evidence a revolution below which it cannot.

    Returns:
        bool ``[M, M]``, symmetric, false on the diagonal.
    """
    return within(steady_evidence(observers, duration), limit_nats)


def within(evidence: Floats, limit_nats: float) -> Flags:
    """Pairs with less evidence than that in both directions, bool ``[M, M]``, false on the diagonal."""
    pairs = np.maximum(evidence, evidence.T) < limit_nats
    np.fill_diagonal(pairs, val=False)
    return np.asarray(pairs, dtype=np.bool_)
