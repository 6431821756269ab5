"""Figures in remedies: who writes them is not refused again."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.machine_files import LAVAL, MACHINES, changed
from support.paths import ROOT

from daqsvc.rounding import counted, counted_are, readable, rounded_down, rounded_up, with_unit
from daqsvc.settings import MachineFileError, load_machine_file, parse_machine_file
from daqsvc.settings.describe import describe

if TYPE_CHECKING:
    from pathlib import Path

SYNCHRONOUS = MACHINES / "rotor-synchronous.toml"
TWO_BUSES = MACHINES / "rotor-two-buses.toml"
SPECIMEN = ROOT / "tests" / "guard" / "specimens" / "specimen-measures.toml"
POSITIVE = st.floats(1e-9, 1e9)
DIGITS = st.integers(1, 6)


@given(POSITIVE, DIGITS)
def test_a_bound_is_met_by_the_figure_and_missed_by_the_next(value, digits):
    step = 10.0 ** (1 - digits) * 1.001
    assert value * (1 - 1e-11) <= float(rounded_up(value, digits)) <= value * (1 + step)
    assert value * (1 - step) <= float(rounded_down(value, digits)) <= value * (1 + 1e-11)


@given(POSITIVE, DIGITS)
def test_a_figure_has_no_more_digits_than_asked_for(value, digits):
    for figure in (rounded_up(value, digits), rounded_down(value, digits)):
        assert float(figure) == float(f"{float(figure):.{digits}g}")


@pytest.mark.parametrize(
    ("value", "digits", "up", "down"),
    [
        (0.2033, 3, "0.204", "0.203"),
        (0.1 + 0.2, 3, "0.3", "0.3"),  # 0.30000000000000004: an error of the machine, not of the person
        (12345.6, 4, "12350", "12340"),
        (999.9, 3, "1000", "999"),
        (2e-5, 2, "2e-05", "2e-05"),
    ],
)
def test_figures_are_written_as_people_write_them(value, digits, up, down):
    assert rounded_up(value, digits) == up
    assert rounded_down(value, digits) == down


def remedies(path: Path, key: str, *replacements: tuple[str, str]) -> list[str]:
    """What is said to be done about a key, errors and warnings."""
    text, _ = changed(path, *replacements)
    try:
        found = parse_machine_file(text, path).warnings
    except MachineFileError as error:
        found = error.problems
    return [one.remedy for one in found if one.key == key]


@pytest.mark.parametrize(
    ("path", "key", "speed_rpm", "setting", "refused"),
    [
        (SPECIMEN, "pipeline.levels.window_s", (600.0, 590.0), "window_s = 1.0", 0.05),
        (LAVAL, "pipeline.rotor_bank.keyphasor", (600.0, 601.27), "rate_hz = 640.0", 30.0),
        (SYNCHRONOUS, "pipeline.rotor_synchronous.probes", (1500.0, 1511.13), "rate_hz = 1600.0", 250.0),
        (TWO_BUSES, "pipeline.alignment.max_error_us", (1500.0, 1507.0), "max_error_us = 200.0", 2000.0),
    ],
)
def test_the_figure_that_a_remedy_states_is_accepted(path, key, speed_rpm, setting, refused):
    speed = (f"speed_rpm = {speed_rpm[0]}", f"speed_rpm = {speed_rpm[1]}")
    name = setting.split(" = ")[0]
    (remedy,) = remedies(path, key, speed, (setting, f"{name} = {refused}"))
    stated = float(re.match(r"(?:write \w+ = |sample at )([0-9.]+)", remedy)[1])
    assert remedies(path, key, speed, (setting, f"{name} = {stated}")) == []


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (65535.0, "65540"),
        (-2147483.648, "-2147000"),
        (0.30000000000000004, "0.3"),
        (25, "25"),
        (0.0, "0"),
        (1.23456e-7, "1.235e-07"),
        (float("nan"), "nan"),
        (float("inf"), "inf"),
    ],
)
def test_measured_values_are_written_as_people_read_them(value: float, text: str) -> None:
    assert readable(value) == text


STATE = """
schema_version = 1
site = "lab"
box = "edge-1"
[machine]
name = "fan"
speed_rpm = 1480.0
[buses.can0]
driver = "can"
interface = "virtual"
channel = "1"
[streams.state]
bus = "can0"
rate_hz = 10.0
[streams.state.layout]
id = 1
length = 8
no_counter = true
first_byte = 0
samples_per_frame = 1
channels = [{ name = "state", type = "uint8", scale = 1.0 }]
[[sensors]]
name = "state"
type = "trend"
stream = "state"
channel = "state"
unit = "1"
ok_between = [0.0, 3.0]
[pipeline]
[pipeline.levels]
[[alarms]]
name = "state"
sensor = "state"
measure = "value"
alert = 0.5
danger = 1.5
deadband = 0.1
"""


@pytest.mark.parametrize(("unit", "text"), [("rpm", "65540 rpm"), ("1", "65540"), ("", "65540")])
def test_a_plain_number_has_no_unit_behind_it(unit: str, text: str) -> None:
    assert with_unit(65535.0, unit) == text


def test_check_shows_limits_of_a_plain_number_without_its_unit(tmp_path: Path) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(STATE)
    text = describe(load_machine_file(file))
    assert "  state  value of state  0.5    1.5     0.1, on 0 s, off 0 s" in text
    assert "OK 0 to 3\n" in text
    assert "1 x 1 channel " in text
    file.write_text(STATE.replace("danger = 1.5", "danger = 300.0"))
    with pytest.raises(MachineFileError, match=r'channel of "state" carries 0 to 255\. Remedy'):
        load_machine_file(file)


def test_what_concerns_a_whole_alarm_names_it(tmp_path: Path) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(STATE.replace("alert = 0.5\ndanger = 1.5\n", ""))
    with pytest.raises(MachineFileError, match=r'alarms\[0\] \("state"\): has neither alert nor danger'):
        load_machine_file(file)


def test_one_thing_is_counted_in_the_singular():
    assert [counted(n, "missing sample") for n in (0, 1, 1000)] == [
        "0 missing samples",
        "1 missing sample",
        "1,000 missing samples",
    ]
    assert [counted_are(n, "sample") for n in (1, 2)] == ["1 sample is", "2 samples are"]


COUNTED = re.compile(r"(?<!\.)\b1 (missing |lost |more )?(samples|frames|values|columns|channels|lines)\b")


def test_no_message_that_tests_have_had_counts_one_thing_in_the_plural():
    known = [*(ROOT / "tests/guard/golden").glob("*.txt"), ROOT / "tests/errors/messages.txt"]
    lines = [line for file in known for line in file.read_text("utf-8").splitlines()]
    # Headings have the values of the tests in them.
    assert [line for line in lines if COUNTED.search(line) and not line.startswith("==")] == []
