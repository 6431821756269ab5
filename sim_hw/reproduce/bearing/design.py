"""Design of a bearing's detection filter: bearings to try it on, two gains, and what sensors can show.

The paper's gain L and ours are for its full observer x^' = (A + LC) x^ + B v - L y. What y injects holds
L D u as well, so that the error obeys e' = (A + LC) e + (F + L D) u. The paper's error equation has no L D u,
and its gain does not separate the races on measured y. ``docs/bearing.md`` has the details.

`check` asks whether a bearing's two sensors can show its faults at all, and answers in words. The paper asks
for observability, for independent fault spaces under C, and for a stable filter. Two more things decide in
practice: the model's invariant zeros, which forbid to integrate, and how much alike the two races look, which
no gain of a filter can change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.model import BearingModel, BearingParameters, transfer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.bearing.model import Complexes, Floats

S1 = BearingParameters(
    m_r=4.0, m_b=0.0185, m_h=2.0, k_s=2e7, k_c=1e8, k_h=5e7, c_s=200.0, c_c=300.0, c_h=2000.0
)
"""A deep-groove ball bearing like a 6205: its balls are light, so that the two races look nearly alike."""

S2 = BearingParameters(
    m_r=2.0, m_b=0.0185, m_h=0.5, k_s=4e7, k_c=1e8, k_h=5e7, c_s=100.0, c_c=50.4718, c_h=2638.981
)
"""With `S2_EIGENVALUE`, has the directions (1, 2) and (1, 6) that the paper found for inner and outer."""
S2_EIGENVALUE = -1.0

S3 = BearingParameters(
    m_r=2.0,
    m_b=1.0,
    m_h=2.0,
    k_s=1.7765e8,
    k_c=3.5531e8,
    k_h=1.7765e8,
    c_s=753.98,
    c_c=2513.27,
    c_h=1256.64,
)
"""Heavy rolling elements: their mode is at 4.2 kHz, so that the two races can be told apart by direction."""

_POINTS = 400
_PLAIN_DEG = 10.0
"""Angle between the races from which on they stay apart in a model that is wrong by a tenth."""
_RANK_TOLERANCE = 1e-9


def paper_gain(model: BearingModel, eigenvalues: tuple[float, float]) -> Floats:
    """L = -(A F - F Lambda) (C F)^-1, which makes the F_i eigenvectors of A + LC.

    Args:
        model: of the healthy bearing.
        eigenvalues: lambda_1 and lambda_2 in 1/s, below 0.

    Returns:
        float64 ``[6, 2]``.

    Raises:
        ValueError: an eigenvalue is not below 0.
    """
    F = model.F
    closed_loop = F @ np.diag(_negative(eigenvalues))
    return np.asarray(-(model.A @ F - closed_loop) @ np.linalg.inv(model.C @ F), dtype=np.float64)


def separating_gain(model: BearingModel, eigenvalues: tuple[float, float]) -> Floats:
    """L = (A^-1 F Lambda - F) D^-1, with which residual i is exactly D_i s / (s - lambda_i) u_i.

    It makes the vectors A^-1 F_i eigenvectors of A + LC, and F + L D = A^-1 F Lambda puts every fault along
    its own. The four other eigenvalues are 0 (accelerometers do not see where the masses rest), which is why
    the service runs `daqsvc.bearing.residual` instead.

    Args:
        model: of the healthy bearing.
        eigenvalues: lambda_1 and lambda_2 in 1/s, below 0.

    Returns:
        float64 ``[6, 2]``.

    Raises:
        ValueError: an eigenvalue is not below 0.
    """
    along = np.linalg.solve(model.A, model.F) @ np.diag(_negative(eigenvalues))
    return np.asarray((along - model.F) @ np.linalg.inv(model.D), dtype=np.float64)


def residual_transfer(model: BearingModel, gain: Floats, frequency_hz: Floats) -> Complexes:
    """From the faults to the residual y - y^ of an observer that is fed with real measurements.

    Args:
        model: of the healthy bearing.
        gain: L, float64 ``[6, 2]``.
        frequency_hz: float64 ``[n]``.

    Returns:
        complex128 ``[n, 2, 2]``: residual, fault.
    """
    closed_loop = model.A + gain @ model.C
    return transfer(closed_loop, model.F + gain @ model.D, model.C, model.D, frequency_hz)


@dataclass(frozen=True, slots=True)
class FixedEigenvalues:
    """The four eigenvalues of A + LC that the paper's gain cannot move.

    Attributes:
        relaxation: -k_s / c_s in 1/s, the shaft's spring against its damper.
        cubic: coefficients a3, a2, a1, a0 of the polynomial that holds the other three; it is Hurwitz for
            every positive set of parameters, as a2 a1 > a3 a0.
        roots: all four, complex128 ``[4]``.
    """

    relaxation: float
    cubic: tuple[float, float, float, float]
    roots: Complexes

    @property
    def slowest_per_s(self) -> float:
        """Decay rate in 1/s of the one that dies out last."""
        return float(-self.roots.real.max())

    @property
    def least_damping_ratio(self) -> float:
        """Damping ratio of the one that rings longest."""
        return float((-self.roots.real / np.abs(self.roots)).min())


def fixed_eigenvalues(model: BearingModel) -> FixedEigenvalues:
    """The result of the paper's "check the stability", in closed form.

    M = m_r + m_b; [M (c_c + c_h) + m_h c_c] s^3 + [M (k_c + k_h) + m_h k_c + c_h c_c] s^2
    + [c_h k_c + k_h c_c] s + k_h k_c.
    """
    p = model.parameters
    moving = p.m_r + p.m_b
    cubic = (
        moving * (p.c_c + p.c_h) + p.m_h * p.c_c,
        moving * (p.k_c + p.k_h) + p.m_h * p.k_c + p.c_h * p.c_c,
        p.c_h * p.k_c + p.k_h * p.c_c,
        p.k_h * p.k_c,
    )
    relaxation = -p.k_s / p.c_s
    roots = np.append(np.roots(cubic), relaxation).astype(np.complex128)
    return FixedEigenvalues(relaxation, cubic, roots)


def separation_deg(response: Complexes) -> Floats:
    """Angle between the two columns of a residual's response, in degrees from 0 to 90.

    Args:
        response: complex128 ``[n, 2, 2]``: residual, fault.

    Returns:
        float64 ``[n]``.
    """
    inner, outer = response[..., 0], response[..., 1]
    # |det| is the sine's area: the cosine's arc would lose all small angles to rounding.
    area = np.abs(inner[..., 0] * outer[..., 1] - inner[..., 1] * outer[..., 0])
    along = np.abs((inner.conj() * outer).sum(axis=-1))
    return np.asarray(np.degrees(np.arctan2(area, along)), dtype=np.float64)


def _negative(eigenvalues: tuple[float, float]) -> tuple[float, float]:
    for value in eigenvalues:
        if not (math.isfinite(value) and value < 0.0):
            raise ValueError(
                f"detection filter: eigenvalue {value} 1/s; it must be a finite number below 0, or "
                "the observer's error does not die out"
            )
    return eigenvalues


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
