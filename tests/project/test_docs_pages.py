"""Every page of the documentation is listed in its index, and what it links to is there.

Anchors, and what the site makes of it all: test_docs_site.py.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path

import pytest
from prose.texts import texts_of
from support.paths import ROOT

from daqsvc.documentation import TITLES

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
TEXTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *PAGES]
WRITTEN = [
    ROOT / "README.md",
    *(page for page in PAGES if page.parent.name not in {"reference", "decisions"}),
]
"""The pages that nothing generates and that are of today."""
LISTED = re.compile(r"^(?:- |\| )\[[^\[\]]+\]\(([^()\s#]+\.md)\)", re.MULTILINE)
FENCED = re.compile(r"^ *(`{3,}).*?^ *\1 *$", re.MULTILINE | re.DOTALL)
NAMED = re.compile(r"\bdocs/[\w/-]+\.md")
NAME = re.compile(r"(?<![\w/.-])(?:[a-z][a-z0-9]*(?:_[a-z0-9]+)+|--[a-z][a-z0-9-]+)(?![\w/-])")
"""A key, a counter or a file of two words, or an option."""
OF_OTHERS = {
    *("buffer_strategy", "purge_keep_days", "hive_partitioning", "autosave_interval", "pg_hba"),
    *("accel_g", "probe_x", "make_run_up", "mosquitto_sub"),
}
"""Names of other programs, and of files and channels of a reader."""
LINK = re.compile(r"\]\(([^()\s#]+)(?:#[^()\s]*)?\)")


def lists(page: Path) -> list[Path]:
    """The pages that a page lists, and those that a README.md among them lists, as the site has them."""
    found = [(page.parent / name).resolve() for name in LISTED.findall(page.read_text("utf-8"))]
    return found + [below for page in found if page.name == "README.md" for below in lists(page)]


def test_every_page_is_listed_once_with_a_line_that_says_when_to_read_it() -> None:
    index = DOCS / "index.md"
    assert sorted(lists(index)) == [page for page in PAGES if page != index]
    text = index.read_text("utf-8")
    assert re.findall("(?m)^## (.*)", text) == ["Tutorials", "How-to guides", "Reference", "Explanation"]
    entries = [line for line in text.splitlines() if line.startswith("- ")]
    assert [entry for entry in entries if not re.match(r"- \[.+\]\(.+\): .{20,}\.$", entry)] == []


def test_the_glossary_has_the_words_that_are_not_explained_where_they_are() -> None:
    """And pages link to it where such a word is first met."""
    words = set(re.findall(r'<a id="([^"]+)"', (DOCS / "glossary.md").read_text("utf-8")))
    assert words >= {
        *("statement", "finding", "cover", "set-aside", "departure", "first-out", "evidence", "nat", "score"),
        *("prior", "whirl", "1x", "innovation", "residual", "coloured", "keyphasor"),
    }
    linked = {
        word for page in PAGES for word in re.findall(r"glossary\.md#([\w-]+)\)", page.read_text("utf-8"))
    }
    assert linked >= {"statement", "finding", "cover", "set-aside", "departure", "first-out", "nat", "score"}
    assert linked <= words


@pytest.mark.sources
@pytest.mark.parametrize("text", TEXTS, ids=lambda text: f"{text.relative_to(ROOT)}")
def test_what_is_linked_is_there(text: Path) -> None:
    links = [link for link in LINK.findall(FENCED.sub("", text.read_text("utf-8"))) if ":" not in link]
    assert [link for link in links if not (text.parent / link).exists()] == []


@functools.cache
def names_of_the_tree() -> set[str]:
    """All names in the program, its tests, examples and reference, and those of the files."""
    rooms = ("daqsvc", "drivers", "sim_hw", "tests", "config", "packaging", "docs/reference")
    files = [file for room in rooms for file in (ROOT / room).rglob("*.*")] + [*DOCS.rglob("*.py")]
    found = {file.stem for file in files}
    texts = {".py", ".toml", ".md", ".js", ".sql", ".yaml", ".service"}
    for file in files:
        if file.suffix in texts and file != Path(__file__):
            found |= {*re.findall(r"--[a-z][a-z0-9-]+|\w+", file.read_text("utf-8"))}
    return found


@pytest.mark.sources
@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: f"{page.relative_to(ROOT)}")
def test_a_key_a_counter_and_an_option_that_a_page_names_is_somewhere(page: Path) -> None:
    marked = re.findall(r"`([^`\n]+)`", FENCED.sub("", page.read_text("utf-8")))
    named = {name for text in marked for name in NAME.findall(text)}
    assert named - names_of_the_tree() - OF_OTHERS == set()


def test_a_name_of_others_is_on_a_page() -> None:
    assert [name for name in OF_OTHERS if not any(name in page.read_text("utf-8") for page in WRITTEN)] == []


@pytest.mark.parametrize("page", TITLES)
def test_texts_of_the_program_name_a_page_by_its_title(page: str) -> None:
    title = (DOCS / f"{page}.md").read_text("utf-8").splitlines()[0]
    assert title.replace("`", "") == f"# {TITLES[page]}"


def test_no_text_that_a_user_reads_names_a_file_of_docs() -> None:
    """A user of the package has the site, and no docs/*.md."""
    program = [file for room in ("daqsvc", "drivers") for file in (ROOT / room).rglob("*.py")]
    templates = [*(ROOT / "daqsvc/page").rglob("*.html")]
    texts = [text for file in [*program, *templates] for text in texts_of(file) if text.kind == "message"]
    machines = (ROOT / "config/machines").rglob("*.toml")
    texts += [text for file in machines for text in texts_of(file)]
    named = {f"{text.file.relative_to(ROOT)}: {text.words}" for text in texts if NAMED.search(text.words)}
    # It looks where the pages are on this computer.
    assert [text for text in sorted(named) if not text.startswith("daqsvc/commands/explain.py")] == []
