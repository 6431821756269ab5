"""How the synchronous vector of one machine follows its speed, learnt while the speed hunts.

Near a critical speed 1 % of speed moves 1X by a tenth of itself. What the stated rotor predicts of that is
taken out beforehand (`daqsvc.rotor.synchronous.baseline.compensated`). What it does not, because frequency
and damping are known roughly, or because the machine is no Laval rotor, is a line through the calibration:

    Z_k = b_k + s_k v + r_k dv/dn,    v = Omega / Omega_0 - 1

with n counted in revolutions. The term of the rate is there because a rotor is late: while the speed rises,
1X is not what it is at that speed while it falls. It is late by about as many revolutions as its free motion
takes to die away. A calibration may have seen the speed rise only. Then the line is uncertain by as much as a
rotor can be late, and more revolutions teach it.

Slopes and rates have a prior: what the rotor's tolerances allow, and as much again as twice its own slope. A
speed that does not move teaches nothing, and the prior stays. The bend of a resonance, a term in v^2, is not
learnt: a part of a swing fits any. How large it may be is a part of what is uncertain.
"""

from __future__ import annotations

import math
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
"""Revolutions that the rate of the speed is taken over, and that residuals of the line are averaged over."""
EARLIER_SPEEDS = _SMOOTHED_REV - 1
"""Revolutions before the first one that its rate takes."""
_LEAST_RATE_REV = 3
"""Revolutions that a rate takes."""
LATE = 2.0
"""Revolutions by which a rotor is late, over those that its free motion dies away in: one of the two modes of
uneven supports is later than the other."""
_LEAST_NOISE = 1e-6
"""Of the whirl: a recording that was computed may have none."""
_BY_CHANCE = 2.0
"""Standard deviations that a mean square may be above its expectation by chance."""
_BEND = 2.0
"""Of a swing's square: from its mean to its largest value is half of it."""
_MODEL_DOUBT = 2.0
"""Standard deviation of a slope that no figures of a rotor give, in parts of the one that they give."""


@dataclass(frozen=True, slots=True)
class SpeedLaw:
    """What was learnt.

    Attributes:
        follows_um: complex128 ``[2, 5]``, s_k in um for a relative speed of 1, and r_k in um for a change of
            it by 1 in a revolution: the first two `speed_terms`.
        covariance_um2: float64 ``[5, 3, 3]``, of the errors of these and of the bend, um^2 for a product of
            two `speed_terms` of 1.
        off_um: float64 ``[5]``, what is off for a few revolutions at most; this cancels over whole swings of
            the speed.
    """

    follows_um: Complexes
    covariance_um2: Floats
    off_um: Floats

    def predicted_um(self, terms: Floats) -> Complexes:
        """What the speed moves the vector by, complex128 ``[..., 5]``.

        Args:
            terms: float64 ``[..., 3]``, `speed_terms`.
        """
        return np.asarray(terms[..., :2] @ self.follows_um)

    def variance_um2(self, apart: Floats) -> Floats:
        """What is uncertain of the difference between revolutions, float64 ``[..., 5]``.

        Args:
            apart: float64 ``[..., 3]``, difference of their `speed_terms`.
        """
        learnt = np.einsum("...i,kij,...j->...k", apart, self.covariance_um2, apart)
        return np.asarray(learnt + self.off_um**2)

    def doubts_um(self, terms: Floats) -> Floats:
        """What `variance_um2` allows for but ``off_um``, part by part, float64 ``[R, 3]``: its square root.

        Of 1X forward, the component that follows the speed most.

        Args:
            terms: float64 ``[R, 3]``, `speed_terms`.
        """
        variances, directions = np.linalg.eigh(self.covariance_um2[FORWARD])
        return np.asarray(terms @ (directions * np.sqrt(np.maximum(variances, 0.0))))

    def turned(self, turns: Complexes) -> SpeedLaw:
        """The same where each component is turned, complex128 ``[5]``."""
        return replace(self, follows_um=self.follows_um * turns)

    def within(self, before: SpeedLaw) -> SpeedLaw:
        """The same, with no more off than by a law of before: more is left by a fault that grows slowly."""
        return replace(self, off_um=np.minimum(self.off_um, before.off_um))

    def over_swings(self) -> SpeedLaw:
        """The same of means over whole swings of the speed."""
        return replace(self, off_um=np.zeros_like(self.off_um))


def speed_terms(deviation: Floats, before: Floats | None = None) -> Floats:
    """What a vector can follow, float64 ``[R, 3]``: relative speed, its change in a revolution, its square.

    Args:
        deviation: float64 ``[R]``, relative speed of each revolution.
        before: float64, that of the revolutions before; the last `EARLIER_SPEEDS` count.
    """
    known = deviation if before is None else np.concatenate((before[-EARLIER_SPEEDS:], deviation))
    rates = np.zeros(len(known))
    for width in range(_LEAST_RATE_REV, min(_SMOOTHED_REV, len(known)) + 1):
        time = np.arange(width) - (width - 1) / 2.0
        last = len(known) if width == _SMOOTHED_REV else width
        rates[width - 1 : last] = np.convolve(known[:last], time[::-1] / (time @ time), mode="valid")
    return np.column_stack((deviation, rates[len(known) - len(deviation) :], deviation**2))


def learn(
    moved: Complexes,
    terms: Floats,
    variance: Floats,
    slope: complex,
    slope_spread: float,
    settling_rev: float,
) -> SpeedLaw | None:
    """Fit the line; None where the speed does not hunt, or only the marks of the keyphasor jitter.

    Args:
        moved: complex128 ``[R, 5]``, vectors with what the stated rotor predicts taken out, um.
        terms: float64 ``[R, 3]``, `speed_terms` of each revolution.
        variance: float64 ``[5]``, variance of one revolution's vector, um^2.
        slope: d ln Z_1 / d ln Omega of the stated rotor.
        slope_spread: standard deviation of it over the rotor's tolerances.
        settling_rev: revolutions in which the free motion of the stated rotor dies away, to 1/e.
    """
    away = terms - terms.mean(axis=0)
    hunting, jitter = float((away[:, 0] ** 2).mean()), float((np.diff(terms[:, 0]) ** 2).mean()) / 2.0
    if hunting < _LEAST_HUNTING**2 or jitter > _MOST_JITTER * hunting:
        return None
    mean = moved.mean(axis=0)
    whirl = float(np.hypot(abs(mean[FORWARD]), abs(mean[BACKWARD])))
    variance = np.maximum(variance, (_LEAST_NOISE * whirl) ** 2 + 1e-30)
    most = whirl * np.hypot(slope_spread, _MODEL_DOUBT * abs(slope))
    late = LATE * settling_rev
    steep = np.hypot(most, abs(slope) * whirl)
    prior = np.array([most, late * steep])
    # By speed and rate; the square is about how it bends.
    line = away[:, :2]
    follows, covariance = _fitted(moved - mean, line, prior, variance)
    lasting = _lasting(moved - mean - line @ follows)
    if np.any(lasting > variance):
        # What the line does not explain is no noise that the next revolution takes back.
        follows, covariance = _fitted(moved - mean, line, prior, np.maximum(variance, lasting))
        lasting = _lasting(moved - mean - line @ follows)
    turned = slope * mean[FORWARD], np.conj(slope) * mean[BACKWARD]
    # The next term of the series of a resonance is as much smaller as this one is than the whole.
    bend = np.abs(follows[0, [FORWARD, BACKWARD]] + turned) ** 2 / max(whirl, 1e-12)
    # It bends about the mean speed: by the square of what the speed is away from that.
    square = np.array([-2.0 * float(terms[:, 0].mean()), 0.0, 1.0])
    for k, most_bend in zip((FORWARD, BACKWARD), _BEND * bend, strict=True):
        covariance[k] += most_bend**2 * np.outer(square, square)
    chance = variance * (1.0 + _BY_CHANCE * math.sqrt(_SMOOTHED_REV / len(moved)))
    left = np.maximum(lasting - chance, 0.0) * 2.0 / _SMOOTHED_REV
    # A part of a swing fits what the next one does not; each whole one that was seen makes that rarer.
    unseen = np.zeros(len(mean))
    unseen[[FORWARD, BACKWARD]] = late * np.sqrt(bend * whirl) * float(np.abs(terms[:, 1]).max())
    unseen /= max(1, _whole_swings(away[:, 0])) ** 2
    return SpeedLaw(follows, covariance, np.sqrt(left + unseen**2))


def _whole_swings(away: Floats) -> int:
    """How often the speed has swung up and down."""
    width = min(_SMOOTHED_REV, len(away) // 2)
    above = np.convolve(away, np.full(width, 1.0 / width), mode="valid") > 0.0
    return int(np.count_nonzero(above[1:] != above[:-1])) // 2


def _fitted(moved: Complexes, line: Floats, prior: Floats, variance: Floats) -> tuple[Complexes, Floats]:
    """What 1X follows speed and rate by, complex128 ``[2, 5]``, and the covariance, float64 ``[5, 3, 3]``."""
    follows = np.zeros((2, moved.shape[1]), dtype=np.complex128)
    covariance = np.zeros((moved.shape[1], 3, 3))
    # In parts of the prior: the two are of different size by decades.
    scaled = line * prior
    for k in (FORWARD, BACKWARD):
        inverse = np.linalg.inv(scaled.T @ scaled + variance[k] * np.eye(2))
        follows[:, k] = prior * (inverse @ (scaled.T @ moved[:, k]))
        covariance[k, :2, :2] = variance[k] * inverse * np.outer(prior, prior)
    return follows, covariance


def _lasting(left: Complexes) -> Floats:
    """Variance of one revolution as it counts in means of a few, float64 ``[5]``, um^2."""
    width = min(_SMOOTHED_REV, len(left) // 2)
    sums = np.cumsum(np.vstack((np.zeros((1, left.shape[1])), left)), axis=0)
    means = (sums[width:] - sums[:-width]) / width
    return np.asarray(width * (np.abs(means) ** 2).mean(axis=0))
