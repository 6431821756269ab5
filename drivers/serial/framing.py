"""Frames out of a stream of bytes: what every framing of a serial port has in common.

A byte stream has no frames of its own. A framing cuts it into frames, finds the next frame after garbage,
and counts the garbage. All frames of a batch are cut, checked and decoded as arrays: no Python
runs per frame that is of a known stream. The virtual bus wraps its frames with the same objects.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

import numpy as np

from drivers.frames import DecodedBatch

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


ArrivalsOf: TypeAlias = "Callable[[NDArray[np.int64]], NDArray[np.int64]]"
"""When frames arrived (int64 ``[n]``, ns), by where each ends in the bytes that are being cut."""


SHOWN_BYTES = 16
"""Bytes that are shown of what is no frame."""
COMPARE = "compare baud, parity, framing and checksum with the device's"
"""What to do about bytes that show nothing more."""


_IN_A_ROW = 3
"""Number of pieces in a row from which on all of them may be no frame."""
_JUDGED_BY = 4
"""Number of the last pieces of a batch by which is judged what is wrong with all of them."""
_MOST_KINDS = 16


class NoFrame(NamedTuple):
    """A piece that should have been a frame.

    Attributes:
        why: what it is, and what is wrong with it.
        remedy: what to do if all pieces are like it.
    """

    why: str
    remedy: str = COMPARE


def in_place(ends: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where frames end represents when they arrived."""
    return ends


def count_steps(batch: DecodedBatch, in_step: NDArray[np.bool_], *, astray: bool) -> bool:
    """Count what is malformed, and how often frames were found again after that.

    Args:
        batch: where to count.
        in_step: bool ``[n]``, False where something was no frame.
        astray: whether the last thing before these was no frame.

    Returns:
        Whether the last of these was no frame.
    """
    before = np.concatenate(([astray], ~in_step))
    batch.note("frames_malformed", int((~in_step).sum()))
    batch.note("resyncs", int((in_step & before[:-1]).sum()))
    return bool(before[-1])


class Framing(Protocol):
    """Cuts a stream of bytes into frames. Whatever the bytes are, it raises nothing."""

    def cut(self, data: bytes, arrivals_of: ArrivalsOf = in_place) -> DecodedBatch:
        """Take in the next bytes; what is incomplete at their end is kept for the next call.

        Args:
            data: the bytes.
            arrivals_of: states when the frames in them arrived.
        """
        ...

    def ends_in(self, chunk: bytes, heard: int) -> bool:
        """Whether a frame ends in a chunk of bytes, or did in those before it; from any thread.

        Args:
            chunk: the last bytes that came.
            heard: how many have come in a row, those included.
        """
        ...

    def encode(
        self,
        stream: str,
        first_index: NDArray[np.int64],
        samples: NDArray[np.float64] | NDArray[np.float32],
        *,
        clip: bool = False,
    ) -> list[bytes]:
        """Samples as the device sends them, one entry per frame with all that goes over the wire.

        Args:
            stream: of the layout to be used.
            first_index: int64 ``[n]``, the device's count of each frame's first sample.
            samples: ``[n, samples_per_frame, channels]`` in physical units.
            clip: saturate what does not fit, as an analogue input does, instead of raising.

        Raises:
            LayoutError: a value does not fit its field (and ``clip`` is False), or is NaN.
        """
        ...

    def restart(self) -> None:
        """Forget what is incomplete: the port has been opened again, in the middle of a frame perhaps."""
        ...


class Pieces(NamedTuple):
    """Stretches of bytes between delimiters.

    Attributes:
        buffer: uint8, the bytes; whoever is given the pieces may change it.
        starts: int64 ``[n]``, where each piece begins in the buffer.
        stops: int64 ``[n]``, one past its last byte.
        ends: int64 ``[n]``, one past its delimiter, in the bytes given to `Framing.cut`.
    """

    buffer: NDArray[np.uint8]
    starts: NDArray[np.int64]
    stops: NDArray[np.int64]
    ends: NDArray[np.int64]

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Bytes of each piece, int64 ``[n]``."""
        return self.stops - self.starts

    def keep(self, chosen: NDArray[np.bool_] | slice) -> Pieces:
        """Some of them."""
        return Pieces(self.buffer, self.starts[chosen], self.stops[chosen], self.ends[chosen])


class DelimitedFraming(ABC):
    """Frames with a delimiter behind each: wherever one stands is a fresh start, whatever was before it.

    Args:
        delimiter: the byte behind each frame.
        longest: bytes of the longest piece that can be a frame; what is longer is garbage.
        padding: a byte that may stand before the delimiter and is no part of the frame.
        whole: whether a frame shows that its beginning is missing.
    """

    def __init__(self, delimiter: bytes, longest: int, padding: bytes = b"", *, whole: bool = True) -> None:
        self._delimiter = ord(delimiter)
        self._longest = longest
        self._padding = padding
        self._whole = whole
        self._is_reported = False
        # What is wrong with the pieces since the last frame, by its remedy; and which of it was reported.
        self._wrong: Counter[str] = Counter()
        self._reported_of_these: str | None = None
        self.restart()

    def restart(self) -> None:
        """See `Framing.restart`; the next piece may be the end of one that began before."""
        self._rest = np.empty(0, np.uint8)
        self._cut_off = True
        self._endless = False
        self._astray = False

    def cut(self, data: bytes, arrivals_of: ArrivalsOf = in_place) -> DecodedBatch:
        """See `Framing.cut`."""
        batch = DecodedBatch()
        kept = self._rest
        pieces, cut_off = self._split(data, batch)
        overlong = batch.notes["frames_malformed"] > 0
        if overlong and not self._is_reported:
            batch.malformed, batch.remedy = self._why_no_end((kept.tobytes() + data)[: self._longest])
            self._is_reported = True
        if cut_off and not self._whole:
            batch.note("bytes_garbage", int((pieces.lengths[:1] + 1).sum()))
            pieces, cut_off = pieces.keep(slice(1, None)), False
        full = pieces.lengths > 0
        if not full.all():  # delimiters side by side
            cut_off &= bool(full[0])
            pieces = pieces.keep(full)
        if len(pieces.ends):
            in_step = self._sort(pieces, batch, arrivals_of)
            batch.note("bytes_garbage", int((pieces.lengths[~in_step] + 1).sum()))
            # The end of a frame that began before the port was opened is no fault.
            skipped = int(cut_off and not in_step[0])
            self._astray = count_steps(batch, in_step[skipped:], astray=self._astray)
            self._report(batch, pieces.keep(slice(skipped, None)), in_step[skipped:], kept, data)
        self._astray |= overlong
        return batch

    def _report(
        self,
        batch: DecodedBatch,
        pieces: Pieces,
        in_step: NDArray[np.bool_],
        kept: NDArray[np.uint8],
        data: bytes,
    ) -> None:
        """Report what is wrong with the first piece that is no frame, and later with what is none now.

        A header that comes now and then is no frame either, and shows nothing of the lines behind it.
        """
        strange, sound = np.flatnonzero(~in_step), np.flatnonzero(in_step)
        if not len(strange):
            self._begin_anew(sound)
            return
        # As they came: who sorts pieces may change the buffer.
        came = kept.tobytes() + data

        def why_no_frame(place: int, which: str) -> NoFrame:
            return self._why_no_frame(came[pieces.starts[place] : pieces.stops[place]], which)

        first = None if self._is_reported else why_no_frame(int(strange[0]), "the first")
        if first is not None:
            batch.malformed, batch.remedy = first
            self._is_reported = True
        self._begin_anew(sound)
        if len(sound):
            strange = strange[strange > sound[-1]]
        elif first is not None:
            self._reported_of_these = first.remedy
        for place in strange[-_JUDGED_BY:].tolist():
            last = why_no_frame(place, "the last")
            if len(self._wrong) == _MOST_KINDS:
                self._wrong.clear()
            self._wrong[last.remedy] += 1
            is_most = self._wrong[last.remedy] == max(self._wrong.values())
            if self._wrong.total() >= _IN_A_ROW and is_most and last.remedy != self._reported_of_these:
                batch.malformed, batch.remedy = last
                self._reported_of_these = last.remedy

    def _begin_anew(self, sound: NDArray[np.int64]) -> None:
        """What was wrong before a frame is of no use for what comes behind it."""
        if len(sound):
            self._wrong.clear()
            self._reported_of_these = None

    def ends_in(self, chunk: bytes, heard: int) -> bool:
        """See `Framing.ends_in`."""
        del heard
        return self._delimiter in chunk

    def _why_no_frame(self, piece: bytes, which: str = "the first") -> NoFrame:
        """What a piece is that should have been a frame, the first or the last, and what is wrong with it."""
        begin = piece[:SHOWN_BYTES].hex(" ")
        shown = f"{begin}{' ...' if len(piece) > SHOWN_BYTES else ''}"
        return NoFrame(f"{which} has {len(piece)} bytes: {shown}")

    def _why_no_end(self, begin: bytes) -> NoFrame:
        """What bytes are that have no delimiter within the longest frame, and what is wrong with them."""
        shown = begin[:SHOWN_BYTES].hex(" ")
        return NoFrame(
            f"no {self._delimiter:#04x}, which ends a frame, in {self._longest} bytes: {shown} ..."
        )

    @abstractmethod
    def _sort(self, pieces: Pieces, batch: DecodedBatch, arrivals_of: ArrivalsOf) -> NDArray[np.bool_]:
        """Put the frames in pieces, none of them empty, into ``batch``.

        Returns:
            bool ``[n]``, which pieces are frames at all, be they corrupt.
        """

    def _split(self, data: bytes, batch: DecodedBatch) -> tuple[Pieces, bool]:
        """The pieces that are complete now; what is not is kept, or counted in ``batch`` if it is overlong.

        Returns:
            The pieces, and whether the first one's beginning may be missing.
        """
        kept = len(self._rest)
        buffer = np.concatenate([self._rest, np.frombuffer(data, np.uint8)])
        ends = np.flatnonzero(buffer == self._delimiter) + 1
        starts = np.concatenate(([0], ends))
        self._rest = buffer[starts[-1] :].copy()
        cut_off = self._cut_off
        self._cut_off = cut_off and not len(ends)
        self._endless &= not len(ends)
        if len(self._rest) > self._longest:
            batch.note("bytes_garbage", len(self._rest))
            batch.note("frames_malformed", int(not self._endless))
            self._rest = self._rest[:0]
            self._cut_off = self._endless = True
        stops = ends - 1
        for byte in self._padding:
            while (padded := (stops > starts[:-1]) & (buffer[stops - 1] == byte)).any():
                stops = stops - padded
        return Pieces(buffer, starts[:-1], stops, ends - kept), cut_off
