"""Detection filters: the paper's, as printed, and the gain that separates the races on real measurements.

Both are the paper's full observer x^' = (A + LC) x^ + B v - L y. They differ in L. What y injects holds
L D u as well, so that the error obeys e' = (A + LC) e + (F + L D) u; the paper's error equation has no L D u,
and its gain does not separate the races on measured y. ``docs/bearing.md`` tells the story.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing.model import transfer

if TYPE_CHECKING:
    from daqsvc.bearing.model import BearingModel, Complexes, Floats


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


def literal_transfer(model: BearingModel, gain: Floats, frequency_hz: Floats) -> Complexes:
    """The same by the paper's error equation e' = (A + LC) e - F u, which drops L D u.

    No observer that sees only y behaves so; the paper's figures 8 to 10 need it.
    """
    return transfer(model.A + gain @ model.C, -model.F, model.C, model.D, frequency_hz)


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
    """What the paper's "check the stability" comes to, in closed form.

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
