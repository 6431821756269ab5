"""A figure of a detector that is shown by itself: in Home Assistant, to a Sparkplug host, on a page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

STALE_S = 120
"""Age from which on a figure is no longer true, unless it is stated less often than that."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A figure of a detector's statements that is shown by itself.

    Attributes:
        detector: whose statements.
        kind: where it is in them.
        key: its name there, e.g. ``"rms"`` or ``"F1"``.
        unit: its unit as in the statements, e.g. ``"um"``; empty for none.
        stale_s: age from which on a figure is no longer true.
    """

    detector: str
    kind: Literal["statistics", "probabilities"]
    key: str
    unit: str = ""
    stale_s: int = STALE_S
