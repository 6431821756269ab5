"""What sniffers share: the sensors that they propose."""

from __future__ import annotations

import tomllib

import pytest

from drivers.bus_questions import is_count, unit_by_name
from drivers.sniffing import WAVEFORM_HZ, Values, by_name, sensor_lines, type_by_unit


def test_what_has_no_unit_is_taken_for_an_acceleration_where_it_comes_as_often_as_a_waveform() -> None:
    def sensor(channel: str, rate_hz: float, *, guess: bool = True) -> tuple[dict[str, str], str]:
        text = "\n".join(sensor_lines("device", {channel: "1"}, set(), rate_hz, guess=guess))
        return tomllib.loads(text)["sensors"][0], text

    fast, text = sensor("x", 2000.0)
    assert (fast["type"], fast["unit"]) == ("accelerometer", "g")
    assert 'type = "accelerometer"    # a guess by the rate, its unit too: see the device\'s manual' in text
    for channel, rate_hz, guess in (("x", 10.0, True), ("temp", 2000.0, True), ("x", 2000.0, False)):
        slow, text = sensor(channel, rate_hz, guess=guess)
        assert (slow["type"], slow["unit"]) == ("trend", "1")
        assert "a guess" not in text


@pytest.mark.parametrize(
    ("unit", "rate_hz", "kind"),
    [
        ("mm/s", 20.0, "trend"),
        ("mm/s", WAVEFORM_HZ, "velocity"),
        ("g", 20.0, "trend"),
        ("g", WAVEFORM_HZ, "accelerometer"),
        ("mg", WAVEFORM_HZ, "accelerometer"),
        ("mm/s pk", WAVEFORM_HZ, "trend"),
        ("g p-p", WAVEFORM_HZ, "trend"),
        ("mm/s^2", WAVEFORM_HZ, "accelerometer"),
        ("°C", 20.0, "trend"),
    ],
)
def test_a_vibration_that_comes_slowly_is_a_level_and_no_waveform(
    unit: str, rate_hz: float, kind: str
) -> None:
    # Of a level the RMS of its changes says nothing: 6.2 mm/s would be shown as next to nothing.
    [sensor] = tomllib.loads("\n".join(sensor_lines("device", {"V": unit}, set(), rate_hz)))["sensors"]
    assert sensor["type"] == kind


@pytest.mark.parametrize(
    ("channel", "unit", "values", "kind"),
    [
        ("VelRms_DE", "mm/s", Values(), "trend"),
        ("AccPeak", "g", Values(), "trend"),
        ("Vib", "mm/s", Values(unsigned=True), "trend"),
        ("Vib", "g", Values(unsigned=True), "trend"),
        ("Vib", "mm/s", Values(least=1.58, most=1.62), "trend"),
        ("Vib", "mm/s", Values(least=1.28, most=1.28), "trend"),  # it stands still
        ("Vib", "mm/s", Values(least=-1.3, most=1.4), "velocity"),
        ("Vib", "mm/s", Values(least=0.2, most=1.4), "velocity"),  # too short to see the other half
        ("Vib", "mm/s", Values(least=0.0, most=0.0), "velocity"),
        ("Vib", "g", Values(least=0.98, most=1.02), "accelerometer"),  # gravity is in it
        ("Gap", "um", Values(unsigned=True, least=990.0, most=1010.0), "proximity"),
        ("Temp", "degC", Values(), None),
    ],
)
def test_a_level_that_comes_as_often_as_a_waveform_is_none(
    channel: str, unit: str, values: Values, kind: str | None
) -> None:
    # An alarm on the RMS of an RMS would never come: that of a steady one is about 0.
    assert type_by_unit(channel, unit, waveform=True, values=values) == kind


@pytest.mark.parametrize(
    ("channel", "kind", "unit"),
    [
        ("Effektivwert", "trend", None),
        ("Schwinggeschwindigkeit_Effektivwert", "trend", "mm/s"),
        ("Schwing_eff", "trend", "mm/s"),
        ("VibEff", "trend", "mm/s"),
        ("Spitze", "trend", None),
        ("Spitzenwert", "trend", None),
        ("Scheitelwert", "trend", None),
        ("Scheitelfaktor", "trend", None),
        ("Kennwert_DE", "trend", None),
        ("Mittelwert", "trend", None),
        ("Gleichwert", "trend", None),
        ("Schwingpegel", "trend", "mm/s"),
        ("Schwingung", None, "mm/s"),
        ("Schwingweg", None, "um"),
        ("Beschleunigung_x", "accelerometer", "g"),
        ("Schwingbeschl", None, "g"),
        ("Drehzahl", "trend", "rpm"),
        ("MotDrehz", "trend", "rpm"),
        ("Lagertemperatur", "trend", "degC"),
        ("Oeldruck", "trend", "bar"),
        ("\u00d6ldruck", "trend", "bar"),
        ("Motorstrom", None, "A"),
        ("Spannung_U1", None, "V"),
        ("Volumenstrom", None, None),
        ("Efficiency", None, None),
        ("Coeff", None, None),
        ("x", None, None),
    ],
)
def test_names_in_german_suggest_what_those_in_english_do(
    channel: str, kind: str | None, unit: str | None
) -> None:
    assert by_name(channel) == kind
    assert unit_by_name(channel) == unit


@pytest.mark.parametrize("name", ["Zaehler", "Z\u00e4hler", "Za\u0308hler", "BotschaftsZAEHLER"])
def test_a_counter_in_german_is_one_with_and_without_umlaut(name: str) -> None:
    assert is_count(name)


@pytest.mark.parametrize("channel", ["SchwingEffektivwert", "v_eff", "Spitzenwert"])
def test_a_level_with_a_german_name_is_no_waveform(channel: str) -> None:
    assert type_by_unit(channel, "mm/s", waveform=True) == "trend"
    assert type_by_unit("Schwinggeschwindigkeit", "mm/s", waveform=True) == "velocity"
