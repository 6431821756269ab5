"""Sliding-mode detectors: the paper's unit in two states, and the two scalar units that the service runs.

A unit slides on the line of its own fault direction and is pushed off by the other's. With a = 12 and b = 8
the free dynamics have the poles -2 and -6, and with the sign of one output flipped the paper's directions
(1, 2) and (1, 6) lie along the eigenvectors (1, -2) and (1, -6). The distance s = n . x from a surface then
obeys s' = -mu s + n . r - K sgn(s) on its own, with mu = 6 for the inner unit and 2 for the outer one: the
unit is a leaky sum with a soft threshold. A unit with the paper's bare directions has a coupled s, and its
matched unit may leave before the other does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.bearing import kernels

if TYPE_CHECKING:
    from daqsvc.bearing.model import Floats

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
        kernels.slide_in_two_states(
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
class SlidingGains:
    """What the two units of a machine pull with.

    Attributes:
        inner: K of the inner race's unit in m/s^2.
        outer: K of the outer race's unit in m/s^2.
        leak: share of the distance that the free dynamics take off in a sample.

    Raises:
        ValueError: a figure is out of its range.
    """

    inner: float
    outer: float
    leak: float = 0.1

    def __post_init__(self) -> None:
        for name in ("inner", "outer", "leak"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(
                    f"sliding units: {name} is {value}; it must be a finite number above 0 "
                    "(learn it from a healthy residual that is not all 0)"
                )

    @classmethod
    def from_healthy(cls, residual: Floats, *, nu: float = 1.0, leak: float = 0.1) -> SlidingGains:
        """K = nu times the standard deviation of what drives a unit on the healthy machine.

        Args:
            residual: float64 ``[n, 2]`` of the healthy machine; NaN rows are left out.
            nu: standard deviations.
            leak: share of the distance that the free dynamics take off in a sample.

        Raises:
            ValueError: there is no residual, or it is all 0.
        """
        usable = residual[np.isfinite(residual).all(axis=1)]
        if not len(usable):
            raise ValueError(
                f"sliding units: none of the {len(residual)} healthy residuals is a number; record longer "
                "than the residual generator takes to settle"
            )
        inner_input, outer_input = usable[:, 1].std(), usable[:, 0].std()
        return cls(inner=float(nu * inner_input), outer=float(nu * outer_input), leak=leak)


class SlidingPair:
    """The inner and the outer unit on the residual of `daqsvc.bearing.residual.TwoSensorResidual`.

    That residual has the direction (1, 0) for the inner race and (0, 1) for the outer one. So the inner unit
    slides on (1, 0) and is driven off by the second component, and the outer unit the other way round.

    Args:
        gains: of the two units.
    """

    _NORMALS = np.array([[0.0, 1.0], [1.0, 0.0]])

    def __init__(self, gains: SlidingGains) -> None:
        self.gains = gains
        self._gains = np.array([gains.inner, gains.outer])
        self._decays = np.full(2, gains.leak)
        self._sigma = np.zeros(2)

    def process(self, residual: Floats) -> Floats:
        """Take in a block.

        Args:
            residual: float64 ``[n, 2]`` in m/s^2; where it is NaN, the units start on their surfaces again.

        Returns:
            float64 ``[n, 2]``, distances of inner and outer unit from their surfaces, in m/s^2.
        """
        distance = np.empty_like(residual)
        kernels.slide(residual, self._NORMALS, self._gains, self._decays, self._sigma, distance)
        return distance


@dataclass(frozen=True, slots=True)
class UnitEnergies:
    """Mean square distances of the two units from their surfaces over a window, in (m/s^2)^2.

    Attributes:
        inner_unit: of the unit that an inner fault leaves in peace.
        outer_unit: of the unit that an outer fault leaves in peace.
    """

    inner_unit: float
    outer_unit: float

    @classmethod
    def of(cls, distance: Floats) -> UnitEnergies:
        """Over the samples of a window that are not missing; NaN if all are.

        Args:
            distance: float64 ``[n, 2]``, of inner and outer unit.
        """
        usable = distance[np.isfinite(distance).all(axis=1)]
        if not len(usable):
            return cls(math.nan, math.nan)
        inner, outer = np.square(usable).mean(axis=0)
        return cls(float(inner), float(outer))
