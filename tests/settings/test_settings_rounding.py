"""Figures in remedies: who writes them is not refused again."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.machine_files import only_problem, parsed
from support.paths import ROOT

from daqsvc.settings.rounding import rounded_down, rounded_up

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


@pytest.mark.parametrize("speed_rpm", [590, 610, 907, 1111])
def test_a_window_that_the_remedy_states_is_accepted(speed_rpm):
    speed = ("speed_rpm = 600.0", f"speed_rpm = {speed_rpm}.0")
    problem, _ = only_problem(SPECIMEN, speed, ("window_s = 1.0", "window_s = 0.05"))
    assert problem.key == "pipeline.levels.window_s"
    stated = problem.remedy.removeprefix("write ").removesuffix(" or more")
    parsed(SPECIMEN, speed, ("window_s = 1.0", stated))
