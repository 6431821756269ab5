"""A write-ahead log with a wrong byte: for SQLite it ends there, for the journal no message may."""

from __future__ import annotations

import itertools
import shutil
import sqlite3

import pytest
from support.journal_commits import commit

from daqsvc.outbox import journal as journal_module
from daqsvc.outbox.journal import Journal
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.log_rows import rows_in
from daqsvc.outbox.messages import Draft

pytestmark = pytest.mark.integration
NAME = "outbox.sqlite"
FRAME_BYTES = 24 + 4096
LONG = 9


def text(number):
    """Every `LONG`th message needs pages of its own."""
    return (b"message %d " % number) * (1500 if number % LONG == 0 else 12)


def opened(path):
    clock = itertools.count(1_800_000_000_000_000_000, 1_000_000)
    journal = Journal(path, lambda: next(clock), OutboxLimits())
    journal.open()
    return journal


def append(journal, topic, *, retain=True):
    return commit(journal, [Draft(topic, text, retain=retain)], [])[0][0]


@pytest.fixture(autouse=True)
def _one_place(monkeypatch):
    """A copy of the store is taken for the store."""
    monkeypatch.setattr(journal_module, "place_of", lambda _lock: "here")


@pytest.fixture
def killed(tmp_path):
    """A store as kill -9 leaves it, and the numbers: an alarm that stands, sent long ago; others unsent."""
    path = tmp_path / "made" / NAME
    journal = opened(path)
    standing = append(journal, "alarms/standing")
    commit(journal, [], [standing])
    numbers = [append(journal, f"alarms/{n % 5}", retain=n % 2 == 0) for n in range(30)]
    shutil.copytree(path.parent, tmp_path / "killed")
    journal.close()
    for suffix in ("-shm", ".ballast"):
        (tmp_path / "killed" / f"{NAME}{suffix}").unlink()
    return tmp_path / "killed" / NAME, standing, numbers


def log_of(path):
    return path.with_name(f"{NAME}-wal")


def flip(path, at):
    content = bytearray(path.read_bytes())
    content[at] ^= 1
    path.write_bytes(content)


def expect_all(path, standing, numbers):
    """Nothing is missing, nothing is told, and the numbers go on."""
    journal = opened(path)
    try:
        assert [m.sequence for m in journal.pending(0, 1000) if m.sequence != standing] == numbers
        assert all(m.payload == text(m.sequence) for m in journal.pending(0, 1000))
        assert "alarms/standing" in {m.topic for m in journal.latest()}
        assert append(journal, "alarms/new") > numbers[-1]
        return journal.quarantined, journal.vanished
    finally:
        journal.close()


PLACES = {
    "in the header's salts": lambda _: 17,
    "in the header's page size": lambda _: 9,
    "at byte 200": lambda _: 200,
    "in the middle": lambda size: size // 2,
    "in the middle frame's header": lambda size: 32 + FRAME_BYTES * (size // FRAME_BYTES // 2) + 9,
    "in the last frame's checksum": lambda size: size - FRAME_BYTES + 17,
}


@pytest.mark.parametrize("place", PLACES)
def test_a_flipped_bit_in_the_log_costs_no_message(killed, place, caplog):
    path, *known = killed
    flip(log_of(path), PLACES[place](log_of(path).stat().st_size))
    assert expect_all(path, *known) == (0, 0)
    assert "are taken back from it" in caplog.text
    assert {p.name for p in path.parent.iterdir() if "log" in p.name or "corrupt" in p.name} == set()


@pytest.mark.long
def test_a_flipped_bit_costs_at_most_the_message_that_it_is_in_wherever_it_is(killed, tmp_path):
    path, standing, numbers = killed
    size = log_of(path).stat().st_size
    for at in range(0, size, size // 40):
        store = tmp_path / f"{at}"
        shutil.copytree(path.parent, store)
        flip(store / f"{NAME}-wal", at)
        journal = opened(store / NAME)
        missing = {standing, *numbers} - {m.sequence for m in journal.following(0, 1000)}
        assert len(missing) <= 1, f"byte {at}"
        assert journal.vanished == len(missing), f"byte {at}"
        assert append(journal, "alarms/new") > numbers[-1]
        journal.close()


@pytest.mark.parametrize("how", ["emptied", "deleted", "header"])
def test_a_journal_that_is_gone_but_for_its_log_has_its_messages_from_there(killed, how):
    path, *known = killed
    if how == "emptied":
        path.write_bytes(b"")
    elif how == "deleted":
        path.unlink()
    else:
        flip(log_of(path), 200)
        path.write_bytes(b"garbage!" * (path.stat().st_size // 8))
    quarantined, vanished = expect_all(path, *known)
    assert quarantined + vanished, "what was in the journal alone, nobody knows: that is told"


def test_a_log_of_which_something_is_missing_is_set_aside(killed):
    path, _, numbers = killed
    log = log_of(path).read_bytes()
    # The last message stands in one frame only, with its number as text.
    log_of(path).write_bytes(log.replace(b"message %d " % numbers[-1], b"massage %d " % numbers[-1]))
    journal = opened(path)
    assert journal.vanished == 1
    assert [m.sequence for m in journal.pending(0, 1000)][-len(numbers) + 1 :] == numbers[:-1]
    assert journal.set_aside is not None
    assert journal.set_aside.exists()
    assert len(rows_in(journal.set_aside.read_bytes())) >= len(numbers) - 1
    journal.close()


def test_a_start_that_is_killed_before_it_has_the_messages_leaves_them_to_the_next(killed, monkeypatch):
    path, *known = killed
    flip(log_of(path), 200)

    def dies(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "_take_back", dies)
        journal = Journal(path, lambda: 1_900_000_000_000_000_000, OutboxLimits())
        with pytest.raises(KeyboardInterrupt):
            journal.open()
        journal.close()
    assert not log_of(path).exists(), "SQLite has done away with it"
    assert expect_all(path, *known) == (0, 0)


def test_a_log_that_is_whole_is_read_as_sqlite_reads_it(killed):
    path, *_ = killed
    found = rows_in(log_of(path).read_bytes())
    with sqlite3.connect(path) as connection:
        stored = connection.execute("SELECT * FROM messages").fetchall()
    connection.close()
    assert {row[0]: row for row in stored} == found
