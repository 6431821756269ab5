"""A machine's alarms and somebody who hands them diagnoses and commands, for the tests of alarms."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from support.clocks import SettableClock

from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.events import Identity
from daqsvc.alarms.handling import CALM
from daqsvc.alarms.manager import AlarmManager
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.payloads import alarm_event, alarm_payload

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.alarms.rules import Rule
    from daqsvc.alarms.status import AlarmStatus
    from daqsvc.diagnosis.record import Severity
    from daqsvc.settings.alarms import AlarmHandling

RIG = Identity("lab", "edge-1", "rig")
SECOND_NS = 1_000_000_000
BANK_SENSORS = ("probe-x", "probe-y", "keyphasor")


def alarm_handling(
    *,
    chatter: tuple[int, float, float] = (0, 60.0, 60.0),
    flood: tuple[int, float] = (0, 600.0),
    **given: Any,
) -> AlarmHandling:
    """The table [alarm_handling]: raises, window, quiet time of chatter; alarms, window of a flood; in s."""
    raises, window_s, quiet_s = chatter
    alarms, flood_window_s = flood
    return CALM.model_copy(
        update={
            "chatter_raises": raises,
            "chatter_window_s": window_s,
            "chatter_quiet_s": quiet_s,
            "flood_alarms": alarms,
            "flood_window_s": flood_window_s,
            **given,
        }
    )


class AlarmRig:
    """Alarms that get a diagnosis a second; every event goes through its payload and is kept."""

    def __init__(
        self, *rules: Rule, handling: AlarmHandling | None = None, clock: SettableClock | None = None
    ) -> None:
        self.clock = clock or SettableClock()
        self.rules = rules
        self.handling = handling or CALM
        self.manager = AlarmManager(RIG, rules, self.clock, handling=self.handling)
        self.events: list[AlarmEvent] = []

    def restarted(
        self, active_detectors: Mapping[str, tuple[str, ...]] | None = None, conditions: Iterable[str] = ()
    ) -> AlarmRig:
        """A service that knows nothing but the last payload of each alarm."""
        last: dict[str, AlarmEvent] = {}
        for event in self.events:
            last.pop(event.alarm, None)
            last[event.alarm] = event
        after = AlarmRig(*self.rules, handling=self.handling, clock=self.clock)
        after.events = list(self.events)
        events = [alarm_event(alarm_payload(event, 1, "series").to_json()) for event in last.values()]
        after.told(after.manager.resume(events, active_detectors or {}, conditions))
        return after

    def told(self, events: Sequence[AlarmEvent]) -> Sequence[AlarmEvent]:
        for event in events:
            back = alarm_event(alarm_payload(event, 1, "series").to_json())
            assert replace(back, cause=event.cause) == event  # what JSON cannot say is NaN in the cause
        self.events += events
        return events

    def take(self, seconds: float = 1.0, **fields: Any) -> Sequence[AlarmEvent]:
        self.clock.advance(seconds)
        fields = {"machine": "rig", "stream": "shaft", "first_index": 0, "end_index": 64, **fields}
        self.last = Diagnosis(t_ns=self.clock.t_ns, **fields)
        return self.told(self.manager.take(self.last))

    def take_state(self, sensor: str, value: float, times: int) -> None:
        """A trend value without a unit, so many times in a row."""
        for _ in range(times):
            self.take(
                detector=f"levels/{sensor}",
                decision="normal",
                statistics={"value": value},
                units={"value": "1"},
                quality="good",
                sensors=(sensor,),
            )

    def rms(
        self,
        value: float,
        quality: str = "good",
        sensor: str = "probe-x",
        reason: str = "",
        seconds: float = 1.0,
    ) -> Sequence[AlarmEvent]:
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

    def mode(
        self,
        decision: str,
        severity: Severity,
        quality: str = "good",
        sensors: tuple[str, ...] = BANK_SENSORS,
        **more: Any,
    ) -> Sequence[AlarmEvent]:
        more = {"detector": "rotor-bank", **more}
        return self.take(decision=decision, severity=severity, quality=quality, sensors=sensors, **more)

    def tick(self, seconds: float = 1.0) -> Sequence[AlarmEvent]:
        self.clock.advance(seconds)
        return self.told(self.manager.tick())

    def condition(self, name: str, level: Any, sentence: str = "") -> Sequence[AlarmEvent]:
        return self.told(self.manager.condition(name, level, sentence))

    def ask(self, verb: Verb, alarm: str, by: str = "ann", **more: Any) -> AlarmEvent:
        (event,) = self.told(self.manager.execute(AlarmCommand(verb=verb, alarm=alarm, by=by, **more)))
        return event

    def acknowledge(self, alarm: str, by: str = "ann", **more: Any) -> AlarmEvent:
        return self.ask(Verb.ACKNOWLEDGE, alarm, by, **more)

    def reset(self, alarm: str, by: str = "ann", **more: Any) -> AlarmEvent:
        return self.ask(Verb.RESET, alarm, by, **more)

    def shelve(self, alarm: str, seconds: float, **more: Any) -> AlarmEvent:
        return self.ask(Verb.SHELVE, alarm, duration_s=seconds, **more)

    def status(self, alarm: str) -> AlarmStatus:
        return self.manager.alarms[alarm]


def kinds(events: Iterable[AlarmEvent]) -> list[tuple[str, str]]:
    return [(event.alarm, event.kind.value) for event in events]
