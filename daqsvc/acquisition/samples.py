"""What flows from a driver into the ring, and from there to detectors: samples that know place, time, loss.

Most streams go on from block to block: what lies between two of them is lost. A device that takes a waveform
now and then sends snapshots: each is complete by itself, and between them nothing is missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntFlag
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Samples: TypeAlias = NDArray[np.float32]

INT64_MIN = -(2**63)
INT64_MAX = 2**63 - 1


class Quality(IntFlag):
    """What is known against a block; 0 means nothing."""

    GOOD = 0
    TIME_UNSETTLED = 1
    """The time base has not seen enough arrivals yet: times may move by up to the arrival jitter."""
    AFTER_LOSS = 2
    """Samples just before this block are missing (`SampleBlock.lost_before`)."""
    LOSS_ESTIMATED = 4
    """The number of missing samples comes from the host clock: the device has no counter, or restarted it."""
    PLACE_ESTIMATED = 8
    """How far this block lies behind the one before is a guess, which may be off by many samples. The device
    has begun to count again, or sends no count and was away for long. What goes by phase begins again."""


@dataclass(frozen=True, slots=True)
class SampleBlock:
    """A run of consecutive samples of one stream.

    Attributes:
        stream: name of the stream in the machine file.
        first_index: position of ``samples[0]`` on the device's own sample count, unwrapped to int64.
        samples: float32 ``[n, channels]`` in the sensors' physical units, C-contiguous.
        t_first_ns: host monotonic time at which ``samples[0]`` was taken, as the time base estimates it.
        period_ns: estimated time between samples.
        lost_before: samples known to be missing between the previous block and this one.
        quality: what is known against this block.
        pause_before: of a snapshot, how many samples long the time without samples was before it, by
            the clock, beside ``lost_before``. None if the stream goes on from block to block.
        t_error_ns: how far ``t_first_ns`` may be off (95th percentile), beside the constant part of the delay
            from the device to the host; infinite if it is not known.
    """

    stream: str
    first_index: int
    samples: Samples
    t_first_ns: int
    period_ns: float
    lost_before: int = 0
    quality: Quality = Quality.GOOD
    t_error_ns: float = math.inf
    pause_before: int | None = None

    def __post_init__(self) -> None:
        if self.samples.ndim != 2 or self.samples.dtype != np.float32:
            raise ValueError(
                f"samples of {self.stream!r} must be float32 [n, channels], "
                f"not {self.samples.dtype} {list(self.samples.shape)}"
            )
        if not INT64_MIN <= self.first_index <= INT64_MAX - len(self.samples):
            raise OverflowError(
                f"sample index {self.first_index} + {len(self.samples)} of {self.stream!r} leaves int64"
            )
        if self.lost_before < 0:
            raise ValueError(f"lost_before of {self.stream!r} is {self.lost_before}; it cannot be negative")
        if self.pause_before is not None and self.pause_before < 0:
            raise ValueError(f"pause_before of {self.stream!r} is {self.pause_before}; it cannot be negative")

    @property
    def gap(self) -> int:
        """Rows between the previous block and this one that hold nothing: lost, or never taken."""
        return self.lost_before + (self.pause_before or 0)

    @property
    def end_index(self) -> int:
        """One past the index of the last sample."""
        return self.first_index + len(self.samples)


@dataclass(frozen=True, slots=True)
class Window:
    """Consecutive samples handed to a detector.

    Attributes:
        first_index: absolute index of ``samples[0]``.
        samples: float32 ``[n, channels]``, a private copy; missing samples are NaN rows.
        t_end_ns: monotonic time of the last sample.
        period_ns: time between samples.
        skipped: samples between the previous window and this one that the detector was too slow
            for (they were overwritten), or that were withheld from it; 0 in normal operation.
        snapshot: whether the samples are one block that was taken by itself. Between it and the window
            before, nothing was sampled: nothing is missing there, nothing goes on, and the time may be of
            any length.
        breaks: absolute indices, rising, of samples whose distance to the one before is a guess
            (`Quality.PLACE_ESTIMATED`). One among samples that were skipped is at the first sample.
    """

    first_index: int
    samples: Samples
    t_end_ns: int
    period_ns: float
    skipped: int = 0
    snapshot: bool = False
    breaks: tuple[int, ...] = ()

    def parts(self) -> list[Window]:
        """The window cut at its breaks: only the first sample of a part can be one."""
        if not self.breaks:
            return [self]
        end = self.first_index + len(self.samples)
        cuts = sorted({self.first_index, *self.breaks, end})
        return [
            replace(
                self,
                first_index=begin,
                samples=self.samples[begin - self.first_index : until - self.first_index],
                t_end_ns=self.t_end_ns - round((end - until) * self.period_ns),
                skipped=self.skipped if begin == self.first_index else 0,
                breaks=(begin,) if begin in self.breaks else (),
            )
            for begin, until in pairwise(cuts)
        ]
