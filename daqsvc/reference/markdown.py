"""What the pages are made of: anchors, tables, values as TOML."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

NOTE = "<!-- Written by `make reference` from the code: change the words there, not here. -->"


class WordsMissingError(Exception):
    """Something that users see has no words.

    Attributes:
        gaps: what, and where to write them.
    """

    def __init__(self, gaps: Sequence[str]) -> None:
        super().__init__("; ".join(gaps))
        self.gaps = tuple(gaps)


def page(title: str, about: str, *parts: str) -> str:
    """A page from its parts, one blank line between them."""
    return "\n\n".join([f"# {title}", NOTE, about, *(part for part in parts if part)]) + "\n"


def anchored(heading: str, name: str) -> str:
    """A heading that links find by ``name``, whatever becomes of its words."""
    return f'<a id="{name}"></a>\n\n{heading}'


def code(text: str) -> str:
    """A text as it is typed; empty for none."""
    if not text:
        return ""
    fence = "``" if "`" in text else "`"
    return f"{fence}{text}{fence}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table without the columns in which nothing stands; empty without rows."""
    rows = [[_cell(text) for text in row] for row in rows]
    kept = [at for at in range(len(header)) if any(row[at] for row in rows)]
    if not rows:
        return ""
    lines = [[header[at] for at in kept], ["---"] * len(kept), *([row[at] for at in kept] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", r"\|")


def toml(value: Any) -> str:
    """A value as a machine file has it."""
    match value:
        case dict():
            return (
                f"{{ {', '.join(f'{key} = {toml(item)}' for key, item in value.items())} }}"
                if value
                else "{}"
            )
        case list() | tuple():
            return f"[{', '.join(map(toml, value))}]"
        case float() if value.is_integer() and abs(value) >= 1e16:
            return f"{value:g}"
        case int() if not isinstance(value, bool) and abs(value) >= 100_000:
            return f"{value:_}"
        case _:
            return json.dumps(value, ensure_ascii=False)
