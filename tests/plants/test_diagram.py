"""The reliability diagram shows shares with their intervals."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from plants.diagram import draw, interval
from plants.table import BEGIN, END, PAGE

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(
    ("true", "count", "low", "high"), [(0, 10, 0.0, 0.278), (10, 10, 0.722, 1.0), (50, 100, 0.404, 0.596)]
)
def test_intervals_are_wilsons(true: int, count: int, low: float, high: float) -> None:
    assert interval(true, count) == (pytest.approx(low, abs=1e-3), pytest.approx(high, abs=1e-3))


def test_the_same_names_make_the_same_picture(tmp_path: Path) -> None:
    names = [(0.95, True)] * 9 + [(0.95, False)] + [(0.4, False)] * 3
    for name in ("one", "two"):
        draw({"tuned half": names}, tmp_path / f"{name}.svg")
    picture = (tmp_path / "one.svg").read_text()
    assert picture == (tmp_path / "two.svg").read_text()
    assert "tuned half" in picture
    assert "probability of the first name" in picture
    assert ">10<" in picture, "names in a bin are counted"


@pytest.mark.sources
@pytest.mark.parametrize("part", ["tuned", "set aside", "drawn"])
def test_the_pictures_of_the_page_count_the_names_of_its_tables(part: str) -> None:
    """If this fails, run: make bench-diagnosis."""
    picture = PAGE.with_name(f"plants-{part.replace(' ', '-')}.svg").read_text("utf-8")
    drawn = [int(count) for count in re.findall(r">(\d+)</text>", picture)]
    page = PAGE.read_text("utf-8")
    tabled = []
    for place in (part, f"{part}, run-up"):
        table = page.partition(BEGIN.format(place))[2].partition(END.format(place))[0]
        tabled += [
            int(count) for count in re.findall(r"^\| 0[.\d]* to [.\d]+ \| (\d+) \|", table, re.MULTILINE)
        ]
    # Both divide at 0.5, 0.7 and 0.9; between, the picture divides at 0.6, 0.8 and 0.95, the tables at 0.99.
    assert [(a, b + c, d + e, f + g) for a, b, c, d, e, f, g in (drawn[:7], drawn[7:])] == [
        (a, b, c, d + e) for a, b, c, d, e in (tabled[:5], tabled[5:])
    ]
