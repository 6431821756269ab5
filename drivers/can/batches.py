"""Frames of a CAN bus as arrays: what every source of them yields, and how they are sorted to streams.

Ids are written as the Linux kernel writes them (``linux/can.h``): 11 or 29 bits of arbitration id under
three flags that state what kind of frame it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from drivers.can.errors import ErrorCounts
from drivers.can.settings import PRIORITY
from drivers.frames import DecodedBatch

if TYPE_CHECKING:
    import threading
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from drivers.base import StreamSpec
    from drivers.frames import FrameLayout

EXTENDED = 0x8000_0000
REMOTE = 0x4000_0000
ERROR = 0x2000_0000
EXTENDED_ID = 0x1FFF_FFFF
STANDARD_ID = 0x7FF
BIT_RATE_SWITCH = 0x01
ERROR_PASSIVE_SENDER = 0x02
FD = 0x04
"""Flags of CAN FD frames (``CANFD_BRS``, ``CANFD_ESI`` and ``CANFD_FDF``)."""

LONGEST = 64


class BusOffError(Exception):
    """The controller has taken itself off the bus; only opening it again helps."""


@dataclass(frozen=True, slots=True)
class CanBatch:
    """Frames in their order of arrival.

    Attributes:
        ids: uint32 ``[n]``, arbitration ids with `EXTENDED`, `REMOTE` and `ERROR`.
        lengths: int64 ``[n]``, payload lengths in bytes; of a remote frame the length that it asks for.
        data: uint8 ``[n, 64]``, payloads; bytes past a payload's length hold anything. It may be a view of
            memory that the next read overwrites, as may be ids.
        arrival_ns: int64 ``[n]``, host monotonic.
        overrun: frames that the kernel dropped since the last batch, because its buffer was full.
        malformed: what came since the last batch and was no frame at all.
        drained_ns: when the bus was last known to hold no frame that was sent before; None if there
            may be more.
        fd_flags: uint8 ``[n]``, of CAN FD frames `FD` with `BIT_RATE_SWITCH` and `ERROR_PASSIVE_SENDER`, of
            others 0; None if there are no CAN FD frames.
    """

    ids: NDArray[np.uint32]
    lengths: NDArray[np.int64]
    data: NDArray[np.uint8]
    arrival_ns: NDArray[np.int64]
    overrun: int = 0
    malformed: int = 0
    drained_ns: int | None = None
    fd_flags: NDArray[np.uint8] | None = None

    def kept(self) -> CanBatch:
        """The same frames in memory of their own, payloads cut to the longest: ``[n, width]``."""
        width = int(self.lengths.max(initial=0))
        return replace(self, ids=self.ids.copy(), data=self.data[:, :width].copy())


class CanSource(Protocol):
    """An open bus; `read` is called from one thread."""

    error_classes: int
    """Which classes of error frames this source reports as ``linux/can/error.h`` means them."""

    recovers: bool
    """Whether the open bus is usable again after bus-off without being opened again."""

    def read(self, timeout_s: float) -> CanBatch:
        """Take what is there; wait for the first frame if there is none.

        Raises:
            BusOffError: the controller went bus-off.
            Exception: whatever the adapter raises when it is lost.
        """
        ...

    def gather(self, stopping: threading.Event) -> None:
        """Let frames gather before the next read, so that one turn of the event loop serves many.

        Args:
            stopping: set when nothing more will be read; ends the wait.
        """
        ...

    def close(self) -> None:
        """Give the bus back."""
        ...


@dataclass(frozen=True, slots=True)
class IdMatch:
    """Which ids a stream's frames have: those that equal ``id`` wherever ``mask`` has a one.

    The ids are those of frames that are no error frames.
    """

    id: int
    mask: int

    @classmethod
    def of(cls, layout: FrameLayout) -> IdMatch:
        """The ids of a layout: one of 11 or 29 bits, of any priority if it has one, in frames with data."""
        # Not `ERROR`: in a filter of the kernel this bit asks for error frames.
        if layout.extended:
            id_mask = EXTENDED_ID & ~PRIORITY if layout.any_priority else EXTENDED_ID
            return cls(layout.frame_id | EXTENDED, id_mask | EXTENDED | REMOTE)
        return cls(layout.frame_id, STANDARD_ID | EXTENDED | REMOTE)

    def __contains__(self, frame_id: int) -> bool:
        return frame_id & self.mask == self.id & self.mask


class FrameDemultiplexer:
    """Sorts batches to streams and decodes them, each stream's frames at once.

    Args:
        specs: the streams on the bus; several may take the same id, as with the pages of a multiplexer.
    """

    def __init__(self, specs: Sequence[StreamSpec[FrameLayout]]) -> None:
        self._specs = list(specs)
        self._matches = [IdMatch.of(spec.layout) for spec in specs]

    @property
    def matches(self) -> Sequence[IdMatch]:
        """Ids that some stream has."""
        return self._matches

    def sort(self, batch: CanBatch, error_classes: int) -> DecodedBatch:
        """Sort and decode a batch; nothing in the result refers to the batch's memory.

        Args:
            batch: frames as they came.
            error_classes: see `CanSource`.
        """
        decoded = DecodedBatch(drained_ns=batch.drained_ns)
        decoded.note("frames_overrun", batch.overrun)
        decoded.note("frames_malformed", batch.malformed)
        chosen: dict[int, list[NDArray[np.intp]]] = {}
        for frame_id, rows in by_id(batch.ids):
            if frame_id & ERROR:
                decoded.note("frames_error", len(rows))
                counts = ErrorCounts.of(batch.ids[rows] & np.uint32(error_classes), batch.data[rows, :8])
                decoded.errors = counts if decoded.errors is None else decoded.errors.followed_by(counts)
                continue
            if frame_id & REMOTE:
                decoded.note("frames_remote", len(rows))
                continue
            decoded.data_frames += len(rows)
            takers = [k for k, match in enumerate(self._matches) if frame_id in match]
            if not takers:
                decoded.note("frames_unknown", len(rows))
                decoded.unknown[id_in_words(frame_id)] = len(rows)
            else:
                self._note_unread_pages(takers, frame_id, batch, rows, decoded)
            for k in takers:
                chosen.setdefault(k, []).append(rows)
        for k, groups in chosen.items():
            rows = groups[0] if len(groups) == 1 else np.sort(np.concatenate(groups))
            self._decode(self._specs[k], batch, rows, decoded)
        return decoded

    def _note_unread_pages(
        self,
        takers: Sequence[int],
        frame_id: int,
        batch: CanBatch,
        rows: NDArray[np.intp],
        decoded: DecodedBatch,
    ) -> None:
        """Note frames that no stream has, though they have the streams' id: pages of a multiplexer."""
        left = rows
        for k in takers:
            layout = self._specs[k].layout
            if not layout.selectors:
                return
            left = left[batch.lengths[left] == layout.length]
            left = left[~layout.selects(batch.data[left, : layout.length])]
        if not len(left):
            return
        decoded.note("frames_unknown", len(left))
        specs = [self._specs[k] for k in takers]
        layout, streams = max((s.layout for s in specs), key=_depth), [spec.name for spec in specs]
        for page, count in layout.pages(batch.data[left, : layout.length]).items():
            name = f"{id_in_words(frame_id)}, {page}"
            decoded.unknown[name], decoded.pages_of[name] = count, streams

    def _decode(
        self, spec: StreamSpec[FrameLayout], batch: CanBatch, rows: NDArray[np.intp], decoded: DecodedBatch
    ) -> None:
        lengths = batch.lengths[rows]
        right = lengths == spec.layout.length
        if not right.all():
            wrong = lengths[~right]
            decoded.wrong_length[spec.name] = (len(wrong), int(wrong[-1]))
            rows = rows[right]
        if spec.layout.selectors:
            rows = rows[spec.layout.selects(batch.data[rows, : spec.layout.length])]
        if len(rows):
            payloads = batch.data[rows, : spec.layout.length]
            decoded.frames[spec.name] = spec.layout.decode(payloads, batch.arrival_ns[rows])


def by_id(ids: NDArray[np.uint32]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Each id with the rows it is in, in their order; error frames all under one."""
    if not len(ids):
        return
    kinds = np.where(ids & np.uint32(ERROR), np.uint32(ERROR), ids)
    if (kinds == kinds[0]).all():
        yield int(kinds[0]), np.arange(len(ids))
        return
    order = np.argsort(kinds, kind="stable")
    in_order = kinds[order]
    starts = np.flatnonzero(np.concatenate(([True], in_order[1:] != in_order[:-1])))
    for rows, frame_id in zip(np.split(order, starts[1:]), in_order[starts].tolist(), strict=True):
        yield frame_id, rows


def _depth(layout: FrameLayout) -> int:
    return len(layout.selectors)


def id_in_words(frame_id: int) -> str:
    """An id as people read it, e.g. ``0x7ff (11 bit)``.

    Args:
        frame_id: with its flags, as in `CanBatch`.
    """
    if frame_id & EXTENDED:
        return f"{frame_id & EXTENDED_ID:#x} (29 bit)"
    return f"{frame_id & STANDARD_ID:#x} (11 bit)"
