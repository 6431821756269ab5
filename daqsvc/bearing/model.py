"""The three-mass model of a rolling element bearing (paper, section III), in SI units.

Rotor with inner ring, rolling elements, housing with outer ring, in a line; a shaft spring between the
first two, a contact spring between the last two, the housing's own spring to ground. A raceway fault is a
displacement u in series with a spring: the inner one with k_s, the outer one with k_c. It acts through the
spring alone; the force of the damper on du/dt is dropped, as the paper's D implies.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Complexes = NDArray[np.complex128]

INNER, OUTER = 0, 1
"""Columns of the fault maps F and D, and of the separated residual."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingParameters:
    """Masses in kg, stiffnesses in N/m, dampings in N s/m, named as in the paper.

    Attributes:
        m_r: rotor and inner ring.
        m_b: rolling elements.
        m_h: housing and outer ring.
        k_s: shaft and inner contact in series.
        k_c: outer contact.
        k_h: housing.
        c_s: shaft; above 0, or the directions of the two faults fall together.
        c_c: outer contact.
        c_h: housing; it or ``c_c`` above 0, for the same reason.

    Raises:
        ValueError: a figure is out of its range.
    """

    m_r: float
    m_b: float
    m_h: float
    k_s: float
    k_c: float
    k_h: float
    c_s: float
    c_c: float
    c_h: float

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            least = "0 or more" if name in {"c_c", "c_h"} else "above 0"
            if not math.isfinite(value) or value < 0.0 or (value == 0.0 and least == "above 0"):
                raise ValueError(f"bearing parameter {name} is {value}; it must be a finite number {least}")
        if self.c_c == 0.0 and self.c_h == 0.0:
            raise ValueError(
                "bearing parameters c_c and c_h are both 0: the directions of inner and outer faults fall "
                "together; give the damping of the contact or of the housing"
            )

    @property
    def mass(self) -> Floats:
        """Mass matrix, float64 ``[3, 3]``, in the order rotor, rolling elements, housing."""
        return np.diag([self.m_r, self.m_b, self.m_h])

    @property
    def stiffness(self) -> Floats:
        """Stiffness matrix, float64 ``[3, 3]``."""
        return _chain(self.k_s, self.k_c, self.k_h)

    @property
    def damping(self) -> Floats:
        """Damping matrix, float64 ``[3, 3]``."""
        return _chain(self.c_s, self.c_c, self.c_h)


class BearingModel:
    """x' = A x + B v + F u, y = C x + E v + D u.

    The state is (x_r, v_r, x_b, v_b, x_h, v_h) in m and m/s. The input v is the force of the unbalance on the
    rotor in N, u are the displacements of inner and outer race in m. The outputs y are the accelerations of
    rotor and housing in m/s^2. C and D are the paper's; F, B and E are those that fit them.

    Args:
        parameters: of the machine.
    """

    def __init__(self, parameters: BearingParameters) -> None:
        p = parameters
        self.parameters = p
        rotor = [-p.k_s, -p.c_s, p.k_s, p.c_s, 0.0, 0.0]
        balls = [p.k_s, p.c_s, -p.k_s - p.k_c, -p.c_s - p.c_c, p.k_c, p.c_c]
        housing = [0.0, 0.0, p.k_c, p.c_c, -p.k_h - p.k_c, -p.c_h - p.c_c]
        self.A: Floats = np.zeros((6, 6))
        self.A[[0, 2, 4], [1, 3, 5]] = 1.0
        for row, force, mass in ((1, rotor, p.m_r), (3, balls, p.m_b), (5, housing, p.m_h)):
            self.A[row] = np.array(force) / mass
        self.C: Floats = self.A[[1, 5]]
        self.F: Floats = np.zeros((6, 2))
        self.F[1, INNER], self.F[3, INNER] = p.k_s / p.m_r, -p.k_s / p.m_b
        self.F[3, OUTER], self.F[5, OUTER] = -p.k_c / p.m_b, p.k_c / p.m_h
        self.D: Floats = self.F[[1, 5]]
        self.B: Floats = np.zeros((6, 1))
        self.B[1, 0] = 1.0 / p.m_r
        self.E: Floats = self.B[[1, 5]]

    def fault_transfer(self, frequency_hz: Floats) -> Complexes:
        """G from the displacements of the faults to the accelerations, by the state equations.

        Args:
            frequency_hz: float64 ``[n]``.

        Returns:
            complex128 ``[n, 2, 2]`` in 1/s^2: output, fault.
        """
        return transfer(self.A, self.F, self.C, self.D, frequency_hz)

    def fault_transfer_by_stiffness(self, frequency_hz: Floats) -> Complexes:
        """The same G from the 3 x 3 dynamic stiffness: -w^2 (K + iwC - w^2 M)^-1 times the spring forces."""
        p = self.parameters
        s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None, None]
        forces = np.array([[p.k_s, 0.0], [-p.k_s, -p.k_c], [0.0, p.k_c]])
        motion = np.linalg.solve(p.mass * s**2 + p.damping * s + p.stiffness, forces.astype(np.complex128))
        return np.asarray(s**2 * motion[:, [0, 2]], dtype=np.complex128)

    @cached_property
    def modes_hz(self) -> tuple[float, float, float]:
        """Natural frequencies, rising; the highest is that of the rolling elements between the races."""
        p = self.parameters
        squared = np.linalg.eigvals(np.linalg.solve(p.mass, p.stiffness))
        slow, middle, ball = np.sort(np.sqrt(squared.real)) / (2.0 * np.pi)
        return float(slow), float(middle), float(ball)


def transfer(A: Floats, B: Floats, C: Floats, D: Floats, frequency_hz: Floats) -> Complexes:
    """D + C (iw I - A)^-1 B.

    Args:
        A: float64 ``[m, m]``.
        B: float64 ``[m, k]``.
        C: float64 ``[l, m]``.
        D: float64 ``[l, k]``.
        frequency_hz: float64 ``[n]``.

    Returns:
        complex128 ``[n, l, k]``.
    """
    s = 2j * np.pi * np.asarray(frequency_hz, dtype=np.float64)[:, None, None]
    states = np.linalg.solve(s * np.eye(len(A)) - A, B.astype(np.complex128))
    return np.asarray(C @ states + D, dtype=np.complex128)


def _chain(first: float, second: float, ground: float) -> Floats:
    """Matrix of three masses in a line, the last one tied to ground."""
    return np.array(
        [[first, -first, 0.0], [-first, first + second, -second], [0.0, -second, second + ground]]
    )
