"""The telemetry file against a list: every message is kept, sent or counted as dropped, the oldest first."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from support.examples import examples

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from daqsvc.outbox import telemetry_file
from daqsvc.outbox.counters import TelemetryCounters
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.outbox.telemetry_file import TelemetryFile

pytestmark = pytest.mark.property
LIMIT_BYTES = 128 * 1024
PLENTY = 10**9
NEARLY_FULL = 10**6
LIMITS = OutboxLimits(
    telemetry_max_bytes=LIMIT_BYTES, telemetry_max_age_ns=100 * NS_PER_S, reserve_bytes=2 * NEARLY_FULL
)


class Keeping(RuleBasedStateMachine):
    """Messages carry the order in which they came, so that what is left tells what was dropped."""

    def __init__(self):
        super().__init__()
        self.directory = tempfile.TemporaryDirectory()
        self.free = PLENTY
        self.was_full = False
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(telemetry_file, "free_bytes", lambda _: self.free)
        self.patch.setattr(telemetry_file, "FILE_RETRY_S", 0.0)
        self.counters = TelemetryCounters()
        self.clock = DrivenClock()
        self.made = 0
        self.expected = []  # (text, expires_ns) of what is neither sent nor too old, the oldest first
        self.file = self.opened()

    def opened(self):
        file = TelemetryFile(
            Path(self.directory.name) / "telemetry.sqlite", self.clock, LIMITS, self.counters
        )
        file.open()
        return file

    def kept(self):
        return self.file.pending(0, 10**6)

    def still_there(self):
        """What is left must be the newest of what was expected: take the model down to it."""
        texts = [message.payload.split()[0] for message in self.kept()]
        self.expected = [(t, e) for t, e in self.expected if e > self.clock.monotonic_ns()]
        assert texts == [t for t, _ in self.expected][len(self.expected) - len(texts) :]
        dropped = len(self.expected) - len(texts)
        self.expected = self.expected[dropped:]
        return dropped

    @rule(sizes=st.lists(st.integers(0, 20_000), max_size=6), lifetime_s=st.integers(1, 100))
    def put(self, sizes, lifetime_s):
        arrived = []
        for size in sizes:
            text = b"%d" % self.made
            self.made += 1
            arrived.append(("status", text + b" " + b"x" * size, lifetime_s * NS_PER_S))
            self.expected.append((text, self.clock.monotonic_ns() + lifetime_s * NS_PER_S))
        before = self.counters.dropped_full + self.counters.dropped_disk
        self.file.apply(arrived, [])
        dropped = self.still_there()
        assert self.counters.dropped_full + self.counters.dropped_disk - before == dropped

    @rule(data=st.data())
    def send(self, data):
        kept = self.kept()
        if not kept:
            return
        sent = data.draw(st.lists(st.sampled_from([m.number for m in kept]), unique=True))
        texts = {m.payload.split()[0] for m in kept if m.number in sent}
        before = self.counters.sent
        self.file.apply([], sent)
        assert self.counters.sent - before == len(sent)
        self.expected = [(t, e) for t, e in self.expected if t not in texts]
        self.still_there()

    @rule(seconds=st.integers(0, 60))
    def time_passes(self, seconds):
        self.clock.advance_to(self.clock.monotonic_ns() + seconds * NS_PER_S)

    @rule()
    def disk_fills(self):
        self.free, self.was_full = NEARLY_FULL, True

    @rule()
    def disk_has_room(self):
        self.free = PLENTY

    @rule()
    def restart(self):
        if self.counters.in_memory:
            return
        before = self.counters.dropped_full + self.counters.dropped_disk
        self.file.close()
        self.file = self.opened()
        # On a disk that is nearly full by now the file makes way before anything else is opened, and with
        # it what has become too old besides.
        dropped = self.still_there()
        assert self.counters.dropped_full + self.counters.dropped_disk - before >= dropped

    @invariant()
    def every_message_is_accounted_for(self):
        counted = self.counters
        assert counted.accepted == self.made == counted.sent + counted.depth + counted.dropped
        assert counted.depth >= len(self.kept())

    @invariant()
    def the_limit_holds(self):
        size = sum(len(message.payload) for message in self.kept())
        assert size <= LIMIT_BYTES or self.counters.in_memory

    @invariant()
    def little_is_dropped_without_need(self):
        """With room on the disk all the while and a few messages, nothing goes."""
        if not self.was_full and self.made < 4:
            assert self.counters.dropped_full == self.counters.dropped_disk == 0

    def teardown(self):
        self.file.close()
        self.patch.undo()
        self.directory.cleanup()


Keeping.TestCase.settings = settings(max_examples=examples(60), stateful_step_count=25, deadline=None)
TestKeeping = Keeping.TestCase
