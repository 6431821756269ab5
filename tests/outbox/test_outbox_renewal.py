"""A corrupt journal is replaced while the process is killed at every step, or the disk is full at each."""

from __future__ import annotations

import shutil

import pytest
from support.crashing import dies_at
from support.journal_commits import commit
from support.small_disks import mounted

from daqsvc.outbox import journal as journal_module
from daqsvc.outbox.journal import Journal
from daqsvc.outbox.limits import MIB, OutboxLimits
from daqsvc.outbox.messages import Draft, OutboxAwayError
from daqsvc.outbox.reading import JOURNAL_NAME
from daqsvc.outbox.salvage import readable

pytestmark = pytest.mark.integration
LIMITS = OutboxLimits(ballast_bytes=0, reserve_bytes=0)
WALL_NS = 10**18
SENT, COUNT = 40, 120
PAGE = 4096


def opened(path, limits=LIMITS):
    journal = Journal(path, lambda: WALL_NS, limits)
    journal.open()
    return journal


def text(number):
    return (b"number %d " % number) * 30


@pytest.fixture(scope="module")
def damaged(tmp_path_factory):
    """A store as a kill leaves it, half of it in the log, with two bad pages; and what can be read of it."""
    directory = tmp_path_factory.mktemp("damaged")
    path = directory / "whole" / JOURNAL_NAME
    journal = opened(path)
    for begin in range(0, COUNT, 10):
        numbers, _ = commit(
            journal, [Draft(f"t/{n % 40}", text, retain=True) for n in range(begin, begin + 10)], []
        )
        if begin < SENT:
            commit(journal, [], numbers)
        if begin == COUNT // 2:
            journal._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    store = directory / "killed"
    shutil.copytree(path.parent, store)
    journal.close()
    (store / f"{JOURNAL_NAME}-shm").unlink()
    damaged = store / JOURNAL_NAME
    content = bytearray(damaged.read_bytes())
    for number in (WALL_NS // 10**6 + 1 + n for n in (25, 50)):
        page = content.index(text(number)) // PAGE
        content[page * PAGE : page * PAGE + 100] = b"\xff" * 100
    damaged.write_bytes(content)
    shutil.copytree(store, directory / "read")
    rows = list(readable(directory / "read" / JOURNAL_NAME))
    unsent = {row[0] for row in rows if not row[4]}
    latest = {}
    for row in rows:
        latest[row[1]] = max(row[0], latest.get(row[1], 0))
    assert len(unsent) > 50
    assert len(rows) < COUNT
    return store, unsent, latest, max(row[0] for row in rows)


@pytest.fixture
def _one_place(monkeypatch):
    """A copy of the store is taken for the store."""
    monkeypatch.setattr(journal_module, "place_of", lambda _lock: "here")


def check(path, unsent, latest, highest):
    """The store is opened again and knows everything; then go on."""
    journal = opened(path)
    try:
        assert journal.quarantined == 1
        assert {m.sequence for m in journal.pending(0, 10**6)} == unsent
        assert all(m.payload == text(m.sequence) for m in journal.pending(0, 10**6))
        assert {m.topic: m.sequence for m in journal.latest()} == latest
        assert commit(journal, [Draft("t", text, retain=True)], [])[0][0] > highest
    finally:
        journal.close()
    left = {path.name for path in path.parent.iterdir()}
    assert not {f"{JOURNAL_NAME}.draft", f"{JOURNAL_NAME}.saved"} & left
    return left


def killed_at_each(damaged, tmp_path, steps):
    store, *known = damaged
    step = 0
    for step in steps:
        path = tmp_path / f"{step}" / JOURNAL_NAME
        shutil.copytree(store, path.parent)
        done = dies_at(step, lambda path=path: opened(path))
        check(path, *known)
        shutil.rmtree(path.parent)
        if done < step:
            return done
    return step


@pytest.mark.long
@pytest.mark.usefixtures("_one_place")
def test_a_kill_at_any_step_loses_nothing_that_can_be_read(damaged, tmp_path):
    done = killed_at_each(damaged, tmp_path, range(1, 10_000, 16))
    assert done > 60, "that many things are done to files"


@pytest.mark.long
@pytest.mark.usefixtures("_one_place")
def test_a_kill_at_every_step_loses_nothing_that_can_be_read(damaged, tmp_path):
    assert killed_at_each(damaged, tmp_path, range(1, 10_000)) > 60


@pytest.mark.parametrize("step", [92, pytest.param(23, marks=pytest.mark.long)])
@pytest.mark.usefixtures("_one_place")
def test_a_kill_while_a_kill_is_made_good_loses_nothing(damaged, tmp_path, step):
    store, *known = damaged
    for first in range(5, 10_000, step):
        path = tmp_path / f"{first}" / JOURNAL_NAME
        shutil.copytree(store, path.parent)
        done = dies_at(first, lambda path=path: opened(path))
        for second in (7, 19, 31, 43):
            dies_at(second, lambda path=path: opened(path))
        check(path, *known)
        if done < first:
            return


def test_the_damage_is_told_until_somebody_has_told_it(damaged, tmp_path):
    path = tmp_path / "store" / JOURNAL_NAME
    shutil.copytree(damaged[0], path.parent)
    opened(path).close()
    again = opened(path)
    assert again.quarantined == 1
    again.damage_is_reported()
    again.close()
    last = opened(path)
    assert last.quarantined == 0
    last.close()


@pytest.mark.parametrize("cut", ["all renamed", "log not renamed", "nothing saved yet"])
def test_what_an_earlier_version_left_half_done_is_finished(damaged, tmp_path, cut):
    """It renamed first and saved afterwards."""
    store, unsent, latest, highest = damaged
    path = tmp_path / "store" / JOURNAL_NAME
    shutil.copytree(store, path.parent)
    aside = path.with_name(f"{JOURNAL_NAME}.corrupt-1795264095376")
    path.rename(aside)
    log = path.with_name(f"{JOURNAL_NAME}-wal")
    if cut != "log not renamed":
        log.rename(aside.with_name(aside.name + "-wal"))
    if cut == "nothing saved yet":
        new = Journal(path, lambda: WALL_NS, LIMITS)
        new._renewal.finish = lambda: None
        new._adopt = lambda: None
        new.open()
        new.damage_is_reported()
        new.close()
    left = check(path, unsent, latest, highest)
    assert aside.name in left
    journal = opened(path)
    journal.damage_is_reported()
    journal.close()
    journal = opened(path)
    assert journal.quarantined == 0, "it is counted once"
    journal.close()


@pytest.mark.parametrize("ballast_bytes", [0, MIB // 4])
@pytest.mark.usefixtures("_one_place")
def test_a_disk_that_is_full_at_any_step_loses_nothing(damaged, small_disk, ballast_bytes):
    store, *known = damaged
    limits = OutboxLimits(ballast_bytes=ballast_bytes, reserve_bytes=0)
    away = 0
    for leave in range(0, 44 * PAGE, 4 * PAGE):
        path = small_disk.directory / f"{leave}" / JOURNAL_NAME
        shutil.copytree(store, path.parent)
        if ballast_bytes:
            (path.with_name(f"{JOURNAL_NAME}.ballast")).write_bytes(bytes(ballast_bytes))
        small_disk.fill(leave)
        journal = Journal(path, lambda: WALL_NS, limits)
        try:
            journal.open()
        except OutboxAwayError:
            away += 1
        journal.close()
        small_disk.free()
        check(path, *known)
        shutil.rmtree(path.parent)
    assert away > 1


@pytest.fixture
def small_disk(tmp_path):
    with mounted(tmp_path / "disk", "1m") as disk:
        yield disk
