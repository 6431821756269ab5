"""From the continuous rotor to what the kernels step with.

Tables and loop counts are made together and travel together (`OBSERVER`): a sub-step propagator that
does not fit its loop count is a silently wrong observer.

The shaft is isotropic, so the two axes decouple and every observer is a 2 x 2 recursion per axis on
the deviation from its own reference orbit; the forcing needs no integration at all. The contact is
stepped by Strang splitting: exact linear flow over half a sub-step, a kick by the contact force,
flow over the other half.
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
        # contact: sub-steps per sample (0: none, a linear observer), the shaft's turn in half a sub-step and
        # in a whole one, K* times the duration of a sub-step, alpha, mu, speed of the rubbing surface
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
    # The tolerance keeps 64 samples a revolution at 2 sub-steps, whatever the last bit says.
    return max(1, math.ceil(duration / step * (1.0 - 1e-9)))


def discretise(
    modes: Sequence[BankMode], *, noise: float, duration: float, variance_factor: float = 1.0
) -> Observers:
    """Constants of a bank for one sampling interval, at the speed of its first mode.

    Args:
        modes: the hypotheses; the first is the healthy one and linear.
        noise: standard deviation of the measured position in clearances, one figure for all modes: a
            noise that differed by mode would be what decides.
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
