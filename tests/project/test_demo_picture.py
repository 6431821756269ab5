"""docs/demo.svg shows what the demo shows now: the same words; figures of times are others in each run."""

from __future__ import annotations

import html
import re
import runpy

import pytest
from support.paths import ROOT

pytestmark = [pytest.mark.integration, pytest.mark.long, pytest.mark.sources, pytest.mark.timeout(300)]
DOCS = ROOT / "docs"


def words(picture: str) -> set[str]:
    text = " ".join(html.unescape(one) for one in re.findall(r"<text[^>]*>([^<]*)</text>", picture))
    return {*re.findall(r"[A-Za-z][A-Za-z0-9-]*", text)}


def test_the_picture_of_the_demo_has_the_words_of_the_demo() -> None:
    now = runpy.run_path(f"{DOCS / 'make_picture.py'}")["drawn"]()
    assert words((DOCS / "demo.svg").read_text("utf-8")) == words(now), "run: python docs/make_picture.py"
