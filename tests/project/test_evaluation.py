"""docs/evaluate.md quotes the figures that stand on the other pages, and commands that exist."""

from __future__ import annotations

import importlib.util
import re
import shutil
from typing import TYPE_CHECKING

import pytest
from support.paths import ROOT

from daqsvc.cli import commands

if TYPE_CHECKING:
    from pathlib import Path
    from types import ModuleType

DOCS = ROOT / "docs"
SOURCES = (
    "alarms",
    "alignment",
    "bearing",
    "detectability",
    "driver-contract",
    "edge-box",
    "fleet",
    "outbox",
    "page",
    "plants",
    "race-test",
    "reproduce",
    "rotor-figures",
    "several-machines",
)


@pytest.fixture(scope="module")
def maker() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_evaluation", DOCS / "make_evaluation.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def commands_of(text: str) -> list[str]:
    """What stands at the end of each row of the tables."""
    return re.findall(r"(?m)^\| \[.*\]\(\S+\) \| .* \| .*: `([^`]+)` \|$", text)


def test_the_figures_are_those_of_the_pages_that_they_are_taken_from(maker: ModuleType) -> None:
    """If this fails, run: make evaluation."""
    assert (DOCS / "evaluate.md").read_text("utf-8") == maker.evaluation(DOCS)


def other_figures(line: str) -> str:
    """A line of a table with another figure wherever there is one, but in its first cell."""
    first, bar, rest = line[1:].partition("|")
    return f"|{first}{bar}" + re.sub(r"\d", lambda digit: str((int(digit[0]) + 1) % 10), rest)


@pytest.mark.parametrize("name", SOURCES)
def test_figures_that_change_on_a_page_change_the_tables(
    maker: ModuleType, tmp_path: Path, name: str
) -> None:
    for file in DOCS.glob("*.md"):
        shutil.copy(file, tmp_path)
    page = tmp_path / f"{name}.md"
    # Headings of tables are what figures are looked up by: the line above |---|.
    text = re.sub(
        r"(?m)^\|(?!---).*\|$(?!\n\|---)", lambda row: other_figures(row[0]), page.read_text("utf-8")
    )
    page.write_text(text, "utf-8")
    try:
        made = maker.evaluation(tmp_path)
    except maker.FigureIsMissingError:
        return  # a figure is in what it is looked up by
    assert made != (DOCS / "evaluate.md").read_text("utf-8")


def test_a_page_that_lost_its_table_is_named(maker: ModuleType, tmp_path: Path) -> None:
    for file in DOCS.glob("*.md"):
        shutil.copy(file, tmp_path)
    (tmp_path / "plants.md").write_text("# Nothing here\n", "utf-8")
    with pytest.raises(maker.FigureIsMissingError, match=r"plants\.md"):
        maker.evaluation(tmp_path)


def test_a_column_that_has_another_name_is_named(maker: ModuleType, tmp_path: Path) -> None:
    for file in DOCS.glob("*.md"):
        shutil.copy(file, tmp_path)
    page = tmp_path / "detectability.md"
    page.write_text(page.read_text("utf-8").replace("| SNR |", "| ratio |"), "utf-8")
    with pytest.raises(maker.FigureIsMissingError, match="no column 'SNR'"):
        maker.evaluation(tmp_path)


def test_every_command_exists() -> None:
    named = commands_of((DOCS / "evaluate.md").read_text("utf-8"))
    targets = set(re.findall(r"(?m)^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8")))
    verbs = set(commands())
    assert len(named) > 30
    kinds = set()
    for command in named:
        words = [word for word in command.split() if not re.match(r"[A-Z_]+=", word)]
        kinds.add(words[0])
        if words[0] == "make":
            assert words[1] in targets, command
        elif words[0] == "daqsvc":
            assert words[1] in verbs, command
        elif words[0] == "python":
            assert importlib.util.find_spec(words[words.index("-m") + 1]), command
        else:
            assert words[0] == "pytest", command
            assert (ROOT / words[-1]).is_file(), command
    assert kinds == {"make", "daqsvc", "python", "pytest"}


def test_a_figure_in_a_limit_stands_on_a_page_that_it_links() -> None:
    section = (DOCS / "evaluate.md").read_text("utf-8").partition("## Where it is weak")[2]
    limits = section.partition("\n## ")[0].split("\n- ")[1:]
    checked = 0
    for limit in limits:
        links = re.findall(r"\]\(([\w.-]+\.md)", limit)
        pages = " ".join(" ".join((DOCS / page).read_text("utf-8").split()) for page in links)
        own = " ".join(re.sub(r"\]\(\S+\)", "]", limit).split())
        for figure in re.findall(r"\d+(?:\.\d+)?(?:, \d+ and \d+)?(?: %| ms| points|\b)", own):
            assert figure in pages, (figure, links)
            checked += 1
    assert checked >= 5


def test_the_rigs_are_as_many_as_are_named_and_are_those_of_the_race_test() -> None:
    text = " ".join((DOCS / "evaluate.md").read_text("utf-8").split())
    found = re.search(r"Records of (\w+) test rigs \(([^)]*)\)", text)
    assert found is not None
    names = found[2].split(", ")
    assert found[1] == {2: "two", 3: "three", 4: "four"}[len(names)]
    measured = (DOCS / "race-test.md").read_text("utf-8")
    assert [name for name in names if name not in measured] == []


def test_every_link_leads_to_a_page_and_a_heading() -> None:
    for name in ("evaluate.md", "comparison.md"):
        for target in set(re.findall(r"\]\(([\w.-]+\.md(?:#[\w-]+)?)\)", (DOCS / name).read_text("utf-8"))):
            page, _, anchor = target.partition("#")
            text = (DOCS / page).read_text("utf-8")
            headings = re.findall(r"(?m)^#+ (.*)$", text)
            slugs = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
            assert not anchor or anchor in slugs, target
