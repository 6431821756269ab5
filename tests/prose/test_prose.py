"""The check of prose finds what it is for, where it is, and nothing else."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING

import pytest
from prose.rules import KINDS, VOCABULARY, length, prose_files, rules, sentences
from prose.texts import items_of, texts_of
from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

MADE_OF_OTHERS = {"readme", "contributing", "changelog"}
LONG = "The line is quiet and " * 30 + "then it is used."


def found(file: Path) -> list[tuple[int, str]]:
    return [(finding.text.line, finding.message) for finding in rules().findings(texts_of(file))]


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("page.md", "# Title\n\nA sentence.\n\n", "\n"),
        ("item.md", "# Title\n\n- An item.\n- ", "\n- another\n"),
        ("table.md", "| a | b |\n|---|---|\n| ", " | cell |\n"),
        ("module.py", '"""One line.\n\n', '\n"""\n'),
        ("function.py", 'def f():\n    """', '"""\n'),
        ("attribute.py", 'X = 1\n"""', '"""\n'),
        ("comment.py", "x = 1\ny = 2\n# ", "\n"),
        ("remark.py", "x = 1\ny = 2\nz = 3  # ", "\n"),
        ("message.py", 'def f(x):\n    pass\n    raise ValueError("', '")\n'),
        ("formatted.py", 'def f(x):\n    pass\n    raise ValueError(f"{x} and {x}: ', '")\n'),
        ("machine.toml", "x = 1\ny = 2\n# ", "\n"),
        ("remark.toml", "x = 1\ny = 2\nz = 3  # ", "\n"),
        ("page.html", "{% if x %}\n<p>{{ x }}</p>\n<p class='a'>", " <b>{{ y }}</b></p>\n{% endif %}\n"),
        ("hint.html", "{# A\nremark. #}\n<button title='", "'>x</button>\n"),
        ("script.js", "let x = 1;\n/* ", " */\n"),
        ("line.js", "const x = 'a'; // b\nx();\n  // ", "\n"),
        ("shown.js", "const x = '//';\nshow(`", " ${x}`);\n"),
        ("schema.sql", "-- A table.\n\n-- ", "\nCREATE TABLE x ();\n"),
        ("remark.sql", "CREATE TABLE x (\n    y INT -- ", "\n);\n"),
        ("Makefile", "# make x   the first thing\n# make y   ", "\nx:\n"),
        ("unit.service", "[Unit]\n# ", "\nType=notify\n"),
        ("postrm", "#!/bin/sh\n# ", "\nexit 0\n"),
    ],
)
@pytest.mark.parametrize("bad", [LONG, "It was made at need."])
def test_a_bad_sentence_is_found_wherever_prose_lies(
    name: str, before: str, after: str, bad: str, tmp_path: Path
) -> None:
    file = tmp_path / name
    file.write_text(f"{before}{bad}{after}", "utf-8")
    if name == "table.md" and bad is LONG:
        assert found(file) == []  # a cell is a list, often
        return
    [(line, message)] = found(file)
    assert line == before.count("\n") + 1
    assert ("words in a sentence" in message) == (bad is LONG)
    file.write_text(f"{before}The line is quiet.{after}", "utf-8")
    assert found(file) == []


@pytest.mark.parametrize(
    "code",
    [
        "```sh\nmake it at need\n```\n",
        "`made at need` is a key.\n",
        "See [this page](made-at-need.md).\n",
        "    made at need\n",
    ],
)
def test_code_and_links_of_a_page_are_no_prose(code: str, tmp_path: Path) -> None:
    file = tmp_path / "page.md"
    file.write_text(f"# Title\n\n{code}", "utf-8")
    assert found(file) == []


@pytest.mark.parametrize(
    "entry", tomllib.loads(VOCABULARY.read_text("utf-8"))["phrase"], ids=lambda e: e["avoid"]
)
def test_an_entry_of_the_vocabulary_is_whole(entry: dict[str, str]) -> None:
    assert {*entry} - {"in"} == {"avoid", "write", "why"}
    assert {*entry.get("in", KINDS)} <= {*KINDS}


@pytest.mark.parametrize(
    ("kind", "bad", "good"),
    [
        ("message", "Copy it anew, or give another one.", "Copy it again, or give another one."),
        ("message", "Nobody knows when it ends.", "It is not known when it ends."),
        ("message", "Its certificate is vouched for.", "Its certificate is signed."),
        ("message", "This waits until it is mended.", "This waits until it is corrected."),
        ("message", "Its id is written down first.", "Its id is stored first."),
        ("message", "The socket was taken away.", "The socket was removed."),
        ("message", "It is told of one event.", "It is not told apart from one."),
        ("message", "The site is another one.", "The site is different."),
        ("message", "False alarms are 0.001 a look.", "False alarms are 0.001 an evaluation."),
        ("message", "See to the disk if it happens.", "Check the disk if it happens."),
        ("message", "The file says no rate.", "The file states no rate."),
        ("message", "It does not say when it began.", "It does not state when it began."),
        ("message", "The alarm stands in the list.", "The alarm is in the list, and stands out."),
        ("docstring", "Nobody has seen what lies between.", "What lies between is not known."),
        (
            "docstring",
            "So many looks in a row agree.",
            "Evaluations in a row that agree, so that it is sure.",
        ),
        ("docstring", "OSError: likewise, or it is gone.", "OSError: as above, or it is gone."),
        ("comment", "Two looks must agree first.", "It looks like a counter that stands still."),
    ],
)
def test_words_that_readers_stumbled_over_are_found(kind: str, bad: str, good: str, tmp_path: Path) -> None:
    file = tmp_path / "module.py"
    form = {
        "message": "raise ValueError('{}')\n",
        "docstring": 'X = 1\n"""{}"""\n',
        "comment": "x = 1\n# {}\n",
    }
    file.write_text(form[kind].format(bad), "utf-8")
    assert found(file)
    file.write_text(form[kind].format(good), "utf-8")
    assert found(file) == []


def test_a_list_item_of_many_short_sentences_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    many = "It is short. " * 34
    page.write_text(f"# Title\n\n{many}\n\n- An item.\n- {many}\n- {'It is short. ' * 33}\n", "utf-8")
    [finding] = rules().long_items(items_of(page))
    assert (finding.text.line, finding.message.split(":")[0]) == (6, "102 words in a list item, at most 100")


def test_a_limit_is_there_for_each_kind_of_text_but_cells() -> None:
    assert {*rules().longest} == {*KINDS} - {"cell"}


def test_the_changelog_may_have_longer_sentences(tmp_path: Path) -> None:
    limits = rules().longest
    assert limits["record"] > limits["page"]
    sentence = " ".join(["word"] * limits["record"]) + "."
    for file, is_record in ((tmp_path / "CHANGELOG.md", True), (tmp_path / "page.md", False)):
        file.write_text(f"# Title\n\n{sentence}\n", "utf-8")
        assert (found(file) == []) is is_record


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("One sentence. Another one? Yes! `x` is a key.", 4),
        ("It takes 0.5 s, e.g. on CAN, at 3.2 kHz, e.g. 5 times.", 1),
        ("It was refused. 20 of them were not.", 2),
        ("See docs/can.md for more.", 1),
        ('He wrote "no frame." Then it came.', 2),
    ],
)
def test_sentences_end_where_they_end(text: str, count: int) -> None:
    assert len(sentences(text)) == count


def test_marks_are_no_words() -> None:
    assert length("a - b = `x` / 2") == 4


@pytest.mark.sources
def test_pages_machine_files_and_sources_are_all_read() -> None:
    files = {str(file.relative_to(ROOT)) for file in prose_files()}
    assert {
        "README.md",
        "docs/alarms.md",
        "docs/decisions/README.md",
        "config/machines/laval-rig.toml",
    } <= files
    assert {"daqsvc/cli.py", "drivers/base.py", "sim_hw/sim_command.py"} <= files
    assert {"Makefile", "docs/conf.py", "docs/make_pictures/style.py", "tests/support/waiting.py"} <= files
    assert {"daqsvc/page/templates/alarms.html", "daqsvc/page/static/page.js"} <= files
    assert {"docs/site_static/site_search.js", "config/postgresql/schema.sql"} <= files
    assert {"config/systemd/daqsvc@.service", "packaging/debian/daqsvc.postrm"} <= files


PAGES = sorted(page for page in (ROOT / "docs").glob("*.md") if page.stem not in {"index", *MADE_OF_OTHERS})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_begins_with_whom_it_is_for(page: Path) -> None:
    _, first, *_ = texts_of(page)
    assert first.words.startswith("This page is for ")
