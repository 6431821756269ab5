"""The summary of all alarms: what it says, and how often."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING
from unittest.mock import AsyncMock

from support.alarm_rig import AlarmRig
from support.mqtt_publishing import commands, output_port

from daqsvc.alarms.manager import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.outbox.messages import OutboxMessage
from daqsvc.outbox.store import Outbox
from daqsvc.publish.home_assistant import link as home_assistant_link
from daqsvc.publish.home_assistant.link import HomeAssistantLink
from daqsvc.publish.home_assistant.settings import HomeAssistant
from daqsvc.publish.home_assistant.summary import Summary, SummaryPayload
from daqsvc.publish.output import Watched
from daqsvc.publish.payloads import alarm_payload
from daqsvc.publish.topics import Topics

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

TOPICS = Topics("daqsvc", "lab", "edge-1")
ALARMS = ("vibration-x", "naïve")


def messages(*values):
    rig = AlarmRig(LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=4.0)))
    events = [event for value in values for event in rig.rms(value)]
    return rig, [
        OutboxMessage(
            number, TOPICS.alarm("rig", event.alarm), alarm_payload(event, number, "s").to_json(), True
        )
        for number, event in enumerate(events, 1)
    ]


def test_the_summary_tells_every_alarm_by_its_newest_event_and_is_what_the_schema_says():
    rig, told = messages(5.0, 1.0, 5.0)
    summary = Summary("rig", ALARMS, TOPICS)
    assert all(summary.note(message) for message in told)
    payload = summary.to_json(rig.clock)
    read = SummaryPayload.model_validate_json(payload)
    assert read.to_json() == payload
    assert read.schema_ == "daqsvc.summary/1"
    assert list(read.alarms) == ["vibration-x", "naïve"]
    raised, quiet = read.alarms.values()
    assert (raised.problem, raised.level, raised.message) == ("ON", "alert", rig.events[-1].message)
    assert (quiet.problem, quiet.level, quiet.occurrence, quiet.time) == ("OFF", "normal", None, None)
    assert json.loads(Summary("rig", (), TOPICS).to_json(rig.clock))["alarms"] == {}


class Heard:
    """A connection that takes everything at once."""

    def __init__(self):
        self.summaries = []

    async def deliver(self, topic, payload, *, retain):
        await asyncio.sleep(0)
        if topic == TOPICS.summary("rig"):
            assert retain
            self.summaries.append(json.loads(payload))

    async def watch(self, *topics):
        return []

    async def unsubscribe(self, topic):
        pass


async def test_a_flood_of_events_is_summed_up_and_the_last_of_them_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(home_assistant_link, "EARLIER_S", 0.0)
    rig, told = messages(*[5.0, 1.0] * 100)
    outbox = Outbox(tmp_path / "outbox.sqlite", rig.clock)
    monkeypatch.setattr(outbox, "retained", AsyncMock(return_value=[]))
    port = output_port(outbox, Watched("rig", alarms=ALARMS), clock=rig.clock)
    link = HomeAssistantLink(HomeAssistant(), commands(), port)
    heard = Heard()
    running = asyncio.create_task(link.run(heard))
    try:
        while not heard.summaries:
            await asyncio.sleep(0.001)
        for message in told:
            link.note(message)
            await asyncio.sleep(0.001)
        while heard.summaries[-1]["alarms"]["vibration-x"]["time"] != json.loads(told[-1].payload)["time"]:
            await asyncio.sleep(0.01)
    finally:
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
    assert len(heard.summaries) < len(told) / 4
