"""Where prose lies in a file, and how to get it out of there.

A text is one paragraph, list item, table cell, comment or message, with the line on which it begins. Code in
it is one word, so that names and commands are neither counted nor judged.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from dataclasses import dataclass
from functools import partial
from html.parser import HTMLParser
from typing import TYPE_CHECKING, TypeGuard

from markdown_it import MarkdownIt

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from markdown_it.token import Token

CODE = "`x`"
"""What code in a text is replaced by: one word that no rule knows."""

_LITERAL = re.compile(r"``[^`]+``|`[^`\n]+`")
_BLANK = re.compile(r"\s*$")
# A list item is a text by itself, and so is an entry below "Args:", a row of a table and a heading.
# So is a formula.
_ITEM = re.compile(r"\s*([-*] |\d+\. |\w+: |\w+\n|[|=:`#]|\w+( \w+)? = )")
_DIRECTIVE = re.compile(r"#\s*(noqa|type: ignore|pragma).*")
# What is written in a language for machines, in strings of several lines.
_PROGRAM = re.compile(
    r"\n.*( = |^CREATE |^SELECT |^PRAGMA )|^\s*(CREATE|SELECT|INSERT|UPDATE|DELETE) ", re.DOTALL
)
_TOML_COMMENT = re.compile(r"# ?\S")
_TOML_REMARK = re.compile(r"""\s# ([^"']+)$""")


@dataclass(frozen=True)
class Text:
    """A piece of prose, in one line, and where it begins."""

    file: Path
    line: int
    kind: str
    words: str


def texts_of(file: Path) -> Iterator[Text]:
    """All prose of a page, a module, or another file with comments."""
    readers = {
        ".md": _of_page,
        ".py": _of_module,
        ".toml": _of_toml,
        ".html": _of_template,
        ".js": _of_script,
        ".sql": partial(_of_lines, mark="--"),
    }
    # Others have comments as a shell has them: units of systemd, Makefile, rules of Debian.
    reader = readers.get(file.suffix, partial(_of_lines, mark="#"))
    is_record = file.name == "CHANGELOG.md"
    for line, found, words in reader(file.read_text("utf-8")):
        kind = "record" if is_record and found == "page" else found
        if plain := " ".join(_LITERAL.sub(CODE, words).split()):
            yield Text(file, line, kind, plain)


def _of_page(text: str) -> Iterator[tuple[int, str, str]]:
    line, kind = 1, "page"
    for token in MarkdownIt("commonmark").enable("table").parse(text):
        if token.map:
            line = token.map[0] + 1
        if token.type in {"table_open", "table_close"}:
            kind = "cell" if token.type == "table_open" else "page"
        elif token.type == "inline":
            yield line, kind, "".join(_visible(token.children or []))


def items_of(page: Path) -> Iterator[Text]:
    """The paragraphs of the list items of a page, which is in Markdown."""
    depth, line = 0, 1
    for token in MarkdownIt("commonmark").enable("table").parse(page.read_text("utf-8")):
        if token.map:
            line = token.map[0] + 1
        depth += {"list_item_open": 1, "list_item_close": -1}.get(token.type, 0)
        if depth and token.type == "inline":
            yield Text(page, line, "page", " ".join("".join(_visible(token.children or [])).split()))


def _visible(tokens: list[Token]) -> Iterator[str]:
    for token in tokens:
        if token.type in {"softbreak", "hardbreak"}:
            yield " "
        elif token.type == "code_inline":
            yield CODE
        elif token.type == "text":
            yield token.content


def _of_module(source: str) -> Iterator[tuple[int, str, str]]:
    tree = ast.parse(source)
    docstrings = [
        node.value for node in ast.walk(tree) if isinstance(node, ast.Expr) and _is_text(node.value)
    ]
    for node in docstrings:
        yield from _paragraphs(node.lineno, "docstring", str(node.value))
    yield from _comments(source)
    yield from _messages(tree, {id(node) for node in docstrings})


def _messages(tree: ast.Module, docstrings: set[int]) -> Iterator[tuple[int, str, str]]:
    """Strings of some words that are no docstrings; what is put in when they are formatted is code."""
    formatted = [node for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)]
    seen = docstrings | {id(part) for node in formatted for part in node.values} | _examples(tree)
    for node in formatted:
        parts = (str(part.value) if isinstance(part, ast.Constant) else CODE for part in node.values)
        if not _PROGRAM.search(words := "".join(parts)):
            yield node.lineno, "message", words
    for node in ast.walk(tree):
        if _is_text(node) and id(node) not in seen and not _PROGRAM.search(node.value):
            yield from _paragraphs(node.lineno, "message", node.value)


def _examples(tree: ast.Module) -> set[int]:
    """Examples of messages: a value is put in there, and where they are made they are judged without it."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    keywords = [one for call in calls if ast.unparse(call.func) == "Code" for one in call.keywords]
    return {id(one.value) for one in keywords if one.arg == "example"}


def _is_text(node: ast.AST) -> TypeGuard[ast.Constant]:
    """Whether a node is a string of three words or more."""
    return isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.count(" ") > 1


def _paragraphs(line: int, kind: str, text: str) -> Iterator[tuple[int, str, str]]:
    """The paragraphs and list items of a text."""
    first, words = line, ""
    for number, row in enumerate([*text.splitlines(), ""], line):
        if words and (_BLANK.match(row) or _ITEM.match(row)):
            yield first, kind, words
            words = ""
        if not words:
            first = number
        words = f"{words} {row.strip()}".strip()


def _comments(source: str) -> Iterator[tuple[int, str, str]]:
    """Comments, those of adjacent lines as one."""
    first, last, words = 0, 0, ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT:
            continue
        line, body = token.start[0], _DIRECTIVE.sub("", token.string).lstrip("# ")
        is_alone = token.line.lstrip().startswith("#")
        if words and is_alone and line == last + 1:
            words, last = f"{words} {body}", line
            continue
        if words:
            yield first, "comment", words
        first, last, words = line, line if is_alone else 0, body
    if words:
        yield first, "comment", words


def _of_toml(text: str) -> Iterator[tuple[int, str, str]]:
    """Comments; what is indented in them are commands."""
    first, words = 0, ""
    for number, row in enumerate([*text.splitlines(), ""], 1):
        if _TOML_COMMENT.match(row):
            first, words = (first or number), f"{words} {row.lstrip('# ')}"
            continue
        if words:
            yield first, "comment", words
        first, words = 0, ""
        if match := _TOML_REMARK.search(row):
            yield number, "comment", match[1]


_ENTRY = re.compile(r"\S.*?\S  +\S")
"""A line of a list whose second column is aligned, as in the Makefile."""


def _of_lines(text: str, mark: str) -> Iterator[tuple[int, str, str]]:
    """Comments, those of adjacent lines as one; an empty one, or a command that is indented in it, ends it.

    Args:
        text: of the file.
        mark: what a comment begins with.
    """
    comment = re.compile(rf"\s*{mark} ?(?=\S)(.*)")
    remark = re.compile(rf"\s*\S.*?\s{mark} (.+)") if mark == "--" else None
    first, words = 0, ""
    for number, row in enumerate([*text.splitlines(), ""], 1):
        match = comment.match(row)
        if match and not row.startswith("#!"):
            if words and (_ITEM.match(match[1]) or _ENTRY.match(match[1])):
                yield first, "comment", words
                first, words = 0, ""
            first, words = (first or number), f"{words} {match[1]}"
            continue
        if words:
            yield first, "comment", words
        first, words = 0, ""
        if remark is not None and (found := remark.match(row)):
            yield number, "comment", found[1]


_SCRIPT = re.compile(
    r"""/\*(?P<block>.*?)\*/|(?<![:\w\\])//(?P<line>[^\n]*)"""
    r"""|(?P<quote>["'])(?P<text>(?:\\.|(?!(?P=quote))[^\\\n])*)(?P=quote)|`(?P<template>(?:\\.|[^`\\])*)`""",
    re.DOTALL,
)
_PUT_IN = re.compile(r"\$\{[^{}]*\}")


def _of_script(text: str) -> Iterator[tuple[int, str, str]]:
    """Comments and strings of some words; of a string, what is put in is code."""
    for match in _SCRIPT.finditer(text):
        line = text.count("\n", 0, match.start()) + 1
        comment = match["block"] if match["block"] is not None else match["line"]
        if comment is not None:
            yield line, "comment", comment.strip("* /")
        elif (words := _PUT_IN.sub(CODE, match["text"] or match["template"] or "")).count(" ") > 1:
            yield line, "message", words


_JINJA = re.compile(r"\{\{.*?\}\}|\{%.*?%\}", re.DOTALL)
_JINJA_COMMENT = re.compile(r"\{#-?(.*?)-?#\}", re.DOTALL)
_INLINE = frozenset(("a", "abbr", "b", "code", "em", "i", "small", "span", "strong", "time"))
_SHOWN = ("title", "placeholder", "aria-label", "alt")
"""Attributes that people see or hear."""


class _Template(HTMLParser):
    """The texts of a page, one for each element that is no part of a sentence."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[int, str, str]] = []
        self._line, self._words = 0, ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        line = self.getpos()[0]
        self.found += [(line, "message", value) for name, value in attrs if name in _SHOWN and value]
        if tag == "code":
            self._words += " ``"
        elif tag not in _INLINE:
            self.end()

    def handle_endtag(self, tag: str) -> None:
        if tag == "code":
            self._words += "`` "
        elif tag not in _INLINE:
            self.end()

    def handle_data(self, data: str) -> None:
        if not self._words.strip():
            self._line = self.getpos()[0] + data[: len(data) - len(data.lstrip())].count("\n")
        self._words += data

    def handle_comment(self, data: str) -> None:
        self.found.append((self.getpos()[0], "comment", data))

    def end(self) -> None:
        """What has come is a text by itself."""
        if self._words.strip():
            self.found.append((self._line, "message", self._words))
        self._words = ""


def _of_template(text: str) -> Iterator[tuple[int, str, str]]:
    """What people read of a template of a page, and its comments; what is put in is code."""
    for match in _JINJA_COMMENT.finditer(text):
        yield text.count("\n", 0, match.start()) + 1, "comment", match[1]

    def lines(match: re.Match[str]) -> str:
        # Statements leave nothing but their lines, so that texts are found where they are.
        return (CODE if match[0].startswith("{{") else "") + "\n" * match[0].count("\n")

    template = _Template()
    template.feed(_JINJA.sub(lines, _JINJA_COMMENT.sub(lines, text)))
    template.close()
    template.end()
    yield from template.found
