"""The desk obeys: written down first, then done, then on disk, then answered; refusals change nothing."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import time
from collections import Counter
from typing import TYPE_CHECKING, Any

import pytest
from support.alarm_desk import alarm_service as service_of
from support.brokers import Consumer, running_mosquitto
from support.can_gateway import MACHINE, CanGateway
from support.live_service import running
from support.mqtt_publishing import mqtt, outputs
from support.waiting import eventually

from daqsvc import alarm_commands, audit
from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.commands import AlarmCommand, CommandOutcome, Verb
from daqsvc.alarms.events import Identity
from daqsvc.alarms.rules import DiagnosisRule
from daqsvc.alarms.states import AlarmState
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.journal import Journal
from daqsvc.publish.mqtt.conditions import NS_PER_DAY
from daqsvc.publish.mqtt.publisher import MqttPublisher
from daqsvc.settings import parse_machine_file

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.alarm_service import AlarmService
    from daqsvc.publish.output import OutputSet

pytestmark = pytest.mark.integration
RUB = "rub"
OTHERS = ("one", "two", "three")
ACK = AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm=RUB, by="ann")


@contextlib.asynccontextmanager
async def desk_in(
    store: Path, clock: DrivenClock | None = None, asked: OutputSet | None = None
) -> AsyncIterator[AlarmService]:
    """A desk with latching alarms on what detectors of the same names find."""
    rules = [DiagnosisRule(name, name, latching=True) for name in (RUB, *OTHERS)]
    desk = service_of(Identity("lab", "edge-1", "pump"), rules, store, clock or DrivenClock(), asked)
    await desk.open()
    try:
        await desk.resume({})
        yield desk
    finally:
        await desk.settle(2.0)
        await desk.close(2.0)


def find(desk: AlarmService, severity: str, alarm: str = RUB) -> None:
    t_ns = desk._clock.monotonic_ns()
    desk.take(Diagnosis("pump", alarm, t_ns, "shaft", 0, 1, severity, severity=severity))  # type: ignore[arg-type]


def state(desk: AlarmService, alarm: str = RUB) -> AlarmState:
    return desk.manager.alarms[alarm].state


def log(store: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (store / "audit.jsonl").read_text().splitlines()]


async def kinds(desk: AlarmService) -> list[str]:
    return [json.loads(message.payload)["kind"] for message in await desk.outbox.pending(0, 1000)]


async def test_a_command_is_in_the_log_before_it_is_obeyed_and_on_disk_before_it_is_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[str, AlarmState, str]] = []
    write = audit._append_durably
    async with desk_in(tmp_path) as desk:
        find(desk, "alert")

        def look(path: Path, line: bytes) -> None:
            outcome = json.loads(line)["outcome"]
            seen.append((outcome, state(desk), str(desk.outbox.counters.appended)))
            write(path, line)

        monkeypatch.setattr(audit, "_append_durably", look)
        await eventually(lambda: desk.outbox.counters.appended == 1, "the raising is on disk")
        outcome = await desk.execute(ACK, "test")
        (message,) = [m for m in await desk.outbox.pending(0, 9) if b'"acknowledged"' in m.payload]
    assert seen == [
        ("asked", AlarmState.ACTIVE_UNACKNOWLEDGED, "1"),
        ("accepted", AlarmState.ACTIVE_ACKNOWLEDGED, "2"),
    ]
    assert outcome == CommandOutcome(accepted=True, events=(json.loads(message.payload)["id"],))
    assert json.loads(message.payload)["id"] == outcome.events[0]


@pytest.mark.parametrize(
    ("command", "why"),
    [
        (AlarmCommand(verb=Verb.RESET, alarm=RUB, by="ann"), "condition is still present"),
        (AlarmCommand(verb=Verb.RESET, alarm="one", by="ann"), "cannot reset one: "),
        (
            AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm="none", by="ann"),
            "no alarm is named 'none'; did you mean 'one'? There are: one, ",
        ),
        (
            AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm=RUB, by="ann", occurrence="0d8c"),
            "occurrence 0d8c is over",
        ),
        (AlarmCommand(verb=Verb.SHELVE, alarm=RUB, by="ann"), "state a time"),
        (AlarmCommand(verb=Verb.SHELVE, alarm=RUB, by="ann", duration_s=float("nan")), "state a time"),
        (AlarmCommand(verb=Verb.SHELVE, alarm=RUB, by="ann", duration_s=1e9), "state a time"),
        (AlarmCommand(verb=Verb.UNSHELVE, alarm=RUB, by="ann"), "not shelved"),
        (AlarmCommand(verb=Verb.UNBYPASS, alarm=RUB, by="ann"), "not out of service"),
    ],
)
async def test_what_cannot_be_done_is_refused_counted_logged_and_changes_nothing(
    command: AlarmCommand, why: str, tmp_path: Path
) -> None:
    async with desk_in(tmp_path) as desk:
        find(desk, "danger")
        before = dict(desk.manager.alarms)
        outcome = await desk.execute(command, "test")
        assert dict(desk.manager.alarms) == before
        assert await kinds(desk) == ["raised"]
        assert (desk.commands.accepted, desk.commands.refused) == (0, 1)
    assert not outcome.accepted
    assert outcome.events == ()
    assert why in outcome.reason
    assert outcome.code == ("C05" if "no alarm is named" in why else "C08")
    asked, answered = log(tmp_path)
    assert (asked["outcome"], answered["outcome"]) == ("asked", "refused")
    assert answered["answer"] == outcome.reason


async def test_a_command_that_cannot_be_written_down_is_not_obeyed(tmp_path: Path) -> None:
    (tmp_path / "audit.jsonl").mkdir()
    async with desk_in(tmp_path, DrivenClock()) as desk:
        find(desk, "alert")
        outcome = await desk.execute(ACK, "test")
        assert not outcome.accepted
        assert "audit.jsonl cannot be written" in outcome.reason
        assert outcome.code == "S08"
        assert state(desk) is AlarmState.ACTIVE_UNACKNOWLEDGED
        assert await kinds(desk) == ["raised"]
        assert (desk.commands.refused, desk.commands.unwritten) == (1, 1)
        desk.tick()
        assert state(desk, "store/audit-log") is AlarmState.ACTIVE_UNACKNOWLEDGED


@pytest.mark.gives("S08")
async def test_a_command_whose_outcome_cannot_be_written_down_has_been_obeyed_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = audit._append_durably

    def full(path: Path, line: bytes) -> None:
        if json.loads(line)["outcome"] != "asked":
            raise OSError(28, os.strerror(28))
        write(path, line)

    monkeypatch.setattr(audit, "_append_durably", full)
    async with desk_in(tmp_path) as desk:
        find(desk, "alert")
        assert (await desk.execute(ACK, "test")).accepted
        assert state(desk) is AlarmState.ACTIVE_ACKNOWLEDGED
        assert desk.commands.unanswered_in_log == 1
    assert [line["outcome"] for line in log(tmp_path)] == ["asked"]


async def test_an_event_that_the_disk_does_not_take_is_not_called_committed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(alarm_commands, "COMMIT_S", 0.2)
    async with desk_in(tmp_path) as desk:
        find(desk, "alert")
        await eventually(lambda: desk.outbox.counters.waiting == 0, "it is on disk")
        write = Journal.write

        def full(*_: object) -> None:
            raise OSError(28, os.strerror(28))

        monkeypatch.setattr(Journal, "write", full)
        outcome = await desk.execute(ACK, "test")
        assert outcome.accepted
        assert outcome.events == ()
        assert outcome.reason.startswith("done, but the journal cannot be written yet")
        assert outcome.code == "S06"
        desk.tick()
        assert state(desk, "store/journal").is_active
        monkeypatch.setattr(Journal, "write", write)
        await eventually(lambda: desk.outbox.counters.waiting == 0, "the disk takes it")
        assert await kinds(desk) == ["raised", "acknowledged", "raised"], (
            "in the order in which they came about"
        )
        desk.tick()
        assert not state(desk, "store/journal").is_active


async def test_commands_are_obeyed_one_after_the_other_in_the_order_they_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = audit._append_durably

    def slowly(path: Path, line: bytes) -> None:
        time.sleep(0.01)
        write(path, line)

    monkeypatch.setattr(audit, "_append_durably", slowly)
    async with desk_in(tmp_path) as desk:
        for name in OTHERS:
            find(desk, "alert", name)
        commands = [AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm=name, by="ann") for name in OTHERS]
        outcomes = await asyncio.gather(*(desk.execute(command, "test") for command in commands))
        assert all(outcome.accepted for outcome in outcomes)
        assert list(outcomes) == sorted(outcomes, key=lambda outcome: outcome.events)
    assert [line["alarm"] for line in log(tmp_path)] == [name for name in OTHERS for _ in range(2)]


async def test_a_flood_of_refused_commands_is_summed_up_and_hides_nothing_that_was_obeyed(
    tmp_path: Path,
) -> None:
    obeyed = []
    async with desk_in(tmp_path) as desk:
        for number in range(600):
            if number % 50 == 0:
                find(desk, "danger" if number % 100 else "alert", OTHERS[number % 3])
                command = AlarmCommand(verb=Verb.SHELVE, alarm=RUB, by="ann", duration_s=60.0)
                assert (await desk.execute(command, "local")).accepted
                obeyed.append(number)
            refused = await desk.execute(
                AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm="nobody", by="mallory", reason="x" * 500), "mqtt t"
            )
            assert "no alarm is named 'nobody'" in refused.reason
            assert refused.code == "C05"
        assert (desk.commands.accepted, desk.commands.refused) == (len(obeyed), 600)
        assert desk.manager.counters.events == len(await kinds(desk))
    told = log(tmp_path)
    by_outcome = Counter(line["outcome"] for line in told)
    assert by_outcome["accepted"] == len(obeyed)
    assert by_outcome["asked"] == by_outcome["accepted"] + by_outcome["refused"]
    assert by_outcome["refused"] == audit.REFUSED_IN_FULL
    many = [line for line in told if line["outcome"] == "refused_many"]
    assert sum(line["count"] for line in many) == 600 - audit.REFUSED_IN_FULL
    assert many[-1]["sources"] == {"mqtt t": many[-1]["count"]}
    assert (tmp_path / "audit.jsonl").stat().st_size < 100_000


async def test_more_commands_than_can_wait_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(alarm_commands, "MOST_COMMANDS", 2)
    async with desk_in(tmp_path) as desk:
        outcomes = await asyncio.gather(*(desk.execute(ACK, "test") for _ in range(5)))
        assert sum("wait for the disk already" in outcome.reason for outcome in outcomes) == 3
        assert [outcome.code for outcome in outcomes].count("C07") == 3
        assert desk.commands.refused == 5
    assert len(log(tmp_path)) == 4


async def test_a_command_is_carried_out_to_its_end_although_nobody_waits_any_more(tmp_path: Path) -> None:
    async with desk_in(tmp_path) as desk:
        find(desk, "alert")
        asking = asyncio.create_task(desk.execute(ACK, "test"))
        await asyncio.sleep(0)
        asking.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asking
        await desk.settle(5.0)
        assert await kinds(desk) == ["raised", "acknowledged"]
        late = await desk.execute(ACK, "test")
        assert late.reason == "the service is stopping; ask again when it runs"
        assert late.code == "C07"
    assert [line["outcome"] for line in log(tmp_path)] == ["asked", "accepted"]


async def test_shelving_ends_by_itself_and_survives_a_restart(tmp_path: Path) -> None:
    clock = DrivenClock()
    shelve = AlarmCommand(verb=Verb.SHELVE, alarm=RUB, by="ann", duration_s=10.0)
    async with desk_in(tmp_path, clock) as desk:
        find(desk, "alert")
        assert (await desk.execute(shelve, "test")).accepted
        assert desk.figures()["shelved"] == 1
        clock.advance_to(clock.monotonic_ns() + 4 * 10**9)
    async with desk_in(tmp_path, clock) as desk:
        assert state(desk) is AlarmState.SHELVED
        keeping_time = asyncio.create_task(desk.keep_time())
        for _ in range(7):
            await asyncio.sleep(0.02)
            clock.advance_to(clock.monotonic_ns() + 10**9)
        await eventually(lambda: state(desk) is AlarmState.ACTIVE_UNACKNOWLEDGED, "it is over")
        keeping_time.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await keeping_time
        await desk.settle(5.0)
        assert await kinds(desk) == ["raised", "shelved", "unshelved"]


@pytest.mark.gives("O23")
async def test_a_certificate_that_ends_soon_is_an_alarm_until_it_is_renewed(tmp_path: Path) -> None:
    clock = DrivenClock()
    async with desk_in(tmp_path, clock, outputs(mqtt(8883, "box", "localhost", tls=True))) as desk:
        publisher = desk.outputs["mqtt"]
        assert isinstance(publisher, MqttPublisher)
        publisher._expiry["client"] = clock.wall_ns() + 13 * NS_PER_DAY
        for _ in range(3):
            desk.tick()
        assert state(desk, "certificate/client") is AlarmState.ACTIVE_UNACKNOWLEDGED
        acknowledge = AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm="certificate/client", by="ann")
        assert (await desk.execute(acknowledge, "test")).accepted
        publisher._expiry["client"] += 90 * NS_PER_DAY
        desk.tick()
        assert state(desk, "certificate/client") is AlarmState.NORMAL
        await desk.settle(5.0)
        assert await kinds(desk) == ["raised", "acknowledged", "returned"]


ALARMS = """
[[alarms]]
name = "shaking"
sensor = "accel"
measure = "rms"
alert = 0.5
latching = true
"""

ALLOWED = """
[mqtt.commands]
enabled = true
allow = ["acknowledge", "reset", "shelve"]

[alarm_handling]
shelve_at_most_s = 60
"""


@pytest.mark.mosquitto
async def test_commands_over_mqtt_reach_the_alarms_and_the_audit_log(tmp_path: Path) -> None:
    with running_mosquitto(tmp_path) as broker:
        async with CanGateway() as gateway, Consumer(broker.port) as consumer:
            gateway.rms_g = 1.0
            text = MACHINE.format(gateway=gateway.port, broker=broker.port, alarms=ALARMS) + ALLOWED
            machine = parse_machine_file(text, tmp_path / "motor.toml")
            base = "daqsvc/lab/edge-1/motor/commands"

            async def ask(verb: str, alarm: str, identifier: str, **keys: Any) -> dict[str, Any]:
                issued = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
                told = {"schema": "daqsvc.command/1", "id": identifier, "alarm": alarm, "by": "ann"}
                payload = json.dumps(told | {"issued_at": issued} | keys)
                consumer._client.publish(f"{base}/{verb}", payload, qos=1)

                def answers() -> list[dict[str, Any]]:
                    heard = [m.payload for m in consumer.on(f"/commands/{verb}/response")]
                    return [answer for answer in heard if answer["id"] == identifier]

                await eventually(answers, "it is answered")
                return answers()[0]

            async with running(machine, tmp_path / "store") as service:
                await eventually(lambda: consumer.on("/alarms/shaking"), "the alarm is raised")
                reset = await ask("reset", "shaking", "c1")
                assert not reset["accepted"]
                assert "condition is still present" in reset["reason"]
                acknowledged = await ask("acknowledge", "shaking", "c2")
                assert acknowledged["accepted"]
                await eventually(lambda: len(consumer.on("/alarms/shaking")) == 2, "the event arrives")
                assert [consumer.on("/alarms/shaking")[-1].payload["id"]] == acknowledged["events"]
                assert not (await ask("acknowledge", "none", "c3"))["accepted"]
                too_long = await ask("shelve", "shaking", "c4", duration_s=61)
                assert "state a time above 0 and up to 1m" in too_long["reason"]
                assert not (await ask("bypass", "shaking", "c5"))["accepted"]
                assert (service.alarms.commands.accepted, service.alarms.commands.refused) == (
                    1,
                    3,
                )
    told = [(line["source"], line["verb"], line["outcome"]) for line in log(tmp_path / "store")][1::2]
    assert told == [
        (f"mqtt {base}/reset", "reset", "refused"),
        (f"mqtt {base}/acknowledge", "acknowledge", "accepted"),
        (f"mqtt {base}/acknowledge", "acknowledge", "refused"),
        (f"mqtt {base}/shelve", "shelve", "refused"),
    ], "what is not allowed over MQTT never comes to the desk"
