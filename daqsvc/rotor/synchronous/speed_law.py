"""How the synchronous vector of one machine follows its speed, learnt while the speed hunts.

Near a critical speed 1 % of speed moves 1X by a tenth of itself. What the stated rotor predicts of that is
taken out beforehand (`daqsvc.rotor.synchronous.baseline.compensated`). What it does not, because frequency
and damping are known roughly, or because the machine is no Laval rotor, is a line through the calibration:

    Z_k(Omega) = b_k + s_k (Omega / Omega_0 - 1)

The rotor is late, by the revolutions that its free motion dies away in: while the speed rises, 1X is not what
it is at that speed while it falls. A calibration often sees one of the two only, and its line is off by that.

The slopes have a prior: nothing beyond what the rotor's tolerances allow. A speed that does not move teaches
nothing, and the prior stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.vectors import BACKWARD, FORWARD

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

_LEAST_HUNTING = 1e-3
"""Standard deviation of the relative speed below which nothing is learnt."""
_MOST_JITTER = 0.5
"""Part of its square that may change from one revolution to the next: a shaft hunts slowly, marks jitter."""
_SMOOTHED_REV = 9
"""Revolutions that the rate of the speed is taken over."""
_LATE = 2.0
"""Revolutions by which a rotor is late, over those that its free motion dies away in: one of the two modes of
uneven supports is later than the other."""
_MODEL_DOUBT = 2.0
"""Standard deviation of a slope that no figures of a rotor give, in parts of the one that they give."""


@dataclass(frozen=True, slots=True)
class SpeedLaw:
    """What was learnt.

    Attributes:
        slopes_um: complex128 ``[5]``, s_k: um for a relative change of speed of 1.
        spread_um: float64 ``[5]``, standard deviation of each.
        bend_um: float64 ``[5]``, what the line is off by at most within the speeds that it was learnt from.
        late_um: float64 ``[5]``, what it is off by at most while the speed changes, as the rotor is late;
            this cancels over whole swings of the speed.
    """

    slopes_um: Complexes
    spread_um: Floats
    bend_um: Floats
    late_um: Floats

    @property
    def off_um(self) -> Floats:
        """What the line is off by at most, float64 ``[5]``."""
        return np.hypot(self.bend_um, self.late_um)

    def over_swings(self) -> SpeedLaw:
        """The same of means over whole swings of the speed."""
        return replace(self, late_um=np.zeros_like(self.late_um))


def learn(
    moved: Complexes,
    deviation: Floats,
    variance: Floats,
    slope: complex,
    slope_spread: float,
    settling_rev: float,
) -> SpeedLaw | None:
    """Fit the line; None where the speed does not hunt, or only the marks of the keyphasor jitter.

    Args:
        moved: complex128 ``[R, 5]``, vectors with what the stated rotor predicts taken out, um.
        deviation: float64 ``[R]``, relative speed of each revolution.
        variance: float64 ``[5]``, variance of one revolution's vector, um^2.
        slope: d ln Z_1 / d ln Omega of the stated rotor.
        slope_spread: standard deviation of it over the rotor's tolerances.
        settling_rev: revolutions in which the free motion of the stated rotor dies away, to 1/e.
    """
    away = deviation - deviation.mean()
    hunting, jitter = float((away**2).mean()), float((np.diff(deviation) ** 2).mean()) / 2.0
    if hunting < _LEAST_HUNTING**2 or jitter > _MOST_JITTER * hunting:
        return None
    mean = moved.mean(axis=0)
    whirl = float(np.hypot(abs(mean[FORWARD]), abs(mean[BACKWARD])))
    prior = np.zeros(len(mean))
    prior[[FORWARD, BACKWARD]] = whirl * np.hypot(slope_spread, _MODEL_DOUBT * abs(slope))
    weight = np.divide(variance, prior**2, out=np.full(len(mean), np.inf), where=prior > 0.0)
    slopes = (away @ (moved - mean)) / ((away**2).sum() + weight)
    spread = np.sqrt(variance / ((away**2).sum() + weight))
    turned = np.zeros(len(mean), dtype=np.complex128)
    turned[[FORWARD, BACKWARD]] = (slope * mean[FORWARD], np.conj(slope) * mean[BACKWARD])
    steep = np.abs(turned + slopes)
    furthest = float(np.abs(away).max())
    # The next term of the series of a resonance is as much smaller as this one is than the whole.
    bend = (steep * furthest) ** 2 / max(whirl, 1e-12)
    late = steep * _fastest(away) * _LATE * settling_rev
    return SpeedLaw(slopes, spread, bend, late)


def _fastest(deviation: Floats) -> float:
    """Largest change of the relative speed in a revolution, without the jitter of the marks."""
    width = min(_SMOOTHED_REV, len(deviation) // 2)
    smooth = np.convolve(deviation, np.full(width, 1.0 / width), mode="valid")
    return float(np.abs(np.diff(smooth)).max())
