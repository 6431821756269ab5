"""The outbox with its thread and a real file: bursts, full disks, broken files, kill -9."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import sqlite3
import subprocess
import sys
import textwrap
import time

import pytest
from support.clocks import SettableClock
from support.given_codes import had
from support.waiting import eventually

import daqsvc
from daqsvc.acquisition.clock import SystemClock
from daqsvc.notice import NOTICE
from daqsvc.outbox.journal import TRIM_EVERY, Journal
from daqsvc.outbox.messages import NewerOutboxError, StorePathError
from daqsvc.outbox.sequence import STEP, UNRECORDED
from daqsvc.outbox.store import Outbox, OutboxError, OutboxLimits

pytestmark = pytest.mark.integration
TOPIC = "daqsvc/lab/edge-1/rig/alarms/rotor-fault"


def payload(sequence: int) -> bytes:
    return b"number %d" % sequence


async def opened(path, **options):
    outbox = Outbox(path, SystemClock(), **options)
    await outbox.open()
    return outbox


@pytest.fixture
async def outbox(tmp_path):
    outbox = await opened(tmp_path / "outbox.sqlite")
    yield outbox
    await outbox.close()


@pytest.fixture
def connections(monkeypatch):
    """Every SQLite connection to a journal of alarms, usable from the test's thread."""
    made = []
    connect = sqlite3.connect

    def spy(*arguments, **options):
        connection = connect(*arguments, **options, check_same_thread=False)
        if "telemetry" not in str(arguments[0]):
            made.append(connection)
        return connection

    monkeypatch.setattr("daqsvc.outbox.files.sqlite3.connect", spy)
    return made


async def test_messages_of_a_flood_share_commits_and_one_alone_waits_for_no_other(outbox, monkeypatch):
    commits, write = [], Journal.write

    def spy(journal, at_most):
        written = write(journal, at_most)
        commits.append(len(written[0]))
        return written

    monkeypatch.setattr(Journal, "write", spy)
    for _ in range(5):
        await outbox.append(TOPIC, payload, retain=True)
    assert commits == [1] * 5
    commits.clear()
    flood = []
    for _ in range(50):
        flood += [outbox.submit(TOPIC, payload, retain=True) for _ in range(4)]
        await asyncio.sleep(0.005)
    assert sorted(await asyncio.gather(*flood)) == [one.result() for one in flood]
    assert sum(commits) == len(flood)
    assert len(commits) < 25, f"{len(commits)} commits for 50 bursts"


async def test_appended_is_on_disk_in_order_and_waits_until_it_is_sent(outbox, tmp_path):
    sequences = [await outbox.append(TOPIC, payload, retain=True) for _ in range(3)]
    assert sequences == sorted(set(sequences))
    with sqlite3.connect(tmp_path / "outbox.sqlite") as other:
        rows = other.execute("SELECT sequence, topic, payload FROM messages").fetchall()
    other.close()
    assert rows == [(s, TOPIC, payload(s)) for s in sequences]
    assert [m.sequence for m in await outbox.pending(0, 10)] == sequences
    assert [m.sequence for m in await outbox.pending(sequences[0], 1)] == sequences[1:2]
    outbox.mark_sent(sequences[0])
    assert [m.sequence for m in await outbox.pending(0, 10)] == sequences[1:]
    assert (outbox.counters.appended, outbox.counters.sent, outbox.counters.depth) == (3, 1, 2)


async def test_a_burst_shares_commits(outbox, connections, tmp_path):
    burst = await opened(tmp_path / "burst.sqlite")
    commits = []
    connections[-1].set_trace_callback(lambda sql: commits.append(sql) if sql == "COMMIT" else None)
    sequences = await asyncio.gather(*[burst.submit(TOPIC, payload, retain=False) for _ in range(500)])
    assert sequences == list(range(sequences[0], sequences[0] + 500))
    assert 1 <= len(commits) < 50
    await burst.close()


async def test_marks_reach_the_disk_without_company(outbox):
    sequence = await outbox.append(TOPIC, payload, retain=False)
    outbox.mark_sent(sequence)
    await eventually(lambda: outbox.counters.sent == 1, "the mark is committed")


async def test_restart_replays_what_was_not_acknowledged(tmp_path):
    path = tmp_path / "outbox.sqlite"
    first = await opened(path)
    sequences = [await first.append(TOPIC, payload, retain=True) for _ in range(4)]
    for sequence in sequences[:2]:
        first.mark_sent(sequence)
    await first.close()
    second = await opened(path)
    assert second.counters.depth == 2
    assert [m.sequence for m in await second.next_pending(0, 10)] == sequences[2:]
    assert await second.append(TOPIC, payload, retain=True) > sequences[-1]
    await second.close()


async def test_next_pending_waits_for_the_next_message(outbox):
    sequence = await outbox.append(TOPIC, payload, retain=False)
    waiting = asyncio.create_task(outbox.next_pending(sequence, 10))
    await asyncio.sleep(0.05)
    assert not waiting.done()
    later = await outbox.append(TOPIC, payload, retain=False)
    assert [m.sequence for m in await waiting] == [later]


async def test_a_payload_that_cannot_be_built_fails_its_own_append_only(outbox):
    def refuse(sequence):
        raise ValueError("cannot be built")

    bad = outbox.submit(TOPIC, refuse, retain=False)
    good = outbox.submit(TOPIC, payload, retain=False)
    with pytest.raises(ValueError, match="cannot be built"):
        await bad
    assert [m.sequence for m in await outbox.pending(0, 10)] == [await good]


@pytest.mark.gives("S08")
async def test_a_full_disk_is_reported_once_and_nothing_is_lost(tmp_path, connections, caplog):
    outbox = await opened(tmp_path / "outbox.sqlite")
    disk = connections[-1]
    before = await outbox.append(TOPIC, payload, retain=False)
    pages = disk.execute("PRAGMA page_count").fetchone()[0]
    disk.execute(f"PRAGMA max_page_count = {pages}")
    with caplog.at_level(NOTICE):
        waiting = [outbox.submit(TOPIC, lambda n: b"x" * 20_000, retain=False) for _ in range(3)]
        await eventually(lambda: outbox.counters.write_errors >= 2, "the write has failed twice")
        assert outbox.counters.waiting == 3
        assert not any(future.done() for future in waiting)
        disk.execute("PRAGMA max_page_count = 1000000")
        sequences = await asyncio.gather(*waiting)
        # The writer says so from its own thread, after whoever waited has heard.
        await eventually(lambda: "can be used again" in caplog.text, "the recovery is told")
    assert sequences == [before + 1, before + 2, before + 3]
    assert outbox.counters.waiting == 0
    [said] = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert "cannot be written: database or disk is full; delivery is not backed by the disk" in said
    await outbox.close()


async def test_closing_on_a_full_disk_says_what_is_lost(tmp_path, connections, caplog):
    outbox = await opened(tmp_path / "outbox.sqlite")
    disk = connections[-1]
    disk.execute(f"PRAGMA max_page_count = {disk.execute('PRAGMA page_count').fetchone()[0]}")
    waiting = outbox.submit(TOPIC, lambda n: b"x" * 50_000, retain=False)
    await eventually(lambda: outbox.counters.write_errors, "the write has failed")
    await outbox.close()
    with pytest.raises(OutboxError, match="closed while it could not be written"):
        await waiting
    assert outbox.counters.lost == 1
    assert "lost 1 messages" in caplog.text


@pytest.mark.parametrize("damage", ["garbage", "torn", "page"])
async def test_a_corrupt_file_is_set_aside_and_numbers_go_on(tmp_path, damage, caplog):
    path = tmp_path / "outbox.sqlite"
    first = await opened(path)
    last = [await first.append(TOPIC, lambda n: b"x" * 3000, retain=True) for _ in range(30)][-1]
    await first.close()
    whole = path.read_bytes()
    path.write_bytes(
        {
            "garbage": b"not a database at all" * 100,
            "torn": whole[: len(whole) // 2],
            "page": whole[:4096] + b"\xff" * 8192 + whole[12288:],
        }[damage]
    )
    second = await opened(path)
    assert second.counters.quarantined == 1
    assert "set aside as" in caplog.text
    assert len(list(tmp_path.glob("outbox.sqlite.corrupt-*"))) == 1
    assert await second.append(TOPIC, payload, retain=True) > last
    await second.close()


async def test_a_file_that_breaks_while_it_is_open_is_replaced(tmp_path, connections):
    path = tmp_path / "outbox.sqlite"
    outbox = await opened(path)
    last = await outbox.append(TOPIC, payload, retain=False)
    connections[-1].execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connections[-1].execute("PRAGMA cache_size = 0")
    with path.open("r+b") as file:
        file.write(b"\xff" * path.stat().st_size)
    assert await outbox.append(TOPIC, payload, retain=False) > last
    assert outbox.counters.quarantined == 1
    assert outbox.counters.depth == 1
    await outbox.close()


async def test_a_file_that_cannot_be_read_is_replaced_by_what_can_be_saved(outbox, monkeypatch):
    """A bad sector: the same page fails again and again, while others can be read."""
    numbers = [await outbox.append(TOPIC, payload, retain=True) for _ in range(5)]
    journal = outbox._journal
    file, pending = journal._connection, journal.pending

    def bad_sector(after, limit):
        if journal._connection is file:
            error = sqlite3.OperationalError("disk I/O error")
            error.sqlite_errorcode = sqlite3.SQLITE_IOERR_READ
            raise error
        return pending(after, limit)

    monkeypatch.setattr(journal, "pending", bad_sector)
    waiting = asyncio.create_task(outbox.pending(0, 10))
    later = await outbox.append(TOPIC, payload, retain=True)
    assert [m.sequence for m in await waiting] == [*numbers, later]
    assert outbox.counters.read_errors == 3
    assert outbox.counters.quarantined == 1
    assert outbox.counters.depth == 6


async def test_numbers_go_on_though_everything_is_lost_and_the_wall_clock_was_set_back(tmp_path):
    path = tmp_path / "outbox.sqlite"
    first = await opened(path)
    last = await first.append(TOPIC, payload, retain=True)
    await first.close()
    path.unlink()
    second = Outbox(path, SettableClock(wall_ns=1))
    await second.open()
    assert await second.append(TOPIC, payload, retain=True) > last
    await second.close()


async def test_the_latest_of_each_topic_is_known_whether_it_is_sent_or_not(tmp_path):
    outbox = await opened(tmp_path / "outbox.sqlite")
    first, second, other = [await outbox.append(topic, payload, retain=True) for topic in ("a", "a", "b")]
    await outbox.append("telemetry", payload, retain=False)
    outbox.mark_sent(first)
    outbox.mark_sent(second)
    await eventually(lambda: outbox.counters.depth == 2, "both are marked")
    assert [message.sequence for message in await outbox.latest()] == [second, other]
    assert [message.sequence for message in await outbox.retained()] == [second]
    await outbox.close()


async def test_the_journal_of_sent_messages_is_bounded(tmp_path):
    outbox = await opened(tmp_path / "outbox.sqlite", limits=OutboxLimits(alarms_max_bytes=0))
    old = await outbox.append("old/but/retained", payload, retain=True)
    sequences = await asyncio.gather(*[outbox.submit(TOPIC, payload, retain=False) for _ in range(600)])
    for sequence in [old, *sequences]:
        outbox.mark_sent(sequence)
    await eventually(lambda: outbox.counters.depth == 0, "all are marked")
    assert [m.sequence for m in await outbox.retained()] == [old]
    await outbox.close()
    with sqlite3.connect(tmp_path / "outbox.sqlite") as other:
        kept = [row[0] for row in other.execute("SELECT sequence FROM messages ORDER BY sequence")]
    other.close()
    assert kept[0] == old
    assert len(kept) <= 1 + TRIM_EVERY
    assert kept == [old, *sequences[len(sequences) + 1 - len(kept) :]]


async def test_a_store_that_was_refused_is_free_when_that_is_told(tmp_path, monkeypatch):
    with contextlib.closing(sqlite3.connect(tmp_path / "newer.sqlite")) as newer:
        newer.execute("PRAGMA user_version = 99")
    close = Journal.close
    # A busy machine may leave the writer's thread alone just then.
    monkeypatch.setattr(Journal, "close", lambda journal: (time.sleep(0.2), close(journal)))
    for _ in range(2):
        with pytest.raises(OutboxError, match="schema version 99"):
            await opened(tmp_path / "newer.sqlite")


async def test_what_cannot_be_used_is_said_with_a_remedy(tmp_path):
    (tmp_path / "file").write_text("not a directory")
    with pytest.raises(StorePathError, match="file is no directory, but a file: name a directory"):
        await opened(tmp_path / "file" / "outbox.sqlite")
    newer = sqlite3.connect(tmp_path / "newer.sqlite")
    newer.execute("PRAGMA user_version = 99")
    newer.close()
    with pytest.raises(OutboxError, match="schema version 99, written by a newer version of daqsvc"):
        await opened(tmp_path / "newer.sqlite")
    (tmp_path / "newer.sqlite.version").write_text("9.9.0\n")
    with pytest.raises(NewerOutboxError, match=r"written by daqsvc 9\.9\.0; .* install that version again"):
        await opened(tmp_path / "newer.sqlite")
    outbox = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    with pytest.raises(OutboxError, match="is not open yet"):
        outbox.mark_sent(1)
    await outbox.open()
    await outbox.close()
    with pytest.raises(OutboxError, match="is closed"):
        await outbox.append(TOPIC, payload, retain=False)


async def test_a_store_says_which_version_has_written_it(tmp_path):
    path = tmp_path / "outbox.sqlite"
    (tmp_path / "outbox.sqlite.version").write_text("0.0.1\n")
    outbox = await opened(path)
    await outbox.close()
    assert (tmp_path / "outbox.sqlite.version").read_text() == f"{daqsvc.__version__}\n"


CRASHER = """
import asyncio, os, pathlib, sys
from daqsvc.acquisition.clock import SystemClock
from daqsvc.outbox.store import Outbox

async def main():
    outbox = Outbox(pathlib.Path(sys.argv[1]), SystemClock())
    await outbox.open()
    while True:
        futures = [outbox.submit("t", lambda n: str(n).encode(), retain=False) for _ in range(7)]
        for sequence in await asyncio.gather(*futures):
            os.write(1, b"%d\\n" % sequence)

asyncio.run(main())
"""


async def test_kill_minus_nine_loses_nothing_that_was_promised(tmp_path):
    path = tmp_path / "outbox.sqlite"
    promised = []
    for wanted in (1, 40, 150):
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", textwrap.dedent(CRASHER), str(path), stdout=subprocess.PIPE
        )
        lines = []
        while len(lines) < wanted:
            lines.append(await process.stdout.readline())
        process.kill()
        lines += (await process.stdout.read()).splitlines(keepends=True)
        await process.wait()
        promised += [int(line) for line in lines if line.endswith(b"\n")]
    assert promised == sorted(set(promised))
    outbox = await opened(path)
    assert outbox.counters.quarantined == 0
    there = [m.sequence for m in await outbox.pending(0, 10**6)]
    assert set(there).issuperset(promised)
    jumps = [after - before for before, after in itertools.pairwise(there) if after != before + 1]
    assert len(jumps) == 2, "one for each kill"
    assert all(jump <= STEP + UNRECORDED for jump in jumps)
    await outbox.close()


async def test_a_store_belongs_to_one_service_at_a_time(tmp_path):
    first = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    await first.open()
    second = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    with pytest.raises(
        OutboxError, match=r"another daqsvc uses the store .*; or have one service watch all"
    ) as refused:
        await second.open()
    assert refused.value.code.id == "S03"
    had("S03", refused.value)
    await second.close()
    await first.close()
    third = Outbox(tmp_path / "outbox.sqlite", SystemClock())
    await third.open()
    await third.close()
