"""WAV: float32 samples in the units of the sensors, as they are: 1.0 in the file is one um, one m/s2, one V.

SciPy's writer takes all samples at once and writes no comment, in which names and units are.
"""

from __future__ import annotations

import json
import struct
from typing import TYPE_CHECKING, Literal, NotRequired, TypedDict

import numpy as np

from daqsvc.errors.recordings import NOT_HELD
from daqsvc.recording import RecordingError
from daqsvc.recording.contents import WAV_SCHEMA
from daqsvc.recording.writers.gaps import filled, notes_on_gaps

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from daqsvc.recording.streams import RecordedStream

IEEE_FLOAT = 3
MOST_BYTES = 2**32 - 1
"""The size of a file and its samples has 32 bits."""
MOST_CHANNELS = 2**16 - 1
MOST_RATE_BYTES = 2**32 - 1
"""The bytes of a second, too."""
_WHOLE = 1e-9


def write_wav(path: Path, streams: Sequence[RecordedStream], about: Mapping[str, str]) -> list[str]:
    """Write one stream; a missing sample is 0, as a NaN ends most players.

    Returns:
        How many samples are 0 that were missing, infinite or beyond float32, in sentences.

    Raises:
        RecordingError: the rate is no whole number of Hz, or rate or samples are more than a WAV file holds.
    """
    (stream,) = streams
    rate_hz, channels = round(stream.rate_hz), len(stream.names)
    if rate_hz < 1 or abs(stream.rate_hz / rate_hz - 1.0) > _WHOLE:
        raise RecordingError(
            f"stream {stream.name} has {stream.rate_hz!r} samples a second, and a WAV file holds whole "
            "numbers only; write .parquet, .mf4 or .mat, or another stream alone with --stream",
            NOT_HELD,
        )
    if 4 * channels * rate_hz > MOST_RATE_BYTES:
        raise RecordingError(
            f"stream {stream.name} has {stream.rate_hz:g} samples a second of {channels} channels, and a WAV "
            "file holds 4.29 GB a second at most; write .parquet, .mf4 or .mat",
            NOT_HELD,
        )
    data_bytes = 4 * channels * len(stream.samples)
    comment = _comment(stream, about)
    head = _head(rate_hz, channels, len(stream.samples), comment)
    if len(head) + data_bytes > MOST_BYTES or channels > MOST_CHANNELS:
        raise RecordingError(
            f"stream {stream.name} has {data_bytes / 1e9:.3g} GB of samples, and a WAV file holds 4.29; "
            "write .parquet or .mf4",
            NOT_HELD,
        )
    infinite = 0
    with path.open("wb") as file:
        # Where the samples of a file have an odd size a byte comes behind; of four bytes each they have not.
        file.write(b"RIFF" + struct.pack("<I", len(head) + data_bytes - 8) + head[8:])
        for piece in stream.pieces(stream.piece_rows()):
            finite, replaced = filled(piece, np.float32)
            file.write(finite.data)
            infinite += replaced
    return notes_on_gaps(path, streams, "WAV", [infinite])


class WavComment(TypedDict):
    """The comment `ICMT` in a WAV file of `daqsvc export`; after these keys come texts of the recording.

    Attributes:
        schema: what the comment is, and of which version.
        stream: name of the stream.
        channels: names of the channels, in the order of the file.
        units: unit of each channel; empty if it is not known.
        start_time: time of the first sample, ISO 8601; null if it is not known.
        scale: what a sample of 1.0 is.
        recording: name of the file that was exported.
        written_by: program and version.
        site: the site, if the recording states it.
        box: the box, if the recording states it.
        machine: the machine, if the recording states it.
    """

    schema: Literal["daqsvc.wav/1"]
    stream: str
    channels: list[str]
    units: list[str]
    start_time: str | None
    scale: str
    recording: NotRequired[str]
    written_by: NotRequired[str]
    site: NotRequired[str]
    box: NotRequired[str]
    machine: NotRequired[str]


def _comment(stream: RecordedStream, about: Mapping[str, str]) -> bytes:
    document: WavComment = {
        "schema": WAV_SCHEMA,
        "stream": stream.name,
        "channels": list(stream.names),
        "units": list(stream.units),
        "start_time": stream.start or None,
        "scale": "1.0 is one unit",
    }
    return json.dumps({**document, **about}).encode("ascii") + b"\0"


def _head(rate_hz: int, channels: int, samples: int, comment: bytes) -> bytes:
    """All chunks up to the first sample; the size of the file is not in yet."""
    form = struct.pack("<HHIIHHH", IEEE_FLOAT, channels, rate_hz, 4 * channels * rate_hz, 4 * channels, 32, 0)
    info = b"INFO" + _chunk(b"ICMT", comment)
    return (
        b"RIFF\0\0\0\0WAVE"
        + _chunk(b"fmt ", form)
        + _chunk(b"fact", struct.pack("<I", samples))
        + _chunk(b"LIST", info)
        + b"data"
        + struct.pack("<I", 4 * channels * samples & MOST_BYTES)
    )


def _chunk(name: bytes, body: bytes) -> bytes:
    return name + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2)
