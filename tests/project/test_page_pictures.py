"""The pictures of the page in the README show it as it is now: its words, its size and its colours."""

from __future__ import annotations

import asyncio
import re
import runpy
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image, ImageChops
from support.browsers import chromium
from support.paths import ROOT

from daqsvc.page.findings import FAULTS

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.integration, pytest.mark.long, pytest.mark.sources]
DOCS = ROOT / "docs"
SCRIPT = runpy.run_path(f"{DOCS / 'make_screenshots.py'}")
BLOCK_PX = 20
LEAST_STEP = 16
"""Between the grey of two blocks that differ, of 255."""
MOST_DIFFERENT = 0.25
"""Share of the blocks. Orbits and times are others in each run (0.1 of the page with the orbit)."""
MODE = re.compile(r"N|(?:[FLKDR][0-9]*)+|[AP]M")
"""Modes of the bank, of which the second is by chance another one, and halves of the day."""


LEVELS = {"normal", "alert", "danger"}
WORD = re.compile(r"[A-Za-z][\w-]*")


def words(picture: Image.Image) -> set[str]:
    """The words, but for those that depend on which limits the last values happen to exceed."""
    found = WORD.findall(picture.text[SCRIPT["WORDS"]])  # type: ignore[attr-defined]
    by_level = WORD.findall(" ".join(part for level in LEVELS & FAULTS.keys() for part in FAULTS[level]))
    return {word for word in found if not MODE.fullmatch(word)} - {*by_level} - LEVELS


def different(one: Image.Image, other: Image.Image) -> float:
    """Share of the blocks of two pictures that are lighter or darker in one of them."""
    first, second = (np.asarray(image.convert("L").reduce(BLOCK_PX), int) for image in (one, other))
    return float(np.mean(np.abs(first - second) > LEAST_STEP))


async def test_the_pictures_are_of_the_page_as_it_is_now(tmp_path: Path) -> None:
    chromium()
    await asyncio.to_thread(SCRIPT["main"], tmp_path)
    for name in SCRIPT["SHOTS"]:
        with Image.open(DOCS / name) as shown, Image.open(tmp_path / name) as now:
            assert words(shown) == words(now), "run: python docs/make_screenshots.py"
            assert shown.size == now.size
            assert different(shown, now) < MOST_DIFFERENT, "run: python docs/make_screenshots.py"


@pytest.mark.parametrize("name", SCRIPT["SHOTS"])
def test_a_page_in_other_colours_has_another_picture(name: str) -> None:
    with Image.open(DOCS / name) as shown:
        grey = shown.convert("L")
        assert different(shown, ImageChops.invert(grey)) > MOST_DIFFERENT
        assert {"Orbit", "Machine", "laval-rig"} <= words(shown)
