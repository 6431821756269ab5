"""The synchronous vector: what a rotor does in one revolution, in five complex numbers and an energy.

With z = x + iy and the shaft angle theta, the orbit of a revolution is fitted by

    z = sum over k of Z_k exp(i k theta),    k in (0, 1, -1, 2, -2)

Z_0 is where the shaft runs (gap voltage), Z_1 its forward 1X whirl, Z_-1 the backward part that makes the
orbit an ellipse, Z_2 and Z_-2 what misalignment, cracks and rub add. What the five leave over is the
non-harmonic energy: noise, and all that does not repeat with the shaft. Of that, 3X in both senses is kept
too: it shows little of whether a machine has changed, and much of what a change is.

The vector of the healthy machine (`Healthy`) and the densities by which hypotheses about its faults are
compared are here, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from daqsvc.dsp.speed.revolutions import Revolutions
    from daqsvc.rotor.laval import LavalRotor

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]


HARMONICS = (0, 1, -1, 2, -2)
"""Orders of the components of a synchronous vector, in this order."""
WITH_THRICE = (*HARMONICS, 3, -3)
"""The same with 3X, where a change is named."""

_LEAST_SHARE = 0.75
"""Part of a revolution's samples that must be there."""
LEAST_SAMPLES_OF_3X = 16.0
"""Samples in a revolution with which 3X is well separated from the other components."""
_WORST_CONDITION = 2.5
"""Largest spread of the normal equations' eigenvalues: missing samples must not lie in one piece too long.

A revolution that lacks an eighth in one piece is just fitted, and the variance of its vector is a quarter
above that of a whole one. With a quarter in one piece it would be 2.6 times that, and make departures.
"""


@dataclass(frozen=True, slots=True)
class SynchronousVectors:
    """Synchronous vectors of R revolutions.

    Attributes:
        vectors: complex128 ``[R, 5]``, Z_k in the order of `HARMONICS`, in the unit of the samples; NaN where
            a revolution cannot be fitted.
        noise: float64 ``[R]``, variance of the complex residual of one sample, squared unit.
        samples: float64 ``[R]``, usable samples in the revolution.
        period_samples: float64 ``[R]``, length of the revolution in samples.
        end_index: int64 ``[R]``, samples since the start up to the end of the revolution.
        thrice: complex128 ``[R, 2]``, 3X forward and backward in what the vectors leave over; NaN where a
            revolution cannot be fitted or has too few samples for it.
    """

    vectors: Complexes
    noise: Floats
    samples: Floats
    period_samples: Floats
    end_index: NDArray[np.int64]
    thrice: Complexes

    def __len__(self) -> int:
        return len(self.noise)

    @property
    def usable(self) -> Flags:
        """Bool ``[R]``, revolutions that could be fitted."""
        return np.isfinite(self.noise)

    def __getitem__(self, part: slice | Flags) -> SynchronousVectors:
        return SynchronousVectors(
            self.vectors[part],
            self.noise[part],
            self.samples[part],
            self.period_samples[part],
            self.end_index[part],
            self.thrice[part],
        )

    @staticmethod
    def joined(parts: Sequence[SynchronousVectors]) -> SynchronousVectors:
        """One after another; at least one."""
        return SynchronousVectors(
            np.concatenate([part.vectors for part in parts]),
            np.concatenate([part.noise for part in parts]),
            np.concatenate([part.samples for part in parts]),
            np.concatenate([part.period_samples for part in parts]),
            np.concatenate([part.end_index for part in parts]),
            np.concatenate([part.thrice for part in parts]),
        )


def synchronous_vectors(revolutions: Revolutions) -> SynchronousVectors:
    """Fit every revolution by least squares.

    Exact for any number of samples in a revolution, whole or not, and for missing ones: the normal equations
    are solved instead of taking the harmonics as orthogonal.

    Args:
        revolutions: whole revolutions with the shaft angle of every sample.
    """
    count = len(revolutions.starts)
    ends = np.append(revolutions.starts[1:], len(revolutions.xy)).astype(np.int64)
    end_index = revolutions.first_index + ends
    if not count:
        empty = np.empty(0)
        return SynchronousVectors(
            np.empty((0, 5), np.complex128),
            empty,
            empty,
            empty,
            end_index[:0],
            np.empty((0, 2), np.complex128),
        )
    z = revolutions.xy[:, 0] + 1j * revolutions.xy[:, 1]
    there = np.isfinite(z) & np.isfinite(revolutions.angle_rad)
    z = np.where(there, z, 0.0)
    turn = np.where(there, np.exp(1j * np.where(there, revolutions.angle_rad, 0.0)), 0.0)

    def total(values: Complexes | Floats) -> Complexes:
        # A revolution without samples would make reduceat return its neighbour's first one.
        sums = np.add.reduceat(np.append(values, 0.0), revolutions.starts)
        return np.where(ends > revolutions.starts, sums, 0.0)

    powers = [there.astype(np.complex128), turn, turn**2, turn**3, turn**4, turn**5]
    sums = [total(power) for power in powers]
    samples = sums[0].real
    order = np.array(HARMONICS)
    difference = order[np.newaxis, :] - order[:, np.newaxis]
    spectrum = np.stack([*(np.conj(s) for s in sums[:0:-1]), *sums], axis=-1)  # orders -5 to 5
    normal = spectrum[:, difference + 5]
    projected = np.stack([total(z * np.conj(_power(powers, k))) for k in HARMONICS], axis=-1)

    eigenvalues = np.linalg.eigvalsh(normal)
    usable = revolutions.trusted & (samples >= np.maximum(_LEAST_SHARE * revolutions.period_samples, 8.0))
    usable &= eigenvalues[:, -1] < _WORST_CONDITION * eigenvalues[:, 0]
    normal[~usable] = np.eye(5)
    vectors: Complexes = np.linalg.solve(normal, projected[..., np.newaxis])[..., 0].astype(np.complex128)
    residual = total(np.abs(z) ** 2).real - np.einsum("rk,rk->r", projected.conj(), vectors).real
    noise = np.maximum(residual, 0.0) / np.maximum(samples - 5.0, 1.0)
    vectors[~usable] = np.nan
    noise[~usable] = np.nan
    beyond = np.array((3, -3))
    explained = spectrum[:, order[np.newaxis, :] - beyond[:, np.newaxis] + 5]
    thrice = np.stack([total(z * np.conj(_power(powers, k))) for k in (3, -3)], axis=-1)
    thrice = (thrice - np.einsum("rjk,rk->rj", explained, vectors)) / np.maximum(samples, 1.0)[:, np.newaxis]
    thrice[~usable | (samples < LEAST_SAMPLES_OF_3X)] = np.nan
    return SynchronousVectors(
        vectors,
        noise,
        samples,
        np.asarray(revolutions.period_samples, dtype=np.float64),
        end_index,
        np.asarray(thrice, dtype=np.complex128),
    )


def _power(powers: Sequence[Complexes], k: int) -> Complexes:
    return powers[k] if k >= 0 else np.conj(powers[-k])


DC, FORWARD, BACKWARD = (HARMONICS.index(k) for k in (0, 1, -1))
TWICE = [HARMONICS.index(k) for k in (2, -2)]
BEYOND_1X = slice(TWICE[0], None)
"""2X and, where it is there, 3X."""
BEYOND_2X = slice(len(HARMONICS), None)
"""3X, where it is there."""
FLOOR = 0.002
"""Part of the 1X amplitude that no average resolves: the sensor chain is not better than that."""

SPREADS = np.array([0.1, 0.3, 1.0, 3.0])
"""Sizes that a change may have, in parts of the healthy orbit."""


@dataclass(frozen=True, slots=True)
class Healthy:
    """The healthy machine, as far as the signatures need it.

    Attributes:
        baseline: complex128 ``[5]``, its synchronous vector in um.
        speed_rad_s: shaft speed.
        rotor: what is known about the rotor.
        laval: whether the machine behaves like a Laval rotor; if not, stiffness loss is any change of mean
            position and 1X together in which the shaft sinks, and damping loss any change of 1X.
    """

    baseline: Complexes
    speed_rad_s: float
    rotor: LavalRotor
    laval: bool

    @property
    def modelled(self) -> bool:
        """Whether a model holds that gives how forces move it: one Laval rotor, or two modes of a run-up."""
        return self.laval or self.rotor.two_modes is not None

    @property
    def amplitude_um(self) -> float:
        """Amplitude A of the healthy whirl, the measure of every change."""
        return float(np.sqrt(np.sum(np.abs(self.baseline[1:]) ** 2)))

    @property
    def floor_um2(self) -> float:
        """Square of a difference that no number of revolutions resolves."""
        return float((FLOOR * abs(self.baseline[FORWARD])) ** 2)

    @property
    def whirl_um(self) -> float:
        """The part of it that unbalance makes: 1X in both senses."""
        return float(np.hypot(abs(self.baseline[FORWARD]), abs(self.baseline[BACKWARD])))

    @property
    def ellipticity(self) -> float:
        """Backward over forward 1X."""
        return float(abs(self.baseline[BACKWARD]) / max(abs(self.baseline[FORWARD]), 1e-12))


def log_density(values: Complexes | Floats, variance: Floats) -> Floats:
    """Log density of circular complex normal values, without the constant ln pi."""
    return np.asarray(-(np.abs(values) ** 2) / variance - np.log(variance))


def density(value: complex, variance: float) -> float:
    """The same of one value."""
    return -(abs(value) ** 2) / variance - math.log(variance)


def log_mean(values: Floats) -> float:
    """Logarithm of the mean of what has these logarithms; minus infinity if all are."""
    top = float(values.max())
    if not math.isfinite(top):
        return top
    return top + math.log(float(np.exp(values - top).mean()))
