"""A manager that is restarted from the journal at any point does what one does that never was."""

from __future__ import annotations

import contextlib
import itertools
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import AlarmManager, DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, CommandNotAllowedError, Level
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.payloads import alarm_event, alarm_payload

pytestmark = pytest.mark.property
RULES = [
    LevelRule("level", "x", "rms", Setpoint(alert=4.0, danger=8.0, deadband=1.0)),
    LevelRule("level-latching", "x", "rms", Setpoint(alert=4.0, danger=8.0, deadband=1.0), latching=True),
    LevelRule("window", "x", "rms", Setpoint(4.0, 8.0, 1.0, alert_low=-4.0, danger_low=-8.0)),
    LevelRule("window-latching", "x", "rms", Setpoint(4.0, 8.0, 1.0, alert_low=-4.0), latching=True),
    DiagnosisRule("mode", "bank"),
    DiagnosisRule("mode-latching", "bank", latching=True),
]
SPEAKERS = {"levels/x": ("x",), "bank": ("x", "y")}
MODES = {"N": "normal", "F1": "alert", "F2": "alert", "F3": "danger", "undetermined": "normal"}
QUALITY = st.sampled_from(["good", "good", "good", "missing", "not_ok"])

VALUES = [-9.0, -7.5, -5.0, -3.5, 0.0, 3.5, 5.0, 7.5, 9.0, math.nan]
MEASURED = st.tuples(st.just("levels/x"), st.sampled_from(VALUES), QUALITY)
DIAGNOSED = st.tuples(st.just("bank"), st.sampled_from(sorted(MODES)), QUALITY)
ASKED = st.tuples(
    st.sampled_from([verb for verb in Verb if verb is not Verb.SHELVE]),
    st.sampled_from([*(rule.alarm for rule in RULES), "sensor-ok/x", "detector-ok/bank"]),
    st.just("good"),
)
STEPS = st.lists(st.tuples(st.booleans(), MEASURED | DIAGNOSED | ASKED), min_size=1, max_size=40)


class Box:
    """A manager, and a journal that holds the last event of each of its alarms, as bytes."""

    def __init__(self):
        self.clock = DrivenClock(start_ns=0, wall_start_ns=10**18)
        self.journal = {}
        self.numbers = itertools.count()
        self.start()

    def start(self):
        self.manager = AlarmManager(
            Identity("s", "b", "m"), RULES, self.clock, lambda: f"o-{next(self.numbers)}"
        )
        told = [alarm_event(payload) for payload in self.journal.values()]
        assert self.manager.resume(told, SPEAKERS) == []

    def do(self, what, which, quality):
        """The events of a step."""
        events = []
        if what in SPEAKERS:
            said = {"statistics": {"rms": which}, "decision": "normal"}
            if what == "bank":
                said = {"decision": which, "severity": MODES[which]}
            t_ns = self.clock.monotonic_ns()
            sensors = SPEAKERS[what]
            events = self.manager.take(
                Diagnosis("m", what, t_ns, "s", 0, 1, quality=quality, sensors=sensors, **said)
            )
        else:
            with contextlib.suppress(CommandNotAllowedError):
                events = self.manager.execute(AlarmCommand(verb=what, alarm=which, by="ann"))
        for event in events:
            self.journal.pop(event.alarm, None)
            self.journal[event.alarm] = alarm_payload(event, 1, "series").to_json()
        return [
            (event.alarm, event.kind, event.from_state, event.to_state, event.to_level, event.occurrence)
            for event in events
        ]

    def standing(self):
        return {
            name: (status.state, status.level, status.occurrence, status.own_state, status.first_out)
            for name, status in self.manager.alarms.items()
            if status.state is not AlarmState.NORMAL
        }


@settings(max_examples=examples(500), deadline=None)
@given(STEPS)
def test_a_restart_changes_nothing(steps):
    steady, restarted = Box(), Box()
    for restart, (what, which, quality) in steps:
        if restart:
            restarted.start()
            assert restarted.standing() == steady.standing()
        assert restarted.do(what, which, quality) == steady.do(what, which, quality)
        assert restarted.standing() == steady.standing()


@settings(max_examples=examples(500), deadline=None)
@given(STEPS)
def test_what_nobody_judges_any_more_ends_normal(steps):
    box = Box()
    for _, step in steps:
        box.do(*step)
    standing = box.standing()
    successor = AlarmManager(Identity("s", "b", "m"), [], box.clock)
    events = successor.resume([alarm_event(payload) for payload in box.journal.values()], {})
    assert {event.alarm for event in events} == set(standing)
    for event in events:
        assert (event.from_state, event.from_level, event.occurrence) == standing[event.alarm][:3]
        assert (event.to_state, event.to_level) == (AlarmState.NORMAL, Level.NORMAL)
    assert dict(successor.alarms) == {}
