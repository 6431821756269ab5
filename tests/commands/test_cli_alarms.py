"""``daqsvc alarms`` and what people do with alarms: beside a service that runs, and without one."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from itertools import permutations
from typing import TYPE_CHECKING, Any

import pytest
from support.can_gateway import MACHINE, CanGateway, daqsvc_run
from support.formats import fits
from support.given_codes import had
from support.ports import free_port
from support.waiting import PATIENCE_S, eventually
from support.written_journals import write_journal

from daqsvc import cli
from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import AlarmCommand, CommandOutcome
from daqsvc.control import ControlServer
from daqsvc.outbox.store import Outbox

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping
    from pathlib import Path

pytestmark = pytest.mark.integration
ALARMS = """
[[alarms]]
name = "shaking"
sensor = "accel"
measure = "rms"
alert = 0.5
danger = 5.0
latching = true

[[alarms]]
name = "peak"
sensor = "accel"
measure = "peak"
alert = 20.0
"""
AUDITED = ("outcome", "verb", "alarm", "by", "reason")


async def daqsvc(*arguments: object, env: dict[str, str] | None = None) -> tuple[int, str, str]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "daqsvc"),
        *map(str, arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | (env or {}),
    )
    out, err = await asyncio.wait_for(process.communicate(), 60)
    assert process.returncode is not None
    return process.returncode, out.decode(), err.decode()


async def alarms(store: Path, *arguments: object) -> list[dict[str, Any]]:
    code, out, err = await daqsvc("alarms", "--store", store, "--json", *arguments)
    assert (code, err) == (0, "")
    return [json.loads(line) for line in out.splitlines()]


async def stands(store: Path, alarm: str, state: str) -> dict[str, Any]:
    """Wait until the journal tells that an alarm is in a state; the event that says so."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        told = [one for one in await alarms(store, "--all") if one["alarm"] == alarm]
        if told and told[0]["state"] == state:
            return told[0]
        await asyncio.sleep(0.1)
    pytest.fail(f"{alarm} is never {state}")


def audited(store: Path) -> list[dict[str, Any]]:
    lines = (store / "audit.jsonl").read_text().splitlines()
    return [fits("daqsvc.audit/1", json.loads(line)) for line in lines]


def outcome(out: str) -> dict[str, Any]:
    (line,) = out.splitlines()
    told: dict[str, Any] = json.loads(line)
    return fits("daqsvc ack", told)


@pytest.mark.long
async def test_a_day_in_the_life_of_a_latching_alarm(tmp_path: Path) -> None:
    file, store = tmp_path / "motor.toml", tmp_path / "store"
    async with CanGateway() as gateway:
        gateway.rms_g = 1.0
        text = MACHINE.format(gateway=gateway.port, broker=free_port(), alarms=ALARMS)
        file.write_text(f'{text}\n[store]\ndirectory = "store"\n')
        async with daqsvc_run(file, store):
            await eventually((store / "control.sock").exists, "it takes commands")
            raised = await stands(store, "shaking", "active_unacknowledged")

            # A person looks, and acknowledges by the id that is shown.
            code, out, _ = await daqsvc("alarms", file)
            assert code == 0
            title, *lines = out.splitlines()
            assert title.split() == ["LEVEL", "STATE", "ALARM", "ID", "SINCE", "MESSAGE"]
            (line,) = [line for line in lines if "shaking" in line and "rms of accel" in line]
            level, state, alarm, shown, since, message = re.split(r" {2,}", line)
            assert (level, state, alarm) == ("alert", "active unacknowledged, first out", "shaking")
            assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d \(\d+ s\)", since)
            assert message.startswith("shaking alert: rms of accel is ")
            assert raised["occurrence"].startswith(shown)
            code, out, err = await daqsvc("ack", shown, file, "--by", "Ann", "--reason", "on my way")
            assert (code, out, err) == (0, "shaking: acknowledged\n", "")
            acknowledged = await stands(store, "shaking", "active_acknowledged")
            assert (acknowledged["by"], acknowledged["occurrence"]) == ("Ann", raised["occurrence"])

            # While the machine shakes it cannot be reset: refused with the reason, nothing is changed.
            code, out, err = await daqsvc("reset", "shaking", "--store", store, "--by", "Ann")
            assert (code, out) == (1, "")
            assert err.startswith("daqsvc reset: refused: ")
            assert "condition is still present" in err
            assert err.endswith("[C08]\n")
            had("C08", err)
            assert (await stands(store, "shaking", "active_acknowledged"))["id"] == acknowledged["id"]

            # Shelved, in JSON, and taken back.
            shelve = ("shelve", "shaking", "--store", store, "--for", "8h", "--by", "Bob", "--json")
            code, out, _ = await daqsvc(*shelve)
            shelved = await stands(store, "shaking", "shelved")
            assert code == 0
            assert outcome(out) == {
                "verb": "shelve",
                "alarm": "shaking",
                "machine": None,
                "occurrence": None,
                "by": "Bob",
                "accepted": True,
                "reason": "",
                "code": None,
                "events": [shelved["id"]],
            }
            _, out, _ = await daqsvc("alarms", file)
            assert re.search(r"shelved until \d{4}-\d\d-\d\d \d\d:\d\d:\d\d", out)
            assert (await daqsvc("unshelve", "shaking", file))[0] == 0
            await stands(store, "shaking", "active_acknowledged")

            # The machine is quiet: the alarm stays latched until it is reset.
            gateway.rms_g = 0.1
            await stands(store, "shaking", "latched_acknowledged")
            assert (await daqsvc("reset", "shaking", file, "--by", "Ann"))[0] == 0
            await stands(store, "shaking", "normal")

            # An alarm that was never raised can be bypassed; one that there is not can be nothing.
            assert (await daqsvc("bypass", "peak", file, "--by", "Ann"))[0] == 0
            await stands(store, "peak", "out_of_service")
            code, _, err = await daqsvc("ack", "shakin", file, "--by", "Ann")
            assert code == 1
            assert "no alarm is named 'shakin'; did you mean 'shaking'? There are: alarm-flood, " in err
            assert ", shaking, " in err

        kinds = ["raised", "acknowledged", "shelved", "unshelved", "latched", "reset"]
        assert [
            told["kind"] for told in await alarms(store, "--history", 99) if told["alarm"] == "shaking"
        ] == kinds
        log = audited(store)
        asked, answered = log[::2], log[1::2]
        assert [line["id"] for line in asked] == [line["id"] for line in answered]
        assert {line["outcome"] for line in asked} == {"asked"}
        assert {line["source"].rsplit(" ", 1)[0] for line in log} == {f"local uid {os.getuid()} pid"}
        assert [tuple(line[key] for key in AUDITED) for line in answered][:3] == [
            ("accepted", "acknowledge", "shaking", "Ann", "on my way"),
            ("refused", "reset", "shaking", "Ann", ""),
            ("accepted", "shelve", "shaking", "Bob", ""),
        ]
        assert "condition is still present" in answered[1]["answer"]
        assert answered[0]["events"] == [acknowledged["id"]]
        assert answered[-1]["outcome"] == "refused"

        # The journal tells without the service, too; commands need it, and nobody is left to take them.
        assert not (store / "control.sock").exists()
        (left,) = [told for told in await alarms(store) if told["alarm"] == "peak"]
        assert left["state"] == "out_of_service"
        code, out, err = await daqsvc("unbypass", "peak", file)
        assert (code, out) == (1, "")
        assert "no daqsvc runs on the store" in err
        assert len(err.splitlines()) == 1

        # What was bypassed and acknowledged stays so over a restart.
        async with daqsvc_run(file, store):
            await eventually((store / "control.sock").exists, "it takes commands")
            assert (await daqsvc("unbypass", "peak", file))[0] == 0
            await stands(store, "peak", "normal")


@pytest.mark.long
async def test_a_service_that_was_killed_leaves_a_journal_that_can_be_read(tmp_path: Path) -> None:
    file, store = tmp_path / "motor.toml", tmp_path / "store"
    async with CanGateway() as gateway:
        gateway.rms_g = 1.0
        file.write_text(MACHINE.format(gateway=gateway.port, broker=free_port(), alarms=ALARMS))
        async with daqsvc_run(file, store) as process:
            await eventually((store / "control.sock").exists, "it takes commands")
            raised = await stands(store, "shaking", "active_unacknowledged")
            process.send_signal(signal.SIGKILL)
            await asyncio.to_thread(process.wait, 10)
        assert (await stands(store, "shaking", "active_unacknowledged"))["id"] == raised["id"]
        left = (store / "control.sock").stat().st_ino
        code, _, err = await daqsvc("ack", "shaking", "--store", store)
        assert code == 1
        assert "no daqsvc runs on the store" in err
        async with daqsvc_run(file, store):
            await eventually(
                lambda: (store / "control.sock").stat().st_ino != left, "the socket is made again"
            )
            assert (await daqsvc("ack", raised["occurrence"], "--store", store))[0] == 0


OTHER = {"machine": "pump", "alarm": "rotor-fault", "occurrence": "0d8cffff-0000", "level": "danger"}


async def test_alarms_of_several_machines_stand_in_one_table_the_worst_first(tmp_path: Path) -> None:
    await write_journal(
        tmp_path,
        {"first_out": True},
        {"alarm": "calm", "state": "normal", "level": "normal", "occurrence": None},
        {**OTHER, "message": "stop\x1b[2Jhere", "state": "suppressed"},
    )
    code, out, _ = await daqsvc("alarms", "--store", tmp_path)
    assert code == 0
    title, *lines = out.splitlines()
    assert title.split() == ["LEVEL", "STATE", "MACHINE", "ALARM", "ID", "SINCE", "MESSAGE"]
    assert [line.split()[0] for line in lines] == ["danger", "alert"]
    assert "pump" in lines[0]
    assert "motor" in lines[1]
    assert "active unacknowledged, first out" in lines[1]
    assert "\x1b" not in out, "no message moves the cursor"
    starts = {
        line.index(word)
        for line, word in zip([title, *lines], ("MESSAGE", "stop", "shaking alert"), strict=True)
    }
    assert len(starts) == 1, "columns are aligned"
    assert len((await daqsvc("alarms", "--store", tmp_path, "--all"))[1].splitlines()) == 4


async def test_what_was_done_about_an_alarm_does_not_hide_what_it_is_and_since_when(tmp_path: Path) -> None:
    begun_ns = time.time_ns() - 7200 * 10**9
    done = {"kind": "acknowledged", "state": "active_acknowledged", "message": "shaking acknowledged by ann"}
    await write_journal(
        tmp_path,
        {"wall_ns": begun_ns - 10**15, "occurrence": "an-earlier-one", "message": "long ago"},
        {"wall_ns": begun_ns},
        {"wall_ns": begun_ns, "kind": "escalated", "level": "danger", "message": "shaking danger: 9 g"},
        done | {"level": "danger", "wall_ns": time.time_ns()},
    )
    _, out, _ = await daqsvc("alarms", "--store", tmp_path)
    assert "(2 h)" in out
    assert out.endswith("  shaking danger: 9 g; shaking acknowledged by ann [A17]\n")


@pytest.mark.long
async def test_history_is_newest_last_and_as_long_as_is_asked(tmp_path: Path) -> None:
    events = [{"kind": "raised"}, {"kind": "acknowledged"}, {"kind": "returned", "state": "normal"}]
    await write_journal(tmp_path, *events)
    told = await alarms(tmp_path, "--history", 3)
    assert [one["kind"] for one in told] == ["raised", "acknowledged", "returned"]
    assert [one["kind"] for one in await alarms(tmp_path, "--history", 2)] == ["acknowledged", "returned"]
    _, out, _ = await daqsvc("alarms", "--store", tmp_path, "--history")
    assert [line.split()[2] for line in out.splitlines()] == ["LEVEL", "raised", "acknowledged", "returned"]
    assert await alarms(tmp_path) == []
    assert (await daqsvc("alarms", "--store", tmp_path))[1] == "every alarm is normal\n"


async def test_the_beginning_of_an_id_must_be_one_alarms(tmp_path: Path) -> None:
    await write_journal(tmp_path, {}, OTHER)
    code, _, err = await daqsvc("ack", "0d8c", "--store", tmp_path)
    assert code == 1
    assert "'0d8c' begins the ids of shaking, rotor-fault: write more of the id" in err
    assert err.endswith("[C05]\n")
    had("C05", err)
    code, _, err = await daqsvc("ack", "0d8c1", "--store", tmp_path)
    assert "no daqsvc runs on the store" in err, "that was one, but nobody is there to obey"


@pytest.mark.long
async def test_a_store_that_is_not_there_is_told_with_the_remedy(tmp_path: Path) -> None:
    for verb in (("alarms",), ("ack", "shaking")):
        code, out, err = await daqsvc(*verb, "--store", tmp_path / "none")
        assert (code, out) == (1, "")
        assert err.startswith(f"daqsvc {verb[0]}: there is no journal {tmp_path / 'none'}")
        assert err.endswith("[S04]\n")
        assert len(err.splitlines()) == 1
    bad = tmp_path / "bad.toml"
    bad.write_text("schema_version = 1")
    assert (await daqsvc("alarms", bad))[0] == 2


@pytest.mark.long
async def test_the_store_is_found_as_run_finds_it(tmp_path: Path) -> None:
    state = tmp_path / "state" / "daqsvc"
    xdg = {"XDG_STATE_HOME": str(tmp_path / "state"), "STATE_DIRECTORY": ""}
    code, _, err = await daqsvc("alarms", env=xdg)
    assert code == 1
    assert "there is no alarm journal below" in err
    await write_journal(state / "lab-edge-1-motor", {})
    assert "shaking" in (await daqsvc("alarms", env=xdg))[1]
    await write_journal(state / "lab-edge-1-pump", OTHER)
    code, _, err = await daqsvc("alarms", env=xdg)
    assert code == 1
    assert "(lab-edge-1-motor, lab-edge-1-pump): name the machine file" in err
    file = tmp_path / "motor.toml"
    file.write_text(MACHINE.format(gateway=1, broker=2, alarms=ALARMS))
    assert "shaking" in (await daqsvc("alarms", file, env=xdg))[1]
    systemd = {"STATE_DIRECTORY": f"{state / 'lab-edge-1-pump'}:/elsewhere"}
    assert "rotor-fault" in (await daqsvc("alarms", env=systemd))[1]


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["shelve", "shaking", "--for", "30"], "'30' is not a time; write e.g. 90s, 30m, 8h, 2d or 1h30m"),
        (["shelve", "shaking", "--for", "0s"], "'0s' is not a time"),
        (["shelve", "shaking", "--for", "-5m"], "'-5m' is not a time; write e.g. 90s"),
        (["shelve", "shaking", "--for", "m30"], "'m30' is not a time"),
        (["shelve", "shaking"], "--for"),
        (["ack", "shaking", "--for", "30m"], "--for"),
        (["ack", "shaking", "--by", "ann\x1b[2J"], "is not printable"),
        (
            ["ack", "shaking", "motor.toml", "--store", "here"],
            "not allowed with argument --store; the machine file names the store already: leave out FILE or",
        ),
        (
            ["alarms", "motor.toml", "--store", "here"],
            "not allowed with argument FILE; the machine file names the store already: leave out FILE or",
        ),
        (["alarms", "--history", "0"], "'0' is not a whole number from 1 on"),
        (["ack"], "ID"),
    ],
)
async def test_what_cannot_be_meant_is_never_asked(arguments: list[str], why: str) -> None:
    code, out, err = await daqsvc(*arguments)
    assert (code, out) == (2, "")
    assert why in err


@pytest.mark.parametrize(
    "verb", ["ack", "reset", "shelve", "unshelve", "bypass", "unbypass", "alarms", "status"]
)
def test_the_words_of_a_verb_may_stand_in_any_order(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    root = cli.parser(cli.commands())
    several = verb not in {"alarms", "status"}
    words = ["hot", "plant.toml"] if several else ["plant.toml"]
    options = [["--machine", "pump"], ["--json"], *([["--for", "1h"]] if verb == "shelve" else [])]
    parts = [(0, words[:1]), *((1, words[1:]) for _ in words[1:]), *((2, one) for one in options)]
    for order in permutations(parts):
        line = [word for _, part in order for word in part]
        if [kind for kind, _ in order if kind < 2] != sorted(kind for kind, _ in order if kind < 2):
            continue
        chosen = cli._chosen(root, [verb, *line])
        assert (f"{chosen.file}", chosen.machine) == ("plant.toml", "pump")
        assert getattr(chosen, "alarms", ["hot"]) == ["hot"]
    for wrong, why in (
        ([*words, "--json", "more.toml"], "unrecognized arguments: more.toml"),
        (["--bogus", *words], "unrecognized arguments: --bogus"),
        ([*words[:-1], "--store", "here", "--json", "plant.toml"], "not allowed with argument"),
    ):
        with pytest.raises(SystemExit) as ended:
            cli._chosen(root, [verb, *(["--for", "1h"] if verb == "shelve" else []), *wrong])
        assert ended.value.code == 2
        assert why in capsys.readouterr().err


def test_the_machine_file_may_be_anywhere_behind_the_first_alarm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plant").mkdir()
    root = cli.parser(cli.commands())
    for words, alarms, file in (
        (["hot", "cold"], ["hot", "cold"], None),
        (["hot", "cold", "pump.toml"], ["hot", "cold"], "pump.toml"),
        (["hot", "pump.toml", "--by", "ann", "cold"], ["hot", "cold"], "pump.toml"),
        (["hot", "--by", "ann", "cold", "plant"], ["hot", "cold"], "plant"),
        (["plant"], ["plant"], None),
        (["hot", "/etc/daqsvc/absent"], ["hot"], "/etc/daqsvc/absent"),
        (["sensor-ok/hot", "sensor-ok/*"], ["sensor-ok/hot", "sensor-ok/*"], None),
        (["hot", "x" * 300], ["hot", "x" * 300], None),
    ):
        chosen = cli._chosen(root, ["ack", *words])
        assert (chosen.alarms, chosen.file and f"{chosen.file}") == (alarms, file)


FANS = (
    {"alarm": "fan.a"},
    {"alarm": "fan.b", "state": "active_acknowledged", "occurrence": "1d8c0000-b"},
    {"alarm": "fan.c", "state": "latched_unacknowledged", "occurrence": "2d8c0000-c"},
    {"alarm": "fan.d", "state": "normal", "level": "normal", "occurrence": None},
    {"alarm": "fan.a", "machine": "pump", "occurrence": "3d8c0000-a"},
    {"alarm": "pump", "machine": "pump", "state": "shelved", "occurrence": "4d8c0000-p"},
)


@contextlib.asynccontextmanager
async def taking_commands(store: Path, refused: Mapping[str, str]) -> AsyncIterator[list[AlarmCommand]]:
    """A service on the store that refuses what concerns some alarms; the commands that it has had."""
    commands: list[AlarmCommand] = []

    async def execute(command: AlarmCommand, source: str) -> CommandOutcome:
        commands.append(command)
        if command.alarm in refused:
            return CommandOutcome(accepted=False, reason=refused[command.alarm], code="C08")
        return CommandOutcome(accepted=True, reason="")

    server = ControlServer(store, ("motor", "pump"), execute)
    await server.open()
    try:
        yield commands
    finally:
        await server.close()


async def test_a_pattern_means_what_waits_for_it_of_every_machine(tmp_path: Path) -> None:
    await write_journal(tmp_path, *FANS)
    async with taking_commands(tmp_path, {}) as commands:
        code, out, err = await daqsvc("ack", "fan.*", "--store", tmp_path)
        assert (code, err) == (0, "")
        assert sorted(out.splitlines()) == [
            "fan.a of motor: acknowledged",
            "fan.a of pump: acknowledged",
            "fan.c of motor: acknowledged",
        ]
        assert all(command.occurrence for command in commands), "what comes meanwhile nobody has seen"
        commands.clear()
        code, out, err = await daqsvc("ack", "fan.[ab]", "--store", tmp_path, "--machine", "motor")
        assert (code, out, err) == (0, "fan.a: acknowledged\n", "")
        assert [(one.alarm, one.machine) for one in commands] == [("fan.a", "motor")]


async def test_each_of_several_alarms_is_asked_for_once_and_all_must_go(tmp_path: Path) -> None:
    await write_journal(tmp_path, *FANS)
    refused = {"fan.d": "cannot acknowledge fan.d: there is nothing to acknowledge: it is normal"}
    async with taking_commands(tmp_path, refused) as commands:
        words = ("fan.d", "fan.c", "2d8c", "fan.c", "never-raised")
        code, out, err = await daqsvc("ack", *words, "--store", tmp_path)
        assert code == 1
        assert out == "fan.c: acknowledged\nnever-raised: acknowledged\n"
        assert err == f"daqsvc ack: refused: {refused['fan.d']} [C08]\n"
        assert [(one.alarm, one.occurrence) for one in commands] == [
            ("fan.d", None),
            ("fan.c", None),
            ("never-raised", None),
        ]
        code, out, _ = await daqsvc("ack", "fan.d", "fan.c", "--store", tmp_path, "--json")
        assert code == 1
        assert [(one["alarm"], one["accepted"]) for one in map(json.loads, out.splitlines())] == [
            ("fan.d", False),
            ("fan.c", True),
        ]


async def test_a_pattern_that_means_nothing_names_what_there_is_and_nothing_is_done(tmp_path: Path) -> None:
    await write_journal(tmp_path, *FANS)
    async with taking_commands(tmp_path, {}) as commands:
        code, out, err = await daqsvc("reset", "fan.a", "fan.[ab]", "--store", tmp_path, "--machine", "motor")
        assert (code, out, commands) == (1, "", [])
        assert "no alarm that 'fan.[ab]' matches waits for reset; these are not normal: fan.a (active" in err
        assert "fan.c (latched unacknowledged). A pattern means" in err
        assert err.endswith("[C05]\n")
        assert "fan.d" not in err


async def test_what_is_not_asked_for_as_the_service_has_gone_is_named(tmp_path: Path) -> None:
    await write_journal(tmp_path, *FANS)
    code, out, err = await daqsvc("ack", "fan.a", "fan.c", "pump", "--store", tmp_path)
    assert (code, out) == (1, "")
    assert "no daqsvc runs on the store" in err
    assert err.endswith("; not asked for then: fan.c, pump [C06]\n")


async def test_what_the_disk_has_not_got_is_told(tmp_path: Path) -> None:
    """The journal alone would show an older state as the present one."""
    outbox = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    await outbox.open()
    await outbox.close()

    async def execute(command: AlarmCommand, source: str) -> CommandOutcome:
        return CommandOutcome(accepted=True, reason="done, but the journal cannot be written yet", code="S06")

    server = ControlServer(tmp_path, ("rig",), execute, lambda: 3)
    await server.open()
    try:
        code, _, err = await daqsvc("alarms", "--store", tmp_path)
        assert code == 0
        assert "3 events wait in the service's memory" in err
        assert err.endswith("[S06]\n")
        had("S06", err)
        code, out, _ = await daqsvc("ack", "shaking", "--store", tmp_path)
        assert out.endswith("cannot be written yet [S06]\n")
        assert code == 1, "0 says that it is on disk"
    finally:
        await server.close()


@pytest.mark.parametrize("nothing", ["", "  "])
async def test_an_id_that_names_nothing_is_refused_in_words(tmp_path: Path, nothing: str) -> None:
    code, _, err = await daqsvc("ack", nothing, "--store", tmp_path)
    assert code == 2
    assert f"{nothing!r} names no alarm; write its name, or how its id begins in daqsvc alarms" in err


async def test_the_machine_file_may_stand_in_front_of_the_alarm(tmp_path: Path) -> None:
    file = tmp_path / "motor.toml"
    file.write_text(MACHINE.format(gateway=1, broker=2, alarms=ALARMS))
    xdg = {"XDG_STATE_HOME": str(tmp_path / "state"), "STATE_DIRECTORY": ""}
    state = tmp_path / "state" / "daqsvc"
    await write_journal(state / "lab-edge-1-motor", {})
    await write_journal(state / "lab-edge-1-pump", OTHER)  # without a file it is not known which is meant
    for order in ((file, "shaking"), ("shaking", file)):
        code, _, err = await daqsvc("ack", *order, env=xdg)
        assert code == 1
        assert "no daqsvc runs on the store" in err
        assert "name the machine file" not in err
    code, _, err = await daqsvc("ack", file, env=xdg)
    assert code == 1
    assert f"no alarm is named: write daqsvc ack ALARM {file}; raised so far: shaking" in err


async def test_a_machine_file_and_a_store_exclude_each_other(tmp_path: Path) -> None:
    code, _, err = await daqsvc("ack", "rotor-fault", "machine.toml", "--store", tmp_path)
    assert code == 2
    assert "not allowed with argument" in err
