"""What the revolutions of two probes are worth: missing, standing still, dead (for a part too), clipped.

A revolution that is worth nothing must not reach a bank or the synchronous vectors. A dead probe makes a
straight orbit and a clipped one makes harmonics, and both look like a fault of the machine.
"""

from __future__ import annotations

import cmath
import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.quality.clipped import clipped_at, never_clipped
from daqsvc.dsp.quality.missing import REVOLUTION_SHARE
from daqsvc.dsp.quality.stuck import dropped_to, never_rests, stands_still
from daqsvc.dsp.quality.unit import RESCALE, beyond_any_unit, within_some_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.dsp.probes import Probe
    from daqsvc.dsp.quality import Quality

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

POOLED_REVOLUTIONS = 4
"""Revolutions that are searched together for clipping."""
DEAD = 0.05
"""A probe that moves less than this part of what it must is dead."""
_SURE = 3.0
_BELIEVED = 0.1
"""A probe is called blind if its motion is known to this part of the other's ..."""
_CLEAR = 4.0
"""... or if it saw so many times the uncertainty when it was calibrated."""


@dataclass(frozen=True, slots=True)
class RevolutionQuality:
    """Whether the last revolution can be trusted, and why not."""

    quality: Quality = "good"
    reason: str = ""


class RevolutionJudge:
    """Looks at the samples of a revolution: of one after the other, or of the last one again and again.

    Args:
        probes: the two probes, in the order of the columns.
        missing: part of a revolution's samples that may be missing.
        pooled: clipping is looked for in so many revolutions together as well: in noise it shows in some of
            them only. 1 where the revolutions overlap.
    """

    def __init__(
        self,
        probes: tuple[Probe, Probe],
        *,
        missing: float = REVOLUTION_SHARE,
        pooled: int = POOLED_REVOLUTIONS,
    ) -> None:
        self._probes = probes
        self._missing = missing
        self._pool: deque[Floats] = deque(maxlen=pooled)

    def reset(self) -> None:
        """Forget the revolutions before a gap."""
        self._pool.clear()

    def missing(self, samples: Floats) -> RevolutionQuality | None:
        """Whether too many samples of a revolution, or of a part of one, are missing.

        Args:
            samples: float64 ``[n, 2]``, NaN where missing.
        """
        present = np.isfinite(samples)
        n, missing = len(samples), int(np.count_nonzero(~present.all(axis=1)))
        if n and missing <= self._missing * n:
            return None
        worst = int(present.sum(axis=0).argmin())
        return RevolutionQuality(
            "missing",
            f"{self._probes[worst].name}: {'all' if missing == n else f'{missing} of {n}'} samples of a "
            "revolution are missing; check the bus and the device",
        )

    def _impossible(self, samples: Floats) -> RevolutionQuality | None:
        for signal, probe in zip(samples.T, self._probes, strict=True):
            if wrong := beyond_any_unit(signal):
                return RevolutionQuality("not_ok", f"{probe.name} {wrong}; {RESCALE}")
        return None

    def judge(self, samples: Floats, least_motion_um: float) -> RevolutionQuality:
        """What a revolution is worth.

        Args:
            samples: float64 ``[n, 2]``, micrometres, as the probes measure it; NaN where missing.
            least_motion_um: standard deviation that each probe must show at least.
        """
        whole = within_some_unit(samples)
        if not whole and (bad := self.missing(samples) or self._impossible(samples)) is not None:
            return bad
        known = np.array(samples, order="C") if whole else samples[np.isfinite(samples).all(axis=1)]
        self._pool.append(known)
        # Both probes at once, and only where that finds something each by itself.
        moves = never_rests(known)
        signals = [known] if len(self._pool) == 1 else [known, np.concatenate(self._pool)]
        signals = [signal for signal in signals if not never_clipped(signal)]
        deviations = known.std(axis=0)
        for column, probe in enumerate(self._probes):
            if not moves and stands_still(known[:, column : column + 1]):
                return RevolutionQuality(
                    "not_ok",
                    f"{probe.name}: stuck at {known[0, column]:.6g} um for a revolution; "
                    "check the probe, its cable and driver",
                )
            least = max(least_motion_um, DEAD * float(deviations[1 - column]))
            if deviations[column] < least:
                return RevolutionQuality(
                    "not_ok",
                    f"{probe.name}: moved by {deviations[column]:.3g} um rms in a revolution, at least "
                    f"{least:.3g} um is expected; check the probe, its cable and driver",
                )
            for signal in signals:
                if (clipped := clipped_at(signal[:, column])) is not None:
                    return RevolutionQuality(
                        "not_ok",
                        f"{probe.name}: clipped at {clipped:.6g} um; "
                        "check the gap and the range of the converter",
                    )
            still = None if moves else dropped_to(known[:, column])
            if still is not None:
                return RevolutionQuality(
                    "not_ok",
                    f"{probe.name}: stuck at {still.value:.6g} um for {still.samples} of {len(known)} "
                    "samples of a revolution; check the probe, its cable and driver",
                )
        return RevolutionQuality()


def seen_by(vector: Complexes, axis_deg: float) -> float:
    """1X amplitude that a probe sees.

    Args:
        vector: complex128 ``[5]``, synchronous vector.
        axis_deg: where the probe points.
    """
    axis = cmath.exp(-1j * math.radians(axis_deg))
    return float(abs(vector[1] * axis + np.conj(vector[2] * axis)))


def blind_probe(
    vector: Complexes,
    deviation_um: float,
    probes: Sequence[Probe],
    axes_deg: Sequence[float],
    healthy: Complexes | None = None,
) -> str:
    """Whether one probe does not see the whirl that the other sees, so that the orbit is a line along it.

    No shaft moves so: a probe that still shows noise, but no 1X, is not connected. What it saw when it was
    calibrated makes that clear in few revolutions.

    Args:
        vector: complex128 ``[5]``, mean synchronous vector in um.
        deviation_um: standard deviation of one component of it.
        probes: the two probes.
        axes_deg: where they point, in the coordinates of the vector.
        healthy: complex128 ``[5]``, the calibrated vector, if there is one.

    Returns:
        What is wrong and what to do; empty if nothing is.
    """
    amplitudes = [seen_by(vector, axis) for axis in axes_deg]
    deaf, seeing = (0, 1) if amplitudes[0] < amplitudes[1] else (1, 0)
    doubt = _SURE * math.sqrt(2.0) * deviation_um
    known_by = amplitudes[seeing] / _CLEAR
    if healthy is None:
        known_by = _BELIEVED * amplitudes[seeing]
    else:
        known_by = min(known_by, seen_by(healthy, axes_deg[deaf]) / _CLEAR)
    if doubt > known_by or amplitudes[deaf] > max(DEAD * amplitudes[seeing], doubt):
        return ""
    return (
        f"{probes[deaf].name}: sees no 1X ({amplitudes[deaf]:.2g} um) where {probes[seeing].name} sees "
        f"{amplitudes[seeing]:.3g} um; check the probe, its cable and driver"
    )
