"""Marks of contact: what a rub leaves on an orbit and no linear change of the rotor can.

A support that gives way, a load, more unbalance, less damping: all of them leave the rotor linear, and a
linear rotor that turns steadily moves at 0 and 1 times its speed only. Backward 1X is no mark: a support that
is softer in one direction makes it. Contact pushes for a part of each revolution, so it leaves harmonics.
Where they do not stand out, a change that the pulse of a rub happens to fit is no rub. It may be one only if
noise would hide them, the rotor's model holds, and backward 1X or 3X has moved with it. The model then
predicts how such a pulse moves them together. A pulse can be made to fit any shift of the mean position with
any forward 1X.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.vectors import BACKWARD, BEYOND_2X, DC, FORWARD, HARMONICS, TWICE, Healthy

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

_LEAST_NATS = 6.0
"""Both senses of 2X together pass this by chance once in 60 evaluations."""
_LINEAR_2X = 0.003
"""Part of a change that a linear rotor leaves at 2X, by runout that is resampled."""
_FILLED = 0.9
"""Part of the clearance beyond which an orbit touches, whatever shape it has by then."""
_ROOM_TAKEN = 0.75
"""Part of the room outside the healthy orbit that an orbit takes up by then. Where the sag takes nearly all
of the clearance, the healthy orbit itself comes that near to the wall."""
_BEYOND_1X = 0.02
"""Part of the healthy whirl that must move in addition to forward 1X where the clearance is filled."""
_ROUND = 0.7
"""Part of the clearance beyond which an orbit stays that whirls around its centre."""
_2X_OF_CONTACT = 0.01
"""Part of a change up to the wall that contact leaves at 2X, or more (finite-element rotors)."""
_ORBIT_POINTS = 64
_TURNING = np.exp(1j * np.outer(2.0 * np.pi * np.arange(_ORBIT_POINTS) / _ORBIT_POINTS, HARMONICS))
_VISIBLE = 3.0
_LEAK = 0.01
"""Part of a change that backward 1X and 3X may move by on a rotor that is not exactly a linear one."""
_IN_PLANE = 0.5
"""How far backward 1X may be from that of an elliptic orbit with the same forward 1X, as a part of that."""


def has_marks(change: Complexes, variance: Floats) -> bool:
    """Whether harmonics came with a change.

    Args:
        change: complex128 ``[5]``, in the order of `HARMONICS`, um.
        variance: float64 ``[5]``, um^2.
    """
    moved = float(np.abs(change).max())
    twice = np.abs(change[TWICE]) ** 2 / (variance[TWICE] + (_LINEAR_2X * moved) ** 2)
    return float(twice.sum()) > _LEAST_NATS


def moves_besides(change: Complexes, variance: Floats, healthy: Healthy) -> bool:
    """Whether backward 1X or 3X has moved by more than mean position and forward 1X bring with them.

    An elliptic orbit that grows does so in both senses: that part of backward 1X is a linear rotor's.

    Args:
        change: complex128 ``[5]`` or, with 3X, ``[7]``, um.
        variance: float64, as many, um^2.
        healthy: the machine before.
    """
    leak = (_LEAK * float(np.abs(change).max())) ** 2
    forward, backward = healthy.baseline[FORWARD], healthy.baseline[BACKWARD]
    in_plane = np.conj(change[FORWARD] / forward) * backward if forward else 0.0
    nats = np.abs(change[BEYOND_2X]) ** 2 / (variance[BEYOND_2X] + leak)
    beside = abs(change[BACKWARD] - in_plane) ** 2
    beside /= variance[BACKWARD] + leak + (_IN_PLANE * abs(in_plane)) ** 2
    alone = abs(change[BACKWARD]) ** 2 / (variance[BACKWARD] + leak)
    return bool(max((min(alone, beside), *nats.tolist())) > _LEAST_NATS)


def resolved(variance: Floats, healthy: Healthy) -> Floats:
    """Variance of the measurement alone, um^2: what a machine wanders by hides no harmonics of contact.

    Args:
        variance: float64, of a change, um^2, the wander of `Healthy.floor_um2` included.
        healthy: the machine before.
    """
    return np.maximum(variance - healthy.floor_um2, 0.0)


def marks_would_show(change: Complexes, variance: Floats) -> bool:
    """Whether noise is low enough that the harmonics of a rub of this size would be seen.

    Args:
        change: complex128 ``[5]``, um.
        variance: float64 ``[5]``, um^2.
    """
    return _visible(_LINEAR_2X * float(np.abs(change[[FORWARD, BACKWARD]]).max()), variance)


def contact_would_show(change: Complexes, variance: Floats) -> bool:
    """The same of a rub that holds the orbit at the wall.

    Args:
        change: complex128 ``[5]``, um.
        variance: float64 ``[5]``, um^2.
    """
    return _visible(_2X_OF_CONTACT * float(np.abs(change[[DC, FORWARD, BACKWARD]]).max()), variance)


def _visible(twice_um: float, variance: Floats) -> bool:
    """Whether 2X of this size would be seen in the noise."""
    return bool(_VISIBLE * np.sqrt(float(variance[TWICE].max())) < twice_um)


def reaches_wall(position: Complexes, healthy: Healthy) -> bool:
    """Whether the orbit comes so much nearer to the wall that it touches, by what is known of the clearance.

    Args:
        position: complex128 ``[5]``, the present synchronous vector, um.
        healthy: the machine before.
    """
    clearance_um = healthy.rotor.clearance_um
    if clearance_um is None:
        return False
    reach, before = (float(np.abs(_TURNING @ one).max()) for one in (position, healthy.baseline))
    return reach > max(_FILLED * clearance_um, before + _ROOM_TAKEN * (clearance_um - before))


def whirls_around(position: Complexes, healthy: Healthy) -> bool:
    """Whether the orbit goes around the clearance along its wall: contact that lasts leaves no harmonics.

    Args:
        position: complex128 ``[5]``, the present synchronous vector, um.
        healthy: the machine before.
    """
    clearance_um = healthy.rotor.clearance_um
    if clearance_um is None:
        return False
    around = 2.0 * abs(position[DC]) < np.abs(position[1:]).sum()
    return bool(around and np.abs(_TURNING @ position).min() > _ROUND * clearance_um)


def fills_clearance(position: Complexes, change: Complexes, variance: Floats, healthy: Healthy) -> bool:
    """Whether the orbit reaches the wall, and more than forward 1X has moved.

    A shaft that only comes to rest beside the wall leaves no harmonics, and does not go around it.

    Args:
        position: complex128 ``[5]``, the present synchronous vector, um.
        change: complex128 ``[5]``, um.
        variance: float64 ``[5]``, um^2.
        healthy: the machine before.
    """
    if not reaches_wall(position, healthy):
        return False
    alone = resolved(variance, healthy)
    if contact_would_show(change, alone) and not (
        has_marks(change, alone) or whirls_around(position, healthy)
    ):
        return False
    others = [DC, BACKWARD, *TWICE]
    least = 9.0 * variance[others] + (_BEYOND_1X * healthy.amplitude_um) ** 2
    return bool((np.abs(change[others]) ** 2 > least).any())
