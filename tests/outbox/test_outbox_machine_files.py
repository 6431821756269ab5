"""Two machine files of the same names: the second does not take the store of the first by mistake."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from support.machine_files import LAVAL

from daqsvc.alarms.events import Identity
from daqsvc.cli import main
from daqsvc.outbox.machine_files import FILE, StoreOfAnotherFileError, note_files, noted_files, take_store

if TYPE_CHECKING:
    from pathlib import Path

RIG = Identity("lab", "edge-1", "laval-rig")
TEXT = LAVAL.read_text().partition("[store]")[0]


@pytest.fixture
def first(tmp_path: Path) -> Path:
    """A machine file whose store is noted to be its own."""
    file = tmp_path / "first.toml"
    file.write_text(TEXT)
    (tmp_path / "store").mkdir(mode=0o700)
    note_files(tmp_path / "store", {"laval-rig": file})
    return file


@pytest.fixture
def second(tmp_path: Path) -> Path:
    """A copy of it, in another folder."""
    file = tmp_path / "elsewhere" / "second.toml"
    file.parent.mkdir()
    file.write_text(TEXT)
    return file


def test_a_copy_with_the_same_names_is_refused_with_both_remedies(first: Path, second: Path) -> None:
    store = first.parent / "store"
    with pytest.raises(StoreOfAnotherFileError) as refused:
        take_store(store, {RIG: second}, on_purpose=False)
    said = f"{refused.value}"
    assert said.startswith(f"the store {store} is that of {first}: {second} has the same site 'lab', box")
    assert f"write another name = ... in [machine] of {second}" in said
    assert said.endswith(f"daqsvc run {second} --store {store} [S02]")


def test_who_names_the_store_takes_it_over_and_the_log_says_so(
    first: Path, second: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = first.parent / "store"
    take_store(store, {RIG: second}, on_purpose=True)
    assert caplog.messages == [f"the store {store} was that of {first}; now it is that of {second}"]
    note_files(store, {"laval-rig": second})
    caplog.clear()
    take_store(store, {RIG: second}, on_purpose=False)
    assert not caplog.messages


def test_a_file_that_was_moved_is_the_same_machine(
    first: Path, second: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first.unlink()
    take_store(first.parent / "store", {RIG: second}, on_purpose=False)
    assert f"was that of {first}; now it is that of {second}" in caplog.text


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_another_name_of_the_same_file_is_the_same_file(
    link: object, first: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert callable(link)
    link(first, first.with_name("current.toml"))
    take_store(first.parent / "store", {RIG: first.with_name("current.toml")}, on_purpose=False)
    assert not caplog.messages


def test_a_first_file_that_has_another_name_by_now_has_another_store(first: Path, second: Path) -> None:
    first.write_text(TEXT.replace('name = "laval-rig"', 'name = "old-rig"'))
    take_store(first.parent / "store", {RIG: second}, on_purpose=False)


def test_a_first_file_that_somebody_is_editing_is_still_there(first: Path, second: Path) -> None:
    first.write_text("[machine")
    with pytest.raises(StoreOfAnotherFileError):
        take_store(first.parent / "store", {RIG: second}, on_purpose=False)


@pytest.mark.parametrize("spoilt", [b"", b"[]", b"\xff\x00", b'{"laval-rig": 1}', None])
def test_a_store_of_which_nothing_is_known_is_anybodys(
    spoilt: bytes | None, first: Path, second: Path
) -> None:
    note = first.parent / "store" / FILE
    note.unlink()
    if spoilt is not None:
        note.write_bytes(spoilt)
    assert noted_files(note.parent) == {}
    take_store(note.parent, {RIG: second}, on_purpose=False)


def test_other_machines_of_the_box_do_not_matter(first: Path, second: Path) -> None:
    take_store(first.parent / "store", {Identity("lab", "edge-1", "pump"): second}, on_purpose=False)


def test_a_disk_that_takes_no_note_is_no_fault(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    note_files(tmp_path / "none", {"laval-rig": tmp_path / "rig.toml"})
    assert "is not written" in caplog.text


@pytest.mark.long
def test_run_refuses_check_and_new_warn_and_the_note_is_made_by_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", f"{tmp_path}/state")
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.chdir(tmp_path)
    answers = ["--yes", "--socket", f"{tmp_path}/bus"]
    assert main(["new", "a.toml", *answers]) == 0
    assert "has the same site" not in capsys.readouterr().out
    watching = subprocess.Popen(
        [sys.executable, "-m", "daqsvc", "run", "a.toml"], stderr=subprocess.PIPE, text=True
    )
    assert watching.stderr is not None
    try:
        assert any("alarm sensor-ok/" in line for line in watching.stderr), "the note is made before"
    finally:
        watching.terminate()
        watching.communicate()
    [store] = (tmp_path / "state" / "daqsvc").iterdir()
    assert [*noted_files(store).values()] == [tmp_path / "a.toml"]
    assert main(["new", "b.toml", *answers]) == 0
    said = f"the store {store} is that of {tmp_path}/a.toml: b.toml has the same site"
    assert said in capsys.readouterr().out
    assert main(["check", "b.toml"]) == 0
    assert said in " ".join(capsys.readouterr().out.split())
    ended = subprocess.run(
        [sys.executable, "-m", "daqsvc", "run", "b.toml"], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 2
    assert said in ended.stderr
    assert len(ended.stderr.splitlines()) == 1, "before anything is compiled or opened"
