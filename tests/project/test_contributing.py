"""What CONTRIBUTING.md, the release recipe and the hooks of git name is there."""

from __future__ import annotations

import importlib
import re
import subprocess
from typing import TYPE_CHECKING

import pytest
from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

TEXTS = ("CONTRIBUTING.md", "docs/release.md")
ROOMS = ("daqsvc/", "drivers/", "sim_hw/", "docs/", "tests/")

WHY = "\n\nThe counter of a unit that restarts was taken for a gap.\n"


@pytest.mark.sources
@pytest.mark.parametrize("name", TEXTS)
def test_every_path_that_is_named_is_there(name: str) -> None:
    text = (ROOT / name).read_text("utf-8")
    named = {
        path for path in re.findall(r"`([\w./]+)`", text) if path.startswith(ROOMS) and "KEY" not in path
    }
    named |= {
        str((ROOT / name).parent.relative_to(ROOT) / link) for link in re.findall(r"\]\(([\w./]+)\)", text)
    }
    assert named
    assert [path for path in sorted(named) if not (ROOT / path).exists()] == []


@pytest.mark.parametrize("name", TEXTS)
def test_every_target_of_make_that_is_named_is_there(name: str) -> None:
    text = (ROOT / name).read_text("utf-8")
    targets = set(re.findall(r"(?m)(?:^ *|`)make ([a-z-]+)", text))
    known = set(re.findall(r"(?m)^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8")))
    assert targets
    assert targets <= known


def test_every_name_of_the_code_that_is_named_is_there() -> None:
    named = set(re.findall(r"`((?:daqsvc|drivers)\.[\w.]+\.[A-Z]\w+)`", (ROOT / TEXTS[0]).read_text("utf-8")))
    assert len(named) >= 4
    for name in named:
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute), name


def test_the_hooks_run_what_make_check_runs() -> None:
    hooks = (ROOT / ".pre-commit-config.yaml").read_text("utf-8")
    check = re.search(r"(?m)^check:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text("utf-8"))
    assert check is not None
    for tool in set(re.findall(r"\$\(BIN\)/(\S+)", check[1])):
        assert f".venv/bin/{tool}" in hooks


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        ("Count a restart once" + WHY, ""),
        ("x" * 72 + WHY, ""),
        ("# a comment of git\nCount a restart once" + WHY, ""),
        ("fixup! Count a restart once", ""),
        ("x" * 73 + WHY, "the subject has 73 characters"),
        ("Count a restart once\n", "say why"),
        ("Count a restart once\nwithout an empty line\n", "leave a line empty"),
    ],
)
def test_a_commit_has_a_short_subject_and_says_why(message: str, complaint: str, tmp_path: Path) -> None:
    file = tmp_path / "message"
    file.write_text(message, "utf-8")
    done = subprocess.run([ROOT / ".ci" / "commit-msg", file], check=False, capture_output=True, text=True)
    assert (done.returncode, complaint in done.stderr) == (bool(complaint), True)
    assert bool(done.stderr) == bool(complaint)
