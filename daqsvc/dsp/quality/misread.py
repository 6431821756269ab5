"""Values whose bytes were put together in the wrong order, or read as the wrong type.

Of a float whose words are exchanged, the digits that change from read to read become its exponent: it is
astronomically large, or all but 0, and many decades away from the one before. A third of such values is of
an ordinary size by chance, so that single ones cannot be told from measured ones, but a row of them can.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from typing import TYPE_CHECKING

from daqsvc.dsp.quality.unit import MOST_IN_ANY_UNIT

if TYPE_CHECKING:
    from collections.abc import Iterable

LEAST_IN_ANY_UNIT = 1e-12
"""A smaller value that is not 0 is hardly measured. It may be what is left of a computation, or dies away."""
REMEMBERED = 16
"""Values that are evaluated together; a third is of an ordinary size by chance, but never all of them."""
FEWEST = 2
LEAST_SHARE = 0.25
"""Number and share of them that must be impossible: a glitch now and then does not count."""
DECADES = 6.0
"""A step over so many decades up is no quantity that is measured; down it may be one that dies away."""
STEPS = 2
"""Number of such steps: a machine that starts makes one."""
STILL = 8
"""Equal values in a row, all nearly 0, from which on they neither decay nor are rounding."""


class Misread:
    """Whether the values of one channel are bytes in the wrong order; goes by what came before."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=REMEMBERED)
        self._is_misread = False

    def update(self, values: Iterable[float]) -> str:
        """Take in values; returns the evidence for a wrong order or type, in a clause, empty if nothing.

        Once that is so, it stays until the last `REMEMBERED` values are all of a size that can be measured.

        Args:
            values: in the order in which they came; finite.
        """
        self._values.extend(map(float, values))
        impossible = [value for value in self._values if _is_impossible(value)]
        self._is_misread = bool(impossible) and (self._is_misread or self._speaks_for_it(impossible))
        if not self._is_misread:
            return ""
        listed = ", ".join(f"{value:.3g}" for value in list(dict.fromkeys(impossible))[-3:])
        return f"reads {listed}, which no sensor measures"

    def _speaks_for_it(self, impossible: list[float]) -> bool:
        if len(impossible) < max(FEWEST, LEAST_SHARE * len(self._values)):
            return False
        sizes = [math.log10(abs(value)) for value in impossible]
        is_astronomic = max(sizes) > math.log10(MOST_IN_ANY_UNIT)
        return (is_astronomic and max(sizes) - min(sizes) >= DECADES) or self._jumps() or self._stands_still()

    def _jumps(self) -> bool:
        there = [value for value in self._values if value]
        steps = [
            math.log10(abs(now)) - math.log10(abs(before))
            for before, now in pairwise(there)
            if _is_impossible(before) or _is_impossible(now)
        ]
        return sum(step >= DECADES for step in steps) >= STEPS

    def _stands_still(self) -> bool:
        last = list(self._values)[-STILL:]
        return len(last) == STILL and len(set(last)) == 1 and _is_impossible(last[0])


def _is_impossible(value: float) -> bool:
    return value != 0.0 and not LEAST_IN_ANY_UNIT <= abs(value) <= MOST_IN_ANY_UNIT
