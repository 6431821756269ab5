"""What is kept of a sensor while somebody looks, longer than its waveform: 1X, and spectra.

Both are made of what the rings hold, each sample once, and kept until the page has not been viewed for a
while.
"""

from __future__ import annotations

import math
from collections import deque
from threading import Lock
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.page.lines import largest, one_sided

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from daqsvc.acquisition.ring import SampleRing
    from daqsvc.dsp.speed.keyphasor import EdgeFinder

    Floats = NDArray[np.float64]

MOST_VECTORS = 20_000
"""Of one sensor that are kept."""
MOST_SPECTRA = 120
MOST_LINES = 400
"""Of a kept spectrum; of more the largest of each group."""
BLOCK = 4
"""Revolutions of each vector: where a mark lies is known by a sample, and the speed by the more of them."""
LEAST_SAMPLES = 8
"""In a revolution for its 1X."""
LEAST_THERE = 0.75
"""Of the samples of a revolution or a spectrum; with fewer it is left out."""
MOST_CHANGE = 1.5
"""By which a revolution is longer than the one before, at most: else a mark is missing between them."""
SLOWEST_S = 10.0
"""The longest revolution that is waited for."""


class Vectors(NamedTuple):
    """1X of a sensor, every few revolutions.

    Attributes:
        t_ns: ``[n]``, when their last sample was taken.
        speed_rpm: ``[n]``.
        vectors: complex ``[n]``, peak amplitudes; minus their angle is the lag of the peak behind the mark.
    """

    t_ns: NDArray[np.int64]
    speed_rpm: Floats
    vectors: NDArray[np.complex128]


class SpectrumThen(NamedTuple):
    """A spectrum of some time ago.

    Attributes:
        t_ns: when its last sample was taken.
        speed_rpm: the speed then.
        frequency_hz: ``[m]``.
        peak: ``[m]``, amplitudes.
    """

    t_ns: int
    speed_rpm: float
    frequency_hz: Floats
    peak: Floats


class Column(NamedTuple):
    """Where a sensor is sampled.

    Attributes:
        ring: what its stream holds.
        column: its place there.
        rate_hz: samples per second.
    """

    ring: SampleRing
    column: int
    rate_hz: float


class Runs:
    """What is kept of the sensors of one machine; for any thread."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._tracks: dict[str, _Track] = {}
        self._cascades: dict[tuple[str, float], _Cascade] = {}

    def vectors(self, sensor: str, column: Column | None, key_column: int, finder: EdgeFinder) -> Vectors:
        """1X of a sensor up to now.

        Args:
            sensor: its name.
            column: where it is sampled; None for nowhere by now.
            key_column: where the keyphasor is sampled in the same stream.
            finder: finds the keyphasor's marks.
        """
        with self._lock:
            track = self._tracks.setdefault(sensor, _Track())
            if column is not None:
                track.take_on(column, key_column, finder)
            return track.vectors()

    def spectra(
        self, sensor: str, column: Column | None, window_s: float, speed_rpm: float
    ) -> list[SpectrumThen]:
        """Spectra of a sensor over windows that follow each other, up to now; the oldest first.

        Args:
            sensor: its name.
            column: where it is sampled; None for nowhere by now.
            window_s: how long each window is.
            speed_rpm: the speed now.
        """
        with self._lock:
            cascade = self._cascades.setdefault((sensor, window_s), _Cascade())
            if column is not None:
                cascade.take_on(column, window_s, speed_rpm)
            return [*cascade.kept]


class _Track:
    def __init__(self) -> None:
        self._from_index: int | None = None
        self._usual: float | None = None
        self._kept: deque[tuple[int, float, complex]] = deque(maxlen=MOST_VECTORS)

    def vectors(self) -> Vectors:
        kept = [*self._kept]
        return Vectors(
            np.array([one[0] for one in kept], dtype=np.int64),
            np.array([one[1] for one in kept]),
            np.array([one[2] for one in kept], dtype=np.complex128),
        )

    def take_on(self, sampled: Column, key_column: int, finder: EdgeFinder) -> None:
        ring = sampled.ring
        first = max(self._from_index or 0, ring.oldest_index)
        rows = ring.read(first, ring.end_index - first).astype(np.float64)
        marks = np.array([index + fraction for index, fraction in finder.find(rows[:, key_column])])
        self._take(rows[:, sampled.column], marks, sampled, first)

    def _take(self, values: Floats, marks: Floats, sampled: Column, first: int) -> None:
        lengths = np.diff(marks)
        before = np.concatenate([[self._usual or np.inf], lengths[:-1]]) if len(lengths) else lengths
        is_whole = lengths <= MOST_CHANGE * before
        at = 0
        while at + BLOCK <= len(lengths):
            if not is_whole[at : at + BLOCK].all():
                at += int(np.flatnonzero(~is_whole[at : at + BLOCK])[-1]) + 1
                continue
            self._fit(values, marks[at : at + BLOCK + 1], sampled, first)
            at += BLOCK
        if at:
            self._usual = float(lengths[at - 1])
        if len(marks):
            # That mark is the first one of the next time; before it the voltage has to have gone back.
            behind = round(0.5 * (self._usual or 0.0))
            self._from_index = max(first + int(marks[at]) - behind, first)
        elif len(values) > SLOWEST_S * sampled.rate_hz:
            self._from_index = first + len(values) - round(SLOWEST_S * sampled.rate_hz)

    def _fit(self, values: Floats, marks: Floats, sampled: Column, first: int) -> None:
        """1X over some revolutions, by least squares."""
        here = np.arange(math.ceil(marks[0]), math.ceil(marks[-1]))
        there = here[np.isfinite(values[here])]
        if len(there) < max(LEAST_SAMPLES * BLOCK, LEAST_THERE * len(here)):
            return
        wave = np.exp(2j * np.pi * np.interp(there, marks, np.arange(len(marks))))
        design = np.column_stack([np.ones(len(there)), wave.real, -wave.imag])
        (_, real, imaginary), *_ = np.linalg.lstsq(design, values[there], rcond=None)
        t_ns = sampled.ring.time_of(first + int(there[-1]))
        speed_rpm = 60.0 * sampled.rate_hz * BLOCK / (marks[-1] - marks[0])
        self._kept.append((t_ns, float(speed_rpm), complex(real, imaginary)))


class _Cascade:
    def __init__(self) -> None:
        self.kept: deque[SpectrumThen] = deque(maxlen=MOST_SPECTRA)
        self._next_index: int | None = None

    def take_on(self, sampled: Column, window_s: float, speed_rpm: float) -> None:
        ring, rate_hz = sampled.ring, sampled.rate_hz
        size = max(round(window_s * rate_hz), 2)
        first = self._next_index
        if first is None or first < ring.oldest_index:
            first = -(-ring.oldest_index // size) * size
        while first + size <= ring.end_index:
            values = ring.read(first, size)[:, sampled.column].astype(np.float64)
            if np.isfinite(values).sum() >= LEAST_THERE * size:
                lines = largest(*one_sided(values, rate_hz), MOST_LINES)
                self.kept.append(SpectrumThen(ring.time_of(first + size - 1), speed_rpm, *lines))
            first += size
        self._next_index = first
