"""Live data over the broker: only while a lease lasts, to so many viewers, no faster than allowed."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING, Any

import pytest
from support.waiting import eventually

from daqsvc.publish.live.link import LiveLink
from daqsvc.publish.live.pieces import Unpacker
from daqsvc.publish.live.settings import Live
from daqsvc.publish.looking import Looking
from daqsvc.publish.mqtt.connection import Incoming
from daqsvc.publish.mqtt.errors import MqttError, PublishRefusedError
from daqsvc.publish.topics import Topics

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Collection

TOPICS = Topics("daqsvc", "lab", "edge-1")
REQUEST = TOPICS.live_request("rig", "page-1")


class Machine:
    """A machine that can be looked at: its lines are those that are put in."""

    def __init__(self) -> None:
        self.lines: asyncio.Queue[bytes] = asyncio.Queue()
        self.looking: list[tuple[str, ...]] = []
        self.left = 0

    def look(
        self, machine: str | None, streams: Collection[str], *, before_bytes: int | None = None
    ) -> Looking | tuple[str, ...]:
        assert before_bytes
        if machine != "rig":
            return ("rig",)
        self.looking.append(tuple(streams))
        return Looking(self.lines.get, self._leave)

    def _leave(self) -> None:
        self.left += 1


class Broker:
    """A connection that keeps what is delivered."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, bytes, float]] = []
        self.watched: list[str] = []
        self.error: Exception | None = None

    async def watch(self, *topics: str, fresh_only: bool = False) -> list[str]:
        assert fresh_only
        self.watched += topics
        return []

    async def deliver(self, topic: str, payload: bytes, *, retain: bool, expiry_s: float) -> None:
        assert (retain, expiry_s > 0) == (False, True)
        if self.error is not None:
            raise self.error
        self.sent.append((topic, payload, asyncio.get_running_loop().time()))

    def told(self, feed: int, looker: str = "page-1") -> bytes:
        unpacker = Unpacker(feed)
        there = TOPICS.live_feed("rig", looker)
        return b"".join(unpacker.take(piece) for topic, piece, _ in self.sent if topic == there)


@contextlib.asynccontextmanager
async def linked(
    machine: Machine, **settings: Any
) -> AsyncIterator[tuple[LiveLink, Broker, asyncio.Task[None]]]:
    link, broker = LiveLink(Live(**settings), machine.look, TOPICS), Broker()
    running = asyncio.create_task(link.run(broker))  # type: ignore[arg-type]
    try:
        yield link, broker, running
    finally:
        running.cancel()
        await asyncio.wait({running})


def ask(
    link: LiveLink, feed: int, lease_s: float, *streams: str, topic: str = REQUEST, **others: Any
) -> bool:
    asked = {"schema": "daqsvc.live-request/1", "feed": feed, "streams": streams, "lease_s": lease_s} | others
    return link.take(Incoming(topic, json.dumps(asked).encode()))


async def test_who_asks_is_told_until_the_lease_is_over() -> None:
    machine = Machine()
    async with linked(machine) as (link, broker, _):
        machine.lines.put_nowait(b'{"before":1}\n')
        await asyncio.sleep(0.05)
        assert (broker.sent, broker.watched) == ([], [TOPICS.live_requests])
        assert ask(link, 1, 0.4, "shaft")
        await eventually(lambda: broker.told(1) == b'{"before":1}\n', "it is told")
        assert machine.looking == [("shaft",)]
        assert ask(link, 1, 0.4, "shaft")
        await eventually(lambda: machine.left == 1, "the lease is over")
        machine.lines.put_nowait(b"nobody\n")
        await asyncio.sleep(0.1)
        assert broker.told(1) == b'{"before":1}\n'
        assert machine.looking == [("shaft",)], "a renewal begins nothing anew"


async def test_another_feed_begins_anew_and_a_lease_of_nothing_ends() -> None:
    machine = Machine()
    async with linked(machine) as (link, broker, _):
        ask(link, 1, 60.0, "shaft")
        await eventually(lambda: len(machine.looking) == 1, "it looks")
        ask(link, 2, 60.0, "shaft", "trend")
        await eventually(lambda: (len(machine.looking), machine.left) == (2, 1), "it looks anew")
        machine.lines.put_nowait(b"two\n")
        await eventually(lambda: broker.told(2) == b"two\n", "the new feed counts from 0")
        ask(link, 2, 0.0)
        await eventually(lambda: machine.left == 2, "it is over")
        machine.lines.put_nowait(b"")


async def test_too_many_and_unknown_machines_are_refused_in_the_feed() -> None:
    machine = Machine()
    async with linked(machine, max_viewers=1) as (link, broker, _):
        ask(link, 1, 60.0)
        await eventually(lambda: len(machine.looking) == 1, "it looks")
        ask(link, 5, 60.0, topic=TOPICS.live_request("rig", "page-2"))
        await eventually(lambda: b"max_viewers" in broker.told(5, "page-2"), "it is refused")
        assert json.loads(broker.told(5, "page-2"))["code"] == "O22"
        ask(link, 1, 0.0)
        await eventually(lambda: machine.left == 1, "there is room")
        ask(link, 6, 60.0, topic=TOPICS.live_request("other", "page-2"))
        await eventually(lambda: "other/live" in broker.sent[-1][0], "it is refused")
        refused = json.loads(Unpacker(6).take(broker.sent[-1][1]))
        assert "no machine 'other' here" in refused["reason"]
        assert refused["code"] == "C04"


async def test_a_machine_that_is_watched_no_more_says_that_it_is_over() -> None:
    machine = Machine()
    async with linked(machine) as (link, broker, _):
        ask(link, 1, 60.0)
        machine.lines.put_nowait(b"")
        await eventually(lambda: broker.told(1) == b'{"over":true}\n', "it says so")
        assert machine.left == 1


async def test_no_more_is_sent_than_is_allowed() -> None:
    machine = Machine()
    async with linked(machine, max_kb_per_s=10.0) as (link, broker, _):
        ask(link, 1, 60.0)
        noise = bytes(range(256)) * 8
        for number in range(4):
            machine.lines.put_nowait(bytes((one * 167 + number) % 256 for one in noise))
        await eventually(lambda: len(broker.sent) == 4, "all is told")
        sizes = [len(piece) for _, piece, _ in broker.sent]
        took_s = broker.sent[-1][2] - broker.sent[0][2]
        assert took_s >= 0.95 * sum(sizes[:-1]) / 10_000


async def test_a_lost_connection_ends_it_and_everybody_who_looks() -> None:
    machine = Machine()
    async with linked(machine) as (link, broker, running):
        ask(link, 1, 60.0)
        broker.error = MqttError("lost")
        machine.lines.put_nowait(b"one\n")
        await asyncio.wait({running})
        with pytest.raises(MqttError, match="lost"):
            running.result()
        assert machine.left == 1


@pytest.mark.gives("O22")
@pytest.mark.parametrize("machine_name", ["rig", "other"])
async def test_a_broker_that_takes_no_feed_ends_that_and_nothing_else(
    machine_name: str, caplog: pytest.LogCaptureFixture
) -> None:
    machine = Machine()
    async with linked(machine) as (link, broker, running):
        broker.error = PublishRefusedError("not authorised")
        machine.lines.put_nowait(b"one\n")
        ask(link, 1, 60.0, topic=TOPICS.live_request(machine_name, "page-1"))
        await eventually(lambda: "not authorised" in caplog.text, "it is said")
        await asyncio.sleep(0.05)
        assert not running.done()
        broker.error = None
        machine.lines.put_nowait(b"two\n")
        ask(link, 2, 60.0)
        await eventually(lambda: broker.told(2).endswith(b"two\n"), "others are told")


@pytest.mark.gives("O21")
@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"no json",
        b"[" * 100_000,
        b"{}",
        b'{"schema": "daqsvc.live-request/1", "feed": 1, "lease_s": 9e9}',
    ],
)
async def test_what_is_no_request_is_left_out_and_said_once(
    payload: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    machine = Machine()
    async with linked(machine) as (link, _, _):
        for _ in range(3):
            assert link.take(Incoming(REQUEST, payload))
        assert len([one for one in caplog.records if one.levelname == "WARNING"]) == 1
        assert not link.take(Incoming("daqsvc/lab/edge-1/rig/commands/reset", payload))
        assert not link.take(Incoming("daqsvc/lab/other/rig/live/page-1/request", payload))
        assert link.take(Incoming(REQUEST, payload, retain=True))
        await asyncio.sleep(0.05)
        assert machine.looking == []


async def test_a_flood_of_requests_is_bounded() -> None:
    machine = Machine()
    link = LiveLink(Live(), machine.look, TOPICS)
    for number in range(10_000):
        assert ask(link, number, 60.0)
    assert link._asked.qsize() <= 64
