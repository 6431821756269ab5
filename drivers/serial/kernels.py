"""Compiled loops over what a serial port brings: CRC-16, the stuffing of COBS, sync words, physical units.

Each goes over a whole batch without the interpreter and without its lock. What they compute is what
`binascii.crc_hqx` and the library `cobs` compute; those write the frames of the virtual bus, and are what the
tests compare these with.
"""

from __future__ import annotations

import binascii
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from daqsvc.kernels import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Bytes = NDArray[np.uint8]
    Places = NDArray[np.int64]

CRC_BYTES = 2
NONE, UNKNOWN = -1, -2
MOST_STRAY = 4
"""Bytes that a device may send behind each frame without a CRC: a line end, or an unknown checksum."""
AT_ONCE = 8
"""Bytes that one step of the CRC takes."""


def _crc_tables() -> NDArray[np.uint16]:
    """CRCs of each byte with 0 to 7 zero bytes behind it, uint16 ``[8, 256]``; polynomial 0x1021."""
    bytes_ = [bytes([value]) for value in range(256)]
    rows = [[binascii.crc_hqx(byte + bytes(zeros), 0) for byte in bytes_] for zeros in range(AT_ONCE)]
    return np.array(rows, np.uint16)


_TABLES = _crc_tables()


@njit(cache=True, nogil=True, error_model="numpy")
def crc16(buffer: Bytes, start: int, stop: int, initial: int) -> int:
    """The CRC-16 of a stretch of bytes, polynomial 0x1021, most significant bit first.

    Eight bytes to a step: their tables are looked up independently of each other.
    (M. Kounavis and F. Berry, Novel Table Lookup-Based Algorithms for High-Performance CRC Generation,
    IEEE Trans. Computers 57, 2008.)

    Args:
        buffer: uint8.
        start: of the stretch.
        stop: one past its end.
        initial: what the CRC begins with.
    """
    crc = np.uint16(initial)
    at = start
    while at + AT_ONCE <= stop:
        crc = (
            _TABLES[7, buffer[at] ^ (crc >> 8)]
            ^ _TABLES[6, buffer[at + 1] ^ (crc & 0xFF)]
            ^ _TABLES[5, buffer[at + 2]]
            ^ _TABLES[4, buffer[at + 3]]
            ^ _TABLES[3, buffer[at + 4]]
            ^ _TABLES[2, buffer[at + 5]]
            ^ _TABLES[1, buffer[at + 6]]
            ^ _TABLES[0, buffer[at + 7]]
        )
        at += AT_ONCE
    while at < stop:
        crc = np.uint16((crc & 0xFF) << 8) ^ _TABLES[0, (crc >> 8) ^ buffer[at]]
        at += 1
    return int(crc)


@njit(cache=True, nogil=True, error_model="numpy")
def _matches(buffer: Bytes, start: int, length: int, initial: int, swap: bool) -> bool:  # noqa: FBT001 - numba
    """Whether a body ends with its CRC, high byte first unless ``swap``."""
    if length < CRC_BYTES:
        return False
    end = start + length - CRC_BYTES
    first, second = np.int64(buffer[end]), np.int64(buffer[end + 1])
    sent = second << 8 | first if swap else first << 8 | second
    return bool(crc16(buffer, start, end, initial) == sent)


@njit(cache=True, nogil=True, error_model="numpy")
def crcs_match(buffer: Bytes, starts: Places, lengths: Places, initial: int, swap: bool) -> NDArray[np.bool_]:  # noqa: FBT001 - numba
    """Which bodies end with their CRC.

    Args:
        buffer: uint8, with the bodies in it.
        starts: int64 ``[n]``, where each begins.
        lengths: int64 ``[n]``, CRC included; negative for what is none.
        initial: what the CRC begins with.
        swap: whether its low byte comes first.

    Returns:
        bool ``[n]``.
    """
    intact = np.empty(len(starts), np.bool_)
    for k in range(len(starts)):
        intact[k] = _matches(buffer, starts[k], lengths[k], initial, swap)
    return intact


@njit(cache=True, nogil=True, error_model="numpy")
def unstuff(buffer: Bytes, starts: Places, stops: Places) -> Places:
    """Take the stuffing out of COBS pieces in place; the body of each then begins at its start + 1.

    A code tells how far the next one is, and stands where a zero was, so most codes just become that zero.
    Only one of 0xFF represents no byte; what is behind the next code then moves up by one.

    Args:
        buffer: uint8, with the pieces in it; changed.
        starts: int64 ``[n]``, where each piece begins, with a code.
        stops: int64 ``[n]``, where the delimiter behind it stands, after one byte at least.

    Returns:
        int64 ``[n]``, bytes of each body; -1 where the codes point past the end.
    """
    lengths = np.empty(len(starts), np.int64)
    for k in range(len(starts)):
        at, stop = starts[k], stops[k]
        code = buffer[at]
        written = run = at + 1  # the bytes from `run` on belong at `written`
        while at + code < stop:
            at += code
            following = buffer[at]
            if code == 0xFF:
                written = _move_up(buffer, run, at, written)
                run = at + 1
            else:
                buffer[at] = 0
            code = following
        written = _move_up(buffer, run, stop, written)
        lengths[k] = written - starts[k] - 1 if at + code == stop else -1
    return lengths


@njit(cache=True, nogil=True, error_model="numpy")
def _move_up(buffer: Bytes, start: int, stop: int, to: int) -> int:
    """Move a stretch of bytes towards the front; returns where it ends then."""
    if to != start:
        for k in range(stop - start):
            buffer[to + k] = buffer[start + k]
    return to + stop - start


@njit(cache=True, nogil=True, error_model="numpy")
def gather(buffer: Bytes, starts: Places, length: int) -> Bytes:
    """Stretches of one length, uint8 ``[n, length]``, that begin at ``starts`` (int64 ``[n]``)."""
    rows = np.empty((len(starts), length), np.uint8)
    for k in range(len(starts)):
        for i, byte in enumerate(buffer[starts[k] : starts[k] + length]):
            rows[k, i] = byte
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def scaled(raw: NDArray[Any], scale: NDArray[np.float64], offset: NDArray[np.float64]) -> NDArray[np.float32]:
    """Raw numbers ``[n, fields]`` in physical units, float32 ``[n, fields]``; see `FrameLayout.decode`."""
    values = np.empty(raw.shape, np.float32)
    for k in range(raw.shape[0]):
        for i in range(raw.shape[1]):
            values[k, i] = np.float64(raw[k, i]) * scale[i] + offset[i]
    return values


class SyncSearch(NamedTuple):
    """How far the search for sync words has come.

    Attributes:
        taken: what is before this is in a frame, or counted.
        tried: where the next sync word may begin.
        fresh: whether no frame has been found yet.
        astray: whether the last thing seen was no frame.
        stray: bytes that the device sends behind each frame without a CRC, before the next sync word.
    """

    taken: int = 0
    tried: int = 0
    fresh: bool = True
    astray: bool = False
    stray: int = 0


class Hunted(NamedTuple):
    """What the hunt for sync words found.

    Attributes:
        starts: int64 ``[n]``, where the body of each frame begins.
        ends: int64 ``[n]``, where it ends.
        intact: bool ``[n]``, False for a corrupt frame in the place where one is due.
        step: where the hunt stands.
        garbage_bytes: bytes that belong to no frame.
        malformed: stretches of them.
        resyncs: how often a frame was found again after one.
    """

    starts: Places
    ends: Places
    intact: NDArray[np.bool_]
    step: SyncSearch
    garbage_bytes: int
    malformed: int
    resyncs: int


@njit(cache=True, nogil=True, error_model="numpy")
def _stands_at(buffer: Bytes, word: Bytes, at: int) -> bool:
    """Whether a word is in the buffer, whole, at a place."""
    if not 0 <= at <= len(buffer) - len(word):
        return False
    for k in range(len(word)):  # noqa: SIM110 - numba
        if buffer[at + k] != word[k]:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _stray_behind(buffer: Bytes, word: Bytes, lengths: Places, end: int, known: int) -> int:
    """How many stray bytes are behind a frame without a CRC, before the next sync word.

    A byte that was put into one frame is told from them by the next frame: it has none.

    Args:
        buffer: uint8.
        word: uint8, the sync word.
        lengths: see `hunt`.
        end: of the frame; a sync word is the least that the buffer has behind it.
        known: how many have been found before; 0 if none.

    Returns:
        0 if the sync word is right behind it; `NONE` if none is there, `UNKNOWN` before more bytes have come.
    """
    if _stands_at(buffer, word, end):
        return 0
    if end + MOST_STRAY + len(word) > len(buffer):
        return UNKNOWN
    if known and _stands_at(buffer, word, end + known):
        return known
    for count in range(1, MOST_STRAY + 1):
        start = end + count + len(word)
        length = lengths[buffer[start]] if start < len(buffer) else 0
        if length < 0 or not _stands_at(buffer, word, end + count):
            continue
        following = start + length
        if following + count + len(word) > len(buffer):
            return UNKNOWN
        if _stands_at(buffer, word, following + count) and not _stands_at(buffer, word, following):
            return count
    return NONE


@njit(cache=True, nogil=True, error_model="numpy")
def hunt(
    buffer: Bytes,
    word: Bytes,
    lengths: Places,
    limits: tuple[int, int],
    initial: int,
    swap: bool,  # noqa: FBT001 - numba
    step: SyncSearch,
) -> Hunted:
    """Find the frames behind sync words.

    A frame counts if its CRC matches, or, where there is none, once the next sync word stands right behind
    it, or behind as many stray bytes as the frame after it has. Every sync word is tried in turn. One with no
    frame behind it, in the place where a frame is due, is a corrupt frame, and may have a good one inside,
    if bytes are missing.

    Args:
        buffer: uint8.
        word: uint8, the sync word.
        lengths: int64 ``[256]``, bytes of a body by its first byte; negative if there is no such body.
        limits: bytes of the shortest body and of the longest.
        initial: what the CRC begins with; negative if there is none.
        swap: whether its low byte comes first.
        step: where the last hunt ended, in places of this buffer.
    """
    taken, at, fresh, astray, stray = step
    resume = at
    garbage_bytes = malformed = resyncs = 0
    follows = len(word) if initial < 0 else 0
    # A corrupt frame and a good one inside it are all that can overlap: each good one ends before the next.
    shortest, longest = limits
    most = 2 * (len(buffer) // (len(word) + shortest)) + 2
    starts, ends = np.empty(most, np.int64), np.empty(most, np.int64)
    intact = np.empty(most, np.bool_)
    n = 0
    while at + len(word) < len(buffer):
        length = lengths[buffer[at + len(word)]]
        if buffer[at] != word[0] or length < 0 or not _stands_at(buffer, word, at):
            at += 1
            continue
        start = at + len(word)
        end = start + length
        if end + follows > len(buffer):
            break
        if initial < 0:
            behind = _stray_behind(buffer, word, lengths, end, stray)
            if behind == UNKNOWN:
                break
            good = behind >= 0
            # None behind a good frame: those that were seen before were damage, and would hide more of it.
            stray = behind if good else stray
        else:
            good = _matches(buffer, start, length, initial, swap)
        due = at == taken and not fresh and not astray
        if good:
            if at > taken:
                garbage_bytes += at - taken
                malformed += not fresh and not astray
                astray |= not fresh
            resyncs += astray
            fresh = astray = False
            resume = end
        if good or due:
            starts[n], ends[n], intact[n] = start, end, good
            n += 1
            taken = end
        at = end if good else at + 1
    else:
        # No sync word with a byte behind it is left; the last bytes may begin one.
        at = max(resume, len(buffer) - len(word) + 1 - _stands_at(buffer, word, len(buffer) - len(word)))
    if at - taken > 2 * (len(word) + longest):
        garbage_bytes += at - taken
        malformed += not fresh and not astray
        astray |= not fresh
        taken = at
    bodies = starts[:n].copy(), ends[:n].copy(), intact[:n].copy()
    return Hunted(
        bodies[0],
        bodies[1],
        bodies[2],
        SyncSearch(taken, at, fresh, astray, stray),
        garbage_bytes,
        malformed,
        resyncs,
    )
