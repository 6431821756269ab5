"""What registers can mean: numbers of 16, 32 and 64 bits in all orders of bytes and words, and how likely.

Registers are read several times. Those of a number of 32 or 64 bits move together: an upper one moves only if
the one below it wraps, or changes wildly. Two numbers of 16 bits side by side do not do this.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from itertools import pairwise, product
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from collections.abc import Set as AbstractSet

    from drivers.modbus.settings import Order, RegisterType

    Registers = Mapping[int, int]
    """Values by address, 0 to 65535."""

ORDERS: Sequence[Order] = ("ABCD", "CDAB", "BADC", "DCBA")
USUAL_ORDERS: Sequence[Order] = ("ABCD", "CDAB")
"""Small integers look like floats in the others."""
_WIDE: Sequence[tuple[RegisterType, str, int]] = (
    ("float32", ">f", 2),
    ("int32", ">i", 2),
    ("uint32", ">I", 2),
    ("float64", ">d", 4),
)

LEAST, MOST = 1e-6, 1e9
SMOOTH = 0.5
"""Part of its value by which a quantity may change while it is read."""
NONE, BESIDE_OTHERS, ALONE, SURE = 0, 1, 2, 3
"""Evidence: only if others of the unit have the same order, enough by itself, and beyond doubt."""
_USUAL = (1e-3, 1e6)
"""Values of which a float is likely, although only its lower register moves."""
_SHORT, _SHORTER, _ROUND = 5, 4, 3
"""Digits of a number that a person has set; of one that is hardly chance; of a round one."""
_MOST_ZEROS = 12
"""Registers in a row that read 0 and may still be numbers, rather than unused."""
_AGREE = 2
"""Numbers that stand still and have few digits, from which on their order is taken for that of the unit."""
_LEAST_COUNT = 65_536
_WILD = 1024
"""A register that moves by so much, either way round, is rather the lower part of a number."""
_CLEARLY = 8
"""Factor by which a movement must be smaller to be clearly smaller."""
_MODULUS = 65_536
_SIGN = 32_768


class Reading(NamedTuple):
    """One way to read registers.

    Attributes:
        address: the first register.
        registers: how many.
        type: of the number.
        order: of bytes and words.
        value: the number when it was read first; not finite where floats are none.
        evidence: that it is a quantity, from `NONE` to `SURE`.
        change: part of its value by which it changed while it was read.
        may_move: whether it is a float32 that may move, with evidence or without.
    """

    address: int
    registers: int
    type: RegisterType
    order: Order
    value: float
    evidence: int
    change: float
    may_move: bool

    @property
    def plausible(self) -> bool:
        """Whether it looks like a quantity."""
        return self.evidence >= ALONE

    @property
    def places(self) -> range:
        """Addresses of its registers."""
        return range(self.address, self.address + self.registers)


def readings(rounds: Sequence[Registers], address: int) -> list[Reading]:
    """Every way to read the registers from an address on, as far as they are there.

    Args:
        rounds: registers by address, as they were read first, again, and so on; later ones may lack some.
        address: of the first register of the number.
    """
    wide: list[Reading] = []
    for kind, code, count in _WIDE:
        places = range(address, address + count)
        if not rounds or not all(place in rounds[0] for place in places):
            continue
        rows = [[these[place] for place in places] for these in rounds if all(p in these for p in places)]
        for order in ORDERS:
            raw = [arranged(row, order) for row in rows]
            numbers = _Numbers(kind, order, raw, [float(struct.unpack(code, one)[0]) for one in raw])
            evidence = numbers.evidence()
            change = numbers.change if evidence else math.inf
            value, may_move = numbers.values[0], numbers.may_move()
            wide.append(Reading(address, count, kind, order, value, evidence, change, may_move))
    return wide


def arranged(words: Sequence[int], order: Order) -> bytes:
    """Registers as the bytes of a number, most significant first."""
    ordered = list(reversed(words)) if order in {"CDAB", "DCBA"} else list(words)
    return b"".join(word.to_bytes(2, "little" if order in {"BADC", "DCBA"} else "big") for word in ordered)


class _Numbers(NamedTuple):
    """The same registers in one order, read several times.

    Attributes:
        kind: type of the number.
        order: of bytes and words.
        raw: its bytes, most significant first.
        values: what they are as numbers.
    """

    kind: str
    order: str
    raw: Sequence[bytes]
    values: Sequence[float]

    @property
    def change(self) -> float:
        """Part of its value by which the number changed."""
        most = max(map(abs, self.values))
        return (max(self.values) - min(self.values)) / most if most else 0.0

    @property
    def moved(self) -> bool:
        """Whether it changed at all."""
        return len(set(self.raw)) > 1

    def evidence(self) -> int:
        """See `Reading.evidence`."""
        if self._is_exchanged:
            return NONE
        if self.kind == "float64":
            return self._float64()
        if self.kind == "float32":
            return self._float32()
        # What is not negative is an int32, too, unless it is beyond the range of counts.
        return self._count() if self.kind == "int32" else NONE

    def _float32(self) -> int:
        if not _in_range(self.values):
            return NONE
        if not self.moved:
            return self._constant()
        if self.change > SMOOTH:
            # One that swings about 0.
            swings = len(set(self.raw)) >= 4 and self._carries(0) and self._moves(0)
            return BESIDE_OTHERS if swings else NONE
        if not self._moves(0):
            return ALONE if self._lower_is_natural() else BESIDE_OTHERS
        if self._is_zero(1):
            return ALONE if max(map(self._digits, self.values)) <= _ROUND else NONE
        return SURE if self._carries(0) else NONE

    def may_move(self) -> bool:
        """See `Reading.may_move`: the value moves a little, and its lower register wildly."""
        if self.kind != "float32" or not self._is_usual or self.change > SMOOTH or self._is_exchanged:
            return False
        steps = [_around(after - before) for before, after in pairwise(self._words(1))]
        return bool(steps) and 2 * sum(step >= _WILD for step in steps) >= len(steps)

    def _float64(self) -> int:
        if not _in_range(self.values) or self.change > SMOOTH:
            return NONE
        if not self.moved:
            return self._constant()
        if self._is_zero(2) and self._is_zero(3):
            return ALONE if max(map(self._digits, self.values)) <= _SHORT else NONE
        # Of two float32 side by side the second would be one, too.
        lower = [struct.unpack(">f", one[4:])[0] for one in self.raw]
        if self._is_zero(2) or _in_range([value for value in lower if value]):
            return NONE
        if not (self._moves(1) or self._moves(2)):
            return BESIDE_OTHERS
        last = 3 if not self._is_zero(3) else 2
        return SURE if all(self._carries(upper) for upper in range(last)) else NONE

    def _constant(self) -> int:
        """A number that was set has few digits."""
        digits = self._digits(self.values[0])
        is_round = digits <= _ROUND or (digits <= _SHORT and self._is_zero(len(self.raw[0]) // 2 - 1))
        if self._is_usual_order:
            # Of the 65536 lower halves a dozen make a float32 of four digits.
            is_round = is_round or (digits <= _SHORTER and self.kind == "float32" and self._is_usual)
            return ALONE if is_round else BESIDE_OTHERS if digits <= _SHORT else NONE
        return BESIDE_OTHERS if is_round else NONE

    def _count(self) -> int:
        """A count of 32 bits goes one way by small steps, and was seen to carry."""
        if not all(_LEAST_COUNT <= abs(value) <= MOST for value in self.values):
            return NONE
        steps = [after - before for before, after in pairwise(self.values)]
        small = all(abs(step) < _SIGN for step in steps)
        one_way = all(step >= 0 for step in steps) or all(step <= 0 for step in steps)
        return SURE if small and one_way and self._moves(0) else NONE

    def _words(self, place: int) -> list[int]:
        """One register, as it was read each time; 0 is the most significant one."""
        return [int.from_bytes(one[2 * place : 2 * place + 2], "big") for one in self.raw]

    def _moves(self, place: int) -> bool:
        return len(set(self._words(place))) > 1

    def _is_zero(self, place: int) -> bool:
        return not any(self._words(place))

    def _lower_is_natural(self) -> bool:
        """Whether the value is usual, and bytes that are not in the usual order show it."""
        here, there = self._movement(1)
        return self._is_usual and (self._is_usual_order or _CLEARLY * here <= there)

    @property
    def _is_usual(self) -> bool:
        return all(_USUAL[0] <= abs(value) <= _USUAL[1] for value in self.values)

    @property
    def _is_exchanged(self) -> bool:
        """Whether a register moves by much less with its bytes exchanged, as a number of 16 bits does."""
        movements = map(self._movement, range(len(self.raw[0]) // 2))
        return any(here > _CLEARLY * there for here, there in movements)

    def _movement(self, place: int) -> tuple[int, int]:
        """How far a register moves in all, and how far with its bytes exchanged."""
        words = self._words(place)
        exchanged = [(word & 0xFF) << 8 | word >> 8 for word in words]
        here, there = (sum(_around(b - a) for a, b in pairwise(these)) for these in (words, exchanged))
        return here, there

    def _carries(self, upper: int) -> bool:
        """Whether the register below an upper one wraps, or changes wildly, when the upper one moves."""
        fits = [
            _wraps(one - before, below - below_before)
            for (before, below_before), (one, below) in pairwise(
                zip(self._words(upper), self._words(upper + 1), strict=True)
            )
            if one != before
        ]
        return 2 * sum(fits) >= len(fits)

    def _digits(self, value: float) -> int:
        """Digits of the shortest decimal number that is this float."""
        import numpy as np  # noqa: PLC0415 - only for who scans

        # Formatted, a float32 has the digits of the double that it is converted to.
        text = str(np.float32(value) if self.kind == "float32" else np.float64(value))
        return len(text.partition("e")[0].replace(".", "").replace("-", "").strip("0"))

    @property
    def _is_usual_order(self) -> bool:
        return self.order in USUAL_ORDERS


def _in_range(values: Sequence[float]) -> bool:
    return bool(values) and all(LEAST <= abs(value) <= MOST for value in values)


def _around(step: int) -> int:
    """How far a register moved, the shorter way round."""
    return min(step % _MODULUS, -step % _MODULUS)


def _wraps(upper_step: int, lower_step: int) -> bool:
    return _around(lower_step) >= _WILD or (
        abs(upper_step) == 1 and abs(upper_step * _MODULUS + lower_step) < _SIGN
    )


def is_signed(values: Sequence[int]) -> bool:
    """Whether a register of 16 bits has been near below 0."""
    return any(value >= 3 * _SIGN // 2 for value in values) and not any(
        _SIGN // 2 <= value < 3 * _SIGN // 2 for value in values
    )


def chosen(rounds: Sequence[Registers]) -> list[Reading]:
    """The likeliest readings that do not overlap, in the order of addresses; registers left over are none.

    Each float64 beyond doubt goes first, since a part of it looks like a float32. Then the order that most
    agree on goes first: devices have one for all numbers, or at least for those of a type.

    Args:
        rounds: see `readings`.
    """
    if not rounds:
        return []
    every = [one for address in sorted(rounds[0]) for one in readings(rounds, address)]
    evident = [one for one in every if one.evidence]
    sure = {one.order for one in evident if one.evidence == SURE} | _agreed(evident)
    likely = [one for one in evident if one.plausible or one.order in sure]
    doubles = _apart([one for one in likely if one.type == "float64" and one.evidence == SURE], [])
    kept = doubles + _apart(likely, doubles)
    floats = [one for one in every if one.type == "float32" and (one.evidence or one.may_move)]
    for run in _in_a_row([one for one in likely if one.type == "float32"]):
        kept = _paired(run, kept, floats)
    return sorted(kept, key=lambda one: one.address)


def _is_usual(one: Reading) -> bool:
    return _USUAL[0] <= abs(one.value) <= _USUAL[1]


def _in_a_row(likely: Sequence[Reading]) -> Iterable[list[Reading]]:
    """Readings in groups: each overlaps another one of its group or is beside it, and none of others."""
    run: list[Reading] = []
    for one in likely:
        if run and one.address > max(before.places[-1] for before in run) + 1:
            yield run
            run = []
        run.append(one)
    if run:
        yield run


def _paired(run: Sequence[Reading], kept: Sequence[Reading], floats: Sequence[Reading]) -> list[Reading]:
    """What is kept, with other pairs in place of those across the border of two numbers.

    A float32 has the value of another one, nearly, with its lower register taken from the number beside it.
    Such pairs leave registers over at both ends, where the right ones have a partner.

    Args:
        run: likely float32 in a row.
        kept: the likeliest of all, which do not.
        floats: every float32 with evidence, or that may move.
    """
    places = {place for one in run for place in one.places}
    beside = [one for one in floats if places & set(one.places)]
    places |= {place for one in beside for place in one.places}
    here = [one for one in kept if places & set(one.places)]
    if not here or any(one.type != "float32" for one in here):
        return [*kept]
    taken = {place for one in here for place in one.places}
    orders = {one.order for one in here}
    more = [one for one in beside if one.order in orders and not taken & set(one.places)]
    most, best = 2 * (len(here) + len(_side_by_side(more))), here
    for order, odd in product(ORDERS, (0, 1)):
        pairs = [one for one in beside if one.order == order and one.address % 2 == odd]
        these = [one for one in pairs if one in run]
        if 2 * len(pairs) > most and 2 * len(these) >= len(here):
            most, best = 2 * len(pairs), these
    return [*(one for one in kept if one not in here), *best]


def _agreed(evident: Sequence[Reading]) -> set[Order]:
    """The order in which several float32 that stand still have few digits: chance makes hardly one so."""
    apart = _apart([one for one in evident if _stands_still(one)], [])
    agreeing = Counter(one.order for one in apart)
    return {order for order, count in agreeing.items() if count >= _AGREE}


def _stands_still(one: Reading) -> bool:
    return one.type == "float32" and one.order in USUAL_ORDERS and one.change == 0 and _is_usual(one)


def undecided(rounds: Sequence[Registers], numbers: Sequence[Reading]) -> list[Reading]:
    """Two registers each that may be one float32, which too little shows, mostly as they stand still.

    Of readings that overlap, those of the order that fits most often.

    Args:
        rounds: see `readings`.
        numbers: what is chosen of them.
    """
    taken = {place for one in numbers for place in one.places}
    candidates = [one for address in sorted(rounds[0] if rounds else ()) for one in readings(rounds, address)]
    moved = {place for these in rounds for place in these if these[place] != rounds[0].get(place)}
    possible = [
        one
        for one in candidates
        if one.type == "float32"
        and not taken & set(one.places)
        and (one.evidence or (_is_usual(one) and not moved & set(one.places)))
    ]
    of_others = {one.order for one in numbers if one.type == "float32"}
    by_order = {
        order: _side_by_side(
            these if order in USUAL_ORDERS or order in of_others else _beside_large(rounds[0], these)
        )
        for order in ORDERS
        if (these := [one for one in possible if one.order == order]) or order == ORDERS[0]
    }
    best = max(by_order, key=lambda order: (order in of_others, len(by_order[order])))
    kept = list(by_order[best])
    places = {place for one in kept for place in one.places}
    for order, these in by_order.items():
        kept += [one for one in these if order != best and not places & set(one.places)]
        places |= {place for one in kept for place in one.places}
    zeros = [
        one for one in candidates if one.address in _zeros_beside(rounds, numbers) and one.order == "ABCD"
    ]
    kept += [one._replace(order=numbers[0].order) for one in zeros if one.type == "float32"]
    return sorted(kept, key=lambda one: one.address)


def _beside_large(registers: Registers, possible: Sequence[Reading]) -> list[Reading]:
    """Those whose registers are both far from 0, as of most floats, and others of 16 bits seldom are.

    Those side by side with one of these may be floats, too.
    """
    large = {one.address for one in possible if all(_around(registers[p]) >= _WILD for p in one.places)}
    for these in (possible, reversed(possible)):
        large |= _chained(these, large)
    return [one for one in possible if one.address in large]


def _chained(possible: Iterable[Reading], begun: AbstractSet[int]) -> set[int]:
    """First registers of pairs side by side with one before, in the order in which they are given."""
    chain = set(begun)
    for one in possible:
        if {one.address - 2, one.address + 2} & chain:
            chain.add(one.address)
    return chain


def _zeros_beside(rounds: Sequence[Registers], numbers: Sequence[Reading]) -> set[int]:
    """First registers of pairs that read 0 beside float32: a machine at rest has many such values."""
    taken = {place for one in numbers if one.type == "float32" for place in one.places}
    zeros = {
        address
        for address in (rounds[0] if rounds else ())
        if not any(these.get(address) for these in rounds) and address not in taken
    }
    pairs: set[int] = set()
    for first in sorted(zeros):
        if first - 1 in zeros:
            continue
        end = first
        while end in zeros:
            end += 1
        beside = first - 1 in taken or end in taken
        if beside and (end - first) % 2 == 0 and end - first <= _MOST_ZEROS:
            pairs |= set(range(first, end, 2))
    return pairs


def _side_by_side(possible: Sequence[Reading]) -> list[Reading]:
    """Those that do not overlap, from the first register on."""
    kept: list[Reading] = []
    for one in possible:
        if not kept or one.address > kept[-1].places[-1]:
            kept.append(one)
    return kept


def _apart(likely: Sequence[Reading], taken: Sequence[Reading]) -> list[Reading]:
    """Those of the likely readings that overlap neither each other nor what is taken, the likeliest first."""
    places = {place for one in taken for place in one.places}
    free = [one for one in likely if not places & set(one.places)]
    votes: Counter[tuple[str, str]] = Counter()
    for one in [*free, *taken]:
        for kind, _, _ in _WIDE:
            votes[kind, one.order] += one.evidence * (2 if kind == one.type else 1)
    kept: list[Reading] = []
    for one in sorted(
        free,
        key=lambda one: (
            -votes[one.type, one.order],
            one.type != "float32",
            -one.evidence,
            one.change,
            one.address,
        ),
    ):
        if not places & set(one.places):
            places |= set(one.places)
            kept.append(one)
    return kept
