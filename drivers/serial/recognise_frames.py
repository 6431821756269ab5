"""Binary frames of one length in a stream of bytes: behind a sync word, or in COBS, with noise among them.

Frames are found by what they have in common, not by counting bytes from the first one: bytes that are lost
or added move the frames behind them. A check that most of them pass is proof.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from cobs import cobs

from drivers.counter_search import counter_between
from drivers.serial.checksums import CHECKSUMS

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from drivers.counter_search import FrameCounter

LEAST_FRAMES = 6
LONGEST_FRAME = 1024
LONGEST_SYNC = 8

_CONSTANT = 0.95
"""Bytes that are the same in so many frames belong to the sync word."""
_MOST_LAGS = 12
_MOST_ANCHORS = 3
_MOST_CHECKED = 64
_MOST_WORDS = 4
_LEAST_PASSING = {1: 0.8, 2: 0.5}
"""Share of the frames that must pass a check, by its bytes: by chance, one in 256 or one in 65536 does."""
_ORDERS: tuple[Literal["big", "little"], ...] = ("big", "little")
_IDLE = b"\x00\xff"


@dataclass(frozen=True, slots=True)
class BinaryFrames:
    """Binary frames of one length.

    Attributes:
        framing: "sync" or "cobs".
        sync: the bytes that each begins with; none with COBS.
        length: bytes of a frame, with sync word and CRC, without the delimiter of COBS.
        frames: how many came whole, uint8 ``[n, length]``; of COBS they are decoded.
        damaged: how many came that do not pass the check, or cannot be decoded.
        bytes_per_frame: bytes from frame to frame on average, what lies between them included.
        coverage: share of the bytes that belong to frames, from the first of them to the last.
        crc: name of the check at the end that most of them pass; empty if none of those tried.
        crc_order: byte order of that.
        crc_bytes: how many bytes it takes.
        crc_from: the first byte that it covers.
        counter: what looks like a counter, its byte counted from the sync word's end.
    """

    framing: Literal["sync", "cobs"]
    sync: bytes
    length: int
    frames: NDArray[np.uint8]
    damaged: int = 0
    bytes_per_frame: float = 0.0
    coverage: float = 1.0
    crc: str = ""
    crc_order: str = "big"
    crc_bytes: int = 0
    crc_from: int = 0
    counter: FrameCounter | None = None

    @property
    def payload_length(self) -> int:
        """Bytes between sync word and CRC."""
        return self.length - len(self.sync) - self.crc_bytes

    @property
    def passing(self) -> float:
        """Share of the frames that are not damaged."""
        return len(self.frames) / (len(self.frames) + self.damaged)

    @property
    def score(self) -> float:
        """How sure it is that these are frames, 0 to 1: a check that they pass is proof."""
        if self.crc_bytes == 2:
            return 0.9 + 0.1 * self.passing
        if self.crc:
            return 0.9 * self.passing
        base = 0.55 if self.framing == "cobs" else 0.45 + 0.05 * min(len(self.sync), 3)
        return (base + (0.2 if self.counter is not None else 0.0)) * self.coverage * self.passing


@dataclass(frozen=True, slots=True)
class _Check:
    """A checksum at the end of frames: name in `CHECKSUMS`, byte order, and the first byte that it covers."""

    name: str = ""
    order: Literal["big", "little"] = "big"
    begin: int = 0

    @property
    def size(self) -> int:
        """How many bytes it takes."""
        return CHECKSUMS[self.name].size if self.name else 0

    def passed(self, frames: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which frames (uint8 ``[n, length]``) pass it, bool ``[n]``; all, if it is none."""
        if not self.name:
            return np.ones(len(frames), np.bool_)
        expected = CHECKSUMS[self.name].of(frames[:, self.begin : -self.size])
        passed: NDArray[np.bool_] = expected == _numbers(frames[:, -self.size :], self.order)
        return passed


def _numbers(ends: NDArray[np.uint8], order: Literal["big", "little"]) -> NDArray[np.int64]:
    """The last bytes of frames, uint8 ``[n, 1 or 2]``, as numbers, int64 ``[n]``."""
    wide = ends.astype(np.int64)
    if order == "little":
        wide = wide[:, ::-1]
    numbers: NDArray[np.int64] = wide[:, 0] if wide.shape[1] == 1 else 256 * wide[:, 0] + wide[:, 1]
    return numbers


def _check_of(frames: NDArray[np.uint8], sync: int) -> _Check | None:
    """The check that most frames pass; None if there is none."""
    frames = frames[:_MOST_CHECKED]
    if _kinds(frames) < 3:
        return None
    for name, checksum in CHECKSUMS.items():
        size = checksum.size
        for begin in dict.fromkeys((sync, 0)):
            if frames.shape[1] - begin <= size:
                continue
            expected = checksum.of(frames[:, begin:-size])
            for order in _ORDERS[:size]:
                passed = expected == _numbers(frames[:, -size:], order)
                # Frames that are all alike show nothing: what they end with may be a constant.
                if passed.mean() >= _LEAST_PASSING[size] and _kinds(frames[passed]) >= 3:
                    return _Check(name, order, begin)
    return None


def _kinds(frames: NDArray[np.uint8]) -> int:
    """How many different frames there are of uint8 ``[n, length]``."""
    return len({frame.tobytes() for frame in frames})


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
        candidate = _behind_sync(numbers, length)
        if candidate is not None and (best is None or candidate.score > best.score + 0.01):
            best = candidate
    if best is None:
        return None
    # Two frames in a row are as regular as one.
    for length in (part for part in range(3, best.length) if best.length % part == 0):
        candidate = _behind_sync(numbers, length)
        if candidate is not None and candidate.score >= best.score:
            return candidate
    return best


def _behind_sync(numbers: NDArray[np.uint8], length: int) -> BinaryFrames | None:
    """Frames of that length; None if there are none."""
    best: BinaryFrames | None = None
    tried: set[bytes] = set()
    for anchors in _anchors(numbers, length):
        grid = _rows(numbers, anchors, length)
        modes = np.array([np.bincount(column, minlength=256).argmax() for column in grid.T], np.uint8)
        constant = (grid == modes).mean(axis=0) >= _CONSTANT
        if constant.all() or not constant.any():
            continue
        # A value that stands still may show more than the sync word does: a check shows which is which.
        for sync in _sync_words(modes, constant):
            if sync in tried:
                continue
            tried.add(sync)
            candidate = _with_sync(numbers, length, sync)
            if candidate is not None and (best is None or candidate.score > best.score):
                best = candidate
            if best is not None and best.crc_bytes == 2:
                return best
    return best


def _anchors(numbers: NDArray[np.uint8], length: int) -> Iterator[NDArray[np.int64]]:
    """Places of the bytes, and of pairs of them, that most often come again a frame later."""
    same = numbers[length:] == numbers[:-length]
    words = numbers[:-length].astype(np.int64)
    pairs = same[:-1] & same[1:]
    for again, values in ((pairs, 256 * words[:-1] + words[1:]), (same, words)):
        counts = np.bincount(values[again], minlength=65_536)
        counts[list(_IDLE)] = 0  # as pairs, 00 00 and 00 ff
        counts[[0xFF00, 0xFFFF]] = 0
        for value in np.argsort(-counts, kind="stable")[:_MOST_ANCHORS].tolist():
            if counts[value] >= LEAST_FRAMES - 1:
                yield np.flatnonzero(again & (values == value))


def _rows(numbers: NDArray[np.uint8], places: NDArray[np.int64], length: int) -> NDArray[np.uint8]:
    """The bytes from each place on, uint8 ``[n, length]``."""
    rows: NDArray[np.uint8] = np.lib.stride_tricks.sliding_window_view(numbers, length)[places]
    return rows


def _sync_words(modes: NDArray[np.uint8], constant: NDArray[np.bool_]) -> list[bytes]:
    """Bytes in a row that are the same in all frames, those that show most first; a few of them.

    Args:
        modes: uint8 ``[length]``, what each place of a frame holds most often.
        constant: bool ``[length]``, where that is so in nearly all frames; not everywhere.
    """
    length = len(modes)
    words: list[bytes] = []
    for first in np.flatnonzero(constant & ~np.roll(constant, 1)).tolist():
        run = next(k for k in range(length) if not constant[(first + k) % length])
        word = bytes(int(modes[(first + k) % length]) for k in range(run))
        # What idles and what counts far have such bytes everywhere.
        word = word.lstrip(_IDLE).rstrip(_IDLE)[:LONGEST_SYNC]
        words += [word] * bool(word)
    return sorted(words, key=lambda word: -sum(byte not in _IDLE for byte in word))[:_MOST_WORDS]


def _with_sync(numbers: NDArray[np.uint8], length: int, sync: bytes) -> BinaryFrames | None:
    """Frames of that length behind that sync word; None if they are too few."""
    places = _places(numbers, length, sync)
    chained = places[_chained(places, length)]
    frames = _rows(numbers, chained, length)
    if len(frames) < LEAST_FRAMES:
        return None
    check = _check_of(frames, len(sync))
    for shorter in range(len(sync) - 1, 0, -1) if check is None else ():
        # A length or an id may be constant, too, and the check begin in the middle of it.
        check = _check_of(frames, shorter)
        if check is not None:
            sync = sync[:shorter]
            places = _places(numbers, length, sync)
            break
    checked = check is not None
    check = check or _Check()
    frames = _rows(numbers, places, length)
    passed = check.passed(frames)
    # A frame between two stretches of noise passes its check; else another one must be beside it.
    there = _chained(places, length) | passed if checked else _chained(places, length)
    places, frames, passed = places[there], frames[there], passed[there]
    gaps = np.diff(places)
    count = 1 + int(np.maximum(gaps // length, 1).sum())
    span = int(places[-1] - places[0]) + length
    counter = None
    whole = frames[passed]
    if len(whole) > 1:
        payloads = whole[:, len(sync) : length - check.size]
        near = np.diff(places[passed]) < 2 * length
        counter = counter_between(payloads[:-1][near], payloads[1:][near])
    return BinaryFrames(
        "sync",
        sync,
        length,
        whole,
        int((~passed).sum()),
        span / count,
        min(1.0, len(places) * length / span),
        check.name,
        check.order,
        check.size,
        check.begin,
        counter,
    )


def _places(numbers: NDArray[np.uint8], length: int, sync: bytes) -> NDArray[np.int64]:
    """Where the sync word is with a whole frame behind it, int64 ``[n]``."""
    there = np.ones(len(numbers) - length + 1, np.bool_)
    for k, byte in enumerate(sync):
        there &= numbers[k : k + len(there)] == byte
    return np.flatnonzero(there)


def _chained(places: NDArray[np.int64], length: int) -> NDArray[np.bool_]:
    """Which of the places have another one a frame before or behind, bool ``[n]``."""
    return np.isin(places + length, places) | np.isin(places - length, places)


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
            bodies.append(b"")
    length, times = Counter(map(len, filter(None, bodies))).most_common(1)[0] if any(bodies) else (0, 0)
    if times < 0.5 * len(bodies) or length < 3:
        return None
    of_length = np.array([len(body) == length for body in bodies])
    frames = np.array([list(body) for body in bodies if len(body) == length], np.uint8)
    known_check = _check_of(frames, 0)
    if known_check is None and times < 0.9 * len(bodies):
        return None
    check = known_check or _Check()
    passed = check.passed(frames)
    whole = np.flatnonzero(of_length)[passed]
    payloads = frames[passed][:, : length - check.size]
    near = np.diff(whole) == 1
    counter = counter_between(payloads[:-1][near], payloads[1:][near]) if len(whole) > 1 else None
    between = sum(map(len, pieces)) / len(pieces) + 1
    return BinaryFrames(
        "cobs",
        b"",
        length,
        frames[passed],
        len(bodies) - len(whole),
        between,
        1.0,
        check.name,
        check.order,
        check.size,
        check.begin,
        counter,
    )
