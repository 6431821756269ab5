"""What registers can mean: numbers of 16, 32 and 64 bits in all orders of bytes and words, and how likely."""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from drivers.modbus.settings import Order, RegisterType

ORDERS: Sequence[Order] = ("ABCD", "CDAB", "BADC", "DCBA")
_WIDE: Sequence[tuple[RegisterType, str, int]] = (
    ("float32", ">f", 2),
    ("int32", ">i", 2),
    ("uint32", ">I", 2),
    ("float64", ">d", 4),
)

LEAST, MOST = 1e-6, 1e9
SMOOTH = 0.2
"""Part of its value by which a quantity may change between two readings."""
_SHORT = 5
_LEAST_COUNT = 65_536


class Reading(NamedTuple):
    """One way to read registers.

    Attributes:
        address: the first register.
        registers: how many.
        type: of the number.
        order: of bytes and words.
        value: the number; not finite where floats are none.
        plausible: whether it looks like a quantity.
    """

    address: int
    registers: int
    type: RegisterType
    order: Order
    value: float
    plausible: bool


def readings(first: Mapping[int, int], second: Mapping[int, int], address: int) -> list[Reading]:
    """Every way to read the registers from an address on, as far as they are there.

    Args:
        first: registers by address.
        second: the same a while later; some may be missing.
        address: of the first register of the number.
    """
    found: list[Reading] = []
    for kind, code, count in _WIDE:
        places = range(address, address + count)
        if not all(place in first for place in places):
            continue
        words = [first[place] for place in places]
        later = [second.get(place, first[place]) for place in places]
        for order in ORDERS:
            value, then = (struct.unpack(code, arranged(these, order))[0] for these in (words, later))
            likely = _is_likely(
                kind, words, value, then, moved=[word != now for word, now in zip(words, later, strict=True)]
            )
            found.append(Reading(address, count, kind, order, float(value), likely))
    return found


def arranged(words: Sequence[int], order: Order) -> bytes:
    """Registers as the bytes of a number, most significant first."""
    ordered = list(reversed(words)) if order in {"CDAB", "DCBA"} else list(words)
    return b"".join(word.to_bytes(2, "little" if order in {"BADC", "DCBA"} else "big") for word in ordered)


def _is_likely(kind: str, words: Sequence[int], value: float, then: float, moved: Sequence[bool]) -> bool:
    """Whether a number is a quantity rather than bits.

    A float that was measured changes little from one reading to the next, and one that was set has few
    digits; any bits are a float in the range of quantities once in five times.
    """
    if not (math.isfinite(value) and math.isfinite(then)) or (
        len(set(words)) < 2 and not kind.startswith("f")
    ):
        return False
    smooth = abs(then - value) <= SMOOTH * max(abs(value), abs(then))
    if kind.startswith("float"):
        in_range = all(LEAST <= abs(number) <= MOST for number in (value, then))
        return in_range and smooth and (any(moved) or _digits(value, kind) <= _SHORT)
    # Two registers of 16 bits side by side look like one of 32, until the upper one is seen to carry.
    return _LEAST_COUNT <= abs(value) <= MOST and smooth and all(moved) and kind == "int32"


def _digits(value: float, kind: str) -> int:
    """Digits of the shortest decimal number that is this float."""
    import numpy as np  # noqa: PLC0415 - only for who scans

    text = f"{np.float32(value) if kind == 'float32' else np.float64(value)}"
    return len(text.partition("e")[0].replace(".", "").replace("-", "").strip("0"))


def chosen(first: Mapping[int, int], second: Mapping[int, int]) -> list[Reading]:
    """The likeliest readings that do not overlap, in the order of addresses; registers left over are none.

    The order that most of them agree on goes first, since devices have one order throughout.
    """
    likely = [one for address in sorted(first) for one in readings(first, second, address) if one.plausible]
    votes: dict[str, int] = {}
    for one in likely:
        votes[one.order] = votes.get(one.order, 0) + (2 if one.type.startswith("float") else 1)
    ranked = sorted(
        likely, key=lambda one: (-votes[one.order], not one.type.startswith("float"), one.address)
    )
    taken: set[int] = set()
    kept: list[Reading] = []
    for one in ranked:
        places = set(range(one.address, one.address + one.registers))
        if not places & taken:
            taken |= places
            kept.append(one)
    return sorted(kept, key=lambda one: one.address)
