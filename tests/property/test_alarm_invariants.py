"""Whatever data and people do in whatever order, the events tell the whole story."""

from __future__ import annotations

import math

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.events import EventKind, Identity
from daqsvc.alarms.manager import AlarmManager, DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, Level, RefusedError
from daqsvc.diagnosis.record import Diagnosis

SECOND_NS = 1_000_000_000
RULES = [
    LevelRule("level", "x", "rms", Setpoint(alert=4.0, danger=8.0, deadband=1.0, on_delay_ns=SECOND_NS)),
    LevelRule("latching", "x", "rms", Setpoint(alert=4.0, danger=8.0), latching=True),
    DiagnosisRule("mode", "bank"),
    DiagnosisRule("mode-latching", "bank", latching=True),
]
MODES = {"N": "normal", "F1": "alert", "F2": "alert", "F3": "danger", "undetermined": "normal"}
QUALITY = st.sampled_from(["good", "good", "good", "missing", "not_ok"])
NAMES = st.sampled_from([rule.alarm for rule in RULES])
LETS_GO = {EventKind.RETURNED, EventKind.RESET, EventKind.LATCHED}


class Alarms(RuleBasedStateMachine):
    def __init__(self):
        super().__init__()
        self.clock = DrivenClock(start_ns=0, wall_start_ns=0)
        self.manager = AlarmManager(Identity("s", "b", "m"), RULES, self.clock)
        self.told = {}
        self.occurrences = set()

    def tell(self, events):
        """A consumer that knows nothing but the events."""
        for event in events:
            state, level, occurrence = self.told.get(event.alarm, (AlarmState.NORMAL, Level.NORMAL, None))
            assert (event.from_state, event.from_level) == (state, level), "an event was left out"
            moved = (event.to_state, event.to_level) != (state, level)
            assert moved or event.kind is EventKind.CHANGED, "an event says nothing"
            if state.is_active and not event.to_state.is_active:
                assert event.kind in LETS_GO | {EventKind.SUPPRESSED}
            if event.to_level < level:
                assert event.kind in LETS_GO | {EventKind.LOWERED}
            if event.kind is EventKind.RAISED:
                assert event.occurrence not in self.occurrences
                self.occurrences.add(event.occurrence)
            elif occurrence is not None:
                assert event.occurrence == occurrence
            ends = event.to_state is AlarmState.NORMAL
            self.told[event.alarm] = (event.to_state, event.to_level, None if ends else event.occurrence)

    def take(self, detector, sensors, seconds, **fields):
        self.clock.advance_to(self.clock.monotonic_ns() + seconds * SECOND_NS)
        before = self.manager.alarms
        events = self.manager.take(
            Diagnosis("m", detector, self.clock.monotonic_ns(), "s", 0, 1, sensors=sensors, **fields)
        )
        self.tell(events)
        if fields["quality"] == "missing":
            assert all("-ok/" in event.alarm for event in events)
            for rule_ in RULES:
                assert self.manager.alarms[rule_.alarm] == before[rule_.alarm]

    @rule(
        value=st.one_of(st.floats(0, 12), st.sampled_from([math.nan, math.inf])),
        quality=QUALITY,
        seconds=st.integers(0, 3),
    )
    def measure(self, value, quality, seconds):
        fields = {"decision": "normal", "statistics": {"rms": value}, "quality": quality}
        self.take("levels/x", ("x",), seconds, **fields)

    @rule(mode=st.sampled_from(sorted(MODES)), quality=QUALITY, seconds=st.integers(0, 3))
    def diagnose(self, mode, quality, seconds):
        self.take("bank", ("x", "y"), seconds, decision=mode, severity=MODES[mode], quality=quality)

    @rule(alarm=NAMES, reset=st.booleans())
    def ask(self, alarm, reset):
        status = self.manager.alarms[alarm]
        try:
            event = self.manager.reset(alarm) if reset else self.manager.acknowledge(alarm)
        except RefusedError:
            assert self.manager.alarms[alarm] == status
            return
        assert not (reset and status.state.is_active)
        self.tell([event])

    @invariant()
    def the_events_tell_the_state(self):
        for name, status in self.manager.alarms.items():
            told = self.told.get(name, (AlarmState.NORMAL, Level.NORMAL, None))
            assert told == (status.state, status.level, status.occurrence)

    @invariant()
    def an_active_alarm_has_a_level(self):
        for status in self.manager.alarms.values():
            if status.state.is_active or status.state.is_latched:
                assert status.level > Level.NORMAL
                assert status.occurrence is not None


Alarms.TestCase.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
TestAlarms = Alarms.TestCase
