"""What softer supports, weaker dampers and a load on oil films do to a rotor whose run-up showed two modes.

A Laval rotor answers such a fault by one line in the plane of forward 1X. Real supports part the mode in two,
take a share of the deflection only, and make the shaft whirl backward, too. `daqsvc.rotor.model.TwoModes`
states how mean position, forward and backward 1X move together: what fits all three is no coincidence.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from daqsvc.rotor.model import Film, Pedestal
from daqsvc.rotor.synchronous.vectors import BACKWARD, DC, FORWARD, Healthy, log_density, log_mean

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.model import NormalisedRotor, RotorParameters

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

_LOSSES = np.geomspace(0.01, 1.5, 32)
"""1 / k - 1 of the static stiffness."""
_SEEN = np.array([0.5, 0.7, 1.0, 1.4, 2.0])
"""How far the shaft sinks at the probes, over what the modes predict: it may sink more elsewhere."""
_ASIDE = np.exp(1j * np.radians([-40.0, -20.0, 0.0, 20.0, 40.0]))
"""On an oil film its way down need not be the one that the modes predict."""
_PEDESTALS = (-0.25, 0.0, 0.25)
"""Compliance of a pedestal along x less that along y, over their sum: most are softer along x."""
_LEFT = np.linspace(0.05, 0.97, 32)
"""Parts of the damping that are left."""
_TOLERANCES = np.array([0.1, 0.2, 0.4])
"""How far a change may be from what the modes predict, equally likely."""
_BESIDE = 0.05
"""The least that such a component is off by, as a part of the largest."""
_SHARES = (1.01, 1.08, 1.2, 1.4, 1.8, 2.5, 4.0)
"""Parts of the deflection that supports on springs may take, over the least that makes as much damping."""
_MOST_LAG = 1.5
"""c over k of such supports, times the speed: beyond it a damper holds them more than the spring does."""
_AS_FOUND = 0.5
"""Probability that the supports' part is the one that the run-up shows."""
_AS_WELL = 0.01
"""Part of 1X by which a rotor may explain a change worse than the best one, and count as well."""
_COMPONENTS = [DC, FORWARD, BACKWARD]
_GROWS = ((0.4, 0.0), (0.8, 0.0), (1.2, 0.0), (0.8, 0.4), (1.2, 1.2))
"""Powers of the load that stiffness and damping of an oil film grow with. In a short bearing that carries
little, stiffness follows the load and damping does not (Ocvirk); both do where it carries much, and a
pedestal in series makes it less."""
_LEAST_LOAD, _MOST_LOAD = 0.3, 3.0
"""Load of a film over the healthy one: bounds within which it is followed."""


def softer(change: Complexes, variance: Floats, healthy: Healthy, rotor: RotorParameters) -> float:
    """Log marginal likelihood of mean position and both senses of 1X where supports got softer.

    Args:
        change: complex128 ``[5]``, um.
        variance: float64 ``[5]``, um^2.
        healthy: the machine before.
        rotor: the same with its two modes.
    """
    beside = _moved(healthy, rotor, _beside_dampers())
    if not on_film(healthy.rotor):
        as_found = _likelihood(change, variance, _as_seen(beside, _SEEN))
        alike = _moved_alike(healthy.baseline.tobytes(), healthy.speed_rad_s, rotor).softer
        return _or_alike(as_found, [_likelihood(change, variance, _as_seen(moved, _SEEN)) for moved in alike])
    # Either the film itself is softer, or what holds it up; the latter has no damper beside it.
    films = _likelihood(change, variance, _as_seen(beside, np.outer(_SEEN, _ASIDE).ravel()))
    pedestals = _likelihood(change, variance, _as_seen(_moved(healthy, rotor, _in_series()), _SEEN))
    return float(np.logaddexp(films, pedestals)) - math.log(2.0)


def _beside_dampers() -> list[dict[str, Any]]:
    """Softer springs that have the dampers beside them."""
    return [{"stiffness_ratio": 1.0 / (1.0 + loss)} for loss in _LOSSES]


def _in_series() -> list[dict[str, Any]]:
    """Softer pedestals, in series with springs and dampers."""
    return [{"pedestal": Pedestal(loss, part)} for part in _PEDESTALS for loss in _LOSSES]


def _as_seen(moved: Complexes, ways: Complexes | Floats) -> Complexes:
    """Predicted changes with each of the ways in which the probes may see the mean position move."""
    moved = np.tile(moved, (len(ways), 1, 1))
    moved[..., 0] *= ways[:, np.newaxis]
    return moved.reshape(-1, 3)


def on_film(rotor: LavalRotor) -> bool:
    """Whether oil films carry the shaft: as stated, else by how much its supports push across the sag."""
    if rotor.plain_bearings is not None or rotor.two_modes is None or rotor.two_modes.two_modes is None:
        return bool(rotor.plain_bearings)
    return rotor.two_modes.two_modes.on_film


def loaded(change: Complexes, variance: Floats, healthy: Healthy, rotor: RotorParameters) -> float:
    """Log marginal likelihood of both senses of 1X where oil films carry another load.

    How far the mean position moves shows by how much the load has grown and turned. A film gets stiffer the
    more it carries, and turns with what it carries (Ocvirk's short bearing; Friswell, Penny, Garvey and Lees,
    "Dynamics of Rotating Machines", 2010, section 5.5.2), and 1X follows. The mean position itself is free.

    Args:
        change: complex128 ``[5]``, um.
        variance: float64 ``[5]``, um^2.
        healthy: the machine before.
        rotor: the same with its two modes.
    """
    speed_rpm = healthy.speed_rad_s * 30.0 / np.pi
    still = rotor.faulty(speed_rpm)
    weight = still.load_for(still.rest)
    films = [Film()]
    for seen in _SEEN if weight else ():  # an upright shaft: no weight to compare a load with
        for aside in _ASIDE:
            load = still.load_for(still.rest + complex(change[DC] * aside) / seen) / weight
            grown = min(max(abs(load), _LEAST_LOAD), _MOST_LOAD)
            turned = float(np.angle(load))
            films += [Film(grown**p, grown**q, way) for p, q in _GROWS for way in (0.0, turned)]
    moved = _moved(healthy, rotor, [{"film": film} for film in films])
    return _likelihood(change, variance, moved[:, 1:], [FORWARD, BACKWARD])


def less_damped(change: Complexes, variance: Floats, healthy: Healthy, rotor: RotorParameters) -> float:
    """The same where dampers got weaker."""
    as_found = _likelihood(change, variance, _moved(healthy, rotor, _weaker(rotor)))
    if on_film(healthy.rotor):
        return as_found
    alike = _moved_alike(healthy.baseline.tobytes(), healthy.speed_rad_s, rotor).damped
    return _or_alike(as_found, [_likelihood(change, variance, moved) for moved in alike])


def _weaker(rotor: RotorParameters) -> list[dict[str, Any]]:
    """Dampers that have lost some of their force."""
    return [{"damping_ratio": left * rotor.damping_ratio} for left in _LEFT]


class _Moved(NamedTuple):
    """Changes, complex128 ``[n, 3]`` each, of rotors that are alike: by softer springs, by weaker dampers."""

    softer: tuple[Complexes, ...]
    damped: tuple[Complexes, ...]


@lru_cache(maxsize=16)
def _moved_alike(baseline: bytes, speed_rad_s: float, rotor: RotorParameters) -> _Moved:
    """What faults do to rotors that are alike; asked for again with every look at a change."""
    healthy = np.frombuffer(baseline, dtype=np.complex128), speed_rad_s
    alike = _alike(speed_rad_s, rotor)
    return _Moved(
        tuple(_moved_from(*healthy, other, _beside_dampers()) for other in alike),
        tuple(_moved_from(*healthy, other, _weaker(other)) for other in alike),
    )


def _alike(speed_rad_s: float, rotor: RotorParameters) -> list[RotorParameters]:
    """Rotors that whirl the same at this speed, with supports that take another part of the deflection."""
    assert rotor.two_modes is not None  # noqa: S101 - asked for two modes only
    speed = speed_rad_s / rotor.natural_frequency_rad_s
    return [
        replace(rotor, two_modes=modes, natural_frequency_hz=rotor.natural_frequency_hz * math.sqrt(square))
        for over_least in _SHARES
        for modes, square in rotor.two_modes.alike_at(speed, over_least)
        if speed / math.sqrt(square) * modes.support_lag < _MOST_LAG
    ]


def _or_alike(as_found: float, others: list[float]) -> float:
    """Log likelihood where the rotor may be as it was found, or as well another that whirls the same."""
    if not others:
        return as_found
    alike = log_mean(np.array(others)) + math.log1p(-_AS_FOUND)
    return float(np.logaddexp(as_found + math.log(_AS_FOUND), alike))


def stiffness_left(change: Complexes, healthy: Healthy, rotor: RotorParameters) -> float:
    """Part of the static stiffness that explains a change best; see `softer`."""
    ways = [_moved(healthy, rotor, _beside_dampers())]
    if on_film(healthy.rotor):
        ways.append(_moved(healthy, rotor, _in_series()))
    else:
        ways += _moved_alike(healthy.baseline.tobytes(), healthy.speed_rad_s, rotor).softer
    return _left(change, healthy, ways, 1.0 / (1.0 + _LOSSES))


def damping_left(change: Complexes, healthy: Healthy, rotor: RotorParameters) -> float:
    """Part of the damping that explains a change best; see `less_damped`."""
    ways = [_moved(healthy, rotor, _weaker(rotor))]
    if not on_film(healthy.rotor):
        ways += _moved_alike(healthy.baseline.tobytes(), healthy.speed_rad_s, rotor).damped
    return _left(change, healthy, ways, _LEFT)


def _left(change: Complexes, healthy: Healthy, ways: list[Complexes], left: Floats) -> float:
    """What is left by the rotors that explain a change best; the median where several do as well.

    Args:
        change: complex128 ``[5]``, um.
        healthy: the machine before.
        ways: complex128 ``[n, 3]`` each, changes that one rotor predicts, for all that may be left in turn.
        left: float64, what may be left.
    """
    misfits = [np.sqrt(_misfit(change, moved)) for moved in ways]
    best = np.array([misfit.min() for misfit in misfits])
    fitted = np.array([left[misfit.argmin() % len(left)] for misfit in misfits])
    whirl = float(np.abs(healthy.baseline[[FORWARD, BACKWARD]] + change[[FORWARD, BACKWARD]]).max())
    return float(np.median(fitted[best <= best.min() + _AS_WELL * whirl]))


def _misfit(change: Complexes, moved: Complexes) -> Floats:
    """Square of what predicted changes leave of 1X, float64 ``[n]``.

    The mean position is left out: what the probes see of a shaft that sinks is not known well.
    """
    return np.asarray((np.abs(change[[FORWARD, BACKWARD]] - moved[:, 1:]) ** 2).sum(axis=1))


def _moved(healthy: Healthy, rotor: RotorParameters, faults: list[dict[str, Any]]) -> Complexes:
    """Change of the mean position, forward and backward 1X by faults, complex128 ``[n, 3]``, um.

    The unbalance is that of the baseline, which need not be that of the run-up.
    """
    return _moved_from(healthy.baseline, healthy.speed_rad_s, rotor, faults)


def _moved_from(
    baseline: Complexes, speed_rad_s: float, rotor: RotorParameters, faults: list[dict[str, Any]]
) -> Complexes:
    speed_rpm = speed_rad_s * 30.0 / np.pi
    before = _orbit(rotor.faulty(speed_rpm))
    balance = baseline[FORWARD] / before[1]
    change = np.array([_orbit(rotor.faulty(speed_rpm, **fault)) for fault in faults]) - before
    return np.asarray(change * np.array([1.0, balance, balance.conjugate()]))


def _orbit(rotor: NormalisedRotor) -> Complexes:
    forward, backward = rotor.runout[1:]
    return np.array([rotor.rest, rotor.orbit() - forward, rotor.backward_orbit() - backward])


def _likelihood(
    change: Complexes, variance: Floats, moved: Complexes, components: list[int] = _COMPONENTS
) -> float:
    size = np.abs(moved).max(axis=1, keepdims=True)
    spread = (
        variance[components]
        + (_TOLERANCES[:, np.newaxis, np.newaxis] * np.maximum(np.abs(moved), _BESIDE * size)) ** 2
    )
    return log_mean(log_density(change[components] - moved, spread).sum(axis=-1).ravel())
