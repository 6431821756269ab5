"""The contract between the pipeline and a detector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.acquisition.samples import Samples
    from daqsvc.diagnosis.record import Diagnosis


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
        snapshot: whether the samples are one block that was taken by itself. Between it and the window before
            nobody sampled: nothing is missing there, nothing goes on from there, and its length is its own.
    """

    first_index: int
    samples: Samples
    t_end_ns: int
    period_ns: float
    skipped: int = 0
    snapshot: bool = False


class Detector(Protocol):
    """Turns windows of one stream into diagnoses.

    The pipeline calls `warm` once and then `process` window after window, in order, from one
    worker thread at a time; the numerical work inside must release the GIL (a numba kernel with
    ``nogil=True`` or NumPy on whole arrays), so that the event loop keeps running beside it.
    """

    name: str
    stream: str
    block: int
    """Samples per step: windows have a multiple of this many samples, but for snapshots."""

    def warm(self) -> None:
        """Compile and run every kernel once, so that the first window is as fast as the rest."""
        ...

    def process(self, window: Window) -> Sequence[Diagnosis]:
        """Take in a window and say what is worth saying (often nothing).

        Must not raise on bad data (NaN, infinities, dead or clipped sensors): it says so in a
        `Diagnosis` whose ``quality`` is not good, and holds its decision.
        """
        ...

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        """What to say when the stream has been silent: decisions held, quality ``"missing"``.

        Called on the event loop, once per silence; changes nothing.

        Args:
            silence_s: how long nothing has come.
            t_ns: monotonic time now.
        """
        ...
