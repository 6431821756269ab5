"""Sentences on what was found on a serial port: ``daqsvc sniff`` and ``daqsvc new`` state it alike."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

from daqsvc.documentation import documented_in
from drivers.serial.settings import LONGEST_BESIDE
from drivers.sniffing import quoted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

WIDEST = 100
"""Characters of a line that are shown."""
_BEHIND_NUMBER = re.compile(r" *[+-]?[0-9]+(?:[.,][0-9]+)? *([^0-9.,: ][^0-9]*?) *")
_IN_FRONT = re.compile(r" *([^\W\d][^=:]*[=:])(?= *[+-]?[.,]?[0-9])")
NO_NUMBERS = "No column is a number, such as 22.5 or NAME=22.5: JSON and hex are not read."
LINES_NEED = "A stream needs a column of numbers, best beside one that counts lines or has the device's time"
"""Why nothing is proposed of lines."""


def frames_need(payload: int) -> str:
    """The same of binary frames with so many bytes between sync word and CRC."""
    return f"A stream needs a counter: none was found in the {payload} bytes of payload, or nothing behind it"


def unchecked_words(crc: str) -> str:
    """What it means that frames have a CRC that the driver does not know."""
    return f"The driver does not check {crc}: a damaged frame is taken for a good one."


def width_words(bits: int, step: int, rate_hz: float | None) -> str:
    """What it means that a counter may be wider, or narrower, than it is taken for."""
    longer = ""
    if rate_hz and bits < 32:
        seconds = math.ceil(1.2 * 256 / step / rate_hz)
        longer = f", or listen until a byte of it carries: --seconds {seconds}"
    return (
        f"That the counter has {bits} bits is a guess: its upper bytes did not change. With another "
        f"width all values are of wrong bytes. Remedy: see the device's manual{longer}."
    )


def sync_words(sync: str) -> str:
    """What it means that frames without a check begin with the same bytes."""
    return (
        f"That frames begin with {sync} is a guess, as they have no check that is known. A byte of a value "
        "may be among these that did not change yet: when it does, all frames are lost. Remedy: correct "
        "sync_word by the device's manual."
    )


def overrun_words(baud: int, proposed: int) -> str:
    """What it means that more bytes come than a baud rate carries."""
    return (
        f"More bytes come than {baud} bit/s carry: the port does not use its baud rate, as USB devices often "
        f"do not. {proposed} bit/s, which carry them, are proposed."
    )


ANY_BAUD = "as good as any: the port does not use it"
"""What the baud rate of a port is that brings the same at all of them."""


MUST_TURN = "one that begins again at 0 after 999, 9999 or the like is no counter for daqsvc"
"""What a few seconds of a counter do not show."""
UNSEEN_WIDTH = (
    "That the counter has 32 bits is a guess: write bits = 16 in it if it begins again at 0 after 65535, "
    "bits = 8 if after 255."
)
"""The same of a counter that was not seen to begin again: one that is taken too narrow loses all lines."""


def seen_width(bits: int) -> str:
    """What is known of a counter that was seen to begin again."""
    return f"begins again at 0 after {2**bits - 1}, as it was seen"


def turn_words(name: str, turns_at: int) -> str:
    """What a column means for daqsvc that begins again at 0 after 99, 999, ..."""
    return (
        f"{name} begins again at 0 after {turns_at - 1}: daqsvc cannot count lines by it. It would report "
        "each turn as a restarted counter [B37], and samples as lost that are not. Use a column with the "
        f"device's time, if there is one. See {documented_in('serial')}."
    )


def other_lines_words(count: int, heard: int, example: str) -> str:
    """What it means that some lines are not like the others."""
    are = "is" if count == 1 else "are"
    return (
        f"{count} of {heard} lines {are} not of this layout, e.g. {quoted(cut_off(example))}: "
        "daqsvc counts such lines, and does not read them"
    )


def other_kinds_words(prefixes: Sequence[str]) -> str:
    """What it means for a file with one stream that lines of other kinds come, too."""
    return (
        f"Lines that begin with {', '.join(prefixes)} come, too. This file reads one kind of line: add a "
        "stream for each other one, as daqsvc sniff serial writes it."
    )


def absent_words(name: str, absent: int, heard: int, text: str) -> str:
    """What it means that a column has no value in some lines."""
    shown = quoted(printable(text)) if text else "nothing"
    return (
        f"{name} has no value in {absent} of {heard} lines: {shown} is there. Only these samples of it are "
        f"missing. See {documented_in('serial')}."
    )


def no_number_words(texts: Mapping[str, str]) -> str:
    """What it means that columns, by name, are no numbers."""
    too_long = {name: words for name, text in texts.items() if (words := _too_long_words(name, text))}
    others = {name: text for name, text in texts.items() if name not in too_long}
    return " ".join([*too_long.values(), *([_no_number_words(others)] if others else [])])


def _too_long_words(name: str, text: str) -> str:
    """What it means that more is around the number of a column than its keys can state; empty if not so."""
    named = _IN_FRONT.match(text)
    behind = _BEHIND_NUMBER.fullmatch(text[named.end() if named else 0 :])
    for found, where, key in ((named, "in front of", "prefix"), (behind, "behind", "suffix")):
        if found is not None and len(found[1]) > LONGEST_BESIDE:
            return (
                f"Column {name} is left out: {quoted(printable(found[1]))} {where} its number has "
                f"{len(found[1])} characters, and {key} takes {LONGEST_BESIDE} at most. If it is to be "
                "watched, have the device send a shorter text."
            )
    return ""


def _no_number_words(texts: Mapping[str, str]) -> str:
    name, text = next(iter(texts.items()))
    example = quoted(cut_off(text))
    if len(texts) == 1:
        begin = (
            f"Column {name} is left out, as not every line has a number there, but e.g. {example}. If it is"
        )
    else:
        begin = (
            f"Columns {', '.join(texts)} are left out: not every line has numbers there, but e.g. {example}. "
            "If they are"
        )
    beside = _BEHIND_NUMBER.fullmatch(text)
    remedy = "have the device send decimal numbers"
    if beside is not None:
        suffix = quoted(printable(beside[1]))
        remedy = f"write suffix = {suffix} in its channel if this is always there, or {remedy}"
    return f"{begin} to be watched, {remedy}."


def cut_off(text: str) -> str:
    """The begin of a text of a device, with a sign where more of it follows."""
    return printable(text[:WIDEST]) + "..." * (len(text) > WIDEST)


def printable(text: str) -> str:
    """A text of a device as a terminal can show it."""
    return "".join(letter if letter.isprintable() or letter in "\n\t" else "?" for letter in text)
