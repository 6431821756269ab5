"""A snapshot is asked for over a real broker, and answered with its file once that is complete."""

from __future__ import annotations

import asyncio
import contextlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from support.brokers import Consumer, Mosquitto, running_mosquitto
from support.live_service import running
from support.mqtt_publishing import commands, mqtt, say
from support.recorded_rig import recorded_rig
from support.waiting import eventually

from daqsvc.alarm_commands import MOST_SNAPSHOTS
from daqsvc.confined.limits import ResourceLimits
from daqsvc.snapshots.reading import read_snapshot

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from daqsvc.service import Service

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]
BASE = "daqsvc/demo/virtual/laval-rig/commands"
SNAPSHOT = f"{BASE}/snapshot"


def wish(identifier: str = "s1", **changes: Any) -> str:
    told = {"schema": "daqsvc.snapshot-command/1", "id": identifier, "by": "Ada", "reason": "a knock"}
    return json.dumps(told | {"issued_at": datetime.now(UTC).isoformat()} | changes)


@contextlib.asynccontextmanager
async def commanded(
    tmp_path: Path, bus: str, *allow: str, protocol: str = "5", **recorder: float
) -> AsyncIterator[tuple[Service, Mosquitto, Consumer]]:
    """A service that takes commands over a broker, and whoever hears what that has to say."""
    machine, _ = recorded_rig(bus, **recorder)
    if not recorder:
        machine = machine.model_copy(update={"recorder": None})
    with running_mosquitto(tmp_path) as mosquitto:
        allowed = commands(*allow)
        table = mqtt(mosquitto.port, "daqsvc-box", protocol=protocol, insecure=True, commands=allowed)
        machine = machine.model_copy(update={"mqtt": table})
        async with Consumer(mosquitto.port) as live, running(machine, tmp_path / "store") as service:
            listens = "Sending SUBACK to daqsvc-box"
            await eventually(lambda: mosquitto.log_text.count(listens) >= 2, "the box listens")
            yield service, mosquitto, live


async def answer(live: Consumer, verb: str = "snapshot") -> dict[str, Any]:
    topic = f"{BASE}/{verb}/response"
    await eventually(lambda: live.on(topic), f"{verb} is answered")
    told: dict[str, Any] = live.on(topic)[-1].payload
    live.messages.clear()
    return told


def audited(store: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (store / "audit.jsonl").read_text().splitlines()]


@pytest.mark.long
@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
async def test_a_snapshot_is_answered_with_its_file(tmp_path: Path, protocol: str) -> None:
    bus = f"mqtt-snapshot-{protocol}"
    async with commanded(tmp_path, bus, "snapshot", protocol=protocol, before_s=0.0, after_s=0.2) as (
        service,
        mosquitto,
        live,
    ):
        await asyncio.to_thread(say, mosquitto.port, SNAPSHOT, wish())
        told = await answer(live)
        assert (told["accepted"], told["id"], told["verb"], told["reason"]) == (True, "s1", "snapshot", "")
        assert told["schema"] == "daqsvc.response/1"
        path = Path(told["path"])
        assert path.parent == tmp_path / "store" / "snapshots"
        assert path.name.endswith("-asked.mcap")
        # The same command once more, as a broker may bring it, makes no second one.
        await asyncio.to_thread(say, mosquitto.port, SNAPSHOT, wish())
        assert "has come before" in (await answer(live))["reason"]
        assert service.figures()["commands"]["accepted"] == 1
    snapshot = read_snapshot(path, ResourceLimits())
    assert snapshot.notes == ()
    assert snapshot.about["causes"] == [f"asked for by Ada (mqtt {SNAPSHOT}): a knock"]
    asked, accepted = audited(tmp_path / "store")
    assert (asked["outcome"], accepted["outcome"]) == ("asked", "accepted")
    assert asked["id"] == accepted["id"]
    assert (asked["verb"], asked["by"], asked["machine"]) == ("snapshot", "Ada", "laval-rig")
    assert accepted["path"] == str(path)


async def test_why_there_is_none_is_the_answer(tmp_path: Path) -> None:
    async with commanded(tmp_path, "mqtt-none", "snapshot") as (_, mosquitto, live):
        await asyncio.to_thread(say, mosquitto.port, SNAPSHOT, wish())
        told = await answer(live)
        assert (told["accepted"], told["path"], told["code"]) == (False, "", "C08")
        assert "has no table [recorder]" in told["reason"]
        await asyncio.to_thread(say, mosquitto.port, SNAPSHOT, wish("s2", alarm="rotor-fault"))
        reason = (await answer(live))["reason"]
        assert reason == "it is no command of schema daqsvc.snapshot-command/1: alarm: there is no such key"
    assert [line["outcome"] for line in audited(tmp_path / "store")] == ["asked", "refused"]


async def test_a_snapshot_has_to_be_allowed(tmp_path: Path) -> None:
    async with commanded(tmp_path, "mqtt-not-allowed", "acknowledge", after_s=0.1) as (_, mosquitto, live):
        await asyncio.to_thread(say, mosquitto.port, SNAPSHOT, wish())
        assert "'snapshot' is not allowed over MQTT" in (await answer(live))["reason"]
    assert not (tmp_path / "store" / "snapshots").exists()
    assert not (tmp_path / "store" / "audit.jsonl").exists()


async def test_who_asks_again_and_again_is_refused(tmp_path: Path) -> None:
    async with commanded(tmp_path, "mqtt-quota", "snapshot", before_s=0.0, after_s=0.1) as (
        service,
        mosquitto,
        live,
    ):
        for number in range(MOST_SNAPSHOTS):
            await asyncio.to_thread(say, mosquitto.port, SNAPSHOT, wish(f"s{number}"))
            assert (await answer(live))["accepted"]
        await asyncio.to_thread(say, mosquitto.port, SNAPSHOT, wish("more"))
        told = await answer(live)
        assert not told["accepted"]
        assert told["code"] == "C07"
        assert told["reason"].startswith(
            f"{MOST_SNAPSHOTS} snapshots of laval-rig were asked for within 600 s"
        )
        assert service.figures()["recorders"]["laval-rig"]["snapshots"] == MOST_SNAPSHOTS
        # At the box people are not held up by that.
        made = await service.snapshot(None, "somebody at the box")
        assert made.endswith(".mcap")


async def test_nobody_waits_for_the_snapshots_of_others(tmp_path: Path) -> None:
    async with commanded(tmp_path, "mqtt-lasting", "snapshot", "acknowledge", after_s=600.0) as (
        service,
        mosquitto,
        live,
    ):
        await asyncio.to_thread(say, mosquitto.port, SNAPSHOT, wish())
        await eventually(lambda: service.figures()["recorders"]["laval-rig"]["recording"], "it is begun")
        of_alarm = {"schema": "daqsvc.command/1", "alarm": "rotor-fault"}
        told = json.loads(wish("a1")) | of_alarm
        await asyncio.to_thread(say, mosquitto.port, f"{BASE}/acknowledge", json.dumps(told))
        assert (await answer(live, "acknowledge"))["id"] == "a1"
        assert not live.on("snapshot/response")
    last = audited(tmp_path / "store")[-1]
    assert (last["verb"], last["outcome"]) == ("snapshot", "accepted"), (
        "it was finished, as the service ended"
    )
