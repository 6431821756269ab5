"""What a person may do."""

from __future__ import annotations

from enum import StrEnum


class Role(StrEnum):
    """What a person may do."""

    VIEWER = "viewer"
    """Look."""
    OPERATOR = "operator"
    """Look, and handle alarms."""
