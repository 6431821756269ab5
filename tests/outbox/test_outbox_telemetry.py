"""Telemetry in the outbox: bounded, dropped oldest first, counted, and apart from the alarms."""

from __future__ import annotations

import asyncio
import contextlib
import sqlite3

import pytest

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock, SystemClock
from daqsvc.outbox import telemetry as telemetry_module
from daqsvc.outbox.limits import MIB
from daqsvc.outbox.store import Outbox, OutboxError, OutboxLimits

pytestmark = pytest.mark.integration
TOPIC = "daqsvc/lab/edge-1/status"
FILE = "outbox-telemetry.sqlite"


async def opened(directory, clock=None, **limits):
    outbox = Outbox(directory / "outbox.sqlite", clock or SystemClock(), OutboxLimits(**limits))
    await outbox.open()
    return outbox


@pytest.fixture
async def outbox(tmp_path):
    outbox = await opened(tmp_path)
    yield outbox
    await outbox.close()


def version_is(path, number):
    with contextlib.closing(sqlite3.connect(path)) as other:
        other.execute(f"PRAGMA user_version = {number}")


async def payloads(outbox):
    return [message.payload for message in await outbox.pending_telemetry(0, 10**6)]


async def test_it_comes_in_order_until_it_is_sent(outbox):
    for text in (b"first", b"second", b"third"):
        outbox.telemetry(TOPIC, text)
    messages = await outbox.pending_telemetry(0, 10)
    assert [message.payload for message in messages] == [b"first", b"second", b"third"]
    assert {message.topic for message in messages} == {TOPIC}
    assert [m.payload for m in await outbox.pending_telemetry(messages[0].number, 1)] == [b"second"]
    outbox.mark_telemetry_sent(messages[0].number)
    assert await payloads(outbox) == [b"second", b"third"]
    counted = outbox.counters.telemetry
    assert (counted.accepted, counted.sent, counted.depth, counted.dropped) == (3, 1, 2, 0)


async def test_the_next_is_waited_for(outbox):
    waiting = asyncio.create_task(outbox.next_telemetry(0, 10))
    await asyncio.sleep(0.05)
    assert not waiting.done()
    outbox.telemetry(TOPIC, b"first")
    [message] = await asyncio.wait_for(waiting, 60)
    waiting = asyncio.create_task(outbox.next_telemetry(message.number, 10))
    await asyncio.sleep(0.05)
    assert not waiting.done()
    outbox.telemetry(TOPIC, b"second")
    assert [m.payload for m in await asyncio.wait_for(waiting, 60)] == [b"second"]


async def test_the_oldest_are_dropped_beyond_the_limit_and_the_file_stays_within(tmp_path):
    outbox = await opened(tmp_path, telemetry_max_bytes=MIB)
    for number in range(6000):
        outbox.telemetry(TOPIC, b"%d " % number + b"x" * 1000)
        if number % 500 == 0:
            await outbox.pending_telemetry(0, 1)
    kept = [int(payload.split()[0]) for payload in await payloads(outbox)]
    assert kept == list(range(6000 - len(kept), 6000))
    assert 0.6 * MIB < 1000 * len(kept) < MIB
    counted = outbox.counters.telemetry
    assert counted.accepted == 6000 == counted.depth + counted.dropped_full
    assert counted.depth == len(kept)
    await outbox.close()
    assert (tmp_path / FILE).stat().st_size < 2 * MIB


async def test_it_expires_by_monotonic_time_whatever_the_wall_clock_does(tmp_path):
    clock = DrivenClock()
    outbox = await opened(tmp_path, clock, telemetry_max_age_ns=100 * NS_PER_S)
    outbox.telemetry(TOPIC, b"5 s", expiry_s=5.0)
    outbox.telemetry(TOPIC, b"50 s", expiry_s=50.0)
    outbox.telemetry(TOPIC, b"as long as may be")
    outbox.telemetry(TOPIC, b"longer than may be", expiry_s=1e6)
    first, *_ = await outbox.pending_telemetry(0, 10)
    assert first.expires_ns == clock.monotonic_ns() + 5 * NS_PER_S
    clock._wall_start_ns += 3600 * NS_PER_S
    clock.advance_to(clock.monotonic_ns() + 6 * NS_PER_S)
    assert await payloads(outbox) == [b"50 s", b"as long as may be", b"longer than may be"]
    clock._wall_start_ns -= 7200 * NS_PER_S
    clock.advance_to(clock.monotonic_ns() + 50 * NS_PER_S)
    assert await payloads(outbox) == [b"as long as may be", b"longer than may be"]
    clock.advance_to(clock.monotonic_ns() + 50 * NS_PER_S)
    assert await payloads(outbox) == []
    outbox.telemetry(TOPIC, b"new")
    assert await payloads(outbox) == [b"new"]
    assert outbox.counters.telemetry.dropped_old == 4
    await outbox.close()


@pytest.mark.parametrize(
    ("wall_step_s", "left_s"),
    [(10, 20), (-3600, 30), (3600, None)],
    ids=["in order", "set back", "set forward"],
)
async def test_a_restart_keeps_it_with_what_is_left_of_its_time(tmp_path, wall_step_s, left_s):
    """Never longer than it had: 30 s in all here."""
    clock = DrivenClock(wall_start_ns=10**18)
    outbox = await opened(tmp_path, clock)
    outbox.telemetry(TOPIC, b"kept", expiry_s=30.0)
    outbox.telemetry(TOPIC, b"sent", expiry_s=30.0)
    outbox.mark_telemetry_sent((await outbox.pending_telemetry(0, 10))[1].number)
    await outbox.close()
    clock = DrivenClock(start_ns=77 * NS_PER_S, wall_start_ns=10**18 + wall_step_s * NS_PER_S)
    outbox = await opened(tmp_path, clock)
    messages = await outbox.pending_telemetry(0, 10)
    if left_s is None:
        assert messages == []
        outbox.telemetry(TOPIC, b"new")
        await outbox.pending_telemetry(0, 1)
        assert outbox.counters.telemetry.dropped_old == 1
    else:
        [message] = messages
        assert message.payload == b"kept"
        assert message.expires_ns == clock.monotonic_ns() + left_s * NS_PER_S
        assert outbox.counters.telemetry.depth == 1
    await outbox.close()


@pytest.mark.parametrize("damage", ["garbage", "torn", "version -1"])
async def test_a_corrupt_file_is_set_aside_and_the_alarms_do_not_notice(tmp_path, damage, caplog):
    outbox = await opened(tmp_path)
    alarm = await outbox.append("alarm", lambda n: b"alarm", retain=True)
    for _ in range(20):
        outbox.telemetry(TOPIC, b"telemetry" * 300)
    await outbox.pending_telemetry(0, 1)
    await outbox.close()
    path = tmp_path / FILE
    whole = path.read_bytes()
    if damage == "version -1":
        with sqlite3.connect(path) as other:
            other.execute("PRAGMA user_version = -1")
        other.close()
    else:
        path.write_bytes(
            {
                "garbage": b"not a database at all" * 100,
                "torn": whole[: len(whole) // 2],
            }[damage]
        )
    outbox = await opened(tmp_path)
    outbox.telemetry(TOPIC, b"new")
    *saved, newest = await payloads(outbox)
    assert newest == b"new"
    assert set(saved) <= {b"telemetry" * 300}
    assert {"garbage": not saved, "torn": len(saved) < 20, "version -1": len(saved) == 20}[damage]
    assert outbox.counters.telemetry.quarantined == 1
    assert outbox.counters.telemetry.in_memory == 0
    assert len(list(tmp_path.glob(f"{FILE}.corrupt-*"))) >= 1
    assert "set aside as" in caplog.text
    assert outbox.counters.quarantined == 0
    assert [m.sequence for m in await outbox.pending(0, 10)] == [alarm]
    await outbox.close()


async def test_a_file_of_a_newer_version_is_kept_for_it_and_is_no_damage(tmp_path, caplog):
    outbox = await opened(tmp_path)
    outbox.telemetry(TOPIC, b"theirs")
    await outbox.pending_telemetry(0, 1)
    await outbox.close()
    path = tmp_path / FILE
    version_is(path, 99)
    outbox = await opened(tmp_path)
    outbox.telemetry(TOPIC, b"ours")
    assert await payloads(outbox) == [b"ours"]
    counted = outbox.counters.telemetry
    assert (counted.quarantined, counted.dropped, counted.in_memory) == (0, 0, 0)
    assert not outbox.has_set_aside
    await outbox.close()
    [kept] = tmp_path.glob(f"{FILE}.version-99-*")
    said = f"{path} was written by a newer version of daqsvc (its form is 99); it is kept as {kept.name}"
    [told] = [record.getMessage() for record in caplog.records]
    assert told.startswith(said)
    assert "install that version again" in told
    version_is(kept, 1)
    path.unlink()
    kept.rename(path)
    outbox = await opened(tmp_path)
    assert await payloads(outbox) == [b"theirs"], "as the newer version finds it"
    await outbox.close()


async def test_telemetry_that_has_changed_on_the_disk_is_not_passed_on(tmp_path):
    outbox = await opened(tmp_path)
    outbox.telemetry(TOPIC, b"telemetry")
    await outbox.pending_telemetry(0, 1)
    await outbox.close()
    path = tmp_path / FILE
    path.write_bytes(path.read_bytes().replace(TOPIC.encode() + b"telemetry", TOPIC.encode() + b"TELEMETRY"))
    outbox = await opened(tmp_path)
    assert outbox.counters.telemetry.quarantined == 0
    assert await payloads(outbox) == []
    assert outbox.counters.telemetry.quarantined == 1
    assert outbox.counters.telemetry.dropped_disk == 1
    outbox.telemetry(TOPIC, b"new")
    assert await payloads(outbox) == [b"new"]
    await outbox.close()


async def test_corrupt_alarms_do_not_touch_telemetry(tmp_path):
    outbox = await opened(tmp_path)
    outbox.telemetry(TOPIC, b"telemetry")
    await outbox.pending_telemetry(0, 1)
    await outbox.close()
    (tmp_path / "outbox.sqlite").write_bytes(b"not a database at all" * 100)
    outbox = await opened(tmp_path)
    assert outbox.counters.quarantined == 1
    assert await payloads(outbox) == [b"telemetry"]
    await outbox.close()


async def test_a_file_that_cannot_be_used_costs_telemetry_its_disk_and_nothing_else(tmp_path, caplog):
    (tmp_path / FILE).mkdir()
    outbox = await opened(tmp_path)
    outbox.telemetry(TOPIC, b"telemetry")
    assert await payloads(outbox) == [b"telemetry"]
    assert outbox.counters.telemetry.in_memory == 1
    assert "are kept in memory until it can" in caplog.text
    await outbox.append("alarm", lambda n: b"alarm", retain=True)
    await outbox.close()


async def test_what_waits_for_a_slow_disk_is_bounded_and_counted(tmp_path, monkeypatch):
    outbox = await opened(tmp_path)
    await outbox.pending_telemetry(0, 1)
    monkeypatch.setattr(telemetry_module, "WAITING_MAX_BYTES", 5000)
    for number in range(20):  # the loop does not yield: the thread sees them at most in part
        outbox.telemetry(TOPIC, b"%d " % number + b"x" * 1000)
    left = [int(payload.split()[0]) for payload in await payloads(outbox)]
    counted = outbox.counters.telemetry
    assert left[-4:] == [16, 17, 18, 19]
    assert left == sorted(left)
    assert counted.accepted == 20 == len(left) + counted.dropped_full
    await outbox.close()


async def test_nothing_is_taken_in_before_and_after(tmp_path):
    outbox = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    with pytest.raises(OutboxError, match="is not open yet"):
        outbox.telemetry(TOPIC, b"")
    await outbox.open()
    with pytest.raises(TypeError, match="of type str; give bytes"):
        outbox.telemetry(TOPIC, "text")
    await outbox.close()
    with pytest.raises(OutboxError, match="is closed"):
        outbox.telemetry(TOPIC, b"")
