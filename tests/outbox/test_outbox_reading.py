"""The journal as another process reads it: with a service, without, after a crash, read-only, absent."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from daqsvc.acquisition.clock import SystemClock
from daqsvc.outbox import reading
from daqsvc.outbox.messages import NewerOutboxError, OutboxError
from daqsvc.outbox.reading import JOURNAL_NAME, read_journal, read_pasts, refuse_newer_header
from daqsvc.outbox.store import Outbox

pytestmark = pytest.mark.integration
READER = """
import pathlib, sys
from daqsvc.outbox.reading import read_journal
view = read_journal(pathlib.Path(sys.argv[1]))
print([entry.sequence for entry in view.latest], [entry.sequence for entry in view.history], view.unsent)
"""


def read_elsewhere(store):
    return subprocess.run(
        [sys.executable, "-c", READER, str(store)], check=True, capture_output=True, text=True
    ).stdout.strip()


def names(store):
    """The journal's files; those of telemetry come and go in their own time."""
    return sorted(path.name for path in store.glob(f"{JOURNAL_NAME}*"))


@contextlib.contextmanager
def read_only(directory):
    mounted = subprocess.run(["mount", "--bind", directory, directory], check=False, capture_output=True)
    if mounted.returncode:
        pytest.skip("this machine lets no test mount a file system")
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", directory], check=True)
        yield
    finally:
        subprocess.run(["umount", directory], check=True)


def holds_a_read_lock(path):
    locks = [line.split() for line in Path("/proc/locks").read_text(encoding="ascii").splitlines()]
    wanted = {"POSIX", "READ", str(os.getpid())}
    return any(wanted <= set(lock) and f":{path.stat().st_ino} " in f"{' '.join(lock)} " for lock in locks)


@pytest.fixture
async def outbox(tmp_path):
    outbox = Outbox(tmp_path / "store" / JOURNAL_NAME, SystemClock())
    await outbox.open()
    await outbox.pending_telemetry(0, 1)  # its files are there, too, and hold still while they are copied
    yield outbox
    await outbox.close()


async def filled(outbox):
    """Three messages: the first is sent, the last two are the latest of their topics."""
    numbers = [
        await outbox.append(topic, lambda n: b"number %d" % n, retain=True) for topic in ("a", "a", "b")
    ]
    outbox.mark_sent(numbers[0])
    await outbox.pending(0, 1)
    return numbers


async def test_it_is_read_while_the_service_runs(outbox, tmp_path):
    first, second, other = await filled(outbox)
    view = read_journal(tmp_path / "store")
    assert [(e.sequence, e.topic, e.sent, e.retain) for e in view.history] == [
        (first, "a", True, True),
        (second, "a", False, True),
        (other, "b", False, True),
    ]
    assert [entry.sequence for entry in view.latest] == [second, other]
    assert all(entry.payload == b"number %d" % entry.sequence for entry in view.history)
    assert abs(view.history[0].wall_ns - SystemClock().wall_ns()) < 60e9
    assert (view.unsent, view.damaged) == (2, 0)
    before = names(tmp_path / "store")
    assert read_elsewhere(tmp_path / "store") == f"[{second}, {other}] [{first}, {second}, {other}] 2"
    assert names(tmp_path / "store") == before
    # The reader has neither locked nor moved anything.
    assert await outbox.append("a", lambda n: b"", retain=True) == other + 1


async def test_only_so_many(outbox, tmp_path):
    _, *newest = await filled(outbox)
    assert [e.sequence for e in read_journal(tmp_path / "store", history=2).history] == newest


async def test_the_pasts_of_many_topics_come_from_one_walk_back(outbox, tmp_path, monkeypatch):
    topics = [f"alarm-{number}" for number in range(40)]
    for turn in range(5):
        for topic in topics:
            await outbox.append(topic, lambda _, turn=turn: b"%d" % turn, retain=True)
    opened = []
    really = reading.opened_to_read
    monkeypatch.setattr(reading, "opened_to_read", lambda path: opened.append(path) or really(path))
    looked = []

    def is_over(entry):
        looked.append(entry.sequence)
        return entry.payload == (b"1" if entry.topic == "alarm-7" else b"0")

    asked = [*topics[:20], "of-nobody"]
    pasts = read_pasts(tmp_path / "store", asked, is_over, most=4)
    told = {topic: [entry.payload for entry in past] for topic, past in pasts.items()}
    whole = [b"1", b"2", b"3", b"4"]
    assert told == dict.fromkeys(topics[:20], whole) | {"alarm-7": whole[1:], "of-nobody": []}
    assert all(past == sorted(past, key=lambda entry: entry.sequence) for past in pasts.values())
    assert len(opened) == 1
    assert looked == sorted(looked, reverse=True)
    short = read_pasts(tmp_path / "store", topics[:1], lambda _: False, most=2)
    assert [entry.payload for entry in short[topics[0]]] == whole[2:]


async def test_it_is_read_without_a_service_and_nothing_is_left_behind(outbox, tmp_path):
    numbers = await filled(outbox)
    await outbox.close()
    before = names(tmp_path / "store")
    assert read_elsewhere(tmp_path / "store") == f"{numbers[1:]} {numbers} 2"
    assert names(tmp_path / "store") == before


@pytest.mark.parametrize("index", [True, False], ids=["with index", "without index"])
async def test_what_a_killed_service_left_is_read_whole(outbox, tmp_path, index):
    """The newest messages stand only in the write-ahead log then."""
    numbers = await filled(outbox)
    crashed = tmp_path / "crashed"
    shutil.copytree(tmp_path / "store", crashed)
    assert (crashed / f"{JOURNAL_NAME}-wal").stat().st_size > 0
    if not index:
        (crashed / f"{JOURNAL_NAME}-shm").unlink()
    before = names(crashed)
    assert read_elsewhere(crashed) == f"{numbers[1:]} {numbers} 2"
    assert names(crashed) == before


async def test_a_store_that_may_only_be_read(outbox, tmp_path):
    """A read-only file system, as far as a test that may run as root can make one."""
    numbers = await filled(outbox)
    crashed = tmp_path / "crashed"
    shutil.copytree(tmp_path / "store", crashed)
    with read_only(crashed):
        with pytest.raises(OSError, match="Read-only"):
            (crashed / "new").touch()
        assert [entry.sequence for entry in read_journal(crashed).history] == numbers


def test_a_store_without_a_journal_says_where_to_look(tmp_path):
    with pytest.raises(OutboxError, match=r"there is no journal .*see --store .*`directory` in \[store\]"):
        read_journal(tmp_path)
    with pytest.raises(OutboxError, match="there is no journal"):
        read_journal(tmp_path / "nowhere")


def test_what_is_no_journal_is_said_to_be_none(tmp_path):
    (tmp_path / JOURNAL_NAME).write_bytes(b"not a database" * 1000)
    with pytest.raises(OutboxError, match="cannot be read: file is not a database"):
        read_journal(tmp_path)


@pytest.mark.parametrize("content", [b"", "a header"])
def test_a_journal_that_was_never_written_is_said_to_be_empty(tmp_path, content):
    """So a disk that was full at the first start leaves it."""
    if content:
        with sqlite3.connect(tmp_path / JOURNAL_NAME) as other:
            other.execute("PRAGMA journal_mode = DELETE")
        other.close()
    else:
        (tmp_path / JOURNAL_NAME).write_bytes(b"")
    with pytest.raises(OutboxError, match=r"is empty: .* make room on the disk"):
        read_journal(tmp_path)


@pytest.mark.parametrize(("version", "remedy"), [(1, "start the service once"), (99, "use the program")])
def test_another_version_is_named(tmp_path, version, remedy):
    with sqlite3.connect(tmp_path / JOURNAL_NAME) as other:
        other.execute(f"PRAGMA user_version = {version}")
    other.close()
    with pytest.raises(OutboxError, match=f"has schema version {version}.*{remedy}"):
        read_journal(tmp_path)


def test_a_newer_version_is_seen_in_the_header_of_a_regular_file_alone(tmp_path):
    """Root looks so where others may put files: no link is followed, and no pipe waited for."""
    path, kept = tmp_path / JOURNAL_NAME, tmp_path / "kept"
    refuse_newer_header(path)
    for version in (99, 2, -1):
        with contextlib.closing(sqlite3.connect(path)) as file:
            file.execute(f"PRAGMA user_version = {version}")
        with (
            pytest.raises(NewerOutboxError, match=r"version 99")
            if version == 99
            else contextlib.nullcontext()
        ):
            refuse_newer_header(path)
        if version == 99:
            shutil.copy(path, kept)
    newer = kept.read_bytes()
    for content in (b"", newer[:99], b"X" + newer[1:]):
        path.write_bytes(content)
        refuse_newer_header(path)
    for make in (lambda: path.symlink_to(kept), lambda: os.mkfifo(path), path.mkdir):
        path.unlink()
        make()
        refuse_newer_header(path)


async def test_a_message_that_has_changed_on_the_disk_is_left_out_and_counted(outbox, tmp_path):
    first, second, other = await filled(outbox)
    await outbox.close()
    path = tmp_path / "store" / JOURNAL_NAME
    path.write_bytes(path.read_bytes().replace(b"number %d" % second, b"NUMBER %d" % second))
    view = read_journal(tmp_path / "store")
    assert [entry.sequence for entry in view.history] == [first, other]
    assert [entry.sequence for entry in view.latest] == [other]
    assert view.damaged == 1


async def test_reading_in_the_service_itself_does_not_undo_its_locks(outbox, tmp_path):
    """Closing any handle of a file frees all POSIX locks that the process has on it."""
    await filled(outbox)
    read_journal(tmp_path / "store")
    assert holds_a_read_lock(tmp_path / "store" / JOURNAL_NAME)
