"""Whether a record was stored at a multiple of the rate that it was sampled with, each sample held or joined.

Where each sample is repeated, the record moves at every n-th sample only. Where straight lines join the
samples, its slope changes there only. No machine keeps to such a grid. Smooth upsampling shows by the band
that stays empty instead (`occupied`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
import scipy.signal

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from daqsvc.dsp.quality.outliers import Stretch

    Real = NDArray[np.float64]

_Kind = TypeVar("_Kind", bound=np.generic)

SHARE_OF_RATE = 0.48
"""Up to this share of its rate a record can be analysed: filters against aliasing end below half."""
_MOST = 1 << 17
"""Samples that are examined."""
_FACTORS = range(2, 33)
_LEAST_SAMPLES = 64
"""Samples that the record was made of, at least: fewer may keep to a grid by chance."""
_LARGE = 0.98
_SMALL = 0.1
"""A change of the slope that is a smaller share of the largest (those beyond a quantile) is rounding."""
_LEAST_ON = 0.25
"""Share of the grid's places at which a record moves, at least: a coarse converter rests at the others."""
_MOST_OFF = 0.01
"""Moves beside the grid over those on it, at most: a wrong sample, or one that was lost, makes some."""


class Upsampling(NamedTuple):
    """How a record was upsampled.

    Attributes:
        factor: samples of the record for each that was measured.
        first: the first sample that was measured.
        held: whether each was repeated; joined by straight lines otherwise.
    """

    factor: int
    first: int
    held: bool

    def measured(self, samples: NDArray[_Kind]) -> NDArray[_Kind]:
        """Those samples that were measured, of ``[n]``."""
        return samples[self.first :: self.factor]

    def joined(self, measured: Real, length: int) -> Real:
        """What was measured, smoothly upsampled instead, ``[length]``."""
        smooth = scipy.signal.resample_poly(measured, self.factor, 1, padtype="line")
        before = np.full(self.first, smooth[0])
        return np.concatenate((before, smooth))[:length]

    def spread(self, stretches: Iterable[Stretch], length: int) -> tuple[Stretch, ...]:
        """Stretches of measured samples as those of the record of some length that was made of them."""
        places = ((self.first + self.factor * at for at in stretch) for stretch in stretches)
        return tuple((min(first, length), min(last, length)) for first, last in places)

    def describe(self, rate_hz: float) -> str:
        """What was done to a record, in words.

        Args:
            rate_hz: the rate at which the record is stored.
        """
        how = (
            f"each sample {self.factor} times"
            if self.held
            else f"{self.factor} samples on each straight line"
        )
        return f"sampled at {rate_hz / self.factor:g} Hz and upsampled ({how})"


def upsampling(samples: Real) -> Upsampling | None:
    """How a record was upsampled; None if it was not, or otherwise.

    Args:
        samples: ``[n]``, finite.
    """
    slope = np.diff(samples[:_MOST])
    if len(slope) < 2 * _LEAST_SAMPLES:
        return None
    bend = np.abs(np.diff(slope))
    return _grid(slope != 0.0, held=True) or _grid(
        bend > _SMALL * float(np.quantile(bend, _LARGE)), held=False
    )


def _grid(moves: NDArray[np.bool_], *, held: bool) -> Upsampling | None:
    """The widest grid that nearly all moves keep to."""
    if moves.mean() > 0.5 * (1.0 + _MOST_OFF):
        return None
    found = None
    for factor in _FACTORS:
        rows = len(moves) // factor
        if rows < _LEAST_SAMPLES:
            break
        counts = np.count_nonzero(moves[: rows * factor].reshape(rows, factor), axis=0)
        on = int(counts.argmax())
        if counts[on] >= _LEAST_ON * rows and counts.sum() - counts[on] <= _MOST_OFF * counts[on]:
            found = Upsampling(factor, (on + 1) % factor, held)
    return found


def even_pace(moves: NDArray[np.bool_]) -> float | None:
    """Samples from one move to the next, where these are as even as they can be; None otherwise.

    A record that was upsampled by 2.5, each sample held, moves after two or three samples. A dead sensor, or
    a coarse converter, rests for any number of them.

    Args:
        moves: whether a record moves, ``[n]``.
    """
    gaps = np.diff(np.flatnonzero(moves))
    if len(gaps) < _LEAST_SAMPLES:
        return None
    lengths = np.bincount(gaps)
    usual = int(np.median(gaps))
    near = [int(lengths[at : at + 2].sum()) for at in (usual - 1, usual)]
    if max(near) < (1.0 - _MOST_OFF) * len(gaps):
        return None
    first = usual - 1 + int(near[1] >= near[0])
    pace = float(np.mean(gaps[(gaps >= first) & (gaps <= first + 1)]))
    # A channel that moves evenly and then rests has a pace, but keeps it for a part of the time only.
    return pace if abs(pace * float(moves.mean()) - 1.0) <= _MOST_OFF else None
