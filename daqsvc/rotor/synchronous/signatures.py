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
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from daqsvc.rotor.laval import unbalance_response
from daqsvc.rotor.synchronous.healthy import (
    BACKWARD,
    DC,
    FORWARD,
    SPREADS,
    Healthy,
    density,
    log_density,
    log_mean,
)
from daqsvc.rotor.synchronous.pulses import crack, rub_pulse
from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from numpy.typing import NDArray

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

_LEAK = 0.01
"""What a change of one component may leave in the others: the plant is no Laval rotor to the last digit."""

_STIFFNESS_LOSSES = np.geomspace(0.02, 1.2, 24)
"""1 / k - 1 of the stiffness losses looked for."""
_STIFFNESS_TOLERANCE = 0.3
_GENERIC_STIFFNESS_NATS = 2.0
"""What stiffness loss pays where no model ties mean position and 1X together."""
_STIFFNESS_DAMPING = np.array([0.0, 1.8])
"""A softer support also damps more: relative increase per 1 / k - 1, up to `_MOST_DAMPING`."""
_MOST_DAMPING = 1.6

_RUB_FULL_CLEARANCE = 0.9

_DAMPING_LEFT = np.geomspace(0.03, 0.97, 40)
_DAMPING_FREQUENCY = np.array([0.92, 0.96, 1.0, 1.015])
_DAMPING_MASS = np.array([0.86, 0.93, 1.0, 1.02])
_DAMPING_TOLERANCE = 0.05
"""Less damping in a bearing shifts frequency and modal mass with it (independent rotor code)."""


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
    normal = float(log_density(change, variance).sum())
    scores: dict[RotorFault, float] = {"normal": normal}
    half = math.log(0.5)
    scores["unbalance"] = _unbalance(change, variance, healthy) + half
    scores["damping_loss"] = _damping_loss(change, variance, healthy) + half
    scores["static_load"] = _static_load(change, variance, healthy)
    scores["stiffness_loss"] = _stiffness_loss(change, variance, healthy)
    scores["rub"] = _rub(change, variance, healthy, position)
    scores["unmodelled"] = float(
        np.logaddexp(
            _unmodelled(change, variance, healthy) - UNMODELLED_NATS, crack(change, variance, healthy) - 1.0
        )
    )
    return {name: score - normal for name, score in scores.items()}


def damping_misfit(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """How far the change of 1X lies from all that a loss of damping can do, in nats; 0 if it can do it.

    The nearest point decides, not the average: what cannot be told apart must stay in the group.
    """
    before, after = _damped(healthy)
    forward = healthy.baseline[FORWARD]
    moved = forward * (after / before - 1.0)
    tolerance = _DAMPING_TOLERANCE * abs(forward + change[FORWARD])
    misfit = np.abs(change[FORWARD] - moved) ** 2 / (variance[FORWARD] + tolerance**2)
    return float(max(0.0, misfit.min() - 1.0))


def _still(change: Complexes, variance: Floats, moved: float) -> Floats:
    """Log density of components that do not move, but for a leak from those that do."""
    return np.logaddexp(
        log_density(change, variance), log_density(change, variance + (_LEAK * moved) ** 2)
    ) - math.log(2.0)


def _free(change: complex, variance: float, amplitude: float) -> float:
    """Log density of a component that moves by an amount not known."""
    return log_mean(log_density(np.full(4, change), variance + (SPREADS * amplitude) ** 2))


def _unbalance(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """1X moves, and on an elliptic orbit backward 1X with it: by as much, if the plane is the same."""
    moved = abs(change[FORWARD])
    score = _still(change, variance, moved)
    forward, backward = healthy.baseline[FORWARD], healthy.baseline[BACKWARD]
    in_plane = np.conj(change[FORWARD] / forward) * backward
    near = (0.1 * abs(in_plane)) ** 2 + (_LEAK * moved) ** 2
    wide = (1.5 * healthy.ellipticity * moved) ** 2 + (_LEAK * moved) ** 2
    score[BACKWARD] = np.logaddexp.reduce(
        [
            score[BACKWARD],
            density(change[BACKWARD] - in_plane, variance[BACKWARD] + near),
            density(change[BACKWARD], variance[BACKWARD] + wide),
        ]
    ) - math.log(3.0)
    score[FORWARD] = _free(change[FORWARD], variance[FORWARD], healthy.amplitude_um)
    return float(score.sum())


def _damping_loss(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """1X moves as less damping moves it; where the rotor is no Laval rotor, both senses of 1X move anyhow."""
    if healthy.laval:
        return _unbalance(change, variance, healthy) - damping_misfit(change, variance, healthy)
    both = [FORWARD, BACKWARD]
    score = _still(change, variance, float(np.abs(change[both]).max()))
    for k in both:
        score[k] = _free(change[k], variance[k], healthy.amplitude_um)
    return float(score.sum()) - _beyond_reach(change, variance, healthy)


def _beyond_reach(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """How much further 1X moves than a loss of damping can move it, in nats, whatever the rotor's shape.

    The direction of the change is that of a Laval rotor only; its size is no larger for any mode that has
    the stated frequency and damping.
    """
    before, after = _damped(healthy)
    reach = float(np.abs(after / before - 1.0).max()) * healthy.whirl_um
    moved = float(np.hypot(abs(change[FORWARD]), abs(change[BACKWARD])))
    tolerance = (_DAMPING_TOLERANCE * moved) ** 2 + float(variance[FORWARD] + variance[BACKWARD])
    return max(0.0, max(0.0, moved - reach) ** 2 / tolerance - 1.0)


def _damped(healthy: Healthy) -> tuple[Complexes, Complexes]:
    """1X response before and after every loss of damping, complex128 ``[n]`` each."""
    omega, zeta = healthy.rotor.box
    speed = healthy.speed_rad_s
    grid = np.meshgrid(np.arange(len(omega)), _DAMPING_LEFT, _DAMPING_FREQUENCY, _DAMPING_MASS, indexing="ij")
    point, left, frequency, mass = (axis.ravel() for axis in grid)
    point = point.astype(np.int64)
    before = unbalance_response(speed / omega[point], zeta[point])
    return before, mass * unbalance_response(speed / (omega[point] * frequency), zeta[point] * left)


def _static_load(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    score = _still(change, variance, abs(change[DC]))
    score[DC] = _free(change[DC], variance[DC], healthy.amplitude_um)
    return float(score.sum())


def _stiffness_loss(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    moved = float(np.hypot(abs(change[DC]), abs(change[FORWARD])))
    score = _still(change, variance, moved)
    rest = float(score.sum() - score[DC] - score[FORWARD])
    if not healthy.laval:
        # A support that gives way makes the orbit rounder or flatter, too.
        backward = np.logaddexp(
            score[BACKWARD], _free(change[BACKWARD], variance[BACKWARD], healthy.amplitude_um)
        ) - math.log(2.0)
        both = [_free(change[k], variance[k], healthy.amplitude_um) for k in (DC, FORWARD)]
        return rest - float(score[BACKWARD]) + float(backward) + sum(both) - _GENERIC_STIFFNESS_NATS
    omega, zeta = healthy.rotor.box
    loss, point, more = (
        axis.ravel()
        for axis in np.meshgrid(_STIFFNESS_LOSSES, np.arange(len(omega)), _STIFFNESS_DAMPING, indexing="ij")
    )
    point = point.astype(np.int64)
    stiffness = 1.0 / (1.0 + loss)
    factor = np.minimum(1.0 + more * loss, _MOST_DAMPING)
    speed = healthy.speed_rad_s / omega[point]
    before = 1.0 / (1.0 - speed**2 + 2j * zeta[point] * speed)
    after = 1.0 / (stiffness - speed**2 + 2j * zeta[point] * factor * speed)
    sag_um = healthy.rotor.sag_um * (healthy.rotor.natural_frequency_rad_s / omega[point]) ** 2
    predicted = (-1j * loss * sag_um, healthy.baseline[FORWARD] * (after / before - 1.0))
    total = np.zeros(len(loss))
    for component, moved_by in zip((DC, FORWARD), predicted, strict=True):
        spread = variance[component] + (_STIFFNESS_TOLERANCE * np.abs(moved_by)) ** 2
        total += log_density(change[component] - moved_by, spread)
    return rest + log_mean(total)


def _rub(change: Complexes, variance: Floats, healthy: Healthy, position: Complexes) -> float:
    pulse = rub_pulse(change, variance, healthy)
    clearance_um = healthy.rotor.clearance_um
    if clearance_um is None:
        return pulse
    theta = 2.0 * math.pi * np.arange(64) / 64.0
    orbit = np.exp(1j * np.outer(theta, HARMONICS)) @ position
    others = [i for i in range(5) if i != FORWARD]
    beyond_1x = (
        np.abs(change[others]) ** 2 > 9.0 * variance[others] + (2.0 * _LEAK * healthy.amplitude_um) ** 2
    )
    if np.abs(orbit).max() > _RUB_FULL_CLEARANCE * clearance_um and beyond_1x.any():
        # An orbit that fills the clearance touches, whatever shape it has by then.
        return max(pulse, _unmodelled(change, variance, healthy) + UNMODELLED_NATS)
    return pulse


def _unmodelled(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    moved = float(np.abs(change).max())
    still = _still(change, variance, moved)
    total = 0.0
    for k in range(len(change)):
        total += np.logaddexp(still[k], _free(change[k], variance[k], healthy.amplitude_um)) - math.log(2.0)
    return float(total)
