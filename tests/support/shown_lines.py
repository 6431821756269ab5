"""The `daqsvc` lines that the pages show, each with what is shown as its output."""

from __future__ import annotations

import re
import shlex
from typing import TYPE_CHECKING, NamedTuple

from support.paths import ROOT
from support.snippets import documented, simple

if TYPE_CHECKING:
    from collections.abc import Iterator


class Shown(NamedTuple):
    """A line that a page shows, and what is below it.

    Attributes:
        page: the page, from the root of the repository.
        words: the command, without ``daqsvc``.
        output: what is shown as its output; None if nothing is.
    """

    page: str
    words: list[str]
    output: str | None

    @property
    def line(self) -> str:
        """As it is typed."""
        return shlex.join(["daqsvc", *self.words])


def shown_lines() -> list[Shown]:
    """All lines, in the order of the pages."""
    return list(_lines())


def _lines() -> Iterator[Shown]:
    blocks = documented()
    for number, block in enumerate(blocks):
        page = f"{block.page.relative_to(ROOT)}"
        if page == "docs/reference/verbs.md" or block.language not in {"sh", ""}:
            continue
        if block.language == "sh":
            below = blocks[number + 1] if number + 1 < len(blocks) else block
            is_output = below.page == block.page and below.language == "" and not below.commands
            for place, command in enumerate(block.commands):
                follows = is_output and place == 0 and below.line - block.line < 14
                yield from _ours(page, command, below.text if follows else None)
        elif block.text.startswith("daqsvc "):
            yield from _ours(page, block.text.strip(), None)
        else:
            for part in re.split(r"(?m)^\$ ", block.text)[1:]:
                command, _, output = part.partition("\n")
                yield from _ours(page, re.sub(r"\s+#\s.*", "", command), output)


def _ours(page: str, command: str, output: str | None) -> Iterator[Shown]:
    for one in simple(command):
        rest = one[1:] if one[0] == "sudo" else one
        if rest[0].rpartition("/")[2] == "daqsvc":
            yield Shown(page, rest[1:], output)
