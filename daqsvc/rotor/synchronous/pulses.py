"""What a rub and a crack do to the synchronous vector: forces that come once a revolution.

A rub pushes inwards for a part of each revolution, where the orbit comes nearest to the wall. While it lasts,
the push turns with the normal of the wall: not at all where the orbit touches from far away, with the shaft
where it whirls around the clearance's centre. A crack makes the shaft softer when its weight opens it, and
pulls the other way. Either force passes through the rotor: through the two modes that its run-up shows, or
through all Laval rotors within the tolerances of the stated one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.laval import compliance
from daqsvc.rotor.synchronous.vectors import DC, HARMONICS, SPREADS, WITH_THRICE, Healthy, log_mean

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

_WIDTHS = np.array([0.3, 0.6, 1.0, 1.4])
"""Standard deviations of a push, as angles of the shaft."""
_FEW_WIDTHS = _WIDTHS[:3]
"""The same of a crack that opens, and of a rub where the rotor's two modes are not known."""
_TURNS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
"""How far the push turns while the shaft turns by 1: way of the whirl over its distance from the centre."""
_ANGLES = 2.0 * math.pi * np.arange(48) / 48.0
"""Angles of the shaft at which it may touch, or at which a crack may lie."""
_RUB_TOLERANCES = np.array([0.1, 0.2, 0.4, 0.7])
"""How far from its shape a rub may be; the first only where the rotor's two modes are known."""
_CRACK_TOLERANCES = np.array([0.1, 0.2, 0.4])
_CRACK_FACING = 0.85
_RUB_FACING = 0.5
_RUB_OUTWARDS = 0.2
_PLACES = ((0, 0), (1, 2), (3, 4), (5, 6))
"""Where the forward and the backward component of orders 0 to 3 are in `WITH_THRICE`."""


def rub_pulse(change: Complexes, variance: Floats, healthy: Healthy, position: Complexes) -> float:
    """Log marginal likelihood of a push once a revolution, inwards.

    Args:
        change: complex128 ``[5]`` or, with 3X, ``[7]``, um.
        variance: float64, as many, um^2.
        healthy: the machine before.
        position: complex128 ``[5]``, the present synchronous vector, um: it is this orbit that touches.
    """
    order = np.array(HARMONICS)
    turning = np.exp(1j * np.outer(_ANGLES, order))
    whirl = turning[:, 1:] @ position[1:]
    place = whirl + position[DC]

    def possible(force: Complexes) -> Flags:
        # The wall is where the whirl leads to, and not behind the centre, as a crack pulls. But only a
        # drawing shows where that centre is, and 3X shows a crack better.
        towards = _facing(-force, whirl) > _RUB_FACING
        return towards if len(change) > len(HARMONICS) else towards & (_facing(-force, place) > _RUB_OUTWARDS)

    tolerances = _RUB_TOLERANCES if healthy.rotor.two_modes is not None else _RUB_TOLERANCES[1:]
    return _shaped(change, variance, healthy, _rubs(healthy, len(change)), tolerances, possible)


def likeliest_touch(change: Complexes, healthy: Healthy) -> tuple[float, float]:
    """Force of a rub over the shaft's stiffness, in um, and the shaft angle where it touches, in rad.

    Of all pulses the one that explains the change best, whichever way it points.
    """
    shape = _rubs(healthy, len(change))
    force, left = _fitted(change, np.ones(len(change)), shape)
    best = np.unravel_index(int(left.argmin()), left.shape)
    return float(np.hypot(*force[best])), float(_ANGLES[best[-1]])


def crack(change: Complexes, variance: Floats, healthy: Healthy) -> float:
    """Log marginal likelihood of a shaft that a crack makes softer once a revolution.

    The lost restoring force lies along the crack and turns with it (Mayes and Davies 1984, and the hinge of
    Gasch 1976). Where 3X is not known, it may as likely be a pulse along the sag. Up to 2X,
    a finite-element model of a crack between bearings looks like one. But it makes next to no backward 3X,
    and a pulse does.
    """
    order = np.array(WITH_THRICE[: len(change)])
    theta = 2.0 * math.pi * np.arange(32) / 32.0
    direction = np.exp(1j * (theta + _ANGLES[:, np.newaxis]))
    deflection = (
        np.exp(1j * np.outer(theta, HARMONICS[1:])) @ healthy.baseline[1:] - 1j * healthy.rotor.sag_um
    )
    down = -direction.imag  # cosine of the angle between crack and gravity
    breathing = np.stack([(1.0 + down) / 2.0, (1.0 + np.sign(down)) / 2.0])
    force = breathing * (deflection * direction.conj()).real * direction
    spectrum: Complexes = np.asarray(
        force @ np.exp(-1j * np.outer(theta, order)) / len(theta), dtype=np.complex128
    )
    turning = _shaped(
        change,
        variance,
        healthy,
        _passed(spectrum, healthy),
        _CRACK_TOLERANCES,
        lambda loss: loss.real > math.cos(math.pi / 4.0) * np.abs(loss),
    )
    if len(change) > len(HARMONICS):
        return turning
    along_sag = _shaped(
        change,
        variance,
        healthy,
        _pushed(healthy, _FEW_WIDTHS, _TURNS[:1], len(change)),
        _CRACK_TOLERANCES,
        lambda loss: -loss.imag > _CRACK_FACING * np.abs(loss),
    )
    return float(np.logaddexp(turning, along_sag)) - math.log(2.0)


def _rubs(healthy: Healthy, count: int) -> Complexes:
    """Response to every push of a wall, complex128 ``[B, W, T, A, count, 2]``.

    Without the two modes, how the push turns is not asked: it would fit what a wrong rotor leaves over.
    """
    if healthy.rotor.two_modes is not None:
        return _pushed(healthy, _WIDTHS, _TURNS, count)
    return _pushed(healthy, _FEW_WIDTHS, _TURNS[:1], count)


def _pushed(healthy: Healthy, widths: Floats, turns: Floats, count: int) -> Complexes:
    """Response to a push once a revolution, complex128 ``[B, W, T, A, count, 2]``; see `_passed`."""
    order = np.array(WITH_THRICE[:count])
    spread = np.exp(
        -(((order - turns[:, np.newaxis]) * widths[:, np.newaxis, np.newaxis]) ** 2) / 2.0
    )  # [W, T, count]
    at = np.exp(-1j * np.outer(_ANGLES, order))
    return _passed(np.asarray(spread[:, :, np.newaxis] * at, dtype=np.complex128), healthy)


def _passed(force: Complexes, healthy: Healthy) -> Complexes:
    """What forces that repeat with the shaft do to its vector.

    Supports that are softer in one direction do not answer a force that is turned by as much. So the answer
    is given to the force as it is and to the force turned by a right angle, and between them it is linear.

    Args:
        force: complex128 ``[..., n]``, forces at the first n orders of `WITH_THRICE`, over the static
            stiffness.
        healthy: the machine.

    Returns:
        complex128 ``[B, ..., n, 2]``; B are the rotors that it may be.
    """
    places = _PLACES[: (force.shape[-1] + 1) // 2]
    through = _compliances(healthy, len(places))
    through = through.reshape(len(through), *(1,) * (force.ndim - 1), len(places), 2, 2)
    passed = np.empty((len(through), *force.shape, 2), dtype=np.complex128)
    for k, turned in enumerate((1.0, 1j)):
        for order, (forward, backward) in enumerate(places):
            there, back = turned * force[..., forward], (turned * force[..., backward]).conj()
            matrix = through[..., order, :, :]
            passed[..., backward, k] = (matrix[..., 1, 0] * there + matrix[..., 1, 1] * back).conj()
            passed[..., forward, k] = matrix[..., 0, 0] * there + matrix[..., 0, 1] * back
    return passed


def _compliances(healthy: Healthy, count: int) -> Complexes:
    """Deflection by forces of the first orders, complex128 ``[B, count, 2, 2]``: `TwoModes.compliance`."""
    rotor = healthy.rotor.two_modes
    if rotor is not None and rotor.two_modes is not None:
        w = healthy.speed_rad_s / rotor.natural_frequency_rad_s
        return np.array([[rotor.two_modes.compliance(w, order) for order in range(count)]])
    omega, zeta = (axis.reshape(5, 5)[::2, ::2].ravel() for axis in healthy.rotor.box)
    order = np.arange(count)
    through = compliance(order * healthy.speed_rad_s / omega[:, np.newaxis], zeta[:, np.newaxis])
    return np.asarray(through[..., np.newaxis, np.newaxis] * np.eye(2))


def _fitted(change: Complexes, variance: Floats, shape: Complexes) -> tuple[Floats, Floats]:
    """The sizes of shapes that explain a change best, float64 ``[..., 2]``, and what they leave of it."""
    a, b, d = _information(variance, shape)
    seen = change / variance
    towards = [(shape[..., k].conj() * seen).real.sum(axis=-1) for k in (0, 1)]
    whole = np.maximum(a * d - b * b, 1e-300)
    size = np.stack((d * towards[0] - b * towards[1], a * towards[1] - b * towards[0]), axis=-1)
    size /= whole[..., np.newaxis]
    left = (np.abs(change - _of_size(shape, size)) ** 2 / variance).sum(axis=-1)
    return size, left


def _of_size(shape: Complexes, size: Floats) -> Complexes:
    """Shapes times their sizes, complex128 ``[..., n]``."""
    return np.asarray(shape[..., 0] * size[..., :1] + shape[..., 1] * size[..., 1:], dtype=np.complex128)


def _information(variance: Floats, shape: Complexes) -> tuple[Floats, Floats, Floats]:
    """Fisher information of both sizes: elements 00, 01 and 11."""
    first, second = shape[..., 0], shape[..., 1]
    return (
        (np.abs(first) ** 2 / variance).sum(axis=-1),
        ((first.conj() * second).real / variance).sum(axis=-1),
        (np.abs(second) ** 2 / variance).sum(axis=-1),
    )


def _shaped(
    change: Complexes,
    variance: Floats,
    healthy: Healthy,
    shape: Complexes,
    tolerances: Floats,
    possible: Callable[[Complexes], Flags],
) -> float:
    """Log marginal likelihood of a change of known shape and unknown size and direction.

    Args:
        change: complex128 ``[n]``.
        variance: float64 ``[n]``.
        healthy: the machine before.
        shape: complex128 ``[..., n, 2]``, shapes, equally likely; see `_passed`.
        tolerances: relative deviations from the shape, equally likely.
        possible: which of the sizes that fit best can be, complex128 ``[...]`` to bool.
    """
    norm = (np.abs(shape) ** 2).sum(axis=(-2, -1)) / 2.0
    scores = np.full((len(tolerances), len(SPREADS), *norm.shape), -np.inf)
    for i, tolerance in enumerate(tolerances):
        spread = variance + (tolerance * np.abs(change)) ** 2
        for _ in range(2):
            size, _ = _fitted(change, spread, shape)
            spread = variance + (tolerance * np.abs(_of_size(shape, size))) ** 2
        size, left = _fitted(change, spread, shape)
        misfit = left + np.log(spread).sum(axis=-1)
        allowed = possible(size[..., 0] + 1j * size[..., 1])
        a, b, d = _information(spread, shape)
        whole = np.maximum(a * d - b * b, 0.0)
        x, y = size[..., 0], size[..., 1]
        explained = a * x * x + 2.0 * b * x * y + d * y * y
        for j, part in enumerate(SPREADS):
            # Integral over the size, normal with this spread: Sherman and Morrison.
            prior = (part * healthy.amplitude_um) ** 2 / norm
            narrowed = 1.0 + prior * (a + d) + prior**2 * whole
            occam = 0.5 * np.log(narrowed) + (explained + prior * whole * (x * x + y * y)) / narrowed
            scores[i, j] = np.where(allowed, -misfit - occam, -np.inf)
    return log_mean(scores.ravel())


def _facing(force: Complexes, place: Complexes) -> Floats:
    """Cosine of the angle between two directions."""
    return np.asarray((force * place.conj()).real / np.maximum(np.abs(force) * np.abs(place), 1e-300))
