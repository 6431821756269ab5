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
    """All prose of a page, a module or a TOML file."""
    readers = {".md": _of_page, ".py": _of_module, ".toml": _of_toml}
    is_record = file.name == "CHANGELOG.md"
    for line, found, words in readers[file.suffix](file.read_text("utf-8")):
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
