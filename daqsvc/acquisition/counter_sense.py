"""Whether the frames of a stream can be placed: a counter that stands still or leaps about, and floods.

The frames of a stream that cannot be placed are set aside: counted, and examined only to see whether they
make sense again. That costs little, however many they are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.counter import MOST_BITS

if TYPE_CHECKING:
    from numpy.typing import NDArray

STILL_NS = NS_PER_S
STILL_FRAMES = 8
"""A counter that so many frames in so much time have alike stands still."""

LOOKED_FRAMES, LOOKED_NS = 64, NS_PER_S // 5
REJECTED = 0.25
"""A counter makes no sense if this share of that many frames fits nothing."""

SENSE_FRAMES, SENSE_NS = 32, NS_PER_S // 2
SENSE = 0.75
"""It makes sense again if this share of that many frames goes on from the one before, ..."""
SENSE_STEPS = 4
"""... by so many frames at most."""

FLOOD_RATE = 4.0
"""Times the nominal rate: more frames than that, for longer, are a flood."""
BACKLOG_S = 60.0
"""But not if they are what a bus may have held back for so long."""
BACKLOG_FRAMES = 1024

# Without figures: the same trouble is the same sentence each time, and not logged again.
SENSELESS_WORDS = (
    "the device's counter makes no sense: a quarter of its frames, or more, fit nothing; "
    "check the device, and the place and width of the counter in the layout"
)

Kind = Literal["still", "senseless", "flood"]


class CounterSense:
    """Watches the frames of one stream.

    Args:
        bits: width of the counter; None if there is none.
        step: counts from one frame to the next.
        frame_rate_hz: nominal frames per second.
    """

    def __init__(self, bits: int | None, step: int, frame_rate_hz: float) -> None:
        self._unused_bits = None if bits is None else MOST_BITS - bits
        self._step = step
        self._frame_rate_hz = frame_rate_hz
        self._sense_frames = min(max(round(frame_rate_hz / 2), STILL_FRAMES), SENSE_FRAMES)
        self._room = self._most_room = BACKLOG_S * frame_rate_hz + BACKLOG_FRAMES
        self._seen_ns: int | None = None
        self._raw = 0
        self._alike = 0
        self._alike_since_ns = 0
        self._placed = self._rejected = 0
        self._placed_since_ns: int | None = None
        self._looked = self._sound = 0
        self._looked_since_ns = 0
        self._kind: Kind | None = None
        self._cause_over = False
        self.doubt = ""
        """Why the frames are set aside; empty if they are not."""

    def look(self, raw: NDArray[np.int64], arrival_ns: NDArray[np.int64]) -> bool:
        """Look at frames before they are placed.

        Args:
            raw: int64 ``[n]``, counters as sent, at least one.
            arrival_ns: int64 ``[n]``, host monotonic.

        Returns:
            Whether they are to be set aside; those after them may be placed again if `doubt` is empty then.
        """
        now_ns = int(arrival_ns[-1])
        steps = self._steps(raw)
        self._watch_flood(len(raw), now_ns)
        if steps is not None:
            self._watch_stillness(steps, arrival_ns, now_ns)
        self._raw, self._seen_ns = int(raw[-1]), now_ns
        if self._kind is None:
            return False
        self._watch_sense(steps, len(raw), now_ns)
        return True

    def placed(self, frames: int, rejected: int, now_ns: int) -> None:
        """Take in what has become of frames that were placed.

        Args:
            frames: how many they were.
            rejected: of those, with a counter that fits nothing.
            now_ns: arrival of the last one.
        """
        if self._placed_since_ns is None:
            self._placed_since_ns = now_ns
        self._placed += frames
        self._rejected += rejected
        if self._placed < LOOKED_FRAMES or now_ns - self._placed_since_ns < LOOKED_NS:
            return
        if self._rejected >= REJECTED * self._placed:
            self._set_aside("senseless", SENSELESS_WORDS, now_ns)
        self._placed = self._rejected = 0
        self._placed_since_ns = now_ns

    @property
    def _flood_words(self) -> str:
        return (
            f"more than {FLOOD_RATE:g} times as many frames come as the file states "
            f"({self._frame_rate_hz:.4g} a second); check the device, and rate_hz"
        )

    def _steps(self, raw: NDArray[np.int64]) -> NDArray[np.int64] | None:
        if self._unused_bits is None:
            return None
        before = raw[:1] - self._step if self._seen_ns is None else np.array([self._raw], np.int64)
        steps = raw - np.concatenate((before, raw[:-1]))
        signed: NDArray[np.int64] = (steps << self._unused_bits) >> self._unused_bits
        return signed

    def _watch_flood(self, frames: int, now_ns: int) -> None:
        since_s = 0.0 if self._seen_ns is None else max(now_ns - self._seen_ns, 0) / NS_PER_S
        self._room = min(self._room + FLOOD_RATE * self._frame_rate_hz * since_s, self._most_room) - frames
        if self._room < 0.0:
            self._room = 0.0
            if self._kind is None:
                self._set_aside("flood", self._flood_words, now_ns)

    def _watch_stillness(self, steps: NDArray[np.int64], arrival_ns: NDArray[np.int64], now_ns: int) -> None:
        moved = np.flatnonzero(steps)
        if len(moved):
            self._alike = len(steps) - 1 - int(moved[-1])
            self._alike_since_ns = int(arrival_ns[moved[-1]])
        else:
            self._alike += len(steps)
        still = self._alike >= STILL_FRAMES and now_ns - self._alike_since_ns >= STILL_NS
        if still and self._kind != "still":
            unsigned = self._raw % 2 ** (MOST_BITS - (self._unused_bits or 0))
            self._set_aside(
                "still", f"the device's counter stands still at {unsigned}; check the device", now_ns
            )

    def _watch_sense(self, steps: NDArray[np.int64] | None, frames: int, now_ns: int) -> None:
        self._looked += frames
        if steps is None:
            self._sound += frames
        else:
            leaps, left = np.divmod(steps, self._step)
            self._sound += int(((left == 0) & (leaps >= 1) & (leaps <= SENSE_STEPS)).sum())
        looked_ns = now_ns - self._looked_since_ns
        if self._looked < self._sense_frames or looked_ns < SENSE_NS:
            return
        calm = self._looked <= FLOOD_RATE * self._frame_rate_hz * looked_ns / NS_PER_S + 1.0
        sound = self._sound >= SENSE * self._looked
        if calm and sound:
            self._kind, self.doubt = None, ""
            self._placed = self._rejected = 0
            self._placed_since_ns = None
            self._room = self._most_room
        else:
            self._watch_cause(now_ns, calm=calm, sound=sound)
        self._looked = self._sound = 0
        self._looked_since_ns = now_ns

    def _watch_cause(self, now_ns: int, *, calm: bool, sound: bool) -> None:
        """Another reason to set frames aside takes over once the one that stands is no longer true.

        One reading is not enough: it may have begun before the device was right again.
        """
        holds = {"still": self._alike >= STILL_FRAMES, "senseless": not sound, "flood": not calm}
        over = self._kind is not None and not holds[self._kind]
        was_over, self._cause_over = self._cause_over, over
        if over and was_over:
            kind: Kind = "senseless" if calm else "flood"
            self._set_aside(kind, SENSELESS_WORDS if calm else self._flood_words, now_ns)

    def _set_aside(self, kind: Kind, doubt: str, now_ns: int) -> None:
        self._kind, self.doubt, self._cause_over = kind, doubt, False
        self._looked = self._sound = 0
        self._looked_since_ns = now_ns
