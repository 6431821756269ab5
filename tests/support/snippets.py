"""The fenced blocks of README, CONTRIBUTING and the pages of docs/, word for word.

``PYTHONPATH=tests python -m support.snippets`` lists them.
"""

from __future__ import annotations

import copy
import re
import shlex
import textwrap
from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
_BLOCK = re.compile(
    r"^(?: *<!-- not run: (?P<why>[^\n]+) -->\n+)?(?P<indent> *)(?P<ticks>`{3,})(?P<language>[\w{}]*)\n"
    r"(?P<text>.*?)^(?P=indent)(?P=ticks)$",
    re.MULTILINE | re.DOTALL,
)
_REMARK = re.compile(r"(?:^|\s+)#\s.*$", re.MULTILINE)


class Snippet(NamedTuple):
    """A fenced block.

    Attributes:
        page: where it stands.
        line: of that page, from 1.
        language: what follows the backticks.
        text: without the indentation of the fence.
        why_not_run: the text of the comment before it (``<!-- not run: ... -->``); "" if there is none.
    """

    page: Path
    line: int
    language: str
    text: str
    why_not_run: str

    @property
    def name(self) -> str:
        """Page and line."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def commands(self) -> list[str]:
        """What a person types: the lines of a shell, or those behind ``$`` in what a terminal shows."""
        text = self.text
        if self.language != "sh":
            text = "\n".join(line[2:] for line in text.splitlines() if line.startswith("$ "))
        lines = _REMARK.sub("", text.replace("\\\n", "")).splitlines()
        return [line.strip() for line in lines if line.strip()]


def snippets(page: Path) -> list[Snippet]:
    """The blocks of a page, in their order."""
    text = page.read_text("utf-8")
    return [
        Snippet(
            page,
            text.count("\n", 0, block.start("ticks")) + 1,
            block["language"],
            textwrap.dedent(block["text"]) if block["indent"] else block["text"],
            block["why"] or "",
        )
        for block in _BLOCK.finditer(text)
    ]


def documented() -> list[Snippet]:
    """The blocks of all pages but docs/tutorials, which has a separate reader."""
    tutorials = ROOT / "docs" / "tutorials"
    return [one for page in PAGES if not page.is_relative_to(tutorials) for one in snippets(page)]


def simple(command: str) -> Iterator[list[str]]:
    """The simple commands of a line, each as its words, without redirection and variables that are set."""
    lexer = shlex.shlex(command, posix=True, punctuation_chars="();<>|&")
    lexer.whitespace_split = True
    words: list[str] = []
    for word in [*lexer, ";"]:
        if set(word) <= set("();|&"):
            while words and re.match(r"\w+=", words[0]):
                del words[0]
            if words:
                yield words
            words = []
        else:
            words.append(word)


def completed(machine: Mapping[str, Any], part: Mapping[str, Any]) -> dict[str, Any]:
    """A machine file with a part put in: buses and layouts whole, sensors and alarms by their names."""
    made = copy.deepcopy(dict(machine))
    for key, value in part.items():
        if key in {"sensors", "alarms"}:
            names = {one["name"] for one in value}
            made[key] = [one for one in made.get(key, []) if one["name"] not in names] + value
        elif isinstance(value, dict) and key != "layout" and isinstance(made.get(key), dict):
            made[key] = made[key] | value if key == "buses" else completed(made[key], value)
        else:
            made[key] = value
    return made


def _print_all() -> None:
    """Every block, and how many there are of each language."""
    found = [one for page in PAGES for one in snippets(page)]
    for one in found:
        print(f"{one.name:40} {one.language or '-':10} {one.why_not_run and f'not run: {one.why_not_run}'}")  # noqa: T201
    print(dict(Counter(one.language or "-" for one in found)))  # noqa: T201


if __name__ == "__main__":
    _print_all()
