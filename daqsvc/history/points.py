"""Points of a trend, and how spans of them lie on the disk.

A chunk is a span of points without gaps in its grid: where nothing was measured stands NaN. Values are
rounded to `MANTISSA_BITS`, a relative error of at most 1 in 32,768, which halves what zlib leaves of noise.
The number of statements follows the values: so means of several points are those of all
statements. Versions that knew no such number wrote chunks without, and read over it.
"""

from __future__ import annotations

import math
import zlib
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

MANTISSA_BITS = 14
MOST = 1e30
"""Larger values are no measurement, and would round to what float32 does not have."""
MOST_COUNTED = 1e9
"""More statements in a step are no number that was written."""
FORM = b"\x01"
"""First byte of a chunk: how the rest is laid out."""

_DROPPED_BITS = 23 - MANTISSA_BITS

RECORD = np.dtype([("t_s", "<i8"), ("n", "<u4"), ("low", "<f4"), ("mean", "<f4"), ("high", "<f4")])
"""A second of a series: how many statements it had, and the least, mean and greatest value."""


class Step(IntEnum):
    """Time from point to point, s."""

    SECOND = 1
    MINUTE = 60
    HOUR = 3600

    @property
    def span_s(self) -> int:
        """How much time a chunk holds."""
        return SPANS_S[self]

    @property
    def names(self) -> tuple[str, ...]:
        """What a point has on the disk, fields of `RECORD`, the number last: of a second no extremes."""
        return ("mean", "n") if self is Step.SECOND else ("low", "mean", "high", "n")

    @property
    def rows(self) -> int:
        """How many figures a point has on the disk."""
        return len(self.names)


HOUR_S, DAY_S = 3600, 86_400
SPANS_S = {Step.SECOND: HOUR_S, Step.MINUTE: DAY_S, Step.HOUR: 30 * DAY_S}


class DamagedChunkError(Exception):
    """A chunk is not what was written."""


class TrendPoints(NamedTuple):
    """A figure over time; only where it was measured there is a point.

    Attributes:
        t_s: int64 ``[n]``, s since the Unix epoch, begin of each step.
        low: float32 ``[n]``, least value within the step.
        mean: float32 ``[n]``.
        high: float32 ``[n]``, greatest value within the step.
        n: int64 ``[n]``, statements within the step, at least 1: what its mean weighs among others.
    """

    t_s: NDArray[np.int64]
    low: NDArray[np.float32]
    mean: NDArray[np.float32]
    high: NDArray[np.float32]
    n: NDArray[np.int64]


def pack(dense: NDArray[np.float32]) -> bytes:
    """A chunk from figures ``[rows, points]``, NaN where there is none."""
    return FORM + _packed(dense[:-1]) + _packed(dense[-1:])


def _packed(dense: NDArray[np.float32]) -> bytes:
    bits = np.ascontiguousarray(dense, dtype="<f4").view("<u4")
    # To nearest; NaN has its highest bit of the mantissa, which stays.
    half = np.uint32(1 << (_DROPPED_BITS - 1))
    rounded = np.where(np.isfinite(dense), bits + half, bits) & ~np.uint32((1 << _DROPPED_BITS) - 1)
    planes = rounded.astype("<u4").view(np.uint8).reshape(-1, 4).T
    return zlib.compress(planes.tobytes(), 6)


def unpack(chunk: bytes, step: Step) -> NDArray[np.float32]:
    """Figures ``[rows, points]`` of a chunk, NaN where there is none; a chunk of old has no numbers.

    Raises:
        DamagedChunkError: it is none, or none of that step.
    """
    if chunk[:1] != FORM:
        raise DamagedChunkError(f"a chunk begins with {chunk[:1]!r}")
    dense = empty(step)
    dense[:-1], rest = _unpacked(chunk[1:], dense[:-1].shape)
    if rest:
        dense[-1:], _ = _unpacked(rest, dense[-1:].shape)
    return dense


def _unpacked(data: bytes, shape: tuple[int, ...]) -> tuple[NDArray[np.float32], bytes]:
    """Values of a shape, and the bytes that are behind them.

    Raises:
        DamagedChunkError: there are none of that shape.
    """
    size = 4 * math.prod(shape)
    try:
        unzip = zlib.decompressobj()
        planes = unzip.decompress(data, size)
        if len(planes) != size or unzip.unconsumed_tail or not unzip.eof:
            raise DamagedChunkError(f"a chunk is not of {size} bytes")
    except zlib.error as error:
        raise DamagedChunkError(f"a chunk cannot be unpacked: {error}") from error
    values = np.frombuffer(planes, np.uint8).reshape(4, -1).T.copy().view("<f4")
    return values.reshape(shape).astype(np.float32), unzip.unused_data


def empty(step: Step) -> NDArray[np.float32]:
    """Figures ``[rows, points]`` of a chunk in which nothing was measured."""
    return np.full((step.rows, step.span_s // step), np.nan, np.float32)


def merge(dense: NDArray[np.float32], new: NDArray[np.float32]) -> NDArray[np.float32]:
    """Two chunks of the same span: where both have a point, which takes a clock that was set back.

    Least and greatest value are those of both; the mean, and the number that belongs to it, are the new ones.
    """
    merged: NDArray[np.float32] = np.where(np.isnan(_mean(new)), dense, new)
    if len(dense) > len(Step.SECOND.names):
        merged[0], merged[2] = np.fmin(dense[0], new[0]), np.fmax(dense[2], new[2])
    return merged


def _mean(dense: NDArray[np.float32]) -> NDArray[np.float32]:
    mean: NDArray[np.float32] = dense[(len(dense) - 1) // 2]
    return mean


def summed_up(records: NDArray[np.void], step: Step) -> NDArray[np.void]:
    """Records of seconds as records of a longer step; `RECORD`, in order of time."""
    at = records["t_s"] // step * step
    times, which = np.unique(at, return_inverse=True)
    found = np.zeros(len(times), RECORD)
    found["t_s"] = times
    np.add.at(found["n"], which, records["n"])
    total = np.zeros(len(times))
    np.add.at(total, which, records["mean"].astype(float) * records["n"])
    found["mean"] = total / found["n"]
    found["low"], found["high"] = np.inf, -np.inf
    np.minimum.at(found["low"], which, records["low"])
    np.maximum.at(found["high"], which, records["high"])
    return found


def spread(records: NDArray[np.void], step: Step, begin_s: int) -> NDArray[np.float32]:
    """Records of one span, in their places of it: figures ``[rows, points]``."""
    dense = empty(step)
    places = (records["t_s"] - begin_s) // step
    for row, name in zip(dense, step.names, strict=True):
        row[places] = records[name]
    return dense


def gathered(dense: NDArray[np.float32], step: Step, begin_s: int) -> NDArray[np.void]:
    """What `spread` has spread out; `n` is 0 where it is not known, see `weighed`."""
    places = np.flatnonzero(~np.isnan(_mean(dense)))
    found = np.zeros(len(places), RECORD)
    found["t_s"] = begin_s + places * int(step)
    counts = dense[-1, places]
    # NaN is between nothing.
    is_known = (counts >= 1.0) & (counts < MOST_COUNTED)
    found["n"] = np.where(is_known, counts, 0.0)
    found["low"], found["mean"], found["high"] = dense[0, places], _mean(dense)[places], dense[-2, places]
    return found


def weighed(packed: NDArray[np.void], recent: NDArray[np.void]) -> NDArray[np.void]:
    """Records of one step, packed and recent ones, each with a number of statements.

    A point of which it is not known, from a chunk of old, counts as much as a usual one of the others, and
    all count the same where none is known.
    """
    records = np.concatenate([packed, recent])
    is_unknown = records["n"] == 0
    known = records["n"][~is_unknown]
    records["n"][is_unknown] = np.median(known) if len(known) else 1
    return records
