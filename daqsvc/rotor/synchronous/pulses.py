"""Faults that push once a revolution: rub and crack, as shapes of the synchronous vector."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.laval import compliance
from daqsvc.rotor.synchronous.healthy import DC, SPREADS, Healthy, log_mean
from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Flags = NDArray[np.bool_]
    Floats = NDArray[np.float64]

_PULSE_WIDTHS = np.array([0.3, 0.6, 1.0])
_ANGLES = 2.0 * math.pi * np.arange(24) / 24.0
"""Angles of the shaft at which it may touch, or at which a crack may lie."""
_RUB_TOLERANCES = np.array([0.2, 0.4, 0.7])
_CRACK_TOLERANCES = np.array([0.1, 0.2, 0.4])
_CRACK_FACING = 0.85
_RUB_FACING = 0.5
_RUB_OUTWARDS = 0.2


def rub_pulse(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """A pulse of force at one angle of the shaft, inwards, through the rotor's compliance."""
    order = np.array(HARMONICS)
    turning = np.exp(1j * np.outer(_ANGLES, order))
    whirl = turning[:, 1:] @ healthy.baseline[1:]
    place = whirl + healthy.baseline[DC]

    def possible(force: Complexes) -> Flags:
        # The wall is where the whirl leads to, and not behind the centre: a crack pulls the other way.
        return (_facing(-force, whirl) > _RUB_FACING) & (_facing(-force, place) > _RUB_OUTWARDS)

    return _shaped(change, variance, healthy, _pulses(healthy), _RUB_TOLERANCES, possible)


def likeliest_touch(change: Complexes, healthy: Healthy) -> tuple[float, float]:
    """Force of a rub over the shaft's stiffness, in um, and the shaft angle where it touches, in rad.

    Of all pulses the one that explains the change best, whichever way it points.
    """
    shape = _pulses(healthy)
    scale = (shape.conj() * change).sum(axis=-1) / (np.abs(shape) ** 2).sum(axis=-1)
    explained = np.abs(scale) ** 2 * (np.abs(shape) ** 2).sum(axis=-1)
    best = np.unravel_index(int(explained.argmax()), explained.shape)
    return float(abs(scale[best])), float(_ANGLES[best[2]])


def crack(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """A shaft that a crack makes softer once a revolution, when its weight opens it.

    Two shapes, equally likely: the lost restoring force lies along the crack and turns with it (Mayes and
    Davies 1984; the hinge of Gasch 1976), or it is a pulse along the sag, as a finite-element model of a
    crack between bearings gives it. A rub pushes the other way.
    """
    order = np.array(HARMONICS)
    theta = 2.0 * math.pi * np.arange(32) / 32.0
    direction = np.exp(1j * (theta + _ANGLES[:, np.newaxis]))
    deflection = np.exp(1j * np.outer(theta, order[1:])) @ healthy.baseline[1:] - 1j * healthy.rotor.sag_um
    down = -direction.imag  # cosine of the angle between crack and gravity
    breathing = np.stack([(1.0 + down) / 2.0, (1.0 + np.sign(down)) / 2.0])
    force = breathing * (deflection * direction.conj()).real * direction
    spectrum = force @ np.exp(-1j * np.outer(theta, order)) / len(theta)
    turning = _shaped(
        change,
        variance,
        healthy,
        spectrum[:, np.newaxis] * _passed(healthy),
        _CRACK_TOLERANCES,
        lambda loss: loss.real > math.cos(math.pi / 4.0) * np.abs(loss),
    )
    along_sag = _shaped(
        change,
        variance,
        healthy,
        _pulses(healthy),
        _CRACK_TOLERANCES,
        lambda loss: -loss.imag > _CRACK_FACING * np.abs(loss),
    )
    return float(np.logaddexp(turning, along_sag)) - math.log(2.0)


def _pulses(healthy: Healthy) -> Complexes:
    """Response to a pulse of force in a fixed direction, once a revolution, complex128 ``[W, B, A, 5]``."""
    order = np.array(HARMONICS)
    width = np.exp(-((order * _PULSE_WIDTHS[:, np.newaxis]) ** 2) / 2.0)
    turning = np.exp(1j * np.outer(_ANGLES, order))
    return np.asarray(width[:, np.newaxis, np.newaxis] * _passed(healthy) * turning.conj())


def _passed(healthy: Healthy) -> Complexes:
    """Compliance to forces at the orders of `HARMONICS`, complex128 ``[B, 1, 5]`` over a coarse box."""
    omega, zeta = (axis.reshape(5, 5)[::2, ::2].ravel() for axis in healthy.rotor.box)
    order = np.array(HARMONICS)
    passed = compliance(order * healthy.speed_rad_s / omega[:, np.newaxis], zeta[:, np.newaxis])
    return np.asarray(passed[:, np.newaxis])


def _shaped(
    change: Complexes,
    variance: Floats,
    healthy: Healthy,
    shape: Complexes,
    tolerances: Floats,
    possible: Callable[[Complexes], Flags],
) -> float:
    """Log marginal likelihood of a change of known shape and unknown complex size.

    Args:
        change: complex128 ``[5]``.
        variance: float64 ``[5]``.
        healthy: the machine before.
        shape: complex128 ``[..., 5]``, shapes, equally likely.
        tolerances: relative deviations from the shape, equally likely.
        possible: which of the sizes that fit best can be, complex128 ``[...]`` to bool.
    """
    size = np.abs(shape)
    norm = (size**2).sum(axis=-1)
    scores = np.full((len(tolerances), len(SPREADS), *norm.shape), -np.inf)
    for i, tolerance in enumerate(tolerances):
        spread = variance + (tolerance * np.abs(change)) ** 2
        for _ in range(2):
            scale = (shape.conj() * change / spread).sum(axis=-1) / (size**2 / spread).sum(axis=-1)
            spread = variance + (tolerance * np.abs(scale)[..., np.newaxis] * size) ** 2
        precision = (size**2 / spread).sum(axis=-1)
        scale = (shape.conj() * change / spread).sum(axis=-1) / precision
        residual = change - scale[..., np.newaxis] * shape
        misfit = (np.abs(residual) ** 2 / spread).sum(axis=-1) + np.log(spread).sum(axis=-1)
        allowed = possible(scale)
        for j, part in enumerate(SPREADS):
            # Integral over the size, normal with this spread: Sherman and Morrison.
            prior = (part * healthy.amplitude_um) ** 2 / norm
            occam = np.log1p(prior * precision) + np.abs(scale) ** 2 * precision / (1.0 + prior * precision)
            scores[i, j] = np.where(allowed, -misfit - occam, -np.inf)
    return log_mean(scores.ravel())


def _facing(force: Complexes, place: Complexes) -> Floats:
    """Cosine of the angle between two directions."""
    return np.asarray((force * place.conj()).real / np.maximum(np.abs(force) * np.abs(place), 1e-300))
