"""Bytes that no device should send: made of what devices do send, or of nothing in particular."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np


def _as_it_is(_rng: np.random.Generator, sound: bytes) -> bytes:
    return sound


def _random(rng: np.random.Generator, sound: bytes) -> bytes:
    return rng.bytes(int(rng.integers(0, 2 * len(sound) + 2)))


def _flipped(rng: np.random.Generator, sound: bytes) -> bytes:
    spoilt = bytearray(sound)
    for place in rng.integers(0, len(spoilt), int(rng.integers(1, 5))) if spoilt else ():
        spoilt[place] ^= 1 << int(rng.integers(8))
    return bytes(spoilt)


def _extreme(rng: np.random.Generator, sound: bytes) -> bytes:
    spoilt = bytearray(sound)
    for place in rng.integers(0, len(spoilt), int(rng.integers(1, 5))) if spoilt else ():
        spoilt[place] = int(rng.choice([0x00, 0x01, 0x7F, 0x80, 0xFF]))
    return bytes(spoilt)


def _cut_short(rng: np.random.Generator, sound: bytes) -> bytes:
    return sound[: int(rng.integers(0, len(sound) + 1))]


def _headless(rng: np.random.Generator, sound: bytes) -> bytes:
    return sound[int(rng.integers(0, len(sound) + 1)) :]


def _spliced(rng: np.random.Generator, sound: bytes) -> bytes:
    at, to = rng.integers(0, len(sound) + 1, 2)
    return sound[:at] + rng.bytes(int(rng.integers(0, 9))) + sound[to:]


def _repeated(rng: np.random.Generator, sound: bytes) -> bytes:
    return sound * int(rng.integers(2, 5))


MUTATIONS: Sequence[Callable[[np.random.Generator, bytes], bytes]] = (
    _as_it_is,
    _random,
    _flipped,
    _extreme,
    _cut_short,
    _headless,
    _spliced,
    _repeated,
)


def mutated(rng: np.random.Generator, sound: bytes) -> bytes:
    """Bytes like ``sound``, or not; one of `MUTATIONS` of it."""
    return MUTATIONS[int(rng.integers(len(MUTATIONS)))](rng, sound)
