"""Sliding-mode detectors: two scalar units, one for each race; the ratio of their energies names the race.

A unit slides on a surface that its own fault does not leave, and is pushed off by the other's. Its distance s
from there obeys s' = -mu s + n . r - K sgn(s): a leaky sum with a soft threshold. The paper's units, in two
states each, are in `sim_hw.reproduce.bearing.experiment`.

A fault of the inner race pushes the outer race's unit off its surface and leaves the inner race's unit in
peace, and the other way round. A ball meets both races and pushes both off. With the model a little wrong the
matched unit is not quite in peace, the less so the larger the fault is: absolute limits then call every large
fault a ball's. The ratio of the two energies does not depend on the size of the fault.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.kernels import njit

if TYPE_CHECKING:
    from daqsvc.bearing.model import BearingParameters, Floats


@njit(cache=True, nogil=True, error_model="numpy")
def _soft(s: float, gain: float) -> float:
    """What is left of a distance after the gain: beyond it the sign is +-1, within it the surface holds."""
    return max(s - gain, 0.0) + min(s + gain, 0.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _slide(
    residual: Floats, normals: Floats, gains: Floats, decays: Floats, sigma: Floats, distance: Floats
) -> None:
    """Two sliding units in scalar form: leaky sums with a soft threshold (implicit Euler).

    A missing residual puts the units back onto their surfaces and is missing in what they say.

    Args:
        residual: float64 ``[n, 2]``.
        normals: float64 ``[2, 2]``, normal of each unit's surface in the plane of the residual, a row each.
        gains: float64 ``[2]``, what a unit takes off its distance in a step, in units of the residual.
        decays: float64 ``[2]``, what the free dynamics take off in a step, as a share.
        sigma: float64 ``[2]``, distances from the surfaces; changed.
        distance: float64 ``[n, 2]``, written.
    """
    # Both units in one pass: each waits for its own last step, and the other fills the time.
    inner, outer = sigma[0], sigma[1]
    inner_shrink, outer_shrink = 1.0 / (1.0 + decays[0]), 1.0 / (1.0 + decays[1])
    # The shrinking is done before the threshold, which shrinks with it: one step less to wait for.
    i1, i2, inner_gain = inner_shrink * normals[0, 0], inner_shrink * normals[0, 1], inner_shrink * gains[0]
    o1, o2, outer_gain = outer_shrink * normals[1, 0], outer_shrink * normals[1, 1], outer_shrink * gains[1]
    for n in range(residual.shape[0]):
        r1, r2 = residual[n, 0], residual[n, 1]
        inner = _soft(inner_shrink * inner + (i1 * r1 + i2 * r2), inner_gain)
        outer = _soft(outer_shrink * outer + (o1 * r1 + o2 * r2), outer_gain)
        distance[n, 0], distance[n, 1] = inner, outer
        if np.isnan(r1 + r2):
            distance[n, 0] = distance[n, 1] = np.nan
            inner = outer = 0.0
    sigma[0], sigma[1] = inner, outer


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
        _slide(residual, self._NORMALS, self._gains, self._decays, self._sigma, distance)
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


Race = Literal["inner", "outer", "ball"]
"""The faulty part; ``"ball"`` is also what inner and outer race together look like."""

BOUNDARY_DB = 3.5
"""Between a race and a ball, in dB of the ratio of the two displacements' energies; a ball's is 0 dB."""
LEAST_EXCESS = 0.2
"""Energies are not told from the healthy ones nearer than this share of them."""


@dataclass(frozen=True, slots=True)
class RatioRule:
    """Judges the energies of a `SlidingPair` against those of the healthy machine.

    Attributes:
        parameters: of the bearing; D turns accelerations back into displacements.
        healthy: energies on the healthy machine.
        boundary_db: between a race and a ball.

    Raises:
        ValueError: the healthy energies are not finite and above 0.
    """

    parameters: BearingParameters
    healthy: UnitEnergies
    boundary_db: float = BOUNDARY_DB

    def __post_init__(self) -> None:
        for name, value in (("inner", self.healthy.inner_unit), ("outer", self.healthy.outer_unit)):
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(
                    f"ratio rule: the healthy energy of the {name} unit is {value}; it must be a finite "
                    "number above 0: record the healthy machine for longer"
                )

    def ratio_db(self, energies: UnitEnergies) -> float:
        """Energy of the inner race's displacement over the outer race's in dB; NaN if neither stands out."""
        p = self.parameters
        # The outer unit is driven by the inner race's component, and the other way round.
        inner = energies.outer_unit / self.healthy.outer_unit - 1.0
        outer = energies.inner_unit / self.healthy.inner_unit - 1.0
        if not max(inner, outer) > LEAST_EXCESS:
            return math.nan
        inner = max(inner, LEAST_EXCESS) * self.healthy.outer_unit * (p.m_r / p.k_s) ** 2
        outer = max(outer, LEAST_EXCESS) * self.healthy.inner_unit * (p.m_h / p.k_c) ** 2
        return 10.0 * math.log10(inner / outer)

    def judge(self, energies: UnitEnergies) -> Race | Literal["inner_or_outer"]:
        """Name the faulty part.

        Args:
            energies: over a window in which a fault was detected.
        """
        ratio_db = self.ratio_db(energies)
        if math.isnan(ratio_db):
            return "inner_or_outer"
        if abs(ratio_db) < self.boundary_db:
            return "ball"
        return "inner" if ratio_db > 0.0 else "outer"
