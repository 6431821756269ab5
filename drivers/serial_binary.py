"""Binary frames on a serial port: COBS with delimiters, and sync words.

The content of a frame, its *body*, is

    [stream id, 1 byte]  payload  [CRC-16, 2 bytes]

with the id only where several streams share a port, and the payload as a `FrameLayout` packs it.
"""

from __future__ import annotations

import binascii
from itertools import repeat
from typing import TYPE_CHECKING, Literal

import numpy as np
from cobs import cobs

from drivers.frames import LayoutError
from drivers.serial_framing import Found, Frames, Pieces

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from drivers.frames import FrameLayout

CrcName = Literal["none", "ibm-3740", "xmodem"]
CrcOrder = Literal["big", "little"]

CRC_INITIAL: Mapping[CrcName, int] = {"ibm-3740": 0xFFFF, "xmodem": 0x0000}
"""Both are the polynomial 0x1021, most significant bit first (CCITT); they begin differently."""

CRC_BYTES = 2
DELIMITER = b"\0"


class BodyCodec:
    """The bodies of the binary frames on one port: id, payload and CRC.

    Args:
        layouts: by stream; where ``ids`` is set, their ``frame_id`` is the byte that names the stream.
        ids: whether each body begins with that byte.
        crc: which CRC-16 ends each body, over all that is before it.
        crc_order: its byte order.

    Raises:
        LayoutError: there is more than one stream and no id to tell them apart, two have the same id, or an
            id is no byte.
    """

    def __init__(
        self,
        layouts: Mapping[str, FrameLayout],
        *,
        ids: bool = False,
        crc: CrcName = "ibm-3740",
        crc_order: CrcOrder = "big",
    ) -> None:
        if not ids and len(layouts) != 1:
            raise LayoutError(
                f"{len(layouts)} streams share a serial port without stream ids; set stream_ids, or keep one"
            )
        self._ids = ids
        self._initial = CRC_INITIAL.get(crc)
        self._swap = crc_order == "little"
        self._head = 1 if ids else 0
        self._tail = 0 if self._initial is None else CRC_BYTES
        self._layouts = dict(layouts)
        self._by_id: dict[int, str] = {}
        for name, layout in layouts.items():
            if ids and not 0 <= layout.frame_id <= 0xFF:
                raise LayoutError(f"stream {name!r}: id {layout.frame_id} is no byte; take 0 to 255")
            other = self._by_id.setdefault(layout.frame_id if ids else 0, name)
            if other != name:
                raise LayoutError(f"streams {other!r} and {name!r} share id {layout.frame_id}")
        self.longest = max(self.length(name) for name in layouts)

    @property
    def checked(self) -> bool:
        """Whether bodies end with a CRC."""
        return self._initial is not None

    def length(self, stream: str) -> int:
        """Bytes of a body of that stream."""
        return self._head + self._layouts[stream].length + self._tail

    def stream_of(self, body: bytes) -> str | None:
        """The stream that a body says it belongs to; None if there is no such stream."""
        return self._by_id.get(body[0] if self._ids else 0)

    def is_intact(self, body: bytes) -> bool:
        """Whether the CRC matches; True if there is none."""
        if self._initial is None:
            return True
        if self._swap:
            body = body[:-2] + body[:-3:-1]
        # The CRC of what is followed by its own CRC, high byte first, is zero.
        return binascii.crc_hqx(body, self._initial) == 0

    def intact(self, bodies: Sequence[bytes]) -> NDArray[np.bool_]:
        """`is_intact` of many bodies."""
        if self._initial is None:
            return np.ones(len(bodies), np.bool_)
        if self._swap:
            bodies = [body[:-2] + body[:-3:-1] for body in bodies]
        residues = map(binascii.crc_hqx, bodies, repeat(self._initial))
        matches: NDArray[np.bool_] = np.fromiter(residues, np.uint16, len(bodies)) == 0
        return matches

    def encode(
        self,
        stream: str,
        first_index: NDArray[np.int64],
        samples: NDArray[np.float64] | NDArray[np.float32],
        *,
        clip: bool = False,
    ) -> list[bytes]:
        """The bodies of frames; see `drivers.serial_framing.Framing.encode`."""
        layout = self._layouts[stream]
        head = bytes([layout.frame_id]) if self._ids else b""
        bodies = [head + payload.tobytes() for payload in layout.encode(first_index, samples, clip=clip)]
        if self._initial is None:
            return bodies
        order: CrcOrder = "little" if self._swap else "big"
        crcs = map(binascii.crc_hqx, bodies, repeat(self._initial))
        return [body + crc.to_bytes(CRC_BYTES, order) for body, crc in zip(bodies, crcs, strict=True)]

    def sort(
        self, bodies: list[bytes], intact: NDArray[np.bool_], ends: NDArray[np.int64], found: Found
    ) -> NDArray[np.bool_]:
        """Decode bodies into ``found``, by stream.

        Args:
            bodies: as they came; an empty one is no frame.
            intact: bool ``[n]``, whether the CRC of each matches.
            ends: int64 ``[n]``, see `Frames`.
            found: where to put frames, unknown ids and wrong lengths.

        Returns:
            bool ``[n]``, False for bodies that are no frame at all: neither length nor CRC speak for them.
        """
        n = len(bodies)
        sound = intact.copy() if self.checked else np.zeros(n, np.bool_)
        lengths = np.fromiter(map(len, bodies), np.int64, n)
        sound &= lengths > 0
        ids = np.zeros(n, np.int64)
        if self._ids:
            ids[:] = [body[0] if body else -1 for body in bodies]
        strays = np.ones(n, np.bool_)
        for key, name in self._by_id.items():
            mine = (ids == key) & (lengths == self.length(name))
            if not mine.any():
                continue
            strays &= ~mine
            chosen = bodies if mine.all() else [bodies[k] for k in np.flatnonzero(mine).tolist()]
            raw = np.frombuffer(b"".join(chosen), np.uint8).reshape(len(chosen), -1)
            decoded = self._layouts[name].decode(raw[:, self._head : raw.shape[1] - self._tail])
            found.frames[name] = Frames(
                decoded._replace(intact=decoded.intact & intact[mine]),
                ends[mine],
            )
        for k in np.flatnonzero(strays & sound).tolist():
            owner = self._by_id.get(int(ids[k]))
            if owner is None:
                found.note_unknown(f"{ids[k]:#04x}")
            else:
                found.note_wrong_length(owner, int(lengths[k]))
        return ~strays | sound


class CobsFraming:
    """Bodies encoded by Consistent Overhead Byte Stuffing, each followed by a zero byte.

    Garbage costs only the frames it touches: the next zero byte is a fresh start, wherever it is.
    (S. Cheshire and M. Baker, Consistent Overhead Byte Stuffing, IEEE/ACM Trans. Networking 7, 1999.)

    Args:
        codec: what the bodies are.
    """

    def __init__(self, codec: BodyCodec) -> None:
        self._codec = codec
        self._pieces = Pieces(DELIMITER, codec.longest + -(-codec.longest // 254) + 1)
        self._astray = False

    def restart(self) -> None:
        """See `Framing.restart`."""
        self._pieces.restart()
        self._astray = False

    def encode(
        self,
        stream: str,
        first_index: NDArray[np.int64],
        samples: NDArray[np.float64] | NDArray[np.float32],
        *,
        clip: bool = False,
    ) -> list[bytes]:
        """See `Framing.encode`."""
        bodies = self._codec.encode(stream, first_index, samples, clip=clip)
        return [cobs.encode(body) + DELIMITER for body in bodies]

    def cut(self, data: bytes) -> Found:
        """See `Framing.cut`."""
        found = Found()
        pieces, ends, cut_off = self._pieces.split(data, found)
        overlong = found.malformed > 0
        if not all(pieces):  # delimiters side by side
            cut_off &= bool(pieces[0])
            full = [k for k, piece in enumerate(pieces) if piece]
            pieces, ends = [pieces[k] for k in full], ends[full]
        if pieces:
            try:
                bodies = list(map(cobs.decode, pieces))
            except cobs.DecodeError:
                bodies = [_decoded(piece) for piece in pieces]
            in_step = self._codec.sort(bodies, self._codec.intact(bodies), ends, found)
            found.garbage_bytes += sum(len(pieces[k]) + 1 for k in np.flatnonzero(~in_step).tolist())
            # The end of a frame that began before the port was opened is no fault.
            self._astray = found.keep_step(
                in_step[1:] if cut_off and not in_step[0] else in_step, self._astray
            )
        self._astray |= overlong
        return found


class SyncFraming:
    """Bodies of fixed length, each behind a sync word, with nothing between them.

    The sync word may turn up inside a frame or in garbage, so a frame counts only if its CRC matches, or,
    where there is none, once the next sync word stands right behind it. After garbage every sync word is
    tried in turn: one that was none delays what follows by a frame at most, and costs nothing. What stands
    in the place of a frame, behind a sync word, and is none, is a corrupt frame.

    Args:
        codec: what the bodies are.
        sync: the sync word.
    """

    def __init__(self, codec: BodyCodec, sync: bytes) -> None:
        if not sync:
            raise LayoutError("the sync word is empty; give the bytes that each frame begins with")
        self._codec = codec
        self._sync = sync
        self._longest = len(sync) + codec.longest
        self.restart()

    def restart(self) -> None:
        """See `Framing.restart`."""
        self._rest = b""
        self._taken = 0
        self._tried = 0
        self._fresh = True
        self._astray = False

    def encode(
        self,
        stream: str,
        first_index: NDArray[np.int64],
        samples: NDArray[np.float64] | NDArray[np.float32],
        *,
        clip: bool = False,
    ) -> list[bytes]:
        """See `Framing.encode`."""
        bodies = self._codec.encode(stream, first_index, samples, clip=clip)
        return [self._sync + body for body in bodies]

    def cut(self, data: bytes) -> Found:
        """See `Framing.cut`."""
        found = Found()
        kept = len(self._rest)
        buffer = self._rest + data
        width = len(self._sync)
        follows = b"" if self._codec.checked else self._sync
        bodies: list[bytes] = []
        intact: list[bool] = []
        ends: list[int] = []
        taken = self._taken  # what is before this is in a frame, or counted
        at = resume = self._tried
        while (at := buffer.find(self._sync, at)) >= 0:
            end = self._end(buffer, at)
            if end is None:
                at += 1
                continue
            if end + len(follows) > len(buffer):
                break
            body = buffer[at + width : end]
            good = self._codec.is_intact(body) and buffer.startswith(follows, end)
            if good:
                if at > taken:
                    self._count_garbage(at - taken, found)
                found.resyncs += self._astray
                self._fresh = self._astray = False
                resume = end
            if good or (at == taken and not self._fresh and not self._astray):
                # A frame, or a corrupt one in the place where one is due.
                bodies.append(body)
                intact.append(good)
                ends.append(end - kept)
                taken = end
            # What is no frame may have one inside, if bytes are missing.
            at = end if good else at + 1
        if at < 0:  # no sync word ahead, unless the last bytes begin one
            at = max(resume, len(buffer) - width + 1)
        if at - taken > 2 * self._longest:
            self._count_garbage(at - taken, found)
            taken = at
        start = min(at, taken)
        self._rest, self._taken, self._tried = buffer[start:], taken - start, at - start
        if bodies:
            self._codec.sort(bodies, np.array(intact), np.array(ends, np.int64), found)
        return found

    def _count_garbage(self, length: int, found: Found) -> None:
        found.garbage_bytes += length
        if not self._fresh:  # the end of a frame that began before the port was opened is no fault
            found.malformed += not self._astray
            self._astray = True

    def _end(self, buffer: bytes, at: int) -> int | None:
        """Where a frame that begins at ``at`` would end; None if no stream has such a frame."""
        head = buffer[at + len(self._sync) : at + len(self._sync) + 1]
        if not head:
            return at + self._longest
        stream = self._codec.stream_of(head)
        return None if stream is None else at + len(self._sync) + self._codec.length(stream)


def _decoded(piece: bytes) -> bytes:
    """A piece without its stuffing; empty if it is no COBS."""
    try:
        body: bytes = cobs.decode(piece)
    except cobs.DecodeError:
        return b""
    return body
