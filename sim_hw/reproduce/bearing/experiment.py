"""The sliding-mode units, free and driven by the residuals of a detection filter.

The residuals are those of the paper's own error equation, e' = (A + LC) e - F u, without the injected term
L D u that real measurements have; only so do the faults keep the directions (1, 2) and (1, 6). F_i is an
eigenvector of A + LC, so that the residual of fault i is exactly D_i u + C F_i times a first-order lag.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from daqsvc.bearing.model import BearingModel
from daqsvc.bearing.two_sensors import TwoSensorMonitor, learn_pair
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
from sim_hw.reproduce.bearing.paper_units import INNER_SLOPE, OUTER_SLOPE, PaperUnit

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from sim_hw.plants.bearing import Fault

    Floats = NDArray[np.float64]

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
    """What the paper's error equation makes of a row of pulses on one race, float64 ``[n, 2]``."""
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
