"""Who looks on is told what passes of a machine, over the control socket; nobody else notices."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import itertools
import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.formats import fits
from support.live_service import running, watch_of
from support.recorded_rig import RATE_HZ, play, recorded_rig, recording
from support.waiting import PATIENCE_S, eventually

from daqsvc import live_feed
from daqsvc.acquisition.clock import DrivenClock
from daqsvc.acquisition.ring import SampleRing
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.control import MOST_CLIENTS, MOST_LOOKING, SOCKET
from daqsvc.live_feed import LiveFeed

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from daqsvc.settings import MachineFile

QUESTION = b'{"schema": "daqsvc.control/1", "verb": "live"'
LONGEST = 2**24


@contextlib.asynccontextmanager
async def looking(
    store: Path, rest: bytes = b"}"
) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_unix_connection(store / SOCKET, limit=LONGEST)
    try:
        writer.write(QUESTION + rest + b"\n")
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


async def next_line(reader: asyncio.StreamReader) -> dict[str, Any]:
    async with asyncio.timeout(PATIENCE_S):
        told: dict[str, Any] = json.loads(await reader.readline())
    return told if told.get("schema") == "daqsvc.control-answer/1" else fits("daqsvc.live/1", told)


def rows_of(told: dict[str, Any]) -> np.ndarray[Any, Any]:
    return np.frombuffer(base64.b64decode(told["values"]), "<f4").reshape(told["shape"])


def rig(name: str) -> MachineFile:
    return recorded_rig(name)[0].model_copy(update={"recorder": None})


@pytest.mark.integration
async def test_who_looks_on_is_told_samples_statements_and_alarms(tmp_path: Path) -> None:
    machine, samples = recorded_rig("live-feed")
    async with (
        recording(machine, tmp_path / "store") as (service, clock),
        looking(tmp_path / "store", b', "streams": ["shaft"]}') as (reader, _),
        looking(tmp_path / "store") as (other, _),
    ):
        about = await next_line(reader)
        assert (about["schema"], about["machine"]) == ("daqsvc.live/1", "laval-rig")
        assert about["streams"]["shaft"]["sensors"] == ["probe-x", "probe-y", "keyphasor"]
        assert about["values"]["machine"]["speed_rpm"] == machine.machine.speed_rpm
        assert "mqtt" not in about["values"]
        assert about["standings"].keys() == {"shaft"}
        await next_line(other)
        count = round(6.5 * RATE_HZ) // 3 * 3
        await play(service, clock, samples[:count])
        told: list[dict[str, Any]] = []
        while not any("alarm" in one for one in told) or await_more(told, count):
            told.append(await next_line(reader))
        blocks = [one["samples"] for one in told if "samples" in one]
        assert len(blocks) < count / 30, "what comes within a moment is told together"
        for before, block in itertools.pairwise(blocks):
            assert block["first_index"] == before["first_index"] + before["shape"][0]
        got = np.concatenate([rows_of(one) for one in blocks])
        ring = watch_of(service).rings["shaft"]
        assert np.array_equal(got[-64:], ring.read(blocks[0]["first_index"] + len(got) - 64, 64))
        newest = blocks[-1]
        assert newest["t_first_ns"] == pytest.approx(ring.time_of(newest["first_index"]), abs=1e6)
        assert any(one["statement"]["detector"] == "rotor-bank" for one in told if "statement" in one)
        raised = next(one["alarm"] for one in told if "alarm" in one)
        assert raised["kind"] == "raised"
        for one in told:  # the other has asked for no samples
            if "samples" not in one:
                while (line := await next_line(other)) == {"alive": True}:
                    pass
                assert line == one
        # Who looks later is told how everything stands.
        async with looking(tmp_path / "store") as (later, _):
            stands = await next_line(later)
        assert raised["alarm"] in [one["alarm"] for one in stands["alarms"]]
        assert "rotor-bank" in [one["detector"] for one in stands["statements"]]


def await_more(told: list[dict[str, Any]], count: int) -> bool:
    rows = sum(one["samples"]["shape"][0] for one in told if "samples" in one)
    return rows < count - 200


@pytest.mark.integration
async def test_those_who_look_on_leave_room_for_commands_and_for_each_other(tmp_path: Path) -> None:
    store = tmp_path / "store"
    async with running(rig("live-room"), store) as service, contextlib.AsyncExitStack() as all_of_them:
        feed = watch_of(service).live
        first, _ = await all_of_them.enter_async_context(looking(store))
        await next_line(first)
        for _ in range(MOST_LOOKING):
            reader, writer = await all_of_them.enter_async_context(looking(store))
            assert "schema" in await next_line(reader)
        async with asyncio.timeout(PATIENCE_S):
            await first.read()  # until its end: it has looked for longest, and makes way
        await eventually(lambda: len(feed._lookers) == MOST_LOOKING, "its place was given away")
        for _ in range(MOST_CLIENTS):  # as many as if nobody looked
            asking, question = await asyncio.open_unix_connection(store / SOCKET)
            all_of_them.callback(question.close)
            question.write(b'{"schema": "daqsvc.control/1", "verb": "standing"}\n')
            assert (await next_line(asking))["accepted"]
        writer.write(b"whatever is said meanwhile\n")
        assert await next_line(reader), "it is told all the same"
        async with looking(store, b', "machine": "other"}') as (refused, _):
            told = await next_line(refused)
        assert len(feed._lookers) == MOST_LOOKING, "nobody made way for that"
        assert (told["reason"], told["machines"]) == ("this service does not watch 'other'", ["laval-rig"])
        async with looking(store, b', "streams": "shaft"}') as (refused, _):
            assert "streams" in (await next_line(refused))["reason"]
        # The service ends while they look: nothing of them is left.


@pytest.mark.integration
async def test_who_looks_on_is_one_of_another_user_and_stays(tmp_path: Path) -> None:
    """Places of others are not given away."""
    store = tmp_path / "store"
    async with running(rig("live-others"), store) as service, contextlib.AsyncExitStack() as all_of_them:
        for _ in range(MOST_LOOKING):
            reader, _ = await all_of_them.enter_async_context(looking(store))
            await next_line(reader)
        for client in service.control._clients:
            client.uid += 1
        async with looking(store) as (refused, _):
            assert (await next_line(refused))["reason"] == "6 others use live already; close one of them"
        assert len(watch_of(service).live._lookers) == MOST_LOOKING


@pytest.mark.integration
async def test_who_looks_on_is_let_go_when_the_machine_is_watched_otherwise(tmp_path: Path) -> None:
    store = tmp_path / "store"
    async with running(rig("live-over"), store) as service:
        async with looking(store) as (reader, _):
            await next_line(reader)
            watch_of(service).change_alarms(rig("live-over"))
            async with asyncio.timeout(PATIENCE_S):
                rest = await reader.read()
            kinds = {next(iter(json.loads(line))) for line in rest.splitlines()}
            assert kinds <= {"standing", "statement", "alive"}
        async with looking(store) as (reader, _):
            assert "schema" in await next_line(reader)


def block(first_index: int, rows: int, stream: str = "shaft") -> SampleBlock:
    samples = np.full((rows, 2), first_index, np.float32)
    return SampleBlock(stream, first_index, samples, first_index * 1000, 1000.0)


async def test_who_is_slow_is_told_how_much_was_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_feed, "MOST_WAITING_BYTES", 10 * 8 * 10)
    feed = LiveFeed(rig("live-slow"), DrivenClock())
    looker = feed.look(["shaft"], [], [], {}, {})
    for number in range(25):
        feed.block(block(10 * number, 10))
    feed.block(block(0, 10, "other"))
    lines = [json.loads(line) for line in (await looker.lines()).splitlines()]
    assert lines[0]["schema"] == "daqsvc.live/1"
    assert lines[1]["samples"]["shape"] == [100, 2]
    assert lines[2:] == [{"left_out": 150}]
    feed.block(block(250, 10))
    [line] = (await looker.lines()).splitlines()
    assert json.loads(line)["samples"]["first_index"] == 250
    feed.leave(looker)
    feed.block(block(260, 10))
    monkeypatch.setattr(live_feed, "ALIVE_S", 0.1)
    assert json.loads(await looker.lines()) == {"alive": True}, "it has left, and nothing more comes"


async def test_blocks_behind_a_gap_are_told_apart() -> None:
    feed = LiveFeed(rig("live-gap"), DrivenClock())
    looker = feed.look(["shaft"], [], [], {}, {})
    feed.block(block(0, 10))
    feed.block(block(10, 5))
    feed.block(block(20, 5))
    _, first, second = [json.loads(line) for line in (await looker.lines()).splitlines()]
    assert (first["samples"]["shape"], first["samples"]["t_first_ns"]) == ([15, 2], 0)
    assert (second["samples"]["first_index"], second["samples"]["t_first_ns"]) == (20, 20_000)


async def test_streams_share_what_is_told_of_the_time_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_feed, "MOST_WAITING_BYTES", 3 * 2 * 8 * 50)
    feed = LiveFeed(rig("live-before"), DrivenClock())
    rings = {}
    for name in ("a", "b", "c", "d"):
        rings[name] = SampleRing(name, ["x", "y"], 1000)
        rings[name].write(block(0, 400, name))
    looker = feed.look(["a", "b", "c"], [], [], {}, rings)
    _, *told = [json.loads(line) for line in (await looker.lines()).splitlines()]
    assert {one["samples"]["stream"]: one["samples"]["shape"] for one in told} == {
        name: [50, 2] for name in "abc"
    }
    assert {one["samples"]["first_index"] for one in told} == {350}
    elsewhere = feed.look(["a"], [], [], {}, rings, before_bytes=2 * 4 * 20)
    about, only = [json.loads(line) for line in (await elsewhere.lines()).splitlines()]
    assert only["samples"]["shape"] == [20, 2]
    assert "folder" not in about, "the path is of this box"
