"""The container of snapshots: MCAP (https://mcap.dev/spec), uncompressed, as much of it as they need.

A file is written from front to back and never changed again. Messages lie in chunks that carry their CRC, so
what is cut off takes the chunk that it is in and nothing else, and what is damaged is known to be.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, BinaryIO

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

MAGIC = b"\x89MCAP0\r\n"

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 1, 2, 3, 4, 5, 6
_MESSAGE_INDEX, _METADATA = 7, 12
_CHUNK_INDEX, _ATTACHMENT, _ATTACHMENT_INDEX, _STATISTICS, _DATA_END = 8, 9, 10, 11, 15
_RECORD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_INDEX_HEAD = struct.Struct("<QQQQ")
_INDEX_COUNT = struct.Struct("<HI")

MOST_CHANNELS = 4096
"""Of a file that is read: more are no machine's."""


class McapError(Exception):
    """A file that is none of this kind, or holds what is not read; to be reported behind the file's name."""


@dataclass(frozen=True, slots=True)
class Schema:
    """What messages of a channel are made of.

    Attributes:
        name: of the type, e.g. ``"daqsvc.SampleBlock"``.
        encoding: ``"protobuf"`` or ``"jsonschema"``.
        data: the schema itself.
    """

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Message:
    """One message.

    Attributes:
        topic: of its channel.
        log_ns: wall time at which it was recorded, ns since the Unix epoch.
        data: its bytes.
    """

    topic: str
    log_ns: int
    data: bytes | memoryview


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file within the file.

    Attributes:
        name: its name.
        data: its bytes.
    """

    name: str
    data: bytes


@dataclass(slots=True)
class Damage:
    """What is wrong with a file that was read.

    Attributes:
        ends_early: whether its end is missing: it was cut, or is still being written.
        damaged_chunks: chunks that are not what was written.
    """

    ends_early: bool = False
    damaged_chunks: int = 0


@dataclass(slots=True)
class _Chunk:
    parts: list[bytes | memoryview] = field(default_factory=list)
    size: int = 0
    times_ns: list[int] = field(default_factory=list)

    def add(self, *parts: bytes) -> None:
        self.parts += parts
        self.size += sum(map(len, parts))


@dataclass(frozen=True, slots=True)
class Mark:
    """How far a file was written, see `McapWriter.mark`.

    Attributes:
        size: its bytes.
        counts: messages of each channel.
        indices: how many parts its index names.
        chunks: how many there are.
        span_ns: times of the first message and the last.
    """

    size: int
    counts: dict[int, int]
    indices: int
    chunks: int
    span_ns: tuple[int, int] | None


class McapWriter:
    """Writes a file; see `open_channel`, `write`, `flush`, `finish`.

    Args:
        file: open for writing, at its begin.
        library: who writes it.

    Attributes:
        size: bytes written so far.
    """

    def __init__(self, file: BinaryIO, library: str) -> None:
        self.size = 0
        self._file = file
        self._chunk = _Chunk()
        self._declared: list[bytes] = []
        """The records of schemas and channels, which the summary repeats."""
        self._schemas: dict[Schema, int] = {}
        self._topics: dict[str, int] = {}
        self._counts: dict[int, int] = {}
        self._indices: list[bytes] = []
        self._attachments = 0
        self._span_ns: tuple[int, int] | None = None
        self._chunks = 0
        self._put(MAGIC)
        self._put(_record(_HEADER, _text("") + _text(library)))

    def open_channel(self, topic: str, encoding: str, schema: Schema, about: Mapping[str, str]) -> None:
        """Declare a topic before its first message.

        Args:
            topic: its name.
            encoding: of its messages, ``"protobuf"`` or ``"json"``.
            schema: what they are made of.
            about: what else a reader should know.
        """
        if schema not in self._schemas:
            number = self._schemas[schema] = len(self._schemas) + 1
            content = struct.pack("<H", number) + _text(schema.name) + _text(schema.encoding)
            self._declare(_record(_SCHEMA, content + struct.pack("<I", len(schema.data)) + schema.data))
        number = self._topics[topic] = len(self._topics)
        self._counts[number] = 0
        metadata = b"".join(_text(key) + _text(value) for key, value in about.items())
        content = struct.pack("<HH", number, self._schemas[schema]) + _text(topic) + _text(encoding)
        self._declare(_record(_CHANNEL, content + struct.pack("<I", len(metadata)) + metadata))

    def write(self, topic: str, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Add a message to the chunk that `flush` writes."""
        number = self._topics[topic]
        chunk = self._chunk
        head = _MESSAGE_HEAD.pack(number, self._counts[number] & 0xFFFFFFFF, log_ns, publish_ns)
        self._counts[number] += 1
        chunk.times_ns.append(log_ns)
        chunk.add(_RECORD.pack(_MESSAGE, len(head) + len(data)), head, data)

    @property
    def waiting_bytes(self) -> int:
        """What the next chunk has so far."""
        return self._chunk.size

    def attach(self, name: str, media_type: str, data: bytes, wall_ns: int) -> None:
        """Add a file."""
        self.flush()
        content = struct.pack("<QQ", wall_ns, wall_ns) + _text(name) + _text(media_type)
        index = struct.pack("<QQQ", wall_ns, wall_ns, len(data)) + _text(name) + _text(media_type)
        content += struct.pack("<Q", len(data)) + data
        content += struct.pack("<I", zlib.crc32(content))
        at = self.size
        self._put(_record(_ATTACHMENT, content))
        self._attachments += 1
        self._indices.append(_record(_ATTACHMENT_INDEX, struct.pack("<QQ", at, self.size - at) + index))

    def flush(self) -> None:
        """Write the chunk, if it has anything."""
        chunk, self._chunk = self._chunk, _Chunk()
        if not chunk.parts:
            return
        crc = 0
        for part in chunk.parts:
            crc = zlib.crc32(part, crc)
        begin_ns, end_ns = min(chunk.times_ns, default=0), max(chunk.times_ns, default=0)
        head = _CHUNK_HEAD.pack(begin_ns, end_ns, chunk.size, crc) + _text("")
        head += struct.pack("<Q", chunk.size)
        at, length = self.size, len(head) + chunk.size
        self._put(b"".join([_RECORD.pack(_CHUNK, length), head, *chunk.parts]))
        self._chunks += 1
        first_ns, last_ns = self._span_ns or (begin_ns, end_ns)
        self._span_ns = min(first_ns, begin_ns), max(last_ns, end_ns)
        index = _INDEX_HEAD.pack(begin_ns, end_ns, at, self.size - at)
        index += struct.pack("<IQ", 0, 0) + _text("") + struct.pack("<QQ", chunk.size, chunk.size)
        self._indices.append(_record(_CHUNK_INDEX, index))

    def mark(self) -> Mark:
        """How far the file is now, without what waits for `flush`."""
        return Mark(self.size, dict(self._counts), len(self._indices), self._chunks, self._span_ns)

    def go_back(self, mark: Mark, file: BinaryIO) -> None:
        """Take the file to be as it was at a mark, and go on in it.

        Args:
            mark: no attachment and no channel came after it.
            file: open for writing, at its end, which is where it was then.
        """
        self._file, self._chunk = file, _Chunk()
        self.size, self._chunks, self._span_ns = mark.size, mark.chunks, mark.span_ns
        self._counts = dict(mark.counts)
        del self._indices[mark.indices :]

    def finish(self) -> None:
        """Write what lets readers find their way, and the end."""
        self.flush()
        self._put(_record(_DATA_END, struct.pack("<I", 0)))
        start = self.size
        counts = b"".join(struct.pack("<HQ", number, count) for number, count in self._counts.items())
        first_ns, last_ns = self._span_ns or (0, 0)
        statistics = struct.pack(
            "<QHIIIIQQI",
            sum(self._counts.values()),
            len(self._schemas),
            len(self._topics),
            self._attachments,
            0,
            self._chunks,
            first_ns,
            last_ns,
            len(counts),
        )
        summary = b"".join([*self._declared, *self._indices, _record(_STATISTICS, statistics + counts)])
        footer = _RECORD.pack(_FOOTER, 20) + struct.pack("<QQ", start, 0)
        self._put(summary)
        self._put(footer + struct.pack("<I", zlib.crc32(footer, zlib.crc32(summary))) + MAGIC)

    def _declare(self, record: bytes) -> None:
        self._declared.append(record)
        self._chunk.add(record)

    def _put(self, data: bytes) -> None:
        self._file.write(data)
        self.size += len(data)


def read(data: memoryview, damage: Damage) -> Iterator[Message | Attachment]:
    """What a file holds, in its order, as far as it can be read.

    Args:
        data: the file.
        damage: takes in what is wrong with it.

    Raises:
        McapError: it is no such file, or not one that is read here.
    """
    begin = bytes(data[: len(MAGIC)])
    if begin and begin != MAGIC and MAGIC.startswith(begin):
        damage.ends_early = True
        return
    if begin != MAGIC:
        raise McapError("is no MCAP file: it does not begin as one")
    topics: dict[int, str] = {}
    for kind, content in _records(data, damage):
        records = _opened(content) if kind == _CHUNK else None
        attachment = _attachment(content) if kind == _ATTACHMENT else None
        if records is not None:
            yield from _messages(records, topics)
        elif attachment is not None:
            yield attachment
        elif not _is_other(kind, content):
            damage.damaged_chunks += 1


def _records(data: memoryview, damage: Damage) -> Iterator[tuple[int, memoryview]]:
    """The records of a file up to the end of its data, as far as they are whole."""
    at = len(MAGIC)
    while at + _RECORD.size <= len(data):
        kind, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if kind == _DATA_END:
            return
        if length > len(data) - at:
            break
        if at > len(MAGIC) + _RECORD.size or kind != _HEADER:
            yield kind, data[at : at + length]
        at += length
    damage.ends_early = True


def _is_other(kind: int, content: memoryview) -> bool:
    """Whether a record is one that tools may add to a file, and that is not needed."""
    if kind == _MESSAGE_INDEX and len(content) >= _INDEX_COUNT.size:
        _, length = _INDEX_COUNT.unpack_from(content)
        return int(length) == len(content) - _INDEX_COUNT.size
    return kind == _METADATA


def _messages(records: memoryview, topics: dict[int, str]) -> Iterator[Message]:
    at = 0
    while at + _RECORD.size <= len(records):
        kind, length = _RECORD.unpack_from(records, at)
        at += _RECORD.size
        if length > len(records) - at:
            raise McapError("holds a message that is longer than its chunk")
        if kind == _CHANNEL:
            _note_channel(records[at : at + length], topics)
        elif kind == _MESSAGE:
            yield _message(records[at : at + length], topics)
        at += length


def _message(content: memoryview, topics: Mapping[int, str]) -> Message:
    if len(content) < _MESSAGE_HEAD.size:
        raise McapError("holds a message that is too short")
    number, _, log_ns, _ = _MESSAGE_HEAD.unpack_from(content)
    if number not in topics:
        raise McapError(f"holds a message of a channel {number} that it does not declare")
    return Message(topics[number], log_ns, content[_MESSAGE_HEAD.size :])


def _note_channel(content: memoryview, topics: dict[int, str]) -> None:
    if len(content) < 4:
        raise McapError("declares a channel without a number")
    topic, _ = _taken_text(content, 4)
    topics[struct.unpack_from("<H", content)[0]] = topic
    if len(topics) > MOST_CHANNELS:
        raise McapError(f"declares more than {MOST_CHANNELS} channels")


def _opened(content: memoryview) -> memoryview | None:
    """The records of a chunk; None if they are damaged.

    Raises:
        McapError: it is compressed.
    """
    try:
        _, _, _, crc = _CHUNK_HEAD.unpack_from(content)
        compression, at = _taken_text(content, _CHUNK_HEAD.size)
    except (struct.error, McapError):
        return None
    if compression in {"lz4", "zstd"}:
        raise McapError(
            f"is compressed ({compression}), which is not read here: mcap convert it without compression"
        )
    if compression or len(content) < at + 8:
        return None
    (size,) = struct.unpack_from("<Q", content, at)
    records = content[at + 8 :]
    if size != len(records) or zlib.crc32(records) != crc:
        return None
    return records


def _attachment(content: memoryview) -> Attachment | None:
    if (
        len(content) < 20
        or zlib.crc32(content[:-4]) != struct.unpack_from("<I", content, len(content) - 4)[0]
    ):
        return None
    name, at = _taken_text(content, 16)
    _, at = _taken_text(content, at)
    if len(content) < at + 12 or struct.unpack_from("<Q", content, at)[0] != len(content) - at - 12:
        return None
    return Attachment(name, bytes(content[at + 8 : -4]))


def _record(kind: int, content: bytes) -> bytes:
    return _RECORD.pack(kind, len(content)) + content


def _text(text: str) -> bytes:
    encoded = text.encode()
    return struct.pack("<I", len(encoded)) + encoded


def _taken_text(content: memoryview, at: int) -> tuple[str, int]:
    """A text, and where it ends.

    Raises:
        McapError: there is none.
    """
    if at + 4 > len(content):
        raise McapError("holds a record that is too short")
    (length,) = struct.unpack_from("<I", content, at)
    if length > len(content) - at - 4:
        raise McapError("holds a record that is too short")
    return bytes(content[at + 4 : at + 4 + length]).decode(errors="replace"), at + 4 + length
