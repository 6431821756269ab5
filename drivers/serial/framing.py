"""Frames out of a stream of bytes: what every framing of a serial port has in common.

A byte stream has no frames of its own. A framing cuts it into frames, finds its feet again after garbage,
and says how much of it was garbage. All frames of a batch are cut, checked and decoded as arrays: no Python
runs per frame that is of a known stream. The virtual bus wraps its frames with the same objects.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from drivers.frames import Decoded


class Frames(NamedTuple):
    """Frames of one stream, in their order of arrival.

    Attributes:
        decoded: their counters and samples; not intact where the checksum does not match.
        ends: int64 ``[n]``, where each frame ends in the bytes given to `Framing.cut`.
    """

    decoded: Decoded
    ends: NDArray[np.int64]


@dataclass(slots=True)
class Found:
    """What a run of bytes held.

    Attributes:
        frames: by stream.
        garbage_bytes: bytes that belong to no frame.
        malformed: pieces between delimiters, or stretches between sync words, that are no frame.
        resyncs: how often a frame was found again after something malformed.
        unknown: sound frames of streams that nobody asked for, by id in words.
        wrong_length: sound frames whose length is not that of their stream: how many, and the last length.
    """

    frames: dict[str, Frames] = field(default_factory=dict)
    garbage_bytes: int = 0
    malformed: int = 0
    resyncs: int = 0
    unknown: dict[str, int] = field(default_factory=dict)
    wrong_length: dict[str, tuple[int, int]] = field(default_factory=dict)

    def note_unknown(self, name: str) -> None:
        """Count a sound frame of an unknown stream."""
        self.unknown[name] = self.unknown.get(name, 0) + 1

    def keep_step(self, in_step: NDArray[np.bool_], astray: bool) -> bool:  # noqa: FBT001 - a state handed on
        """Count what is malformed, and how often frames were found again after that.

        Args:
            in_step: bool ``[n]``, False where something was no frame.
            astray: whether the last thing before these was no frame.

        Returns:
            Whether the last of these was no frame.
        """
        before = np.concatenate(([astray], ~in_step))
        self.malformed += int((~in_step).sum())
        self.resyncs += int((in_step & before[:-1]).sum())
        return bool(before[-1])

    def note_wrong_length(self, stream: str, length: int) -> None:
        """Count a sound frame of the wrong length."""
        self.wrong_length[stream] = (self.wrong_length.get(stream, (0, 0))[0] + 1, length)


class Framing(Protocol):
    """Cuts a stream of bytes into frames. Whatever the bytes are, it raises nothing."""

    def cut(self, data: bytes) -> Found:
        """Take in the next bytes; what is incomplete at their end is kept for the next call."""
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
        """Forget what is incomplete: the port has been opened anew, in the middle of a frame perhaps."""
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
        self.restart()

    def restart(self) -> None:
        """See `Framing.restart`; the next piece may be the end of one that began before."""
        self._rest = np.empty(0, np.uint8)
        self._cut_off = True
        self._astray = False

    def cut(self, data: bytes) -> Found:
        """See `Framing.cut`."""
        found = Found()
        pieces, cut_off = self._split(data, found)
        overlong = found.malformed > 0
        if cut_off and not self._whole:
            found.garbage_bytes += int((pieces.lengths[:1] + 1).sum())
            pieces, cut_off = pieces.keep(slice(1, None)), False
        full = pieces.lengths > 0
        if not full.all():  # delimiters side by side
            cut_off &= bool(full[0])
            pieces = pieces.keep(full)
        if len(pieces.ends):
            in_step = self._sort(pieces, found)
            found.garbage_bytes += int((pieces.lengths[~in_step] + 1).sum())
            # The end of a frame that began before the port was opened is no fault.
            skipped = int(cut_off and not in_step[0])
            self._astray = found.keep_step(in_step[skipped:], self._astray)
        self._astray |= overlong
        return found

    @abstractmethod
    def _sort(self, pieces: Pieces, found: Found) -> NDArray[np.bool_]:
        """Put the frames in pieces, none of them empty, into ``found``.

        Returns:
            bool ``[n]``, which pieces are frames at all, be they corrupt.
        """

    def _split(self, data: bytes, found: Found) -> tuple[Pieces, bool]:
        """The pieces that are complete now; what is not is kept, or counted in ``found`` if it is overlong.

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
        if len(self._rest) > self._longest:
            found.garbage_bytes += len(self._rest)
            found.malformed += not self._cut_off
            self._rest = self._rest[:0]
            self._cut_off = True
        stops = ends - 1
        for byte in self._padding:
            while (padded := (stops > starts[:-1]) & (buffer[stops - 1] == byte)).any():
                stops = stops - padded
        return Pieces(buffer, starts[:-1], stops, ends - kept), cut_off
