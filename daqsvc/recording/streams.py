"""Samples of a stream as files hold them: evenly spaced, NaN where some are missing, and from when on."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from daqsvc.errors.recordings import DAMAGED
from daqsvc.recording import RecordingError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from daqsvc.acquisition.samples import SampleBlock

    Samples: TypeAlias = NDArray[np.float64] | NDArray[np.float32]

NS_PER_S = 1_000_000_000
FIRST_NS, LAST_NS = -9_214_560_000_000_000_000, 9_214_646_400_000_000_000
"""Wall times of the years 1678 to 2261: what a count of nanoseconds in 64 bits holds in whole years."""
PIECE_VALUES = 1 << 22
"""Samples times channels that are evaluated together."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_WRITTEN = re.compile(
    r"(?P<second>\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d)(?:[.,](?P<part>\d{1,9})\d*)?\s*"
    r"(?P<zone>Z|[+-]\d\d:?\d\d)?"
)


class LongGapsError(Exception):
    """A stream lacks so many samples that its gaps are no gaps any more; states how many."""


@dataclass(frozen=True, slots=True)
class RecordedStream:
    """Channels that were sampled together.

    Attributes:
        name: of the stream.
        rate_hz: samples per second, as the machine file or the recording states.
        names: of the channels: those of the sensors where there are any.
        units: of the channels; empty where none is stated.
        samples: float ``[n, channels]`` in these units; NaN where samples are missing.
        start_ns: wall time of the first sample, ns since the Unix epoch; None if not stated.
        measured_hz: samples per second by the clock of the box; None if it was not measured.
    """

    name: str
    rate_hz: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    samples: Samples
    start_ns: int | None = None
    measured_hz: float | None = None

    @property
    def start(self) -> str:
        """`start_ns` as ISO 8601 with nine decimals; empty if it is not known."""
        return "" if self.start_ns is None else iso_ns(self.start_ns)

    def missing(self) -> int:
        """Samples that are NaN in at least one channel."""
        return int(sum(np.isnan(piece).any(axis=1).sum() for piece in self.pieces(self.piece_rows())))

    def piece_rows(self, values: int = PIECE_VALUES) -> int:
        """Rows of a piece that holds so many values at most: with many channels, fewer; one at least."""
        return max(1, values // max(1, len(self.names)))

    def pieces(self, rows: int) -> Sequence[Samples]:
        """The samples, so many rows at a time."""
        return [self.samples[k : k + rows] for k in range(0, len(self.samples), rows)]

    def times_ns(self, first: int, count: int) -> NDArray[np.int64]:
        """When samples were taken by `rate_hz`, ns after the first of all, or wall time where that is known.

        Args:
            first: number of the first of them, from 0.
            count: how many.
        """
        steps = np.arange(first, first + count, dtype=np.float64) * (NS_PER_S / self.rate_hz)
        return np.rint(steps).astype(np.int64) + (self.start_ns or 0)


def checked(stream: RecordedStream, recording: str) -> tuple[RecordedStream, list[str]]:
    """A stream as any format can take it, as files may state what they like.

    Args:
        stream: as it was read.
        recording: what it was read from, for messages.

    Returns:
        The stream, its names unique and its texts without control characters and lone surrogates, without a
        begin where no count of nanoseconds holds it. And notes on what is not as it was, in sentences.

    Raises:
        RecordingError: its names, units and samples do not belong together, or its rate is none.
    """
    channels = stream.samples.shape[1] if stream.samples.ndim == 2 else 0
    if not channels or not len(stream.names) == len(stream.units) == channels:
        raise RecordingError(
            f"{recording} cannot be read: stream {printable(stream.name):.80} has {len(stream.names)} names "
            f"and {len(stream.units)} units of {channels} channels; it may be damaged: copy it again",
            DAMAGED,
        )
    if not 0.0 < stream.rate_hz < np.inf or len(stream.samples) / stream.rate_hz > LAST_NS / NS_PER_S:
        raise RecordingError(
            f"{recording} cannot be read: stream {printable(stream.name):.80} is stated to have "
            f"{stream.rate_hz!r} samples a second; it may be damaged: copy it again",
            DAMAGED,
        )
    notes = []
    start_ns, length_ns = stream.start_ns, round(len(stream.samples) / stream.rate_hz * NS_PER_S)
    if start_ns is not None and not FIRST_NS <= start_ns <= LAST_NS - length_ns:
        start_ns = None
        notes.append(
            f"{recording} states a begin outside of the years 1678 to 2261, and it is left out; check the "
            "clock"
        )
    measured_hz = stream.measured_hz
    if measured_hz is not None and not 0.0 < measured_hz < np.inf:
        measured_hz = None
    names = unique([printable(name) for name in stream.names])
    units = [printable(unit) for unit in stream.units]
    notes += [
        f"the name of a channel of {recording} is taken or no text, and written as {new}"
        for old, new in zip(stream.names, names, strict=True)
        if old != new
    ]
    return replace(
        stream,
        name=printable(stream.name),
        names=tuple(names),
        units=tuple(units),
        start_ns=start_ns,
        measured_hz=measured_hz,
    ), notes


def unique(names: Sequence[str], taken: Iterable[str] = ()) -> list[str]:
    """Names with a number behind those that came before, or are taken."""
    used, left = set(taken), Counter(names)
    made = []
    for name in names:
        one, number = name, 1
        left[name] -= 1
        while one in used or (one != name and left[one]):
            number += 1
            one = f"{name}_{number}"
        used.add(one)
        made.append(one)
    return made


def printable(text: str) -> str:
    """Text that every file and terminal takes: control characters and lone surrogates as escapes."""
    return "".join(
        ascii(letter)[1:-1] if unicodedata.category(letter) in {"Cc", "Cs"} else letter for letter in text
    )


def of_blocks(blocks: Sequence[SampleBlock], most_stretched: int) -> tuple[NDArray[np.float32], int, float]:
    """The samples of a stream in their places.

    Args:
        blocks: of one stream, in order.
        most_stretched: how many times as long as its samples a stream may be with its gaps.

    Returns:
        Samples ``[n, channels]``; monotonic time of the first, ns; time between two by the time base, ns.

    Raises:
        LongGapsError: it is longer.
    """
    origin = blocks[0].first_index
    end = max(block.end_index for block in blocks)
    there = sum(len(block.samples) for block in blocks)
    if end - origin > most_stretched * max(there, 1):
        raise LongGapsError(f"lacks {end - origin - there:,} of {end - origin:,} samples")
    samples = np.full((end - origin, blocks[0].samples.shape[1]), np.nan, np.float32)
    for block in blocks:
        at = block.first_index - origin
        if at >= 0 and block.samples.shape[1] == samples.shape[1]:
            samples[at : at + len(block.samples)] = block.samples
    # The block whose time is known best; of several the last, as the time base learns.
    best = min(reversed(blocks), key=lambda block: block.t_error_ns)
    return samples, round(best.t_first_ns - (best.first_index - origin) * best.period_ns), best.period_ns


def iso_ns(t_ns: int) -> str:
    """Wall time with all its nanoseconds: ``2026-11-23T14:58:31.123456789Z``."""
    seconds, part = divmod(t_ns, NS_PER_S)
    return f"{_EPOCH + timedelta(seconds=seconds):%Y-%m-%dT%H:%M:%S}.{part:09d}Z"


def ns_of_iso(text: str) -> int | None:
    """Wall time of an ISO 8601 text, ns since the Unix epoch; UTC if it names no zone, None if it is none."""
    written = _WRITTEN.fullmatch(text.strip())
    if written is None:
        return None
    zone = "+00:00" if written["zone"] in {None, "Z"} else written["zone"]
    try:
        second = datetime.fromisoformat(f"{written['second']}{zone}")
    except ValueError:
        return None
    since = second - _EPOCH
    part_ns = int((written["part"] or "").ljust(9, "0"))
    return (since.days * 86_400 + since.seconds) * NS_PER_S + part_ns
