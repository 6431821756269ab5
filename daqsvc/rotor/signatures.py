"""What each fault does to the synchronous vector, as a likelihood.

Given the change d of the synchronous vector since the healthy baseline and the variance v of each of its
components, every hypothesis has a marginal likelihood: its unknown amplitude, direction and the box of the
rotor's parameters are averaged over, so that a flexible hypothesis pays for its flexibility. All in nats.

* unbalance: only 1X moves, anyhow; damping loss: only 1X moves, and along what less damping does to it.
* static load: only the mean position moves.
* stiffness loss: mean position and 1X move together, by one parameter.
* rub: a pulse once a revolution, directed inwards where the orbit comes nearest to the wall, passed through
  the rotor; or an orbit that fills the clearance.
* unmodelled: any components, each by itself. It pays `UNMODELLED_NATS` for explaining everything.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from daqsvc.rotor.laval import compliance, unbalance_response
from daqsvc.rotor.synchronous import HARMONICS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.laval import LavalRotor

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

RotorFault: TypeAlias = Literal[
    "normal",
    "unbalance",
    "damping_loss",
    "static_load",
    "stiffness_loss",
    "rub",
    "unmodelled",
    "small_change",
]
"""Verdicts about a rotor."""

UNMODELLED_NATS = 6.0

_SPREADS = np.array([0.1, 0.3, 1.0, 3.0])
"""Sizes that a change may have, in parts of the healthy orbit."""
_LEAK = 0.01
"""What a change of one component may leave in the others: the plant is no Laval rotor to the last digit."""
_DC, _FORWARD, _BACKWARD = (HARMONICS.index(k) for k in (0, 1, -1))

_STIFFNESS_LOSSES = np.geomspace(0.02, 1.2, 24)
"""1 / k - 1 of the stiffness losses looked for."""
_STIFFNESS_TOLERANCE = 0.3
_STIFFNESS_DAMPING = np.array([1.0, 1.6])
"""A softer shaft or support is also damped otherwise."""

_RUB_WIDTHS = np.array([0.3, 0.6, 1.0])
_RUB_PHASES = 2.0 * math.pi * np.arange(24) / 24.0
_RUB_TOLERANCES = np.array([0.2, 0.4, 0.7])
_RUB_FACING = 0.5
_RUB_FULL_CLEARANCE = 0.9

_DAMPING_LEFT = np.geomspace(0.03, 0.97, 40)
_DAMPING_FREQUENCY = np.array([0.92, 0.96, 1.0, 1.015])
_DAMPING_MASS = np.array([0.86, 0.93, 1.0, 1.02])
_DAMPING_TOLERANCE = 0.05
"""Less damping in a bearing shifts frequency and modal mass with it (independent rotor code)."""


@dataclass(frozen=True, slots=True)
class Healthy:
    """The healthy machine, as far as the signatures need it.

    Attributes:
        baseline: complex128 ``[5]``, its synchronous vector in um.
        speed_rad_s: shaft speed.
        rotor: what is known about the rotor.
        laval: whether the machine behaves like a Laval rotor; if not, stiffness loss is any change of mean
            position and 1X together, and damping loss any change of 1X.
    """

    baseline: Complexes
    speed_rad_s: float
    rotor: LavalRotor
    laval: bool

    @property
    def amplitude_um(self) -> float:
        """Amplitude A of the healthy whirl, the measure of every change."""
        return float(np.sqrt(np.sum(np.abs(self.baseline[1:]) ** 2)))

    @property
    def ellipticity(self) -> float:
        """Backward over forward 1X."""
        return float(abs(self.baseline[_BACKWARD]) / max(abs(self.baseline[_FORWARD]), 1e-12))


def likelihoods(
    change: Complexes, variance: Floats, healthy: Healthy, position: Complexes
) -> dict[RotorFault, float]:
    """Log marginal likelihood ratio of every hypothesis against "normal", in nats.

    Args:
        change: complex128 ``[5]``, d in um, in the order of `HARMONICS`.
        variance: float64 ``[5]``, complex variance of each component of it, um^2.
        healthy: the machine before.
        position: complex128 ``[5]``, the present synchronous vector in um, for the clearance.
    """
    normal = float(_log_density(change, variance).sum())
    scores: dict[RotorFault, float] = {"normal": normal}
    unbalance = _unbalance(change, variance, healthy)
    half = math.log(0.5)
    scores["unbalance"] = unbalance + half
    scores["damping_loss"] = unbalance + half - damping_misfit(change, variance, healthy)
    scores["static_load"] = _static_load(change, variance, healthy)
    scores["stiffness_loss"] = _stiffness_loss(change, variance, healthy)
    scores["rub"] = _rub(change, variance, healthy, position)
    scores["unmodelled"] = _unmodelled(change, variance, healthy) - UNMODELLED_NATS
    return {name: score - normal for name, score in scores.items()}


def damping_misfit(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """How far the change of 1X lies from all that a loss of damping can do, in nats; 0 if it can do it.

    The nearest point decides, not the average: what cannot be told apart must stay in the group.
    """
    if not healthy.laval:
        return 0.0
    omega, zeta = healthy.rotor.box
    speed = healthy.speed_rad_s
    grid = np.meshgrid(np.arange(len(omega)), _DAMPING_LEFT, _DAMPING_FREQUENCY, _DAMPING_MASS, indexing="ij")
    point, left, frequency, mass = (axis.ravel() for axis in grid)
    point = point.astype(np.int64)
    before = unbalance_response(speed / omega[point], zeta[point])
    after = mass * unbalance_response(speed / (omega[point] * frequency), zeta[point] * left)
    # Towards no change of damping there is no change of frequency and mass either.
    forward = healthy.baseline[_FORWARD]
    moved = forward * (after / before - 1.0)
    tolerance = _DAMPING_TOLERANCE * abs(forward + change[_FORWARD])
    misfit = np.abs(change[_FORWARD] - moved) ** 2 / (variance[_FORWARD] + tolerance**2)
    return float(max(0.0, misfit.min() - 1.0))


def _log_density(values: Complexes | Floats, variance: Floats) -> Floats:
    """Log density of circular complex normal values, without the constant ln pi."""
    return np.asarray(-(np.abs(values) ** 2) / variance - np.log(variance))


def _log_mean(values: Floats) -> float:
    top = float(values.max())
    if not math.isfinite(top):
        return top
    return top + math.log(float(np.exp(values - top).mean()))


def _still(change: Complexes, variance: Floats, moved: float) -> Floats:
    """Log density of components that do not move, but for a leak from those that do."""
    return np.logaddexp(
        _log_density(change, variance), _log_density(change, variance + (_LEAK * moved) ** 2)
    ) - math.log(2.0)


def _free(change: complex, variance: float, amplitude: float) -> float:
    """Log density of a component that moves by an amount not known."""
    return _log_mean(_log_density(np.full(4, change), variance + (_SPREADS * amplitude) ** 2))


def _unbalance(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    moved = abs(change[_FORWARD])
    score = _still(change, variance, moved)
    ellipse = 1.5 * healthy.ellipticity * moved
    score[_BACKWARD] = _log_density(
        change[_BACKWARD : _BACKWARD + 1],
        variance[_BACKWARD : _BACKWARD + 1] + ellipse**2 + (_LEAK * moved) ** 2,
    )[0]
    score[_FORWARD] = _free(change[_FORWARD], variance[_FORWARD], healthy.amplitude_um)
    return float(score.sum())


def _static_load(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    score = _still(change, variance, abs(change[_DC]))
    score[_DC] = _free(change[_DC], variance[_DC], healthy.amplitude_um)
    return float(score.sum())


def _stiffness_loss(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    moved = float(np.hypot(abs(change[_DC]), abs(change[_FORWARD])))
    score = _still(change, variance, moved)
    rest = float(score.sum() - score[_DC] - score[_FORWARD])
    if not healthy.laval:
        both = _free(change[_DC], variance[_DC], healthy.amplitude_um)
        return rest + both + _free(change[_FORWARD], variance[_FORWARD], healthy.amplitude_um)
    omega, zeta = healthy.rotor.box
    loss, point, factor = (
        axis.ravel()
        for axis in np.meshgrid(_STIFFNESS_LOSSES, np.arange(len(omega)), _STIFFNESS_DAMPING, indexing="ij")
    )
    point = point.astype(np.int64)
    stiffness = 1.0 / (1.0 + loss)
    speed = healthy.speed_rad_s / omega[point]
    before = 1.0 / (1.0 - speed**2 + 2j * zeta[point] * speed)
    after = 1.0 / (stiffness - speed**2 + 2j * zeta[point] * factor * speed)
    sag_um = healthy.rotor.sag_um * (healthy.rotor.natural_frequency_rad_s / omega[point]) ** 2
    predicted = (-1j * loss * sag_um, healthy.baseline[_FORWARD] * (after / before - 1.0))
    total = np.zeros(len(loss))
    for component, moved_by in zip((_DC, _FORWARD), predicted, strict=True):
        spread = variance[component] + (_STIFFNESS_TOLERANCE * np.abs(moved_by)) ** 2
        total += _log_density(change[component] - moved_by, spread)
    return rest + _log_mean(total)


def _rub(change: Complexes, variance: Floats, healthy: Healthy, position: Complexes) -> float:
    pulse = _rub_pulse(change, variance, healthy)
    clearance_um = healthy.rotor.clearance_um
    if clearance_um is None:
        return pulse
    theta = 2.0 * math.pi * np.arange(64) / 64.0
    orbit = np.exp(1j * np.outer(theta, HARMONICS)) @ position
    others = [i for i in range(5) if i != _FORWARD]
    beyond_1x = (
        np.abs(change[others]) ** 2 > 9.0 * variance[others] + (2.0 * _LEAK * healthy.amplitude_um) ** 2
    )
    if np.abs(orbit).max() > _RUB_FULL_CLEARANCE * clearance_um and beyond_1x.any():
        # An orbit that fills the clearance touches, whatever shape it has by then.
        return max(pulse, _unmodelled(change, variance, healthy) + UNMODELLED_NATS)
    return pulse


def _rub_pulse(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """A pulse of force at one angle of the shaft, inwards, through the rotor's compliance."""
    omega, zeta = (axis.reshape(5, 5)[::2, ::2].ravel() for axis in healthy.rotor.box)
    order = np.array(HARMONICS)
    passed = compliance(order * healthy.speed_rad_s / omega[:, np.newaxis], zeta[:, np.newaxis])
    width = np.exp(-((order * _RUB_WIDTHS[:, np.newaxis]) ** 2) / 2.0)
    phase = np.exp(-1j * np.outer(_RUB_PHASES, order))
    # [width, box, phase, order]
    shape = width[:, np.newaxis, np.newaxis] * passed[np.newaxis, :, np.newaxis] * phase
    size = np.abs(shape)
    best = np.full((len(_RUB_TOLERANCES), *shape.shape[:-1], len(_SPREADS)), -np.inf)
    touched = np.exp(1j * np.outer(_RUB_PHASES, order)) @ healthy.baseline
    for i, tolerance in enumerate(_RUB_TOLERANCES):
        spread = variance + (tolerance * np.abs(change)) ** 2
        for _ in range(2):
            precision = (size**2 / spread).sum(axis=-1)
            force = (shape.conj() * change / spread).sum(axis=-1) / precision
            spread = variance + (tolerance * np.abs(force)[..., np.newaxis] * size) ** 2
        precision = (size**2 / spread).sum(axis=-1)
        force = (shape.conj() * change / spread).sum(axis=-1) / precision
        residual = change - force[..., np.newaxis] * shape
        misfit = (np.abs(residual) ** 2 / spread).sum(axis=-1) + np.log(spread).sum(axis=-1)
        inwards = (-force * touched.conj()).real > _RUB_FACING * np.abs(force) * np.abs(touched)
        norm = (size**2).sum(axis=-1)
        for j, part in enumerate(_SPREADS):
            # Integral over the force, normal with this spread: Sherman and Morrison.
            prior = (part * healthy.amplitude_um) ** 2 / norm
            occam = np.log1p(prior * precision) + np.abs(force) ** 2 * precision / (1.0 + prior * precision)
            best[i, ..., j] = np.where(inwards, -misfit - occam, -np.inf)
    return _log_mean(best.ravel())


def _unmodelled(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    moved = float(np.abs(change).max())
    still = _still(change, variance, moved)
    total = 0.0
    for k in range(len(change)):
        total += np.logaddexp(still[k], _free(change[k], variance[k], healthy.amplitude_um)) - math.log(2.0)
    return float(total)
