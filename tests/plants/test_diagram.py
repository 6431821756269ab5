"""The reliability diagram shows shares with their intervals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from plants.diagram import draw, interval

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
