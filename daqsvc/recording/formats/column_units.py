"""Units of columns as loggers write them: in a row of their own, or in brackets behind a name."""

from __future__ import annotations

import re
from typing import NamedTuple

from daqsvc.recording.contents import LONGEST_TEXT
from daqsvc.recording.rate import PER_SECOND, TIME_NAME

_UNITS = (
    r"%|V|mV|uV|µV|kV|A|mA|kA|"
    r"g|gn|mg|ug|µg|(?:|m|c)m/s2|(?:|m|c)m/s²|(?:|m|c)m/s\^2|(?:|m)m/s/s|in/s2|in/s²|in/s\^2|ft/s2|ft/s²|ft/s\^2|gal|"
    r"(?:|m|c|u|µ)m/s|in/s|ips|m|cm|mm|um|µm|nm|in|inch|mil|mils|"
    r"Hz|kHz|1/s|rpm|r/min|1/min|min-1|min\^-1|U/min|°|deg|grad|rad|°C|C|degC|°F|F|K|"
    r"N|mN|kN|Nm|N·m|N\*m|Pa|hPa|kPa|MPa|bar|mbar|psi|W|kW|VA|kVA|var|kg|kg/h|t/h|l/min|l/h|l/s|m3/h|m³/h|"
    r"dB|dB\(A\)|Ohm|Ω|kOhm|kΩ|s|sec|ms|us|µs|ns|h|min"
)
_HOW = r"(?i:[\s_]*\(?(?:rms|eff|pk-?pk|p-?p|pp|0-?p|0-?pk|peak|pk)\)?)?"
_QUANTITY = re.compile(rf"(?i:{_UNITS}){_HOW}")
_AS_SPELT = re.compile(rf"(?P<unit>{_UNITS}){_HOW}")
_IN_ROWS = frozenset({"T", "t"})
"""Units in a row of them alone: behind a name, ``(T)`` is mostly a phase."""
_NAMES_TOO = frozenset({"in", "min", "rad", "var", "rpm", "deg"})
"""Units that channels are called by: input, minimum, wheel (German), variance, speed, angle."""
_NONE = re.compile(r"-*|n/?a", re.IGNORECASE)
_MASK = re.compile(
    r"(?i)date|time|(?![dt]$)(?:[dt]{1,2}|[yj]{2,4})[./ -]?[mdytjhs.,:/ \-f0]*|hh?:mm[:s.,f0]*|"
    r"m{1,2}[./-]d{1,2}[./-]y{2,4}(?:[ ,t]*h{1,2}:mm[:s.,f0]*)?(?: ?(?:tt|am/pm))?"
)
"""How a date or a time is written, in place of a unit; some units look so, too."""
_OTHER_AS_CAPITAL = re.compile(rf"(?:m(?:n|nm|pa|w|wh|v|va|var|a|j|hz|ohm|ω)|nm)(?:/.*|{_HOW})")
"""Units, in small letters, that mean something else with a capital as their first letter."""

_OPEN, _CLOSE = "[(", "])"
_BEHIND = re.compile(r"(?P<name>.*\S)\s*(?:\[(?P<square>[^][]+)\]|\((?P<round>[^()]+)\))")
_TIME_IN = re.compile(r"(?P<name>.*?\S)(?:\s+in\s+|\s*/\s*)(?P<unit>\S+)")

_SECONDS_EACH = {
    "ns": ("ns", 1.0),
    **dict.fromkeys(("us", "usec", "microseconds", "mikrosekunden"), ("us", 1.0)),
    **dict.fromkeys(("ms", "msec", "msek", "milliseconds", "millisekunden"), ("ms", 1.0)),
    **dict.fromkeys(
        ("s", "sec", "sek", "sec.", "sek.", "second", "seconds", "sekunde", "sekunden"), ("s", 1.0)
    ),
    **dict.fromkeys(("min", "min.", "minute", "minutes", "minuten"), ("s", 60.0)),
    **dict.fromkeys(("h", "hr", "hrs", "std", "std.", "hour", "hours", "stunde", "stunden"), ("s", 3600.0)),
    **dict.fromkeys(("d", "day", "days", "tag", "tage"), ("s", 86_400.0)),
}


class TimeUnit(NamedTuple):
    """A unit that times are counted in.

    Attributes:
        name: of a unit that a name of `TIME_NAME` may end with.
        factor: how many of these it is.
    """

    name: str
    factor: float


def time_unit(text: str) -> TimeUnit | None:
    """The unit of time that a text means, in English or German; None if it is none."""
    unit = _SECONDS_EACH.get(_one_micro(text).lower().replace("µ", "u"))
    return None if unit is None else TimeUnit(*unit)


def without_brackets(cell: str) -> str:
    """The text of a cell of units; empty if it names none, or only how a date is written."""
    text = cell.strip()
    if text[:1] and text[0] in _OPEN and text[-1] in _CLOSE:
        text = text[1:-1].strip()
    is_mask = _MASK.fullmatch(text) is not None and not _means_unit(text)
    return "" if is_mask or _NONE.fullmatch(text) else text


def is_unit(cell: str) -> bool:
    """Whether a cell may be in a row of units: a unit, how a date is written, or nothing."""
    text = without_brackets(cell)
    return not text or text in _IN_ROWS or _means_unit(text)


def unit_as_name(cell: str) -> str:
    """The unit that a column may be called by; empty if the name is not spelt like one."""
    text = without_brackets(cell)
    return text if _AS_SPELT.fullmatch(_one_micro(text)) is not None else ""


def is_surely_unit(cell: str) -> bool:
    """Whether a cell is a unit even where a name may stand: that is not known of a letter or a word."""
    spelt = _AS_SPELT.fullmatch(_one_micro(without_brackets(cell)))
    if spelt is None:
        return False
    unit = spelt["unit"]
    return cell.strip()[0] in _OPEN or (unit not in _NAMES_TOO and (len(unit) > 1 or not unit.isalpha()))


def unit_in_name(name: str) -> tuple[str, str]:
    """A name without the unit in brackets behind it, and that unit; empty if there is none.

    Of a column of time the unit may also follow ``in`` or ``/``, as in ``Zeit in ms``.
    """
    if len(name) > LONGEST_TEXT:
        return name, ""
    behind = _BEHIND.fullmatch(name)
    if behind is not None:
        unit = (behind["square"] or behind["round"]).strip()
        return (behind["name"], unit) if _means_unit(unit) else (name, "")
    written = _TIME_IN.fullmatch(name)
    if written is not None and is_time_name(written["name"]) and time_unit(written["unit"]) is not None:
        return written["name"], written["unit"]
    named = TIME_NAME.fullmatch(name)
    return name, (named["unit"] or "") if named is not None else ""


def is_time_name(name: str) -> bool:
    """Whether a column of this name is one of time."""
    return TIME_NAME.fullmatch(name) is not None


def spelt_alike(one: str, other: str) -> bool:
    """Whether two texts are one unit but for small and capital letters, and how an exponent is written.

    Letters that are another unit as capitals count as written: milli and mega, Nm and nm.
    """
    first, second = time_unit(one), time_unit(other)
    if first is not None and second is not None:
        return first.factor / PER_SECOND.get(first.name, 1.0) == second.factor / PER_SECOND.get(
            second.name, 1.0
        )
    return _plain(one) == _plain(other)


def _plain(unit: str) -> str:
    written = re.sub(r"[\s^*·]", "", _one_micro(unit))
    small = written.lower().replace("µ", "u").replace("²", "2").replace("/s/s", "/s2")
    return written[0] + small[1:] if _OTHER_AS_CAPITAL.fullmatch(small) else small


def _means_unit(text: str) -> bool:
    return time_unit(text) is not None or _QUANTITY.fullmatch(_one_micro(text)) is not None


def _one_micro(text: str) -> str:
    """With one of the two letters that look like a micro sign."""
    return text.replace("\N{GREEK SMALL LETTER MU}", "\N{MICRO SIGN}")
