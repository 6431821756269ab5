"""Has the machine changed? A generalised likelihood ratio over windows of the last revolutions.

For every window of m revolutions the mean synchronous vector is compared with that of all revolutions
before it:

    T = max over m of sum over k of |mean_m(Z_k) - mean_ref(Z_k)|^2 / (v_k (1/m + 1/n_ref) + floor)

Under a healthy machine T of one window is Gamma(5, 1): five complex components. The reference is all that
was seen since it began, so it gets better while the machine stays as it is. What can be seen at all is
limited by its length, not by the time: delta_min = sqrt(threshold / (n_ref N SNR)).

Before that: are the revolutions of a baseline those of one and the same machine (`oddest_stretch`)? Every
stretch of revolutions is compared with all others, in its mean vector and in its nonstationarity. The
scatter that this is judged by comes from neighbouring revolutions, by medians: a step, a burst or a drift
hardly widens it, so that none of them hides itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.rotor.synchronous.speed_law import SpeedLaw

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]


WINDOWS = np.array([1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128])
"""Lengths of the windows in revolutions."""

_LONGEST = int(WINDOWS[-1])
_MOST_REFERENCE = 2000
"""The reference stops to grow here: beyond, the drift of a machine would be taken for healthy."""

# Measured over healthy revolutions with a growing baseline (test_rotor_departure.py): 1.6, 0.42, 0.09
# and 0.02 departures per 1000 revolutions at 16, 18, 20 and 22 nats; the line is on the safe side of them.
_RATE_AT_16 = 1.9
_RATE_PER_NAT = math.log(1.9 / 0.03) / 6.0
_BESIDE_NOISE = 1.8
"""Departures of a healthy machine over those that noise makes of its vector: its energy is tested, too, its
probes drift and its speed hunts. Of finite-element rotors there were up to this many times those wanted."""


def threshold_for(false_alarms_per_1000_rev: float) -> float:
    """Threshold of T in nats for a wanted rate of false departures.

    Raises:
        ValueError: a rate that cannot be.
    """
    if not 1e-9 <= false_alarms_per_1000_rev <= 10.0:
        raise ValueError(
            f"departure test: {false_alarms_per_1000_rev} false alarms per 1000 revolutions; "
            "give a rate from 1e-9 to 10"
        )
    return 16.0 + math.log(_BESIDE_NOISE * _RATE_AT_16 / false_alarms_per_1000_rev) / _RATE_PER_NAT


@dataclass(frozen=True, slots=True)
class Spread:
    """How much the synchronous vectors of a machine that does not change scatter.

    Attributes:
        variance: float64 ``[5]``, complex variance v_k of one revolution's Z_k as it counts in means of many:
            an orbit that is stirred by process noise is correlated from one revolution to the next.
        noise: variance of the complex residual of one sample.
        noise_variance: relative variance of it from one revolution to the next.
        floor: um^2, a difference that more revolutions do not resolve.
        speed_slope: standard deviation of d ln Z_1 / d ln Omega after compensation.
        amplitude_um: modulus of Z_1 that the slope belongs to.
        drift: um^2, variance of the mean position that is the probes', not the shaft's.
        turn_rad: standard deviation of what the angle turns against the shaft in a revolution, where a
            stated speed replaces a keyphasor.
        late_um: what 1X may be late by, in um for a change of the relative speed by 1 in a revolution.
        law: how the vector follows the speed, where that was learnt; takes the place of ``speed_slope`` and
            ``late_um``.
    """

    variance: Floats
    noise: float
    noise_variance: float
    floor: float
    speed_slope: float = 0.0
    amplitude_um: float = 0.0
    drift: float = 0.0
    turn_rad: float = 0.0
    late_um: float = 0.0
    law: SpeedLaw | None = None

    def of_means(
        self,
        revolutions: Floats | float,
        reference: Floats | float,
        terms: Floats | None = None,
        apart: Floats | float = 0.0,
    ) -> Floats:
        """Variance of the difference of two mean vectors, float64 ``[..., 5]``.

        Args:
            revolutions: in the one mean.
            reference: in the other.
            terms: float64 ``[..., 3]``, difference of their `speed_terms`; None if there is none.
            apart: revolutions from the middle of the one to that of the other.
        """
        share = np.asarray(1.0 / np.asarray(revolutions) + 1.0 / np.asarray(reference))[..., np.newaxis]
        variance = self.variance * share + self.floor
        terms = np.zeros(3) if terms is None else terms
        guard = np.zeros(terms.shape[:-1])
        if self.law is not None:
            variance = variance + self.law.variance_um2(terms)
        else:
            guard += (self.amplitude_um * self.speed_slope * terms[..., 0]) ** 2
            guard += (self.late_um * terms[..., 1]) ** 2
        guard = guard + (self.amplitude_um * self.turn_rad * np.asarray(apart)) ** 2
        variance[..., 1] += guard
        variance[..., 2] += guard
        variance[..., 0] += self.drift
        return np.asarray(variance)


@dataclass(frozen=True, slots=True)
class DepartureEvidence:
    """What the departure test states after a revolution.

    Attributes:
        nats: T, the largest over the windows.
        energy_nats: the same of the non-harmonic energy.
        window: revolutions in the window that shows it.
        departed: whether either is past its threshold.
    """

    nats: float
    energy_nats: float
    window: int
    departed: bool


@dataclass(frozen=True, slots=True)
class Reference:
    """Revolutions that others are compared with.

    Attributes:
        vector: complex128 ``[5]``, their mean synchronous vector, um.
        terms: float64 ``[3]``, mean of their `speed_terms`.
        revolutions: how many they are.
    """

    vector: Complexes
    terms: Floats
    revolutions: int


class DepartureTest:
    """Compares each revolution with all before.

    Args:
        spread: scatter of the vectors.
        threshold_nats: T that is a departure.
        energy_threshold_nats: that of the non-harmonic energy.
        least_reference: revolutions before the first test.
    """

    def __init__(
        self, spread: Spread, *, threshold_nats: float, energy_threshold_nats: float, least_reference: int
    ) -> None:
        self.spread = spread
        self.threshold_nats = threshold_nats
        self.energy_threshold_nats = energy_threshold_nats
        self._least = least_reference
        # Sums up to each of the last revolutions: Z_k, noise, terms of the speed.
        self._sums: NDArray[np.complex128] = np.zeros((_LONGEST + 1, 9), dtype=np.complex128)
        self._frozen: NDArray[np.complex128] | None = None
        self.count = 0

    def add(self, vector: Complexes, noise: float, terms: Floats) -> DepartureEvidence:
        """Take in a revolution.

        Args:
            vector: complex128 ``[5]``, its synchronous vector in um, 1X compensated for its speed.
            noise: its residual variance.
            terms: float64 ``[3]``, its `speed_terms`.
        """
        row = np.concatenate((vector, (noise,), terms))
        self.count += 1
        last = self.count % (_LONGEST + 1)
        self._sums[last] = self._sums[(self.count - 1) % (_LONGEST + 1)] + row
        if self.count == _MOST_REFERENCE:
            self._frozen = self._sums[last].copy()
        windows = WINDOWS[self.count - self._least >= WINDOWS]
        if not len(windows):
            return DepartureEvidence(0.0, 0.0, 0, departed=False)
        before = self._sums[(self.count - windows) % (_LONGEST + 1)]
        recent = (self._sums[last] - before) / windows[:, np.newaxis]
        length = (self.count - windows).astype(np.float64)
        if self._frozen is not None:
            late = length > _MOST_REFERENCE
            before = np.where(late[:, np.newaxis], self._frozen, before)
            length = np.minimum(length, _MOST_REFERENCE)
        reference = before / length[:, np.newaxis]
        return self._judge(windows, recent, length, reference)

    def look_at(self, vector: Complexes, terms: Floats, turned_um: float) -> DepartureEvidence:
        """Compare one revolution with all before, without taking it in: its angle is less exact than theirs.

        Args:
            vector: complex128 ``[5]``, its synchronous vector in um, 1X compensated for its speed.
            terms: float64 ``[3]``, its `speed_terms`.
            turned_um: standard deviation of what its angle leaves uncertain, in um.
        """
        before = self.reference_before(0)
        variance = self.spread.of_means(1.0, float(before.revolutions), terms - before.terms)
        nats = float((np.abs(vector - before.vector) ** 2 / (variance + turned_um**2)).sum())
        return DepartureEvidence(nats, 0.0, 1, departed=nats > self.threshold_nats)

    def _judge(
        self, windows: NDArray[np.int64], recent: Complexes, length: Floats, reference: Complexes
    ) -> DepartureEvidence:
        change = recent[:, :5] - reference[:, :5]
        terms = (recent[:, 6:] - reference[:, 6:]).real
        apart = self.count - (windows + length) / 2.0
        variance = self.spread.of_means(windows.astype(np.float64), length, terms, apart)
        nats = (np.abs(change) ** 2 / variance).sum(axis=1)
        noise = np.maximum(reference[:, 5].real, 1e-300)
        louder = np.maximum(recent[:, 5].real / noise - 1.0, 0.0)
        energy = louder**2 / (2.0 * self.spread.noise_variance * (1.0 / windows + 1.0 / length))
        best, loudest = int(nats.argmax()), int(energy.argmax())
        by_vector = bool(nats[best] > self.threshold_nats)
        by_energy = bool(energy[loudest] > self.energy_threshold_nats)
        window = windows[best] if by_vector or not by_energy else windows[loudest]
        return DepartureEvidence(
            float(nats[best]), float(energy[loudest]), int(window), departed=by_vector or by_energy
        )

    def reference_before(self, window: int) -> Reference:
        """What all revolutions before the last ``window`` ones have in common."""
        before = self._sums[(self.count - window) % (_LONGEST + 1)]
        length = self.count - window
        if self._frozen is not None and length > _MOST_REFERENCE:
            before, length = self._frozen, _MOST_REFERENCE
        mean = before / length
        return Reference(mean[:5], mean[6:].real, length)


VECTOR_NATS = 30.0
"""Gamma(5, 1) passes this once in 300 million stretches; a calibration has some thousands."""
NONSTATIONARITY_NATS = 25.0
_LENGTHS = np.unique(np.round(np.geomspace(1, 1000, 25)).astype(np.int64))
_STARTS = 400
_SHORTEST_NONSTATIONARITY = 4
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

    The residual within the revolution, and the bend of the vector over three revolutions. A whirl at half
    the speed leaves little in the residual, as five harmonics fit half a cycle well, but is different
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
    vectors: Complexes,
    white: float,
    memory: float,
    floor: float,
    guard: Complexes | Floats,
    jitter_rad: float = 0.0,
) -> Stretch:
    """The stretch whose mean vector differs most from that of the others.

    Args:
        vectors: complex128 ``[R, 5]``, brought to one speed.
        white: variance of a vector's component that white noise makes.
        memory: correlation of the stirred orbit from one revolution to the next.
        floor: um^2 that no difference counts below.
        guard: ``[R, G]``, um of 1X that each revolution's speed leaves uncertain, for each reason.
        jitter_rad: standard deviation of where a revolution begins.
    """
    neighbours = np.median(np.abs(np.diff(vectors, axis=0)) ** 2, axis=0) / (2.0 * _MEDIAN)
    stirred = np.maximum(neighbours - white, 0.0) / (1.0 - memory)
    variance = white + stirred * (1.0 + memory) / (1.0 - memory)
    variance = variance + (jitter_rad * np.abs(np.array(HARMONICS) * np.median(np.abs(vectors), axis=0))) ** 2
    columns = np.column_stack((vectors, guard))
    best = Stretch(0, 0, 0.0, "", 0.0)
    for length, starts, inside, outside, share in _stretches(columns):
        change = inside[:, :5] - outside[:, :5]
        allowed = np.tile(variance * share + floor, (len(starts), 1))
        allowed[:, 1:3] += (np.abs(inside[:, 5:] - outside[:, 5:]) ** 2).sum(axis=1, keepdims=True)
        terms = np.abs(change) ** 2 / allowed
        nats = terms.sum(axis=1)
        at = int(nats.argmax())
        if nats[at] > best.nats:
            worst = int(terms[at].argmax())
            begin = int(starts[at])
            by = float(abs(change[at, worst]))
            best = Stretch(begin, begin + length, float(nats[at]), _NAMES[worst], by)
    return best


def least_stationary_stretch(values: Floats, samples: float) -> Stretch:
    """The stretch whose nonstationarity differs most from that of the others.

    Args:
        values: float64 ``[R]``, nonstationarity of every revolution.
        samples: samples in a revolution; white noise scatters the less the more there are.
    """
    typical = float(np.median(values))
    scatter = float(np.median(np.abs(np.diff(values)))) / (0.6745 * math.sqrt(2.0))
    scatter = max(scatter, typical / math.sqrt(max(samples - 5.0, 1.0)), 1e-300)
    best = Stretch(0, 0, 0.0, "", 0.0)
    for length, starts, inside, outside, share in _stretches(values[:, np.newaxis]):
        if length < _SHORTEST_NONSTATIONARITY:
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
    stretches = []
    for length in _LENGTHS[count // 2 >= _LENGTHS].tolist():
        stride = max(1, (count - length) // _STARTS)
        starts = np.unique(np.append(np.arange(0, count - length + 1, stride), count - length))
        total = sums[starts + length] - sums[starts]
        inside, outside = total / length, (sums[-1] - total) / (count - length)
        stretches.append((length, starts, inside, outside, 1.0 / length + 1.0 / (count - length)))
    return stretches
