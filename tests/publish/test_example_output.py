"""The worked example of docs/outputs.md: every event once over restarts, and its failures end nothing."""

from __future__ import annotations

import asyncio
import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.alarm_desk import alarm_service
from support.example_packages import DOCS, OUTPUT, installed
from support.live_service import play, running, watch_of
from support.machine_files import LAVAL, MOTOR, problems_of
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.conditions import Condition
from daqsvc.alarms.events import Identity
from daqsvc.alarms.rules import DiagnosisRule
from daqsvc.alarms.states import Level
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.reading import read_journal
from daqsvc.publish.make import output_set
from daqsvc.publish.output import Output
from daqsvc.settings import describe, parse_machine_file, registry

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from daqsvc.alarm_service import AlarmService
    from daqsvc.settings import MachineFile

pytestmark = pytest.mark.integration
CLOCK = SystemClock()
TABLE = '[event_file]\npath = "{}"\n'


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from installed(OUTPUT, tmp_path / "site", monkeypatch)


def machine(file: Path) -> MachineFile:
    return parse_machine_file(f"{MOTOR.read_text()}\n{TABLE.format(file)}", MOTOR)


def without_broker() -> str:
    text = LAVAL.read_text()
    return text[: text.index("[mqtt]")] + text[text.index("[store]") :]


@contextlib.asynccontextmanager
async def alarms_of(told: MachineFile, store: Path) -> AsyncIterator[AlarmService]:
    identity = Identity(told.site, told.box, told.machine.name)
    alarms = alarm_service(identity, [DiagnosisRule("knocks", "crest")], store, CLOCK, output_set(told))
    await alarms.open()
    await alarms.resume({identity.machine: {"crest": ("accel-de",)}})
    tasks = [asyncio.create_task(alarms.outputs["event_file"].run())]
    try:
        yield alarms
    finally:
        await alarms.settle(2.0)
        await alarms.stop(2.0)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await alarms.close(2.0)


def said(decision: str, severity: Any) -> Diagnosis:
    now_ns = CLOCK.monotonic_ns()
    return Diagnosis("motor", "crest", now_ns, "motor", 0, 1, decision, changed=True, severity=severity)


def lines(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def events(file: Path) -> list[tuple[str, str]]:
    return [(line["alarm"], line["kind"]) for line in lines(file) if "kind" in line]


async def test_every_event_is_in_the_file_once_also_over_restarts(tmp_path: Path) -> None:
    file = tmp_path / "events.jsonl"
    async with alarms_of(machine(file), tmp_path / "store") as alarms:
        for diagnosis in (said("alert", "alert"), said("normal", "normal")):
            alarms.take(diagnosis)
            alarms.outputs["event_file"].report(diagnosis)
        await eventually(lambda: len(lines(file)) == 4, "two events and two diagnoses are in the file")
        assert alarms.outputs["event_file"].figures() == {"lines": 4}
    assert [line["decision"] for line in lines(file) if "decision" in line] == ["alert", "normal"]
    async with alarms_of(machine(file), tmp_path / "store") as alarms:
        alarms.take(said("alert", "alert"))
        await eventually(lambda: len(events(file)) == 3, "the new event is in the file")
    assert events(file) == [("knocks", "raised"), ("knocks", "returned"), ("knocks", "raised")]
    journal = {json.loads(entry.payload)["id"] for entry in read_journal(tmp_path / "store").history}
    assert {line["id"] for line in lines(file) if "kind" in line} == journal


def test_its_table_is_described_and_checked_like_any_other() -> None:
    told = " ".join(describe(machine(Path("/var/log/events.jsonl"))).split())
    assert "event_file path /var/log/events.jsonl" in told
    [misspelt] = problems_of(f"{MOTOR.read_text()}\n{TABLE.replace('path', 'paht')}", MOTOR)
    assert "event_file.paht" in str(misspelt)
    assert "did you mean path?" in str(misspelt)


class Broken(Output):
    """An output that fails in whatever it is asked to do."""

    def __init__(self, counted: dict[str, int]) -> None:
        self._counted = counted

    def __getattribute__(self, name: str) -> Any:
        if name.startswith("_"):
            return super().__getattribute__(name)

        def fail(*_: object, **__: object) -> None:
            self._counted[name] = self._counted.get(name, 0) + 1
            raise RuntimeError(f"{name} is broken")

        return fail


@pytest.mark.long
@pytest.mark.parametrize("is_made", [True, False])
async def test_one_that_fails_in_everything_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, *, is_made: bool
) -> None:
    import event_file  # type: ignore[import-not-found]

    counted: dict[str, int] = {}

    def build(*_: object) -> Broken:
        if not is_made:
            raise RuntimeError("build is broken")
        return Broken(counted)

    monkeypatch.setattr(event_file.EventFilePlugin, "build", build)
    told = parse_machine_file(f"{without_broker()}\n{TABLE.format(tmp_path / 'none')}", LAVAL)
    can0 = told.buses["can0"].model_copy(update={"interface": "virtual", "channel": "broken-output"})
    told = told.model_copy(update={"buses": {"can0": can0}})
    async with running(told, tmp_path / "store") as service:
        await play(service, np.tile([5.0, 5.0, 0.0], (1280, 1)), 640.0)
        await eventually(lambda: service.figures()["streams"]["shaft"]["samples_received"] > 1200, "acquired")
        assert any(c.windows for c in watch_of(service).pipeline.counters.values())
        events = service.alarms.manager.condition("store/disk", Level.ALERT, "is nearly full")
        for event in events:
            await service.alarms._post(event)
        assert service.figures()["event_file"] == {}
    assert read_journal(tmp_path / "store").history
    if is_made:
        assert {"run", "report", "status", "figures", "conditions", "stop"} <= counted.keys()
        assert service.supervisor.failures["event_file"] > 0
    else:
        said = (
            "output event_file cannot be made and is left out: build of event_file.EventFilePlugin has failed"
        )
        assert f"{said}: RuntimeError: build is broken (" in caplog.text


def test_what_an_output_has_said_is_over_once_its_table_is_gone(tmp_path: Path) -> None:
    outputs = output_set(parse_machine_file(without_broker(), LAVAL))
    assert outputs.outdated["broker/refused"] == "there is no broker any more"
    assert outputs.outdated["certificate/"] == "it is no longer in use"
    alarms = alarm_service(Identity("lab", "edge-1", "motor"), [], tmp_path, CLOCK, outputs)
    alarms.manager.condition("certificate/ca", Level.ALERT, "it ends soon")
    said = Condition("certificate/ca", Level.NORMAL, "it is no longer in use")
    assert list(alarms._of_outputs()) == [said]


def test_one_that_cannot_be_loaded_is_said_and_one_at_a_table_of_ours_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    info = tmp_path / "more" / "spoilt-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: spoilt\nVersion: 1.0\n")
    points = "gone = no_such_module:Plugin\nalarms = event_file:EventFilePlugin\n"
    (info / "entry_points.txt").write_text(f"[daqsvc.outputs]\n{points}")
    # Undone before the example's own places on the path are: they would come back otherwise.
    with monkeypatch.context() as patch:
        patch.syspath_prepend(str(info.parent))
        registry.forget()
        [problem] = problems_of(f"{MOTOR.read_text()}\n[gone]\npath = 'x'", MOTOR)
        assert problem.message.startswith("the output cannot be loaded from no_such_module:Plugin: ")
        assert problem.remedy == "install the package that brings it again, or remove [gone]"
        assert parse_machine_file(MOTOR.read_text(), MOTOR).alarms
        assert "output alarms is left out: [alarms] is a table of daqsvc itself" in caplog.text


def test_the_documentation_shows_the_example_as_it_is() -> None:
    text = (DOCS / "outputs.md").read_text()
    for name in ("event_file.py", "pyproject.toml"):
        assert (OUTPUT / name).read_text().strip() in text, f"docs/outputs.md has another {name}"
