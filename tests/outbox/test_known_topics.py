"""The file of topics that ever had a retained message: what a flood adds to it, and what damage does."""

import json
import zlib

import pytest

from daqsvc.outbox import known_topics
from daqsvc.outbox.files import append_durably
from daqsvc.outbox.known_topics import KnownTopics

TOPICS = [f"daqsvc/lab/edge-1/rig/alarms/level-{i}" for i in range(40)]


def opened(path, *, is_whole=False):
    known = KnownTopics(path)
    known.open([], is_whole=is_whole)
    return known


@pytest.fixture
def path(tmp_path):
    """A file that knows all of `TOPICS`, a line for each."""
    known = opened(tmp_path / "topics", is_whole=True)
    for topic in TOPICS:
        known.add([topic])
    return tmp_path / "topics"


def test_a_new_topic_costs_a_line_and_not_the_whole_file(path):
    before, inode = path.read_bytes(), path.stat().st_ino
    opened(path).add(["a/new/one", TOPICS[3]])
    after = path.read_bytes()
    assert path.stat().st_ino == inode
    assert after.startswith(before)
    assert json.loads(after[len(before) :].partition(b" ")[2]) == ["a/new/one"]
    assert opened(path).topics == {*TOPICS, "a/new/one"}


def test_the_one_line_of_an_earlier_version_is_read(tmp_path):
    content = json.dumps(TOPICS).encode()
    (tmp_path / "topics").write_bytes(b"%08x %b\n" % (zlib.crc32(content), content))
    known = opened(tmp_path / "topics")
    known.add(["a/new/one"])
    assert opened(tmp_path / "topics").topics == {*TOPICS, "a/new/one"}


def test_nobody_knows_the_topics_after_any_flipped_bit_and_any_cut_within_a_line(path):
    whole = path.read_bytes()
    for place in range(0, len(whole), 7):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        assert opened(path).topics is None, f"bit flipped in byte {place}"
        if place == 0 or whole[place - 1 : place] != b"\n":
            path.write_bytes(whole[:place])
            assert opened(path).topics is None, f"cut at byte {place}"


def test_a_damaged_file_is_made_anew_where_the_journal_knows_all(path):
    path.write_bytes(path.read_bytes()[:-5])
    known = KnownTopics(path)
    known.open(TOPICS[:4], is_whole=True)
    known.add(["a/new/one"])
    assert opened(path).topics == {*TOPICS[:4], "a/new/one"}


def test_a_full_disk_that_takes_half_of_a_line_spoils_nothing(path, monkeypatch):
    def full(path, content):
        append_durably(path, content[: len(content) // 2])
        raise OSError(28, "No space left on device")

    known = opened(path)
    with monkeypatch.context() as disk:
        disk.setattr(known_topics, "append_durably", full)
        known.add(["told/while/it/is/full"])
    known.add(["told/later"])
    assert opened(path).topics == {*TOPICS, "told/while/it/is/full", "told/later"}
