"""Which bytes of frames count: those that grow by the same step from each frame to the next."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

LEAST_COUNTS = 8
"""Frames after which bytes that grew by the same step each time are taken for a counter."""

_BYTE_STEPS, _WORD_STEPS = 256, 65_536
_NEARLY_ALL = 0.9
_SORTED = 199
"""Pairs of frames, evenly spread, that show which step is the usual one."""


class FrameCounter(NamedTuple):
    """Bytes that grow by the same step from frame to frame.

    Attributes:
        byte: the first of them.
        bits: 8 or 16; a wider one looks like 16 as long as its upper bytes do not change.
        order: byte order; of 8 bits it does not matter.
        step: by how much it grows.
    """

    byte: int
    bits: int
    order: str
    step: int

    def __str__(self) -> str:
        order = f" {self.order}" if self.bits > 8 else ""
        return f"byte {self.byte}, {self.bits} bit{order}, +{self.step}"


class _Steps:
    """Whether numbers in a payload grow by one step each.

    Args:
        modulus: of the numbers.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._step: NDArray[np.int64] | None = None
        self._constant: NDArray[np.bool_] | None = None

    def take(self, values: NDArray[np.int64]) -> None:
        """The next numbers ``[n, places]``, the last of those before among them."""
        steps = np.diff(values, axis=0) % self._modulus
        if not len(steps):
            return
        if self._step is None or self._constant is None:
            self._step, self._constant = steps[0], np.ones(steps.shape[1], np.bool_)
        self._constant &= (steps == self._step).all(axis=0)

    @property
    def steps(self) -> dict[int, int]:
        """The step by place, of those that have one."""
        if self._step is None or self._constant is None:
            return {}
        places = np.flatnonzero(self._constant & (self._step != 0))
        return {int(place): int(self._step[place]) for place in places}


class CounterSearch:
    """Looks for a counter in frames of one length, as they come."""

    def __init__(self) -> None:
        self._bytes, self._little, self._big = _Steps(_BYTE_STEPS), _Steps(_WORD_STEPS), _Steps(_WORD_STEPS)
        self._before: NDArray[np.uint8] | None = None
        self._first: NDArray[np.uint8] | None = None
        self._changed: NDArray[np.bool_] | None = None
        self._frames = 0

    def take(self, payloads: NDArray[np.uint8]) -> None:
        """The next frames, uint8 ``[n, length]``; bytes that a frame does not have are 0."""
        if not len(payloads):
            return
        if self._before is None or self._first is None or self._changed is None:
            rows, self._first, self._changed = payloads, payloads[0], np.zeros(payloads.shape[1], np.bool_)
        else:
            rows = np.concatenate((self._before[None], payloads))
        self._changed |= (payloads != self._first).any(axis=0)
        numbers = rows.astype(np.int64)
        self._bytes.take(numbers)
        self._little.take(numbers[:, :-1] + 256 * numbers[:, 1:])
        self._big.take(256 * numbers[:, :-1] + numbers[:, 1:])
        self._before = payloads[-1]
        self._frames += len(payloads)

    @property
    def counter(self) -> FrameCounter | None:
        """What looks like a counter; None if nothing does."""
        if self._frames <= LEAST_COUNTS or self._changed is None:
            return None
        return _widest(self._bytes.steps, self._little.steps, self._big.steps, self._changed)


def counter_between(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> FrameCounter | None:
    """What looks like a counter in pairs of successive frames, some of which may be damaged or missing.

    Args:
        before: uint8 ``[n, length]``.
        after: uint8 ``[n, length]``, the frame behind each of those.
    """
    if len(before) < LEAST_COUNTS:
        return None
    changed = (before != before[0]).any(axis=0) | (after != before[0]).any(axis=0)
    steps = after - before  # of 8 bits, and below of 16, it begins again from 0 by itself
    words = after.astype(np.uint16) - before
    return _widest(
        _usual_steps(steps),
        _usual_steps(words[:, :-1] + words[:, 1:] * _BYTE_STEPS),
        _usual_steps(words[:, :-1] * _BYTE_STEPS + words[:, 1:]),
        changed,
    )


def _usual_steps(steps: NDArray[np.uint8] | NDArray[np.uint16]) -> dict[int, int]:
    """By place, the step that nearly all pairs have, where it is not 0; ``steps`` is ``[n, places]``."""
    # What nearly all of them have is in the middle when some of them are sorted.
    some = steps[:: -(-len(steps) // _SORTED)]
    middle = np.partition(some, len(some) // 2, axis=0)[len(some) // 2]
    usual = (steps == middle).mean(axis=0) >= _NEARLY_ALL
    return {place: int(middle[place]) for place in np.flatnonzero(usual & (middle != 0)).tolist()}


def _widest(
    alone: Mapping[int, int], little: Mapping[int, int], big: Mapping[int, int], changed: NDArray[np.bool_]
) -> FrameCounter | None:
    """The counter among bytes and words that grow by one step each, given by place."""
    # Of 16 bits only where the upper byte was seen to carry; else its own 8 bits say as much.
    for order, steps, upper in (("little", little, 1), ("big", big, 0)):
        for place, step in steps.items():
            if changed[place + upper] and place + 1 - upper in alone:
                return FrameCounter(place, 16, order, step)
    return next((FrameCounter(place, 8, "little", step) for place, step in alone.items()), None)
