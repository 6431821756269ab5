"""What kind of motion it is: whirl, Poincare section, recurrence, growth of a small displacement.

Positions are complex, z = x + iy in clearances. A Poincare section takes the disc once a revolution,
where the keyphasor sees the mark.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.integrate import solve_ivp

from sim_hw.plants.rotor import PlantParameters, contact_force, simulate, state_derivative

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Complexes = NDArray[np.complex128]

_SETTLING_REV = 200
"""A rub settles with zeta = 0.02: by a factor of 1e10 in this time."""
_WATCHED_REV = 400
_DISPLACEMENT = 1e-5
_HARMONICS = 12
_OUTSIDE = 2.0
"""A disc this many clearances from the centre has left its housing."""


def whirl_per_rev(z: Complexes, samples_per_rev: int) -> float:
    """Mean turns of the disc's position about the housing's centre in a shaft revolution; below 0 backward.

    Args:
        z: complex128 ``[n]``, positions.
        samples_per_rev: samples in a revolution.
    """
    angle = np.unwrap(np.angle(z))
    return float((angle[-1] - angle[0]) / (2.0 * math.pi) / (len(z) - 1) * samples_per_rev)


def spread(section: Complexes) -> float:
    """Largest distance in clearances of a point of a Poincare section from their mean; 0 for period one."""
    return float(np.abs(section - section.mean()).max())


@dataclass(frozen=True, slots=True)
class SettledRub:
    """The rub after its transient, over hundreds of revolutions.

    Attributes:
        revolutions: length of what was watched.
        whirl_per_rev: mean whirl.
        largest_radius: in clearances.
        section: complex128 ``[revolutions]``, the Poincare section.
        return_rev: revolutions after which the section comes back nearest to itself.
        return_miss: largest distance, in clearances, by which it misses itself then.
        drift: distance after the most of such periods that were watched over that after one: 1 if
            the motion repeats itself and noise is all that remains, their number if it is quasi-periodic.
        periods: the number of such periods.
        rotation_per_rev: turns of the section's points along their curve in a revolution.
        curve_residual: rms distance in clearances of the later half of the section from a closed curve
            through the earlier half; small if the section is a closed curve.
        growth_per_rev: exponent by which a small displacement grows, per revolution; above 0 in chaos.
    """

    revolutions: int
    whirl_per_rev: float
    largest_radius: float
    section: Complexes
    return_rev: int
    return_miss: float
    drift: float
    periods: int
    rotation_per_rev: float
    curve_residual: float
    growth_per_rev: float


def settled_rub(rotor: PlantParameters, start: Floats, samples_per_rev: int) -> SettledRub:
    """Watch a rotor that rubs until it has settled, and from then on.

    Args:
        rotor: the rotor.
        start: state ``[x, x', y, y']`` to start from.
        samples_per_rev: samples in a revolution.
    """
    revolutions = _SETTLING_REV + _WATCHED_REV
    z, displaced = (
        _positions(rotor, start + offset, revolutions, samples_per_rev)
        for offset in (np.zeros(4), np.array([_DISPLACEMENT, 0.0, 0.0, 0.0]))
    )
    late = slice(_SETTLING_REV * samples_per_rev, None)
    section = z[late][::samples_per_rev]
    lags = np.arange(1, len(section) // 4)
    misses = np.array([np.abs(section[lag:] - section[:-lag]).max() for lag in lags])
    return_rev = int(lags[misses.argmin()])
    periods = (len(section) - 1) // return_rev
    far = np.abs(section[periods * return_rev :] - section[: -periods * return_rev]).max()
    distance = np.abs(displaced - z)[late].reshape(-1, samples_per_rev).mean(axis=1)
    rotation = _rotation_per_rev(section)
    return SettledRub(
        revolutions=_WATCHED_REV,
        whirl_per_rev=whirl_per_rev(z[late], samples_per_rev),
        largest_radius=float(np.abs(z[late]).max()),
        section=section,
        return_rev=return_rev,
        return_miss=float(misses.min()),
        drift=float(far / misses.min()),
        periods=periods,
        rotation_per_rev=rotation,
        curve_residual=_curve_residual(section, rotation),
        growth_per_rev=float(np.polyfit(np.arange(len(distance)), np.log(distance), 1)[0]),
    )


def _positions(rotor: PlantParameters, start: Floats, revolutions: float, samples_per_rev: int) -> Complexes:
    motion = simulate(rotor, revolutions=revolutions, samples_per_rev=samples_per_rev, initial=start)
    return motion.x + 1j * motion.y


def _rotation_per_rev(section: Complexes) -> float:
    """The strongest line of the section's spectrum, refined until the points do not drift against it."""
    k = np.arange(len(section))
    centred = section - section.mean()
    spectrum = np.abs(np.fft.fft(centred * np.hanning(len(section)), 16 * len(section)))
    rotation = float(np.fft.fftfreq(len(spectrum))[spectrum.argmax()])
    half = len(section) // 2
    window = np.hanning(half)
    for _ in range(5):
        turned = centred * np.exp(-2j * math.pi * rotation * k)
        early, late = window @ turned[:half], window @ turned[half : 2 * half]
        rotation += float(np.angle(late / early)) / (2.0 * math.pi) / half
    return rotation


def _curve_residual(section: Complexes, rotation_per_rev: float) -> float:
    k = np.arange(len(section))
    orders = np.arange(-_HARMONICS, _HARMONICS + 1)
    basis = np.exp(2j * math.pi * rotation_per_rev * np.outer(k, orders))
    half = len(section) // 2
    curve, *_ = np.linalg.lstsq(basis[:half], section[:half], rcond=None)
    return float(np.sqrt(np.mean(np.abs(section[half:] - basis[half:] @ curve) ** 2)))


def whirl_of_model(rotor: PlantParameters, start: Floats, samples_per_rev: int) -> float:
    """Whirl of a rotor that is left to itself, per revolution, once it has settled.

    Args:
        rotor: the rotor.
        start: state ``[x, x', y, y']`` to start from.
        samples_per_rev: samples in a revolution.
    """
    z = _positions(rotor, start, _SETTLING_REV, samples_per_rev)
    return whirl_per_rev(z[len(z) // 2 :], samples_per_rev)


def escape_with_printed_signs(rotor: PlantParameters, start: Floats) -> float:
    """The state equation as printed, ``x' = Ax + Bu + gamma f(Cx)``: the housing pulls the disc outwards.

    Args:
        rotor: the rotor.
        start: state ``[x, x', y, y']`` to start from.

    Returns:
        Revolutions from the first contact to two clearances from the centre.

    Raises:
        ArithmeticError: the rotor did not leave its housing.
    """

    def derivative(tau: float, state: Floats) -> list[float]:
        vx, ax, vy, ay = state_derivative(tau, state, rotor)
        fx, fy = contact_force(
            state[0], state[1], state[2], state[3],
            rotor.contact_stiffness, rotor.contact_exponent, rotor.friction,
            rotor.speed_ratio * rotor.disc_radius,
        )  # fmt: skip
        return [vx, ax - 2.0 * fx, vy, ay - 2.0 * fy]

    def touches(_tau: float, state: Floats) -> float:
        return math.hypot(state[0], state[2]) - 1.0

    def outside(_tau: float, state: Floats) -> float:
        return math.hypot(state[0], state[2]) - _OUTSIDE

    outside.terminal = True  # type: ignore[attr-defined]
    per_rev = 2.0 * math.pi / rotor.speed_ratio
    # Short steps, so that no trial step reaches the radius at which the plant gives up.
    solution = solve_ivp(
        derivative, (0.0, 20.0 * per_rev), start, events=(touches, outside), max_step=1e-2, rtol=1e-8
    )
    events = solution.t_events
    if events is None or not len(events[1]):
        raise ArithmeticError(f"with the printed signs {rotor} stayed inside {_OUTSIDE} clearances")
    contact, escape = float(events[0][0]), float(events[1][0])
    return (escape - contact) / per_rev


def rub_limit(rotor: PlantParameters) -> float:
    """Damping ratio below which the steady orbit about the sagging shaft reaches the housing.

    Args:
        rotor: the rotor; its own damping does not matter. Holds at resonance, w^2 = k.
    """
    room = 1.0 - abs(rotor.rest)
    return abs(replace(rotor, damping_ratio=1.0).orbit_1x) / room
