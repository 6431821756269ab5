"""Compares what a page shows as the output of a command with what came: words, and figures within 2 %."""

from __future__ import annotations

import itertools
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

LEFT_OUT = "..."
FIGURE = "\0"
"""Represents a figure in a line of which the words are compared."""
CLOSE = 0.02
"""How far figures may be off, as a part of what is shown; so numbers below 50 that count are exact."""
_FIGURES = re.compile(r"(?:(?<![A-Za-z])[-+]?\d[\d,.]*(?:e[-+]?\d+)?)+")
_DUMP = re.compile(r"[0-9a-f]{6} ( [0-9a-f]{2}){16}  .{16}")
_BYTES = re.compile(r"\b[0-9a-f]{2}( [0-9a-f]{2}){3,}\b")


def shape(line: str) -> str:
    """A line with all figures alike, and all bytes in hex; a dump has text behind them."""
    return _FIGURES.sub("#", _plain(line))


def differs(shown: str, output: str, *, figures: bool = True) -> str:
    """What is wrong with an output; "" if it has the lines that are shown, one behind the other.

    Args:
        shown: as the page has it, "" for nothing. ``...`` as a line matches any lines;
            within a line, for any text.
        output: what came; it may have other lines before and behind them.
        figures: False if figures may be any others.
    """
    expected = [line for line in map(_plain, shown.splitlines()) if line]
    came = [line for line in map(_plain, output.splitlines()) if line]
    for judged in (False, True)[: 1 + figures]:
        lines = [one if one == LEFT_OUT else _line(one, figures=judged) for one in expected]
        if lines and not any(_follows(lines, came[begin:]) for begin in range(len(came))):
            return (
                f"figures of {shown!r} are not in {output!r}" if judged else f"{shown!r} is not in {output!r}"
            )
    return ""


def _plain(line: str) -> str:
    """A line with one blank wherever there are some, and without bytes in hex."""
    line = line.strip()
    return "dump" if _DUMP.fullmatch(line) else re.sub(r"\s+", " ", _BYTES.sub("bytes", line))


def _line(shown: str, *, figures: bool) -> Callable[[str], bool]:
    """What finds a line with the words of one that is shown, and its figures if they count."""
    parts = _FIGURES.sub(FIGURE, shown).split(LEFT_OUT)
    pattern = re.compile("(.*)".join(map(re.escape, parts)))
    expected = iter(_FIGURES.findall(shown))
    of_parts = [[*itertools.islice(expected, part.count(FIGURE))] for part in parts]

    def matches(line: str) -> bool:
        found = pattern.fullmatch(_FIGURES.sub(FIGURE, line))
        if found is None or not figures:
            return found is not None
        came = iter(_FIGURES.findall(line))
        for one, left_out in zip(of_parts, [*found.groups(), ""], strict=True):
            if not all(_is_close(figure, next(came)) for figure in one):
                return False
            skipped = left_out.count(FIGURE)
            next(itertools.islice(came, skipped, skipped), None)
        return True

    return matches


def _is_close(shown: str, came: str) -> bool:
    """Whether a figure is what is shown; a date, an address or the like has to be the same."""
    try:
        one, other = (float(text.rstrip(",.").replace(",", "")) for text in (shown, came))
    except ValueError:
        return shown == came
    return abs(one - other) <= CLOSE * abs(one)


def _follows(expected: list[str | Callable[[str], bool]], came: list[str]) -> bool:
    """Whether lines begin as expected."""
    at, skipping = 0, False
    for line in expected:
        if isinstance(line, str):
            skipping = True
            continue
        while skipping and at < len(came) and not line(came[at]):
            at += 1
        if at >= len(came) or not line(came[at]):
            return False
        at, skipping = at + 1, False
    return True
