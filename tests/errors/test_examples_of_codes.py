"""The example of each code is a message of the program, word for word where a test has it on record."""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING

import pytest
from errors.test_codes_are_given import GIVEN, said_of
from project.test_quoted_messages import is_said
from support.paths import ROOT

from daqsvc.errors.table import CODES

if TYPE_CHECKING:
    from daqsvc.errors.code import Code

pytestmark = pytest.mark.sources
GOLDEN = ROOT / "tests" / "guard" / "golden"
OF_A_FILE = [code for code in CODES.values() if code.example.startswith("machine.toml")]
IN_OTHER_TESTS = {"B14", "D14", "F25", "O02", "S01", "F43"}
"""Codes of machine files that take more than such a file: another file, a plugin, or a service that runs."""


def bare(text: str) -> str:
    """Without line breaks, folders and names of machine files, and without the memory of this computer."""
    text = re.sub(r"(?:[\w<>.~-]*/)+", "", " ".join(text.split()))
    text = re.sub(r"this computer has \S+ GB\. Remedy: write ring_s = .+? or less", "...", text)
    return re.sub(r"[\w-]+\.toml", "machine.toml", text)


@cache
def shown_by_check() -> str:
    """All that the guard has of it, and of other verbs."""
    return bare("\n".join(file.read_text(encoding="utf-8") for file in GOLDEN.glob("*.txt")))


@pytest.mark.parametrize("code", CODES.values(), ids=str)
def test_the_example_has_the_words_of_the_program(code: Code) -> None:
    assert is_said(code.example)


@pytest.mark.parametrize("code", OF_A_FILE, ids=str)
def test_the_example_of_a_machine_file_is_what_check_shows(code: Code) -> None:
    """If this fails, a message was changed: copy the new one from the golden texts of the guard."""
    given = [text for one, path, edits in GIVEN if one == code.id for text in said_of(path, edits)]
    said = bare("\n".join(given)) if given else shown_by_check()
    assert f"{bare(code.example)} [{code}]" in said or code.id in IN_OTHER_TESTS
