"""The paper's sliding-mode units as printed: two states each, and a limit for each instead of their ratio.

A unit slides on the line of its own fault direction and is pushed off by the other's. With a = 12 and b = 8
the free dynamics have the poles -2 and -6, and with the sign of one output flipped the paper's directions
(1, 2) and (1, 6) lie along the eigenvectors (1, -2) and (1, -6). The distance s = n . x from a surface then
obeys s' = -mu s + n . r - K sgn(s) on its own, with mu = 6 for the inner unit and 2 for the outer one: the
unit is a leaky sum with a soft threshold, which is what the service runs (`daqsvc.bearing.sliding_mode`). A
unit with the paper's bare directions has a coupled s, and its matched unit may leave before the other does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from daqsvc.bearing.model import Floats
    from daqsvc.bearing.sliding_mode import Race, UnitEnergies

STIFFNESS, DAMPING = 12.0, 8.0
"""a in 1/s^2 and b in 1/s of the free dynamics, chosen so that both surfaces are their eigenvectors."""
INNER_SLOPE, OUTER_SLOPE = -2.0, -6.0
"""Slopes of the two surfaces: the paper's directions, the sign of the second output flipped."""


@dataclass(frozen=True, slots=True)
class PaperUnit:
    """One detection unit of the paper, in its two states and its normalised time.

    Attributes:
        slope: x2 / x1 of the sliding surface.
        gain: k1 and k2; the surface is attractive where k2 - slope k1 > 0.
        a: of the free dynamics, 1/s^2.
        b: of the free dynamics, 1/s.

    Raises:
        ValueError: the surface is not attractive, or the free dynamics are not stable.
    """

    slope: float
    gain: tuple[float, float]
    a: float = STIFFNESS
    b: float = DAMPING

    def __post_init__(self) -> None:
        if self.pull <= 0.0:
            raise ValueError(
                f"sliding unit: gain {self.gain} pulls the state away from the surface of slope "
                f"{self.slope:g}; k2 - slope k1 must be above 0"
            )
        if self.a <= 0.0 or self.b <= 0.0:
            raise ValueError(
                f"sliding unit: a {self.a:g} and b {self.b:g}; both must be above 0 (stable free dynamics)"
            )

    @property
    def pull(self) -> float:
        """K = n . k, at which the switching pulls the distance to 0; an input beyond it wins."""
        return self.gain[1] - self.slope * self.gain[0]

    @property
    def decay(self) -> float | None:
        """Rate mu in 1/s where the surface is an eigenvector of the free dynamics; else None (coupled)."""
        other = self.a / -self.slope if self.slope else math.inf
        return other if math.isclose(self.b, other - self.slope, rel_tol=1e-9) else None

    def distance(self, path: Floats) -> Floats:
        """Distance s = x2 - slope x1 of states float64 ``[n, 2]``."""
        return np.asarray(path[:, 1] - self.slope * path[:, 0])

    def run(
        self,
        residual: Floats,
        step: float,
        *,
        start: tuple[float, float] = (0.0, 0.0),
        implicit: bool = True,
    ) -> Floats:
        """Drive the unit with a residual.

        Args:
            residual: float64 ``[n, 2]``.
            step: of time.
            start: state before the first step.
            implicit: whether the sign is solved for at the end of each step (projected Euler): no chatter at
                any step. The explicit sign chatters by about half a step times K.

        Returns:
            float64 ``[n, 2]``, the state after each step.
        """
        path = np.empty((len(residual), 2))
        _slide(
            np.ascontiguousarray(residual, dtype=np.float64),
            self.a,
            self.b,
            self.slope,
            np.array(self.gain),
            step,
            implicit,
            np.array(start, dtype=np.float64),
            path,
        )
        return path


@dataclass(frozen=True, slots=True)
class AbsoluteRule:
    """The paper's logic: each unit against a limit of its own.

    Attributes:
        inner_limit: energy that the inner unit does not pass on a healthy machine.
        outer_limit: the same for the outer unit.
    """

    inner_limit: float
    outer_limit: float

    def judge(self, energies: UnitEnergies) -> Race | Literal["normal"]:
        """Name what the two bits say: a unit off its surface denies its own race.

        Args:
            energies: over a window.
        """
        denied = (energies.inner_unit > self.inner_limit, energies.outer_unit > self.outer_limit)
        named: dict[tuple[bool, bool], Race | Literal["normal"]] = {
            (False, False): "normal",
            (False, True): "inner",
            (True, False): "outer",
            (True, True): "ball",
        }
        return named[denied]


@njit(cache=True, nogil=True, error_model="numpy")
def _slide(
    residual: Floats,
    a: float,
    b: float,
    slope: float,
    gain: Floats,
    step: float,
    implicit: bool,  # noqa: FBT001 - numba has no keyword-only arguments
    state: Floats,
    path: Floats,
) -> None:
    """The paper's unit x1' = x2 - k1 sgn(s) + r1, x2' = -a x1 - b x2 - k2 sgn(s) + r2, s = -slope x1 + x2.

    Args:
        residual: float64 ``[n, 2]``, what drives the unit.
        a: of the free dynamics, in 1/s^2.
        b: of the free dynamics, in 1/s.
        slope: x2 / x1 of the sliding surface.
        gain: float64 ``[2]``, k1 and k2.
        step: in s.
        implicit: whether sgn is taken at the end of a step, with a value between -1 and 1 on the surface;
            else at its beginning, and the unit chatters.
        state: float64 ``[2]``, x1 and x2; changed.
        path: float64 ``[n, 2]``, written: the state after each step.
    """
    x1, x2 = state[0], state[1]
    # Both ways treat the free dynamics alike: (I - step A) x+ = x + step (r - k sgn).
    determinant = 1.0 + step * b + step * step * a
    p11, p12 = (1.0 + step * b) / determinant, step / determinant
    p21, p22 = -step * a / determinant, 1.0 / determinant
    n1, n2 = -slope, 1.0
    pull = step * (n1 * (p11 * gain[0] + p12 * gain[1]) + n2 * (p21 * gain[0] + p22 * gain[1]))
    for n in range(residual.shape[0]):
        f1, f2 = x1 + step * residual[n, 0], x2 + step * residual[n, 1]
        if implicit:
            free = n1 * (p11 * f1 + p12 * f2) + n2 * (p21 * f1 + p22 * f2)
            sign = min(1.0, max(-1.0, free / pull))
        else:
            sign = np.sign(n1 * x1 + n2 * x2)
        f1 -= step * gain[0] * sign
        f2 -= step * gain[1] * sign
        x1, x2 = p11 * f1 + p12 * f2, p21 * f1 + p22 * f2
        path[n, 0], path[n, 1] = x1, x2
    state[0], state[1] = x1, x2
