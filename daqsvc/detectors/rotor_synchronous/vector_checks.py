"""Whether synchronous vectors can be those of the calibrated machine at all, whatever has happened to it."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.quality.probes import RevolutionQuality, blind_probe
from daqsvc.rotor.synchronous.baseline import SPEED_TOLERANCE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.dsp.probes import Probe
    from daqsvc.rotor.synchronous.baseline import Calibration

    Complexes = NDArray[np.complex128]

_LENGTHS = (4, 8, 12, 32)
"""Revolutions evaluated together: short for what is clear, before a change gets a name; long for noise."""
_SLIP_LENGTH = 12
_VANISHED = 0.05
_SURE = 6.0
_SLIP = 0.001
"""Relative difference of speeds below which a turning 1X may be the machine's own (a thermal bow, a rub)."""
_EVEN = 0.1
_STEADY = 1.1
"""A shaft at another speed turns 1X evenly and leaves it as large as it was; a rotor that swings into a new
state does neither."""


class VectorChecks:
    """Looks at the last synchronous vectors of a calibrated machine.

    Args:
        probes: the two probes.
        axes_deg: where they point, in the coordinates of the vectors.
        angle_assumed: whether the shaft angle rests on a stated speed instead of a keyphasor.
    """

    def __init__(self, probes: Sequence[Probe], axes_deg: Sequence[float], *, angle_assumed: bool) -> None:
        self._probes = tuple(probes)
        self._axes_deg = tuple(axes_deg)
        self._angle_assumed = angle_assumed
        self._vectors: deque[Complexes] = deque(maxlen=_LENGTHS[-1])

    def reset(self) -> None:
        """Forget what was before a gap."""
        self._vectors.clear()

    @property
    def mean(self) -> Complexes:
        """Complex128 ``[5]``, mean of the last few vectors in um; NaN if there are none."""
        if not self._vectors:
            return np.full(5, np.nan, dtype=np.complex128)
        return np.asarray(np.mean(list(self._vectors)[-8:], axis=0))

    def add(self, vector: Complexes) -> None:
        """Take in the vector of a revolution, complex128 ``[5]`` in um."""
        self._vectors.append(vector)

    def of_baseline(self, calibration: Calibration) -> str:
        """What cannot be true of a baseline; empty if nothing is wrong."""
        deviation = math.sqrt(float(calibration.variance[1]) / calibration.revolutions)
        return blind_probe(calibration.baseline, deviation, self._probes, self._axes_deg)

    def judge(self, calibration: Calibration) -> RevolutionQuality:
        """Whether the last vectors can be believed."""
        for length in _LENGTHS:
            if len(self._vectors) < length:
                break
            vectors = np.array(list(self._vectors)[-length:])
            deviation = math.sqrt(float(calibration.variance[1]) / length)
            reason = blind_probe(
                vectors.mean(axis=0), deviation, self._probes, self._axes_deg, calibration.baseline
            )
            if not reason and self._angle_assumed and length >= _SLIP_LENGTH:
                reason = self._lost(vectors, deviation, calibration)
            if reason:
                return RevolutionQuality("not_ok", reason)
        return RevolutionQuality()

    def _lost(self, vectors: Complexes, deviation: float, calibration: Calibration) -> str:
        """Whether the shaft no longer turns at the stated speed."""
        forward = vectors[:, 1]
        amplitude, healthy = float(abs(forward.mean())), calibration.amplitude_um
        turned = [float(np.angle(b.mean() * np.conj(a.mean()))) for a, b in _neighbours(forward)]
        radii = [float(abs(part.mean())) for part in np.array_split(forward, 3)]
        spread = _SURE * deviation * math.sqrt(6.0)  # of the difference of two thirds
        slip = sum(turned) / len(turned) / (len(forward) / 3.0) / math.tau
        uneven = abs(turned[0] - turned[1]) > _EVEN * abs(sum(turned)) + spread / max(min(radii), 1e-12)
        steady = max(radii) < _STEADY * min(radii) + spread
        if min(radii) > spread and abs(sum(turned)) / 2.0 > spread / min(radii) and not uneven and steady:
            if turned[0] * turned[1] > 0.0 and abs(slip) > _SLIP:
                way = "faster" if slip > 0.0 else "slower"
                return (
                    f"the angle is no longer locked to the shaft: 1X turns by {360.0 * slip:+.2g} degrees a "
                    f"revolution, so the shaft turns {100.0 * abs(slip):.2g} % {way} than "
                    f"{calibration.speed_rpm:.1f} rpm; use a keyphasor, or calibrate at the present speed"
                )
            return ""
        if amplitude < _VANISHED * healthy and _SURE * deviation < _VANISHED * 3.0 * healthy:
            return (
                f"there is no orbit at {calibration.speed_rpm:.1f} rpm any more (1X {amplitude:.2g} um, "
                f"calibrated {healthy:.3g} um); check that the machine still runs at that speed"
            )
        return ""


def speed_verdict(speed_rpm: float, calibration: Calibration) -> RevolutionQuality:
    """Whether a revolution is near enough to the speed of calibration to be judged."""
    if abs(speed_rpm / calibration.speed_rpm - 1.0) <= SPEED_TOLERANCE:
        return RevolutionQuality()
    return RevolutionQuality(
        "missing",
        f"not judged at {speed_rpm:.0f} rpm: the machine was calibrated at {calibration.speed_rpm:.0f} rpm, "
        f"and beyond {100.0 * SPEED_TOLERANCE:.0f} % of that its healthy orbit differs; run it at that "
        "speed, or calibrate it at this one",
    )


def static_position_missing(calibration: Calibration) -> bool:
    """Whether the baseline shows no mean position where the shaft's own weight must make one."""
    seen = float(abs(calibration.baseline[0]))
    doubt = 4.0 * math.sqrt(float(calibration.variance[0]) / calibration.revolutions)
    allowed = doubt + 1e-3 * calibration.amplitude_um
    return seen < allowed and calibration.rotor.sag_um > 10.0 * allowed


def _neighbours(values: Complexes) -> list[tuple[Complexes, Complexes]]:
    first, second, third = np.array_split(values, 3)
    return [(first, second), (second, third)]
