"""Lines of a machine file: keys, values and what a newcomer should know about them."""

from __future__ import annotations

import json
from typing import Any

_COMMENT_AT = 33
"""Column where comments begin, as in the examples."""


class Hexadecimal(int):
    """A whole number that people write in hexadecimal."""


def toml(value: Any) -> str:
    """A value of TOML.

    Args:
        value: text without control characters, number, truth value, or a list or table of such.
    """
    match value:
        case bool():
            return "true" if value else "false"
        case Hexadecimal():
            return f"{value:#x}"
        case str():
            # A text of JSON is a basic string of TOML, as long as nothing in it is beyond printing.
            return json.dumps(value, ensure_ascii=False)
        case list() | tuple():
            return f"[{', '.join(map(toml, value))}]"
        case dict():
            return f"{{ {', '.join(f'{key} = {toml(item)}' for key, item in value.items())} }}"
        case _:
            return repr(value)


def entry(key: str, value: Any, comment: str = "") -> str:
    """``key = value``, with a comment behind it."""
    return behind(f"{key} = {toml(value)}", comment)


def behind(text: str, comment: str) -> str:
    """A line with a comment behind it."""
    return f"{text:<{_COMMENT_AT - 2}}  # {comment}" if comment else text


def array(key: str, tables: list[dict[str, Any]]) -> list[str]:
    """An array of tables, one a line."""
    return [f"{key} = [", *(f"  {toml(table)}," for table in tables), "]"]
