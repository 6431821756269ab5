"""Buses of ``daqsvc new`` that other packages bring: the example of docs/write-a-driver.md."""

from __future__ import annotations

import importlib
import sys
from types import FunctionType
from typing import TYPE_CHECKING

import pytest
from support.example_packages import DOCS, DRIVER, installed

from daqsvc.cli import main
from daqsvc.commands.new.buses import buses
from daqsvc.settings import load_machine_file

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.integration
QUESTIONS = DOCS / "example_questions" / "tcp_questions.py"


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The example of a driver, and beside it that of its questions."""
    site = tmp_path / "questions"
    info = site / "tcp_questions-1.0.dist-info"
    info.mkdir(parents=True)
    (site / QUESTIONS.name).write_text(QUESTIONS.read_text("utf-8"), encoding="utf-8")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tcp-questions\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[daqsvc.questions]\ntcp-frames = tcp_questions:LoggerQuestions\nbroken = tcp_questions:absent\n"
    )
    monkeypatch.syspath_prepend(f"{site}")
    monkeypatch.delitem(sys.modules, "tcp_questions", raising=False)
    importlib.invalidate_caches()
    buses.cache_clear()
    yield from installed(DRIVER, tmp_path / "site", monkeypatch)
    buses.cache_clear()


def test_a_bus_of_another_package_is_like_ours(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "fan.toml"
    options = ["--bus", "tcp-frames", "--logger", "192.0.2.7", "--channels", "de, nde", "--scale", "0.002"]
    assert main(["new", f"{file}", "--yes", *options]) == 0
    said = capsys.readouterr()
    assert "daqsvc: bus broken is left out: module 'tcp_questions' has no attribute 'absent'" in said.err
    machine = load_machine_file(file)
    assert machine.warnings == ()
    assert machine.buses["main"].summary == "driver tcp-frames, host 192.0.2.7, tcp_port 4001"
    stream = machine.streams["device"]
    assert (stream.rate_hz, stream.layout.frame_bytes) == (1000.0, 124)  # type: ignore[attr-defined]
    assert [channel.scale for channel in stream.layout.channels] == [0.002, 0.002]  # type: ignore[attr-defined]
    assert [sensor.type for sensor in machine.sensors] == ["accelerometer", "accelerometer"]


def test_its_questions_are_options_too(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["new", "--help"])
    assert "--logger-port ANSWER" in capsys.readouterr().out
    assert main(["new", "--yes", "--bus", "tcp-frame"]) == 2
    assert "give --logger" in capsys.readouterr().err


def test_questions_of_another_package_that_fail_are_named_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def tables(_: object, answers: dict[str, object]) -> object:
        return answers["nothing"]

    theirs = vars(importlib.import_module("tcp_questions"))
    monkeypatch.setattr(theirs["LoggerQuestions"], "tables", FunctionType(tables.__code__, theirs))
    file = tmp_path / "fan.toml"
    assert main(["new", f"{file}", "--yes", "--bus", "tcp-frames", "--logger", "192.0.2.7"]) == 1
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("daqsvc new: nothing was written: ")
    assert " of tcp_questions has failed: KeyError: 'nothing' (" in said
    assert said.endswith("have the authors of tcp-questions 1.0 fix it [F23]")
    assert not file.exists()


def test_the_documentation_shows_the_example_as_it_is() -> None:
    assert QUESTIONS.read_text("utf-8").strip() in (DOCS / "write-a-driver.md").read_text("utf-8")
