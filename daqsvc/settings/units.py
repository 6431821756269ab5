"""Units however they are spelt: whether two texts mean the same unit, and by which factor they differ.

DBC files, data sheets and people write the same unit in many ways (``m/s2``, ``m/s^2``, ``m/s/s``, ``m/s²``).
"""

from __future__ import annotations

import re
import unicodedata
from typing import NamedTuple

STANDARD_GRAVITY = 9.80665
"""m/s2 per g (CGPM 1901)."""


class Unit(NamedTuple):
    """A unit that is known.

    Attributes:
        name: as a machine file spells it.
        quantity: what is measured in it; only units of one quantity can be converted.
        factor: worth of 1 in the quantity's base unit; None of a unit whose zero lies elsewhere (degC).
    """

    name: str
    quantity: str
    factor: float | None


_INCH_M = 0.0254

# Quantity, name, factor, and what it is written as: without blanks, in lower case, "u" for micro.
_UNITS: tuple[tuple[str, str, float | None, str], ...] = (
    ("acceleration", "m/s2", 1.0, "m/s2 m/s/s m/ss ms-2 m.s-2 mps2 m/sq.s m/sqs"),
    ("acceleration", "mm/s2", 1e-3, "mm/s2 mm/s/s mms-2 mmps2"),
    ("acceleration", "g", STANDARD_GRAVITY, "g gn g0 gs gee grav gravity g-force"),
    ("acceleration", "mg", 1e-3 * STANDARD_GRAVITY, "mg millig mgn"),
    ("acceleration", "ug", 1e-6 * STANDARD_GRAVITY, "ug microg"),
    ("acceleration", "in/s2", _INCH_M, "in/s2 in/s/s ips2"),
    ("acceleration", "ft/s2", 12 * _INCH_M, "ft/s2 ft/s/s fps2"),
    ("acceleration", "Gal", 1e-2, "gal cm/s2"),
    ("velocity", "m/s", 1.0, "m/s ms-1 mps meter/s metre/s"),
    ("velocity", "mm/s", 1e-3, "mm/s mms-1 mmps"),
    ("velocity", "cm/s", 1e-2, "cm/s cms-1"),
    ("velocity", "um/s", 1e-6, "um/s ums-1"),
    ("velocity", "in/s", _INCH_M, "in/s ips inch/s"),
    ("length", "m", 1.0, "m meter metre meters metres"),
    ("length", "cm", 1e-2, "cm"),
    ("length", "mm", 1e-3, "mm millimeter millimetre millimeters millimetres"),
    ("length", "um", 1e-6, "um micron microns micrometer micrometre micrometers micrometres"),
    ("length", "nm", 1e-9, "nm"),
    ("length", "in", _INCH_M, "in inch inches"),
    ("length", "mil", 1e-3 * _INCH_M, "mil mils thou"),
    ("voltage", "V", 1.0, "v volt volts vdc vac"),
    ("voltage", "mV", 1e-3, "mv millivolt millivolts mvdc"),
    ("voltage", "uV", 1e-6, "uv microvolt microvolts"),
    ("current", "A", 1.0, "a amp amps ampere amperes"),
    ("current", "mA", 1e-3, "ma milliamp milliamps"),
    ("temperature", "degC", None, "degc c celsius degreec degreesc degcelsius degreecelsius degreescelsius"),
    ("temperature", "degF", None, "degf f fahrenheit degreef degreesf degfahrenheit degreesfahrenheit"),
    ("temperature", "K", None, "k kelvin"),
    ("angle", "deg", 1.0, "deg degree degrees"),
    ("angle", "rad", 57.29577951308232, "rad radian radians"),
    ("rotational speed", "rpm", 1.0, "rpm r/min rev/min 1/min min-1 u/min"),
    ("rotational speed", "Hz", 60.0, "hz 1/s s-1 rps rev/s r/s"),
    ("ratio", "%", 1.0, "% percent pct"),
    ("pressure", "Pa", 1.0, "pa pascal"),
    ("pressure", "kPa", 1e3, "kpa"),
    ("pressure", "MPa", 1e6, "mpa"),
    ("pressure", "mbar", 1e2, "mbar hpa"),
    ("pressure", "bar", 1e5, "bar"),
    ("pressure", "psi", 6894.757293168, "psi"),
    ("force", "N", 1.0, "n newton"),
    ("force", "kN", 1e3, "kn"),
    ("power", "W", 1.0, "w watt watts"),
    ("power", "kW", 1e3, "kw"),
    ("time", "s", 1.0, "s"),
    ("time", "ms", 1e-3, "ms"),
)
_BY_SPELLING = {
    spelling: Unit(name, quantity, factor)
    for quantity, name, factor, spellings in _UNITS
    for spelling in spellings.split()
}
# Units that are not converted, and that in lower case are others: a torque, a millipascal, a gallon.
_OTHERS = frozenset(("Nm", "NM", "mPa", "gal"))
# How a level was made shows nothing of its unit: "mm/s RMS", "mm/s eff.", "um p-p".
_PEAK = "pk-?pk|p-?p|pp|0-?p|0-?pk|peak|pk"
QUALIFIER = rf"\(?(?:rms|eff\.?|{_PEAK})\)?"
"""Regular expression of how a level was made, behind its unit; case does not matter."""
_QUALIFIER = re.compile(rf"[_ ]*{QUALIFIER}$", re.IGNORECASE)
_OF_PEAK = re.compile(rf"(?:[_ (]|\b)(?:{_PEAK})\)?$", re.IGNORECASE)
_DROPPED = re.compile(r"[\s^*()\[\]{}·⋅]+")
_SECONDS = re.compile(r"(?<![a-z])seconds?|(?<![a-z])sec(?![a-z])")
_PER = re.compile(r"(?<=[a-z])per(?=[a-z])")


_PREFIXES = ("", "da", *"yzafpnumcdhkgt")
_PREFIXED = (
    "m g s a k mol cd rad sr hz n pa j w c v f ohm wb t h lm lx",
    "bq gy sv kat l eq wh va vah var varh ah ev bar b bit byte cal",
    "p st gf gn vpp vrms ge gse nm wc hg",
)
"""Symbols of units that take a prefix such as k; in lower case."""
_WORDS = (
    "min hr hour hours day days d week weeks month months yr year years sec second seconds",
    "in inch ft foot feet yd mi mile miles mil mils thou micron microns",
    "lb lbs lbf oz ozf kip ton tonne tonnes psi psig psia bara barg atm torr inhg inwc",
    "hp ps btu btuh tr gal gallon gallons gpm gph lpm lph slpm nlpm cfm scfm cmh",
    "kph kmh kmph mph kn knot knots ips fps mps rpm rps rev revs r u turn turns cycle cycles cpm cps",
    "deg degc degf degdh degree degrees grad arcmin arcsec kelvin celsius fahrenheit",
    "db dba dbm dbv ppm ppb ph ntu fnu rh percent pct sone phon vol lux",
    "count counts cnt cts step steps pulse pulses imp impulses event events pcs piece pieces item items",
    "x pu raw lsb digit digits dig state status code bool on off yes no fraction ratio part parts",
    "per squared",
)
"""Words and symbols that take no prefix, and what people write where there is no unit."""
_WITH_PREFIX = frozenset(" ".join(_PREFIXED).split())
_AS_THEY_ARE = frozenset(" ".join(_WORDS).split())
_SYMBOLS = re.compile(r"[a-z]+")


def may_be_unit(text: str) -> bool:
    """Whether a text may be a unit: whether it is known, or made of symbols that units have.

    What is no unit, e.g. a type or an address, has found its way into the wrong place.
    """
    if unit_of(text) is not None:
        return True
    plain = _plain(text).replace("ω", "ohm").replace("h2o", "wc")
    symbols = _SYMBOLS.findall(plain)
    if not symbols:
        return plain in {"1", "-"} or any(sign in plain for sign in "%‰")
    return all(
        one in _AS_THEY_ARE
        or any(one.startswith(prefix) and one[len(prefix) :] in _WITH_PREFIX for prefix in _PREFIXES)
        for one in symbols
    )


def unit_of(text: str) -> Unit | None:
    """The unit that a text means; None if it is not known.

    Args:
        text: as somebody has written it, e.g. ``m/s²``, ``°C``, ``mm/s RMS``.
    """
    if _DROPPED.sub("", text) in _OTHERS:
        return None
    plain = _DROPPED.sub("", _plain(text))
    plain = _SECONDS.sub("s", _PER.sub("/", plain)).replace("squared", "2")
    return _BY_SPELLING.get(plain)


def is_of_peak(text: str) -> bool:
    """Whether a text is a unit with a word for peak or peak to peak, e.g. ``mm/s pk``: no RMS."""
    return _OF_PEAK.search(text.strip()) is not None and unit_of(text) is not None


def is_of_vibration(text: str) -> bool:
    """Whether a value in this unit is most likely the level of a vibration, and no position or flow."""
    known = unit_of(text)
    if known is None:
        return False
    if known.quantity == "length":
        return known.name in {"um", "mil"} or is_of_peak(text)
    return known.quantity == "acceleration" or (known.quantity == "velocity" and known.name != "m/s")


def _plain(text: str) -> str:
    """A unit in lower case, in few signs, and without how a level was made."""
    plain = unicodedata.normalize("NFKC", text).replace("μ", "u").replace("\N{MINUS SIGN}", "-")
    plain = _QUALIFIER.sub("", plain.strip()) or plain
    # The case tells a unit in few places only, and people get it wrong in all of them.
    return plain.replace("°", "deg").lower()


def same_unit(one: str, other: str) -> bool:
    """Whether two texts mean the same unit; texts that are not known must be equal."""
    first, second = unit_of(one), unit_of(other)
    if first is None or second is None:
        return one.strip() == other.strip()
    return first == second


def factor_between(one: str, other: str) -> float | None:
    """How many of ``other`` are 1 of ``one``; None where no factor tells that."""
    first, second = unit_of(one), unit_of(other)
    if first is None or second is None or first.quantity != second.quantity:
        return None
    if first == second:
        return 1.0
    return None if first.factor is None or second.factor is None else first.factor / second.factor
