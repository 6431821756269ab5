"""The desk when the outbox refuses events or has lost them: disk and broker get to know how things stand."""

from __future__ import annotations

import asyncio
import json
import shutil

import pytest
from support.alarm_desk import alarm_service
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import DiagnosisRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.messages import OutboxError
from daqsvc.self_check import conditions

pytestmark = pytest.mark.integration
IDENTITY = Identity("lab", "edge-1", "rig")
CLOCK = SystemClock()


def said(decision, severity="alert"):
    return Diagnosis("rig", "bank", CLOCK.monotonic_ns(), "shaft", 0, 64, decision, severity=severity)


async def states(desk):
    await desk.settle(5.0)
    return [json.loads(message.payload)["state"] for message in await desk.outbox.following(0, 100)]


async def test_the_last_of_the_refused_events_is_told_again(tmp_path, monkeypatch) -> None:
    desk = alarm_service(IDENTITY, [DiagnosisRule("fault", "bank")], tmp_path, CLOCK, None)
    await desk.open()
    try:
        desk.take(said("F1"))
        assert await states(desk) == ["active_unacknowledged"]

        def refuse(*_, **__):
            refused = asyncio.get_running_loop().create_future()
            refused.set_exception(OutboxError("too many wait already"))
            return refused

        with monkeypatch.context() as full:
            full.setattr(desk.outbox, "submit", refuse)
            desk.take(said("N", "normal"))
            desk.take(said("F2"))
            desk.take(said("N", "normal"))
            await eventually(lambda: desk._untold, "the refusal is known")
            desk.tick()
        await asyncio.sleep(0)
        desk.tick()
        assert await states(desk) == ["active_unacknowledged", "returned_unacknowledged"]
        desk.tick()
        assert len(await states(desk)) == 2, "told once"
    finally:
        await desk.close(1.0)


async def test_a_newer_event_makes_the_refused_one_needless(tmp_path, monkeypatch) -> None:
    """Told again after the newer one, the refused event would stand as the alarm's state."""
    desk = alarm_service(IDENTITY, [DiagnosisRule("fault", "bank")], tmp_path, CLOCK, None)
    await desk.open()
    try:
        refused = asyncio.get_running_loop().create_future()
        with monkeypatch.context() as full:
            full.setattr(desk.outbox, "submit", lambda *_, **__: refused)
            desk.take(said("F1"))
        desk.take(said("N", "normal"))
        refused.set_exception(OutboxError("too many wait already"))
        await asyncio.sleep(0)
        desk.tick()
        assert await states(desk) == ["returned_unacknowledged"]
    finally:
        await desk.close(1.0)


@pytest.mark.parametrize("knows", [True, False], ids=["which were raised", "nothing"])
async def test_alarms_that_a_damaged_journal_forgot_are_told_as_normal(tmp_path, knows) -> None:
    """Else the broker would show them as active for ever."""
    rules = [DiagnosisRule("fault", "bank"), DiagnosisRule("other", "bank")]
    active_detectors = {"bank": ("x",)}
    desk = alarm_service(IDENTITY, rules, tmp_path, CLOCK, None)
    await desk.open()
    desk.take(said("F1"))
    await states(desk)
    await desk.close(1.0)
    journal = tmp_path / "outbox.sqlite"
    if not knows:
        (tmp_path / "outbox.sqlite.topics").write_text("garbage")
    journal.write_bytes(b"garbage!" * (journal.stat().st_size // 8))

    desk = alarm_service(IDENTITY, rules, tmp_path, CLOCK, None)
    await desk.open()
    await desk.resume({IDENTITY.machine: active_detectors})
    await desk.settle(5.0)
    told = {}
    for message in await desk.outbox.latest():
        payload = json.loads(message.payload)
        told[payload["alarm"]] = (payload["kind"], payload["state"], payload["occurrence"])
    names = ("fault", "other") if knows else ("fault", "other", "sensor-ok/x", *conditions())
    assert told == dict.fromkeys(names, ("returned", "normal", None))
    await desk.close(1.0)

    desk = alarm_service(IDENTITY, rules, tmp_path, CLOCK, None)
    await desk.open()
    before = len(await states(desk))
    await desk.resume({IDENTITY.machine: active_detectors})
    assert len(await states(desk)) == before, "once"
    await desk.close(1.0)


@pytest.mark.parametrize("damage", ["at byte 200", "in the middle", "emptied"])
async def test_an_alarm_that_stands_still_stands_after_damage_of_the_log(tmp_path, damage) -> None:
    """And one that was never raised is not told of."""
    rules = [DiagnosisRule("fault", "bank", latching=True), DiagnosisRule("other", "another")]
    desk = alarm_service(IDENTITY, rules, tmp_path / "store", CLOCK, None)
    await desk.open()
    desk.take(said("F1", "danger"))
    desk.take(said("N", "normal"))
    stood = await states(desk)
    shutil.copytree(
        tmp_path / "store", tmp_path / "killed", ignore=shutil.ignore_patterns("*-shm", "*telemetry*")
    )
    await desk.close(1.0)
    journal, log = tmp_path / "killed" / "outbox.sqlite", tmp_path / "killed" / "outbox.sqlite-wal"
    if damage == "emptied":
        journal.write_bytes(b"")
    else:
        content = bytearray(log.read_bytes())
        content[200 if damage == "at byte 200" else len(content) // 2] ^= 1
        log.write_bytes(content)

    desk = alarm_service(IDENTITY, rules, tmp_path / "killed", CLOCK, None)
    await desk.open()
    await desk.resume({IDENTITY.machine: {"bank": ("x",)}})
    await desk.settle(5.0)
    assert await states(desk) == stood
    assert desk.figures()["latched"] == 1
    await desk.close(1.0)


async def test_ids_of_commands_that_are_gone_at_the_start_are_an_alarm(tmp_path) -> None:
    async def damage():
        desk = alarm_service(IDENTITY, [], tmp_path, CLOCK, None)
        await desk.open()
        try:
            await desk.resume({})
            desk.tick()
            status = desk.manager.alarms.get("store/damage")
            return None if status is None or not status.state.is_active else status.message
        finally:
            await desk.settle(5.0)
            await desk.close(1.0)

    assert await damage() is None, "a new store is sound"
    (tmp_path / "command-ids").write_bytes(b"\xff" * 10)
    assert "were damaged" in await damage()
