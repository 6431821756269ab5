"""A machine in time: exact steps of what is linear, a force in each step for what is not.

The linear part (elements, oil films, gyroscopic moments) is propagated by its matrix exponential. Contact, a
crack that breathes and a loose support are forces of the position at the begin of a step; a step is 1/1024 of
a revolution.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numba
import numpy as np
import scipy.linalg
from plants.timing import PER_REV

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray
    from plants.machines import Machine

    Floats = NDArray[np.float64]
    Complexes = NDArray[np.complex128]

_SUBSTEPS = 16
_SETTLING_REV = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class Contact:
    """A stator that the shaft may touch.

    Attributes:
        centre: of the clearance, m, x + i y.
        clearance_m: radial.
        stiffness_n_m: of the stator.
        friction: Coulomb's coefficient.
    """

    centre: complex
    clearance_m: float
    stiffness_n_m: float
    friction: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Crack:
    """A loss of bending stiffness in one direction of the shaft.

    Attributes:
        loss: part of the element's bending stiffness.
        angle_rad: of the weak direction against the shaft angle.
        breathes: whether it opens below and closes above; else it is open always, as a keyway.
    """

    loss: float
    angle_rad: float
    breathes: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Loose:
    """A support that holds less upwards than downwards.

    Attributes:
        support: its number.
        lost_n_m: stiffness that is missing above the rest position.
    """

    support: int
    lost_n_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """How a machine is from some revolution on.

    Attributes:
        begin_rev: from where on.
        machine: linear part.
        turning: complex128 ``[3, n]``, forces at 0, 1 and 2 times the shaft speed besides weight; the real
            part of force times e^{i k theta} acts.
        contact: none if there is no stator near.
        crack: none if the shaft is whole.
        loose: none if all supports hold.
    """

    begin_rev: float
    machine: Machine
    turning: Complexes
    contact: Contact | None = None
    crack: Crack | None = None
    loose: Loose | None = field(default=None)


@dataclass(frozen=True, slots=True)
class Motion:
    """What the probes would see of a shaft without noise.

    Attributes:
        position_m: complex128 ``[n]``, x + i y at the probes.
        rub_m: complex128 ``[n]``, the same where it would rub.
        angle_rad: float64 ``[n]``, shaft angle, from 0.
        rate_hz: sampling rate.
    """

    position_m: Complexes
    rub_m: Complexes
    angle_rad: Floats
    rate_hz: float


def move(stages: Sequence[Stage], speed_rad_s: float, revolutions: int, hunting: Floats) -> Motion:
    """Let the machine run.

    Args:
        stages: from the first one, at revolution 0, on.
        speed_rad_s: mean shaft speed.
        revolutions: how long.
        hunting: float64 ``[2]``, relative amplitude of the speed's variation and its period in revolutions.
    """
    rate_hz = speed_rad_s / (2.0 * math.pi) * PER_REV
    tables = _tables(stages, rate_hz)
    samples = (revolutions + _SETTLING_REV) * PER_REV
    at_rev = np.arange(samples) / PER_REV - _SETTLING_REV
    begins = np.array([stage.begin_rev for stage in stages])
    which = np.maximum(np.searchsorted(begins, at_rev, side="right") - 1, 0)
    fine = (np.arange(samples * _SUBSTEPS) + 0.5) / (PER_REV * _SUBSTEPS) - _SETTLING_REV
    depth, period = hunting
    angle = 2.0 * math.pi * (fine + depth * period / (2.0 * math.pi) * np.sin(2.0 * math.pi * fine / period))
    seen = _run(*tables, which, angle, np.ones(len(angle), dtype=np.complex128))
    kept = slice(_SETTLING_REV * PER_REV, None)
    turned = (
        2.0 * math.pi * (at_rev + depth * period / (2.0 * math.pi) * np.sin(2.0 * math.pi * at_rev / period))
    )
    return Motion(
        seen[kept, 0] + 1j * seen[kept, 1], seen[kept, 2] + 1j * seen[kept, 3], turned[kept], rate_hz
    )


def run_through(stages: Sequence[Stage], speeds_rad_s: Floats, revolutions: int) -> Motion:
    """Let the machine run up evenly in time, from the first speed to the last.

    Args:
        stages: the machine at each speed; forces at the shaft speed are over its square.
        speeds_rad_s: float64 ``[S]``, rising.
        revolutions: how long.
    """
    low, high = float(speeds_rad_s[0]), float(speeds_rad_s[-1])
    rate_hz = high / (2.0 * math.pi) * PER_REV
    duration_s = 2.0 * math.pi * revolutions / ((low + high) / 2.0)
    samples = round(duration_s * rate_hz)
    rate = (high - low) / duration_s
    settling = round(_SETTLING_REV * 2.0 * math.pi / low * rate_hz)
    fine = (np.arange((samples + settling) * _SUBSTEPS) + 0.5) / (rate_hz * _SUBSTEPS)
    fine -= settling / rate_hz
    begun = np.maximum(fine, 0.0)
    angle = low * fine + 0.5 * rate * begun**2
    speed = low + rate * begun
    at_s = np.maximum((np.arange(samples + settling) - settling) / rate_hz, 0.0)
    which = np.searchsorted(speeds_rad_s[1:], low + rate * at_s + 0.5 * (speeds_rad_s[1] - low))
    # With the speed's growth the heavy spot is also pulled along: theta'^2 - i theta''.
    force = speed**2 - 1j * np.where(fine > 0.0, rate, 0.0)
    seen = _run(*_tables(stages, rate_hz), which, angle, force)
    kept = slice(settling, None)
    turned = low * at_s[kept] + 0.5 * rate * at_s[kept] ** 2
    return Motion(seen[kept, 0] + 1j * seen[kept, 1], seen[kept, 2] + 1j * seen[kept, 3], turned, rate_hz)


def _tables(stages: Sequence[Stage], rate_hz: float) -> tuple[Floats, ...]:
    """What `_run` steps with: of each stage, and of the machine."""
    step_s = 1.0 / (rate_hz * _SUBSTEPS)
    n = len(stages[0].machine.mass)
    propagators, forced, statics, parameters = [], [], [], []
    for stage in stages:
        m = stage.machine
        inverse = np.linalg.inv(m.mass)
        a = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ m.stiffness, -inverse @ m.damping]])
        e = scipy.linalg.expm(a * step_s)
        propagators.append(e)
        forced.append(np.linalg.solve(a, (e - np.eye(2 * n)) @ np.vstack((np.zeros((n, n)), inverse))))
        statics.append(m.stiffness @ m.rest)
        parameters.append(_parameters(stage))
    first = stages[0].machine
    rows = np.array(
        [first.places[f"{where} {axis}"] for where in ("probe", "rub", "bend") for axis in "xy"]
        + [first.places[f"support {i} y"] for i in (0, 1)]
    )
    return (
        np.array(propagators),
        np.array(forced),
        np.array(statics),
        np.array([stage.turning for stage in stages]),
        np.array(parameters),
        rows,
        np.concatenate((first.rest, np.zeros(n))),
    )


def _parameters(stage: Stage) -> Floats:
    """Figures of what is not linear, float64 ``[10]``."""
    contact, crack, loose = stage.contact, stage.crack, stage.loose
    figures = np.zeros(10)
    if contact is not None:
        figures[:5] = (
            contact.centre.real,
            contact.centre.imag,
            contact.clearance_m,
            contact.stiffness_n_m,
            contact.friction,
        )
    if crack is not None:
        figures[5:8] = (crack.loss * stage.machine.bending_n_m, crack.angle_rad, float(crack.breathes))
    if loose is not None:
        figures[8:] = (loose.support, loose.lost_n_m)
    return figures


@numba.njit(cache=True)
def _run(propagators, forced, statics, turning, parameters, rows, state, which, angle, once):
    samples = len(which)
    n = statics.shape[1]
    seen = np.empty((samples, 4))
    rest_y = np.zeros(2)
    for i in range(2):
        rest_y[i] = rows[6 + i] @ state[:n]
    k = 0
    for i in range(samples):
        stage = which[i]
        p = parameters[stage]
        e, g = propagators[stage], forced[stage]
        for j in range(4):
            seen[i, j] = rows[j] @ state[:n]
        for _ in range(len(angle) // samples):
            theta, at_1x = angle[k], once[k]
            k += 1
            q = state[:n]
            f = statics[stage].copy()
            for order in range(3):
                c, s = math.cos(order * theta), math.sin(order * theta)
                part = turning[stage, order] * at_1x if order == 1 else turning[stage, order]
                f += part.real * c - part.imag * s
            if p[3] > 0.0:
                x, y = rows[2] @ q - p[0], rows[3] @ q - p[1]
                r = math.hypot(x, y)
                if r > p[2]:
                    push = p[3] * (r - p[2]) / r
                    f -= push * (x - p[4] * y) * rows[2] + push * (y + p[4] * x) * rows[3]
            if p[5] > 0.0:
                cx, cy = math.cos(theta + p[6]), math.sin(theta + p[6])
                opened = 1.0
                if p[7] > 0.0:
                    opened = (1.0 - cy) / 2.0
                bend = rows[4] @ q * cx + rows[5] @ q * cy
                f += p[5] * opened * bend * (cx * rows[4] + cy * rows[5])
            if p[9] > 0.0:
                which_support = int(p[8])
                lifted = rows[6 + which_support] @ q - rest_y[which_support]
                if lifted > 0.0:
                    f += p[9] * lifted * rows[6 + which_support]
            state = e @ state + g @ f
    return seen
