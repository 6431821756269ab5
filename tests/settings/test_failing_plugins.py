"""A plugin that fails is named with its table, its error and the line; the rest of the check goes on."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Never

import pytest
from pydantic import field_validator
from support.example_packages import DETECTOR, DRIVER, OUTPUT, installed
from support.machine_files import MOTOR, problems_of

from daqsvc.acquisition.clock import SystemClock
from daqsvc.detectors.make import check_files, detectors
from daqsvc.settings import describe, parse_machine_file, registry
from daqsvc.settings.problems import AssemblyError
from drivers.make import bus_drivers

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.integration
MACHINE = DRIVER / "machine.toml"
TABLES = (
    f'{MACHINE.read_text()}\n[pipeline.crest]\nsensor = "casing-x"\n[event_file]\npath = "events.jsonl"\n'
)
HERE = Path(__file__).name


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    sites = [
        installed(example, tmp_path / example.name, monkeypatch) for example in (DRIVER, DETECTOR, OUTPUT)
    ]
    for site in sites:
        next(site)
    yield
    for site in reversed(sites):
        next(site, None)


def break_(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Have ``module.Class.method`` raise, or a property of that name."""

    def failing(*_: Any) -> Never:
        raise KeyError("no such thing")

    module, kind, part = name.split(".")
    owner = getattr(importlib.import_module(module), kind)
    monkeypatch.setattr(owner, part, property(failing) if kind.endswith("Bus") else failing)


@pytest.mark.parametrize(
    ("broken", "table"),
    [
        ("tcp_frames.LoggerPlugin.checks", "buses.logger"),
        ("tcp_frames.LoggerPlugin.stream_checks", "streams.casing"),
        ("tcp_frames.LoggerBus.device", "buses.logger"),
        ("crest.CrestPlugin.checks", "pipeline.crest"),
        ("event_file.EventFilePlugin.checks", "event_file"),
    ],
)
def test_a_check_that_fails_is_one_finding_and_the_others_go_on(
    monkeypatch: pytest.MonkeyPatch, broken: str, table: str
) -> None:
    break_(monkeypatch, broken)
    wrong = TABLES.replace('channel = "x"', 'channel = "z"')
    [first, other] = sorted(problems_of(wrong, MACHINE), key=lambda problem: problem.key != table)
    owner, _, part = broken.rpartition(".")
    assert first.key == table
    assert first.line is not None
    assert f"{part} of {owner} has failed: KeyError: 'no such thing' (" in first.message
    assert first.remedy == f"have the package that brings it mended, or remove [{table}]"
    assert other.key == "sensors[0].channel"


def test_a_check_that_fails_later_is_one_finding_with_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def checks(*_: Any) -> Iterator[Iterator[Any]]:
        yield (1 // zero for zero in [0])

    plugin = importlib.import_module("crest").CrestPlugin
    monkeypatch.setattr(plugin, "checks", checks)
    [problem] = problems_of(TABLES, MACHINE)
    assert "checks of crest.CrestPlugin has failed: ZeroDivisionError" in problem.message
    assert f"({HERE}, line {checks.__code__.co_firstlineno + 1})" in problem.message


@pytest.mark.parametrize(
    ("broken", "said_of"),
    [
        ("tcp_frames.LoggerPlugin.describe_bus", "LoggerPlugin"),
        ("tcp_frames.LoggerBus.summary", "describe_bus of tcp_frames.LoggerPlugin"),
        ("crest.CrestPlugin.describe", "crest.CrestPlugin"),
        ("event_file.EventFilePlugin.describe", "event_file.EventFilePlugin"),
    ],
)
def test_words_that_fail_are_named_in_their_place(
    monkeypatch: pytest.MonkeyPatch, broken: str, said_of: str
) -> None:
    break_(monkeypatch, broken)
    text = " ".join(describe(parse_machine_file(TABLES, MACHINE)).split())
    assert f"{said_of} has failed: KeyError: 'no such thing' (" in text
    assert "128 bytes, 30 x 2 samples, 32 bit count" in text


def test_a_driver_that_cannot_be_made_is_named_with_its_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    break_(monkeypatch, "tcp_frames.LoggerDriver.__init__")
    machine = parse_machine_file(MACHINE.read_text(), MACHINE)
    with pytest.raises(AssemblyError) as caught:
        bus_drivers(machine, SystemClock(), lambda _: None)
    said = (
        f"{MACHINE}: buses.logger: build of tcp_frames.LoggerPlugin has failed: KeyError: 'no such thing' ("
    )
    assert str(caught.value).startswith(said)
    assert "(tcp_frames.py, line " in str(caught.value)


def test_a_detector_that_cannot_be_made_is_named_with_its_table(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = parse_machine_file(TABLES, MACHINE)
    for part, ask in (("build", detectors), ("check_files", check_files)):
        break_(monkeypatch, f"crest.CrestPlugin.{part}")
        said = (
            f"{MACHINE}: pipeline.crest: {part} of crest.CrestPlugin has failed: KeyError: 'no such thing' ("
        )
        with pytest.raises(AssemblyError, match=re.escape(said)):
            ask(machine)


@pytest.mark.parametrize(
    "layout", ['[streams.casing.layout]\nshape = "whatever its driver reads"\n', ""], ids=["own", "packed"]
)
def test_a_driver_that_cannot_be_loaded_is_one_finding(monkeypatch: pytest.MonkeyPatch, layout: str) -> None:
    text = MACHINE.read_text()
    at, end = text.index("[streams.casing.layout]"), text.index("[[sensors]]")
    monkeypatch.setitem(sys.modules, "tcp_frames", None)
    registry.forget()
    problems = problems_of(f"{text[:at]}{layout}{text[end:]}" if layout else text, MACHINE)
    assert [problem.key for problem in problems] == ["buses.logger.driver"]


def test_a_detector_that_cannot_be_loaded_is_one_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    alarm = '[[alarms]]\nname = "knocks"\ndetector = "crest"\n'
    text = f'{MOTOR.read_text()}\n[pipeline.crest]\nsensor = "accel-de"\n{alarm}'
    monkeypatch.setitem(sys.modules, "crest", None)
    registry.forget()
    assert [problem.key for problem in problems_of(text, MOTOR)] == ["pipeline.crest"]
    without = text.replace('[pipeline.crest]\nsensor = "accel-de"\n', "")
    assert [problem.message for problem in problems_of(without, MOTOR)] == ["there is no such detector"]


def test_words_of_a_validator_are_said_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: Any, host: str) -> str:
        raise ValueError(f"{host} is no address")

    module = importlib.import_module("tcp_frames")
    picky = type(
        "PickyBus",
        (module.LoggerBus,),
        {"__module__": "tcp_frames", "picky": field_validator("host")(classmethod(refuse))},
    )
    monkeypatch.setattr(module.LoggerPlugin, "buses", (picky,))
    [problem] = [one for one in problems_of(MACHINE.read_text(), MACHINE) if one.key == "buses.logger.host"]
    assert problem.message == "is not valid: 127.0.0.1 is no address"
