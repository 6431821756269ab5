"""The paper's sliding-mode units, free and driven by the residuals of a detection filter.

The residuals are those of the paper's own error equation, e' = (A + LC) e - F u, without the injected term
L D u that real measurements have. Only so do the faults keep the directions (1, 2) and (1, 6). F_i is an
eigenvector of A + LC, so that the residual of fault i is exactly D_i u + C F_i times a first-order lag.

The units are as printed: two states each, and a limit for each instead of their ratio.

A unit slides on the line of its own fault direction and is pushed off by the other's. With a = 12 and b = 8
the free dynamics have the poles -2 and -6. With the sign of one output flipped, the paper's directions (1,
2) and (1, 6) lie along the eigenvectors (1, -2) and (1, -6). The distance s = n . x from a surface then
obeys s' = -mu s + n . r - K sgn(s) on its own, with mu = 6 for the inner unit and 2 for the outer one. The
unit is a leaky sum with a soft threshold, as in the service (`daqsvc.bearing.sliding_mode`). A unit with
the paper's bare directions has a coupled s, and its matched unit may leave before the other does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from daqsvc.bearing.model import BearingModel
from daqsvc.bearing.two_sensors import TwoSensorMonitor, learn_pair
from daqsvc.kernels import njit
from sim_hw.plants.bearing import BearingMachine, FaultSignal, levels, simulate
from sim_hw.reproduce.bearing.design import (
    S2,
    S2_EIGENVALUE,
    S3,
    paper_gain,
    residual_transfer,
    separating_gain,
    separation_deg,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sim_hw.plants.bearing import Fault

    Floats = NDArray[np.float64]


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


STEP = 1e-3
SPAN = 40.0
RACES = ("outer", "inner")
SLOPES = {"inner": INNER_SLOPE, "outer": OUTER_SLOPE}
DRIVE = 6.0
"""Largest residual, in units of the gain |k|; the unmatched unit leaves from about 3 on."""
START = (1.0, 1.0)
PULSES_PER_TIME = 0.25
PULSE = 1.2
LATE = 10.0
"""From here on, the free units have long been on their surfaces."""
BAND_HZ = np.geomspace(30.0, 10_000.0, 200)


@dataclass(frozen=True, slots=True)
class BearingExperiment:
    """What came out.

    Attributes:
        time: float64 ``[n]``, in the paper's normalised time.
        free: path ``[n, 2]`` of each unit from `START` on a healthy machine.
        driven: path of each unit, by faulty race and unit.
        slopes: of the literal fault directions, by race.
        still: largest distance from the surface with an implicit step, of the same units and faults.
        literal_deg: largest angle between the races from 30 Hz to 1 kHz with the paper's gain and real y.
        exact_deg: least angle from 30 Hz to 10 kHz with the separating gain and real y.
        verdicts: of the service's detectors on a simulated machine, by fault.
    """

    time: Floats
    free: Mapping[str, Floats]
    driven: Mapping[tuple[str, str], Floats]
    slopes: Mapping[str, float]
    still: Mapping[tuple[str, str], float]
    literal_deg: float
    exact_deg: float
    verdicts: Mapping[str, str]

    def leaving(self, fault: str, unit: str) -> float:
        """Largest distance of a unit from its surface under a fault, once it has settled."""
        return float(np.abs(distance(unit, self.driven[fault, unit][self.time >= LATE])).max())

    def healthy(self, unit: str) -> float:
        """The same of the free unit: the chatter of the explicit step."""
        return float(np.abs(distance(unit, self.free[unit][self.time >= LATE])).max())


def detection_unit(race: str) -> PaperUnit:
    """The paper's unit for a race: gain of length 1 along the normal of its surface."""
    slope = SLOPES[race]
    normal = np.array([-slope, 1.0]) / np.hypot(slope, 1.0)
    return PaperUnit(slope, (float(normal[0]), float(normal[1])))


def distance(race: str, path: Floats) -> Floats:
    """How far states ``[n, 2]`` of a unit are from its surface, at right angles to it: float64 ``[n]``."""
    return np.asarray(detection_unit(race).distance(path) / np.hypot(SLOPES[race], 1.0))


def run(seed: int, snr_db: float) -> BearingExperiment:
    """Do it.

    Args:
        seed: of the simulated machine's noise, phases and slip.
        snr_db: of its sensors.
    """
    model = BearingModel(S2)
    time: Floats = STEP * np.arange(round(SPAN / STEP), dtype=np.float64)
    residuals = {race: literal_residual(model, race, time) for race in RACES}
    slopes = {race: float(r[-1, 1] / r[-1, 0]) for race, r in residuals.items()}
    driven, still = {}, {}
    for fault, residual in residuals.items():
        scaled = DRIVE * residual / np.linalg.norm(residual, axis=1).max() * [1.0, -1.0]
        for race in RACES:
            unit = detection_unit(race)
            driven[fault, race] = unit.run(scaled, STEP, implicit=False)
            still[fault, race] = float(np.abs(distance(race, unit.run(scaled, STEP))).max())
    quiet = np.zeros((len(time), 2))
    literal = residual_transfer(
        model, paper_gain(model, (S2_EIGENVALUE, 2.0 * S2_EIGENVALUE)), BAND_HZ[BAND_HZ < 1000.0]
    )
    exact = residual_transfer(model, separating_gain(model, (-100.0, -200.0)), BAND_HZ)
    return BearingExperiment(
        time=time,
        free={race: detection_unit(race).run(quiet, STEP, start=START, implicit=False) for race in RACES},
        driven=driven,
        slopes=slopes,
        still=still,
        literal_deg=float(separation_deg(literal).max()),
        exact_deg=float(separation_deg(exact).min()),
        verdicts=_verdicts(seed, snr_db),
    )


def literal_residual(model: BearingModel, race: str, time: Floats) -> Floats:
    """Residual of the paper's error equation under a row of pulses on one race, float64 ``[n, 2]``."""
    column = ("inner", "outer").index(race)
    phase = np.mod(time * PULSES_PER_TIME, 1.0) / (PULSE * PULSES_PER_TIME)
    u = np.where(phase < 1.0, np.sin(np.pi * np.minimum(phase, 1.0)), 0.0)
    # The lag 1 / (s - lambda) by the trapezoidal rule: pulses are a thousand steps long.
    half = 0.5 * STEP
    eps = lfilter([half, half], [1.0 - half * S2_EIGENVALUE, -1.0 - half * S2_EIGENVALUE], u)
    return np.asarray(np.outer(u, model.D[:, column]) - np.outer(eps, model.C @ model.F[:, column]))


def _verdicts(seed: int, snr_db: float) -> dict[str, str]:
    """Of the service's detectors, on a machine whose parameters are up to 10 % off."""
    p, signal, rng = S3, FaultSignal(), np.random.default_rng(seed)
    nominal = BearingMachine(
        masses=(p.m_r, p.m_b, p.m_h), stiffnesses=(p.k_s, p.k_c, p.k_h), dampings=(p.c_s, p.c_c, p.c_h)
    )
    level = levels(nominal, signal, snr_db=snr_db)
    machine = nominal.mismatched(0.1, rng)
    calm = simulate(machine, signal, "healthy", level, rng, seconds=2.0)
    monitor = TwoSensorMonitor(learn_pair(p, 48_000.0, calm.y, calm.v))
    verdicts: dict[str, str] = {}
    faults: tuple[Fault, ...] = ("healthy", "inner", "outer", "ball", "inner_and_outer")
    for fault in faults:
        monitor.reset()
        window = simulate(machine, signal, fault, level, rng)
        verdicts[fault] = monitor.evaluate(window.y, window.v).verdict
    return verdicts
