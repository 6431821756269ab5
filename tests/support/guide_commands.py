"""The commands that a guide in ``docs/`` gives, word for word."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

_BLOCK = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_REMARK = re.compile(r"\s+#\s.*$", re.MULTILINE)


def shell_blocks(guide: str, folder: Path = ROOT / "docs") -> dict[str, list[list[str]]]:
    """By heading, its blocks of shell commands, a list each: without what is said behind ``#``."""
    blocks: dict[str, list[list[str]]] = {}
    for section in re.split(r"^(?=##? )", (folder / guide).read_text("utf-8"), flags=re.MULTILINE):
        heading = section.partition("\n")[0].lstrip("# ")
        for block in _BLOCK.findall(section):
            text = _REMARK.sub("", block).replace("\\\n", "")
            lines = [line.strip() for line in text.splitlines()]
            blocks.setdefault(heading, []).append([line for line in lines if line])
    return blocks
