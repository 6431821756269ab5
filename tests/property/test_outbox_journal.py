"""The journal against a dictionary, through crashes and restarts."""

from __future__ import annotations

import tempfile
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from daqsvc.outbox.journal import Draft, Journal

KEEP_SENT = 4
TOPICS = ["a", "b", "c"]


class Restarts(RuleBasedStateMachine):
    """A crash is a journal that is never closed; the wall clock may do what it likes."""

    def __init__(self):
        super().__init__()
        self.directory = tempfile.TemporaryDirectory()
        self.path = Path(self.directory.name) / "outbox.sqlite"
        self.wall_ns = 10**18
        self.left_open = []
        self.used = set()
        self.unsent = {}
        self.latest_retained = {}
        self.journal = self.opened()

    def opened(self):
        journal = Journal(self.path, lambda: self.wall_ns, KEEP_SENT)
        journal.open()
        return journal

    @rule(drafts=st.lists(st.tuples(st.sampled_from(TOPICS), st.booleans()), max_size=3), data=st.data())
    def commit(self, drafts, data):
        sent = data.draw(st.lists(st.sampled_from(sorted(self.unsent)), unique=True)) if self.unsent else []
        sequences, marked = self.journal.commit(
            [Draft(topic, lambda n: f"payload {n}".encode(), retain) for topic, retain in drafts], sent
        )
        assert marked == len(sent)
        for sequence in sent:
            del self.unsent[sequence]
        for sequence, (topic, retain) in zip(sequences, drafts, strict=True):
            assert sequence not in self.used
            assert sequence > max(self.used, default=0)
            self.used.add(sequence)
            self.unsent[sequence] = topic
            if retain:
                self.latest_retained[topic] = sequence

    @rule()
    def refused_payload_takes_no_number(self):
        def refuse(_sequence):
            raise ValueError("no")

        [outcome], _ = self.journal.commit([Draft("a", refuse, retain=True)], [])
        assert isinstance(outcome, ValueError)

    @rule(step_ns=st.integers(-(10**17), 10**17))
    def wall_clock_steps(self, step_ns):
        self.wall_ns += step_ns

    @rule()
    def restart(self):
        self.journal.close()
        self.journal = self.opened()

    @rule()
    def crash(self):
        self.journal._lock.close()  # as the system does for a process that ends
        self.left_open.append(self.journal)
        self.journal = self.opened()

    @precondition(lambda self: self.used)
    @rule()
    def file_is_destroyed(self):
        self.journal.close()
        for left in self.left_open:
            left.close()
        self.left_open.clear()
        self.path.write_bytes(b"this is not a database" * 500)
        self.journal = self.opened()
        assert self.journal.quarantined == 1
        self.unsent.clear()
        self.latest_retained.clear()

    @invariant()
    def nothing_unsent_is_forgotten(self):
        assert {m.sequence: m.topic for m in self.journal.pending(0, 10**6)} == self.unsent
        assert [m.sequence for m in self.journal.pending(0, 10**6)] == sorted(self.unsent)
        assert all(m.payload == f"payload {m.sequence}".encode() for m in self.journal.pending(0, 2))
        assert self.journal.unsent() == len(self.unsent)

    @invariant()
    def the_latest_of_each_retained_topic_is_kept(self):
        expected = {t: s for t, s in self.latest_retained.items() if s not in self.unsent}
        assert {m.topic: m.sequence for m in self.journal.retained()} == expected

    def teardown(self):
        self.journal.close()
        for left in self.left_open:
            left.close()
        self.directory.cleanup()


Restarts.TestCase.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)
TestRestarts = Restarts.TestCase
