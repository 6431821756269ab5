"""The number that somebody meant who wrote a unit behind it, ``k`` for a thousand, or O for a zero."""

from __future__ import annotations

import math
import re

_NUMBER = re.compile(r"(?P<number>[+-]?\d[\d_]*(?:[.,]\d+)?(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\s#]*)")
_PREFIXED = re.compile(r"(?P<prefix>[kKM])(?:bit(?:/s)?|bps|Bd|Baud|Hz|S/s|sps)?", re.IGNORECASE)
_RATE = re.compile(r"baud|bitrate|hz|rate|length|size|samples")
_PREFIXES = {"k": 1e3, "K": 1e3, "M": 1e6}
_OTHER_UNITS = {
    ("_s", "ms"): 1e-3,
    ("_s", "min"): 60.0,
    ("_s", "h"): 3600.0,
    ("_ms", "s"): 1e3,
    ("_ms", "us"): 1e-3,
    ("_rpm", "hz"): 60.0,
}
"""What a number is multiplied by where the key ends with one unit, and another one is written."""


_ALIKE = re.compile(r"[+-]?(?=[._OolI]*\d)[\dOolI][\d_OolI]*(?:\.[\dOolI]+)?")
_DIGITS = {"O": "0", "o": "0", "l": "1", "I": "1"}
_NAMES = {"0": "zero", "1": "one"}


def with_digits(text: str) -> tuple[str, str] | None:
    """A number that has letters for digits, with these digits, and what that takes for granted.

    Args:
        text: e.g. ``5O`` or ``l0.5``.

    Returns:
        e.g. ``50`` and ``if the letter O is a zero``; None if it is something else.
    """
    match = _ALIKE.fullmatch(text.strip())
    letters = [] if match is None else [one for one in dict.fromkeys(match[0]) if one in _DIGITS]
    if match is None or not letters:
        return None
    number = "".join(_DIGITS.get(one, one) for one in match[0])
    number = re.sub(r"^([+-]?)0+(?=\d)", r"\1", number)
    return number, "if " + " and ".join(f"the letter {one} is a {_NAMES[_DIGITS[one]]}" for one in letters)


def number_meant(text: str, key: str) -> float | None:
    """The number that begins a text, in the unit of its key.

    Args:
        text: e.g. ``990 rpm``, ``250k`` or ``115200 8N1``.
        key: name of the key, which ends with its unit if it has one.

    Returns:
        None if the text does not begin with a number, or it is not clear which one is meant.
    """
    if with_digits(text) is not None:
        return None  # the number that it begins with has lost a digit
    match = _NUMBER.match(text.strip())
    if match is None or text.strip()[match.end("number") :][:1] in {".", ",", ":", "-"}:
        return None
    value = float(match["number"].replace("_", "").replace(",", "."))
    unit = match["unit"]
    prefixed = _PREFIXED.fullmatch(unit)
    if prefixed is not None and _RATE.search(key):
        return value * _PREFIXES.get(prefixed["prefix"], 1.0)
    for (ending, other), factor in _OTHER_UNITS.items():
        if key.endswith(ending) and unit.lower() == other:
            return value * factor
    return value


def as_toml(value: float, *, whole: bool) -> str:
    """A number as it is written in a machine file; a whole one has no decimal point."""
    return f"{value:.0f}" if whole else repr(float(f"{value:.12g}"))


_SLOW_RPM = 60.0
"""Below it few machines turn."""


def thousands_meant(speed_rpm: float) -> int | None:
    """The speed that may be meant where the point of a slow one is one between thousands, e.g. 1485 of 1.485.

    None where it cannot be: of a whole number, a faster shaft, or with more than three decimals.
    """
    meant = round(1000 * speed_rpm)
    is_slow = abs(speed_rpm) < _SLOW_RPM and speed_rpm != int(speed_rpm)
    return meant if is_slow and math.isclose(meant, 1000 * speed_rpm, rel_tol=1e-9) else None
