"""What a driver brings to ``daqsvc sniff``: what is on a bus of its kind, without a machine file.

A sniffer listens or asks, and states what it found: for a person, for a program, and as tables of a machine
file to begin with. Those of this tree are named in `daqsvc.commands.sniff`; its own package registers
one by entry point in the group ``daqsvc.sniffers``, under the name of its driver.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import unicodedata
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from daqsvc.errors.command_line import NOT_OPENED, NOTHING_ON_BUS, WRONG_VALUE
from daqsvc.settings.units import is_of_peak, may_be_unit, unit_of
from drivers.names import sensor_name, unused

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable, Collection, Mapping, Sequence
    from typing import NoReturn


LONGEST_UNIT = 16
"""Letters that the unit of a sensor may have."""
_GUESS = "    # a guess by {}, its unit too: see the device's manual"
_ABOUT_0 = "the values, which swing about 0"
WAVEFORM_HZ = 100.0
"""Rate from which on samples are usually a waveform; below it, values that the device measures itself."""
_NEAR_WAVEFORM = 0.95
"""The clock of a device, and what was measured in a few seconds, are not exact."""
LEAST_SWINGING_HZ = 30.0
"""Rate from which on a vibration can be measured, where the values swing about 0."""
TYPE_OF_UNIT = {
    **dict.fromkeys(("g", "m/s2", "mg", "mm/s2"), "accelerometer"),
    "mm/s": "velocity",
    **dict.fromkeys(("um", "mm", "mil"), "proximity"),
}
"""Type of a sensor by the unit of its samples, if they are a waveform."""
_LEVEL_WORDS = (
    *("rms", "peak", "level", "crest", "kurt"),
    *("effektiv", "spitz", "scheitel", "pegel", "kennwert", "mittelwert", "gleichwert"),
)
"""What is in the names of values that a device has computed from a waveform: in English, and in German."""
_EFF = re.compile(r"E(?:FF|ff)(?![A-Za-z])|(?<![A-Za-z])eff(?![A-Za-z])")
"""Short for effective, or Effektivwert: the RMS. It is no part of Efficiency or Coeff."""
_UMLAUTS = str.maketrans(
    {**{umlaut: f"{base}e" for umlaut, base in zip("äöü", "aou", strict=True)}, "ß": "ss"}
)


class SniffError(Exception):
    """Nothing can be seen; the message names the thing, what is wrong with it, and the remedy.

    Args:
        message: for a person, one line.
        usage: whether the arguments are wrong, rather than the bus.
    """

    def __init__(self, message: str, *, usage: bool = False) -> None:
        super().__init__(message)
        self.usage = usage
        self.code = WRONG_VALUE if usage else NOT_OPENED


class NothingFoundError(SniffError):
    """The bus was examined, and nothing of use was on it.

    Attributes:
        figures: what was found all the same; see `Sniffed`.
    """

    def __init__(self, message: str, figures: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.code = NOTHING_ON_BUS
        self.figures: Mapping[str, Any] = figures or {}


class SniffTable(NamedTuple):
    """Rows with a title above each column."""

    titles: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Sniffed:
    """What was found on a bus.

    Attributes:
        parts: the same for a person, in this order: texts of whole lines, and tables.
        figures: the same for a program; of what JSON has.
        fragment: tables of a machine file to begin with, in TOML; empty if there is nothing to propose.
        problem: what is wrong, with what to check; empty if nothing is. It makes the verb fail.
    """

    parts: Sequence[str | SniffTable]
    figures: Mapping[str, Any]
    fragment: str = ""
    problem: str = ""


class Sniffer(ABC):
    """One kind of bus for ``daqsvc sniff KIND``; importing its module must be cheap.

    Attributes:
        help: one line for the list of kinds.
        description: what ``daqsvc sniff KIND --help`` begins with.
    """

    help: ClassVar[str]
    description: ClassVar[str]

    @abstractmethod
    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the arguments; heavy imports belong into `sniff`."""

    @abstractmethod
    def sniff(
        self, arguments: argparse.Namespace, stop: threading.Event, tell: Callable[[str], None]
    ) -> Sniffed:
        """Look at the bus. Nothing may wait for longer than some 0.2 s without checking ``stop``.

        Args:
            arguments: as parsed.
            stop: set when the person has seen enough; what was found so far is still returned.
            tell: states one line while it goes on.

        Raises:
            SniffError: nothing can be seen at all.
        """


def is_waveform_rate(rate_hz: float) -> bool:
    """Whether samples that come so often are usually a waveform."""
    return rate_hz >= _NEAR_WAVEFORM * WAVEFORM_HZ


def plain_name(channel: str) -> str:
    """The name of a channel in small letters, with umlauts as two letters, as most devices write them."""
    return unicodedata.normalize("NFC", channel).lower().translate(_UMLAUTS)


def by_name(channel: str) -> str | None:
    """The type of sensor that the name of a channel suggests; None if it suggests none."""
    low = plain_name(channel)
    if any(part in low for part in ("kph", "key", "phas", "tacho")):
        return "keyphasor"
    if _names_level(channel):
        return "trend"
    if low.startswith(("acc", "a_", "beschl")) or low == "a":
        return "accelerometer"
    if any(part in low for part in ("temp", "press", "druck", "speed", "rpm", "drehz")):
        return "trend"
    return None


def _names_level(channel: str) -> bool:
    low = plain_name(channel)
    return any(part in low for part in _LEVEL_WORDS) or _EFF.search(channel) is not None


class Values(NamedTuple):
    """What is known of the values of a channel.

    Attributes:
        unsigned: whether none can be below 0.
        least: the least one that was heard; NaN if none was.
        most: the greatest one.
    """

    unsigned: bool = False
    least: float = math.nan
    most: float = math.nan

    @property
    def keep_off_0(self) -> bool:
        """Whether they stay farther from 0 than they are apart, as those of a vibration never do."""
        nearest = min(abs(self.least), abs(self.most))
        return self.least * self.most > 0.0 and nearest > self.most - self.least


UNKNOWN_VALUES = Values()


def type_by_unit(
    channel: str, unit: str | None, *, waveform: bool, values: Values = UNKNOWN_VALUES
) -> str | None:
    """The type of the sensor on a channel, by the unit of its samples; None if the unit shows none.

    A value that the device has computed, such as an RMS, may come as often as a waveform. An alarm on the RMS
    of it would never come, as it hardly changes.

    Args:
        channel: its name.
        unit: as machine files write it; None where it is not known.
        waveform: whether the samples come as often as those of a waveform.
        values: what is known of them.
    """
    kind = TYPE_OF_UNIT.get(unit or "")
    if not waveform:
        return "trend"
    if kind is None:
        return None
    unsigned = values.unsigned and kind in {"accelerometer", "velocity"}
    # An accelerometer may measure gravity, too, and a probe its gap: the values of both keep off 0.
    still = values.keep_off_0 and kind == "velocity"
    return "trend" if _names_level(channel) or unsigned or still else kind


def span(least: float, most: float) -> str:
    """The values between two, in words; one where they are the same."""
    ends = f"{least:.6g}", f"{most:.6g}"
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def quoted(text: str) -> str:
    """A text as TOML has it."""
    return json.dumps(text, ensure_ascii=False)


def sensor_lines(
    stream: str,
    channels: Mapping[str, str],
    taken: set[str],
    rate_hz: float = math.inf,
    *,
    by_stream: bool = False,
    guess: bool = False,
    swinging: Collection[str] = (),
    values: Mapping[str, Values] | None = None,
) -> list[str]:
    """A table ``[[sensors]]`` for each channel of a stream, of the type that its unit is usual for.

    Args:
        stream: its name.
        channels: the unit of each channel; ``1`` where none is known.
        taken: names of sensors that there are; the new ones are added.
        rate_hz: samples per second; below `WAVEFORM_HZ` they are levels, no vibration.
        by_stream: whether a sensor is named after its stream, too, as others have channels of the same names.
        guess: whether what has no unit and comes as often as a waveform is taken for an acceleration, as
            ``daqsvc new`` takes it, unless its name suggests something else.
        swinging: channels whose values were seen to swing about 0, as those of a vibration do.
        values: what else is known of the values of channels.
    """
    lines: list[str] = []
    for channel, text in channels.items():
        swings = channel in swinging and rate_hz >= LEAST_SWINGING_HZ
        waveform = is_waveform_rate(rate_hz) or swings
        is_guess = guess and text == "1" and rate_hz < math.inf and waveform
        is_guess = is_guess and by_name(channel) in {None, "accelerometer"}
        by = _GUESS.format(_ABOUT_0 if swings else "the rate")
        unit_text = "g" if is_guess else text
        known = unit_of(unit_text)
        unit = unit_text.strip() if known is None else known.name
        known_values = (values or {}).get(channel, UNKNOWN_VALUES)
        by_unit = type_by_unit(channel, unit, waveform=waveform, values=known_values)
        kind = "trend" if is_of_peak(unit_text) else by_unit or "trend"
        if kind in {"trend", "proximity"}:  # a probe needs more keys than can be known here
            kind = "trend"
            unit = text.strip()
        if not (0 < len(unit) <= LONGEST_UNIT and unit.isprintable()):
            unit = "1"
        lines += [
            "",
            "[[sensors]]",
            f"name = {quoted(unused(sensor_name(channel, kind, stream, by_stream=by_stream), taken))}",
            f"type = {quoted(kind)}{by if is_guess else ''}",
            f"stream = {quoted(stream)}",
            f"channel = {quoted(channel)}",
            f"unit = {quoted(unit)}",
        ]
    return lines


def rounded_rate(rate_hz: float) -> float:
    """A rate that was measured, to three digits."""
    return float(f"{rate_hz:.3g}")


_USUAL = (1.0, 1.25, 1.28, 1.6, 2.0, 2.4, 2.5, 2.56, 3.2, 4.0, 4.8, 5.0, 5.12, 6.4, 8.0, 9.6, 10.0)
"""First digits of the rates that makers of devices choose, beside powers of 2."""
_NEAR = 0.005


def usual_rate(rate_hz: float) -> float:
    """The usual rate that a measured one is within 0.5 % of; else that one to three digits."""
    decade = 10.0 ** math.floor(math.log10(rate_hz))
    usual = [digits * decade for digits in _USUAL] + [2.0 ** round(math.log2(rate_hz))]
    nearest = min(usual, key=lambda one: abs(one - rate_hz))
    return round(nearest, 6) if abs(nearest - rate_hz) <= _NEAR * rate_hz else rounded_rate(rate_hz)


class _Words(argparse.ArgumentParser):
    """Arguments that a program has written."""

    def error(self, message: str) -> NoReturn:
        """See `argparse.ArgumentParser.error`.

        Raises:
            SniffError: always.
        """
        raise SniffError(message, usage=True)


def sniffed(
    sniffer: Sniffer, words: Sequence[str], stop: threading.Event, tell: Callable[[str], None]
) -> Mapping[str, Any]:
    """The figures of what a sniffer finds, with arguments as they would be typed.

    Raises:
        SniffError: nothing can be seen; states what to do.
        NothingFoundError: nothing was there; the same holds.
    """
    parser = _Words(add_help=False)
    sniffer.add_arguments(parser)
    result = sniffer.sniff(parser.parse_args(words), stop, tell)
    if result.problem:
        raise NothingFoundError(result.problem, result.figures)
    return result.figures


def unit_of_suffix(suffix: str) -> str:
    """The unit that a text behind numbers means, as a machine file spells it; ``1`` if it is none."""
    known = unit_of(suffix)
    if known is not None and not is_of_peak(suffix):
        return known.name
    return suffix if suffix and may_be_unit(suffix) else "1"
