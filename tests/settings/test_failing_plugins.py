"""A plugin that fails is named with its table, its error and the line; the rest of the check goes on."""

from __future__ import annotations

import importlib
import inspect
import logging
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import is_dataclass
from functools import partial
from inspect import get_annotations
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Never, Union, get_args, get_origin
from unittest.mock import MagicMock

import pytest
from pydantic import field_validator
from support.example_packages import DETECTOR, DRIVER, OUTPUT, installed
from support.given_codes import had
from support.live_service import watch_of
from support.machine_files import MOTOR, problems_of

import daqsvc
from daqsvc.acquisition.clock import SystemClock
from daqsvc.api import Bus, DetectorPlugin, Device, DriverPlugin, OutputPlugin, StreamDriver, WindowDetector
from daqsvc.box import Box
from daqsvc.cli import main, start_logging
from daqsvc.detectors.make import change_setpoints, check_files, detectors
from daqsvc.publish.make import output_set, watched
from daqsvc.service import Service
from daqsvc.settings import describe, hooks, parse_machine_file, registry
from daqsvc.settings.plugins import StreamWords
from daqsvc.settings.problems import AssemblyError, Finding
from drivers.base import BusOptionError
from drivers.make import bus_drivers

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.integration
MACHINE = DRIVER / "machine.toml"
STATE = '[[sensors]]\nname = "state"\ntype = "trend"\nstream = "casing"\nchannel = "y"\nunit = "1"\n'
"""A value that a layout may have names for."""
TABLES = f"""
{MACHINE.read_text()}
{STATE}
[pipeline.crest]
sensor = "casing-x"
[event_file]
path = "events.jsonl"
"""
HERE = Path(__file__).name


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    sites = [
        installed(example, tmp_path / example.name, monkeypatch) for example in (DRIVER, DETECTOR, OUTPUT)
    ]
    for site in sites:
        next(site)
    states_speed = {"crest": ("speed",)}
    monkeypatch.setattr(class_at("crest.CrestPlugin"), "start_up_signals", lambda *_: states_speed)
    monkeypatch.setattr(class_at("crest.CrestPlugin"), "predictable", True)
    yield
    for site in reversed(sites):
        next(site, None)


BROUGHT = {
    "tcp_frames.LoggerPlugin": "daqsvc-tcp-frames 1.0",
    "tcp_frames.LoggerBus": "daqsvc-tcp-frames 1.0",
    "daqsvc.settings.packing.PackedLayout": f"daqsvc {daqsvc.__version__}",
    "crest.CrestPlugin": "daqsvc-crest 1.0",
    "daqsvc.diagnosis.recorded.RecordedLive": f"daqsvc {daqsvc.__version__}",
    "event_file.EventFilePlugin": "daqsvc-event-file 1.0",
    "daqsvc.publish.home_assistant.plugin.HomeAssistantPlugin": f"daqsvc {daqsvc.__version__}",
}
"""For every contract of plugins something that keeps it, and the distribution that brings this."""
NOT_ASKED = {
    ("crest.CrestPlugin", "change_setpoints"): "at a reload",
    ("crest.CrestPlugin", "faults"): "where somebody looks on",
    ("daqsvc.settings.packing.PackedLayout", "polled"): "where a trend is taken of it",
    ("daqsvc.diagnosis.recorded.RecordedLive", "sensors"): "where it gives a verdict",
    ("daqsvc.diagnosis.recorded.RecordedLive", "not_judged"): "likewise",
    ("daqsvc.publish.home_assistant.plugin.HomeAssistantPlugin", "build"): "by nobody: it is a link",
}
"""What this machine file has no use for."""
WHOLE = f"""
{TABLES}
[mqtt]
url = "mqtt://127.0.0.1"
insecure = true
[mqtt.home_assistant]
[[alarms]]
name = "knocks"
detector = "crest"
[alarm_handling.start_up]
detector = "crest"
measure = "speed"
between = [100.0, 1000.0]
"""


def contracts(kind: type[hooks.Hooks] = hooks.Hooks) -> Iterator[type[hooks.Hooks]]:
    for derived in kind.__subclasses__():
        if "__hooks__" in vars(derived):
            yield derived
        yield from contracts(derived)


def class_at(name: str) -> type[Any]:
    module, _, kind = name.rpartition(".")
    found: type[Any] = getattr(importlib.import_module(module), kind)
    return found


def contract_of(name: str) -> type[hooks.Hooks]:
    """What a class of `BROUGHT` keeps, without importing the examples, which are not installed yet."""
    kinds: dict[str, type[hooks.Hooks]] = {
        "tcp_frames.LoggerPlugin": DriverPlugin,
        "tcp_frames.LoggerBus": Bus,
        "crest.CrestPlugin": DetectorPlugin,
        "event_file.EventFilePlugin": OutputPlugin,
    }
    return kinds[name] if name in kinds else class_at(name)


OF_SEVERAL = ("several_checks",)
"""Hooks that are asked of a directory of machine files only."""

EVERY_HOOK = [(name, hook) for name in BROUGHT for hook in sorted(contract_of(name).__hooks__)]


def test_every_contract_has_something_that_keeps_it() -> None:
    kept = {kind for name in BROUGHT for kind in class_at(name).__mro__}
    assert set(contracts()) <= kept


def failing(*_: Any, **__: Any) -> Never:
    raise KeyError("no such thing")


def exiting(*_: Any, **__: Any) -> Never:
    raise SystemExit(0)


class UnsayableError(Exception):
    def __str__(self) -> str:
        raise ValueError


def unsayable(*_: Any, **__: Any) -> Never:
    raise UnsayableError


RAISING = {
    failing: "KeyError: 'no such thing'",
    exiting: "SystemExit: 0",
    unsayable: "UnsayableError",
}


def break_(
    monkeypatch: pytest.MonkeyPatch, owner: str, hook: str, how: Callable[..., Never] = failing
) -> str:
    """Have a hook raise; returns how that is said."""
    kind = class_at(owner)
    is_property = isinstance(inspect.getattr_static(kind, hook), property)
    monkeypatch.setattr(kind, hook, property(how) if is_property else how)
    return f"{hook} of {owner} has failed: {RAISING[how]} ("


def all_said(
    file: Path,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    log: pytest.LogCaptureFixture,
    hook: str = "",
) -> str:
    """All that is said of a machine file: by ``check``, by the start of the service, and by ``analyze``."""
    if hook in OF_SEVERAL:
        assert main(["check", str(file.parent)]) == 2
        return log.text
    assert main(["check", str(file)]) in {0, 2}
    said = capsys.readouterr()
    if not said.err:
        machine = parse_machine_file(file.read_text("utf-8"), file)
        try:
            Service(Box.single(machine), folder)
            output_set(machine).make(MagicMock(machines={machine.machine.name: watched(machine)}))
        except AssemblyError as error:
            return f"{error}"
        recording = folder / "casing.csv"
        rows = "\n".join(f"{0.001 * row:g},{row % 7}" for row in range(3000))
        recording.write_text(f"time,casing-x\n{rows}\n")
        with suppress(SystemExit):
            main(["analyze", str(file), str(recording)])
            main(["detectability", str(file)])
    more = capsys.readouterr()
    return f"{said.out}\n{said.err}\n{more.out}\n{more.err}\n{log.text}"


@pytest.mark.parametrize(
    "how",
    [failing, *(pytest.param(how, marks=pytest.mark.long) for how in (exiting, unsayable))],
)
@pytest.mark.parametrize(("owner", "hook"), EVERY_HOOK)
def test_a_hook_that_fails_is_named_with_who_can_mend_it(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    owner: str,
    hook: str,
    how: Callable[..., Never],
) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(WHOLE)
    failed = break_(monkeypatch, owner, hook, how)
    said = " ".join(all_said(file, tmp_path, capsys, caplog, hook).split())
    if (owner, hook) not in NOT_ASKED:
        assert failed in said
        assert f"have the authors of {BROUGHT[owner]} fix it" in said
    assert "Traceback" not in said


def test_a_hook_that_would_end_the_process_ends_check_in_words(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The short form of the above."""
    file = tmp_path / "machine.toml"
    file.write_text(WHOLE)
    failed = break_(monkeypatch, "crest.CrestPlugin", "checks", exiting)
    assert main(["check", str(file)]) == 2
    assert failed in " ".join(capsys.readouterr().err.split())


def wrong(wanted: Any) -> Iterator[Callable[..., Any]]:
    """What is not of a type: itself, or only in an element or a field of it."""
    origin: Any = get_origin(wanted) or wanted or NoneType
    kinds = get_args(wanted)
    if origin in {Any, object}:
        return
    if origin in {Union, UnionType}:
        yield from (answer for answer in wrong(kinds[0]) if answer() is not None)
        return
    yield lambda: 42.0 if origin is str else "x"
    yield Wrong
    if origin is not NoneType:
        yield lambda: None
    elements = [element for kind in kinds[:1] for element in wrong(kind)] if origin is not type else []
    if origin is tuple and kinds[-1] is not ...:
        yield lambda: ([1], [1])
        yield lambda: (None,)
    elif isinstance(origin, type) and issubclass(origin, Mapping):
        yield lambda: {"speed": [1]}
    else:
        for element in elements:
            yield partial(of_one, list, element)
            if issubclass(Iterator, origin):
                yield partial(of_one, iter, element)
    if (hasattr(origin, "_fields") or is_dataclass(origin)) and not inspect.isabstract(origin):
        yield partial(origin, *[Wrong()] * len(get_annotations(origin)))


def of_one(kind: Callable[[list[Any]], Any], element: Callable[[], Any]) -> Any:
    return kind([element()])


class Wrong:
    """Of no kind that a contract asks for."""


EVERY_WRONG_ANSWER = [
    # The last one is wrong in the deepest place.
    pytest.param(owner, hook, answer, marks=[pytest.mark.long] if more else [], id=f"{owner}-{hook}-{more}")
    for owner, hook in EVERY_HOOK
    for more, answer in enumerate(reversed([*wrong(hooks.declared(contract_of(owner), hook).wanted)]))
]


@pytest.mark.parametrize(("owner", "hook", "answer"), EVERY_WRONG_ANSWER)
def test_a_hook_that_answers_something_else_is_named_with_who_can_mend_it(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
    owner: str,
    hook: str,
    answer: Callable[[], Any],
) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(WHOLE)
    kind = class_at(owner)
    is_property = isinstance(inspect.getattr_static(kind, hook), property)

    def answering(*_: Any, **__: Any) -> Any:
        return answer()

    monkeypatch.setattr(kind, hook, property(answering) if is_property else answering)
    said = " ".join(all_said(file, tmp_path, capsys, caplog, hook).split())
    if (owner, hook) not in NOT_ASKED:
        assert re.search(rf"{hook} of {re.escape(owner)} has failed: it (is|returns|yields) .+, not ", said)
        assert f"({HERE}, line {answering.__code__.co_firstlineno})" in said
        assert f"have the authors of {BROUGHT[owner]} fix it" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(("owner", "hook"), EVERY_HOOK)
def test_a_hook_that_fails_takes_no_other_table_down(
    monkeypatch: pytest.MonkeyPatch, owner: str, hook: str
) -> None:
    failed = break_(monkeypatch, owner, hook)
    again = '[[alarms]]\nname = "knocks"\ndetector = "crest"\n[alarm_handling'
    wrong = WHOLE.replace("[alarm_handling", again)
    others = [one for one in problems_of(wrong, MACHINE) if failed not in one.message]
    assert [one.key for one in others] == ["alarms[1].name"]


@pytest.mark.parametrize(
    ("owner", "hook", "table"),
    [
        ("tcp_frames.LoggerPlugin", "checks", "buses.logger"),
        ("tcp_frames.LoggerPlugin", "stream_checks", "streams.casing"),
        ("tcp_frames.LoggerPlugin", "bus_of", "buses.logger"),
        ("tcp_frames.LoggerPlugin", "read_files", "streams.casing.layout"),
        ("tcp_frames.LoggerBus", "device", "buses.logger"),
        ("daqsvc.settings.packing.PackedLayout", "channel_names", "streams.casing.layout"),
        ("daqsvc.settings.packing.PackedLayout", "value_names", "streams.casing.layout"),
        ("crest.CrestPlugin", "checks", "pipeline.crest"),
        ("crest.CrestPlugin", "sampled_together", "pipeline.crest"),
        ("event_file.EventFilePlugin", "checks", "event_file"),
    ],
)
def test_a_hook_that_fails_is_one_finding_with_its_line(
    monkeypatch: pytest.MonkeyPatch, owner: str, hook: str, table: str
) -> None:
    failed = break_(monkeypatch, owner, hook)
    [problem] = problems_of(TABLES, MACHINE)
    assert problem.message.startswith(failed)
    assert problem.key == table
    assert problem.line is not None
    removed = table.removesuffix(".layout")
    assert problem.remedy == f"have the authors of {BROUGHT[owner]} fix it, or remove [{removed}]"


@pytest.mark.parametrize("names", [("ghost",), ("casing-x", "ghost")])
def test_sensors_that_a_plugin_takes_together_and_there_are_none_of_are_its_failure(
    monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...]
) -> None:
    monkeypatch.setattr(class_at("crest.CrestPlugin"), "sampled_together", lambda *_: names)
    [problem] = problems_of(TABLES, MACHINE)
    assert problem.key == "pipeline.crest"
    words = (
        "it names 'ghost', which is no sensor; name some of casing-x, state (test_failing_plugins.py, line"
    )
    assert f"sampled_together of crest.CrestPlugin has failed: {words}" in problem.message
    assert problem.remedy == "have the authors of daqsvc-crest 1.0 fix it, or remove [pipeline.crest]"
    # A table that names them is to blame for it, and says so itself.
    [problem] = problems_of(TABLES.replace('sensor = "casing-x"', 'sensor = "ghost"'), MACHINE)
    assert problem.key == "pipeline.crest.sensor"


def test_kinds_of_buses_and_layouts_may_be_a_list(monkeypatch: pytest.MonkeyPatch) -> None:
    plugin = class_at("tcp_frames.LoggerPlugin")
    for name in ("buses", "layouts", "self_checks"):
        monkeypatch.setattr(plugin, name, list(getattr(plugin, name)))
    registry.forget()
    assert list(parse_machine_file(TABLES, MACHINE).buses) == ["logger"]
    monkeypatch.setattr(plugin, "buses", {})
    registry.forget()
    [problem] = problems_of(MACHINE.read_text(), MACHINE)
    assert "buses of LoggerPlugin is {}, which must be tuple[type[Bus], ...]" in problem.message


@pytest.mark.parametrize(
    ("owner", "base", "contract"),
    [
        ("tcp_frames.LoggerPlugin", StreamDriver, "Driver"),
        ("crest.CrestPlugin", WindowDetector, "Detector"),
    ],
)
def test_an_init_that_forgets_its_base_is_named_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, owner: str, base: type[Any], contract: str
) -> None:
    body = {"__init__": lambda _: None, "__repr__": lambda _: "<Bare>", "read": None, "judge": None}
    bare = type("Bare", (base,), body)
    monkeypatch.setattr(class_at(owner), "build", lambda *_: [bare()] if contract == "Detector" else bare())
    with pytest.raises(AssemblyError) as caught:
        Service(Box.single(parse_machine_file(TABLES, MACHINE)), tmp_path)
    remedy = "call super().__init__() in its __init__, or set it"
    assert f"<Bare> lacks name of {contract}; {remedy} (test_failing_plugins.py, line" in f"{caught.value}"
    assert f"build of {owner} has failed: " in f"{caught.value}"
    assert f"have the authors of {BROUGHT[owner]} fix it" in f"{caught.value}"


def test_a_plugin_cannot_change_the_machine_file_that_it_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    def meddling(_: Any, draft: Any, settings: Any) -> Iterator[Any]:
        del settings
        draft.buses.clear()
        yield iter(())

    monkeypatch.setattr(class_at("crest.CrestPlugin"), "checks", meddling)
    partly_valid = '[[alarms]]\nname = "knocks"\ndetector = "crest"\nlatching = 7\n'
    for more in ("", partly_valid):
        [said] = [one.message for one in problems_of(TABLES + more, MACHINE) if one.key == "pipeline.crest"]
        assert "checks of crest.CrestPlugin has failed: TypeError: a machine file is not to be" in said


@pytest.mark.parametrize("change", ["draft.streams['x'] = 1", "draft.buses.pop('logger')", "facts['x'] = 1"])
def test_a_driver_cannot_change_what_it_is_given(monkeypatch: pytest.MonkeyPatch, change: str) -> None:
    def meddling(_: Any, draft: Any, facts: Any) -> Iterator[Any]:
        exec(change, {"draft": draft, "facts": facts})  # noqa: S102 - our own text
        yield iter(())

    monkeypatch.setattr(class_at("tcp_frames.LoggerPlugin"), "checks", meddling)
    [problem] = problems_of(TABLES, MACHINE)
    assert "checks of tcp_frames.LoggerPlugin has failed: " in problem.message


STEERING = "beats\n\x1b[2J\x1b]0;title\x07\tfast\udc00"


@pytest.mark.parametrize(
    ("owner", "hook", "answer"),
    [
        ("tcp_frames.LoggerBus", "summary", STEERING),
        ("daqsvc.settings.packing.PackedLayout", "summary", STEERING),
        ("tcp_frames.LoggerPlugin", "describe_stream", StreamWords(*[STEERING] * 5)),
        ("tcp_frames.LoggerPlugin", "describe_stream", StreamWords(channels=((STEERING,), (STEERING, "")))),
        ("crest.CrestPlugin", "describe", STEERING),
        ("event_file.EventFilePlugin", "describe", STEERING),
        ("crest.CrestPlugin", "checks", [iter([Finding((), STEERING, STEERING, fatal=False)])]),
        ("crest.CrestPlugin", "checks", [iter([Finding((), STEERING, STEERING)])]),
        ("crest.CrestPlugin", "check_files", AssemblyError(STEERING)),
        ("crest.CrestPlugin", "describe", KeyError(STEERING)),
    ],
)
def test_what_a_plugin_says_is_shown_in_lines_that_steer_no_terminal(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    owner: str,
    hook: str,
    answer: Any,
) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(TABLES)
    main(["check", str(file)])
    before = capsys.readouterr().out

    def answering(*_: Any, **__: Any) -> Any:
        if isinstance(answer, Exception):
            raise answer
        return answer

    kind = class_at(owner)
    is_property = isinstance(inspect.getattr_static(kind, hook), property)
    monkeypatch.setattr(kind, hook, property(answering) if is_property else answering)
    main(["check", str(file)])
    said = capsys.readouterr()
    assert said.out != before
    assert all(line.isprintable() for line in (said.out + said.err).splitlines())
    assert "beats" in said.out + said.err


def test_the_log_steers_no_terminal_and_takes_one_line_for_a_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])
    monkeypatch.setattr(root, "level", root.level)
    start_logging(verbose=False)
    logging.getLogger("daqsvc.test").warning("%s", STEERING)
    [line] = capsys.readouterr().err.splitlines()
    assert "beats" in line
    assert line.isprintable()


class NoHash:
    def __hash__(self) -> int:
        raise KeyError("no hash")


@pytest.mark.parametrize("identity", [["can0"], ("can0", ["1"]), NoHash()], ids=["list", "tuple", "own"])
def test_a_device_that_cannot_be_told_apart_is_one_finding(
    monkeypatch: pytest.MonkeyPatch, identity: Any
) -> None:
    device = Device("address", identity, "take another")
    monkeypatch.setattr(class_at("tcp_frames.LoggerBus"), "device", property(lambda _: device))
    [problem] = problems_of(TABLES, MACHINE)
    assert problem.key == "buses.logger"
    assert "device of tcp_frames.LoggerBus has failed: it is Device(key='address', iden" in problem.message
    assert "in its identity, " in problem.message
    assert " is no Hashable (" in problem.message
    assert problem.remedy == "have the authors of daqsvc-tcp-frames 1.0 fix it, or remove [buses.logger]"


def test_a_validator_that_fails_is_one_finding_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Any, sensor: str) -> Never:
        raise KeyError(sensor)

    module = importlib.import_module("crest")
    picky = type(
        "Picky",
        (module.Crest,),
        {"__module__": "crest", "picky": field_validator("sensor")(classmethod(fail))},
    )
    monkeypatch.setattr(module.CrestPlugin, "settings", picky)
    registry.forget()
    wrong = TABLES.replace('channel = "x"', 'channel = "z"')
    problems = {problem.key: problem for problem in problems_of(wrong, MACHINE)}
    assert problems.keys() == {"pipeline.crest", "sensors[0].channel"}
    assert (
        "a validator of crest.Picky has failed: KeyError: 'casing-x' (" in problems["pipeline.crest"].message
    )
    assert problems["pipeline.crest"].remedy == "have the authors of daqsvc-crest 1.0 fix it"


@pytest.mark.parametrize("answer", [None, 42])
def test_a_hook_that_answers_nothing_or_something_else_is_named(
    monkeypatch: pytest.MonkeyPatch, answer: object
) -> None:
    monkeypatch.setattr(class_at("crest.CrestPlugin"), "checks", lambda *_: answer)
    [problem] = problems_of(TABLES, MACHINE)
    words = f"checks of crest.CrestPlugin has failed: it returns {answer}, not Iterator["
    assert words in problem.message
    assert problem.remedy == "have the authors of daqsvc-crest 1.0 fix it, or remove [pipeline.crest]"


@pytest.mark.parametrize(
    ("attribute", "value", "said"),
    [
        ("place", "first", "place of CrestPlugin is 'first', which must be float"),
        ("detector", 7, "detector of CrestPlugin is 7, which must be str | None"),
        ("about", None, "about of CrestPlugin is None, which must be str"),
        ("settings", dict, "settings of CrestPlugin is <class 'dict'>, which must be type[Section]"),
        ("settings", 42, "settings of CrestPlugin is 42, which must be type[Section]"),
        ("settings", None, "CrestPlugin does not state its settings"),
        ("start_up_signals", 42, "start_up_signals of CrestPlugin is 42, which must be a method"),
    ],
)
def test_a_plugin_with_odd_attributes_is_one_finding(
    monkeypatch: pytest.MonkeyPatch, attribute: str, value: object, said: str
) -> None:
    monkeypatch.setattr(class_at("crest.CrestPlugin"), attribute, value)
    registry.forget()
    [problem] = problems_of(TABLES, MACHINE)
    assert problem.key == "pipeline.crest"
    assert problem.message == f"the detector cannot be loaded from crest:CrestPlugin: {said}"
    assert problem.remedy == "have the authors of daqsvc-crest 1.0 fix it, or remove [pipeline.crest]"


@pytest.mark.parametrize(
    ("attribute", "value", "said"),
    [
        ("buses", 42, "buses of LoggerPlugin is 42, which must be tuple[type[Bus], ...]"),
        ("buses", (int,), "buses of LoggerPlugin is (<class 'int'>,), which must be tuple[type[Bus], ...]"),
        ("buses", (), "LoggerPlugin does not state its buses"),
        ("layouts", 42, "layouts of LoggerPlugin is 42, which must be tuple[type[Layout], ...]"),
        ("self_checks", (1,), "self_checks of LoggerPlugin is (1,), which must be tuple[str, ...]"),
    ],
)
def test_a_driver_with_odd_attributes_is_one_finding(
    monkeypatch: pytest.MonkeyPatch, attribute: str, value: object, said: str
) -> None:
    monkeypatch.setattr(class_at("tcp_frames.LoggerPlugin"), attribute, value)
    registry.forget()
    [problem] = problems_of(MACHINE.read_text(), MACHINE)
    assert problem.message == f"the driver cannot be loaded from tcp_frames:LoggerPlugin: {said}"
    assert problem.remedy == "have the authors of daqsvc-tcp-frames 1.0 fix it, or remove [buses.logger]"


@pytest.mark.parametrize(
    ("source", "said", "remedy"),
    [
        ("import numpy\n1 / 0\n", "ZeroDivisionError: division by zero (crest.py, line 2)", "have"),
        ("import numpy\nclass Crest(\n", "SyntaxError: '(' was never closed (crest.py, line 2)", "have"),
        (
            "import nobody_has_this\n",
            "ModuleNotFoundError: No module named 'nobody_has_this' (crest.py, line 1)",
            "install nobody_has_this, or have",
        ),
        ("Crest = 1\n", "module 'crest' has no attribute 'CrestPlugin'", "have"),
    ],
)
def test_a_plugin_whose_own_module_fails_is_named_with_its_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, source: str, said: str, remedy: str
) -> None:
    (tmp_path / "crest.py").write_text(source)
    with monkeypatch.context() as patch:  # undone before the examples go
        patch.syspath_prepend(str(tmp_path))
        patch.delitem(sys.modules, "crest")
        registry.forget()
        [problem] = problems_of(TABLES, MACHINE)
    assert problem.message == f"the detector cannot be loaded from crest:CrestPlugin: {said}"
    assert problem.remedy == f"{remedy} the authors of daqsvc-crest 1.0 fix it, or remove [pipeline.crest]"


def test_what_a_plugin_finds_without_a_code_gets_the_one_for_that(monkeypatch: pytest.MonkeyPatch) -> None:
    def checks(*_: Any) -> Iterator[Iterator[Finding]]:
        yield iter([Finding(("pipeline", "crest"), "is odd", "make it even")])

    monkeypatch.setattr(class_at("crest.CrestPlugin"), "checks", checks)
    [problem] = problems_of(TABLES, MACHINE)
    assert f"{problem}".endswith("pipeline.crest: is odd. Remedy: make it even [F43]")
    had("F43", problem)
    assert f"{AssemblyError('the licence has ended')}" == "the licence has ended [F43]"


def test_a_check_that_fails_later_is_one_finding_with_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def checks(*_: Any) -> Iterator[Iterator[Any]]:
        yield (1 // zero for zero in [0])

    plugin = importlib.import_module("crest").CrestPlugin
    monkeypatch.setattr(plugin, "checks", checks)
    [problem] = problems_of(TABLES, MACHINE)
    assert "checks of crest.CrestPlugin has failed: ZeroDivisionError" in problem.message
    assert f"({HERE}, line {checks.__code__.co_firstlineno + 1})" in problem.message


@pytest.mark.parametrize(
    ("owner", "hook"),
    [
        ("tcp_frames.LoggerPlugin", "describe_bus"),
        ("tcp_frames.LoggerBus", "summary"),
        ("crest.CrestPlugin", "describe"),
        ("event_file.EventFilePlugin", "describe"),
    ],
)
def test_words_that_fail_are_named_in_their_place(
    monkeypatch: pytest.MonkeyPatch, owner: str, hook: str
) -> None:
    failed = break_(monkeypatch, owner, hook)
    text = " ".join(describe(parse_machine_file(TABLES, MACHINE)).split())
    assert failed in text
    assert "128 bytes, 30 x 2 channels, 32 bit count" in text


@pytest.mark.parametrize("hook", ["readings", "quality_alarms"])
def test_figures_that_cannot_be_asked_for_do_not_keep_the_service_from_its_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture, hook: str
) -> None:
    failed = break_(monkeypatch, "crest.CrestPlugin", hook)
    service = Service(Box.single(parse_machine_file(TABLES, MACHINE)), tmp_path)
    assert [detector.name for detector in watch_of(service).pipeline.detectors] == ["crest"]
    assert failed in caplog.text
    assert (
        "have the authors of daqsvc-crest 1.0 fix it, or remove [pipeline.crest]; the service" in caplog.text
    )


def test_words_that_fail_end_check_with_an_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(TABLES)
    for owner, hook, table in (
        ("crest.CrestPlugin", "describe", "pipeline.crest"),
        ("tcp_frames.LoggerBus", "summary", "buses.logger"),
    ):
        with monkeypatch.context() as patch:
            failed = break_(patch, owner, hook)
            assert main(["check", str(file)]) == 2
        said = capsys.readouterr()
        assert said.err.startswith(f"{file}: {table}: {failed}")
        assert said.err.endswith(f" fix it, or remove [{table}] [F23]\n")
        had("F23", said.err)
        assert "128 bytes, 30 x 2 channels" in " ".join(said.out.split())


def test_a_driver_that_cannot_be_made_is_named_with_its_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(class_at("tcp_frames.LoggerDriver"), "__init__", failing)
    machine = parse_machine_file(MACHINE.read_text(), MACHINE)
    with pytest.raises(AssemblyError) as caught:
        bus_drivers(machine, SystemClock(), lambda _: None)
    said = (
        f"{MACHINE}: buses.logger: build of tcp_frames.LoggerPlugin has failed: KeyError: 'no such thing' ("
    )
    assert str(caught.value).startswith(said)
    assert "(tcp_frames.py, line " in str(caught.value)


def test_an_option_that_a_driver_cannot_use_is_named_with_its_bus(monkeypatch: pytest.MonkeyPatch) -> None:
    def refusing(*_: Any) -> Never:
        raise BusOptionError("depth", "is odd", "write an even one")

    monkeypatch.setattr(class_at("tcp_frames.LoggerPlugin"), "build", refusing)
    machine = parse_machine_file(MACHINE.read_text(), MACHINE)
    with pytest.raises(AssemblyError) as caught:
        bus_drivers(machine, SystemClock(), lambda _: None)
    assert f"{caught.value}" == f"{MACHINE}: buses.logger: depth is odd; write an even one [B25]"
    had("B25", caught.value)


def test_a_detector_that_cannot_be_made_is_named_with_its_table(monkeypatch: pytest.MonkeyPatch) -> None:
    machine = parse_machine_file(TABLES, MACHINE)
    asked = {
        "build": detectors,
        "check_files": check_files,
        "change_setpoints": lambda one: change_setpoints(one, ()),
    }
    for part, ask in asked.items():
        break_(monkeypatch, "crest.CrestPlugin", part)
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
    assert f"{problem}".endswith("[F25]")
    had("F25", problem)
