"""The tutorials, followed word for word: a text that is no longer true fails here."""

from __future__ import annotations

import re
import shutil
import tempfile
import tomllib
from pathlib import Path

import pytest
from support.brokers import mosquitto_program
from support.machine_files import MACHINES
from support.paths import ROOT
from support.snippets import completed
from tutorials.reader import (
    NOT_HERE,
    NotAsShownError,
    Reader,
    Step,
    UnreadBlockError,
    is_introduced,
    is_passed_over,
    steps,
)

from daqsvc.settings.load import machine_file_of

pytestmark = pytest.mark.integration
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("[0-9]*.md"))
EVERYDAY = {"01-first-machine.md"}


@pytest.fixture
def reader():
    # Not below pytest's folders: the paths of sockets have to be short.
    folder = Path(tempfile.mkdtemp(prefix="tutorial-"))
    one = Reader(folder)
    yield one
    one.close()
    shutil.rmtree(folder)


def followed(path: Path) -> object:
    return pytest.param(path, id=path.stem, marks=[] if path.name in EVERYDAY else [pytest.mark.long])


def goes_on_from(path: Path) -> list[Path]:
    """The tutorial in whose folder this one goes on, if there is one."""
    text = " ".join(path.read_text(encoding="utf-8").split())
    found = re.findall(r"\]\((\S+\.md)\) and go on in its folder", text)
    return [path.parent / name for name in found]


@pytest.mark.parametrize("path", [followed(path) for path in TUTORIALS])
def test_a_tutorial_is_true_word_for_word(reader: Reader, path: Path) -> None:
    if "mosquitto_sub" in path.read_text(encoding="utf-8"):
        mosquitto_program()
        mosquitto_program("mosquitto_sub", "mosquitto-clients")
    for one in (*goes_on_from(path), path):
        reader.follow(one.read_text(encoding="utf-8"), one.name)


def passed_over() -> list[tuple[str, Step]]:
    """The blocks that the reader passes over, each with its page."""
    every = [(path.name, step) for path in TUTORIALS for step in steps(path.read_text(encoding="utf-8"))]
    return [(page, step) for page, step in every if is_passed_over(page, step)]


def test_few_blocks_are_passed_over_and_a_test_of_each_is_there() -> None:
    assert len(NOT_HERE) <= 2
    assert [page for page, _ in passed_over()] == [page for page, _ in NOT_HERE]
    for why in NOT_HERE.values():
        file, name = re.findall(r"(tests/\S+\.py)::(\w+)", why)[0]
        assert f"\ndef {name}(" in (ROOT / file).read_text("utf-8")


def test_a_part_of_a_machine_file_fits() -> None:
    rig = MACHINES / "virtual-rig.toml"
    [part] = [tomllib.loads(step.text) for _, step in passed_over() if step.language == "toml"]
    machine = tomllib.loads(rig.read_text("utf-8"))
    del machine["mqtt"]
    assert machine_file_of(completed(machine, part), rig).mqtt.url == part["mqtt"]["url"]


def test_each_block_is_one_that_the_reader_knows() -> None:
    """Of the long ones, too: without doing what they state."""
    for path in TUTORIALS:
        for step in steps(path.read_text(encoding="utf-8")):
            known = step.language == "console" or is_introduced(step) or is_passed_over(path.name, step)
            assert known, f"{path.name}:{step.line}"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("In `f` replace\n\n```toml\nold\n```\n", "text:3: nothing says what to do with this block"),
        ("As root:\n\n```sh\nip link set can0 upp\n```\n", "after 'As root:'"),
        ("In `f`, replace\n\n```toml\nold\n```\n", "no block follows with what is put in f"),
        ("In `f`, replace\n\n```\nold\n```\n\nthus\n\n```\nnew\n```\n", 'text:9: "by" and a block'),
        ("- Type:\n\n  ```console\n  $ never\n  ```\n", "line 3: the reader does not read this fence"),
        ("~~~\nnever\n~~~\n", "line 1: the reader does not read this fence"),
    ],
)
def test_a_block_that_nothing_introduces_is_refused(reader: Reader, text: str, words: str) -> None:
    (reader.folder / "f").write_text("old")
    with pytest.raises(UnreadBlockError) as caught:
        reader.follow(text)
    assert words in f"{caught.value}"


def test_lines_that_a_file_has_are_looked_for_there(reader: Reader) -> None:
    (reader.folder / "f").write_text("one\ntwo\n")
    reader.follow("These lines of `f` count:\n\n```text\ntwo\n```\n")
    with pytest.raises(NotAsShownError, match="f has 0 times"):
        reader.follow("These lines of `f` count:\n\n```text\nthree\n```\n")


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_says_how_long_it_takes_and_where_to_go_next(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert "minutes" in text.partition("##")[0]
    assert "## What you have now" in text
    assert "Next: [" in text
    assert any(step.language == "console" for step in steps(text))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("```console\n$ echo one\ntwo\n```", "'two', and there came ['one']"),
        ("```console\n$ printf 'a\\nb\\n'\na\n```", "'nothing more', and there came ['b']"),
        ("```console\n$ true\n...\nnever\n```", "'never', and there came []"),
        ("```console\n$ read -p 'Name: ' a; echo $a\nName: ann\nbob\n```", "'bob', and there came ['ann']"),
        ("In `f`, replace\n\n```toml\nold\n```\n\nby\n\n```toml\nnew\n```", "f has 0 times"),
    ],
)
def test_what_is_not_as_shown_is_found(reader: Reader, text: str, words: str) -> None:
    (reader.folder / "f").write_text("other")
    with pytest.raises(NotAsShownError) as caught:
        reader.follow(text)
    assert words in f"{caught.value}"


def test_a_page_in_a_browser_has_the_words_that_are_shown(reader: Reader) -> None:
    text = (
        "```console\n$ python3 -u -m http.server 8420 --bind 127.0.0.1\nServing HTTP ...\n...\n```\n\n"
        "Open `http://127.0.0.1:8420/` in a browser:\n\n```text\n{words}\n```\n"
    )
    (reader.folder / "index.html").write_text("<p>one &amp; <b>two</b></p>")
    with pytest.raises(NotAsShownError, match="does not show 'three'"):
        reader.follow(text.format(words="one & \nthree"))


def test_what_is_as_shown_is_followed_in_all_terminals(reader: Reader) -> None:
    reader.follow(
        "Save this as `f`:\n\n```text\nold\n```\n\n"
        "In `f`, replace\n\n```text\nold\n```\n\nby\n\n```text\nnew\n```\n"
        "Then:\n\n```console\n$ cat f\nnew\n$ cat\n```\n\nIn a second terminal:\n\n"
        "```console\n$ read -p 'Name: ' a; echo hello $a, $RANDOM times\nName: ann\nhello ann, ... times\n"
        "$ seq 3\n...\n3\n```\n\nIn the first terminal, press Ctrl-C:\n\n```console\n^C\n```\n"
    )


def test_what_looks_is_typed_again_until_it_shows_what_it_must(reader: Reader) -> None:
    program = reader.folder.parent / "bin" / "daqsvc"
    program.write_text("#!/bin/sh\nrm ready 2>/dev/null && echo well || { touch ready; echo not yet; }\n")
    reader.follow("```console\n$ daqsvc status\nwell\n```\n")
    with pytest.raises(NotAsShownError, match="not yet"):
        reader.follow("```console\n$ daqsvc run\nwell\n```\n")
