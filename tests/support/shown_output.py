"""Compares what a page shows as the output of a command with what came: figures may differ, words may not."""

from __future__ import annotations

import re

LEFT_OUT = "..."
_FIGURES = re.compile(r"(?:(?<![A-Za-z])[-+]?\d[\d,.]*(?:e[-+]?\d+)?)+")
_DUMP = re.compile(r"[0-9a-f]{6} ( [0-9a-f]{2}){16}  .{16}")
_BYTES = re.compile(r"\b[0-9a-f]{2}( [0-9a-f]{2}){3,}\b")


def shape(line: str) -> str:
    """A line with all figures alike, and all bytes in hex; a dump has text behind them."""
    line = line.strip()
    if _DUMP.fullmatch(line):
        return "dump"
    return re.sub(r"\s+", " ", _FIGURES.sub("#", _BYTES.sub("bytes", line)))


def differs(shown: str, output: str) -> str:
    """What is wrong with an output; "" if it has the lines that are shown, one behind the other.

    Args:
        shown: as the page has it, "" for nothing. ``...`` as a line matches any lines;
            within a line, for any text.
        output: what came; it may have other lines before and behind them.
    """
    expected = [shape(line) for line in shown.splitlines() if line.strip()]
    came = [shape(line) for line in output.splitlines() if line.strip()]
    if not expected or any(_follows(expected, came[begin:]) for begin in range(len(came))):
        return ""
    return f"{shown!r} is not in {output!r}"


def _follows(expected: list[str], came: list[str]) -> bool:
    """Whether lines begin as expected."""
    at, skipping = 0, False
    for line in expected:
        if line == LEFT_OUT:
            skipping = True
            continue
        pattern = re.compile(".*".join(map(re.escape, line.split(LEFT_OUT))))
        while skipping and at < len(came) and not pattern.fullmatch(came[at]):
            at += 1
        if at >= len(came) or not pattern.fullmatch(came[at]):
            return False
        at, skipping = at + 1, False
    return True
