"""How sure "normal" may be: only as sure as damage would have been seen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.bearing.race.verdict import PARTS

if TYPE_CHECKING:
    from collections.abc import Mapping

MOST_MARGIN = 10.0
"""A limit missed by more is no less missed."""
NOTE_DOUBT, REPAIR_DOUBT = 0.01, 0.1
"""Of each thing that weakens the test, and of each kind of defect of its samples: a convention."""
MOST_DOUBT = 0.5


def doubted(probability: Mapping[str, float], notes: int, repairs: int, lost: float) -> dict[str, float]:
    """Shares of belief in which "normal" gives to the parts what was perhaps not seen.

    Args:
        probability: share of belief per word, by the evidence alone.
        notes: number of other things that weaken the test.
        repairs: kinds of defects that were put right.
        lost: share of the record in which nothing could be seen.
    """
    doubt = min(NOTE_DOUBT * notes + REPAIR_DOUBT * repairs + lost, MOST_DOUBT)
    shares = dict(probability)
    given = doubt * shares.get("normal", 0.0)
    if given > 0.0:
        shares["normal"] -= given
        for part in PARTS:
            shares[part] = shares.get(part, 0.0) + given / len(PARTS)
    return shares
