"""The table of codes: what is promised of it, the page that is made of it, and ``daqsvc explain``."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from support.given_codes import had
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.errors.code import Code
from daqsvc.errors.table import CODES, GROUPS

if TYPE_CHECKING:
    from collections.abc import Iterator

GIVEN_OUT = ROOT / "tests" / "errors" / "codes.txt"
"""Every code that was ever given out, with its name; one that is no longer used is ``retired``."""


def named() -> Iterator[tuple[str, str]]:
    """The codes in the modules of the groups, with the names of their constants."""
    for group in GROUPS.values():
        for name, value in vars(group).items():
            if isinstance(value, Code):
                yield value.id, name


def test_a_code_that_was_given_out_keeps_its_meaning() -> None:
    """A new code gets a line at the end of its group; the line of one that goes says ``retired``."""
    given_out = [tuple(line.split()) for line in GIVEN_OUT.read_text(encoding="utf-8").splitlines()]
    assert [one for one in given_out if one[1] != "retired"] == list(named())
    ids = [one[0] for one in given_out]
    assert sorted(set(ids), key=lambda one: (list(GROUPS).index(one[0]), one)) == ids


def test_codes_are_a_letter_of_a_group_and_two_digits() -> None:
    assert len(CODES) == len(list(named()))
    for letter, group in GROUPS.items():
        for code in vars(group).values():
            if isinstance(code, Code):
                assert re.fullmatch(rf"{letter}[0-9][0-9]", code.id)


@pytest.mark.parametrize("code", CODES.values(), ids=str)
def test_each_code_has_whole_sentences_and_a_page(code: Code) -> None:
    assert not code.title.endswith(".")
    assert code.example
    for text in (code.cause, code.remedy):
        assert len(text.split()) > 3
        assert text.endswith(".")
    file, _, heading = code.page.partition("#")
    lines = (ROOT / "docs" / file).read_text(encoding="utf-8").splitlines()
    headings = {
        re.sub(r"[^a-z0-9 -]", "", line.lower()).strip().replace(" ", "-") for line in lines if "#" in line
    }
    assert not heading or heading in headings


def test_titles_are_different() -> None:
    titles = [code.title for code in CODES.values()]
    assert sorted(titles) == sorted({*titles})


def test_the_page_has_a_place_for_each_code() -> None:
    """That it is current, tests/project/test_reference.py sees."""
    page = (ROOT / "docs" / "reference" / "errors.md").read_text(encoding="utf-8")
    for code in CODES.values():
        assert f'<a id="{code.id.lower()}"></a>\n\n### {code}: {code.title}\n\n{code.cause}' in page


def test_explain_says_cause_remedy_and_where_to_read_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "F05", "[b10]"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    for code in (CODES["F05"], CODES["B10"]):
        assert f"{code.id} {code.title}" in said
        assert f"Cause: {code.cause} Remedy: {code.remedy} More: docs/{code.page}" in said
    assert "docs/reference/errors.md#f05" in said


def test_explain_without_a_code_lists_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain"]) == 0
    listed = re.findall(r"^  ([A-Z][0-9]{2})  (.+)$", capsys.readouterr().out, re.MULTILINE)
    assert listed == [(code.id, code.title) for code in CODES.values()]


def test_explain_of_a_code_that_there_is_not(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "F05", "Z99"]) == 2
    out, err = capsys.readouterr()
    assert not out
    assert err == "daqsvc explain: there is no code 'Z99'; daqsvc explain lists them [C14]\n"


@pytest.mark.parametrize("key", ["on_delay_s", "alarms.on_delay_s", "frames_lost", "no samples"])
def test_explain_of_what_is_no_code_names_where_that_is_explained(
    key: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["explain", key]) == 2
    said = capsys.readouterr().err
    assert said.startswith(
        f"daqsvc explain: '{key}' is no code; it takes the code at the end of a message, e.g. B05"
    )
    assert 'a key of the machine file see "Keys of the machine file" in the documentation' in said
    had("C14", said)


@pytest.mark.parametrize(
    "words",
    [["m.toml:24: speed_rpm = 1: must be more. Remedy: write 600 [F05]"], ["must", "be", "more", "[F05]"]],
)
def test_explain_takes_a_message_that_was_pasted(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["explain", *words]) == 0
    assert capsys.readouterr().out.startswith("F05  ")
