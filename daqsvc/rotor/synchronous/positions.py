"""The shaft's positions in the last revolutions, at even times: what a spectrum over many of them needs."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.rotor.synchronous.vectors import HARMONICS

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    Complexes = NDArray[np.complex128]
    Floats = NDArray[np.float64]

REVOLUTIONS = 512
"""Revolutions that are kept: a line 1 % beside a harmonic is five bins away from it then."""
_POINTS_PER_REV = 32
_MOST_MISSING = 0.3
_LONG_GAP = 0.5
"""Revolutions that may be lost without being counted."""
_HIGHEST = 6
"""Harmonics that are fitted."""
_RIDGE = 1e-9
"""Keeps a fit from failing where two columns are alike."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Positions of the shaft over some revolutions, at even times.

    Attributes:
        z: complex128 ``[n]``, um; 0 where missing.
        turns: float64 ``[n]``, shaft angle in revolutions.
        there: bool ``[n]``.
        rate_hz: of the positions.
        averaged: samples in each.
        first: number of the first position, on the grid that begins with sample 0.
    """

    z: Complexes
    turns: Floats
    there: NDArray[np.bool_]
    rate_hz: float
    averaged: int
    first: int

    @property
    def revolutions(self) -> float:
        """How far the shaft turned."""
        known = self.turns[self.there]
        return float(known[-1] - known[0]) if len(known) else 0.0

    def last(self, revolutions: float) -> Stretch:
        """Its last revolutions alone."""
        known = self.turns[self.there]
        begin = int(np.flatnonzero(self.there & (self.turns >= known[-1] - revolutions))[0])
        return replace(
            self,
            z=self.z[begin:],
            turns=self.turns[begin:],
            there=self.there[begin:],
            first=self.first + begin,
        )

    @property
    def orders(self) -> list[int]:
        """Harmonics of the shaft that its positions show: `HARMONICS`, then all others."""
        points_per_rev = len(self.z) / max(self.revolutions, 1.0)
        # With fewer points two of them are one.
        highest = max(2, min(_HIGHEST, math.ceil(points_per_rev / 2.0) - 1))
        return [*HARMONICS, *(k for k in range(-highest, highest + 1) if k not in HARMONICS)]

    @property
    def harmonics(self) -> Complexes:
        """Motions at `orders`, complex128 ``[n, H]``."""
        return turning(self.turns, self.orders)

    def off(self, baseline: Complexes) -> Stretch:
        """Its positions off an orbit, complex128 ``[5]``, the amplitudes of `HARMONICS` in um."""
        orbit = turning(self.turns, HARMONICS) @ baseline
        return replace(self, z=np.where(self.there, self.z - orbit, 0.0))

    def fit(self, *columns: Complexes) -> Complexes:
        """Least-squares amplitudes of motions that are nearly orthogonal.

        Args:
            columns: complex128 ``[n, ...]`` each, motions of amplitude 1.

        Returns:
            complex128, of all columns.
        """
        basis = np.column_stack(columns) * self.there[:, np.newaxis]
        normal = basis.conj().T @ basis
        normal += _RIDGE * len(basis) * np.eye(len(normal))
        return np.asarray(np.linalg.solve(normal, basis.conj().T @ self.z))


def turning(turns: Floats, orders: Iterable[int]) -> Complexes:
    """Motions of amplitude 1 at harmonics of the shaft, complex128 ``[n, H]``.

    Args:
        turns: float64 ``[n]``, shaft angle in revolutions.
        orders: ``[H]``, negative ones against the shaft.
    """
    once = np.exp(2j * math.pi * turns)
    return np.stack([once**k for k in orders], axis=1)


@dataclass(frozen=True, slots=True)
class _Kept:
    """Positions of one revolution: ``z`` is NaN where missing."""

    revolution: int
    first: int
    z: NDArray[np.complex64]
    turns: Floats


class LastPositions:
    """The shaft's positions in the last revolutions, some 32 in each.

    Args:
        rate_hz: sampling rate.
    """

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._averaged = 0
        self._kept: deque[_Kept] = deque(maxlen=REVOLUTIONS)
        self._next = -1
        self._rest_z: Complexes = np.empty(0, dtype=np.complex128)
        self._rest_turns: Floats = np.empty(0)

    @property
    def end(self) -> int:
        """Number of the revolution after the last one that is kept."""
        return self._kept[-1].revolution + 1 if self._kept else 0

    def forget(self) -> None:
        """Keep nothing of what was."""
        self._kept.clear()
        self._rest_z, self._rest_turns = self._rest_z[:0], self._rest_turns[:0]

    def add(self, revolution: int, first_index: int, turns: Floats, z: Complexes) -> None:
        """Keep a revolution.

        Args:
            revolution: its number.
            first_index: of its first sample.
            turns: float64 ``[n]``, shaft angle in revolutions from its beginning.
            z: complex128 ``[n]``, um; NaN where missing.
        """
        if not self._averaged:
            self._averaged = max(1, len(z) // _POINTS_PER_REV)
        if first_index < self._next:
            self._kept.clear()  # the stream has begun again
        if first_index != self._next:
            self._rest_z, self._rest_turns = self._rest_z[:0], self._rest_turns[:0]
        self._next = first_index + len(z)
        first = first_index - len(self._rest_z)
        z = np.concatenate((self._rest_z, z))
        turns = np.concatenate((self._rest_turns, revolution + turns))
        # Positions lie on one grid, over gaps as well.
        skip = -first % self._averaged
        whole = max(0, len(z) - skip) // self._averaged * self._averaged
        self._rest_z, self._rest_turns = z[skip + whole :], turns[skip + whole :]
        if not whole:
            return
        blocks = z[skip : skip + whole].reshape(-1, self._averaged)
        known = np.isfinite(blocks)
        count = known.sum(axis=1)
        sums = np.where(known, blocks, 0.0).sum(axis=1)
        means = np.where(2 * count >= self._averaged, sums / np.maximum(count, 1), np.nan)
        at = turns[skip : skip + whole].reshape(-1, self._averaged).mean(axis=1)
        first = (first + skip) // self._averaged
        self._kept.append(_Kept(revolution, first, means.astype(np.complex64), at))

    def stretch(self, begin: int, end: int) -> Stretch | None:
        """The revolutions from one up to before another, after a long gap; None if too much is missing."""
        kept = _after_gaps([one for one in self._kept if begin <= one.revolution < end])
        if not kept:
            return None
        first = kept[0].first
        z = np.full(kept[-1].first + len(kept[-1].z) - first, np.nan, dtype=np.complex128)
        turns = np.zeros(len(z))
        for one in kept:
            part = slice(one.first - first, one.first - first + len(one.z))
            z[part], turns[part] = one.z, one.turns
        there = np.isfinite(z)
        if there.mean() < 1.0 - _MOST_MISSING:
            return None
        z[~there] = 0.0
        return Stretch(z, turns, there, self._rate_hz / self._averaged, self._averaged, first)


def _after_gaps(kept: list[_Kept]) -> list[_Kept]:
    """The last of them that have no gap of a revolution between them: how far the shaft turned is known."""
    for i in range(len(kept) - 1, 0, -1):
        ends = kept[i - 1].first + len(kept[i - 1].z)
        if kept[i].first - ends > _LONG_GAP * len(kept[i].z):
            return kept[i:]
    return kept
