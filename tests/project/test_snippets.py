"""Every fenced block of the documentation is one that works: each kind is checked in its own way.

``PYTHONPATH=tests python -m support.snippets`` lists them. One that cannot be run says why in a comment
before it, and what tests the same: ``<!-- not run: ...; tests/... -->``. docs/tutorials has tests of its own.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import json
import re
import runpy
import shlex
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jsonschema
import pytest
from support.bearing_signals import healthy
from support.machine_files import MACHINES
from support.page_folder import SHARED_BUS, fill
from support.paths import ROOT
from support.sim_processes import process
from support.snippets import Snippet, completed, documented, simple

from daqsvc.cli import _chosen, commands, main, parser
from daqsvc.settings import MachineFileError
from daqsvc.settings.load import machine_file_of

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.integration
ALL = documented()
EXAMPLES = {path.read_text("utf-8").strip() for path in (ROOT / "docs").glob("example_*/*") if path.is_file()}
"""Files that pages show; their own tests install and run them."""
TESTED = {
    ("docs/alarms.md", "toml"): "tests/alarms/test_alarm_documented.py",
    ("docs/can.md", "toml"): "tests/drivers/test_bus_pages.py",
    ("docs/comparison.md", "toml"): "tests/project/test_comparison.py",
    ("docs/detectors.md", "toml"): "tests/detectors/test_example_detector.py",
    ("docs/modbus.md", "toml"): "tests/drivers/modbus/test_modbus_documented.py",
    ("docs/outputs.md", "toml"): "tests/publish/test_example_output.py",
    ("docs/replay.md", "toml"): "tests/drivers/test_bus_pages.py",
}
"""Pages whose parts need others around them: the tests that put these together."""
REMARKS = {"", "text", "{include}"}
"""What a terminal shows, of which the commands are checked; and what only the site reads."""
ELSEWHERE = {"sql", "yaml"}
"""Languages of other programs."""
PROGRAMS = {
    *("daqsvc", "make", "pip", "python", "python3", "python3.11", "git"),
    *("apt", "apt-get", "systemctl", "systemd-sysusers", "ip", "candump", "mosquitto_sub", "psql", "dask"),
    *(".", "cd", "cp", "install", "mkdir", "rm", "sed", "sha256sum"),
}
"""Else it is no command but what one has answered."""
MAKEFILE = (ROOT / "Makefile").read_text("utf-8")


def of(*languages: str) -> Any:
    found = [one for one in ALL if one.language in languages]
    return pytest.mark.parametrize("snippet", found, ids=lambda one: one.name)


def objects(text: str) -> Iterator[str]:
    """The objects of JSON that stand one after the other."""
    decoder, at = json.JSONDecoder(), 0
    text = text.strip()
    while at < len(text):
        _, end = decoder.raw_decode(text, at)
        yield text[at:end]
        at = end + len(text[end:]) - len(text[end:].lstrip())


def test_every_language_is_checked_in_some_way() -> None:
    assert {one.language for one in ALL} <= {"sh", "toml", "python", "json"} | REMARKS | ELSEWHERE


def test_few_blocks_are_not_run_and_each_says_why_and_what_tests_the_same() -> None:
    left_out = {one.name: re.search(r"; (tests/\S+\.py) ", one.why_not_run) for one in ALL if one.why_not_run}
    assert len(left_out) <= 1, [*left_out]
    for name, test in left_out.items():
        assert test is not None, name
        assert (ROOT / test[1]).is_file(), name


@pytest.mark.parametrize(("page", "language"), TESTED)
def test_the_test_of_a_page_reads_it(page: str, language: str) -> None:
    assert [one for one in ALL if one.name.startswith(f"{page}:") and one.language == language]
    assert Path(page).name in (ROOT / TESTED[page, language]).read_text("utf-8")


@functools.cache
def machines() -> dict[Path, dict[str, Any]]:
    """The examples, the paper's rig first."""
    files = sorted(MACHINES.glob("*.toml"), key=lambda file: (file.stem != "laval-rig", file.stem))
    return {file: tomllib.loads(file.read_text("utf-8")) for file in files}


@of("toml")
def test_a_part_of_a_machine_file_fits_an_example(snippet: Snippet) -> None:
    part = tomllib.loads(snippet.text)
    page = f"{snippet.page.relative_to(ROOT)}"
    if (page, "toml") in TESTED or snippet.text.strip() in EXAMPLES:
        return
    why = []
    for file, machine in machines().items():
        try:
            machine_file_of(part if "machine" in part else completed(machine, part), file)
        except MachineFileError as error:
            why.append(f"{error}")
        else:
            return
    pytest.fail("\n".join([f"{snippet.name} fits no example:", *why[:1]]))


@of("json")
def test_json_is_what_its_schema_says(snippet: Snippet) -> None:
    for text in objects(snippet.text):
        told = json.loads(text)
        schema = ROOT / "docs" / "schemas" / f"{told.get('schema', '').replace('/', '-')}.json"
        if schema.is_file():
            jsonschema.validate(told, json.loads(schema.read_text("utf-8")))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings and machine files under the names that the pages give them."""
    made = tmp_path_factory.mktemp("snippets")
    fill(made)
    with contextlib.chdir(made):
        assert main(["analyze", "archive", "--cluster", "local:1"]) == 0  # as docs/fleet.md has done
    return made


@of("python")
def test_python_is_whole(snippet: Snippet) -> None:
    ast.parse(snippet.text)


@pytest.mark.long
@pytest.mark.parametrize(
    "snippet",
    [one for one in ALL if one.language == "python" and not one.why_not_run],
    ids=lambda one: one.name,
)
def test_python_runs(
    snippet: Snippet, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    text = snippet.text.replace(SHARED_BUS, f"{folder}/can0")
    file = folder / "snippet.py"
    file.write_text(text)
    with contextlib.ExitStack() as running:
        if text != snippet.text:
            sim = running.enter_context(process("sim", "machine.toml", "--scenario", "healthy"))
            assert sim.stderr is not None
            assert "playing" in sim.stderr.readline()
        # What the text of a page says that there is.
        runpy.run_path(f"{file}", init_globals={"samples": healthy(10.0, 2, rate_hz=25_600.0)})
    out = capsys.readouterr().out
    assert out != "None\n", "no frame has come"
    if snippet.page.name == "fleet.md":
        assert out == "[('pump-1', 4)] 10\n"


def shown(language: str) -> Iterator[tuple[str, list[str]]]:
    for snippet in ALL:
        for command in snippet.commands if snippet.language == language else ():
            for words in simple(command):
                yield snippet.name, words[1:] if words[0] == "sudo" else words


SHOWN = [*shown("sh"), *shown("")]
OURS = [(name, words[1:]) for name, words in SHOWN if words[0].rpartition("/")[2] == "daqsvc"]


def chosen(words: list[str]) -> list[str]:
    """The arguments, without brackets around what may be left out and without what goes into a file."""
    words = words[: words.index(">")] if ">" in words else words
    return [word.strip("[]") for word in words]


@pytest.mark.parametrize(("name", "words"), OURS, ids=[f"{name} {shlex.join(words)}" for name, words in OURS])
def test_a_verb_and_its_options_are_there(
    name: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with contextlib.suppress(SystemExit):  # what has no verb, as --version
        _chosen(parser(commands()), chosen(words))
    assert capsys.readouterr().err == "", name


def test_every_command_is_of_a_known_program() -> None:
    programs = {(name, words[0].rpartition("/")[2]) for name, words in SHOWN}
    assert sorted((name, program) for name, program in programs if program not in PROGRAMS) == []


def test_targets_of_make_and_files_of_the_repository_are_there() -> None:
    targets = set(re.findall(r"(?m)^([a-z-]+):", MAKEFILE))
    for name, words in SHOWN:
        if words[0] == "make":
            assert {word for word in words[1:] if "=" not in word} <= targets, (name, words)
        # In a value of ARGS, too.
        for path in re.findall(r"(?:^|[ =])((?:config|tests|requirements)[\w./@-]+)", " ".join(words)):
            assert (ROOT / path).exists(), (name, path)
