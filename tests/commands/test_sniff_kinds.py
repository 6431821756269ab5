"""Kinds of ``daqsvc sniff``, those of other packages too."""

from __future__ import annotations

import importlib
import json
import sys
from typing import TYPE_CHECKING

import pytest

from daqsvc.cli import main

if TYPE_CHECKING:
    from pathlib import Path

SNIFFER = """
from daqsvc.api import Sniffed, Sniffer, SniffError, SniffTable

class ProfibusSniffer(Sniffer):
    help = "listen to PROFIBUS"
    description = "Listen to PROFIBUS."

    def add_arguments(self, parser):
        parser.add_argument("port", metavar="PORT")

    def sniff(self, arguments, stop, tell):
        tell("listening")
        if arguments.port == "odd":
            raise KeyError("odd")
        if arguments.port == "absent":
            raise SniffError("there is no absent. Remedy: plug it in")
        table = SniffTable(("station", "bytes"), [("3", "12"), ("\\x1b[31m14", "7")])
        problem = "nobody is there" if arguments.port == "silent" else ""
        return Sniffed(["2 stations", table], {"stations": [3, 14]}, "[buses.p]", problem)

class Other:
    pass

def broken():
    raise RuntimeError("no licence")
"""


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "profibus_sniff.py").write_text(SNIFFER)
    info = tmp_path / "profibus_sniff-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: profibus-sniff\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[daqsvc.sniffers]\nprofibus = profibus_sniff:ProfibusSniffer\n"
        "other = profibus_sniff:Other\nbroken = profibus_sniff:broken\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "profibus_sniff", raising=False)
    importlib.invalidate_caches()
    return tmp_path


@pytest.mark.usefixtures("package")
def test_a_kind_of_another_package_is_one_like_ours(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sniff", "profibus", "port"]) == 0
    said = capsys.readouterr()
    assert said.out.splitlines()[:5] == ["2 stations", "", "station  bytes", "3        12", "�[31m14  7"]
    assert said.out.endswith("\n\n[buses.p]\n")
    assert "sniff broken is left out: no licence" in said.err
    assert "sniff other is left out: it is not derived from Sniffer of daqsvc.api" in said.err
    assert main(["sniff", "profibus", "port", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "stations": [3, 14],
        "machine_file": "[buses.p]",
        "problem": "",
    }


@pytest.mark.usefixtures("package")
def test_what_is_wrong_goes_to_stderr_and_fails(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sniff", "profibus", "silent"]) == 1
    said = capsys.readouterr()
    assert said.out.startswith("2 stations")
    assert said.err.endswith("daqsvc: nobody is there [C20]\n")
    assert main(["sniff", "profibus", "absent"]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.endswith("daqsvc: there is no absent. Remedy: plug it in [C21]\n")


@pytest.mark.usefixtures("package")
def test_a_kind_of_another_package_that_fails_is_named_in_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["sniff", "profibus", "odd"]) == 1
    assert capsys.readouterr().err.endswith(
        "daqsvc: sniff of profibus_sniff.ProfibusSniffer has failed: KeyError: 'odd' "
        "(profibus_sniff.py, line 14); have the authors of profibus-sniff 1.0 fix it [F23]\n"
    )


def test_without_a_kind_those_there_are_can_be_seen(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["sniff"])
    assert ended.value.code == 2
    assert "KIND" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["sniff", "--help"])
    assert "listen to a CAN bus" in capsys.readouterr().out
