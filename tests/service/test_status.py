"""``daqsvc status``: what the service says of itself, and how a person and a program read it."""

from __future__ import annotations

import asyncio
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import jsonschema
import numpy as np
import pytest
from support.can_gateway import MACHINE, CanGateway, daqsvc_run
from support.live_service import play, running
from support.machine_files import LAVAL
from support.paths import ROOT
from support.ports import LOOPBACK, free_port
from support.waiting import PATIENCE_S, eventually

from daqsvc import status_report
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.states import Level
from daqsvc.cli import main
from daqsvc.commands import status as verb
from daqsvc.commands.status_text import status_text
from daqsvc.control import AbsentError, ControlError, ControlServer, ask_status
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.service_status import ServiceStatusPayload
from daqsvc.settings import parse_machine_file

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from daqsvc.settings import MachineFile

pytestmark = pytest.mark.integration
SCHEMA = json.loads((ROOT / "docs" / "schemas" / "daqsvc.service-status-1.json").read_text())
ENTER, LEAVE, HOME = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l", "\x1b[H"


def rig(**mqtt: int) -> MachineFile:
    text = (
        LAVAL.read_text().replace('interface = "socketcan"', 'interface = "virtual"').partition("[mqtt]")[0]
    )
    if mqtt:
        text += f'\n[mqtt]\nurl = "mqtt://127.0.0.1:{mqtt["port"]}"\ninsecure = true\n'
    return parse_machine_file(text, LAVAL)


async def told(store: Path) -> dict[str, Any]:
    """The answer of the service on a store, which is as it is documented."""
    [answer] = await asyncio.to_thread(ask_status, store)
    jsonschema.validate(answer, SCHEMA)
    payload = ServiceStatusPayload.model_validate_json(json.dumps(answer))
    assert json.loads(payload.model_dump_json(by_alias=True)).keys() == answer.keys()
    return answer


async def told_when(store: Path, holds: Callable[[dict[str, Any]], object], what: str) -> dict[str, Any]:
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        if holds(status := await told(store)):
            return status
        await asyncio.sleep(0.05)
    pytest.fail(f"it never says that {what}: {status}")


def channel(status: dict[str, Any], sensor: str) -> dict[str, Any]:
    (one,) = [one for one in status["channels"] if one["sensor"] == sensor]
    return one  # type: ignore[no-any-return]


def statement(**fields: Any) -> Diagnosis:
    return Diagnosis(
        machine="laval-rig",
        detector="levels/probe-x",
        stream="shaft",
        first_index=0,
        end_index=10,
        decision="normal",
        sensors=("probe-x",),
        **fields,
    )


async def test_newest_samples_and_statements_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daqsvc.status_report.FRESH_S", -1.0)
    async with running(rig(), tmp_path / "store") as service:
        now_ns = service.clock.monotonic_ns()
        samples = np.array([[1.0, 2.0, -10.0], [43.5, np.nan, -10.0]], np.float32)
        service._deliver(SampleBlock("shaft", 0, samples, now_ns, NS_PER_S / 640.0))
        service._report(statement(t_ns=now_ns, statistics={"rms": np.float32(7.5)}, units={"rms": "um"}))
        status = await told(tmp_path / "store")
        assert [(one["sensor"], one["value"], one["state"]) for one in status["channels"]] == [
            ("probe-x", 43.5, "ok"),
            ("probe-y", None, "unknown"),
            ("keyphasor", -10.0, "unknown"),
        ]
        assert status["outputs"] == {}
        assert re.search(r"probe-x +ok +43\.5 um +\d\.\d s +rms 7\.5 um\n", status_text(status))
        assert "broker: none is configured" in status_text(status)

        service._report(statement(t_ns=now_ns, quality="not_ok", reason="the probe touches"))
        status = await told(tmp_path / "store")
        assert channel(status, "probe-x")["state"] == "not_ok"
        assert status["alarms"]["by_state"]["active_unacknowledged"] == 1
        text = " ".join(status_text(status, 60).split())
        assert "probe-x NOT OK" in text
        assert "ago) [the probe touches]" in text
        assert "alert active unacknowledged sensor-ok/probe-x" in text


@pytest.mark.parametrize("losses", ["counted", "estimated"])
async def test_losses_that_nothing_counts_are_told_as_an_estimate(tmp_path: Path, losses: str) -> None:
    text = LAVAL.read_text().partition("[mqtt]")[0]
    counter = 'counter = { byte = 0, bits = 16, counts = "samples" }'
    assert counter in text
    if losses == "estimated":
        text = text.replace(counter, "no_counter = true")
    machine = parse_machine_file(text.replace('interface = "socketcan"', 'interface = "virtual"'), LAVAL)
    async with running(machine, tmp_path / "store") as service:
        block = np.ones((8, 3), np.float32)
        service._deliver(SampleBlock("shaft", 0, block, service.clock.monotonic_ns(), NS_PER_S / 640.0))
        status = await told(tmp_path / "store")
    assert status["streams"]["shaft"]["losses"] == losses
    stream = status["streams"]["shaft"] | {"samples_received": 990, "samples_lost": 10}
    shown = {"counted": "10 of 1,000 samples (1 %)", "estimated": "10 of 1,000 samples (1 %, estimated)"}
    assert shown[losses] in status_text(status | {"streams": {"shaft": stream}}, 200)


async def test_until_when_an_alarm_is_shelved_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("daqsvc.status_report.FRESH_S", -1.0)
    async with running(rig(), tmp_path / "store") as service:
        shelve = AlarmCommand(verb=Verb.SHELVE, alarm="rotor-fault", by="ann", duration_s=3600.0)
        before_ns = service.clock.wall_ns()
        assert (await service.alarms.execute(shelve, "test")).accepted
        status = await told(tmp_path / "store")
        [alarm] = status["alarms"]["standing"]
        assert (alarm["alarm"], alarm["state"]) == ("rotor-fault", "shelved")
        until_ns = alarm["shelved_until_wall_ns"]
        assert 3600 * NS_PER_S <= until_ns - before_ns <= (3600 + PATIENCE_S) * NS_PER_S
        shown = datetime.fromtimestamp(until_ns // NS_PER_S, UTC).astimezone()
        assert f"shelved until {shown:%Y-%m-%d %H:%M:%S}  rotor-fault" in status_text(status, 80)
        titles = r"LEVEL +STATE +ALARM +CHANGED\n.* rotor-fault +\d+\.\d s ago\n"
        assert re.search(titles, status_text(status, 80))
        del alarm["shelved_until_wall_ns"]
        assert "shelved  rotor-fault" in status_text(status, 80), "of a service of an earlier version"

        unshelve = AlarmCommand(verb=Verb.UNSHELVE, alarm="rotor-fault", by="ann")
        assert (await service.alarms.execute(unshelve, "test")).accepted
        service.alarms.manager.condition("store/disk", Level.ALERT, "x")
        [disk] = (await told(tmp_path / "store"))["alarms"]["standing"]
        assert disk["shelved_until_wall_ns"] is None


async def test_no_alarm_is_missing_beside_the_statement_that_raises_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(rig(), tmp_path / "store") as service:
        by_turns, asked = status_report._by_turns, iter(range(9))

        async def interrupted(items: Any) -> AsyncIterator[Any]:
            async for one in by_turns(items):
                yield one
            if next(asked) == 1:  # when the alarms have been looked at
                now_ns = service.clock.monotonic_ns()
                service._report(statement(t_ns=now_ns, quality="not_ok", reason="the probe touches"))

        monkeypatch.setattr(status_report, "_by_turns", interrupted)
        status = await told(tmp_path / "store")
        assert next(asked) == 2
        is_not_ok = channel(status, "probe-x")["state"] == "not_ok"
        assert is_not_ok == bool(status["alarms"]["standing"])


@pytest.mark.long
async def test_the_newest_sample_is_the_last_that_the_figures_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(rig(), tmp_path / "store") as service:
        first_ns, period_ns = service.clock.monotonic_ns(), NS_PER_S / 640.0

        def comes(index: int) -> None:
            samples = np.full((1, 3), 10.0 + index, np.float32)
            t_ns = first_ns + round(index * period_ns)
            service._deliver(SampleBlock("shaft", index, samples, t_ns, period_ns))

        async def slow() -> None:
            comes(1)

        comes(0)
        monkeypatch.setattr(service.alarms.outbox, "oldest_wall_ns", slow)
        status = await told(tmp_path / "store")
        assert service.figures()["streams"]["shaft"]["end_index"] == 2
        assert status["figures"]["streams"]["shaft"]["end_index"] == 1
        assert channel(status, "probe-x")["value"] == 10.0


@pytest.mark.long
async def test_all_is_told_that_the_service_knows(tmp_path: Path) -> None:
    broker, store = free_port(), tmp_path / "store"
    async with running(rig(port=broker), store) as service:
        before = await told(store)
        assert {one["state"] for one in before["channels"]} == {"unknown"}
        assert {one["value"] for one in before["channels"]} == {None}
        assert before["streams"]["shaft"]["rate_hz"] is None

        t_s = np.arange(6400) / 640.0
        x, y = 10.0 * np.cos(20.0 * np.pi * t_s), 10.0 * np.sin(20.0 * np.pi * t_s)
        keyphasor = np.where(np.cos(20.0 * np.pi * t_s) > 0.98, -3.0, -10.0)
        samples = np.column_stack((x, y, keyphasor)).astype(np.float32)
        playing = asyncio.create_task(play(service, samples, 640.0))
        status = await told_when(store, lambda now: now["streams"]["shaft"]["rate_hz"], "its rate is known")
        assert channel(status, "probe-x")["state"] == "ok"
        playing.cancel()

        bus, stream, probe = status["buses"]["can0"], status["streams"]["shaft"], channel(status, "probe-x")
        assert (bus["driver"], bus["state"], bus["reason"]) == ("can", "up", "")
        assert stream["configured_rate_hz"] == 640.0
        assert stream["rate_hz"] == pytest.approx(640.0, rel=0.05)
        assert stream["samples_received"] > 600
        assert (probe["unit"], abs(probe["value"]) <= 10.1, probe["age_s"] < PATIENCE_S) == ("um", True, True)
        (levels,) = [one for one in status["statements"] if one["detector"] == "levels/probe-x"]
        assert levels["measures"]["rms"]["unit"] == "um"
        assert levels["measures"]["rms"]["value"] == pytest.approx(10.0 / np.sqrt(2.0), rel=0.02)
        assert levels["quality"] == "good"
        away = f"{LOOPBACK}:{broker}: nothing listens there"
        status = await told_when(
            store, lambda now: now["outputs"]["mqtt"]["reason"], "why the broker is away"
        )
        away_s = status["outputs"]["mqtt"].pop("away_s")
        assert status["outputs"] == {"mqtt": {"connected": False, "reason": away, "code": "O09"}}
        later = await told_when(
            store, lambda now: now["outputs"]["mqtt"]["away_s"] > away_s + 0.3, "it is away for longer"
        )
        assert later["outputs"]["mqtt"]["reason"] == away, "also if it was tried again meanwhile"

        # Then the bus goes with a reason that no terminal should be given, an alarm stands, frames were lost.
        driver = service.drivers[0]
        driver.link.down("cable \x1b[2J\udcff\ngone")
        driver.counters.frames_unknown += 3
        # At first some samples of its window are there, on a busy computer.
        status = await told_when(
            store, lambda now: "no samples" in channel(now, "probe-x")["reason"], "nothing comes"
        )
        assert status["buses"]["can0"]["reason"] == "cable \x1b[2J?\ngone"
        assert status["streams"]["shaft"]["rate_hz"] is None
        assert channel(status, "probe-x")["state"] == "missing"
        assert "no samples of stream 'shaft'" in channel(status, "probe-x")["reason"]
        (levels,) = [one for one in status["statements"] if one["detector"] == "levels/probe-x"]
        assert levels["measures"]["rms"]["value"] == pytest.approx(10.0 / np.sqrt(2.0), rel=0.02), "held"
        assert levels["measures_age_s"] > levels["age_s"]
        assert status["faults"]["buses"]["can0"] == {"losses": 1, "frames_unknown": 3}
        (lost,) = [one for one in status["alarms"]["standing"] if one["alarm"] == "sensor-ok/probe-x"]
        assert (lost["state"], lost["level"]) == ("active_unacknowledged", "alert")
        assert status["alarms"]["by_state"]["active_unacknowledged"] >= 2
        status = await told_when(store, lambda now: now["outbox"]["depth"], "events wait")
        assert status["outbox"]["oldest_age_s"] < PATIENCE_S

        live = status_text(status, 80, alarms_first=True).splitlines()
        assert live[2].startswith("alarms: "), "what matters most is on any screen"
        assert live.index(next(row for row in live if row.startswith("BUS"))) > live.index(
            next(row for row in live if row.startswith("broker: "))
        )
        text = status_text(status, 80)
        assert sorted(live) == sorted(text.splitlines())
        assert max(map(len, text.splitlines())) <= 80
        assert all(letter.isprintable() or letter == "\n" for letter in text)
        words = " ".join(text.split())
        for said in (
            "can0 can down cable",
            "probe-x missing",
            "- of 640",
            "can0 3",
            f" s ({away} [O09])",
            "alert active unacknowledged sensor-ok/probe-x",
            "for the broker, the oldest for",
        ):
            assert said in words, text
        assert re.search(r"broker: NOT CONNECTED for \d+\.\d s \(", words), text
        assert re.search(r"probe-x +missing.* rms 7\.\d+ um", text), text


async def test_who_asks_at_the_same_time_gets_one_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running(rig(), tmp_path / "store") as service:
        [report] = service.reports.values()
        asked, figures = [0], report._figures

        def counted() -> dict[str, Any]:
            asked[0] += 1
            return figures()

        monkeypatch.setattr(report, "_figures", counted)
        monkeypatch.setattr("daqsvc.status_report.FRESH_S", 3600.0)
        answers = await asyncio.gather(*(asyncio.to_thread(ask_status, tmp_path / "store") for _ in range(8)))
        assert asked == [1]
        assert all(answer == answers[0] for answer in answers)


async def test_a_disk_that_hangs_holds_up_no_status(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daqsvc.status_report.OLDEST_S", 0.05)
    async with running(rig(), tmp_path / "store") as service:
        service.alarms.manager.condition("store/disk", Level.ALERT, "x")
        await eventually(lambda: service.alarms.outbox.counters.depth, "the alarm is stored")
        monkeypatch.setattr(service.alarms.outbox, "pending", lambda *_: asyncio.sleep(3600.0))
        status = await told(tmp_path / "store")
        assert status["outbox"]["depth"] >= 1
        assert status["outbox"]["oldest_age_s"] is None


def test_without_a_service_one_sentence_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["status", "--store", str(tmp_path)]) == 1
    assert main(["status", "--watch", "--store", str(tmp_path)]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first == second
    assert first.startswith(
        f"daqsvc status: no daqsvc runs on the store {tmp_path}: start it with daqsvc run"
    )


@pytest.mark.parametrize(
    ("answer", "error", "words"),
    [
        (None, ControlError, "is of an older version, which does not report its status: restart it"),
        (b"nonsense\n", AbsentError, "without an answer"),
        (b"[1]\n", AbsentError, "without an answer"),
    ],
)
async def test_an_answer_that_is_no_status_is_said(
    tmp_path: Path, answer: bytes | None, error: type[Exception], words: str
) -> None:
    async def status(_: str | None) -> bytes:
        assert answer is not None
        return answer

    server = ControlServer(tmp_path, ("rig",), lambda *_: None, status=status if answer else None)  # type: ignore[arg-type,return-value]
    await server.open()
    try:
        with pytest.raises(error, match=words):
            await asyncio.to_thread(ask_status, tmp_path)
    finally:
        await server.close()


class Terminal:
    """Where a picture is drawn."""

    encoding = "utf-8"

    def __init__(self, *, is_live: bool) -> None:
        self.text, self._is_live = "", is_live

    def isatty(self) -> bool:
        return self._is_live

    def write(self, text: str) -> None:
        self.text += text

    def flush(self) -> None:
        pass


def watched(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    *answers: object,
    is_live: bool = True,
    arguments: str = "",
) -> tuple[int, str]:
    """The exit code and what was written while these answers came; then Ctrl-C."""
    coming = iter(answers)

    def ask(_: Path, _machine: str | None) -> list[dict[str, Any]]:
        answer = next(coming, None)
        if answer is None:
            raise KeyboardInterrupt
        if isinstance(answer, Exception):
            raise answer
        assert isinstance(answer, dict)
        return [answer]

    terminal = Terminal(is_live=is_live)
    monkeypatch.setattr("daqsvc.control.ask_status", ask)
    monkeypatch.setattr("daqsvc.commands.status_text.status_text", lambda status, _width, **_: status["text"])
    monkeypatch.setattr(verb, "EVERY_S", 0.0)
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "20")
    monkeypatch.setenv("LINES", "4")
    return main(["status", "--watch", *arguments.split(), "--store", str(tmp_path)]), terminal.text


def test_a_live_view_is_drawn_over_itself_and_outlives_the_service(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first, second = {"text": "one\ntwo"}, {"text": "\n".join(f"line {n} {'x' * 30}" for n in range(9))}
    away = AbsentError("it is away")
    code, text = watched(monkeypatch, tmp_path, first, away, away, second)
    assert code == 0
    assert text.startswith(ENTER)
    assert text.endswith(LEAVE)
    assert "\x1b[2J" not in text, "a screen that is cleared flickers"
    pictures = text.removeprefix(ENTER).removesuffix(LEAVE).split(HOME)[1:]
    assert pictures[0] == "one\x1b[K\ntwo\x1b[K\x1b[J"
    assert pictures[1] == pictures[2]
    assert pictures[1].startswith("it is away; it is\x1b[K\nasked again every\x1b[K\n")
    lines = pictures[3].removesuffix("\x1b[K\x1b[J").split("\x1b[K\n")
    assert lines == [
        "line 0 xxxxxxxxxxxxx",
        "line 1 xxxxxxxxxxxxx",
        "line 2 xxxxxxxxxxxxx",
        "... and 6 more lines",
    ]


def test_in_a_pipe_each_status_follows_the_last(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    away = AbsentError("it is away")
    answers = [{"text": "one"}, away, away, {"text": "two"}]
    assert watched(monkeypatch, tmp_path, *answers, is_live=False) == (0, "one\n\ntwo\n\n")
    assert capsys.readouterr().err == "daqsvc status: it is away; it is asked again every second [C06]\n"
    _, text = watched(monkeypatch, tmp_path, *answers, arguments="--json")
    assert [json.loads(line) for line in text.splitlines()] == [{"text": "one"}, {"text": "two"}]


def test_who_may_not_ask_any_more_is_not_kept_waiting(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    code, text = watched(monkeypatch, tmp_path, {"text": "one"}, ControlError("not yours"))
    assert code == 1
    assert text.endswith(LEAVE)


@pytest.mark.long
async def test_a_live_view_in_a_terminal_over_a_kill_of_the_service(tmp_path: Path) -> None:
    file, store = tmp_path / "motor.toml", tmp_path / "store"
    command = [sys.executable, "-m", "daqsvc", "status", "--watch", str(file)]
    async with CanGateway() as gateway:
        text = MACHINE.format(gateway=gateway.port, broker=free_port(), alarms="")
        file.write_text(f'{text}\n[store]\ndirectory = "store"\n')
        master, slave = pty.openpty()
        screen = b""

        def shown(words: str) -> bool:
            nonlocal screen
            while select.select([master], [], [], 0)[0]:
                screen += os.read(master, 65536)
            return words.encode() in screen

        try:
            async with daqsvc_run(file, store) as service:
                await eventually((store / "control.sock").exists, "it takes questions")
                view = subprocess.Popen(command, stdin=slave, stdout=slave, stderr=slave)  # noqa: ASYNC220
                await eventually(lambda: shown("accel"), "the sensor is shown")
                service.kill()
                await eventually(lambda: shown("no daqsvc runs on the store"), "the loss is said")
            screen = b""
            async with daqsvc_run(file, store):
                await eventually(lambda: shown("can0"), "the new service is shown")
                view.send_signal(signal.SIGINT)
                assert await asyncio.to_thread(view.wait, PATIENCE_S) == 0
                assert shown(LEAVE)
        finally:
            os.close(master)
            os.close(slave)
