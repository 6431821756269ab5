"""The probes of a rotor bank, and signs that one does not see a turning shaft, whatever it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.diagnosis.record import DataQuality
    from daqsvc.dsp.keyphasor import Edge

    Floats = NDArray[np.float64]

_CLIPPED = 1 / 16
"""Part of a revolution at one extreme value that makes a probe clipped."""


@dataclass(frozen=True, slots=True)
class Probe:
    """A proximity probe.

    Attributes:
        name: name of the sensor.
        column: its column in the stream, counted from the shaft-centred position.
        angle_deg: where it points, from +x against the clock.
        um_per_unit: micrometres in a unit of the column.
    """

    name: str
    column: int
    angle_deg: float
    um_per_unit: float = 1.0


@dataclass(frozen=True, slots=True)
class KeyphasorProbe:
    """A keyphasor.

    Attributes:
        name: name of the sensor.
        column: its column in the stream, volts.
        threshold_v: level that marks the edge.
        hysteresis_v: how far the voltage must return before there can be another edge.
        edge: the edge that marks angle zero.
    """

    name: str
    column: int
    threshold_v: float
    hysteresis_v: float = 0.5
    edge: Edge = "rising"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the last revolution can be trusted, and why not."""

    quality: DataQuality = "good"
    reason: str = ""


def judge_probes(
    samples: Floats, probes: Sequence[Probe], *, revolution: int, least_motion_um: float
) -> Verdict | None:
    """What is wrong with the last revolution of the probes, or None.

    Args:
        samples: float64 ``[n, probes]``, micrometres, NaN where missing; short at the start.
        probes: the probes, in the order of the columns.
        revolution: samples in a revolution.
        least_motion_um: standard deviation that a probe must show.
    """
    n = len(samples)
    for column, probe in enumerate(probes):
        signal = samples[:, column]
        signal = signal[~np.isnan(signal)]
        if n - len(signal) > n / 2:
            return Verdict(
                "missing",
                f"{probe.name}: {n - len(signal)} of the last {n} samples are missing; "
                "check the bus and the device",
            )
        if n < revolution:
            continue
        if (deviation := float(signal.std())) < least_motion_um:
            return Verdict(
                "not_ok",
                f"{probe.name}: moved by {deviation:.3g} um rms in the last revolution, at least "
                f"{least_motion_um:.3g} um is expected; check the probe, its cable and driver",
            )
        if (clipped := clipped_at(signal)) is not None:
            return Verdict(
                "not_ok",
                f"{probe.name}: clipped at {clipped:.6g} um in the last revolution; "
                "check the gap and the range of the converter",
            )
    return None


def stands_still(probes: Floats) -> bool:
    """Whether a probe repeats one value through a block, as none does that sees a turning shaft.

    Args:
        probes: float64 ``[n, 2]``.
    """
    return len(probes) > 2 and bool((probes == probes[0]).all(axis=0).any())


def clipped_at(signal: Floats) -> float | None:
    """The extreme value that a signal is clipped at, or None.

    Args:
        signal: float64 ``[n]``, a revolution without missing samples.

    A coarse converter repeats its values between the extremes as well, and a sine only twice as often at
    its top as elsewhere: a clipped signal repeats its extreme four times as often as any other value.
    """
    values, counts = np.unique(signal, return_counts=True)
    usual = int(counts[1:-1].max(initial=0))
    least = max(_CLIPPED * len(signal), 4.0 * usual, 3.0)
    for extreme in (0, -1):
        if counts[extreme] >= least:
            return float(values[extreme])
    return None
