"""What prose is held to: sentences that can be read in one go, and the words of the trade.

`vocabulary.toml` has the words, and how long a sentence may be; this module only applies them.
"""

from __future__ import annotations

import math
import re
import tomllib
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from prose.texts import items_of, texts_of
from support.paths import ROOT

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from prose.texts import Text

VOCABULARY = ROOT / "tests" / "prose" / "vocabulary.toml"
KINDS = ("page", "record", "cell", "message", "docstring", "comment")

_END = re.compile(r"""(?<=[.!?])(?<!e\.g\.)(?<!i\.e\.)["')\]*]*\s+(?=["'(*\[]*[A-Z\d`])""")
_WORD = re.compile(r"\w")


@dataclass(frozen=True)
class Finding:
    """One sentence or phrase to mend."""

    text: Text
    message: str

    def __str__(self) -> str:
        """As compilers print it, so that editors jump there."""
        return f"{self.text.file.relative_to(ROOT)}:{self.text.line}: {self.message}"


@dataclass(frozen=True)
class Phrase:
    """Words that readers stumbled over."""

    avoid: str
    write: str
    why: str
    kinds: tuple[str, ...] = KINDS

    @cached_property
    def pattern(self) -> re.Pattern[str]:
        """Finds whole words, in upper or lower case."""
        return re.compile(rf"\b(?:{self.avoid})\b", re.IGNORECASE)


@dataclass(frozen=True)
class Rules:
    """The vocabulary and the limits of length, by kind of text."""

    longest: dict[str, int]
    phrases: tuple[Phrase, ...]
    longest_item: int

    def findings(self, texts: Iterable[Text]) -> Iterator[Finding]:
        """All that is to be mended, in the order of the texts."""
        for text in texts:
            most = self.longest.get(text.kind, math.inf)
            for sentence in sentences(text.words, text.kind):
                if (words := length(sentence)) > most:
                    beginning = " ".join(sentence.split()[:8])
                    yield Finding(
                        text, f'{words} words in a sentence, at most {most}: split "{beginning} ..."'
                    )
            for phrase in self.phrases:
                if text.kind in phrase.kinds and (match := phrase.pattern.search(text.words)):
                    around = text.words[max(0, match.start() - 30) : match.end() + 30]
                    yield Finding(
                        text, f'"{match[0]}" is {phrase.why}: write {phrase.write} in "... {around} ..."'
                    )

    def long_items(self, items: Iterable[Text]) -> Iterator[Finding]:
        """List items with too many sentences: nobody finds a fact in there."""
        for item in items:
            if (words := length(item.words)) > self.longest_item:
                beginning = " ".join(item.words.split()[:8])
                yield Finding(
                    item,
                    f'{words} words in a list item, at most {self.longest_item}: divide "{beginning} ..."',
                )


def sentences(words: str, kind: str = "page") -> list[str]:
    """The sentences of a text; in a message a semicolon ends one, too: what follows is the remedy."""
    return [
        sentence
        for part in _END.split(words)
        for sentence in (part.split("; ") if kind == "message" else [part])
    ]


def length(sentence: str) -> int:
    """How many words a sentence has; code is one word, a dash and other marks are none."""
    return sum(bool(_WORD.search(word)) for word in sentence.split())


def rules(file: Path = VOCABULARY) -> Rules:
    """Those of the file."""
    data = tomllib.loads(file.read_text("utf-8"))
    phrases = (
        Phrase(entry["avoid"], entry["write"], entry["why"], tuple(entry.get("in", KINDS)))
        for entry in data["phrase"]
    )
    return Rules(data["longest_sentence"], tuple(phrases), data["longest_item"])


def prose_files(root: Path = ROOT) -> list[Path]:
    """Pages, sources, and all else with comments or texts for people that is held to the rules.

    The pages of docs/reference are made from the sources, whose messages have fewer rules than pages.
    """
    pages = [*root.glob("*.md"), *root.glob("docs/**/*.md")]
    machines = root.glob("config/**/*.toml")
    sources = [
        file
        for folder in ("daqsvc", "drivers", "sim_hw", "docs", "config", "tests/support")
        for file in root.glob(f"{folder}/**/*.py")
    ]
    others = [
        *(root / "daqsvc/page").glob("**/*.html"),
        *(root / "daqsvc/page/static").glob("*.js"),
        *root.glob("docs/site_static/*.js"),
        *(file for file in root.glob("config/**/*") if file.suffix in {".sql", ".yml", ".service", ".conf"}),
        *(file for file in root.glob("packaging/debian/*") if file.is_file() and file.name != "copyright"),
        *root.glob("Makefile"),
    ]
    return [
        *sorted(pages),
        *sorted(machines),
        *(file for file in sorted(sources) if not file.stem.endswith("_pb2")),
        *sorted(others),
    ]


def findings(files: Iterable[Path]) -> list[Finding]:
    """What is to be mended in the files."""
    every = rules()
    found: list[Finding] = []
    for file in files:
        found += every.findings(texts_of(file))
        if file.suffix == ".md" and file.name != "CHANGELOG.md":
            found += every.long_items(items_of(file))
    return found
