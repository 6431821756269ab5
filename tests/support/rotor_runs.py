"""Runs of the simulated rotor for the statistical tests, and the bound that no detector can beat.

Plants are the simulator's, with its own integrator; onsets are dithered over a whole revolution, so that no
grid of blocks can be in step with them. The noise-free motion of a seed is integrated once for all levels of
sensor noise.
"""

from __future__ import annotations

import functools
import itertools
import math
import os
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.detectors.rotor_bank.detector import KeyphasorProbe, Probe, RotorBankDetector
from daqsvc.detectors.rotor_bank.modes import RotorMode, bank_modes
from daqsvc.rotor import kernels
from daqsvc.rotor.discretise import discretise
from daqsvc.rotor.model import RotorParameters
from sim_hw.plants import rotor as plant
from sim_hw.plants.rotor import keyphasor_voltage, noise_sigma

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.rotor.model import NormalisedRotor

    Floats = NDArray[np.float64]
    Models = Any

PER_REV = 64
DURATION = 2.0 * math.pi / PER_REV
CLEARANCE_UM = 100.0
HEALTHY = plant.PlantParameters()
PROCESS_NOISE = 1e-4

ROTOR = RotorParameters(
    natural_frequency_hz=10.0,
    damping_ratio=0.18,
    eccentricity_um=10.0,
    clearance_um=CLEARANCE_UM,
    static_sag_um=10.0,
)
PAPER_MODES = (
    RotorMode("N"),
    RotorMode("F1", 0.10, "alert"),
    RotorMode("F1L2", 0.06, "alert"),
    RotorMode("F1L3", 0.02, "danger", rub=True),
)
PAPER_PLANTS = {
    "F1": {"damping_ratio": 0.10},
    "F1L2": {"damping_ratio": 0.06},
    "F1L3": {"damping_ratio": 0.02},
}
TWELVE_MODES = (
    RotorMode("N"),
    RotorMode("U1", unbalance_ratio=1.3),
    RotorMode("U2", unbalance_ratio=1.8),
    RotorMode("U3", unbalance_ratio=2.5),
    RotorMode("L1", static_load_um=(0.0, -5.0)),
    RotorMode("L2", static_load_um=(0.0, -10.0)),
    RotorMode("L3", static_load_um=(0.0, -20.0)),
    RotorMode("D1", 0.10),
    RotorMode("D2", 0.06),
    RotorMode("R", 0.02, rub=True),
    RotorMode("K1", stiffness_ratio=0.95),
    RotorMode("K2", stiffness_ratio=0.90),
)
TWELVE_PLANTS: dict[str, dict[str, float]] = {
    "N": {},
    "U1": {"eccentricity": 0.13},
    "U2": {"eccentricity": 0.18},
    "U3": {"eccentricity": 0.25},
    "L1": {"static_load": 0.05},
    "L2": {"static_load": 0.10},
    "L3": {"static_load": 0.20},
    "D1": {"damping_ratio": 0.10},
    "D2": {"damping_ratio": 0.06},
    "R": {"damping_ratio": 0.02},
    "K1": {"stiffness": 0.95},
    "K2": {"stiffness": 0.90},
}


def damping_bank(
    rate_hz: float,
    noise_um: float,
    *,
    angles: Sequence[float] = (0.0, 90.0),
    speed_rpm: float = 600.0,
    **options: Any,
) -> RotorBankDetector:
    """The detector of the paper's modes on two probes and a keyphasor; columns as of `shaft_channels`."""
    return RotorBankDetector(
        machine="rig",
        stream="shaft",
        rate_hz=rate_hz,
        speed_rpm=speed_rpm,
        probes=(Probe("probe-x", 0, angles[0]), Probe("probe-y", 1, angles[1])),
        keyphasor=KeyphasorProbe("keyphasor", 2, -6.0),
        rotor=ROTOR,
        modes=PAPER_MODES,
        noise_um=noise_um,
        **options,
    )


def seeds(default: int) -> int:
    """How many seeds to run: ``DAQSVC_SEEDS`` if it is set."""
    return int(os.environ.get("DAQSVC_SEEDS", default))


def models(modes: Sequence[RotorMode] = TWELVE_MODES) -> Models:
    """Normalised models of modes at resonance."""
    return bank_modes(modes, ROTOR, 600.0)


def true_models(modes: Sequence[RotorMode] = PAPER_MODES) -> Models:
    """The same with the contact of the plant, which no bank knows; its observer needs little slack."""
    contact: dict[str, Any] = {
        "hertz_exponent": 1.5,
        "friction": 0.3,
        "contact_radius_um": 500.0 * CLEARANCE_UM,
    }
    return bank_modes(modes, replace(ROTOR, **contact), 600.0, rub_process_noise=1e-3)


def sigma(snr_db: float, healthy: plant.PlantParameters = HEALTHY) -> float:
    """Standard deviation of the sensor noise in clearances, against the AC power of the healthy orbit."""
    return noise_sigma(abs(healthy.orbit_1x), snr_db)


@dataclass(frozen=True)
class Run:
    """A run of the plant without sensor noise.

    Attributes:
        motion: the plant's.
        begins: revolution at which each change begins.
    """

    motion: plant.Motion
    begins: tuple[float, ...]

    @property
    def angle(self) -> Floats:
        return 2.0 * math.pi * self.motion.revolution

    def xy(self, snr_db: float, seed: int) -> Floats:
        """Measured positions in clearances, float64 ``[n, 2]``."""
        clean = np.column_stack((self.motion.x, self.motion.y))
        return clean + sigma(snr_db) * np.random.default_rng([seed, 7]).standard_normal(clean.shape)

    def channels(self, snr_db: float, seed: int) -> NDArray[np.float32]:
        """Float32 ``[n, 3]``: probes in micrometres and the keyphasor's voltage."""
        voltage = keyphasor_voltage(self.motion.revolution)
        voltage += 0.02 * np.random.default_rng([seed, 8]).standard_normal(len(voltage))
        return np.column_stack((CLEARANCE_UM * self.xy(snr_db, seed), voltage)).astype(np.float32)


def run(
    changes: Sequence[tuple[float, Mapping[str, float]]],
    revolutions: float,
    seed: int,
    healthy: plant.PlantParameters = HEALTHY,
    process_noise: float = 0.0,
) -> Run:
    """Simulate; ``changes`` are pairs of revolution and altered parameters, dithered by up to half a turn."""
    rng = np.random.default_rng([seed, 1])
    begins = [at + rng.uniform(-0.5, 0.5) for at, _ in changes]
    base: dict[str, Any] = {name: getattr(healthy, name) for name in plant.PlantParameters.__slots__}
    steps = [
        plant.Change(at, plant.PlantParameters(**{**base, **change}))
        for at, (_, change) in zip(begins, changes, strict=True)
    ]
    motion = plant.simulate(
        healthy, steps, revolutions=revolutions, samples_per_rev=PER_REV, process_noise=process_noise, rng=rng
    )
    return Run(motion, tuple(begins))


@functools.cache
def paper_run(seed: int, process_noise: float = 0.0) -> Run:
    """The paper's schedule: 170 s of normalised time in every mode, the last one longer."""
    changes = list(zip((27.06, 54.11, 81.17), PAPER_PLANTS.values(), strict=True))
    return run(changes, 161.17, seed, process_noise=process_noise)


def genie_delays(
    observed: tuple[Floats, Floats],
    begins: Sequence[float],
    modes: Models,
    threshold_nats: float,
    snr_db: float,
) -> list[float]:
    """Delays of a detector that knows when each change happens, and to which mode.

    At the change the new mode's observer takes over the old one's estimate; the delay is over when the
    log-likelihood ratio of new against old reaches the threshold. Modes follow one another in their order.

    Args:
        observed: measured positions in clearances and shaft angles.
        begins: revolution at which each change begins.
        modes: models of the bank.
        threshold_nats: evidence that is asked for.
        snr_db: level of the sensor noise that the observers assume.

    Returns:
        Revolutions, one for each change; infinite where the evidence does not suffice.
    """
    xy, angle = observed
    cos, sin = np.cos(angle), np.sin(angle)
    observers = discretise(modes, noise=sigma(snr_db), duration=DURATION)
    usable = np.ones(len(xy), dtype=bool)
    states = np.zeros((len(modes), 4))
    # The observers of all modes run along; only the pair in question is evaluated.
    edges = [0, *(math.ceil(at * PER_REV) for at in begins), len(xy)]
    delays: list[float] = []
    for old, (begin, end) in enumerate(itertools.pairwise(edges)):
        if old:
            handed = states[[old - 1]].copy()
            kernels.change_orbits(observers[[old - 1]], observers[[old]], cos[begin], sin[begin], handed)
            states[old] = handed[0]
        scores = np.empty((len(modes), end - begin))
        part = slice(begin, end)
        kernels.run_free(xy[part], usable[part], cos[part], sin[part], observers, states, scores)
        if old:
            evidence = np.cumsum(scores[old] - scores[old - 1])
            enough = np.flatnonzero(evidence >= threshold_nats)
            at = begins[old - 1]
            delays.append((begin + enough[0] + 1) / PER_REV - at if len(enough) else math.inf)
    return delays


def physical_rotor(
    rotor: NormalisedRotor, *, natural_frequency_hz: float, clearance_um: float
) -> RotorParameters:
    """The physical rotor behind normalised quantities.

    A rotor with k != 1 is described by its own natural frequency, sqrt(k) omega_s, so that its
    damping ratio becomes zeta / sqrt(k) and its K* becomes K* / k.

    Args:
        rotor: the normalised rotor.
        natural_frequency_hz: omega_s / 2 pi that it was normalised with.
        clearance_um: clearance that it was normalised with.
    """
    return RotorParameters(
        natural_frequency_hz=natural_frequency_hz * math.sqrt(rotor.k),
        damping_ratio=rotor.zeta / math.sqrt(rotor.k),
        eccentricity_um=rotor.e * clearance_um,
        clearance_um=clearance_um,
        heavy_spot_deg=math.degrees(rotor.heavy_spot_rad),
        static_sag_um=rotor.g / rotor.k * clearance_um,
        contact_stiffness=rotor.contact_stiffness / rotor.k,
        hertz_exponent=rotor.alpha,
        friction=rotor.mu,
        contact_radius_um=rotor.contact_radius * clearance_um,
        static_load_x_um=rotor.load_x / rotor.k * clearance_um,
    )
