"""What compares the outputs that pages show finds words, figures, cells and titles that did not come."""

from __future__ import annotations

import pytest
from project.test_quoted_messages import is_said
from support.shown_lines import shown_lines
from support.shown_output import FIGURE, differs
from support.shown_tables import unlike

pytestmark = pytest.mark.sources
ANALYZED = """\
105.mat: inner race at DE_time, severity 23.3
  inner z 31.0 size 0.75, outer z 1.0 size 0.05, ball z 4.1 size 0.09
  BPFI at 161.70 Hz (5.402 per revolution), modulation 0.70
  2 x BPFI at 323.41 Hz (10.805 per revolution), modulation 0.40
"""
TREND = """\
pump, 2026-11-28 17:55 to 2026-11-28 23:55, by the minute
reading             last     least      mean     greatest  unit
levels/probe-x.rms  46.65    26.69      37.76    59.36     um    ▁▂▃
rotor-bank.F1L3     8.0e-07  3.775e-11  0.01848  0.562
"""
STATUS = """\
STREAM  BUS   RATE (Hz)        AGE    LOST
shaft   can0  639.9933 of 640  0.0 s  0 of 2,610 samples

CHANNEL    STATE  NEWEST     AGE    MEASURES
probe-x    ok     -52.22 um  0.0 s  mean -0.1882 um, rms 39.98 um, peak 89.26
                                    um, crest_factor 2.233
"""


@pytest.mark.parametrize(
    ("shown", "output", "same"),
    [
        ("a 1\n...\nb 2\n", "a 1\nx\nb 2\n", True),
        ("a 1\nb 2\n", "a 1\nx\nb 2\n", False),
        ("a 1\n...\nb 2\n", "a 1\nx\nb 3\n", False),
        ("all is well\n", "File machine.toml\n", False),
        ("noise 2.00 um", "noise 2.03 um", True),
        ("noise 2.00 um", "noise 2.05 um", False),
        ("49 samples", "50 samples", False),
        ("4,480 samples", "4481 samples", True),
        ("4,480 samples", "448 samples", False),
        ("z -4.1", "z 4.1", False),
        ("off 0", "off 1", False),
        ("on 2026-03-01", "on 2026-03-02", False),
        ("1.105e-05", "1.105e-06", False),
        ("... at 12 um", "x 7 at 12 um", True),
        ("... at 12 um", "x 7 at 24 um", False),
        ("... 12 um", "x 312 um", False),
        ("from 3 ... 12 um", "from 3 by 4 to 12 um", True),
        ("# as measured 7", "# as measured 7", True),
        ("F1 0.5", "F1L2 0.5", False),
    ],
)
def test_other_output_than_shown_is_found(shown: str, output: str, *, same: bool) -> None:
    assert (differs(shown, output) == "") is same


def test_words_alone_are_compared_where_figures_may_be_others() -> None:
    assert differs("a 1", "a 2", figures=False) == ""
    assert differs("a 1", "b 1", figures=False)
    assert differs("a 1", "a 2").startswith("figures of 'a 1'")
    assert FIGURE not in differs("a 1", "a 2")


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("inner z 31.0", "inner z 91.0"),
        ("161.70 Hz", "323.4 Hz"),
        ("severity 23.3", "severity 46.6"),
        ("modulation 0.70", "modulation 0.07"),
        ("ball z", "cage z"),
    ],
)
def test_a_line_of_readme_that_is_wrong_is_found(right: str, wrong: str) -> None:
    [shown] = [
        one.output for one in shown_lines() if one.page == "README.md" and ANALYZED[:30] in f"{one.output}"
    ]
    assert shown is not None
    assert differs(shown, ANALYZED) == ""
    assert differs(shown.replace(right, wrong), ANALYZED)


@pytest.mark.parametrize(
    ("shown", "wrong"),
    [
        (TREND, ""),
        (TREND.replace("17:55 to", "18:01 to").replace("46.65", "0.4").replace("F1L3", "F1"), ""),
        (
            TREND.replace(" 2026-11-28 17:55 to", " since 2026-11-28 17:55 until"),
            "since 2026-11-28 17:55 until 2026-11-28 23:55",
        ),
        (TREND.replace("by the minute", "each minute"), "each minute"),
        (TREND.replace("probe-x.rms", "probe-x.rmss"), "levels/probe-x.rmss"),
        (TREND.replace("greatest", "largest"), "largest"),
        (STATUS.replace("peak 89.26\n", "peak\n").replace("    um, crest", " 9.2 um, crest"), ""),
        (STATUS.replace("RATE (Hz)", "RATE"), "STREAM  BUS   RATE        AGE    LOST"),
        (STATUS.replace("of 2,610 samples", "from 2,610 samples"), "0 from 2,610 samples"),
        (STATUS.replace("rms", "effective"), "effective 39.98 um"),
    ],
)
def test_a_table_that_is_wrong_is_found(shown: str, wrong: str) -> None:
    assert unlike(shown, TREND + STATUS, is_said) == wrong


def test_two_pages_show_the_same_of_one_recording() -> None:
    shown = [one for one in shown_lines() if one.output and "105.mat: inner" in one.output]
    assert {one.page for one in shown} == {"README.md", "docs/analyze.md"}
    assert len({one.output for one in shown}) == 1
