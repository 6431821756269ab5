"""The example of docs/write-a-driver.md: installed as a third party's package is, it serves a machine."""

from __future__ import annotations

import ast
import json
import sys
import tomllib
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conformance.example_transport import LoggerDevice
from conformance.rig import samples_of
from support.example_packages import DETECTOR, DOCS, DRIVER, installed, lines_of
from support.live_service import running, watch_of
from support.machine_files import problems_of
from support.machine_mutations import toml
from support.snippets import snippets
from support.waiting import eventually

from daqsvc.api import Device
from daqsvc.settings import describe, load_machine_file, parse_machine_file, registry
from daqsvc.settings.packing import PackedLayout
from drivers.make import stream_layout
from drivers.plugin import DriverPlugin

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daqsvc.settings import MachineFile

pytestmark = pytest.mark.integration
MACHINE = DRIVER / "machine.toml"


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from installed(DRIVER, tmp_path / "site", monkeypatch)


def changed(old: str, new: str) -> str:
    text = MACHINE.read_text()
    assert old in text
    return text.replace(old, new)


def machine(old: str = "", new: str = "") -> MachineFile:
    return parse_machine_file(changed(old, new), MACHINE)


async def test_the_example_serves_a_machine(tmp_path: Path) -> None:
    logger = LoggerDevice(stream_layout(load_machine_file(MACHINE), "casing"))
    try:
        async with running(machine("4001", f"{logger.tcp_port}"), tmp_path / "store") as service:
            [driver] = service.drivers
            await eventually(lambda: driver.link.state == "up", "the logger is connected")
            ring = watch_of(service).rings["casing"]
            await logger.send(0, samples_of(np.arange(1500)))
            # The last frames are held until it is sure that none of before them is still to come.
            await eventually(lambda: ring.end_index >= 1200, "the samples have arrived")
            np.testing.assert_array_equal(ring.read(0, 1200), samples_of(np.arange(1200)))
    finally:
        logger.close()


def test_check_says_what_it_has_understood_of_it() -> None:
    text = " ".join(describe(load_machine_file(MACHINE)).split())
    assert "logger driver tcp-frames, host 127.0.0.1, tcp_port 4001; if absent at start: retry" in text
    assert "128 bytes, 30 x 2 channels, 32 bit count" in text


def test_a_frame_may_have_any_length() -> None:
    long = machine("frame_bytes = 128", "frame_bytes = 60000")
    assert stream_layout(long, "casing").length == 60_000


@pytest.mark.parametrize(
    ("old", "new", "key", "said"),
    [
        ("= 4001", '= "4001"', "buses.logger.tcp_port", "must be a whole number"),
        ("= 4001", "= 70000", "buses.logger.tcp_port", "must be 65535 or less"),
        ("tcp_port", "tpc_port", "buses.logger.tpc_port", "did you mean tcp_port?"),
        ('host = "127.0.0.1"\n', "", "buses.logger.host", 'add host = "192.0.2.10" to [buses.logger]'),
        (
            "frame_bytes = 128",
            "frame_bytes = 64",
            "streams.casing.layout.first_byte",
            "of a frame of 64 bytes",
        ),
        ("byte = 0", "byte = 70", "streams.casing.layout.counter", "would overlap the samples"),
        (
            "counter = {",
            "# counter = {",
            "streams.casing.layout.counter",
            "is missing: it tells what was lost",
        ),
        (
            "frame_bytes = 128",
            "id = 5\nlength = 64",
            "streams.casing.layout",
            'bus "logger" is a data logger',
        ),
        ('"tcp-frames"', '"tcp-frame"', "buses.logger.driver", 'did you mean "tcp-frames"?'),
    ],
)
def test_what_is_wrong_is_said_with_line_value_and_remedy(old: str, new: str, key: str, said: str) -> None:
    problems = [problem for problem in problems_of(changed(old, new), MACHINE) if problem.key == key]
    assert any(said in str(problem) for problem in problems), problems_of(changed(old, new), MACHINE)
    assert all(problem.line is not None for problem in problems)


@pytest.mark.parametrize("key", PackedLayout.model_fields)
def test_every_key_of_its_layout_is_checked(key: str) -> None:
    document = tomllib.loads(MACHINE.read_text())
    layout = document["streams"]["casing"]["layout"]

    def keys_of_problems(spoilt: dict[str, Any]) -> set[str]:
        whole = document | {"streams": {"casing": document["streams"]["casing"] | {"layout": spoilt}}}
        text = "".join(f"{json.dumps(name)} = {toml(value)}\n" for name, value in whole.items())
        return {problem.key for problem in problems_of(text, MACHINE)}

    assert f"streams.casing.layout.{key}" in keys_of_problems(layout | {key: 17.5})
    assert f"streams.casing.layout.{key}x" in keys_of_problems(layout | {f"{key}x": 1})
    if PackedLayout.model_fields[key].is_required() and key != PackedLayout.mark:
        without = {name: value for name, value in layout.items() if name != key}
        assert f"streams.casing.layout.{key}" in keys_of_problems(without)


def test_a_second_stream_is_too_much_for_it() -> None:
    text = MACHINE.read_text()
    stream = text[text.index("[streams.casing]") : text.index("[[sensors]]")]
    both = f"{text}\n{stream.replace('streams.casing', 'streams.other')}"
    assert "buses.logger: has several streams. Remedy: give it exactly one" in str(
        problems_of(both, MACHINE)[0]
    )


def test_a_device_as_the_page_shows_it_belongs_to_one_bus_only(monkeypatch: pytest.MonkeyPatch) -> None:
    [part] = [one for one in snippets(DOCS / "write-a-driver.md") if one.why_not_run]
    made: dict[str, Any] = {"Device": Device}
    exec(part.text, made)  # noqa: S102 - of our own page
    monkeypatch.setattr("tcp_frames.LoggerBus.device", made["device"])
    other = MACHINE.read_text().partition("[buses.logger]")[2].partition("[streams")[0]
    text = f"{MACHINE.read_text()}\n[buses.other]{other}"
    [problem] = problems_of(text, MACHINE)
    assert problem.key == "buses.other.tcp_port"
    assert 'belongs to bus "logger" already. Remedy: give each bus its own port' in str(problem)


class _Unfinished(DriverPlugin[Any]):
    """A plugin whose author has forgotten the model of its bus."""


MEND = "have the authors of daqsvc-tcp-frames 1.0 fix it"


@pytest.mark.parametrize(
    ("plugin", "why", "remedy"),
    [
        (None, "import of tcp_frames halted", "install the package that brings it again"),
        (dict, "it is not derived from DriverPlugin of daqsvc.api", MEND),
        (_Unfinished, "_Unfinished does not state its buses", MEND),
    ],
)
def test_a_package_that_cannot_be_loaded_is_named_with_its_bus(
    monkeypatch: pytest.MonkeyPatch, plugin: type[Any] | None, why: str, remedy: str
) -> None:
    broken = None if plugin is None else type("module", (), {"LoggerPlugin": plugin})
    monkeypatch.setitem(sys.modules, "tcp_frames", broken)
    registry.forget()
    [problem] = [p for p in problems_of(MACHINE.read_text(), MACHINE) if p.key == "buses.logger.driver"]
    assert f"the driver cannot be loaded from tcp_frames:LoggerPlugin: {why}" in problem.message
    assert problem.remedy == f"{remedy}, or remove [buses.logger]"
    assert problem.line == 10


def test_the_documentation_shows_the_example_as_it_is() -> None:
    text = (DOCS / "write-a-driver.md").read_text()
    for name in ("tcp_frames.py", "pyproject.toml", "machine.toml"):
        assert (DRIVER / name).read_text().strip() in text, (
            f"docs/write-a-driver.md does not show {name} as it is"
        )


@pytest.mark.parametrize(("example", "most"), [(DRIVER, 60), (DETECTOR, 40)], ids=["driver", "detector"])
def test_an_example_is_short_and_imports_what_is_public_only(example: Path, most: int) -> None:
    assert lines_of(example) <= most
    [module] = example.glob("*.py")
    imported = {
        node.module
        for node in ast.walk(ast.parse(module.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in {"daqsvc", "drivers"}
    }
    assert imported == {"daqsvc.api"}
