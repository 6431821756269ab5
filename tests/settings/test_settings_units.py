"""Units are told by what they mean, however they are spelt, and by the factor they differ."""

from __future__ import annotations

import pytest
from support.machine_files import MACHINES, parsed

from daqsvc.errors.machine_file import UNIT_UNKNOWN
from daqsvc.settings.units import factor_between, is_of_peak, may_be_unit, same_unit, unit_of

TRENDS = MACHINES / "modbus-vibration-temperature.toml"


@pytest.mark.parametrize(
    ("name", "spellings"),
    [
        ("m/s2", ["m/s2", "m/s^2", "m/s/s", "m/s²", "m / s^2", "m/sec^2", "m·s⁻²", "ms-2", "M/S2", "m/s**2"]),
        ("g", ["g", "G", "gn", "g rms", "g(rms)", "gravity"]),
        ("mm/s", ["mm/s", "mm/sec", "mm·s^-1", "mm/s RMS", "mm/s_rms"]),
        ("um", ["um", "µm", "μm", "micron", "Microns", "micrometre", "um p-p", "µm pk-pk"]),
        ("mil", ["mil", "mils", "mils pp", "thou"]),
        ("degC", ["degC", "°C", "℃", "deg C", "C", "Celsius"]),
        ("mV", ["mV", "MV", "millivolt"]),
        ("V", ["V", "volt", "Volts", "VDC"]),
        ("in/s", ["in/s", "ips", "in/sec"]),
        ("rpm", ["rpm", "RPM", "1/min", "min^-1", "r/min"]),
    ],
)
def test_a_unit_however_it_is_spelt(name, spellings):
    assert {spelling: unit_of(spelling).name for spelling in spellings} == dict.fromkeys(spellings, name)
    assert all(same_unit(one, other) for one in spellings for other in spellings)


@pytest.mark.parametrize(
    ("one", "other", "factor"),
    [
        ("g", "m/s²", 9.80665),
        ("mV", "V", 1e-3),
        ("mil", "µm", 25.4),
        ("ips", "mm/s", 25.4),
        ("Hz", "rpm", 60.0),
        ("°C", "degC", 1.0),
        ("°C", "K", None),
        ("g", "um", None),
        ("furlong", "um", None),
    ],
)
def test_what_one_unit_is_of_another(one, other, factor):
    assert factor_between(one, other) == (None if factor is None else pytest.approx(factor))


@pytest.mark.parametrize("unit", ["Nm", "N·m", "N m", "NM", "mPa", "gal"])
def test_what_only_its_case_tells_from_another_unit_is_none_of_the_known(unit):
    assert unit_of(unit) is None
    assert {unit_of(known).name for known in ("nm", "MPa", "Gal")} == {"nm", "MPa", "Gal"}


def test_units_that_are_not_known_are_the_same_only_as_texts():
    assert unit_of("furlong") is None
    assert unit_of("") is None
    assert same_unit("furlong", " furlong ")
    assert not same_unit("furlong", "fathom")
    assert not same_unit("furlong", "m")


UNITS = """
mm/s degC °C l/min m³/h Nm kNm N·m lbf·ft kWh kVA kvar % ‰ 1 - pH NTU µS/cm kΩ count t/h g/cm^3 cSt mm2/s
bar(g) kg/h rpm 1/min gE inH2O W/m2 dB(A) mV/g Nm3/h GWh deg/s m/s²
"""
OTHERS = "float32 106 40001 uint16 CDAB holding none vibration 0.1"


@pytest.mark.parametrize("text", UNITS.split())
def test_what_is_made_of_symbols_of_units_may_be_one(text):
    assert may_be_unit(text)
    assert may_be_unit(f"{text} RMS")


@pytest.mark.parametrize(
    "text", ["float32", "106", "40001", "uint16", "CDAB", "holding", "none", "vibration", "0.1"]
)
def test_what_answers_another_question_is_no_unit(text):
    assert not may_be_unit(text)


@pytest.mark.parametrize(
    ("unit", "warns"), [("float32", True), ("106", True), ("l/min", False), ("°C", False)]
)
def test_the_unit_of_a_value_that_is_none_is_a_warning(unit, warns):
    machine = parsed(TRENDS, ('"temperature"\nunit = "degC"', f'"temperature"\nunit = "{unit}"'))
    said = [warning for warning in machine.warnings if warning.code is UNIT_UNKNOWN]
    assert [(one.key, one.message) for one in said] == warns * [("sensors[2].unit", "is not known as a unit")]


@pytest.mark.parametrize(
    "text", ["mm/s pk", "mm/s 0-p", "mm/s p-p", "um pp", "mm/s peak", "mm/s (peak)", "g_pk"]
)
def test_a_word_for_peak_behind_a_unit_is_seen(text: str) -> None:
    assert is_of_peak(text)


@pytest.mark.parametrize("text", ["mm/s", "mm/s RMS", "rpm", "ppm", "mps", "bar", "peak", "pk", ""])
def test_a_unit_without_one_is_not_of_a_peak(text: str) -> None:
    assert not is_of_peak(text)
