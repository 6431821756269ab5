"""Faults of a link: frames dropped, sent twice, overtaken by later ones, or corrupted on the way.

The faults are planned over the whole schedule of one id's frames before the first is sent. So the plan
knows whether a later frame can really overtake a held one, and what it counts is what happens.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_FLIPPED_BITS = 3
"""A CRC-16 is sure to notice up to three flipped bits in any frame."""


class Fault(IntEnum):
    """What the link does to one frame, or to one copy of it."""

    NONE = 0
    DROPPED = 1
    DUPLICATED = 2
    """The second copy of a frame that was sent just before."""
    REORDERED = 3
    CORRUPTED = 4
    SILENCED = 5
    """Not sent, because its node is silent."""
    BABBLED = 6
    """Sent by a babbling node."""


@dataclass(frozen=True, slots=True)
class FaultCounts:
    """How many frames a node made, and what was done to them.

    Attributes:
        frames_in: frames that the node made, sent or not.
        dropped: of those, lost on the link.
        duplicated: of those, sent twice.
        reordered: of those, overtaken by a later one.
        corrupted: of those, sent with bits flipped.
        silenced: of those, not sent because the node was silent.
        delayed: frames, second copies too, that were sent later than they were due.
        babbled: frames of a babbling node, beside those.
        brown_outs: how often the node came back from a brown-out.
        counter_resets: how often its counter was reset.
    """

    frames_in: int = 0
    dropped: int = 0
    duplicated: int = 0
    reordered: int = 0
    corrupted: int = 0
    silenced: int = 0
    delayed: int = 0
    babbled: int = 0
    brown_outs: int = 0
    counter_resets: int = 0

    @property
    def lost(self) -> int:
        """Frames that a receiver who checks their CRC never sees."""
        return self.dropped + self.corrupted + self.silenced

    @property
    def sent(self) -> int:
        """Frames of the node that went onto the bus, second copies and corrupted ones too."""
        return self.frames_in - self.dropped - self.silenced + self.duplicated

    def __add__(self, other: FaultCounts) -> FaultCounts:
        return FaultCounts(
            **{each.name: getattr(self, each.name) + getattr(other, each.name) for each in fields(self)}
        )

    @classmethod
    def of(
        cls, faults: NDArray[np.uint8], *, delayed: int = 0, brown_outs: int = 0, counter_resets: int = 0
    ) -> FaultCounts:
        """Counts of a run of events, by their `Fault`, and what else happened meanwhile."""
        seen = Counter(faults.tolist())
        return cls(
            frames_in=len(faults) - seen[Fault.DUPLICATED] - seen[Fault.BABBLED],
            dropped=seen[Fault.DROPPED],
            duplicated=seen[Fault.DUPLICATED],
            reordered=seen[Fault.REORDERED],
            corrupted=seen[Fault.CORRUPTED],
            silenced=seen[Fault.SILENCED],
            babbled=seen[Fault.BABBLED],
            delayed=delayed,
            brown_outs=brown_outs,
            counter_resets=counter_resets,
        )


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """What a link does, event by event in the order of time.

    An event sends one frame, except that a `Fault.DROPPED` one sends nothing.

    Attributes:
        t_ns: int64 ``[m]``, when.
        frame: int64 ``[m]``, which frame of the schedule.
        fault: uint8 ``[m]``, the `Fault` done to it.
        flips: uint8 ``[m, length]``, bits to flip in the payload; non-zero where it is corrupted.
    """

    t_ns: NDArray[np.int64]
    frame: NDArray[np.int64]
    fault: NDArray[np.uint8]
    flips: NDArray[np.uint8]

    @property
    def injected(self) -> FaultCounts:
        """Counts over the whole plan."""
        return FaultCounts.of(self.fault)


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFaults:
    """A link with random faults, at most one to a frame, the same for the same seed.

    The first and the last frame pass untouched: what is missing before the first or after the last
    frame, a receiver cannot know.

    Attributes:
        drop: probability that a frame is not sent.
        duplicate: probability that it is sent twice in a row.
        reorder: probability that it is held back until a later intact frame has been sent. Where
            none comes soon enough the frame keeps its place, and is not counted.
        corrupt: probability that one to three bits of its payload are flipped.
        seed: of the random draws.
        reorder_within_ns: longest time for which a frame is held back.

    Raises:
        ValueError: a probability is outside 0 to 1, or they add up to more than 1.
    """

    drop: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0
    seed: int = 0
    reorder_within_ns: int = 5_000_000

    def __post_init__(self) -> None:
        rates = {name: getattr(self, name) for name in ("drop", "duplicate", "reorder", "corrupt")}
        for name, rate in rates.items():
            if not 0.0 <= rate <= 1.0:
                raise ValueError(f"link fault {name} = {rate}; a probability lies between 0 and 1")
        if sum(rates.values()) > 1.0 + 1e-12:
            raise ValueError(f"link faults {rates} add up to {sum(rates.values())}; lower them to 1 or less")
        if self.reorder_within_ns < 0:
            raise ValueError(f"reorder_within_ns is {self.reorder_within_ns}; it cannot be negative")

    def plan(self, t_ns: NDArray[np.int64], length: int, *, salt: int = 0) -> FaultPlan:
        """Decide what happens to every frame of a schedule.

        Args:
            t_ns: int64 ``[n]``, when each frame of one id is due, not falling.
            length: payload bytes of a frame.
            salt: makes other draws of the same seed, for another part of the same run.

        Raises:
            ValueError: ``t_ns`` falls somewhere.
        """
        if np.any(np.diff(t_ns) < 0):
            raise ValueError("the schedule of frames goes back in time; sort it before planning its faults")
        rng = np.random.default_rng([self.seed, salt] if salt else self.seed)
        fault = self._draw(len(t_ns), rng)
        overtaken_by = self._hold_back(fault, t_ns)

        copies = np.where(fault == Fault.DUPLICATED, 2, 1)
        frame = np.repeat(np.arange(len(t_ns)), copies)
        event_fault = fault[frame]
        is_first_copy = np.diff(frame, prepend=-1) > 0
        event_fault[(event_fault == Fault.DUPLICATED) & is_first_copy] = Fault.NONE
        # A held frame follows the one that overtakes it; frames held for the same one keep their order.
        order = np.lexsort((frame != overtaken_by[frame], overtaken_by[frame]))
        frame, event_fault = frame[order], event_fault[order]

        flips = np.zeros((len(frame), length), np.uint8)
        for event in np.flatnonzero(event_fault == Fault.CORRUPTED):
            bits = rng.choice(8 * length, rng.integers(1, MAX_FLIPPED_BITS + 1), replace=False)
            for bit in bits:
                flips[event, bit // 8] |= np.uint8(1 << (bit % 8))
        return FaultPlan(t_ns=t_ns[overtaken_by[frame]], frame=frame, fault=event_fault, flips=flips)

    def _draw(self, frames: int, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The fault each frame is meant to have: one uniform draw each, so at most one fault."""
        limits = np.cumsum([self.drop, self.duplicate, self.reorder, self.corrupt])
        outcomes = np.array(
            [Fault.DROPPED, Fault.DUPLICATED, Fault.REORDERED, Fault.CORRUPTED, Fault.NONE], np.uint8
        )
        fault = outcomes[np.searchsorted(limits, rng.random(frames), side="right")]
        fault[:1] = fault[-1:] = Fault.NONE
        return fault

    def _hold_back(self, fault: NDArray[np.uint8], t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """For each frame the one after which it is sent: itself unless it is held back.

        Goes from the last frame to the first, because only a frame that keeps its place can overtake.
        Frames that cannot be held back lose their fault in place.
        """
        sent_with = np.arange(len(fault))
        in_place: int | None = None
        for i in range(len(fault) - 1, -1, -1):
            if fault[i] == Fault.REORDERED:
                if in_place is not None and t_ns[in_place] - t_ns[i] <= self.reorder_within_ns:
                    sent_with[i] = in_place
                    continue
                fault[i] = Fault.NONE
            if fault[i] in {Fault.NONE, Fault.DUPLICATED}:
                in_place = i
        return sent_with
