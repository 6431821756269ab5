"""Working by what changed finds the same events as a walk over all alarms and all sensors in doubt.

The walk is the plain reading of the rules: after every diagnosis ask of each alarm whether it is fed, whether
it can speak, and what it finds.
"""

from __future__ import annotations

import itertools
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.alarm_rig import alarm_handling
from support.clocks import SettableClock
from support.examples import examples

from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import Doubt, Identity
from daqsvc.alarms.manager import AlarmManager, DiagnosisRule, LevelRule
from daqsvc.alarms.quality import UNHEARD_NS, SensorHealth, Touched, quality_alarm
from daqsvc.alarms.rules import Circumstances
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, CommandNotAllowedError, Hold, Level
from daqsvc.alarms.voting import VotingRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.payloads import alarm_event, alarm_payload

pytestmark = pytest.mark.property
SECOND_NS = 1_000_000_000
IDENTITY = Identity("s", "b", "m")
LIMITS = Setpoint(alert=4.0, danger=8.0, deadband=1.0)
RULES = [
    LevelRule("level-x", "x", "rms", LIMITS),
    LevelRule("latching-x", "x", "rms", LIMITS, latching=True, group="other"),
    LevelRule("level-y", "y", "rms", LIMITS),
    VotingRule("vote", ("x", "y", "z"), 2, "rms", LIMITS),
    DiagnosisRule("mode", "bank"),
    DiagnosisRule("bearing", "race", latching=True),
]
NEW_RULE = LevelRule("level-z", "z", "rms", LIMITS)
SPEAKERS = {
    "levels/x": ("x",),
    "levels/y": ("y",),
    "levels/z": ("z",),
    "bank": ("x", "y"),
    "race": ("z",),
}
HANDLING = alarm_handling(
    chatter=(2, 20, 4),
    flood=(5, 15),
    shelve_at_most_s=100.0,
)


class WalkingDoubts(SensorHealth):
    """One table, searched from end to end."""

    def __init__(self):
        super().__init__()
        self.table = {}
        self.assumed = {}
        self.unsettled = {}

    def update(self, diagnosis, now_ns):
        del now_ns
        detector, sensors = diagnosis.detector, diagnosis.sensors
        name = quality_alarm(detector, sensors)
        before = self.table.pop(detector, None) or self.assumed.pop(detector, None)
        if before is not None and diagnosis.quality != "not_ok" and not (sensors and before[1].sensors):
            name, sensors = before[0], before[1].sensors
        if diagnosis.quality == "good":
            for detectors in self.unsettled.values():
                detectors.discard(detector)
        else:
            not_ok = diagnosis.quality == "not_ok" or (before is not None and before[1].not_ok)
            doubt = Doubt(detector, diagnosis.quality, not_ok, diagnosis.reason, sensors)
            self.table[detector] = (name, doubt)
        names = (name,) if before is None or before[0] == name else (before[0], name)
        return Touched(names, frozenset())

    def resume(self, doubts, t_ns, found="", *, restarted=True):
        assert restarted, "nothing is replayed here"
        for doubt in doubts:
            self.assumed.pop(doubt.detector, None)
            self.table[doubt.detector] = (quality_alarm(doubt.detector, doubt.sensors), doubt)

    def expect(self, name, speakers, t_ns):
        self.until_ns = t_ns + UNHEARD_NS
        doubts = self.of(name)
        worst = min(doubts, key=lambda doubt: doubt.quality != "not_ok", default=None)
        for detector, sensors in speakers.items():
            if doubts and detector not in self.table:
                self.assumed[detector] = name, Doubt(detector, worst.quality, False, worst.reason, sensors)

    def not_ok(self):
        return [(name, doubt) for name, doubt in self.table.values() if doubt.not_ok]

    def excuse(self, detector):
        name, doubt = self.table[detector]
        self.table[detector] = name, doubt._replace(not_ok=False)

    def give_up(self, t_ns):
        if not self.assumed or t_ns < self.until_ns:
            return []
        names = sorted({name for name, _ in self.assumed.values()})
        self.assumed.clear()
        return names

    def _assumed(self, name):
        return [doubt for alarm, doubt in self.assumed.values() if alarm == name]

    def unsettle(self, rule):
        self.unsettled[rule.alarm] = set(rule.detectors)

    def of(self, name):
        return tuple(sorted(doubt for alarm, doubt in self.table.values() if alarm == name))

    @property
    def blamed(self):
        return {
            doubt.sensors[0]: doubt.reason
            for _, doubt in self.table.values()
            if doubt.not_ok and len(doubt.sensors) == 1
        }

    def silences(self, rule, sensors):
        if self.unsettled.get(rule.alarm):
            return "a sensor was not OK before the restart"
        for detector in rule.detectors:
            if rule.spare == 0 and detector in self.table and self.table[detector][1].not_ok:
                return self.table[detector][1].reason
        lost = [sensor for sensor in sorted(sensors) if sensor in self.blamed]
        return self.blamed[lost[0]] if len(lost) > rule.spare else None


class WalkingManager(AlarmManager):
    """Asks every alarm after every diagnosis."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self._doubts = WalkingDoubts()

    def _events(self, diagnosis, at):
        yield from self._quality(self._doubts.update(diagnosis, at.t_ns).alarms, diagnosis, at)
        followers = [ruled for ruled in self._ruled if diagnosis.detector in ruled.rule.detectors]
        for ruled in followers:
            if not ruled.rule.sensors and diagnosis.sensors and diagnosis.quality != "missing":
                ruled.sensors = frozenset(diagnosis.sensors)
        for ruled in self._ruled:
            reason = self._doubts.silences(ruled.rule, ruled.sensors)
            if (reason is not None) == ruled.alarm.is_held(Hold.SUPPRESSED):
                continue
            if reason is not None:
                yield ruled.alarm.suppress(reason, diagnosis, at)
            else:
                yield ruled.alarm.unsuppress("its sensors are good again", diagnosis, at)
        given_now = Circumstances(False, frozenset(self._doubts.blamed))
        for ruled in followers:
            if diagnosis.quality != "good" or ruled.alarm.is_held(Hold.SUPPRESSED):
                ruled.watch.hold(diagnosis)
                ruled.alarm.hold()
                continue
            finding = ruled.watch.find(diagnosis, given_now)
            if finding is not None:
                yield from ruled.alarm.apply(finding, diagnosis, at)

    def _timed(self, now):
        shelved = [alarm for alarm in self._alarms.values() if alarm.shelved_until_ns is not None]
        for alarm in sorted(shelved, key=lambda one: (one.shelved_until_ns, one.name)):
            if expired := alarm.expire(now, self._unjudged(alarm.name, now)):
                yield expired
        for name in self._doubts.give_up(now.t_ns):
            yield from self._quality([name], self._unjudged(name, now), now)


class Twins:
    """The same happens to both; what they say must be the same, in the same order."""

    def __init__(self):
        self.clock = SettableClock(5 * SECOND_NS)
        self.journal = {}
        self.rules = list(RULES)
        self.start()

    def start(self):
        told = [alarm_event(payload) for payload in self.journal.values()]
        self.both = []
        for kind in (AlarmManager, WalkingManager):
            numbers = itertools.count(len(told))
            manager = kind(IDENTITY, self.rules, self.clock, lambda n=numbers: f"o-{next(n)}", HANDLING)
            self.both.append(manager)
        self.same([manager.resume(told, SPEAKERS, ("store/disk",)) for manager in self.both])

    def same(self, said):
        ours, walked = said
        assert ours == walked
        for event in ours:
            self.journal.pop(event.alarm, None)
            self.journal[event.alarm] = alarm_payload(event, 1, "series").to_json()
        manager = self.both[0]
        assert dict(manager.alarms) == dict(self.both[1].alarms)
        shown = Counter(status.state for status in manager.alarms.values())
        del shown[AlarmState.NORMAL]
        assert +Counter(manager.shown) == +shown

    def take(self, detector, sensors, seconds, **fields):
        self.clock.advance(seconds)
        diagnosis = Diagnosis("m", detector, self.clock.t_ns, "s", 0, 1, sensors=sensors, **fields)
        self.same([manager.take(diagnosis) for manager in self.both])

    def command(self, verb, alarm, duration_s):
        said = []
        for manager in self.both:
            try:
                asked = AlarmCommand(verb=verb, alarm=alarm, by="ann", duration_s=duration_s)
                said.append(manager.execute(asked))
            except CommandNotAllowedError as refusal:
                said.append([])
                reason = f"{refusal}"
        if not any(said):
            assert reason
        self.same(said)

    def tick(self, seconds):
        self.clock.advance(seconds)
        self.same([manager.tick() for manager in self.both])

    def condition(self, level):
        self.same([manager.condition("store/disk", level, "it is full") for manager in self.both])

    def restart(self, *, changed):
        self.rules = [*RULES, NEW_RULE] if changed else list(RULES)
        self.start()


QUALITY = st.sampled_from(["good", "good", "missing", "not_ok"])
SECONDS = st.integers(0, 3)
LEVELS = st.tuples(
    st.just("levels"), st.sampled_from("xyz"), st.sampled_from([0.0, 5.0, 9.0]), QUALITY, SECONDS
)
FOUND = st.tuples(
    st.just("found"),
    st.sampled_from(["bank", "race"]),
    st.sampled_from(["normal", "alert", "danger"]),
    QUALITY,
    st.sampled_from([("x", "y"), ("z",), ("x",), ("y", "z"), ()]),
    SECONDS,
)
ORDERS = st.tuples(
    st.just("command"),
    st.sampled_from(list(Verb)),
    st.sampled_from(
        [*(rule.alarm for rule in RULES), "sensor-ok/x", "detector-ok/bank", "store/disk", "nobody"]
    ),
    st.sampled_from([1.0, 3.0, 90.0]),
)
OTHERS = st.one_of(
    st.tuples(st.just("tick"), st.sampled_from([0, 1, 4, 40])),
    st.tuples(st.just("condition"), st.sampled_from(list(Level))),
    st.tuples(st.just("restart"), st.booleans()),
)


@settings(max_examples=examples(150), deadline=None)
@given(st.lists(st.one_of(LEVELS, LEVELS, FOUND, FOUND, ORDERS, OTHERS), max_size=60))
def test_what_is_found_by_index_is_what_a_walk_over_all_alarms_finds(steps):
    twins = Twins()
    for number, (kind, *step) in enumerate(steps):
        if kind == "levels":
            sensor, value, quality, seconds = step
            twins.take(
                f"levels/{sensor}",
                (sensor,),
                seconds,
                decision="normal",
                statistics={"rms": value},
                quality=quality,
                reason=f"reason {number}",
            )
        elif kind == "found":
            detector, severity, quality, sensors, seconds = step
            twins.take(
                detector,
                sensors,
                seconds,
                decision=severity,
                changed=True,
                severity=severity,
                quality=quality,
                reason=f"reason {number}",
            )
        elif kind == "command":
            twins.command(*step)
        elif kind == "restart":
            twins.restart(changed=step[0])
        else:
            getattr(twins, kind)(*step)
