"""The journal against a dictionary: restarts, kill -9, power cuts, clock steps and destroyed files."""

from __future__ import annotations

import shutil
import tempfile
import zlib
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from support.examples import examples
from support.journal_commits import commit

from daqsvc.outbox import journal as journal_module
from daqsvc.outbox import sequence as sequence_module
from daqsvc.outbox.journal import Journal
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.messages import Draft
from daqsvc.outbox.reading import JOURNAL_NAME, read_journal

pytestmark = pytest.mark.property
TOPICS = ["a", "b", "c"]

# A crash is played by copying files, so what a sync costs on this machine's disk need not be paid.
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # noqa: S108


def drafts_of(topics_and_retain):
    return [Draft(topic, lambda n: f"payload {n}".encode(), retain) for topic, retain in topics_and_retain]


class Store:
    """A directory whose state at any moment is what a crash leaves: a copy goes on, the original ends."""

    def __init__(self):
        self._directory = tempfile.TemporaryDirectory(dir=MEMORY)
        self._lives = 0
        self.path = self._next()

    def _next(self):
        self._lives += 1
        directory = Path(self._directory.name) / f"life-{self._lives}"
        directory.mkdir()
        return directory / JOURNAL_NAME

    def crash(self):
        path = self._next()
        shutil.copytree(self.path.parent, path.parent, dirs_exist_ok=True)
        self.path = path

    def cleanup(self):
        self._directory.cleanup()


class Restarts(RuleBasedStateMachine):
    """Every rule leaves a commit boundary behind, and any of them may be followed by a crash."""

    def __init__(self):
        super().__init__()
        self.store = Store()
        self.wall_ns = 10**18
        self.used = set()
        self.highest = 0
        self.jumped = True
        self.unsent = {}
        self.latest = {}
        self.sent = set()
        self.left_open = []
        self.boots = 0
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(sequence_module, "boot_id", lambda: f"boot-{self.boots}")
        # A crash is played by a copy, which is another place.
        self.patch.setattr(journal_module, "place_of", lambda _lock: "here")
        self.journal = self.opened()

    def opened(self):
        journal = Journal(self.store.path, lambda: self.wall_ns, OutboxLimits(alarms_max_bytes=0))
        journal.open()
        return journal

    @rule(drafts=st.lists(st.tuples(st.sampled_from(TOPICS), st.booleans()), max_size=3), data=st.data())
    def commit(self, drafts, data):
        sent = data.draw(st.lists(st.sampled_from(sorted(self.unsent)), unique=True)) if self.unsent else []
        sequences, marked = commit(self.journal, drafts_of(drafts), sent)
        assert marked == len(sent)
        for number in sent:
            del self.unsent[number]
        self.sent.update(sent)
        for number, (topic, retain) in zip(sequences, drafts, strict=True):
            assert number not in self.used
            assert number > self.highest
            assert self.jumped or number == self.highest + 1, "no gap without a crash or a lost file"
            self.jumped = False
            self.used.add(number)
            self.highest = number
            self.unsent[number] = topic
            if retain:
                self.latest[topic] = number

    @rule()
    def refused_payload_takes_no_number(self):
        def refuse(_sequence):
            raise ValueError("no")

        outcomes, _ = commit(
            self.journal, [Draft("a", refuse, retain=True), Draft("a", lambda n: "no bytes", retain=True)], []
        )
        assert [type(outcome) for outcome in outcomes] == [ValueError, TypeError]

    @rule(step_ns=st.integers(-(10**17), 10**17))
    def wall_clock_steps(self, step_ns):
        self.wall_ns += step_ns

    @rule()
    def restart(self):
        self.journal.close()
        self.journal = self.opened()
        assert self.journal.vanished == 0

    @rule()
    def kill_minus_nine(self):
        self.left_open.append(self.journal)
        self.store.crash()
        self.jumped = True
        self.journal = self.opened()
        assert self.journal.vanished == 0

    @rule(data=st.data())
    def power_cut(self, data):
        """What was not synced of the side file is lost; a disk that lies loses the log's tail as well."""
        self.left_open.append(self.journal)
        self.store.crash()
        self.boots += 1
        self.jumped = True
        for mark in self.store.path.parent.glob(f"{JOURNAL_NAME}.sequence*"):
            ceiling, _used, *rest, _checksum = mark.read_text().split()
            told = " ".join([ceiling, f"{0:020d}", *rest])
            mark.write_text(f"{told} {zlib.crc32(told.encode()):08x}\n")
        log = self.store.path.with_name(JOURNAL_NAME + "-wal")
        if data.draw(st.booleans(), label="the disk lied") and log.exists():
            log.write_bytes(log.read_bytes()[: data.draw(st.integers(0, log.stat().st_size))])
            # The index is memory of the system that is gone.
            self.store.path.with_name(JOURNAL_NAME + "-shm").unlink(missing_ok=True)
            self.journal = self.opened()
            self.believe_the_journal()
        else:
            self.journal = self.opened()

    def believe_the_journal(self):
        """After a loss that nobody could prevent, what is there must be of what was written."""
        there = {m.sequence: m.topic for m in self.journal.pending(0, 10**6)}
        assert set(there) <= self.used
        self.journal.damage_is_reported()
        self.unsent = there
        self.latest = {m.topic: m.sequence for m in self.journal.latest()}
        self.sent = {m.sequence for m in self.journal.retained()}

    @precondition(lambda self: self.used)
    @rule()
    def file_is_destroyed(self):
        self.journal.close()
        self.store.path.write_bytes(b"this is not a database" * 500)
        self.jumped = True
        self.journal = self.opened()
        assert self.journal.quarantined == 1
        self.journal.damage_is_reported()
        self.unsent.clear()
        self.latest.clear()
        self.sent.clear()

    @precondition(lambda self: self.used)
    @rule(data=st.data())
    def log_is_damaged_while_the_program_is_down(self, data):
        """SQLite takes a log with a flipped bit for one that ends there, and says nothing."""
        self.left_open.append(self.journal)
        self.store.crash()
        log = self.store.path.with_name(JOURNAL_NAME + "-wal")
        content = bytearray(log.read_bytes())
        if not content:
            self.journal = self.opened()
            return
        content[data.draw(st.integers(0, len(content) - 1))] ^= 0xFF
        log.write_bytes(content)
        self.store.path.with_name(JOURNAL_NAME + "-shm").unlink(missing_ok=True)
        self.journal = self.opened()
        there = self.journal.last_sequence
        assert there >= self.highest, "no number is used twice"
        self.jumped = self.jumped or self.journal.quarantined > 0 or there > self.highest
        self.believe_the_journal()

    @invariant()
    def nothing_unsent_is_forgotten(self):
        pending = self.journal.pending(0, 10**6)
        assert [m.sequence for m in pending] == sorted(self.unsent)
        assert {m.sequence: m.topic for m in pending} == self.unsent
        assert all(m.payload == f"payload {m.sequence}".encode() for m in pending)
        assert self.journal.unsent() == len(self.unsent)

    @invariant()
    def the_latest_of_each_retained_topic_is_kept(self):
        assert {m.topic: m.sequence for m in self.journal.latest()} == self.latest
        expected = {t: s for t, s in self.latest.items() if s not in self.unsent}
        assert {m.topic: m.sequence for m in self.journal.retained()} == expected

    @invariant()
    def another_process_reads_the_same(self):
        view = read_journal(self.store.path.parent, history=10**6)
        assert {e.topic: e.sequence for e in view.latest} == self.latest
        assert {e.sequence for e in view.history if not e.sent} == set(self.unsent)
        assert [e.sequence for e in view.history] == sorted(e.sequence for e in view.history)
        assert view.unsent == len(self.unsent)
        assert view.damaged == 0

    def teardown(self):
        self.journal.close()
        for left in self.left_open:
            left.close()
        self.store.cleanup()
        self.patch.undo()


Restarts.TestCase.settings = settings(max_examples=examples(40), stateful_step_count=20, deadline=None)
TestRestarts = Restarts.TestCase
