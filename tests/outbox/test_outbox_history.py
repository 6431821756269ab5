"""What the journal keeps of what is sent, what it says of numbers, and files of earlier versions."""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import sqlite3
import subprocess
import zlib
from pathlib import Path

import pytest
from support.journal_commits import commit

import daqsvc
from daqsvc.outbox import files, sequence
from daqsvc.outbox import journal as journal_module
from daqsvc.outbox.ballast import Ballast
from daqsvc.outbox.files import ASIDE_KEPT, free_bytes
from daqsvc.outbox.journal import TRIM_EVERY, Journal
from daqsvc.outbox.limits import MIB, NS_PER_DAY, OutboxLimits
from daqsvc.outbox.messages import Draft, NewerOutboxError, OutboxAwayError, OutboxError
from daqsvc.outbox.reading import read_journal

SIZE = 1000


class Wall:
    ns = 10**18

    def __call__(self):
        return self.ns


@pytest.fixture
def wall():
    return Wall()


def opened(path, wall, **limits):
    journal = Journal(path, wall, OutboxLimits(ballast_bytes=0, **limits))
    journal.open()
    return journal


def append(journal, count, topic="t", *, sent=True):
    drafts = [Draft(topic, lambda n: b"%d " % n + b"x" * SIZE, retain=True)] * count
    numbers, _ = commit(journal, drafts, [])
    if sent:
        for begin in range(0, count, TRIM_EVERY):
            commit(journal, [], numbers[begin : begin + TRIM_EVERY])
    return numbers


def kept(path):
    with sqlite3.connect(path) as other:
        numbers = [row[0] for row in other.execute("SELECT sequence FROM messages ORDER BY sequence")]
    other.close()
    return numbers


def test_the_oldest_that_are_sent_go_beyond_the_size_and_the_file_stays_within(tmp_path, wall):
    path = tmp_path / "outbox.sqlite"
    journal = opened(path, wall, alarms_max_bytes=MIB)
    only = append(journal, 1, topic="once, long ago")
    unsent = append(journal, 1, topic="waiting", sent=False)
    numbers = []
    for _ in range(8):
        numbers += append(journal, 1000)
    assert [m.sequence for m in journal.pending(0, 10)] == unsent
    journal.close()
    left = kept(path)
    assert left[:2] == [*only, *unsent]
    assert left[2:] == numbers[len(numbers) - len(left) + 2 :]
    assert 0.2 * MIB < len(left) * SIZE < 1.4 * MIB  # a look at the limit for each 256 messages
    assert path.stat().st_size < 5 * MIB  # after 8 MB: the pages are used again


@pytest.mark.long
def test_a_file_that_was_large_gives_its_room_back(tmp_path, wall):
    """A backlog of a long outage is gone in the end, and so is the room that it took."""
    path = tmp_path / "outbox.sqlite"
    journal = opened(path, wall, alarms_max_bytes=MIB)
    backlog = append(journal, 30_000, sent=False)
    for begin in range(0, len(backlog), TRIM_EVERY):
        commit(journal, [], backlog[begin : begin + TRIM_EVERY])
    for _ in range(30):
        append(journal, TRIM_EVERY)
    journal.close()
    assert path.stat().st_size < 16 * MIB


def test_what_is_sent_goes_when_it_is_old_but_the_newest_stay(tmp_path, wall):
    path = tmp_path / "outbox.sqlite"
    limits = {"alarms_keep_ns": 30 * NS_PER_DAY, "alarms_keep_at_least": 100}
    journal = opened(path, wall, **limits)
    old = append(journal, 500)
    journal.close()
    wall.ns += 20 * NS_PER_DAY
    journal = opened(path, wall, **limits)
    young = append(journal, 50)
    journal.close()
    wall.ns += 20 * NS_PER_DAY
    opened(path, wall, **limits).close()
    assert kept(path) == [*old[-50:], *young]
    wall.ns += 3650 * NS_PER_DAY  # a wall clock that is wrong must not cost the history
    opened(path, wall, **limits).close()
    assert kept(path) == [*old[-50:], *young]


def test_a_look_at_the_limits_costs_the_same_however_long_the_history_is(tmp_path, wall):
    """Counted in steps of SQLite's virtual machine: 20 times the history, hardly more work."""

    def steps_of_a_trim(count):
        journal = opened(tmp_path / f"{count}.sqlite", wall)
        append(journal, count)
        steps = []
        connection = journal._connection
        connection.set_progress_handler(lambda: steps.append(1), 100)
        with connection:
            journal._trim(connection)
        connection.set_progress_handler(None, 0)
        journal.close()
        return len(steps)

    assert steps_of_a_trim(20_000) < 1.5 * steps_of_a_trim(2_000)


FIRST_VERSION = """
CREATE TABLE messages (sequence INTEGER PRIMARY KEY AUTOINCREMENT, topic TEXT NOT NULL, payload BLOB NOT NULL,
    retain INTEGER NOT NULL, sent INTEGER NOT NULL DEFAULT 0);
CREATE INDEX unsent ON messages (sequence) WHERE NOT sent;
CREATE INDEX retained ON messages (topic, sequence) WHERE retain;
INSERT INTO messages VALUES (5, 'a', x'41', 1, 1), (6, 'a', x'42', 1, 0), (7, 'b', x'43', 0, 0);
PRAGMA user_version = 1;
"""


def test_a_file_of_the_first_version_is_taken_over(tmp_path, wall):
    path = tmp_path / "outbox.sqlite"
    with sqlite3.connect(path) as first:
        first.executescript(FIRST_VERSION)
    first.close()
    path.with_name("outbox.sqlite.sequence").write_text("1031")  # how the side file was then
    journal = opened(path, wall)
    assert [(m.sequence, m.topic, m.payload, m.retain) for m in journal.pending(0, 10)] == [
        (6, "a", b"B", True),
        (7, "b", b"C", False),
    ]
    assert [m.sequence for m in journal.latest()] == [6]
    (next_number,) = append(journal, 1)
    assert next_number == wall() // files.NS_PER_MS + sequence.LEAP + 1
    assert journal.quarantined == 0
    journal.close()
    assert kept(path) == [5, 6, 7, next_number]
    with sqlite3.connect(path) as other:
        unguarded = other.execute("SELECT count(*) FROM messages WHERE checksum IS NULL").fetchone()
    other.close()
    assert unguarded == (0,), "what has no checksum cannot be saved from a corrupt file"


def test_a_journal_that_is_an_older_copy_is_told_and_gives_no_number_again(tmp_path, wall, caplog):
    path = tmp_path / "outbox.sqlite"
    journal = opened(path, wall)
    append(journal, 3)
    journal.close()
    copy = path.read_bytes()
    journal = opened(path, wall)
    last = append(journal, 5)[-1]
    journal.close()
    path.write_bytes(copy)
    journal = opened(path, wall)
    assert journal.vanished == 5
    assert "5 messages are gone from the disk" in caplog.text
    assert append(journal, 1) == [last + 1]
    journal.close()
    journal = opened(path, wall)
    assert journal.vanished == 5, "nobody has told the broker yet"
    journal.damage_is_reported()
    journal.close()
    journal = opened(path, wall)
    assert journal.vanished == 0, "it is told once"
    journal.close()


@pytest.mark.parametrize("boot", ["same boot", "after a power cut"])
def test_a_log_that_is_lost_brings_no_number_back(tmp_path, wall, monkeypatch, boot):
    """SQLite says nothing about it: a log that is gone, or cut off by a flipped bit, is a log that ended."""
    store = tmp_path / "store"
    journal = opened(store / "outbox.sqlite", wall)
    append(journal, 3)
    journal.close()
    journal = opened(store / "outbox.sqlite", wall)
    last = append(journal, 5)[-1]
    crashed = tmp_path / "crashed"
    shutil.copytree(store, crashed)
    journal.close()
    for suffix in ("-wal", "-shm"):
        (crashed / f"outbox.sqlite{suffix}").unlink()
    if boot != "same boot":
        monkeypatch.setattr(sequence, "boot_id", lambda: "another-boot")
    journal = opened(crashed / "outbox.sqlite", wall)
    [after] = append(journal, 1)
    assert last < after <= last + 1 + sequence.STEP + 2 * sequence.MARGIN
    assert journal.vanished == 5
    journal.close()


@pytest.mark.parametrize("which", ["sequence", "sequence.twin"])
@pytest.mark.parametrize(
    "damage", ["", "no number", "17", "1\n2\n3\n4", "00000000000000000017 what boot", "\xff\xff"]
)
def test_a_damaged_side_file_costs_nothing_while_the_journal_is_whole(tmp_path, wall, damage, which):
    path = tmp_path / "outbox.sqlite"
    journal = opened(path, wall)
    last = append(journal, 3)[-1]
    journal.close()
    path.with_name(f"outbox.sqlite.{which}").write_text(damage, encoding="latin-1")
    journal = opened(path, wall)
    assert journal.quarantined == journal.vanished == 0
    [after] = append(journal, 1)
    assert after > last + sequence.LEAP, "nobody knows what the damaged one knew"
    journal.close()
    journal = opened(path, wall)
    assert append(journal, 1) == [after + 1], "both are sound again"
    journal.close()


@pytest.mark.parametrize("ended", [True, False])
def test_a_side_file_of_an_earlier_version_is_understood(tmp_path, wall, caplog, ended):
    """It stood alone, and said nothing of the place."""
    path = tmp_path / "outbox.sqlite"
    journal = opened(path, wall)
    last = append(journal, 3)[-1]
    journal.close()
    mark = path.with_name("outbox.sqlite.sequence")
    mark.with_name(mark.name + ".twin").unlink()
    told = f"{last if ended else last + 500:020d} {last:020d} {sequence.boot_id()}"
    mark.write_text(f"{told} {zlib.crc32(told.encode()):08x}\n")
    journal = opened(path, wall)
    assert append(journal, 1) == [last + 1 if ended else last + 501 + 2 * sequence.MARGIN]
    assert "damaged" not in caplog.text
    journal.close()


@pytest.mark.parametrize("put_back", [False, True])
def test_a_copy_of_a_store_goes_on_at_the_clock(tmp_path, wall, put_back):
    """On another box or in the place of the original: what that has used since is below."""
    store, backup = tmp_path / "store", tmp_path / "backup"
    journal = opened(store / "outbox.sqlite", wall)
    append(journal, 3)
    journal.close()
    subprocess.run(["cp", "-a", store, backup], check=True)
    journal = opened(store / "outbox.sqlite", wall)
    last = append(journal, 50)[-1]
    journal.close()
    if put_back:
        shutil.rmtree(store)
        subprocess.run(["cp", "-a", backup, store], check=True)
    wall.ns += 10**9
    journal = opened((store if put_back else backup) / "outbox.sqlite", wall)
    assert append(journal, 1) == [wall() // files.NS_PER_MS + 1]
    assert append(journal, 1)[0] > last
    journal.close()


def test_a_system_without_boot_identity_is_taken_for_a_new_boot_each_time(tmp_path, wall, monkeypatch):
    monkeypatch.setattr(sequence, "_BOOT_ID", tmp_path / "nowhere")
    path = tmp_path / "outbox.sqlite"
    journal = opened(path, wall)
    last = append(journal, 3)[-1]
    journal._lock.close()  # kill -9
    again = opened(path, wall)
    [after] = append(again, 1)
    assert last + 1 < after <= last + 1 + sequence.STEP + sequence.UNRECORDED
    again.close()
    journal.close()


def run_on_a_disk_that_takes_no_writes(path, wall, monkeypatch, count):
    """The numbers that such a run gives to messages in memory; it leaves no trace."""

    def refuse(*_arguments, **_options):
        raise OSError(errno.EROFS, "Read-only file system")

    with monkeypatch.context() as patches:
        for module, name in (
            (journal_module, "connect"),
            (sequence, "overwrite_durably"),
            (sequence, "replace_durably"),
        ):
            patches.setattr(module, name, refuse)
        patches.setattr(sequence._Side, "note", refuse)
        journal = Journal(path, wall, OutboxLimits(ballast_bytes=0))
        with pytest.raises(OutboxAwayError):
            journal.open()
        told = [journal.number([Draft("t", lambda _: b"x", retain=True)])[0].sequence for _ in range(count)]
        journal.close()
    return told


@pytest.mark.parametrize("runs", list(itertools.product(["in order", "killed", "read-only"], repeat=3)))
def test_numbers_rise_over_runs_that_the_disk_never_heard_of(tmp_path, wall, monkeypatch, runs):
    path = tmp_path / "outbox.sqlite"
    last = 0
    killed = []
    for number, how in enumerate(runs):
        wall.ns += 60 * 10**9
        if how == "read-only":
            told = run_on_a_disk_that_takes_no_writes(path, wall, monkeypatch, 50)
        else:
            journal = opened(path, wall)
            told = append(journal, 50)
            if how == "killed":
                journal._lock.close()
                killed.append(journal)
            else:
                journal.close()
        assert told[0] > last, f"run {number} of {runs}"
        assert told == sorted(set(told))
        last = told[-1]
        # Not a lead that a run without a disk could fall behind of.
        assert last < wall.ns // files.NS_PER_MS + 1000
    for journal in killed:
        journal.close()


def test_kills_in_quick_succession_bring_no_number_back(tmp_path, wall, monkeypatch):
    """The numbers are ahead of the clock then; the clock has overtaken them after a while."""
    path, last, killed = tmp_path / "outbox.sqlite", 0, []
    for _ in range(4):
        wall.ns += 10**9
        journal = opened(path, wall)
        told = append(journal, 20)
        assert told[0] > last
        last = told[-1]
        journal._lock.close()
        killed.append(journal)
    wall.ns += 10**9
    unread = run_on_a_disk_that_takes_no_writes(path, wall, monkeypatch, 20)
    assert unread[0] > last
    journal = opened(path, wall)
    [after] = append(journal, 1)
    assert unread[-1] < after < wall.ns // files.NS_PER_MS + 20 * sequence.MARGIN
    for one in (journal, *killed):
        one.close()


def test_only_so_many_corrupt_files_are_kept(tmp_path, wall):
    path = tmp_path / "outbox.sqlite"
    for number in range(ASIDE_KEPT + 3):
        path.write_bytes(b"not a database %d" % number * 100)
        os.utime(path, ns=(number * 10**9, number * 10**9))
        opened(path, wall).close()
    aside = {p.read_bytes() for p in tmp_path.glob("outbox.sqlite.corrupt-*")}
    assert aside == {b"not a database %d" % n * 100 for n in range(3, ASIDE_KEPT + 3)}


def test_new_names_are_durable_before_they_are_relied_on(tmp_path, wall, monkeypatch):
    """A name that is not synced is gone after a power cut, and with it what was in the file."""
    synced = []
    real = os.fsync

    def spy(handle):
        synced.append(str(Path(f"/proc/self/fd/{handle}").readlink()))
        real(handle)

    monkeypatch.setattr(files.os, "fsync", spy)
    store = tmp_path / "new" / "store"
    journal = opened(store / "outbox.sqlite", wall)
    assert synced[:2] == [str(tmp_path), str(tmp_path / "new")]
    append(journal, 1)
    mark = str(store / "outbox.sqlite.sequence.new")
    assert synced.index(mark) < len(synced) - 1
    assert synced[synced.index(mark) + 1] == str(store)
    journal.close()


def test_ballast_is_taken_where_there_is_room_and_thrown_off_once(tmp_path):
    ballast = Ballast(tmp_path / "ballast", MIB, reserve_bytes=0)
    ballast.allocate()
    assert (tmp_path / "ballast").stat().st_blocks * 512 >= MIB
    assert ballast.throw_off()
    assert not ballast.throw_off()
    Ballast(tmp_path / "ballast", MIB, reserve_bytes=free_bytes(tmp_path)).allocate()
    assert not (tmp_path / "ballast").exists()


@pytest.mark.parametrize("version", [-1, 0, 1, 99, 258, 1 << 25])
@pytest.mark.parametrize("names_the_version", [True, False])
def test_a_damaged_version_number_costs_no_message_and_no_start(tmp_path, wall, version, names_the_version):
    path = tmp_path / "outbox.sqlite"
    journal = opened(path, wall)
    numbers = append(journal, 3)
    journal.close()
    if not names_the_version:
        path.with_name("outbox.sqlite.version").unlink()
    with sqlite3.connect(path) as damaged:
        damaged.execute(f"PRAGMA user_version = {version}")
    damaged.close()
    with pytest.raises(
        OutboxError, match=f"schema version {version} .* the service sets a corrupt one aside"
    ):
        read_journal(tmp_path)
    journal = opened(path, wall)
    assert journal.quarantined == 1
    journal.close()
    assert kept(path) == numbers


NEWER = {
    "nothing but the number": "SELECT 1",
    "a table": "CREATE TABLE shifts (begun_ns INTEGER)",
    "an index": "CREATE INDEX by_time ON messages (wall_ns)",
    "a column of the messages": "ALTER TABLE messages ADD COLUMN author TEXT",
    "a column of the latest": "ALTER TABLE latest ADD COLUMN author TEXT",
}


@pytest.mark.parametrize(
    ("more", "writer"),
    [
        ("nothing but the number", "9.9.0"),
        *itertools.product(list(NEWER)[1:], ["9.9.0", daqsvc.__version__, ""]),
    ],
)
def test_a_journal_of_a_newer_version_is_refused_and_stays_as_it_is(tmp_path, wall, more, writer):
    """Also one whose version file was lost, or was put back."""
    path = tmp_path / "outbox.sqlite"
    journal = opened(path, wall)
    numbers = append(journal, 3)
    journal.close()
    path.with_name("outbox.sqlite.version").write_text(writer)
    with sqlite3.connect(path) as newer:
        newer.executescript(f"{NEWER[more]}; PRAGMA user_version = 99")
    newer.close()
    by = "daqsvc 9.9.0" if writer == "9.9.0" else "a newer version of daqsvc"
    with pytest.raises(OutboxError, match=f"has schema version 99, .* use the program .* runs, {by}"):
        read_journal(tmp_path)
    refused = Journal(path, wall, OutboxLimits(ballast_bytes=0))
    with pytest.raises(NewerOutboxError, match=f"has schema version 99, written by {by}; .* install that"):
        refused.open()
    refused.close()
    assert kept(path) == numbers
    assert not [*tmp_path.glob("*.corrupt-*")]
