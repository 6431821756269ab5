"""A machine's alarms and somebody who hands them diagnoses and commands, for the tests of alarms."""

from __future__ import annotations

from dataclasses import replace

from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import Identity
from daqsvc.alarms.handling import AlarmHandling
from daqsvc.alarms.manager import AlarmManager
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.payloads import alarm_event, alarm_payload

RIG = Identity("lab", "edge-1", "rig")
SECOND_NS = 1_000_000_000
BANK_SENSORS = ("probe-x", "probe-y", "keyphasor")


class SettableClock:
    """Both clocks by hand; unlike that of `DrivenClock` the wall clock may be set, and a reboot come."""

    def __init__(self, t_ns=0, wall_ns=1_000 * SECOND_NS):
        self.t_ns, self.wall = t_ns, wall_ns

    def advance(self, seconds):
        self.t_ns += round(seconds * SECOND_NS)
        self.wall += round(seconds * SECOND_NS)

    def set_wall(self, seconds):
        self.wall += round(seconds * SECOND_NS)

    def monotonic_ns(self):
        return self.t_ns

    def wall_ns(self):
        return self.wall

    async def sleep_ns(self, duration_ns):
        raise AssertionError(f"alarms wait for nobody, not {duration_ns} ns either")


class AlarmRig:
    """Alarms that get a diagnosis a second; every event goes through its payload and is kept."""

    def __init__(self, *rules, handling=None, clock=None):
        self.clock = clock or SettableClock()
        self.rules = rules
        self.handling = handling or AlarmHandling()
        self.manager = AlarmManager(RIG, rules, self.clock, handling=self.handling)
        self.events = []

    def restarted(self, active_detectors=None, conditions=()):
        """A service that knows nothing but the last payload of each alarm."""
        last = {}
        for event in self.events:
            last.pop(event.alarm, None)
            last[event.alarm] = event
        after = AlarmRig(*self.rules, handling=self.handling, clock=self.clock)
        after.events = list(self.events)
        told = [alarm_event(alarm_payload(event, 1, "series").to_json()) for event in last.values()]
        after.told(after.manager.resume(told, active_detectors or {}, conditions))
        return after

    def told(self, events):
        for event in events:
            back = alarm_event(alarm_payload(event, 1, "series").to_json())
            assert replace(back, cause=event.cause) == event  # what JSON cannot say is NaN in the cause
        self.events += events
        return events

    def take(self, seconds=1.0, **fields):
        self.clock.advance(seconds)
        fields = {"machine": "rig", "stream": "shaft", "first_index": 0, "end_index": 64, **fields}
        return self.told(self.manager.take(Diagnosis(t_ns=self.clock.t_ns, **fields)))

    def rms(self, value, quality="good", sensor="probe-x", reason="", seconds=1.0):
        return self.take(
            seconds,
            detector=f"levels/{sensor}",
            decision="normal",
            statistics={"rms": value},
            units={"rms": "um"},
            quality=quality,
            reason=reason,
            sensors=(sensor,),
        )

    def mode(self, decision, severity, quality="good", sensors=BANK_SENSORS, **more):
        more = {"detector": "rotor-bank", **more}
        return self.take(decision=decision, severity=severity, quality=quality, sensors=sensors, **more)

    def tick(self, seconds=1.0):
        self.clock.advance(seconds)
        return self.told(self.manager.tick())

    def condition(self, name, level, sentence=""):
        return self.told(self.manager.condition(name, level, sentence))

    def ask(self, verb, alarm, by="ann", **more):
        (event,) = self.told(self.manager.execute(AlarmCommand(verb=verb, alarm=alarm, by=by, **more)))
        return event

    def acknowledge(self, alarm, by="ann", **more):
        return self.ask(Verb.ACKNOWLEDGE, alarm, by, **more)

    def reset(self, alarm, by="ann", **more):
        return self.ask(Verb.RESET, alarm, by, **more)

    def shelve(self, alarm, seconds, **more):
        return self.ask(Verb.SHELVE, alarm, duration_s=seconds, **more)

    def status(self, alarm):
        return self.manager.alarms[alarm]


def kinds(events):
    return [(event.alarm, event.kind.value) for event in events]
