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
# How a level was made shows nothing of its unit: "mm/s RMS", "um p-p".
_QUALIFIER = re.compile(r"[_ ]*\(?(?:rms|pk-?pk|p-?p|pp|0-?p|0-?pk|peak|pk)\)?$", re.IGNORECASE)
_DROPPED = re.compile(r"[\s^*()\[\]{}·⋅]+")
_SECONDS = re.compile(r"(?<![a-z])seconds?|(?<![a-z])sec(?![a-z])")
_PER = re.compile(r"(?<=[a-z])per(?=[a-z])")


def unit_of(text: str) -> Unit | None:
    """The unit that a text means; None if it is not known.

    Args:
        text: as somebody has written it, e.g. ``m/s²``, ``°C``, ``mm/s RMS``.
    """
    plain = unicodedata.normalize("NFKC", text).replace("μ", "u").replace("\N{MINUS SIGN}", "-")
    plain = _QUALIFIER.sub("", plain.strip()) or plain
    # The case tells a unit in few places only, and people get it wrong in all of them.
    plain = _DROPPED.sub("", plain.replace("°", "deg")).lower()
    plain = _SECONDS.sub("s", _PER.sub("/", plain)).replace("squared", "2")
    return _BY_SPELLING.get(plain)


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
