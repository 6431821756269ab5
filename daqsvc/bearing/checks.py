"""Whether a bearing's two sensors can show its faults at all, explained in words.

The paper asks for observability, for independent fault spaces under C, and for a stable filter. Two more
things decide in practice: the model's invariant zeros, which forbid to integrate, and how much alike the two
races look, which no gain of a filter can change.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.detection_filter import fixed_eigenvalues, separation_deg
from daqsvc.bearing.model import BearingModel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.bearing.model import BearingParameters, Floats

_POINTS = 400
_PLAIN_DEG = 10.0
"""Races that look so much different stay apart in a model that is wrong by a tenth."""
_RANK_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Check:
    """One question about a bearing and its answer.

    Attributes:
        name: of the check.
        passed: whether the answer lets the two races be told apart.
        value: the number behind it.
        unit: of the number.
        explanation: a sentence for a person.
    """

    name: str
    passed: bool
    value: float
    unit: str
    explanation: str


def check(parameters: BearingParameters, *, highest_hz: float = 12_000.0) -> Sequence[Check]:
    """Ask everything.

    Args:
        parameters: of the healthy bearing.
        highest_hz: up to which both accelerometers are flat.
    """
    model = BearingModel(parameters)
    return (
        _observable(model),
        _independent(model),
        _zeros(model),
        _stable(model),
        _alike(model, highest_hz),
    )


def observability(model: BearingModel) -> Floats:
    """Least singular value of [A - s I; C] over all eigenvalues s of A, each row in its own scale (PBH).

    Returns:
        float64 ``[6]``; above 0 for every eigenvalue that the sensors see.
    """
    A, scale = _scaled(model)
    C = model.C * scale
    C = C / np.linalg.norm(C, axis=1, keepdims=True)
    least = []
    for s in np.linalg.eigvals(A):
        stacked = np.vstack((A - s * np.eye(6), C * np.abs(s)))
        least.append(np.linalg.svd(stacked, compute_uv=False)[-1] / np.abs(s))
    return np.array(least)


def fault_space_condition(model: BearingModel) -> float:
    """Condition number of C [F_1 F_2], columns in their own scale; infinite if they fall together."""
    CF = model.C @ model.F
    return float(np.linalg.cond(CF / np.linalg.norm(CF, axis=0)))


def invariant_zeros(model: BearingModel) -> int:
    """How many of the six invariant zeros of (A, F, C, D) are at s = 0.

    D is regular, so that the zeros are the eigenvalues of A - F D^-1 C; all six are 0 if it is nilpotent.
    """
    A, scale = _scaled(model)
    inverse = A - (model.F / scale[:, None]) @ np.linalg.solve(model.D, model.C * scale) / _rate(model)
    size = np.linalg.norm(inverse)
    power = np.linalg.matrix_power(inverse / size, 6)
    return 6 if np.linalg.norm(power) < _RANK_TOLERANCE else int(np.linalg.matrix_rank(power))


def _rate(model: BearingModel) -> float:
    """A rate of the order of the ball's mode in 1/s, to make velocities and positions alike in size."""
    return 2.0 * np.pi * model.modes_hz[2]


def _scaled(model: BearingModel) -> tuple[Floats, Floats]:
    """A in the time unit 1/w of the ball's mode and states of one size; also the size of each state."""
    w = _rate(model)
    scale = np.tile([1.0, w], 3)
    return model.A * scale / scale[:, None] / w, scale


def _observable(model: BearingModel) -> Check:
    least = float(observability(model).min())
    passed = least > _RANK_TOLERANCE
    text = (
        "every motion of the three masses shows in the two accelerometers"
        if passed
        else "a motion of the masses is invisible to both accelerometers: an observer cannot follow it"
    )
    return Check("observability", passed, least, "", text)


def _independent(model: BearingModel) -> Check:
    condition = fault_space_condition(model)
    passed = condition < 1.0 / _RANK_TOLERANCE
    text = (
        "the fault spaces of inner and outer race are independent under C: the paper's gain exists"
        if passed
        else "the fault spaces of both races fall together under C: give the dampings c_s and c_c or c_h"
    )
    return Check("fault spaces", passed, condition, "", text)


def _zeros(model: BearingModel) -> Check:
    zeros = invariant_zeros(model)
    return Check(
        "invariant zeros",
        zeros == 6,
        float(zeros),
        "",
        "all six invariant zeros are at s = 0: accelerometers do not feel where the masses rest, so that an "
        "exact filter must integrate; the residual is high-passed to keep it stable"
        if zeros == 6
        else "some invariant zero is not at s = 0: the parameters are not those of three masses in a line",
    )


def _stable(model: BearingModel) -> Check:
    fixed = fixed_eigenvalues(model)
    slowest = fixed.slowest_per_s
    return Check(
        "stability",
        slowest > 0.0,
        slowest,
        "1/s",
        f"the paper's filter is stable, as it is for all positive parameters; its slowest error dies out in "
        f"{1.0 / slowest:.3g} s, and its least damping ratio is {fixed.least_damping_ratio:.3f}",
    )


def _alike(model: BearingModel, highest_hz: float) -> Check:
    frequency_hz = np.geomspace(10.0, highest_hz, _POINTS)
    angle = separation_deg(model.fault_transfer(frequency_hz))
    apart = np.flatnonzero(angle >= _PLAIN_DEG)
    ball_hz = model.modes_hz[2]
    if not len(apart):
        return Check(
            "separation",
            False,
            float(angle.max()),
            "deg",
            f"inner and outer race look alike to both sensors up to {highest_hz:g} Hz (at most "
            f"{angle.max():.1f} deg apart); the mode of the rolling elements is at {ball_hz:.0f} Hz: use "
            "accelerometers that are flat to beyond a quarter of it, or be content with inner_or_outer",
        )
    return Check(
        "separation",
        True,
        float(angle.max()),
        "deg",
        f"inner and outer race look {_PLAIN_DEG:g} deg or more different from "
        f"{frequency_hz[apart[0]]:.0f} Hz on; below, they look alike, as the rolling elements (mode at "
        f"{ball_hz:.0f} Hz) pass the force on",
    )
