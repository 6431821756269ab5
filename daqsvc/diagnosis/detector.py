"""The contract between the pipeline and a detector."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from daqsvc.acquisition.samples import Window

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.diagnosis.record import Diagnosis


__all__ = ["Detector", "Window"]


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
        """Take in a window and state what is worth a statement (often nothing).

        Must not raise on bad data (NaN, infinities, dead or clipped sensors): it states it in a
        `Diagnosis` whose ``quality`` is not good, and holds its decision.
        """
        ...

    def silent(self, silence_s: float, t_ns: int) -> Sequence[Diagnosis]:
        """The statements when the stream has been silent: decisions held, quality ``"missing"``.

        Called on the event loop, once per silence; changes nothing.

        Args:
            silence_s: how long nothing has come.
            t_ns: monotonic time now.
        """
        ...
