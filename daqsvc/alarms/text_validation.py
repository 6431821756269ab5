"""What holds for a command's text whichever way it comes: it stands in logs, at terminals and in events."""

from __future__ import annotations

import json


def printable(text: str) -> str:
    """Text that does to a terminal, or to the order of the letters about it, nothing but stand there.

    Control characters (C0 and C1), line and paragraph separators and what turns the direction of writing are
    none (Unicode categories Other and Separator, but for the space).

    Raises:
        ValueError: it is something else.
    """
    if not text.isprintable():
        raise ValueError("must be printable, in one line")
    return text


def refuse_twice(raw: bytes) -> None:
    """Refuse a JSON object in which a key stands twice: nobody knows which one is meant.

    Args:
        raw: JSON without deep nesting.

    Raises:
        ValueError: a key stands twice, or it is no JSON.
    """
    json.loads(raw, object_pairs_hook=_once)


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    made = dict(pairs)
    if len(made) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in made if keys.count(key) > 1)
        raise ValueError(f"key {twice!a} stands twice; say it once")
    return made
