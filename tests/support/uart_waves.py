"""A serial line at the level of its bits: what a UART reads of it at any baud rate."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np


class Sampled(NamedTuple):
    """What a UART has read.

    Attributes:
        data: bytes.
        framing_errors: how many of them had no stop bit.
    """

    data: bytes
    framing_errors: int


def wave(
    data: bytes, *, data_bits: int = 8, parity: str = "none", gap_bits: int = 0, gap_every: int = 1
) -> str:
    """The levels of a line, one for each bit time of the sender.

    Args:
        data: what is sent.
        data_bits: 7 or 8.
        parity: "none", "even" or "odd".
        gap_bits: bit times that the line idles for after every ``gap_every`` bytes.
        gap_every: see there.
    """
    levels = ["1" * 12]
    for number, byte in enumerate(data):
        bits = [byte >> k & 1 for k in range(data_bits)]
        if parity != "none":
            bits.append((sum(bits) + (parity == "odd")) % 2)
        levels.append("0" + "".join(map(str, bits)) + "1")
        if (number + 1) % gap_every == 0:
            levels.append("1" * gap_bits)
    return "".join(levels) + "1" * 12


def sampled(levels: str, ratio: float, *, parity_bit: bool = False) -> Sampled:
    """What a UART reads of a line, 8 bits to the character.

    Args:
        levels: see `wave`.
        ratio: its bit time in those of the sender: the sender's baud rate by its own.
        parity_bit: whether it takes a parity bit before the stop bit, which it does not check.
    """
    line = np.frombuffer(levels.encode(), np.uint8) == ord("1")
    falls = np.flatnonzero(~line[1:] & line[:-1]) + 1
    data, errors, now = bytearray(), 0, 0.0
    places = (np.arange(9 + parity_bit) + 1.5) * ratio
    while (k := int(np.searchsorted(falls, math.ceil(now - 1e-9)))) < len(falls):
        start = float(falls[k])
        at = (start + places).astype(np.int64)
        if at[-1] >= len(line):
            break
        if line[int(start + 0.5 * ratio)]:
            now = start + 0.5 * ratio  # too short for a start bit
            continue
        bits = line[at]
        data.append(int(np.packbits(bits[:8], bitorder="little")[0]))
        errors += not bits[-1]
        now = start + places[-1]
    return Sampled(bytes(data), errors)
