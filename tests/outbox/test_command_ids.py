"""Ids of commands: on disk before a command is obeyed, bounded, and read back from whatever is left."""

from __future__ import annotations

import errno
import random

import pytest

from daqsvc.outbox import command_ids
from daqsvc.outbox.command_ids import CommandIds

NOW, LATER = 10**18, 10**18 + 60 * 10**9


def remember(ids, identifier, *, until_ns=LATER, now_ns=NOW, machine="rig"):
    return ids.remember(machine, identifier, until_ns=until_ns, now_ns=now_ns)


def test_an_id_is_known_until_it_is_too_old_and_after_every_restart(tmp_path):
    path = tmp_path / "ids"
    assert remember(CommandIds(path), "a") == "new"
    ids = CommandIds(path)
    assert remember(ids, "a") == "known"
    assert remember(ids, "a", machine="pump") == "new"
    assert remember(ids, "a", now_ns=LATER, until_ns=LATER + 1) == "new"
    assert path.stat().st_mode & 0o777 == 0o600


def test_the_file_stays_small_and_forgets_nothing_that_could_come_again(tmp_path, monkeypatch):
    monkeypatch.setattr(command_ids, "REMEMBERED", 20)
    path = tmp_path / "ids"
    ids = CommandIds(path)
    for number in range(200):
        now_ns = NOW + number * 10**9
        assert remember(ids, f"n{number}", now_ns=now_ns, until_ns=now_ns + 10 * 10**9) == "new"
    assert path.stat().st_size < 60 * 50
    ids = CommandIds(path)
    for number in range(190, 200):
        assert remember(ids, f"n{number}", now_ns=now_ns) == "known"


def test_too_many_at_a_time_are_refused_over_restarts_too(tmp_path, monkeypatch):
    monkeypatch.setattr(command_ids, "REMEMBERED", 10)
    path = tmp_path / "ids"
    for number in range(10):
        assert remember(CommandIds(path), f"n{number}") == "new"
    assert remember(CommandIds(path), "n10") == "full"
    assert remember(CommandIds(path), "n0") == "known"
    assert remember(CommandIds(path), "n10", now_ns=LATER, until_ns=LATER + 1) == "new"


def test_of_a_damaged_file_every_whole_line_counts(tmp_path):
    path = tmp_path / "ids"
    for number in range(50):
        remember(CommandIds(path), f"n{number}")
    whole = path.read_bytes()
    dice = random.Random(1)
    for _ in range(25):
        spoilt = bytearray(whole)
        for _ in range(dice.randrange(1, 4)):
            spoilt[dice.randrange(len(spoilt))] = dice.randrange(256)
        path.write_bytes(spoilt[: dice.randrange(len(spoilt) + 1)])
        lines = set(path.read_bytes().split(b"\n"))
        ids = CommandIds(path)
        for number, line in enumerate([line for line in whole.split(b"\n") if line][1:]):  # without its head
            assert remember(ids, f"n{number}") == ("known" if line in lines else "new")


def opened(path, begun_ns=NOW, *, is_new=False):
    ids = CommandIds(path)
    return ids, ids.open(begun_ns, is_new=is_new)


def test_a_file_that_is_as_it_was_left_refuses_nothing(tmp_path):
    path = tmp_path / "ids"
    ids, lost = opened(path, is_new=True)
    assert not lost
    assert path.stat().st_size, "it is there before the first command, so that its loss can be told"
    for _ in range(2):
        ids, lost = opened(path)
        assert not lost
        assert not ids.is_from_before(1)
    assert remember(ids, "a") == "new"
    ids, lost = opened(path)
    assert not lost
    assert remember(ids, "a") == "known"


@pytest.mark.parametrize("damage", ["deleted", "emptied", "overwritten", "cut", "a flipped bit"])
def test_what_was_issued_before_a_start_without_the_ids_is_refused(tmp_path, damage, caplog):
    path = tmp_path / "ids"
    ids, _ = opened(path, is_new=True)
    for name in ("first", "second"):
        assert remember(ids, name) == "new"
    whole = path.read_bytes()
    spoilt = {
        "emptied": b"",
        "overwritten": b"\xff" * len(whole),
        "cut": whole[:-3],
        "a flipped bit": whole.replace(b"second", b"sacond"),
    }
    if damage == "deleted":
        path.unlink()
    else:
        path.write_bytes(spoilt[damage])
    begun_ns = NOW + 5 * 10**9
    ids, lost = opened(path, begun_ns)
    assert lost
    assert "is missing or damaged" in caplog.text
    assert ids.is_from_before(NOW)
    assert not ids.is_from_before(begun_ns + 1)
    assert remember(ids, "third") == "new"
    ids, lost = opened(path, begun_ns)
    assert not lost, "it is told once"
    assert remember(ids, "third") == "known"


def test_a_first_id_that_a_full_disk_refuses_leaves_no_list_that_looks_damaged(tmp_path, monkeypatch):
    path = tmp_path / "ids"

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(command_ids, "replace_durably", full)
        ids, lost = opened(path, is_new=True)
        assert not lost
        with pytest.raises(OSError, match="No space"):
            ids.begin()
        with pytest.raises(OSError, match="No space"):
            remember(ids, "a")
    assert not path.exists()
    ids.begin()
    assert remember(ids, "a") == "new"
    whole = path.read_bytes()
    ids.begin()
    assert path.read_bytes() == whole, "what is there stays"
    assert opened(path)[1] is False


@pytest.mark.parametrize("what", ["directory", "link"])
def test_what_is_no_file_of_ours_is_an_error(tmp_path, what):
    path = tmp_path / "ids"
    if what == "directory":
        path.mkdir()
    else:
        (tmp_path / "other").write_text("")
        path.symlink_to(tmp_path / "other")
    with pytest.raises(OSError):  # noqa: PT011  whichever it is, the command is refused with its words
        remember(CommandIds(path), "a")
