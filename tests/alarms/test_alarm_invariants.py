"""Whatever data, people, time and restarts do in whatever order, the events tell the whole story.

A consumer knows nothing but the payloads, in their order; the service knows nothing after a restart but the
last payload of each alarm.
"""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from support.alarm_rig import alarm_handling
from support.clocks import SettableClock
from support.examples import examples

from daqsvc.alarms.alarm import FINDINGS
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import ANNUNCIATIONS, EventKind, Identity
from daqsvc.alarms.manager import AlarmManager, DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, CommandNotAllowedError, Level
from daqsvc.alarms.voting import VotingRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.payloads import alarm_event, alarm_payload
from daqsvc.settings.alarms import StartUp

pytestmark = pytest.mark.property
SECOND_NS = 1_000_000_000
HOUR_NS = 3600 * SECOND_NS
LIMITS = Setpoint(alert=4.0, danger=8.0, deadband=1.0)
RULES = [
    LevelRule("level", "x", "rms", Setpoint(alert=4.0, danger=8.0, deadband=1.0, on_delay_ns=SECOND_NS)),
    LevelRule("latching", "x", "rms", LIMITS, latching=True, trip_multiply=2.0),
    VotingRule("vote", ("x", "y", "z"), 2, "rms", LIMITS),
    DiagnosisRule("mode", "bank", evidence_nats=5.0),
    DiagnosisRule("mode-latching", "bank", latching=True, group="bank"),
]
GROUPS = {rule_.alarm: rule_.group for rule_ in RULES}
SPEAKERS = {
    "levels/x": ("x",),
    "levels/y": ("y",),
    "levels/z": ("z",),
    "bank": ("x", "y"),
    "bearing": ("x",),
    "bearing-fe": ("x",),
}
HANDLING = alarm_handling(
    chatter=(1, 20, 4),
    flood=(6, 30),
    start_up=StartUp(detector="bank", between=(100.0, 500.0), at_most_s=10.0),
    shelve_at_most_s=100.0,
)
MODES = {"N": "normal", "F1": "alert", "F2": "alert", "F3": "danger", "undetermined": "normal"}
QUALITY = st.sampled_from(["good", "good", "good", "missing", "not_ok"])
SECONDS = st.integers(0, 3)
NAMES = st.sampled_from([*GROUPS, "sensor-ok/x", "detector-ok/bank", "certificate/client", "alarm-flood"])
ENDS = {EventKind.RETURNED, EventKind.LATCHED}
HOLD_KINDS = {
    AlarmState.SUPPRESSED: (EventKind.SUPPRESSED, EventKind.UNSUPPRESSED),
    AlarmState.SHELVED: (EventKind.SHELVED, EventKind.UNSHELVED),
    AlarmState.OUT_OF_SERVICE: (EventKind.BYPASSED, EventKind.UNBYPASSED),
}


def own(event):
    return event.to_state if event.covered is None else event.covered


class Alarms(RuleBasedStateMachine):
    def __init__(self):
        super().__init__()
        self.clock = SettableClock(5 * SECOND_NS, 10**18)
        self.numbers = itertools.count()
        self.journal = {}
        self.sequence = itertools.count(1)
        self.told = {}
        self.told_at = {}
        self.found = {}
        self.settings_of_the_wall = 0
        self.occurrences = set()
        self.start()
        assert self.manager.resume([], SPEAKERS) == []

    def start(self):
        self.called_ns = []
        self.manager = AlarmManager(
            Identity("s", "b", "m"), RULES, self.clock, lambda: f"o-{next(self.numbers)}", HANDLING
        )

    def tell(self, events):
        """A consumer that knows nothing but the payloads."""
        for sent in events:
            payload = alarm_payload(sent, next(self.sequence), "series").to_json()
            self.journal.pop(sent.alarm, None)
            self.journal[sent.alarm] = payload
            event = alarm_event(payload)
            before = self.told.get(event.alarm)
            self.told[event.alarm] = event
            self.told_at[event.alarm] = self.settings_of_the_wall
            if event.kind in ANNUNCIATIONS and not event.holds and event.alarm != "alarm-flood":
                self.called_ns.append(self.clock.monotonic_ns())
            self.follows(event, before)

    def follows(self, event, before):
        normal = (AlarmState.NORMAL, Level.NORMAL)
        seen = normal if before is None else (before.to_state, before.to_level)
        assert (event.from_state, event.from_level) == seen, "an event was left out"
        was = AlarmState.NORMAL if before is None else own(before)
        occurrence = None if before is None or was is AlarmState.NORMAL else before.occurrence
        if was.is_active and not own(event).is_active:
            assert event.kind in ENDS, "an active alarm disappeared"
        if was.is_latched and not own(event).is_latched:
            assert event.kind in {EventKind.RESET, EventKind.RECURRED}
        if event.to_level < event.from_level:
            assert event.kind in {EventKind.RETURNED, EventKind.RESET, EventKind.LOWERED}, "a silent drop"
        if event.kind is EventKind.CHANGED:
            assert event.message != self.found.get(event.alarm), "nothing has changed for a person"
        if event.kind in FINDINGS:
            self.found[event.alarm] = event.message
        if event.kind is EventKind.RAISED:
            assert event.occurrence not in self.occurrences, "an occurrence was used twice"
            self.occurrences.add(event.occurrence)
        else:
            assert event.occurrence == occurrence
        if event.kind in ANNUNCIATIONS:
            assert own(event) is AlarmState.ACTIVE_UNACKNOWLEDGED, "nobody is called"
        held = set() if before is None else set(before.holds)
        for hold, (covers, uncovers) in HOLD_KINDS.items():
            assert (hold in set(event.holds) - held) <= (event.kind is covers)
            assert (hold in held - set(event.holds)) == (event.kind is uncovers)
        chattered = before is not None and before.chattering
        if event.chattering != chattered:
            assert event.kind is (EventKind.CHATTERING if event.chattering else EventKind.QUIET)
        if event.chattering:
            assert own(event).is_active, "a chattering alarm returned"
            assert event.to_level >= event.from_level

    def take(self, detector, seconds, **fields):
        self.clock.advance(seconds)
        before = dict(self.manager.alarms)
        diagnosis = Diagnosis(
            "m", detector, self.clock.monotonic_ns(), "s", 0, 1, sensors=SPEAKERS[detector], **fields
        )
        events = self.manager.take(diagnosis)
        self.tell(events)
        if diagnosis.partial:
            for event in events:
                if event.alarm in GROUPS:
                    assert event.kind not in ENDS | {EventKind.LOWERED}, "missing data cleared an alarm"
                    assert event.to_level >= event.from_level
        elif fields["quality"] == "missing":
            assert all("-ok/" in event.alarm or event.alarm == "alarm-flood" for event in events)
            for name in GROUPS:
                assert self.manager.alarms[name] == before[name], "missing data changed an alarm"

    @rule(
        sensor=st.sampled_from("xxyz"),
        value=st.one_of(st.floats(0, 12), st.sampled_from([0.0, 5.0, 9.0, math.nan, math.inf])),
        quality=QUALITY,
        seconds=SECONDS,
        sure=st.sampled_from([None, None, 0.5, 0.9]),
    )
    def measure(self, sensor, value, quality, seconds, sure):
        more = {}
        if sure is not None and quality == "missing" and math.isfinite(value):
            more = {"bounds": {"rms": (sure * value, math.inf)}, "missing_share": 0.3}
        self.take(
            f"levels/{sensor}", seconds, decision="normal", statistics={"rms": value}, quality=quality, **more
        )

    @rule(
        mode=st.sampled_from(sorted(MODES)),
        nats=st.sampled_from([2.0, 9.0, 20.0]),
        speed=st.sampled_from([300.0, 1000.0]),
        quality=QUALITY,
        seconds=SECONDS,
    )
    def diagnose(self, mode, nats, speed, quality, seconds):
        stood = self.manager.alarms["mode"].own_state.is_active
        self.take(
            "bank",
            seconds,
            decision=mode,
            changed=True,
            severity=MODES[mode],
            statistics={"speed": speed},
            evidence={f"lead.{other}": nats for other in MODES if other != mode},
            quality=quality,
        )
        if nats < 5.0 and not stood:
            assert not self.manager.alarms["mode"].own_state.is_active

    @rule(
        detector=st.sampled_from(["bearing", "bearing-fe"]),
        quality=QUALITY,
        reason=st.sampled_from(["", "no samples", "clipped"]),
        seconds=SECONDS,
    )
    def doubt(self, detector, quality, reason, seconds):
        """Others have something against the same sensor."""
        self.take(detector, seconds, decision="normal", quality=quality, reason=reason)

    @rule(
        verb=st.sampled_from(list(Verb)),
        alarm=NAMES,
        duration_s=st.sampled_from([1.0, 5.0, 60.0, 100.5, None]),
        stale=st.sampled_from([False, False, False, True]),
    )
    def command(self, verb, alarm, duration_s, stale):
        before = dict(self.manager.alarms)
        occurrence = "o-of-yesterday" if stale else None
        asked = AlarmCommand(
            verb=verb, alarm=alarm, by="ann", duration_s=duration_s, occurrence=occurrence, reason="why not"
        )
        try:
            events = self.manager.execute(asked)
        except CommandNotAllowedError:
            assert dict(self.manager.alarms) == before
            return
        assert not stale
        assert not (verb is Verb.RESET and before[alarm].own_state.is_active), "a standing alarm was reset"
        assert verb is not Verb.SHELVE or duration_s <= 100.0
        assert [(event.by, event.reason) for event in events] == [("ann", "why not")]
        self.tell(events)

    @rule()
    def see_everything(self):
        for name, status in self.manager.alarms.items():
            if status.state.value.endswith("_unacknowledged"):
                self.tell(self.manager.execute(AlarmCommand(verb=Verb.ACKNOWLEDGE, alarm=name, by="bob")))

    @rule(seconds=st.sampled_from([0, 1, 4, 35]))
    def wait(self, seconds):
        self.clock.advance(seconds)
        self.tell(self.manager.tick())
        now_ns = self.clock.monotonic_ns()
        for status in self.manager.alarms.values():
            assert status.shelved_until_ns is None or status.shelved_until_ns > now_ns

    @rule(name=st.just("certificate/client"), level=st.sampled_from(list(Level)))
    def stand(self, name, level):
        self.tell(self.manager.condition(name, level, "client.pem ends in 9 days"))
        if name in self.manager.alarms and not self.manager.alarms[name].chattering:
            assert self.manager.alarms[name].level is level

    @rule(step_ns=st.sampled_from([HOUR_NS, -HOUR_NS]))
    def set_the_wall_clock(self, step_ns):
        before = dict(self.manager.alarms)
        self.clock.wall += step_ns
        self.settings_of_the_wall += 1
        self.tell(self.manager.tick())
        for name, status in before.items():
            if status.shelved_until_ns is None or status.shelved_until_ns > self.clock.monotonic_ns():
                after = self.manager.alarms[name]
                assert name in {"alarm-flood", "trip-multiply"} or after == status

    @rule(
        down_s=st.sampled_from([0, 2, 50]),
        step_ns=st.sampled_from([0, 0, HOUR_NS, -HOUR_NS]),
        rebooted=st.booleans(),
    )
    def restart(self, down_s, step_ns, rebooted):
        before, then_ns = dict(self.manager.alarms), self.clock.monotonic_ns()
        self.clock.advance(down_s)
        self.clock.wall += step_ns
        self.settings_of_the_wall += step_ns != 0
        if rebooted:
            self.clock.t_ns = 7 * SECOND_NS
        self.start()
        assert self.manager.resume([alarm_event(said) for said in self.journal.values()], SPEAKERS) == []
        now_ns = self.clock.monotonic_ns()
        for name, status in before.items():
            if status.own_state is AlarmState.NORMAL and not status.holds and name not in GROUPS:
                continue
            after = self.manager.alarms[name]
            # What was found is in the journal, and here only while nothing else has been said since.
            same = {"since": None, "shelved_until_ns": None, "found": ""}
            assert after._replace(**same) == status._replace(**same)
            if status.shelved_until_ns is not None:
                left_ns, left_after_ns = status.shelved_until_ns - then_ns, after.shelved_until_ns - now_ns
                told = self.told[name]
                assert 0 <= left_after_ns <= max(told.shelved_until_wall_ns - told.wall_ns, 0)
                if self.told_at[name] == self.settings_of_the_wall:
                    assert left_after_ns == max(left_ns - down_s * SECOND_NS, 0)

    @invariant()
    def the_payloads_tell_the_state(self):
        for name, status in self.manager.alarms.items():
            told = self.told.get(name)
            if told is None:
                assert (status.state, status.level, status.holds) == (AlarmState.NORMAL, Level.NORMAL, ())
                continue
            assert (told.to_state, told.to_level, own(told)) == (status.state, status.level, status.own_state)
            assert (told.holds, told.chattering) == (status.holds, status.chattering)
            if status.own_state is not AlarmState.NORMAL:
                assert told.occurrence == status.occurrence
                assert told.chattering or status.level > Level.NORMAL or not status.own_state.is_active

    @invariant()
    def one_alarm_of_a_standing_group_is_first_out(self):
        for group in set(GROUPS.values()):
            alarms = [self.manager.alarms[name] for name, its in GROUPS.items() if its == group]
            aside = {AlarmState.SHELVED, AlarmState.OUT_OF_SERVICE}
            stands = any(a.own_state is not AlarmState.NORMAL and not aside & set(a.holds) for a in alarms)
            assert sum(alarm.first_out for alarm in alarms) == stands

    @invariant()
    def a_flood_is_told(self):
        now_ns = self.clock.monotonic_ns()
        recent = [t_ns for t_ns in self.called_ns if now_ns - t_ns <= 30 * SECOND_NS]
        if len(recent) > 6:
            flood = self.manager.alarms["alarm-flood"]
            assert flood.own_state.is_active


Alarms.TestCase.settings = settings(max_examples=examples(120), stateful_step_count=50, deadline=None)


@pytest.mark.timeout(170)
class TestAlarms(Alarms.TestCase):
    pass
