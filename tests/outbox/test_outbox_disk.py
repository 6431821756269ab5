"""The outbox on a disk that is really full, slow or gone: what waits, what gives way, and what is said."""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import threading

import pytest
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.notice import NOTICE
from daqsvc.outbox import telemetry_file
from daqsvc.outbox.limits import MIB
from daqsvc.outbox.store import Outbox, OutboxError, OutboxLimits

pytestmark = pytest.mark.integration
TOPIC = "daqsvc/lab/edge-1/rig/alarms/rotor-fault"
NO_RESERVE = OutboxLimits(reserve_bytes=0, ballast_bytes=MIB // 2)


def kilobyte(sequence):
    return (b"number %d " % sequence).ljust(1000, b".")


@pytest.fixture
def disk(tmp_path):
    """A disk of 8 MiB of its own."""
    directory = tmp_path / "disk"
    directory.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=8m,mode=700", "none", directory],
        check=False,
        capture_output=True,
    )
    if mounted.returncode:
        pytest.skip("this machine lets no test mount a file system")
    yield directory
    subprocess.run(["umount", "--lazy", directory], check=True)


def fill(directory, leave=0):
    """Fill the disk with something of somebody else's."""
    with (directory / "somebody-else").open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            disk = os.statvfs(directory)
            if disk.f_bavail * disk.f_frsize <= leave:
                return
            file.write(bytes(4096))


def make_room(directory):
    (directory / "somebody-else").unlink()


async def opened(directory, limits=NO_RESERVE):
    outbox = Outbox(directory / "outbox.sqlite", SystemClock(), limits)
    await outbox.open()
    return outbox


async def test_alarms_are_delivered_from_a_full_disk_and_from_memory_and_stored_later(disk):
    outbox = await opened(disk)
    before = [await outbox.append(TOPIC, kilobyte, retain=False) for _ in range(10)]
    await outbox.pending_telemetry(0, 1)  # both files are there
    fill(disk)
    waiting = [outbox.submit(TOPIC, lambda n: kilobyte(n) * 9, retain=False) for _ in range(200)]
    await eventually(lambda: outbox.counters.write_errors >= 2, "the disk is full")
    await eventually(lambda: outbox.counters.unbacked == 1, "memory takes over")
    there = await outbox.pending(0, 1000)
    # On a busy computer the first few go by themselves, and the log of the database has room for them.
    done = sum(future.done() for future in waiting)
    assert done < len(waiting) // 2
    assert [m.sequence for m in there if m.stored] == list(range(before[0], before[-1] + 1 + done))
    assert [m.sequence for m in there] == list(range(before[0], before[-1] + 201))
    assert await outbox.pending(before[-1] + 10, 3) == there[20:23]
    make_room(disk)
    numbers = await asyncio.wait_for(asyncio.gather(*waiting), 30)
    assert numbers == list(range(before[-1] + 1, before[-1] + 201))
    stored = await outbox.pending(0, 1000)
    assert all(message.stored for message in stored)
    assert [(m.sequence, m.payload) for m in stored] == [(m.sequence, m.payload) for m in there]
    assert (
        outbox.counters.unbacked
        == outbox.counters.waiting
        == outbox.counters.lost
        == outbox.counters.refused
        == 0
    )
    await outbox.close()


async def test_on_a_full_disk_the_history_gives_its_room_to_new_alarms(disk):
    """What the broker has is given up before what it has not; nobody need come and clear the disk."""
    outbox = await opened(disk)
    old = await asyncio.gather(*[outbox.submit(TOPIC, kilobyte, retain=False) for _ in range(1500)])
    for sequence in old:
        outbox.mark_sent(sequence)
    await eventually(lambda: outbox.counters.depth == 0, "all are sent")
    fill(disk)
    new = []
    for _ in range(20):
        new += await asyncio.wait_for(
            asyncio.gather(*[outbox.submit(TOPIC, kilobyte, retain=False) for _ in range(50)]), 30
        )
    assert [m.sequence for m in await outbox.pending(0, 10_000)] == new
    await outbox.close()


async def test_a_store_on_a_full_disk_is_opened_again_and_delivers(disk):
    outbox = await opened(disk)
    numbers = [await outbox.append(TOPIC, kilobyte, retain=True) for _ in range(50)]
    await outbox.close()
    fill(disk, leave=256 * 1024)
    outbox = await opened(disk)
    assert [m.sequence for m in await outbox.pending(0, 100)] == numbers
    await outbox.close()


@pytest.mark.parametrize("room", ["before the next start", "while it runs"])
async def test_a_store_begun_on_a_full_disk_has_not_lost_its_list_of_commands(disk, room, caplog):
    fill(disk)
    outbox = await opened(disk)
    assert outbox.counters.shut
    with pytest.raises(OSError, match="No space"):
        outbox.command_ids.remember("rig", "a", until_ns=10**18, now_ns=0)
    if room == "while it runs":
        make_room(disk)
        await outbox.append(TOPIC, kilobyte, retain=True)
        assert (disk / "command-ids").stat().st_size
    await outbox.close()
    if room != "while it runs":
        make_room(disk)
    outbox = await opened(disk)
    assert not outbox.command_ids_lost
    assert "missing or damaged" not in caplog.text
    await outbox.close()
    (disk / "command-ids").unlink()
    outbox = await opened(disk)
    assert outbox.command_ids_lost, "a list that was there and is gone is told"
    await outbox.close()


async def test_telemetry_gives_its_room_to_alarms(disk):
    """A nearly full disk costs telemetry, oldest first; every message of it is accounted for."""
    limits = OutboxLimits(reserve_bytes=2 * MIB, ballast_bytes=0, telemetry_max_bytes=4 * MIB)
    outbox = await opened(disk, limits)
    for number in range(2000):
        outbox.telemetry("daqsvc/lab/edge-1/status", b"%d " % number + b"x" * 1000)
        if number % 100 == 0:
            await outbox.pending_telemetry(0, 1)
    await outbox.pending_telemetry(0, 1)
    counted = outbox.counters.telemetry
    kept = counted.depth
    size = (disk / "outbox-telemetry.sqlite").stat().st_size
    assert size > MIB
    assert kept > 1000
    fill(disk, leave=limits.reserve_bytes - MIB)
    outbox.telemetry("daqsvc/lab/edge-1/status", b"the last")
    newest = (await outbox.pending_telemetry(0, 10_000))[-1]
    assert newest.payload == b"the last"
    assert counted.depth < kept
    assert counted.accepted == 2001 == counted.depth + counted.dropped
    free = os.statvfs(disk)
    assert free.f_bavail * free.f_frsize >= size
    alarms = await asyncio.wait_for(
        asyncio.gather(*[outbox.submit(TOPIC, kilobyte, retain=False) for _ in range(1000)]), 30
    )
    assert len(alarms) == 1000
    assert outbox.counters.write_errors == 0
    await outbox.close()


async def test_telemetry_goes_on_in_memory_and_comes_back(disk, monkeypatch, caplog):
    monkeypatch.setattr(telemetry_file, "FILE_RETRY_S", 0.0)
    limits = OutboxLimits(reserve_bytes=2 * MIB, ballast_bytes=0)
    outbox = await opened(disk, limits)
    counted = outbox.counters.telemetry
    outbox.telemetry("status", b"first")
    await outbox.pending_telemetry(0, 1)
    fill(disk)
    outbox.telemetry("status", b"second")
    after_full = await outbox.pending_telemetry(0, 10)
    assert [m.payload for m in after_full] == [b"first", b"second"]
    assert counted.in_memory == 1
    make_room(disk)
    outbox.telemetry("status", b"third")
    back = await outbox.pending_telemetry(0, 10)
    assert [m.payload for m in back] == [b"first", b"second", b"third"]
    assert [m.number for m in back] == [1, 2, 3]
    assert counted.in_memory == 0
    assert counted.dropped == 0
    said = [record.getMessage() for record in caplog.records if record.levelno >= NOTICE]
    assert len(said) == 2
    assert "is nearly full" in said[0]
    assert "can be used again" in said[1]
    await outbox.close()


@pytest.mark.gives("O15")
async def test_telemetry_of_a_former_run_makes_way_before_the_journal_is_opened(disk, caplog):
    outbox = await opened(disk, NO_RESERVE)
    for _ in range(3000):
        outbox.telemetry("status", b"x" * 1000)
    await outbox.pending_telemetry(0, 1)
    numbers = [await outbox.append(TOPIC, kilobyte, retain=True) for _ in range(5)]
    await outbox.close()
    fill(disk)
    outbox = await opened(disk, OutboxLimits(reserve_bytes=2 * MIB, ballast_bytes=0))
    assert [m.sequence for m in await outbox.pending(0, 10)] == numbers
    assert await asyncio.wait_for(outbox.append(TOPIC, kilobyte, retain=True), 10) > numbers[-1]
    assert "is dropped: the disk is nearly full" in caplog.text
    await outbox.close()


async def test_what_waits_in_memory_is_bounded_and_what_is_refused_is_said_loudly(disk, caplog):
    outbox = await opened(disk, OutboxLimits(reserve_bytes=0, ballast_bytes=0, alarms_waiting_max=5))
    fill(disk)
    big = [outbox.submit(TOPIC, lambda n: b"x" * 10 * MIB, retain=False) for _ in range(5)]
    refused = [outbox.submit(TOPIC, kilobyte, retain=False) for _ in range(3)]
    for each in refused:
        with pytest.raises(OutboxError, match="5 messages wait already; this one is refused"):
            await each
    assert outbox.counters.refused == 3
    assert outbox.counters.waiting == 5
    assert caplog.text.count("alarms are being lost: make room") == 1
    await outbox.close()
    for each in big:
        with pytest.raises(OutboxError, match="closed while it could not be written"):
            await each
    assert outbox.counters.lost == 5


async def ended(outbox):
    """Wait for the writer's last breath: what it leaves behind is not for the hook that pytest puts back."""
    assert await asyncio.to_thread(outbox._writer.join, 10)


@pytest.mark.parametrize("mistake", [OSError("the disk is gone"), RuntimeError("a mistake")])
async def test_what_comes_while_the_last_write_fails_is_answered_and_counted(tmp_path, monkeypatch, mistake):
    """By a close, or by a mistake in this program: nobody waits in vain, and each message is counted."""
    outbox = await opened(tmp_path)
    is_writing, may_fail = threading.Event(), threading.Event()

    def write(*_):
        is_writing.set()
        may_fail.wait(10)
        raise mistake

    monkeypatch.setattr(outbox._journal, "write", write)
    monkeypatch.setattr("threading.excepthook", lambda _: None)
    waiting = [outbox.submit(TOPIC, kilobyte, retain=False)]
    await eventually(is_writing.is_set, "the writer is at the disk")
    waiting += [outbox.submit(TOPIC, kilobyte, retain=False) for _ in range(3)]
    reading = asyncio.create_task(outbox.following(0, 10))
    await asyncio.sleep(0)
    closing = asyncio.create_task(outbox.close())
    await asyncio.sleep(0)
    may_fail.set()
    outcomes = await asyncio.wait_for(asyncio.gather(*waiting, reading, return_exceptions=True), 10)
    assert [type(outcome) for outcome in outcomes[:4]] == [OutboxError] * 4
    assert outbox.counters.waiting == 0
    assert outbox.counters.lost == 4
    await closing
    await ended(outbox)


async def test_what_comes_after_the_last_look_of_a_writer_that_ends_is_answered(tmp_path, monkeypatch):
    outbox = await opened(tmp_path)
    late = []

    def write(*_):
        raise RuntimeError("a mistake")

    def abandon(*words):
        abandoned(*words)
        if not late:
            # The event loop may put in what comes until it hears that the thread has ended.
            asked = asyncio.run_coroutine_threadsafe(submitted(), loop)
            late.append(asked.result(10))

    async def submitted():
        return outbox.submit(TOPIC, kilobyte, retain=False)

    loop = asyncio.get_running_loop()
    abandoned = outbox._writer._abandon
    monkeypatch.setattr(outbox._journal, "write", write)
    monkeypatch.setattr(outbox._writer, "_abandon", abandon)
    monkeypatch.setattr(outbox._books, "stopped", lambda _: None)  # has not come yet
    monkeypatch.setattr("threading.excepthook", lambda _: None)
    with pytest.raises(OutboxError, match="a mistake"):
        await asyncio.wait_for(outbox.append(TOPIC, kilobyte, retain=False), 10)
    await eventually(lambda: late, "a message has come too late")
    with pytest.raises(OutboxError, match="its thread has ended"):
        await asyncio.wait_for(late[0], 10)
    assert outbox.counters.waiting == 0
    await outbox.close()
    await ended(outbox)


async def test_a_mistake_of_the_writer_is_told_to_all_who_wait(tmp_path, monkeypatch):
    outbox = await opened(tmp_path)

    def mistake(*_):
        raise RuntimeError("a mistake")

    monkeypatch.setattr(outbox._journal, "write", mistake)
    monkeypatch.setattr("threading.excepthook", lambda _: None)
    with pytest.raises(OutboxError, match="a mistake"):
        await asyncio.wait_for(outbox.append(TOPIC, kilobyte, retain=False), 5)
    with pytest.raises(OutboxError, match="has stopped: RuntimeError"):
        outbox.submit(TOPIC, kilobyte, retain=False)
    await outbox.close()
    await ended(outbox)
