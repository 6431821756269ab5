"""Gathers `contradictions.json` from the unit tests of the settings: ``PYTHONPATH=tests python -m
guard.gather``.

Every machine file that a test reads is written down as edits of the example or specimen that it comes nearest
to. Of those with the same messages one is kept. Gather anew only together with `make guard ARGS=--take`, and
never in a change of the code that the guard watches over.
"""

from __future__ import annotations

import difflib
import json
import re
import sys
import tempfile
from typing import TYPE_CHECKING, Any

import pytest
from guard.broken import CONTRADICTIONS
from guard.verbs import ROOT, SPECIMENS, answer, workplace

from daqsvc.settings import load

if TYPE_CHECKING:
    from pathlib import Path

TESTS = sorted((ROOT / "tests").rglob("test_*settings*.py"))
_MOST_CHANGED = 0.4
"""Share of its lines in which a file may differ from an example to be told by edits of it."""


class Listener:
    """Notes the machine files that are read while tests run."""

    def __init__(self) -> None:
        self.texts: dict[str, str] = {}
        self._test = ""

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Called by pytest before each test."""
        self._test = item.name

    def listen(self) -> None:
        """Note from now on what `parse_machine_file` is given."""
        original = load.parse_machine_file

        def parse(text: str, path: Path) -> Any:
            self.texts.setdefault(text, self._test)
            return original(text, path)

        load.parse_machine_file = parse
        sys.modules["daqsvc.settings"].parse_machine_file = parse  # type: ignore[attr-defined]


def edits(text: str, example: str) -> list[tuple[str, str]]:
    """What makes ``text`` of ``example``, each an old text, found where it occurs first, and the new one."""
    old, new = example.splitlines(keepends=True), text.splitlines(keepends=True)
    found = []
    shaped = ""
    for tag, a, b, c, d in difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes():
        if tag == "equal":
            shaped += "".join(old[a:b])
            continue
        # Lines before and after, until the place is the first one of its kind in the text as it is by now.
        first, last, kept = a, b, c
        rest = shaped + "".join(old[a:])
        while first > 0 and (
            first == last or rest.find("".join(old[first:last])) != len("".join(new[:kept]))
        ):
            if old[first - 1] != new[kept - 1]:
                break
            first, kept = first - 1, kept - 1
        found.append(("".join(old[first:last]), "".join(new[kept:d])))
        shaped += "".join(new[c:d])
    return found


def remade(example: str, changes: list[tuple[str, str]]) -> str:
    """As `guard.broken.contradictions` does it."""
    for old, new in changes:
        example = example.replace(old, new, 1)
    return example


def main() -> int:
    """Write the file."""
    examples = {
        path.name: path.read_text(encoding="utf-8") for path in (ROOT / "config/machines").glob("*.toml")
    }
    examples |= {path.name: path.read_text(encoding="utf-8") for path in SPECIMENS.glob("*.toml")}
    listener = Listener()
    listener.listen()
    pytest.main(["-q", "-p", "no:cacheprovider", "-p", "no:xdist", *map(str, TESTS)], plugins=[listener])
    cases, known = [], set[frozenset[str]]()
    seen: set[str] = set()
    with workplace() as folder:
        for text, test in sorted(listener.texts.items(), key=lambda one: (one[1], one[0])):
            # Those of a test's own folder, or too large to be looked at.
            if tempfile.gettempdir() in text or "pytest" in text or len(text) > 20_000:
                continue
            machine = max(
                sorted(examples),
                key=lambda name: difflib.SequenceMatcher(
                    None, examples[name].splitlines(), text.splitlines(), autojunk=False
                ).quick_ratio(),
            )
            changes = edits(text, examples[machine])
            if remade(examples[machine], changes) != text or sum(len(o) + len(n) for o, n in changes) > 1500:
                continue
            (folder / "machines" / machine).write_text(text, encoding="utf-8")
            told = answer("check", f"machines/{machine}")
            (folder / "machines" / machine).write_text(examples[machine], encoding="utf-8")
            if told.code == 0:
                continue
            messages = {
                re.sub(r'"[^"]*"|-?\d[\d.,e+-]*', "#", line.partition(": ")[2].partition(": ")[2] or line)
                for line in told.err.splitlines()
                if line
            }
            if not messages <= seen and frozenset(messages) not in known:
                seen |= messages
                known.add(frozenset(messages))
                cases.append({"name": test, "machine": machine, "edits": changes})
    CONTRADICTIONS.write_text(json.dumps(cases, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    print(f"{len(listener.texts)} files were read, {len(cases)} are kept, {len(seen)} messages")  # noqa: T201
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
