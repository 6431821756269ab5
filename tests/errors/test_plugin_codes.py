"""Codes of packages that add to daqsvc: their own letters, given like those of daqsvc, and explained."""

from __future__ import annotations

import importlib
import logging
import re
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING

import pytest
from support.example_packages import DRIVER, MESSAGE_CODES, installed

from daqsvc import api
from daqsvc.cli import main
from daqsvc.commands import plugged
from daqsvc.errors.table import CODES

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

ODD = api.PluginCode("ACME01", "It is odd", "Nobody knows why it is so.", "Look at it again some day.", "")
ALIEN = api.PluginCode("OTHER01", "It is of others", "It has other letters.", "Write one's own.", "")


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    driver = installed(DRIVER, tmp_path / "driver", monkeypatch)
    codes = installed(MESSAGE_CODES, tmp_path / "codes", monkeypatch)
    for one in (driver, codes):
        next(one)
    yield
    for one in (codes, driver):
        next(one, None)


def register(monkeypatch: pytest.MonkeyPatch, **modules: str) -> None:
    points = [EntryPoint(letters.strip("_"), module, plugged.CODES) for letters, module in modules.items()]
    monkeypatch.setattr(plugged, "entry_points", lambda group: points if group == plugged.CODES else [])


@pytest.mark.usefixtures("example")
def test_a_plugin_gives_a_code_of_its_own_which_explain_knows(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    codes, plugin = (importlib.import_module(name) for name in ("tcp_frames_codes", "tcp_frames"))

    def checks(*_: object) -> Iterator[Iterator[api.Finding]]:
        code = codes.SEVERAL_STREAMS
        yield iter([api.Finding(("buses", "logger"), "has several streams", "give it one", code=code)])

    monkeypatch.setattr(plugin.LoggerPlugin, "checks", checks)
    assert main(["check", f"{DRIVER / 'machine.toml'}"]) == 2
    assert capsys.readouterr().err.endswith("has several streams. Remedy: give it one [TCPF01]\n")
    assert main(["explain", "tcpf01"]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert told.startswith("TCPF01 A logger has several streams Cause: A logger sends one stream, ")
    assert told.endswith("More: https://example.com/tcp-frames"), "not the pages of daqsvc"
    assert main(["explain"]) == 0
    assert "\n\nTCPF\n  TCPF01  A logger has several streams\n" in capsys.readouterr().out


@pytest.mark.parametrize("unfit", ["F99", "F100", "acme01", "ACME1", "ACME001", "ACMEACMEA01", "", "AC-ME01"])
def test_no_code_of_a_plugin_looks_like_one_of_daqsvc(unfit: str) -> None:
    with pytest.raises(ValueError, match=f"^{unfit!r} is no code of a plugin; write two to eight capital"):
        api.PluginCode(unfit, "t", "c", "r", "")


def test_no_code_of_daqsvc_has_two_letters() -> None:
    assert all(re.fullmatch("[A-Z][0-9]{2}", code) for code in CODES)


def test_a_line_of_the_log_has_the_code_of_a_plugin(caplog: pytest.LogCaptureFixture) -> None:
    logging.getLogger("acme").warning("it is odd", extra=api.coded(ODD))
    [record] = caplog.records
    assert record.__dict__["code"] is ODD


def test_an_error_of_assembly_ends_with_the_code_of_a_plugin() -> None:
    assert f"{api.AssemblyError('it is odd', code=ODD)}" == "it is odd [ACME01]"


def test_letters_of_two_packages_are_left_out_and_explain_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    register(monkeypatch, ACME=__name__, ACME_="support.paths")
    assert main(["explain", "ACME01"]) == 2
    first, second, unknown = capsys.readouterr().err.splitlines()
    assert first == (
        "daqsvc: group of codes ACME is left out: two packages have these letters, one of them "
        f"{__name__} [C26]"
    )
    assert "one of them support.paths [C26]" in second
    assert unknown.endswith("there is no code 'ACME01'; daqsvc explain lists them [C14]")


@pytest.mark.parametrize(
    ("module", "why"),
    [
        (__name__, "OTHER01 has other letters than its entry point"),
        ("no_such_module", "No module named 'no_such_module'"),
    ],
)
def test_codes_that_cannot_be_taken_are_left_out_and_all_others_explained(
    module: str, why: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    register(monkeypatch, ACME=module)
    assert main(["explain"]) == 0
    out, err = capsys.readouterr()
    assert err == f"daqsvc: group of codes ACME is left out: {why} [C26]\n"
    assert "F05" in out
