"""What a stream of bytes is: lines of text, frames behind a sync word, or COBS frames.

Pure functions of bytes. Bytes that were sampled at a wrong baud rate are none of these, so that the score
shows the right rate, too.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drivers.serial.recognise_frames import BinaryFrames, cobs_frames, sync_frames
from drivers.serial.recognise_lines import TextLines, text_lines

LEAST_BYTES = 24
"""Of fewer nothing is reported."""
CONCLUSIVE = 0.9
"""No other baud rate need be tried."""
SURE = 0.6
"""What has a lower score is a guess: it may be chance."""
MOST_BYTES = 65_536
"""Of a longer stream the end is examined."""

_TEXT = frozenset(range(0x20, 0x7F)) | {0x09, 0x0A, 0x0D}
LEAST_PRINTABLE = 0.95
"""Share of printable bytes from which on they may be text."""
_SAME_PARITY = 0.98
_OF_UNITS = re.compile(
    rb"(?<=[ -~])(?:\xc2[\xb0\xb2\xb3\xb5]|\xce\xbc|[\xb0\xb2\xb3\xb5])(?=[A-Za-z/,;|*\t\r\n ]|$)"
)
"""Letters of units such as a degree or a mu, in UTF-8 or Latin-1, between others of a text."""
_UTF_8 = re.compile(rb"[\xc2-\xdf][\x80-\xbf]|[\xe0-\xef][\x80-\xbf]{2}|[\xf0-\xf4][\x80-\xbf]{3}")
"""What may be a letter in UTF-8."""
_OF_WORDS = re.compile(
    rb"(?<=[A-Za-z])[\x80-\xff]{1,2}(?![\x80-\xff])|(?<![\x80-\xff])[\x80-\xff]{1,2}(?=[A-Za-z])"
    rb"|(?<=[,;|\t ])[\xa1-\xff](?=[,;|\t\r\n ])|(?<=[0-9])[\x80-\xff](?=[,;|\t\r\n ])"
)
"""Letters in a table of 256 such as Latin-1 or cp1252: one or two beside others, or a sign alone."""
_MOST_OF_WORDS = 0.15
"""Share of the bytes that such letters are at most. In UTF-8 all of them may be beyond ASCII."""
_ENCLOSED = re.compile(rb"\x02[\t\x20-\x7e\x80-\xff]{3,}\x03")
_LEAST_ENCLOSED = 3
_MOSTLY = 0.75

Parity = Literal["none", "even", "odd"]


@dataclass(frozen=True, slots=True)
class Recognised:
    """What a stream is.

    Attributes:
        score: 0 if it is nothing that is known, 1 if it is beyond doubt.
        what: the finding; None if there is none.
        parity: of characters of 7 bits; None if characters have 8.
        printable: share of the bytes that are text.
        is_enclosed: whether it is text between STX and ETX, which the driver cannot read.
    """

    score: float
    what: TextLines | BinaryFrames | None = None
    parity: Parity | None = None
    printable: float = 0.0
    is_enclosed: bool = False

    @property
    def sure(self) -> bool:
        """Whether there is a finding that is more than a guess."""
        return self.what is not None and self.score >= SURE


def recognised(data: bytes, line_errors: int = 0) -> Recognised:
    """What bytes are that came over a serial line of 8 bits without parity.

    Args:
        data: as they came, from anywhere in a frame on.
        line_errors: characters among them that the UART has found without a stop bit.
    """
    data = data[-MOST_BYTES:]
    if len(data) < LEAST_BYTES:
        return Recognised(0.0, printable=_printable(data))
    parity = seven_bits(data)
    text = bytes(byte & 0x7F for byte in data) if parity else data
    printable = _printable(text)
    if _is_enclosed(text):
        # Of one length, such text looks like frames whose sync word is part of it.
        return Recognised(CONCLUSIVE, None, parity, printable, is_enclosed=True)
    candidates = [Recognised(0.3 * printable**2, None, None, printable)]
    if printable >= LEAST_PRINTABLE and (lines := text_lines(text)) is not None:
        damaged = sum(len(kind.damaged) for kind in lines.kinds)
        regular = 1 - damaged / sum(len(kind.lines) for kind in lines.kinds)
        score = (0.6 + 0.35 * regular) * printable + 0.05 * (lines.checksum in {"xor", "crc16"})
        candidates.append(Recognised(min(score, 1.0), lines, parity, printable))
    if all(one.score < CONCLUSIVE for one in candidates):  # the search for frames takes seconds
        candidates += [
            Recognised(frames.score, frames, None, printable)
            for frames in (cobs_frames(data), sync_frames(data))
            if frames is not None
        ]
    best = max(candidates, key=lambda one: one.score)
    # A few characters are cut where the port was opened; at a wrong rate many are without stop bit.
    return Recognised(
        best.score * max(0.0, 1 - 5 * line_errors / len(data)), best.what, best.parity, printable
    )


def _printable(data: bytes) -> float:
    """Share of bytes that are text; 0 of none."""
    if not data:
        return 0.0
    plain = _OF_UNITS.sub(b"", data)
    # Of a few bytes, more letters would make more of them text by chance.
    if len(data) >= LEAST_BYTES:
        plain = _UTF_8.sub(_unless_letter, plain)
        words = _OF_WORDS.sub(b"", plain)
        plain = words if len(plain) - len(words) <= _MOST_OF_WORDS * len(data) else plain
    return 1 - sum(byte not in _TEXT for byte in plain) / len(data)


def _unless_letter(match: re.Match[bytes]) -> bytes:
    """Nothing in place of a letter in UTF-8; what is none stays."""
    try:
        return b"" if match[0].decode().isprintable() else match[0]
    except UnicodeDecodeError:
        return match[0]


def _is_enclosed(data: bytes) -> bool:
    """Whether nearly all bytes are text between STX and ETX; check bytes may follow each."""
    enclosed = _ENCLOSED.findall(data)
    return len(enclosed) >= _LEAST_ENCLOSED and sum(map(len, enclosed)) >= _MOSTLY * len(data)


def seven_bits(data: bytes) -> Parity | None:
    """The parity of characters of 7 bits, read as 8 bits without parity; None if they do not look so.

    The eighth bit is then the parity of the others, whatever they are, and it is set in some of them.
    """
    ones = np.unpackbits(np.frombuffer(data, np.uint8)[:, None], axis=1).sum(axis=1) % 2
    high = np.frombuffer(data, np.uint8) >= 0x80
    low_text = sum(byte & 0x7F in _TEXT for byte in data) / len(data)
    if not high.any() or high.all() or low_text < LEAST_PRINTABLE:
        return None
    if (ones == 0).mean() >= _SAME_PARITY:
        return "even"
    return "odd" if (ones == 1).mean() >= _SAME_PARITY else None
