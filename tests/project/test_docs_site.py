"""``make docs``: what the site makes of pages that are written for a forge, and at what its build fails."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING
from urllib.parse import unquote

import pytest
from support.docs_site import built_docs, copied_tree, make_docs
from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.integration, pytest.mark.long, pytest.mark.sources]
OURS = re.compile(r'(?:src|href)="(?!https?:|data:|mailto:)([^"#?]+)')


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    return built_docs(tmp_path_factory)


def test_all_that_the_pages_need_is_in_the_site(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) >= len(list((ROOT / "docs").rglob("*.md")))
    for page in pages:
        text = page.read_text("utf-8")
        assert not re.search(r'<(?:script|img|link)[^>]* (?:src|href)="(?:https?:)?//', text), page
        assert [link for link in OURS.findall(text) if not (page.parent / unquote(link)).exists()] == [], page
    for style in site.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import)\W*(?:https?:)?//", style.read_text("utf-8")), style


def test_options_keep_their_two_hyphens(site: Path) -> None:
    for page in site.rglob("*.html"):
        assert re.findall(r"[–—][a-z][a-z-]+|[“”]", page.read_text("utf-8")) == [], page  # noqa: RUF001


def test_links_of_the_readme_lead_to_pages_and_copies_of_files(site: Path) -> None:
    text = (site / "readme.html").read_text("utf-8")
    assert 'href="edge-box.html#reload"' in text
    assert 'href="decisions/README.html"' in text
    assert 'href="contributing.html"' in text
    [copy] = re.findall(r'href="(_downloads/\w+/serial-probes.toml)"', text)
    assert (site / copy).read_bytes() == (ROOT / "config/machines/serial-probes.toml").read_bytes()
    # A folder has no page: its name stays.
    assert re.search(r"<code[^>]*><span[^>]*>config/machines/</span></code> has examples", text)


def test_the_side_has_the_lists_of_the_index(site: Path) -> None:
    text = (site / "mqtt.html").read_text("utf-8")
    captions = re.findall(r'<p class="caption"[^>]*><span class="caption-text">(.*?)</span>', text)
    assert captions == ["Tutorials", "How-to guides", "Reference", "Explanation"]
    assert re.search(r'<a class="reference internal" href="decisions/0003-sqlite-outbox.html">', text)


def test_the_build_fails_at_links_that_lead_nowhere_and_names_each(tmp_path: Path) -> None:
    tree = copied_tree(tmp_path)
    docs = tree / "docs"
    with (docs / "history.md").open("a") as page:
        page.write("\n[a](no-page.md), [b](alarms.md#no-heading), [c](#not-here), [d](../config/no.toml)\n")
        page.write('\n<a href="no-html.html">e</a> <img src="pictures/no.svg"> [f][no-reference]\n')
        page.write('\n<a href="alarms.html#no-raw-anchor">g</a> <a href="alarms.html#states">h</a>\n')
    (docs / "forgotten.md").write_text("# In no list\n")
    with (docs / "search_questions.toml").open("a") as questions:
        questions.write('"alarms#no-such-section" = ["a question"]\n')
    made = make_docs(tree)
    assert made.returncode != 0
    assert "alarms.html#states" not in made.stderr
    for what in (
        "no-html.html",
        "pictures/no.svg",
        "[f][no-reference]",
        "alarms.html#no-raw-anchor",
        "no such place: alarms#no-such-section",
        "no-page.md",
        "no-heading",
        "not-here",
        "no.toml",
        "forgotten.md",
    ):
        assert what in made.stderr, made.stderr
