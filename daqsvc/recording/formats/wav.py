"""WAV files: linear PCM and IEEE float (Multimedia Programming Interface and Data Specifications 1.0).

Read here and not by a library: those at hand leave out float or extensible formats, and take a file that
is cut short for a whole one.
"""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from daqsvc.errors.recordings import DAMAGED, UNKNOWN_FORMAT
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import (
    LONGEST_NAME,
    LONGEST_TEXT,
    STATED_START,
    WAV_SCHEMA,
    Contents,
    check_columns,
)

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.confined.limits import Budget

    Floats: TypeAlias = NDArray[np.float64]

PCM = 1
FLOAT = 3
EXTENSIBLE = 0xFFFE
"""The format itself is in the first two bytes of the sub-format's GUID."""
SUBFORMAT_AT = 24

ENCODINGS = {PCM: (8, 16, 24, 32), FLOAT: (32, 64)}


def read_wav(path: Path, budget: Budget) -> Contents:
    """Channels "0", "1", ..., integers scaled to a full scale of 1; and ``rate_hz``."""
    content = path.read_bytes()
    chunks = _chunks(path, content)
    missing = [name for name in ("fmt ", "data") if name not in chunks]
    if missing:
        raise RecordingError(
            f"{path} cannot be read: it has no {missing[0].strip()!r} chunk; it is cut short or empty, "
            "and has to be copied or saved again",
            DAMAGED,
        )
    encoding, bits, channels, rate_hz = _format(path, chunks["fmt "])
    data = chunks["data"]
    frame_bytes = channels * bits // 8
    if len(data) % frame_bytes:
        raise RecordingError(
            f"{path} cannot be read: its {len(data)} bytes of samples are no whole number of frames of "
            f"{frame_bytes} bytes; copy or save it again",
            DAMAGED,
        )
    check_columns(channels)
    budget.check_declared(len(data) * 64.0 / bits)
    samples = _decoded(data, encoding, bits).reshape(-1, channels)
    names, units, start = _of_comment(chunks.get("LIST", memoryview(b"")), channels)
    entries: dict[str, NDArray[np.generic]] = {name: samples[:, i] for i, name in enumerate(names)}
    entries |= {"rate_hz": np.array(rate_hz)} | ({STATED_START: np.array(start)} if start else {})
    return Contents(entries, is_table=True, units=units)


def _of_comment(info: memoryview, channels: int) -> tuple[list[str], dict[str, str], str]:
    """Names and units of the channels and the begin, where `daqsvc export` has written a comment of them."""
    names = [str(i) for i in range(channels)]
    body = bytes(info)
    if body[:4] != b"INFO" or body[4:8] != b"ICMT":
        return names, {}, ""
    try:
        comment: dict[str, Any] = json.loads(body[12:].split(b"\0", 1)[0])
        stated = [str(name)[:LONGEST_TEXT] for name in comment["channels"]]
        units = [str(unit)[:LONGEST_NAME] for unit in comment["units"]]
        start = str(comment["start_time"] or "")[:LONGEST_TEXT]
        is_ours = (
            comment["schema"] == WAV_SCHEMA and len(stated) == len(set(stated)) == len(units) == channels
        )
    except (ValueError, KeyError, TypeError, RecursionError):
        return names, {}, ""
    if not is_ours or {"rate_hz", STATED_START} & set(stated):
        return names, {}, ""
    return stated, {name: unit for name, unit in zip(stated, units, strict=True) if unit}, start


def _chunks(path: Path, content: bytes) -> dict[str, memoryview]:
    """The first chunk of each name in a RIFF file."""
    if content[:4] != b"RIFF" or content[8:12] != b"WAVE":
        kind = repr(content[:4]) if content else "nothing"
        raise RecordingError(
            f"{path} is not a WAV file: it begins with {kind}, not with RIFF; "
            "save it as WAV (not RF64 or RIFX)",
            UNKNOWN_FORMAT,
        )
    chunks: dict[str, memoryview] = {}
    view, at = memoryview(content), 12
    while at + 8 <= len(content):
        tag, size = struct.unpack_from("<4sI", content, at)
        body = view[at + 8 : at + 8 + size]
        if len(body) < size:
            raise RecordingError(
                f"{path} is cut short: its {tag.decode('latin-1').strip()!r} chunk should have {size} bytes "
                f"and has {len(body)}; copy or save it again",
                DAMAGED,
            )
        chunks.setdefault(tag.decode("latin-1"), body)
        at += 8 + size + size % 2
    return chunks


def _format(path: Path, chunk: memoryview) -> tuple[int, int, int, int]:
    """Encoding, bits per sample, channels, and samples per second."""
    encoding, channels, rate_hz, _, frame_bytes, bits = struct.unpack_from("<HHIIHH", chunk)
    if encoding == EXTENSIBLE:
        (encoding,) = struct.unpack_from("<H", chunk, SUBFORMAT_AT)
    if bits not in ENCODINGS.get(encoding, ()):
        raise RecordingError(
            f"{path} has {bits}-bit samples of WAV format {encoding}; save it as PCM of 8, 16, 24 or 32 "
            "bits, or as float of 32 or 64 bits",
            UNKNOWN_FORMAT,
        )
    if frame_bytes != channels * bits // 8 or not channels:
        raise RecordingError(
            f"{path} cannot be read: {channels} channels of {bits} bits do not make frames of {frame_bytes} "
            "bytes; copy or save it again",
            DAMAGED,
        )
    return encoding, bits, channels, rate_hz


def _decoded(data: memoryview, encoding: int, bits: int) -> NDArray[np.floating]:
    """Samples of all channels in turn."""
    if encoding == FLOAT:
        with np.errstate(invalid="ignore"):  # signalling NaN
            return np.frombuffer(data, f"<f{bits // 8}")
    # Integers of up to 24 bits are float32 without rounding.
    if bits == 8:
        samples = np.frombuffer(data, np.uint8).astype(np.float32)
        samples -= 128.0
        samples /= 128.0
        return samples
    if bits == 24:
        # As the upper three bytes of 32 bits.
        widened = np.zeros((len(data) // 3, 4), np.uint8)
        widened[:, 1:] = np.frombuffer(data, np.uint8).reshape(-1, 3)
        samples = widened.view("<i4").ravel().astype(np.float32)
        samples /= 2.0**31
        return samples
    samples = np.frombuffer(data, f"<i{bits // 8}").astype(np.float32 if bits == 16 else np.float64)
    samples /= 2.0 ** (bits - 1)
    return samples
