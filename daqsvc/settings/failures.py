"""Words about a plugin that fails: for its author, and for whoever has to do without it."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path
from typing import Any

packages: dict[str, str] = {}
"""By the top-level module of a plugin, the distribution that brings it, with its version."""


def raised(error: Exception, kind: type[Any], part: str) -> str:
    """What code of a plugin has raised, in words for its author, with the line of the plugin's file.

    Args:
        error: as it was caught.
        kind: class of the plugin, or of one of its tables.
        part: what of it was asked.
    """
    home = getattr(sys.modules.get(kind.__module__), "__file__", None)
    frames = traceback.extract_tb(error.__traceback__)
    place = next((frame for frame in reversed(frames) if frame.filename == home), frames[-1])
    error_text = ": ".join(word for word in (type(error).__name__, " ".join(f"{error}".split())) if word)
    where = f"{Path(place.filename).name}, line {place.lineno}"
    return f"{part} of {kind.__module__}.{kind.__qualname__} has failed: {error_text} ({where})"


def mend_or_remove(kind: type[Any], table: str = "") -> str:
    """Who can put right a plugin that fails, and how to do without it.

    Args:
        kind: class of the plugin, or of one of its tables.
        table: what to remove, as people write it; empty if that is not known.
    """
    home = kind.__module__.partition(".")[0]
    remedy = f"have the authors of {packages.get(home, f'the package of {home}')} mend it"
    return f"{remedy}, or remove [{table}]" if table else remedy
