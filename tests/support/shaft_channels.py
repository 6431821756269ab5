"""Two probes and a keyphasor as a detector gets them: from a simulated motion, in windows, sound or not."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.diagnosis.detector import Window
from sim_hw.plants.rotor import keyphasor_voltage

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.record import Diagnosis
    from sim_hw.plants.rotor import Motion

CLEARANCE_UM = 100.0
FIRST = 10_000_000_000
"""Index of the first sample: the device has been running for long."""


def channels_of(
    motion: Motion, noise_um: float, seed: int = 0, angles: Sequence[float] = (0.0, 90.0)
) -> NDArray[np.float32]:
    """Float32 ``[n, 3]``: probes in um that point at ``angles``, in white noise, and the keyphasor in V."""
    rng = np.random.default_rng(seed)
    x, y = motion.in_um(CLEARANCE_UM)
    probes = [x * math.cos(math.radians(a)) + y * math.sin(math.radians(a)) for a in angles]
    noisy = [p + noise_um * rng.standard_normal(len(p)) for p in probes]
    voltage = keyphasor_voltage(motion.revolution) + 0.02 * rng.standard_normal(len(x))
    return np.column_stack((*noisy, voltage)).astype(np.float32)


def windows(
    samples: NDArray[np.float32], rate_hz: float, *, block: int, first_index: int = FIRST
) -> Iterator[Window]:
    """Samples as a pipeline hands them on; the clock began with index 0."""
    period_ns = 1e9 / rate_hz
    for begin in range(0, len(samples), block):
        part = samples[begin : begin + block]
        last = first_index + begin + len(part) - 1
        yield Window(first_index + begin, part, round(last * period_ns), period_ns)


def feed(
    detector: Detector, samples: NDArray[np.float32], rate_hz: float, *, block: int, first_index: int = FIRST
) -> list[Diagnosis]:
    """All that a detector states about samples."""
    taken = windows(samples, rate_hz, block=block, first_index=first_index)
    return [said for window in taken for said in detector.process(window)]


# Ways to spoil channels in place.


def dead(part: NDArray[np.float32]) -> None:
    part[:, 0] = 12.5


def gone(part: NDArray[np.float32]) -> None:
    part[:, 0] = np.nan


def infinite(part: NDArray[np.float32]) -> None:
    part[:, 1] = -np.inf


def half_gone(part: NDArray[np.float32]) -> None:
    part[np.arange(len(part)) % 3 > 0, :2] = np.nan


def keyphasor_of_wrong_bits(part: NDArray[np.float32]) -> None:
    part[::7, 2] = 3e30


def no_keyphasor(part: NDArray[np.float32]) -> None:
    part[:, 2] = -10.0
