"""How large a fault is, in the figures of that fault: what a name alone does not show."""

from __future__ import annotations

import cmath
import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.laval import unbalance_response
from daqsvc.rotor.synchronous.by_two_modes import damping_left, stiffness_left
from daqsvc.rotor.synchronous.pulses import likeliest_touch

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.rotor.synchronous.signatures import Identification, RotorFault

_DAMPING_LEFT = (0.01, 1.0, 400)


def levels(identification: Identification, calibration: Calibration) -> dict[RotorFault, dict[str, float]]:
    """Level of every fault in the group, by name, in the unit that ends each figure's name.

    * ``unbalance``: ``ratio`` of the 1X vectors after and before, ``change_um`` and ``change_deg`` of the 1X
      vector (from the mark, with the rotation), ``eccentricity_change_um`` that makes it.
    * ``damping_loss``: ``damping_ratio`` left, ``least`` and ``most`` that the rotor's tolerances allow, and
      ``left`` as a part of the healthy one; nothing where no damping explains the change.
    * ``static_load``: ``shift_um`` and ``shift_deg`` of the mean position, ``of_sag`` relative to the sag.
    * ``stiffness_loss``: ``stiffness`` left, as a part of the healthy one.
    * ``rub``: ``backward_1x_um``, ``force_um`` (contact force per revolution over the shaft's stiffness)
      and ``contact_deg``, the shaft angle where it touches.
    * ``unmodelled``, ``small_change``: ``change_um`` of the synchronous vector, and ``nonsynchronous_um``,
      what does not repeat with the shaft, rms of one probe above the healthy one.

    Where a run-up has shown two modes, ``left`` and ``stiffness`` are by them. Without these and without a
    Laval rotor, figures that need a model are left out.
    """
    known: Mapping[RotorFault, Callable[[Identification, Calibration], dict[str, float]]] = {
        "unbalance": _unbalance,
        "damping_loss": _damping_loss,
        "static_load": _static_load,
        "stiffness_loss": _stiffness_loss,
        "rub": _rub,
        "unmodelled": _size,
        "small_change": _size,
    }
    return {name: known[name](identification, calibration) for name in identification.group if name in known}


def _unbalance(identification: Identification, calibration: Calibration) -> dict[str, float]:
    before, change = complex(calibration.baseline[1]), complex(identification.change[1])
    level = {
        "ratio": abs(before + change) / max(abs(before), 1e-12),
        "change_um": abs(change),
        "change_deg": math.degrees(cmath.phase(change)),
    }
    if calibration.laval:
        speed = calibration.speed_rad_s / calibration.rotor.natural_frequency_rad_s
        response = complex(unbalance_response(speed, calibration.rotor.damping_ratio))
        level["eccentricity_change_um"] = abs(change / response)
    return level


def _damping_loss(identification: Identification, calibration: Calibration) -> dict[str, float]:
    modes = calibration.rotor.two_modes
    if modes is not None:
        left = damping_left(identification.change, calibration.healthy, modes)
        return {"damping_ratio": left * modes.damping_ratio, "left": left}
    if not calibration.laval:
        return {}
    omega, zeta = calibration.rotor.box
    left_over = np.linspace(*_DAMPING_LEFT)
    speed = calibration.speed_rad_s / omega[:, np.newaxis]
    before = unbalance_response(speed, zeta[:, np.newaxis])
    ratio = unbalance_response(speed, zeta[:, np.newaxis] * left_over) / before
    misfit = np.abs(identification.change[1] - calibration.baseline[1] * (ratio - 1.0))
    # Every rotor of the box has its own best figure; those that explain the change as well as any count.
    best = misfit.min(axis=1)
    good = best <= best.min() + 0.05 * abs(calibration.baseline[1] + identification.change[1])
    fitted = left_over[misfit.argmin(axis=1)[good]]
    damping = fitted * zeta[good]
    if fitted.min() <= _DAMPING_LEFT[0] or fitted.min() >= _DAMPING_LEFT[1]:
        return {}
    return {
        "damping_ratio": float(np.median(damping)),
        "least": float(damping.min()),
        "most": float(damping.max()),
        "left": float(np.median(fitted)),
    }


def _static_load(identification: Identification, calibration: Calibration) -> dict[str, float]:
    shift = complex(identification.change[0])
    level = {"shift_um": abs(shift), "shift_deg": math.degrees(cmath.phase(shift))}
    if calibration.rotor.sag_um > 0.0:
        level["of_sag"] = abs(shift) / calibration.rotor.sag_um
    return level


def _stiffness_loss(identification: Identification, calibration: Calibration) -> dict[str, float]:
    modes = calibration.rotor.two_modes
    if modes is not None:
        return {"stiffness": stiffness_left(identification.change, calibration.healthy, modes)}
    if not calibration.laval:
        return {}
    rotor, change = calibration.rotor, identification.change
    speed = calibration.speed_rad_s / rotor.natural_frequency_rad_s
    stiffness = np.linspace(0.4, 1.0, 400)
    damped = 2j * rotor.damping_ratio * speed
    moved = (1.0 - speed**2 + damped) / (stiffness - speed**2 + damped) - 1.0
    sag = -1j * rotor.sag_um * (1.0 / stiffness - 1.0)
    misfit = np.abs(change[1] - calibration.baseline[1] * moved) ** 2 + np.abs(change[0] - sag) ** 2
    return {"stiffness": float(stiffness[misfit.argmin()])}


def _rub(identification: Identification, calibration: Calibration) -> dict[str, float]:
    force_um, angle_rad = likeliest_touch(identification.change, calibration.healthy)
    return {
        "backward_1x_um": float(abs(identification.change[2])),
        "force_um": force_um,
        "contact_deg": math.degrees(angle_rad),
    }


def _size(identification: Identification, calibration: Calibration) -> dict[str, float]:
    del calibration
    return {
        "change_um": float(np.sqrt(np.sum(np.abs(identification.change) ** 2))),
        "nonsynchronous_um": math.sqrt(identification.excess / 2.0),
    }
