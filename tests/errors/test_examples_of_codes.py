"""The example of each code is a message of the program, word for word where a test has it on record.

Messages that tests have had from the program are in messages.txt; a message that is another now fails the
test that has it. The texts of the source are the second witness, but for those of daqsvc/errors: an example
is no witness of itself.
"""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING

import pytest
from errors.test_codes_are_given import GIVEN, said_of
from project.test_quoted_messages import is_said
from support.given_codes import is_had
from support.paths import ROOT

from daqsvc.errors.table import CODES

if TYPE_CHECKING:
    from daqsvc.errors.code import Code

pytestmark = pytest.mark.sources
GOLDEN = ROOT / "tests" / "guard" / "golden"
OF_A_FILE = [code for code in CODES.values() if code.example.startswith("machine.toml")]
IN_OTHER_TESTS = {"B14", "D14", "F25", "O02", "S01", "F43"}
"""Codes of machine files that take more than such a file: another file, a plugin, or a service that runs."""

PUT_TOGETHER = {
    "C26": ("is left out",),
    "F26": ("no machine file (*.toml) is in this directory", "copy an example into it: daqsvc example"),
    "R04": (
        "it takes more memory than it may",
        "if it is not that large, it is damaged: copy or save it again",
    ),
    "R10": ("have different lengths", "map only channels taken together"),
    "O06": (
        "names one device, and each of several machines is one",
        "the name of each machine is its device id",
    ),
    "O10": ("its certificate is not signed by an authority in ca_file",),
    "O24": ("PostgreSQL is away, and nothing is acknowledged",),
    "O25": (),  # all words of the server of the page
    "S06": ("in the service's memory for a disk that cannot be written: this is not their present state",),
    "S18": ("do not end; the process is ended",),
    "B25": (),  # all words of a plugin
}
"""Examples that are made of texts of the source and words of libraries: those texts."""


def bare(text: str) -> str:
    """Without line breaks, folders and names of machine files, and without the memory of this computer."""
    text = re.sub(r"(?:[\w<>.~-]*/)+", "", " ".join(text.split()))
    text = re.sub(r"this computer has \S+ GB\. Remedy: write ring_s = .+? or less", "...", text)
    return re.sub(r"[\w-]+\.toml", "machine.toml", text)


@cache
def shown_by_check() -> str:
    """All that the guard has of it, and of other verbs."""
    return bare("\n".join(file.read_text(encoding="utf-8") for file in GOLDEN.glob("*.txt")))


@pytest.mark.parametrize("code", [code for code in CODES.values() if code not in OF_A_FILE], ids=str)
def test_the_example_has_the_words_of_the_program(code: Code) -> None:
    assert is_had(code.id, code.example) or is_said(code.example) or code.id in PUT_TOGETHER


@pytest.mark.parametrize("code", PUT_TOGETHER)
def test_an_example_that_is_put_together_has_its_words(code: str) -> None:
    assert all(part in CODES[code].example and is_said(part) for part in PUT_TOGETHER[code])


def test_an_example_that_nobody_has_said_is_found() -> None:
    example = "stream 'a': unit 3 has had enough of purple registers, which is counted from now on"
    assert not is_had("B33", example)
    assert not is_said(example)
    assert not is_said(CODES["B45"].cause), "it is in daqsvc/errors only"


@pytest.mark.parametrize("code", OF_A_FILE, ids=str)
def test_the_example_of_a_machine_file_is_what_check_shows(code: Code) -> None:
    """If this fails, a message was changed: copy the new one from the golden texts of the guard."""
    given = [text for one, path, edits in GIVEN if one == code.id for text in said_of(path, edits)]
    said = bare("\n".join(given)) if given else shown_by_check()
    assert f"{bare(code.example)} [{code}]" in said or code.id in IN_OTHER_TESTS
