"""A question of ``daqsvc new``, and how what is typed becomes a value.

Those about a bus are in the folder of its driver: see `drivers.bus_questions`.
"""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

from drivers.names import LONGEST_NAME

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

Answers = dict[str, Any]
"""Values by the key of their question."""

NONE = "none"
LONGEST_LINE = 256
"""Characters of a text of a machine file; for names see `drivers.names`."""
SENSOR = "sensor"
"""First part of the keys that belong to one channel: ``sensor.CHANNEL.TOPIC``."""


@dataclass(frozen=True, slots=True)
class Topic:
    """What a question is about, independent of its default.

    Attributes:
        text: the question.
        help: a sentence for whoever types ``?``.
    """

    text: str
    help: str


@dataclass(frozen=True, slots=True)
class Question:
    """A question as the answers before have made it.

    Attributes:
        key: of the answer; also the name of the option.
        topic: what it is about.
        read: makes a value of the text, or raises `ValueError` with the reason.
        default: text that is taken for an empty answer; None where there must be one.
        choices: what may be answered, with what each means; empty if it is free.
        doubt: why a value is most likely a mistake, and what to offer instead; None if it is none. Whoever
            types it again means it.
        quiet: whether the default is taken without asking, unless an option states something else.
        beside: what was heard of the default, shown behind it; may be empty.
    """

    key: str
    topic: Topic
    read: Callable[[str], Any]
    default: str | None = None
    choices: Mapping[str, str] | None = None
    quiet: bool = False
    doubt: Callable[[Any], tuple[str, str] | None] | None = None
    beside: str = ""


def sensor_key(channel: str, topic: str) -> str:
    """Key of a question about one channel."""
    return f"{SENSOR}.{channel}.{topic}"


def one_of(choices: Mapping[str, str]) -> Callable[[str], str]:
    """One of some words, or the beginning of it that only it has."""

    def read(text: str) -> str:
        word = text.lower()
        if word in choices:
            return word
        begun = [choice for choice in choices if word and choice.startswith(word)]
        if len(begun) != 1:
            raise _no_choice(text, choices, begun)
        return begun[0]

    return read


def _no_choice(text: str, choices: Mapping[str, str], begun: Sequence[str] = ()) -> ValueError:
    """The message about a text that is none of the choices, with those that may be meant."""
    near = begun or get_close_matches(text.lower(), choices, n=1)
    meant = f"; did you mean {' or '.join(near)}?" if near else ""
    return ValueError(f'"{text}" is not one of {", ".join(choices)}{meant}')


def exactly(choices: Mapping[str, str]) -> Callable[[str], str | None]:
    """One of some words as they are written; None for `NONE`."""

    def read(text: str) -> str | None:
        if text not in choices:
            raise _no_choice(text, choices)
        return None if text == NONE else text

    return read


def line(text: str) -> str:
    """Any text on one line."""
    if not text.strip() or not text.isprintable():
        raise ValueError("it must be one line of plain text")
    if len(text.strip()) > LONGEST_LINE:
        raise ValueError(f"it has {len(text.strip())} characters; {LONGEST_LINE} are allowed: shorten it")
    return text.strip()


def title(text: str) -> str:
    """A text that holds a short name: see `short_name`."""
    if not short_name(line(text)):
        raise ValueError(
            f'"{text}" holds no letter from a to z and no digit, and topics and file names need one: '
            f"write e.g. pump-3 {text}"
        )
    return line(text)


def short_name(text: str) -> str:
    """The name for topics and files that a text holds: without accents, lower case, ``-`` between words."""
    plain = unicodedata.normalize("NFKD", text.replace("ß", "ss"))
    ascii_only = plain.encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9_]+", "-", ascii_only.lower())[:LONGEST_NAME].strip("-")


def name(text: str) -> str:
    """A name of the machine file."""
    if not re.fullmatch(r"\.*[A-Za-z0-9_-][A-Za-z0-9_.-]*", text) or len(text) > LONGEST_NAME:
        raise ValueError(
            f'"{text}" is no name: use up to {LONGEST_NAME} letters from a to z, digits, "_", "." and "-"'
        )
    return text


def names(text: str) -> tuple[str, ...]:
    """Names with commas between."""
    words = text.split()
    if len(words) > 1 and "," not in text:
        raise ValueError(f'"{text}" has no commas: write {", ".join(words)}')
    parts = tuple(name(part.strip()) for part in text.split(","))
    if len(set(parts)) < len(parts):
        raise ValueError(f'"{text}" has a name twice')
    return parts


def number(text: str) -> float:
    """A number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f'"{text}" is not a number; write e.g. 0.5 or 1480')
    return value


_HZ = ("Hz", "1/s", "s-1", "samples/s", "Sa/s", "S/s", "SPS")
_RPM = ("rpm", "1/min", "min-1", "r/min", "rev/min", "U/min")


def number_in(*units: str) -> Callable[[str], float]:
    """A number; one of these units may be written behind it."""
    # The end of a number is no unit: the unit 1 means none, and 1481/min is no speed of 148.
    with_letters = [unit for unit in units if re.search("[^\\W\\d]|[%°]", unit)]
    behind = "|".join(rf"{' +' if unit[0].isdigit() else ' *'}{re.escape(unit)}" for unit in with_letters)

    def read(text: str) -> float:
        return number(re.sub(rf"(?<=[\d. ])(?:{behind})\s*$", "", text, flags=re.IGNORECASE))

    return read if with_letters else number


AUTO = "auto"
"""Answer that leaves a question to the program."""
_LONGEST_S = 3600.0


def seconds_or_auto(text: str) -> float | None:
    """A time to listen; None for ``auto``."""
    if text.lower() == AUTO:
        return None
    value = number_in("s", "sec", "second", "seconds")(text)
    if not 0 < value <= _LONGEST_S:
        raise ValueError(f'"{text}": give a time above 0, up to {_LONGEST_S:g} s, or {AUTO}')
    return value


def rate_hz(text: str) -> float:
    """A sampling rate; its unit may be written behind it."""
    value = number_in(*_HZ)(text)
    if value < 1e-4:
        raise ValueError(f'"{text}" is not a rate: write how many samples there are in a second, e.g. 2560')
    return value


def speed_rpm(text: str) -> float:
    """The speed of a shaft that turns; its unit may be written behind it."""
    value = number_in(*_RPM)(text)
    if abs(value) < 1e-3:
        raise ValueError(f'"{text}" is a shaft that stands still: write its usual speed')
    return value


def doubt_of_speed(speed_rpm: float) -> tuple[str, str] | None:
    """See `Question.doubt`: 1.485 is most likely 1485, with a point between the thousands."""
    from daqsvc.settings.written_numbers import thousands_meant  # noqa: PLC0415 - brings the settings

    meant = thousands_meant(speed_rpm)
    if meant is None:
        return None
    reason = (
        f"{speed_rpm:g} rpm is slow for a shaft, and the point is a decimal point here. Enter takes {meant}; "
        f"type {speed_rpm:g} again if the shaft turns so slowly"
    )
    return reason, f"{meant}"


def whole(text: str) -> int:
    """A whole number, hexadecimal with ``0x``."""
    try:
        return int(text, 0)
    except ValueError:
        raise ValueError(f'"{text}" is not a whole number; write e.g. 17 or 0x101') from None


def bit_rate(text: str) -> int:
    """A bit rate in bit/s; ``500k`` and ``1M`` are those that everybody states."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([kM]?)(?:bit/s|bps|bit|bd|baud)?", text.strip(), re.IGNORECASE)
    if match is None:
        raise ValueError(f'"{text}" is not a bit rate; write it in bit/s, e.g. 500000 or 500k')
    value = float(match[1]) * {"": 1, "k": 1e3, "m": 1e6}[match[2].lower()]
    if not value.is_integer():
        raise ValueError(f'"{text}" is not a whole number of bit/s; write e.g. 500000 or 500k')
    return int(value)


def whole_or_none(text: str) -> int | None:
    """A whole number, or ``none``."""
    return None if text.lower() == NONE else whole(text)


def number_or_none(text: str) -> float | None:
    """A number, or ``none``."""
    return None if text.lower() == NONE else number(text)


def text_or_none(text: str) -> str | None:
    """A text, or ``none``."""
    return None if text.lower() == NONE else line(text)


YES_NO = {"yes": "", "no": ""}


def yes_no(text: str) -> bool:
    """``yes`` or ``no``."""
    return one_of(YES_NO)(text) == "yes"
