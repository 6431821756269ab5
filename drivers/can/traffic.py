"""What is on a CAN bus: of each id how often it comes, how long it is, and which of its bytes change."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from drivers.can.batches import BIT_RATE_SWITCH, ERROR, EXTENDED, EXTENDED_ID, FD, LONGEST, REMOTE, by_id
from drivers.can.checks import FrameTime, frame_time
from drivers.can.errors import ErrorCounts
from drivers.counter_search import CounterSearch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from drivers.can.batches import CanBatch
    from drivers.counter_search import FrameCounter


class Wire(NamedTuple):
    """What decides how long a frame takes."""

    length: int
    fd: bool
    switches: bool


@dataclass(slots=True)
class IdTraffic:
    """What came under one id.

    Attributes:
        frame_id: with the flags `EXTENDED` and `REMOTE`, as in `CanBatch`.
        frames: how many.
        wires: how many of each length and kind.
        last: the last payload.
        first_ns: when the first came, host monotonic.
        last_ns: when the last did.
        shortest_s: shortest time from one to the next; infinite below two frames.
        longest_s: longest one; 0 below two frames.
        changed: uint8 ``[64]``, bits that were not always the same.
    """

    frame_id: int
    frames: int = 0
    wires: Counter[Wire] = field(default_factory=Counter)
    last: bytes = b""
    first_ns: int = 0
    last_ns: int = 0
    shortest_s: float = math.inf
    longest_s: float = 0.0
    changed: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(LONGEST, np.uint8))
    _first: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(LONGEST, np.uint8))
    _first_gap_s: float | None = None
    _gap_sum: float = 0.0
    _gap_squares: float = 0.0
    _counters: CounterSearch = field(default_factory=CounterSearch)

    @property
    def arbitration_id(self) -> int:
        """The id without flags."""
        return self.frame_id & EXTENDED_ID

    @property
    def extended(self) -> bool:
        """Whether it has 29 bits."""
        return bool(self.frame_id & EXTENDED)

    @property
    def remote(self) -> bool:
        """Whether these are remote frames."""
        return bool(self.frame_id & REMOTE)

    @property
    def lengths(self) -> list[int]:
        """Payload lengths that came, in bytes; of remote frames what they ask for."""
        return sorted({wire.length for wire in self.wires})

    @property
    def kind(self) -> str:
        """In words: width of the id, and what is special about the frames."""
        words = ["29 bit" if self.extended else "11 bit"]
        words += ["remote"] * self.remote
        fd = {wire.fd for wire in self.wires}
        words += ["FD"] * (fd == {True}) + ["classic and FD"] * (fd == {True, False})
        return ", ".join(words)

    @property
    def period_s(self) -> float | None:
        """Mean time from one frame to the next; None below two frames."""
        return None if self.frames < 2 else (self.last_ns - self.first_ns) / NS_PER_S / (self.frames - 1)

    @property
    def period_std_s(self) -> float | None:
        """Standard deviation of that; None below three frames."""
        gaps = self.frames - 1
        if gaps < 2:
            return None
        return math.sqrt(max(self._gap_squares - self._gap_sum**2 / gaps, 0.0) / (gaps - 1))

    @property
    def rate_hz(self) -> float | None:
        """Frames a second; None below two frames."""
        return None if not self.period_s else 1 / self.period_s

    @property
    def changed_bytes(self) -> list[int]:
        """Bytes that were not always the same, from 0."""
        return [int(place) for place in np.flatnonzero(self.changed)]

    @property
    def counter(self) -> FrameCounter | None:
        """What looks like a counter; None if nothing does."""
        return self._counters.counter

    def take(
        self,
        data: NDArray[np.uint8],
        lengths: NDArray[np.int64],
        arrival_ns: NDArray[np.int64],
        fd_flags: NDArray[np.uint8],
    ) -> None:
        """Count frames, all of them of this id.

        Args:
            data: uint8 ``[n, 64]``, whatever past the length.
            lengths: int64 ``[n]``.
            arrival_ns: int64 ``[n]``.
            fd_flags: uint8 ``[n]``, see `CanBatch`.
        """
        for length, flags in zip(lengths.tolist(), fd_flags.tolist(), strict=True):
            self.wires[Wire(length, bool(flags & FD), bool(flags & BIT_RATE_SWITCH))] += 1
        held = 0 if self.remote else lengths[:, None]
        payloads = np.where(np.arange(data.shape[1]) < held, data, np.uint8(0))
        if not self.frames:
            self.first_ns = int(arrival_ns[0])
            self._first = payloads[0]
        times_ns = np.concatenate(([self.last_ns], arrival_ns)) if self.frames else arrival_ns
        self._note_gaps(np.diff(times_ns) / NS_PER_S)
        self.changed |= np.bitwise_or.reduce(payloads ^ self._first, axis=0)
        self._counters.take(payloads)
        self.frames += len(lengths)
        self.last_ns = int(arrival_ns[-1])
        self.last = b"" if self.remote else payloads[-1, : int(lengths[-1])].tobytes()

    def _note_gaps(self, gaps_s: NDArray[np.float64]) -> None:
        if not len(gaps_s):
            return
        if self._first_gap_s is None:
            self._first_gap_s = float(gaps_s[0])
        # Sums of what differs little from 0 lose no digits.
        differences = gaps_s - self._first_gap_s
        self._gap_sum += float(differences.sum())
        self._gap_squares += float((differences**2).sum())
        self.shortest_s = min(self.shortest_s, float(gaps_s.min()))
        self.longest_s = max(self.longest_s, float(gaps_s.max()))

    def time_on_wire(self, bitrate: int, data_bitrate: int | None) -> FrameTime:
        """How long the bus was taken by these frames, in s."""
        least_s = most_s = 0.0
        for wire, count in self.wires.items():
            one = frame_time(
                0 if self.remote else wire.length,
                extended=self.extended,
                bitrate=bitrate,
                data_bitrate=data_bitrate if wire.switches else None,
                fd=wire.fd,
            )
            least_s, most_s = least_s + count * one.least_s, most_s + count * one.most_s
        return FrameTime(least_s, most_s)


class Traffic:
    """All that came over a bus.

    Attributes:
        ids: by id with its flags, in the order of their first frames.
        error_frames: how many error frames came; they are from this computer's controller.
        errors: what they report.
        dropped: frames that this computer was too slow for.
    """

    def __init__(self) -> None:
        self.ids: dict[int, IdTraffic] = {}
        self.error_frames = 0
        self.errors = ErrorCounts()
        self.dropped = 0

    @property
    def frames(self) -> int:
        """Frames of all ids."""
        return sum(one.frames for one in self.ids.values())

    @property
    def fd(self) -> bool:
        """Whether a CAN FD frame came."""
        return any(wire.fd for one in self.ids.values() for wire in one.wires)

    def take(self, batch: CanBatch, error_classes: int) -> None:
        """Count a batch.

        Args:
            batch: frames as they came.
            error_classes: see `drivers.can.batches.CanSource`.
        """
        self.dropped += batch.overrun
        fd_flags = np.zeros(len(batch.ids), np.uint8) if batch.fd_flags is None else batch.fd_flags
        for frame_id, rows in by_id(batch.ids):
            if frame_id & ERROR:
                self.error_frames += len(rows)
                counts = ErrorCounts.of(batch.ids[rows] & np.uint32(error_classes), batch.data[rows, :8])
                self.errors = self.errors.followed_by(counts)
                continue
            one = self.ids.setdefault(frame_id, IdTraffic(frame_id))
            one.take(batch.data[rows], batch.lengths[rows], batch.arrival_ns[rows], fd_flags[rows])

    def load(self, seconds: float, bitrate: int, data_bitrate: int | None) -> FrameTime:
        """Which part of the time the bus was taken: without stuff bits, and with the most there can be."""
        times = [one.time_on_wire(bitrate, data_bitrate) for one in self.ids.values()]
        return FrameTime(sum(t.least_s for t in times) / seconds, sum(t.most_s for t in times) / seconds)
