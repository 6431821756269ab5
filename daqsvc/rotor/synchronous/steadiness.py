"""Are these revolutions of one and the same machine? What is not steady is no baseline.

Every stretch of revolutions is held against all others, in its mean vector and in its unrest. The scatter
that this is judged by comes from neighbouring revolutions, by medians: a step, a burst or a drift hardly
widens it, so that none of them hides behind itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

VECTOR_NATS = 30.0
"""Gamma(5, 1) passes this once in 300 million stretches; a calibration has some thousands."""
UNREST_NATS = 25.0
_LENGTHS = np.unique(np.round(np.geomspace(1, 1000, 25)).astype(np.int64))
_STARTS = 400
_SHORTEST_UNREST = 4
"""A bend reaches over three revolutions."""
_WITHOUT_TURNING = 10.0 / 9.0
"""One of ten real figures is left out."""
_NAMES = ("the mean position", "1X", "backward 1X", "2X", "backward 2X")
_MEDIAN = math.log(2.0)
_TURN_PADDING = 16
_LEAST_TURN_RAD = 0.3


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of revolutions that is not like the others.

    Attributes:
        begin: its first revolution, from 0.
        end: one past its last.
        nats: how much it differs.
        what: what differs.
        by: difference, um.
    """

    begin: int
    end: int
    nats: float
    what: str
    by: float


def nonstationarity(
    vectors: Complexes,
    noise: Floats,
    samples: Floats,
    baseline: Complexes,
    previous: Complexes | None = None,
) -> Floats:
    """Variance of a sample that does not repeat with the shaft, float64 ``[R]``.

    The residual within the revolution, and the bend of the vector over three revolutions: a whirl at half
    the speed leaves little in the residual, as five harmonics fit half a cycle well, but is another one
    every time. A vector that creeps or settles hardly bends, and what jitter of the marks does to it (all
    components turn together) is left out. For white noise it equals the noise.

    Args:
        vectors: complex128 ``[R, 5]``.
        noise: float64 ``[R]``, variance of the residual of a sample.
        samples: float64 ``[R]``.
        baseline: complex128 ``[5]``, mean vector.
        previous: complex128 ``[P, 5]``, vectors of the revolutions before, the last two of them count.
    """
    known = vectors if previous is None else np.vstack((previous[-2:], vectors))
    bends = np.full(len(known), np.nan)
    if len(known) > 2:
        bend = known[2:] - 2.0 * known[1:-1] + known[:-2]
        turning = 1j * np.array(HARMONICS) * baseline
        turning /= max(float(np.linalg.norm(turning)), 1e-300)
        along = (bend @ turning.conj()).real
        bends[2:] = (np.sum(np.abs(bend) ** 2, axis=1) - along**2) / 6.0 * _WITHOUT_TURNING
        bends[:2] = bends[2]
    else:
        bends[:] = 5.0 * noise.mean() / samples.mean()
    bends = bends[len(known) - len(vectors) :]
    return np.asarray((noise * np.maximum(samples - 5.0, 1.0) + samples * bends) / samples)


def oddest_stretch(
    vectors: Complexes, white: float, memory: float, floor: float, guard: Floats, jitter_rad: float = 0.0
) -> Stretch:
    """The stretch whose mean vector differs most from that of the others.

    Args:
        vectors: complex128 ``[R, 5]``, brought to one speed.
        white: variance of a vector's component that white noise makes.
        memory: correlation of the stirred orbit from one revolution to the next.
        floor: um^2 that no difference counts below.
        guard: float64 ``[R]``, um of 1X that each revolution's speed leaves uncertain, with its sign.
        jitter_rad: standard deviation of where a revolution begins.
    """
    neighbours = np.median(np.abs(np.diff(vectors, axis=0)) ** 2, axis=0) / (2.0 * _MEDIAN)
    stirred = np.maximum(neighbours - white, 0.0) / (1.0 - memory)
    variance = white + stirred * (1.0 + memory) / (1.0 - memory)
    variance = variance + (jitter_rad * np.abs(np.array(HARMONICS) * np.median(np.abs(vectors), axis=0))) ** 2
    columns = np.column_stack((vectors, guard.astype(np.complex128)))
    best = Stretch(0, 0, 0.0, "", 0.0)
    for length, starts, inside, outside, share in _stretches(columns):
        change = inside[:, :5] - outside[:, :5]
        allowed = np.tile(variance * share + floor, (len(starts), 1))
        allowed[:, 1:3] += (np.abs(inside[:, 5] - outside[:, 5]) ** 2)[:, np.newaxis]
        terms = np.abs(change) ** 2 / allowed
        nats = terms.sum(axis=1)
        at = int(nats.argmax())
        if nats[at] > best.nats:
            worst = int(terms[at].argmax())
            begin = int(starts[at])
            by = float(abs(change[at, worst]))
            best = Stretch(begin, begin + length, float(nats[at]), _NAMES[worst], by)
    return best


def most_restless_stretch(values: Floats, samples: float) -> Stretch:
    """The stretch whose unrest differs most from that of the others.

    Args:
        values: float64 ``[R]``, unrest of every revolution.
        samples: samples in a revolution; white noise scatters the less the more there are.
    """
    typical = float(np.median(values))
    scatter = float(np.median(np.abs(np.diff(values)))) / (0.6745 * math.sqrt(2.0))
    scatter = max(scatter, typical / math.sqrt(max(samples - 5.0, 1.0)), 1e-300)
    best = Stretch(0, 0, 0.0, "", 0.0)
    for length, starts, inside, outside, share in _stretches(values[:, np.newaxis]):
        if length < _SHORTEST_UNREST:
            continue
        nats = (inside[:, 0] - outside[:, 0]) ** 2 / (2.0 * share * scatter**2)
        at = int(nats.argmax())
        if nats[at] > best.nats:
            begin = int(starts[at])
            by = math.sqrt(max(float(inside[at, 0]), 0.0) / 2.0)
            best = Stretch(begin, begin + length, float(nats[at]), "what does not repeat", by)
    return best


def turn_per_revolution(forward: Complexes) -> float:
    """What 1X turns against the angle in a revolution, in rad; 0 if hardly anything in all of them."""
    size = _TURN_PADDING * 2 ** math.ceil(math.log2(len(forward)))
    strongest = int(np.abs(np.fft.fft(forward, size)).argmax())
    turn = 2.0 * math.pi * ((strongest + size // 2) % size - size // 2) / size
    time = np.arange(len(forward)) - (len(forward) - 1) / 2.0
    for _ in range(3):
        still = forward * np.exp(-1j * turn * time)
        mean = still.mean()
        # What is left turns slowly: its slope is that of the part at right angles to the mean.
        turn += float(
            (time * (still * mean.conjugate()).imag).sum() / (time @ time) / max(abs(mean) ** 2, 1e-300)
        )
    return turn if abs(turn) * len(forward) > _LEAST_TURN_RAD else 0.0


def _stretches(
    columns: NDArray[np.generic],
) -> list[tuple[int, NDArray[np.int64], NDArray[np.complex128], NDArray[np.complex128], float]]:
    """Stretches of every length up to half: length, starts, means inside and outside, 1/m + 1/(n - m)."""
    count = len(columns)
    sums = np.vstack((np.zeros((1, columns.shape[1])), np.cumsum(columns, axis=0)))
    found = []
    for length in _LENGTHS[count // 2 >= _LENGTHS].tolist():
        stride = max(1, (count - length) // _STARTS)
        starts = np.unique(np.append(np.arange(0, count - length + 1, stride), count - length))
        total = sums[starts + length] - sums[starts]
        inside, outside = total / length, (sums[-1] - total) / (count - length)
        found.append((length, starts, inside, outside, 1.0 / length + 1.0 / (count - length)))
    return found
