"""The desk when the outbox refuses events: how each alarm stands is on disk as soon as the disk takes it."""

from __future__ import annotations

import asyncio
import json

from brokers import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarm_desk import AlarmDesk
from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import DiagnosisRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox.messages import OutboxError

IDENTITY = Identity("lab", "edge-1", "rig")
CLOCK = SystemClock()


def said(decision, severity="alert"):
    return Diagnosis("rig", "bank", CLOCK.monotonic_ns(), "shaft", 0, 64, decision, severity=severity)


async def states(desk):
    await desk.settle(5.0)
    return [json.loads(message.payload)["state"] for message in await desk.outbox.following(0, 100)]


async def test_the_last_of_the_refused_events_is_told_again(tmp_path, monkeypatch) -> None:
    desk = AlarmDesk(IDENTITY, [DiagnosisRule("fault", "bank")], tmp_path, CLOCK, None)
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
    desk = AlarmDesk(IDENTITY, [DiagnosisRule("fault", "bank")], tmp_path, CLOCK, None)
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
