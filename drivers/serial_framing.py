"""Frames out of a stream of bytes: what every framing of a serial port has in common.

A byte stream has no frames of its own. A framing cuts it into frames, finds its feet again after garbage,
and says how much of it was garbage. Python handles whole frames, never their bytes or samples: cutting, CRC
and COBS run in C, and all frames of a batch are decoded as arrays. The virtual bus wraps its frames with
the same objects.
"""

from __future__ import annotations

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


class Pieces:
    """Cuts bytes at a delimiter and keeps what is incomplete, up to a length.

    Args:
        delimiter: the byte between pieces.
        longest: bytes of the longest piece that can be a frame; what is longer is garbage.
    """

    def __init__(self, delimiter: bytes, longest: int) -> None:
        self._delimiter = delimiter
        self._longest = longest
        self.restart()

    def restart(self) -> None:
        """Forget what is incomplete; the next piece may be the end of one that began before."""
        self._rest = b""
        self._cut_off = True

    def split(self, data: bytes, found: Found) -> tuple[list[bytes], NDArray[np.int64], bool]:
        """The pieces that are complete now, without their delimiters; overlong ones are counted in ``found``.

        Returns:
            The pieces; int64 ``[n]``, where each ends in ``data``; and whether the first one's beginning may
            be missing.
        """
        kept = len(self._rest)
        pieces = (self._rest + data).split(self._delimiter)
        self._rest = pieces.pop()
        ends = np.cumsum(np.fromiter(map(len, pieces), np.int64, len(pieces)) + 1) - kept
        cut_off = self._cut_off
        self._cut_off = cut_off and not pieces
        if len(self._rest) > self._longest:
            found.garbage_bytes += len(self._rest)
            found.malformed += not self._cut_off
            self._rest = b""
            self._cut_off = True
        return pieces, ends, cut_off
