"""What is wrong with samples: clipped, stuck, missing, outliers, wrong unit, wrong rate.

A module for each question. What watches a machine and what reads a recording ask the same functions, with the
same limits; where the limits differ, the reason is beside them.
"""

from __future__ import annotations

from typing import Literal

from daqsvc.errors.recordings import NOT_JUDGED, UNFIT_SAMPLES

Quality = Literal["good", "missing", "not_ok"]
"""Of what a statement rests on: good, too little of it there, or not what a working sensor delivers."""


class RefusedError(ValueError):
    """What was measured cannot be judged; the message names the thing, its value and the remedy."""

    code = NOT_JUDGED


class UnfitError(RefusedError):
    """Samples cannot be judged: they are not what a healthy sensor delivers, or not enough of it.

    Args:
        thing: what is wrong, e.g. ``"channel"``.
        value: what was found.
        remedy: what to do about it.
    """

    code = UNFIT_SAMPLES

    def __init__(self, thing: str, value: str, remedy: str) -> None:
        super().__init__(f"{thing} {value}; {remedy}")
