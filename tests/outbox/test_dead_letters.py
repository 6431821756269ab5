"""What the broker refuses: kept in order, over restarts and damage, and no more than is sensible."""

from __future__ import annotations

import asyncio
import contextlib
import sqlite3

import pytest
from support.crashing import dies_at

from daqsvc.outbox import dead_letters
from daqsvc.outbox.dead_letters import DeadLetters
from daqsvc.outbox.messages import OutboxError, OutboxMessage, checksum


@pytest.fixture
def path(tmp_path):
    return tmp_path / "refused.sqlite"


def at(path):
    return DeadLetters(path, lambda: 10**18)


def message(number, topic="a"):
    return OutboxMessage(number, topic, b"%d" % number, retain=True)


async def test_letters_survive_a_restart_in_their_order(path):
    letters = at(path)
    assert not await letters.hold(message(1)), "nothing was refused yet"
    await letters.put(message(2), "not allowed")
    assert await letters.hold(message(3))
    assert not await letters.hold(message(4, "b"))
    letters = at(path)
    await letters.load()
    assert letters.reasons == {"a": "not allowed"}
    assert letters.waiting == 2
    for number in (2, 3):
        found = await letters.oldest("a")
        assert found == message(number)
        await letters.remove(found)
    assert await letters.oldest("a") is None
    assert letters.reasons == {}


async def test_a_letter_that_was_overtaken_is_not_retained_any_more(path):
    letters = at(path)
    await letters.put(message(1), "quota")
    await letters.overtake(message(2))
    assert not (await letters.oldest("a")).retain


async def test_a_letter_that_is_put_twice_is_kept_once(path):
    letters = at(path)
    await letters.put(message(1), "x")
    await letters.put(message(1), "y")
    assert (letters.waiting, letters.reasons["a"]) == (1, "y")


async def test_of_one_topic_the_newest_are_kept(path, monkeypatch, caplog):
    monkeypatch.setattr(dead_letters, "MOST_OF_A_TOPIC", 10)
    letters = at(path)
    for number in range(1, 31):
        await letters.put(message(number), "x")
    await letters.put(message(31, "b"), "x")
    assert (letters.waiting, letters.dropped) == (11, 20)
    assert (await letters.oldest("a")).sequence == 21
    assert caplog.text.count("are refused; the oldest are dropped") == 1


async def test_a_damaged_file_is_set_aside_and_said(path, caplog):
    letters = at(path)
    await letters.put(message(1), "x")
    path.write_bytes(b"no database at all" * 1000)
    await letters.put(message(2), "x")
    assert letters.waiting == 1
    assert "is damaged" in caplog.text
    assert list(path.parent.glob("refused.sqlite.corrupt-*"))


async def test_a_file_of_a_newer_version_is_kept_for_it_and_is_no_damage(path, caplog):
    await at(path).put(message(1), "x")
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA user_version = 99")
    letters = at(path)
    await letters.put(message(2), "x")
    assert (letters.waiting, letters.dropped) == (1, 0)
    [kept] = path.parent.glob("refused.sqlite.version-99-*")
    [told] = [record.getMessage() for record in caplog.records]
    assert told.startswith(f"{path} was written by a newer version of daqsvc")
    kept.rename(path)
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA user_version = 0")
    assert (await at(path).oldest("a")).sequence == 1, "as the newer version finds it"


async def test_a_letter_that_has_changed_on_the_disk_is_not_sent(path, caplog):
    letters = at(path)
    await letters.put(message(1), "x")
    await letters.put(message(2), "x")
    path.write_bytes(path.read_bytes())  # the log is in the file by now
    import sqlite3

    with sqlite3.connect(path) as file:
        file.execute("UPDATE letters SET payload = ? WHERE sequence = 1", (b"7",))
    file.close()
    assert (await letters.oldest("a")).sequence == 2
    assert "has changed on the disk" in caplog.text


async def test_a_file_that_cannot_be_is_an_error_with_its_name(path):
    path.mkdir()
    with pytest.raises(OutboxError, match=r"refused messages in .*refused\.sqlite"):
        await at(path).put(message(1), "x")


async def test_whoever_is_cancelled_leaves_nothing_half_done(path):
    letters = at(path)
    tasks = [asyncio.create_task(letters.put(message(n), "x")) for n in range(1, 6)]
    await asyncio.sleep(0.005)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    known = letters.waiting
    await letters.load()
    assert letters.waiting == known


def damaged(path, count=200):
    """A file with a page that nobody can read; the numbers of letters on other pages."""
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as made:
        dead_letters._make(made)
        made.execute("BEGIN")
        for number in range(count):
            payload = b"%d " % number * 100
            told = checksum(number, f"t/{number % 3}", payload)
            made.execute(
                "INSERT INTO letters VALUES (?, ?, ?, 1, 'no', 0, ?)",
                (number, f"t/{number % 3}", payload, told),
            )
        made.execute("COMMIT")
    content = bytearray(path.read_bytes())
    begin = content.index(b"%d " % (count // 2) * 100) // 4096 * 4096
    on_page = [n for n in range(count) if b"%d " % n * 100 in content[begin : begin + 4096]]
    content[begin : begin + 4096] = b"\xff" * 4096
    path.write_bytes(content)
    return set(range(count)) - set(range(min(on_page) - 1, max(on_page) + 2))


def numbers(path):
    letters = at(path)
    letters._work(lambda connection: None)
    with contextlib.closing(sqlite3.connect(path)) as there:
        return {row[0] for row in there.execute("SELECT sequence FROM letters")}, letters


async def test_of_a_damaged_file_what_can_be_read_is_kept(path, caplog):
    readable = damaged(path)
    kept, letters = await asyncio.to_thread(numbers, path)
    assert kept >= readable
    assert letters.waiting == len(kept) > 150
    assert f"{len(kept)} can be read and are kept" in caplog.text
    assert len(list(path.parent.glob("refused.sqlite.corrupt-*"))) == 1
    assert (await letters.oldest("t/0")).sequence == 0


def test_a_crash_while_a_damaged_file_is_replaced_loses_nothing_that_can_be_read(tmp_path):
    step = 1
    while True:
        path = tmp_path / f"{step}" / "refused.sqlite"
        path.parent.mkdir()
        readable = damaged(path, 60)
        done = dies_at(step, lambda path=path: at(path)._work(lambda connection: None))
        kept, _ = numbers(path)
        assert kept >= readable, f"died before step {step}"
        assert not path.with_name("refused.sqlite.saved").exists()
        if done < step:
            break
        step += 4
    assert step > 20
