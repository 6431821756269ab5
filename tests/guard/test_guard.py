"""What users see is what the golden texts say; and the guard that holds it so catches a changed word."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from importlib.metadata import entry_points
from pathlib import Path
from typing import get_args

import pytest
from guard.broken import contradictions, covered
from guard.golden import FOLDER, compare
from guard.measure import circles, imports, modules, repeated_classes
from guard.parts import FAST
from guard.recordings import DATA, GROUPS, TAKEN_ON, processor
from guard.verbs import ROOT, SPECIMENS, answer, workplace

import daqsvc.settings  # noqa: F401 - all tables are known
from daqsvc.cli import CheckCommand
from daqsvc.settings.packing import PackedLayout
from daqsvc.settings.section import Section

CONFIG = ROOT / "config" / "machines"
DAILY = {"examples", "schemas"}
"""Parts that take a few seconds only."""


DIGEST = re.compile(r"; [0-9a-f]{64}$")


def guard_run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """The guard in a process of its own, as `make guard` runs it."""
    return subprocess.run(
        [sys.executable, "-m", "guard", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])},
        check=False,
        capture_output=True,
        text=True,
    )


def guard(*arguments: str | Path, code: int = 0) -> str:
    """What the guard prints."""
    done = guard_run(*arguments)
    assert done.returncode == code, f"{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "part", [pytest.param(part, marks=[pytest.mark.long] * (part not in DAILY)) for part in FAST]
)
def test_what_users_see_is_as_before(part):
    guard("--only", part)


@pytest.mark.long
@pytest.mark.first
@pytest.mark.data
@pytest.mark.timeout(1800)
def test_what_is_said_of_every_recording_is_as_before():
    if not DATA.is_dir():
        pytest.skip(f"no recordings at {DATA}; set DAQSVC_DATA to where they are")
    if processor() == TAKEN_ON.read_text(encoding="utf-8").strip():
        guard("--only", *GROUPS)
        return
    # With and without AVX-512 the last digits are others (seen on an AMD EPYC, with the very code that the
    # digests had been taken of); what is said of each recording is not.
    done = guard_run("--only", *GROUPS)
    before, now = (verdicts(done.stdout, mark) for mark in "-+")
    assert before == now, done.stdout
    assert done.returncode == int(bool(now)), f"{done.stdout}\n{done.stderr}"


def verdicts(diff: str, mark: str) -> Counter[str]:
    """The lines that a diff takes away or adds, without digests."""
    lines = (line for line in diff.splitlines() if line.startswith(mark) and line[1:4] not in {"-- ", "++ "})
    return Counter(DIGEST.sub("", line[1:]) for line in lines)


def test_a_changed_verdict_is_seen_whatever_the_digests():
    digest = "; " + "0f" * 32
    assert (
        DIGEST.sub("", f"analyze a, bearing: inner of inner{digest}") == "analyze a, bearing: inner of inner"
    )
    same = f"--- golden/a\n+++ now/a\n-x: inner{digest}\n+x: inner; {'1e' * 32}\n"
    assert verdicts(same, "-") == verdicts(same, "+") != Counter()
    assert verdicts(same.replace("+x: inner", "+x: outer"), "+") != verdicts(same, "-")


@pytest.fixture
def copy(tmp_path):
    return Path(shutil.copytree(FOLDER, tmp_path / "golden"))


@pytest.mark.long
def test_a_changed_key_is_caught_shown_and_taken(copy):
    text = (copy / "schemas.txt").read_text(encoding="utf-8")
    (copy / "schemas.txt").write_text(text.replace('"wall_ns"', '"wall_time_ns"', 1), encoding="utf-8")
    said = guard("--only", "schemas", "--golden", copy, code=1)
    assert "--- golden/schemas.txt" in said
    assert any(line.startswith("-") and '"wall_time_ns"' in line for line in said.splitlines())
    assert any(line.startswith("+") and '"wall_ns"' in line for line in said.splitlines())
    assert "If that is meant: make guard ARGS=--take" in said
    assert "1 of them new or other than before" in guard("--only", "schemas", "--golden", copy, "--take")
    guard("--only", "schemas", "--golden", copy)


def test_a_changed_word_of_the_code_is_caught(monkeypatch):
    def whole(old, new):
        with workplace():
            said = f"{answer('--help')}\n\n{answer('run', '--help')}\n\n{answer('check', '--help')}\n"
        golden = (FOLDER / "help.txt").read_text(encoding="utf-8")
        assert old in golden
        assert new not in golden
        return compare("help.txt", said + golden[len(said) :], FOLDER)

    word, other = (
        "read a machine file and print what was understood",
        "read a machine file and print what it holds",
    )
    assert whole(word, other) == ""
    monkeypatch.setattr(CheckCommand, "help", other)
    diff = whole(word, other)
    assert any(line.startswith("+") and other in line for line in diff.splitlines())
    assert any(line.startswith("-") and word in line for line in diff.splitlines())


def test_a_changed_key_of_a_message_is_caught():
    text = (FOLDER / "messages.txt").read_text(encoding="utf-8")
    diff = compare("messages.txt", text.replace("  cause.severity\n", "  cause.level\n", 1), FOLDER)
    assert "-  cause.severity" in diff
    assert "+  cause.level" in diff


def texts(*folders):
    return {
        path.name: path.read_text(encoding="utf-8") for one in folders for path in sorted(one.glob("*.toml"))
    }


def sections(above=Section):
    for section in above.__subclasses__():
        yield section
        yield from sections(section)


def subtables(known, title):
    """Keys of a table that hold tables with a header of their own."""
    begin = f"{title}." if title else ""
    return {other.removeprefix(begin).split("<")[0] for other in known if other.startswith(begin)}


def is_of_another_test(table):
    """Whether a table is of a plugin that a test has installed."""
    is_table = isinstance(table, type) and issubclass(table, Section)
    return is_table and table.__module__.split(".")[0] not in {"daqsvc", "drivers"}


def test_every_key_of_every_table_is_spoilt():
    for group in ("daqsvc.drivers", "daqsvc.detectors", "daqsvc.outputs"):
        for point in entry_points(group=group):
            point.load()
    known = covered(texts(CONFIG, SPECIMENS))
    left_out = {}
    seen = 0
    for section in sections():
        # One with kinds of its own shows by these; one with an underscore before its name never stands alone.
        if section.__subclasses__() or section.__name__.startswith("_"):
            continue
        if is_of_another_test(section):
            continue
        if section.__module__.startswith("daqsvc.offline."):
            continue  # options of a command, not a table of a machine file
        if section is PackedLayout:
            continue  # of drivers of others, so tests/drivers/test_example_driver.py spoils it
        seen += 1
        held = {
            key
            for key, field in section.model_fields.items()
            if not any(is_of_another_test(table) for table in get_args(field.annotation))
        }
        # A table of another plugin may stand in this one without being a key of its model.
        spoilt = set().union(
            *(keys for title, keys in known.items() if keys - subtables(known, title) <= held and keys & held)
        )
        if missing := held - spoilt:
            left_out[section.__name__] = sorted(missing)
    assert seen > 40
    assert left_out == {}, "add them to a file of tests/guard/specimens, then make guard ARGS=--take"


def test_there_are_as_many_broken_files_as_said():
    cases = [*contradictions(texts(CONFIG, SPECIMENS))]
    assert len(cases) > 200
    assert len({case.text for case in cases}) == len(cases)
    golden = "".join(path.read_text(encoding="utf-8") for path in FOLDER.glob("broken-*.txt"))
    assert golden.count("\nexit code 2") > 800


def test_circles_and_names_that_occur_twice_are_counted():
    trees = modules(
        {
            "a/__init__.py": "",
            "a/one.py": "from a import two\nclass Same: ...\n",
            "a/two.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from a.one import Same\n",
            "a/three.py": "def later():\n    from a import four\nclass Same: ...\n",
            "a/four.py": "from .three import later\n",
        }
    )
    packages = frozenset({"a"})
    assert circles(imports(trees, packages, "run")) == []
    assert circles(imports(trees, packages, "types")) == [["a.one", "a.two"]]
    assert circles(imports(trees, packages, "all")) == [["a.four", "a.three"], ["a.one", "a.two"]]
    assert repeated_classes(trees) == {"Same": ["a.one", "a.three"]}
