"""``daqsvc explain``: what the code at the end of a message means."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.commands.arguments import EXIT_OK, EXIT_USAGE
from daqsvc.commands.complaint import complain
from daqsvc.commands.plugged import plugged_codes
from daqsvc.documentation import documented_in
from daqsvc.errors.code import PluginCode
from daqsvc.errors.command_line import NOT_KNOWN

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterable, Sequence

    from daqsvc.errors.code import Code

_COLUMNS = 100


class ExplainCommand:
    """``daqsvc explain [CODE ...]``."""

    help = "explain the code at the end of a message, and what to do"
    description = (
        "Print what the code at the end of a message means, what causes it, and what to do, e.g. daqsvc "
        "explain F01. Without a code, list all codes."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument(
            "codes",
            nargs="*",
            metavar="CODE",
            help="code of a message, e.g. F01, or the message with its code (default: list all)",
        )

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        from daqsvc.errors.table import CODES  # noqa: PLC0415 - texts that no other verb needs

        # Of a message that was pasted, the code at its end is meant.
        pasted = _PASTED.findall(" ".join(arguments.codes))
        wanted = [text.strip("[]").upper() for text in arguments.codes]
        if pasted and not all(map(_CODE.fullmatch, wanted)):
            wanted = pasted
        known = dict(CODES)
        if not known.keys() >= {*wanted} or not wanted:
            known |= plugged_codes()
        unknown = [text for text in wanted if text not in known]
        if unknown:
            return complain("daqsvc explain", _unknown(unknown[0], arguments.codes), NOT_KNOWN, EXIT_USAGE)
        print("\n\n".join(_explanation(known[text]) for text in wanted) or _listed(known.values()))  # noqa: T201 - what the verb is for
        return EXIT_OK


_CODE = re.compile(r"[A-Z]+[0-9]{2}")
_PASTED = re.compile(rf"\[({_CODE.pattern})\]")
"""As it is at the end of a message."""


def _unknown(text: str, words: Sequence[str]) -> str:
    """That there is no such code, and where what is none is explained."""
    if _CODE.fullmatch(text):
        return f"there is no code {text!r}; daqsvc explain lists them"
    typed = next(word for word in words if word.strip("[]").upper() == text)
    return (
        f"{typed!r} is no code; it takes the code at the end of a message, e.g. B05, and daqsvc explain "
        f"lists them. For a key of the machine file see {documented_in('reference/keys')}, for a counter "
        f"{documented_in('reference/counters')}; for all else use the search of the documentation"
    )


_SOURCES = Path(__file__).parents[2] / "docs"
_PACKAGE = Path("/usr/share/doc/daqsvc/html")


def _where(code: Code) -> str:
    """Where a page about a code and its subject is on this computer."""
    anchor = f"#{code.id.lower()}"
    if (_SOURCES / "reference" / "errors.md").is_file():
        return f"docs/{code.page}, docs/reference/errors.md{anchor}"
    if (_PACKAGE / "index.html").is_file():
        page = code.page.replace(".md", ".html")
        return f"{_PACKAGE / page}, {_PACKAGE}/reference/errors.html{anchor}; in daqsvc page below /docs/"
    return f"the pages {code.page} and reference/errors.md{anchor} of the documentation"


def _explanation(code: Code) -> str:
    more = _where(code)
    parts = {
        "Example": code.example,
        "Cause": code.cause,
        "Remedy": code.remedy,
        "More": code.page if isinstance(code, PluginCode) else more,
    }
    blocks = [f"{code}  {code.title}"]
    for name, text in ((name, text) for name, text in parts.items() if text):
        lines = textwrap.wrap(text, _COLUMNS, break_long_words=False, break_on_hyphens=False)
        blocks.append("\n".join([f"{name}:", *(f"  {line}" for line in lines)]))
    return "\n".join(blocks)


def _listed(codes: Iterable[Code]) -> str:
    from daqsvc.errors.table import group_title  # noqa: PLC0415 - as above

    groups: dict[str, list[str]] = {}
    for code in codes:
        title = code.letters if isinstance(code, PluginCode) else group_title(code.id[0])
        groups.setdefault(title, []).append(f"  {code}  {code.title}")
    return "\n\n".join("\n".join([title, *lines]) for title, lines in groups.items())
