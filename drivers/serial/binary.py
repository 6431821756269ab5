"""Binary frames on a serial port: COBS with delimiters, and sync words.

The content of a frame, its *body*, is

    [stream id, 1 byte]  payload  [CRC-16, 2 bytes]

with the id only where several streams share a port, and the payload as a `FrameLayout` packs it.
"""

from __future__ import annotations

import binascii
from abc import ABC, abstractmethod
from itertools import repeat
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from cobs import cobs

from daqsvc.rounding import counted
from drivers.frames import DecodedBatch, LayoutError
from drivers.serial.framing import SHOWN_BYTES, DelimitedFraming, NoFrame, in_place
from drivers.serial.kernels import CRC_BYTES, SyncSearch, crcs_match, gather, hunt, scaled, unstuff

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from drivers.frames import FrameLayout
    from drivers.serial.framing import ArrivalsOf, Pieces
    from drivers.serial.kernels import Hunted

CrcName = Literal["none", "ibm-3740", "xmodem"]
CrcOrder = Literal["big", "little"]

CRC_INITIAL: Mapping[CrcName, int] = {"ibm-3740": 0xFFFF, "xmodem": 0x0000}
"""Both are the polynomial 0x1021, most significant bit first (CCITT); they begin differently."""

NO_CRC = -1
DELIMITER = b"\0"


class Bodies(NamedTuple):
    """Where the bodies of frames are.

    Attributes:
        buffer: uint8, with all of them in it.
        starts: int64 ``[n]``, where each begins in the buffer.
        lengths: int64 ``[n]``, bytes of each; 0 or less for what is no frame.
        intact: bool ``[n]``, whether its CRC matches.
        arrival_ns: int64 ``[n]``, when each arrived.
    """

    buffer: NDArray[np.uint8]
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    intact: NDArray[np.bool_]
    arrival_ns: NDArray[np.int64]


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
        self._initial = CRC_INITIAL.get(crc, NO_CRC)
        self._swap = crc_order == "little"
        self._head = 1 if ids else 0
        self._tail = CRC_BYTES if self.checked else 0
        self._layouts = dict(layouts)
        self._by_id: dict[int, str] = {}
        for name, layout in layouts.items():
            if ids and not 0 <= layout.frame_id <= 0xFF:
                raise LayoutError(f"stream {name!r}: id {layout.frame_id} is no byte; take 0 to 255")
            other = self._by_id.setdefault(layout.frame_id if ids else 0, name)
            if other != name:
                raise LayoutError(f"streams {other!r} and {name!r} share id {layout.frame_id}")
        self.longest = max(self.length(name) for name in layouts)
        self._by_first_byte = np.full(256, -1 if ids else self.longest, np.int64)
        for key, name in self._by_id.items():
            self._by_first_byte[key] = self.length(name)

    @property
    def checked(self) -> bool:
        """Whether bodies end with a CRC."""
        return self._initial != NO_CRC

    def length(self, stream: str) -> int:
        """Bytes of a body of that stream."""
        return self._head + self._layouts[stream].length + self._tail

    def intact(
        self, buffer: NDArray[np.uint8], starts: NDArray[np.int64], lengths: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Whether the CRC of each body matches, bool ``[n]``; True if there is none. See `Bodies`."""
        if not self.checked:
            return np.ones(len(starts), np.bool_)
        return crcs_match(buffer, starts, lengths, self._initial, self._swap)

    def hunt(self, buffer: NDArray[np.uint8], word: NDArray[np.uint8], step: SyncSearch) -> Hunted:
        """The bodies behind sync words; see `drivers.serial.kernels.hunt`."""
        limits = min(map(self.length, self._layouts)), self.longest
        return hunt(buffer, word, self._by_first_byte, limits, self._initial, self._swap, step)

    def encode(
        self,
        stream: str,
        first_index: NDArray[np.int64],
        samples: NDArray[np.float64] | NDArray[np.float32],
        *,
        clip: bool = False,
    ) -> list[bytes]:
        """The bodies of frames; see `drivers.serial.framing.Framing.encode`."""
        layout = self._layouts[stream]
        head = bytes([layout.frame_id]) if self._ids else b""
        bodies = [head + payload.tobytes() for payload in layout.encode(first_index, samples, clip=clip)]
        if not self.checked:
            return bodies
        order: CrcOrder = "little" if self._swap else "big"
        crcs = map(binascii.crc_hqx, bodies, repeat(self._initial))
        return [body + crc.to_bytes(CRC_BYTES, order) for body, crc in zip(bodies, crcs, strict=True)]

    def sort(self, bodies: Bodies, batch: DecodedBatch) -> NDArray[np.bool_]:
        """Decode bodies into ``batch``, by stream.

        Args:
            bodies: as they came.
            batch: where to put frames, unknown ids and wrong lengths.

        Returns:
            bool ``[n]``, False for bodies that are no frame at all: neither length nor CRC is evidence for
            them.
        """
        buffer, starts, lengths, intact, arrival_ns = bodies
        sound = intact & (lengths > 0) if self.checked else np.zeros(len(starts), np.bool_)
        ids = np.where(lengths > 0, buffer[starts], -1) if self._ids else np.zeros(len(starts), np.int64)
        strays = np.ones(len(starts), np.bool_)
        for key, name in self._by_id.items():
            layout = self._layouts[name]
            mine = (ids == key) & (lengths == self.length(name))
            if not mine.any():
                continue
            strays &= ~mine
            payloads = gather(buffer, starts[mine] + self._head, layout.length)
            frames = layout.decode(payloads, arrival_ns[mine], scaling=scaled)
            batch.frames[name] = frames._replace(intact=frames.intact & intact[mine])
        for k in np.flatnonzero(strays & sound).tolist():
            owner = self._by_id.get(int(ids[k]))
            if owner is None:
                batch.unknown[f"{ids[k]:#04x}"] += 1
            else:
                before, _ = batch.wrong_length.get(owner, (0, 0))
                batch.wrong_length[owner] = before + 1, int(lengths[k])
        return ~strays | sound


class _BinaryFraming(ABC):
    """What wraps bodies for the wire.

    Args:
        codec: what the bodies are.
    """

    def __init__(self, codec: BodyCodec) -> None:
        self._codec = codec

    @abstractmethod
    def _wrap(self, body: bytes) -> bytes:
        """All that goes over the wire for a body."""

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
        return [self._wrap(body) for body in bodies]


class CobsFraming(_BinaryFraming, DelimitedFraming):
    """Bodies encoded by Consistent Overhead Byte Stuffing, each followed by a zero byte.

    Garbage costs only the frames it touches: the next zero byte is a fresh start, wherever it is.
    (S. Cheshire and M. Baker, Consistent Overhead Byte Stuffing, IEEE/ACM Trans. Networking 7, 1999.)

    Args:
        codec: what the bodies are.
    """

    def __init__(self, codec: BodyCodec) -> None:
        _BinaryFraming.__init__(self, codec)
        DelimitedFraming.__init__(self, DELIMITER, codec.longest + -(-codec.longest // 254) + 1)

    def _wrap(self, body: bytes) -> bytes:
        stuffed: bytes = cobs.encode(body)
        return stuffed + DELIMITER

    def _sort(self, pieces: Pieces, batch: DecodedBatch, arrivals_of: ArrivalsOf) -> NDArray[np.bool_]:
        buffer, starts, stops, ends = pieces
        lengths = unstuff(buffer, starts, stops)
        intact = self._codec.intact(buffer, starts + 1, lengths)
        return self._codec.sort(Bodies(buffer, starts + 1, lengths, intact, arrivals_of(ends)), batch)


class SyncFraming(_BinaryFraming):
    """Bodies of fixed length, each behind a sync word, with nothing between them.

    The sync word may turn up inside a frame or in garbage, so a frame counts only if its CRC matches. Where
    there is none, it counts once the next sync word is right behind it, or behind as many stray bytes as
    the frame after it has. After garbage every sync word is tried in turn: one that was none delays what
    follows by a frame at most, and costs nothing. What is in the place of a frame, behind a sync word, and is
    none, is a corrupt frame.

    Args:
        codec: what the bodies are.
        sync: the sync word.
    """

    def __init__(self, codec: BodyCodec, sync: bytes) -> None:
        if not sync:
            raise LayoutError("the sync word is empty; give the bytes that each frame begins with")
        super().__init__(codec)
        self._is_reported = False
        self._sync = np.frombuffer(sync, np.uint8).copy()
        self.restart()

    def restart(self) -> None:
        """See `Framing.restart`."""
        self._rest = np.empty(0, np.uint8)
        self._step = SyncSearch()

    def _wrap(self, body: bytes) -> bytes:
        return self._sync.tobytes() + body

    def ends_in(self, chunk: bytes, heard: int) -> bool:
        """See `Framing.ends_in`; sure only of as many bytes as the longest frame has."""
        del chunk
        return heard >= len(self._sync) + self._codec.longest

    def cut(self, data: bytes, arrivals_of: ArrivalsOf = in_place) -> DecodedBatch:
        """See `Framing.cut`."""
        kept = len(self._rest)
        buffer = np.concatenate([self._rest, np.frombuffer(data, np.uint8)])
        before = self._step
        hunted = self._codec.hunt(buffer, self._sync, self._step)
        batch = DecodedBatch()
        batch.note("bytes_garbage", hunted.garbage_bytes)
        batch.note("frames_malformed", hunted.malformed)
        batch.note("resyncs", hunted.resyncs)
        # Before the first frame nothing is malformed: what a device sends may be in no frame at all.
        nothing_else = bool(hunted.garbage_bytes) and not len(hunted.ends)
        if nothing_else or (hunted.malformed and not self._is_reported):
            batch.malformed, batch.remedy = self._no_frame(buffer, hunted, before)
            self._is_reported = True
        step = hunted.step
        start = min(step.taken, step.tried)
        self._rest = buffer[start:].copy()
        self._step = step._replace(taken=step.taken - start, tried=step.tried - start)
        if len(hunted.ends):
            lengths = hunted.ends - hunted.starts
            arrival_ns = arrivals_of(hunted.ends - kept)
            self._codec.sort(Bodies(buffer, hunted.starts, lengths, hunted.intact, arrival_ns), batch)
        return batch

    def _no_frame(self, buffer: NDArray[np.uint8], hunted: Hunted, before: SyncSearch) -> NoFrame:
        """The first bytes that are in no frame; of those between two whole ones, that they cost none.

        Devices may end their frames by such bytes.

        Args:
            buffer: the bytes.
            hunted: what was found in them.
            before: how far the search had come.
        """
        if not len(hunted.ends):
            return self._none_in(buffer[before.taken : hunted.step.taken].tobytes())
        begins, ends = hunted.starts - len(self._sync), hunted.ends
        whole = hunted.intact
        if not (before.fresh or before.astray):
            ends, whole = np.append(before.taken, ends), np.append(True, whole)
            begins = np.append(0, begins)
        gaps = begins[1:] - ends[:-1]
        few = np.flatnonzero(whole[1:] & whole[:-1] & (gaps > 0) & (gaps <= SHOWN_BYTES))
        if not len(few):
            begin = int([*ends[:-1][gaps > 0], *hunted.ends[-1:]][0])
            shown = buffer[begin : begin + SHOWN_BYTES].tobytes().hex(" ")
            return NoFrame(f"the first of them: {shown} ...")
        count, begin = int(gaps[few[0]]), int(ends[few[0]])
        shown = buffer[begin : begin + count].tobytes().hex(" ")
        return NoFrame(
            f"the first are between two whole frames, {counted(count, 'byte')}: {shown}",
            "the device sends them behind each frame, and no frame is lost by them",
        )

    def _none_in(self, came: bytes) -> NoFrame:
        """Bytes without a frame, and what that shows of the settings."""
        word = self._sync.tobytes()
        shown = f"{came[:SHOWN_BYTES].hex(' ')}{' ...' if len(came) > SHOWN_BYTES else ''}"
        many = counted(len(came), "byte")
        if word not in came:
            return NoFrame(
                f"the sync word {word.hex()} is not in {many}: {shown}",
                "compare baud, parity and sync_word with the device's",
            )
        length = counted(self._codec.longest, "byte")
        checked = "no frame with a good CRC" if self._codec.checked else "no other one"
        return NoFrame(
            f"the sync word {word.hex()} is in {many}, but {checked} {length} behind it: {shown}",
            "compare payload_length, stream_ids and crc with the device's",
        )
