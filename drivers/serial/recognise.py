"""What a stream of bytes is: lines of text, frames behind a sync word, or COBS frames.

Pure functions of bytes. Bytes that were sampled at a wrong baud rate are none of these, so that the score
tells the right rate, too.
"""

from __future__ import annotations

import binascii
import re
from collections import Counter
from dataclasses import dataclass, field
from functools import reduce
from operator import xor
from typing import TYPE_CHECKING, Literal

import numpy as np
from cobs import cobs

from drivers.counter_search import CounterSearch

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from drivers.counter_search import FrameCounter

LEAST_BYTES = 24
"""Of fewer nothing is said."""
LEAST_FRAMES = 6
CONCLUSIVE = 0.9
"""No other baud rate need be tried."""
LONGEST_FRAME = 1024
MOST_BYTES = 65_536
"""Of a longer stream the end is looked at."""

_TEXT = frozenset(range(0x20, 0x7F)) | {0x09, 0x0A, 0x0D}
_LEAST_PRINTABLE = 0.95
_CONSTANT = 0.98
_MOST_LAGS = 12
_MOST_CHECKED = 64
_IDLE = b"\x00\xff"
LONGEST_SYNC = 8

SEPARATORS = (",", ";", "\t", "|", " ")
_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*")
_CHECKSUM = re.compile(r"\*([0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})$")
_PREFIX = re.compile(r"[!$]?[A-Za-z_-][A-Za-z0-9_-]{0,14}")

Parity = Literal["none", "even", "odd"]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of lines.

    Attributes:
        name: as the header has it, else ``c1``, ``c2`` ...
        numeric: whether it is a number in every line.
        least: least value; 0 of a text.
        most: largest one.
        step: by how much it grows from line to line, where it does so always; else 0.
        grows: whether it never falls, and grows at all.
        last: its last text.
    """

    name: str
    numeric: bool
    least: float = 0.0
    most: float = 0.0
    step: float = 0.0
    grows: bool = False
    last: str = ""


@dataclass(frozen=True, slots=True)
class TextLines:
    """Lines of text.

    Attributes:
        lines: whole lines, oldest first, without their ends.
        delimiter: what ends one; a carriage return before a line feed is none of it.
        separator: between columns; empty if there is one column.
        prefix: the first field of each line, where it is the same word in all; else empty.
        checksum: behind a ``*``: "xor", "crc16", "unknown", or "none".
        columns: those of most lines, without prefix.
        header: whether the first line names the columns.
        other: lines with another number of columns.
    """

    lines: Sequence[str]
    delimiter: str
    separator: str
    prefix: str
    checksum: str
    columns: Sequence[Column]
    header: bool
    other: int


@dataclass(frozen=True, slots=True)
class BinaryFrames:
    """Binary frames of one length.

    Attributes:
        framing: "sync" or "cobs".
        sync: the bytes that each begins with; none with COBS.
        length: bytes of a frame, with sync word and CRC, without the delimiter of COBS.
        frames: how many came whole, uint8 ``[n, length]``; of COBS they are decoded.
        crc: name of the check at the end that all of them pass; empty if none of those tried.
        crc_order: byte order of that.
        crc_bytes: how many bytes it takes.
        crc_from: the first byte that it covers.
        counter: what looks like a counter, its byte counted from the sync word's end.
    """

    framing: Literal["sync", "cobs"]
    sync: bytes
    length: int
    frames: NDArray[np.uint8]
    crc: str = ""
    crc_order: str = "big"
    crc_bytes: int = 0
    crc_from: int = 0
    counter: FrameCounter | None = None

    @property
    def payload_length(self) -> int:
        """Bytes between sync word and CRC."""
        return self.length - len(self.sync) - self.crc_bytes


@dataclass(frozen=True, slots=True)
class Recognised:
    """What a stream is.

    Attributes:
        score: 0 if it is nothing that is known, 1 if it is beyond doubt.
        what: the finding; None if there is none.
        parity: of characters of 7 bits; None if characters have 8.
        printable: share of the bytes that are text.
    """

    score: float
    what: TextLines | BinaryFrames | None = None
    parity: Parity | None = None
    printable: float = 0.0


def recognised(data: bytes, line_errors: int = 0) -> Recognised:
    """What bytes are that came over a serial line of 8 bits without parity.

    Args:
        data: as they came, from anywhere in a frame on.
        line_errors: characters among them that the UART has found without a stop bit.
    """
    data = data[-MOST_BYTES:]
    if len(data) < LEAST_BYTES:
        return Recognised(0.0)
    parity = seven_bits(data)
    text = bytes(byte & 0x7F for byte in data) if parity else data
    printable = sum(byte in _TEXT for byte in text) / len(text)
    candidates = [Recognised(0.3 * printable**2, None, None, printable)]
    if printable >= _LEAST_PRINTABLE and (lines := text_lines(text)) is not None:
        regular = 1 - lines.other / len(lines.lines)
        score = (0.6 + 0.35 * regular) * printable + 0.05 * (lines.checksum in {"xor", "crc16"})
        candidates.append(Recognised(min(score, 1.0), lines, parity, printable))
    candidates += [
        Recognised(_score_of(frames), frames, None, printable)
        for frames in (cobs_frames(data), sync_frames(data))
        if frames is not None
    ]
    best = max(candidates, key=lambda one: one.score)
    # A few characters are cut where the port was opened; at a wrong rate many are without stop bit.
    return Recognised(
        best.score * max(0.0, 1 - 5 * line_errors / len(data)), best.what, best.parity, printable
    )


def seven_bits(data: bytes) -> Parity | None:
    """The parity of characters of 7 bits, read as 8 bits without parity; None if they do not look so.

    The eighth bit is then the parity of the others, whatever they are, and it is set in some of them.
    """
    ones = np.unpackbits(np.frombuffer(data, np.uint8)[:, None], axis=1).sum(axis=1) % 2
    high = np.frombuffer(data, np.uint8) >= 0x80
    low_text = sum(byte & 0x7F in _TEXT for byte in data) / len(data)
    if not high.any() or high.all() or low_text < _LEAST_PRINTABLE:
        return None
    if (ones == 0).mean() >= _CONSTANT:
        return "even"
    return "odd" if (ones == 1).mean() >= _CONSTANT else None


def text_lines(data: bytes) -> TextLines | None:
    """Lines of text and their columns; None if there are not even three whole lines."""
    for delimiter in (b"\n", b"\r", b";"):
        # The first piece may lack its beginning, the last its end.
        pieces = data.split(delimiter)[1:-1]
        lines = [line for piece in pieces if (line := piece.decode("ascii", "replace").strip("\r\n"))]
        if len(lines) >= 3:
            whole = data.startswith(b"#") or _first_is_whole(data, delimiter)
            if whole:
                first = data.split(delimiter)[0].decode("ascii", "replace").strip("\r\n")
                lines = [first, *lines]
            return _columns_of(lines, delimiter.decode())
    return None


def _first_is_whole(data: bytes, delimiter: bytes) -> bool:
    """Whether the first line is a header: words, where the others are numbers."""
    first = data.split(delimiter)[0].decode("ascii", "replace").strip("\r\n")
    rest = data.split(delimiter)[1].decode("ascii", "replace").strip("\r\n")
    separator = _separator_of([rest])
    fields = first.split(separator) if separator else [first]
    same = len(fields) == (len(rest.split(separator)) if separator else 1)
    return same and not any(_NUMBER.fullmatch(one) for one in fields) and not rest.startswith(fields[0])


def _separator_of(lines: Sequence[str]) -> str:
    """What stands between columns: the mark that most lines have as often as each other."""
    best, fewest = "", 0.0
    for separator in SEPARATORS:
        counts = Counter(len(line.split(separator)) - 1 for line in lines)
        count, agreeing = counts.most_common(1)[0]
        if count and (score := agreeing / len(lines)) > fewest + 0.1:
            best, fewest = separator, score
    return best


def _columns_of(lines: Sequence[str], delimiter: str) -> TextLines:
    checksum = _checksum_of(lines)
    plain = [_CHECKSUM.sub("", line) if checksum != "none" else line for line in lines]
    separator = _separator_of(plain[1:] or plain)
    rows = [line.split(separator) if separator else [line] for line in plain]
    width = Counter(len(row) for row in rows[1:] or rows).most_common(1)[0][0]
    header = (
        len(rows[0]) == width
        and not any(_NUMBER.fullmatch(one) for one in rows[0])
        and any(_NUMBER.fullmatch(one) for one in rows[1])
        and rows[0] != rows[1]
    )
    header &= rows[0][0] != rows[1][0]
    body = [row for row in rows[header:] if len(row) == width]
    names = [name.strip().lstrip("#").strip() for name in rows[0]] if header else []
    prefix = body[0][0].strip() if body else ""
    has_prefix = width > 1 and bool(_PREFIX.fullmatch(prefix)) and all(r[0].strip() == prefix for r in body)
    first = 1 if has_prefix else 0
    columns = [
        _column([row[k].strip() for row in body], names[k] if names else f"c{k + 1 - first}")
        for k in range(first, width)
    ]
    other = sum(len(row) != width for row in rows)
    return TextLines(
        lines, delimiter, separator, prefix if has_prefix else "", checksum, columns, header, other
    )


def _column(texts: Sequence[str], name: str) -> Column:
    if not all(_NUMBER.fullmatch(text) for text in texts):
        return Column(name, numeric=False, last=texts[-1])
    values = np.array([float(text) for text in texts])
    steps = np.diff(values)
    step = float(steps[0]) if len(steps) >= LEAST_FRAMES - 1 and (steps == steps[0]).all() else 0.0
    if not step and len(steps) >= LEAST_FRAMES and all(float(text).is_integer() for text in texts):
        # A counter that wraps once or twice still grows by the same step elsewhere.
        common, times = Counter(steps.tolist()).most_common(1)[0]
        wraps = steps[steps != common]
        step = common if common > 0 and times >= len(steps) - 2 and (wraps < 0).all() else 0.0
    grows = bool(len(steps) and (steps >= 0).all() and (steps > 0).any())
    return Column(name, True, float(values.min()), float(values.max()), step, grows, texts[-1])


def _checksum_of(lines: Sequence[str]) -> str:
    found = [match for line in lines if (match := _CHECKSUM.search(line)) is not None]
    if len(found) < 0.8 * len(lines):
        return "none"
    sums: Mapping[int, tuple[str, Callable[[bytes], int]]] = {
        2: ("xor", lambda text: reduce(xor, text, 0)),
        4: ("crc16", lambda text: binascii.crc_hqx(text, 0xFFFF)),
    }
    passed = 0
    for match in found:
        text = match.string[: match.start()].encode("ascii", "replace").lstrip(b"$!")
        passed += sums[len(match[1])][1](text) == int(match[1], 16)
    name = sums[len(found[0][1])][0]
    return name if passed >= 0.8 * len(found) else "unknown"


# Checks at the end of a frame: bytes, and the sum of what is before it.
def _reflected(polynomial: int, initial: int) -> Callable[[bytes], int]:
    """A CRC-16 that takes the least significant bit first."""
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ polynomial if crc & 1 else crc >> 1
        table.append(crc)
    return lambda data: reduce(lambda crc, byte: crc >> 8 ^ table[(crc ^ byte) & 0xFF], data, initial)


def _crc8(data: bytes) -> int:
    """CRC-8/SMBUS: polynomial 0x07."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x07) & 0xFF if crc & 0x80 else crc << 1
    return crc


CHECKS: Mapping[str, tuple[int, Callable[[bytes], int]]] = {
    "ibm-3740": (2, lambda data: binascii.crc_hqx(data, 0xFFFF)),
    "xmodem": (2, lambda data: binascii.crc_hqx(data, 0)),
    "modbus": (2, _reflected(0xA001, 0xFFFF)),
    "arc": (2, _reflected(0xA001, 0)),
    "kermit": (2, _reflected(0x8408, 0)),
    "crc-8": (1, _crc8),
    "sum-8": (1, lambda data: sum(data) & 0xFF),
    "xor-8": (1, lambda data: reduce(xor, data, 0)),
}
"""By name: bytes, and what they hold; the first two are those that the driver checks."""


def _check_of(frames: NDArray[np.uint8], sync: int) -> tuple[str, str, int, int] | None:
    """Name, byte order, bytes and begin of the check that all frames pass; None if there is none."""
    some = [frame.tobytes() for frame in frames[:_MOST_CHECKED]]
    if len(set(some)) < 3:
        return None
    for name, (size, check) in CHECKS.items():
        for begin in dict.fromkeys((sync, 0)):
            if frames.shape[1] - begin <= size:
                continue
            sums = [check(frame[begin:-size]) for frame in some]
            for order in ("big", "little"):
                ends = [int.from_bytes(frame[-size:], order) for frame in some]
                if ends == sums:
                    return name, order, size, begin
    return None


@dataclass(slots=True)
class _Periods:
    """How often bytes are the same a number of bytes later.

    Args:
        data: uint8 ``[n]``.
    """

    data: NDArray[np.uint8]
    shares: dict[int, float] = field(default_factory=dict)

    def likely(self) -> list[int]:
        """Lengths that a frame may have, the likeliest first; the shorter of two that are as likely."""
        most = min(LONGEST_FRAME, len(self.data) // LEAST_FRAMES)
        for lag in range(3, most + 1):
            self.shares[lag] = float((self.data[lag:] == self.data[:-lag]).mean())
        best = sorted(self.shares, key=lambda lag: (-round(self.shares[lag], 2), lag))
        return best[:_MOST_LAGS]


def sync_frames(data: bytes) -> BinaryFrames | None:
    """Frames of one length that begin with the same bytes; None if there are none."""
    numbers = np.frombuffer(data, np.uint8)
    best: BinaryFrames | None = None
    for length in _Periods(numbers).likely():
        found = _behind_sync(numbers, length)
        if found is not None and (best is None or _score_of(found) > _score_of(best) + 0.01):
            best = found
    if best is None:
        return None
    # Two frames in a row are as regular as one.
    for length in (part for part in range(3, best.length) if best.length % part == 0):
        found = _behind_sync(numbers, length)
        if found is not None and _score_of(found) >= _score_of(best):
            return found
    return best


def _behind_sync(numbers: NDArray[np.uint8], length: int) -> BinaryFrames | None:
    count = len(numbers) // length
    grid = numbers[: count * length].reshape(count, length)
    modes = np.array([np.bincount(column, minlength=256).argmax() for column in grid.T], np.uint8)
    constant = (grid == modes).mean(axis=0) >= _CONSTANT
    if constant.all() or not constant.any():
        return None
    sync, start = _sync_word(modes, constant)
    if not sync:
        return None
    frames = _whole(numbers, length, start, sync)
    if len(frames) < LEAST_FRAMES:
        return None
    check = _check_of(frames, len(sync))
    for shorter in range(len(sync) - 1, 0, -1) if check is None else ():
        # A length or an id may be constant, too, and the check begin in the middle of it.
        check = _check_of(frames, shorter)
        if check is not None:
            sync = sync[:shorter]
            break
    name, order, size, begin = check or ("", "big", 0, 0)
    search = CounterSearch()
    search.take(frames[:, len(sync) : length - size])
    return BinaryFrames("sync", sync, length, frames, name, order, size, begin, search.found)


def _sync_word(modes: NDArray[np.uint8], constant: NDArray[np.bool_]) -> tuple[bytes, int]:
    """The bytes in a row that tell most, of those that are the same in all frames, and where they begin.

    Args:
        modes: uint8 ``[length]``, what each place of a frame holds most often.
        constant: bool ``[length]``, where that is so in nearly all frames; not everywhere.
    """
    length = len(modes)
    best, told, begin = b"", 0, 0
    for first in np.flatnonzero(constant & ~np.roll(constant, 1)).tolist():
        run = next(k for k in range(length) if not constant[(first + k) % length])
        word = bytes(int(modes[(first + k) % length]) for k in range(run))
        # What idles and what counts far have such bytes everywhere.
        begun = word.lstrip(_IDLE)
        start, word = first + len(word) - len(begun), begun.rstrip(_IDLE)[:LONGEST_SYNC]
        if (tells := sum(byte not in _IDLE for byte in word)) > told:
            best, told, begin = word, tells, start % length
    return best, begin


def _whole(numbers: NDArray[np.uint8], length: int, start: int, sync: bytes) -> NDArray[np.uint8]:
    count = (len(numbers) - start) // length
    frames = numbers[start : start + count * length].reshape(count, length)
    whole: NDArray[np.uint8] = frames[(frames[:, : len(sync)] == np.frombuffer(sync, np.uint8)).all(axis=1)]
    return whole


def cobs_frames(data: bytes) -> BinaryFrames | None:
    """COBS frames of one length with a zero byte behind each; None if there are none."""
    pieces = [piece for piece in data.split(b"\0")[1:-1] if piece]
    if len(pieces) < LEAST_FRAMES:
        return None
    bodies: list[bytes] = []
    for piece in pieces:
        try:
            bodies.append(cobs.decode(piece))
        except cobs.DecodeError:
            continue
    if len(bodies) < 0.95 * len(pieces):
        return None
    length, times = Counter(map(len, bodies)).most_common(1)[0]
    if times < 0.9 * len(bodies) or length < 3:
        return None
    frames = np.array([list(body) for body in bodies if len(body) == length], np.uint8)
    name, order, size, begin = _check_of(frames, 0) or ("", "big", 0, 0)
    search = CounterSearch()
    search.take(frames[:, : length - size])
    return BinaryFrames("cobs", b"", length, frames, name, order, size, begin, search.found)


def _score_of(frames: BinaryFrames) -> float:
    """How sure it is that these are frames: a check that all pass is proof."""
    if frames.crc_bytes == 2:
        return 1.0
    if frames.crc:
        return 0.9
    base = 0.55 if frames.framing == "cobs" else 0.45 + 0.05 * min(len(frames.sync), 3)
    return base + (0.2 if frames.counter is not None else 0.0)
