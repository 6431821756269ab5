"""Golden texts: kept in `golden/`, held against what comes out now, taken anew."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

FOLDER = Path(__file__).with_name("golden")
TAKE = "make guard ARGS=--take"
_MOST_LINES = 400
"""Of a difference that are shown; a change of every message would flood the terminal."""


def compare(name: str, text: str, folder: Path) -> str:
    """What differs from the golden text of that name, as a unified diff; empty if nothing does."""
    path = folder / name
    kept = path.read_text(encoding="utf-8") if path.exists() else ""
    if kept == text:
        return ""
    lines = list(
        difflib.unified_diff(
            kept.splitlines(), text.splitlines(), f"golden/{name}", f"now/{name}", lineterm="", n=4
        )
    )
    more = len(lines) - _MOST_LINES
    return "\n".join([*lines[:_MOST_LINES], *([f"... and {more} more lines"] if more > 0 else [])])


def take(texts: Mapping[str, str], folder: Path) -> None:
    """Keep texts as the golden ones."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def unwanted(names: set[str], folder: Path) -> Iterator[Path]:
    """Golden texts that nothing comes out for any more."""
    return (path for path in sorted(folder.glob("*.txt")) if path.name not in names)
