"""What softer supports and weaker dampers do to a rotor whose run-up showed two modes.

A Laval rotor answers such a fault by one line in the plane of forward 1X. Real supports part the mode in two,
take a share of the deflection only, and make the shaft whirl backward, too. `daqsvc.rotor.model.TwoModes`
states how mean position, forward and backward 1X move together: what fits all three is no coincidence.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.vectors import BACKWARD, DC, FORWARD, Healthy, log_density, log_mean

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.model import NormalisedRotor, RotorParameters

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

_LOSSES = np.geomspace(0.01, 1.5, 32)
"""1 / k - 1 of the static stiffness."""
_SEEN = np.array([0.5, 0.7, 1.0, 1.4, 2.0])
"""How far the shaft sinks at the probes, over what the modes predict: it may sink more elsewhere."""
_FILM = 0.05
"""Above this stiffness across the deflection, over the static one, an oil film carries the shaft ..."""
_ASIDE = np.exp(1j * np.radians([-40.0, -20.0, 0.0, 20.0, 40.0]))
"""... so that its way down need not be the one that the modes predict."""
_LEFT = np.linspace(0.05, 0.97, 32)
"""Parts of the damping that are left."""
_TOLERANCES = np.array([0.1, 0.2, 0.4])
"""How far a change may be from what the modes predict, equally likely."""
_BESIDE = 0.05
"""The least that such a component is off by, as a part of the largest."""
_COMPONENTS = [DC, FORWARD, BACKWARD]


def softer(change: Complexes, variance: Floats, healthy: Healthy, rotor: RotorParameters) -> float:
    """Log marginal likelihood of mean position and both senses of 1X where supports got softer.

    Args:
        change: complex128 ``[5]``, um.
        variance: float64 ``[5]``, um^2.
        healthy: the machine before.
        rotor: the same with its two modes.
    """
    moved = _moved(healthy, rotor, [{"stiffness_ratio": 1.0 / (1.0 + loss)} for loss in _LOSSES])
    film = rotor.two_modes is not None and abs(rotor.two_modes.cross_stiffness) > _FILM
    ways = np.outer(_SEEN, _ASIDE if film else [1.0]).ravel()
    moved = np.tile(moved, (len(ways), 1, 1))
    moved[..., 0] *= ways[:, np.newaxis]
    return _likelihood(change, variance, moved.reshape(-1, 3))


def less_damped(change: Complexes, variance: Floats, healthy: Healthy, rotor: RotorParameters) -> float:
    """The same where dampers got weaker."""
    damping_ratio = rotor.damping_ratio
    moved = _moved(healthy, rotor, [{"damping_ratio": left * damping_ratio} for left in _LEFT])
    return _likelihood(change, variance, moved)


def stiffness_left(change: Complexes, healthy: Healthy, rotor: RotorParameters) -> float:
    """Part of the static stiffness that explains a change best; see `softer`."""
    left = 1.0 / (1.0 + _LOSSES)
    moved = _moved(healthy, rotor, [{"stiffness_ratio": part} for part in left])
    return float(left[_misfit(change, moved).argmin()])


def damping_left(change: Complexes, healthy: Healthy, rotor: RotorParameters) -> float:
    """Part of the damping that explains a change best."""
    moved = _moved(healthy, rotor, [{"damping_ratio": left * rotor.damping_ratio} for left in _LEFT])
    return float(_LEFT[_misfit(change, moved).argmin()])


def _misfit(change: Complexes, moved: Complexes) -> Floats:
    """Square of what predicted changes leave of 1X, float64 ``[n]``.

    The mean position is left out: what the probes see of a shaft that sinks is not known well.
    """
    return np.asarray((np.abs(change[[FORWARD, BACKWARD]] - moved[:, 1:]) ** 2).sum(axis=1))


def _moved(healthy: Healthy, rotor: RotorParameters, faults: list[dict[str, float]]) -> Complexes:
    """Change of the mean position, forward and backward 1X by faults, complex128 ``[n, 3]``, um.

    The unbalance is that of the baseline, which need not be that of the run-up.
    """
    speed_rpm = healthy.speed_rad_s * 30.0 / np.pi
    before = _orbit(rotor.faulty(speed_rpm))
    balance = healthy.baseline[FORWARD] / before[1]
    change = np.array([_orbit(rotor.faulty(speed_rpm, **fault)) for fault in faults]) - before
    return np.asarray(change * np.array([1.0, balance, balance.conjugate()]))


def _orbit(rotor: NormalisedRotor) -> Complexes:
    forward, backward = rotor.runout[1:]
    return np.array([rotor.rest, rotor.orbit() - forward, rotor.backward_orbit() - backward])


def _likelihood(change: Complexes, variance: Floats, moved: Complexes) -> float:
    size = np.abs(moved).max(axis=1, keepdims=True)
    spread = (
        variance[_COMPONENTS]
        + (_TOLERANCES[:, np.newaxis, np.newaxis] * np.maximum(np.abs(moved), _BESIDE * size)) ** 2
    )
    return log_mean(log_density(change[_COMPONENTS] - moved, spread).sum(axis=-1).ravel())
