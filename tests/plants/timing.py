"""How long the records of the plants are, for those who make them and those who judge them."""

from __future__ import annotations

PER_REV = 64
"""Samples in a revolution."""
REVOLUTIONS = 700
"""In a record: a quarter of a minute at 3000 rpm."""
ONSET_REV = 300
"""When the fault comes."""
