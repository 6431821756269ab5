"""From a machine file to its alarms: whose they are, what each of them watches, and what holds for all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.chatter import ChatterLimit
from daqsvc.alarms.events import Identity
from daqsvc.alarms.flood import FloodLimit
from daqsvc.alarms.handling import AlarmHandling
from daqsvc.alarms.rules import DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.start_up import StartUp
from daqsvc.alarms.voting import VotingRule
from daqsvc.settings.models import LevelAlarm, SetpointAlarm

if TYPE_CHECKING:
    from daqsvc.alarms.rules import Rule
    from daqsvc.settings.models import MachineFile


def identity(machine: MachineFile) -> Identity:
    """Whose alarms these are."""
    return Identity(machine.site, machine.box, machine.machine.name)


def alarm_rules(machine: MachineFile) -> list[Rule]:
    """One rule per alarm."""
    rules: list[Rule] = []
    for alarm in machine.alarms:
        if isinstance(alarm, SetpointAlarm):
            rules.append(_setpoint_rule(alarm))
        else:
            rules.append(
                DiagnosisRule(
                    alarm.name, alarm.detector, alarm.latching, alarm.evidence_nats, alarm.first_out_group
                )
            )
    return rules


def alarm_handling(machine: MachineFile) -> AlarmHandling:
    """What holds for all alarms."""
    given = machine.alarm_handling
    chatter, flood, start_up = None, None, None
    if given.chatter_raises:
        chatter = ChatterLimit(given.chatter_raises, _ns(given.chatter_window_s), _ns(given.chatter_quiet_s))
    if given.flood_alarms:
        flood = FloodLimit(given.flood_alarms, _ns(given.flood_window_s))
    if given.start_up is not None:
        start_up = StartUp(
            detector=given.start_up.detector,
            measure=given.start_up.measure,
            between=given.start_up.between,
            change_per_s=given.start_up.change_per_s,
            at_most_ns=_ns(given.start_up.at_most_s),
        )
    return AlarmHandling(
        chatter=chatter, flood=flood, start_up=start_up, shelve_at_most_s=given.shelve_at_most_s
    )


def _setpoint_rule(alarm: SetpointAlarm) -> LevelRule | VotingRule:
    setpoint = Setpoint(
        alarm.alert,
        alarm.danger,
        alarm.deadband,
        _ns(alarm.on_delay_s),
        _ns(alarm.off_delay_s),
        alarm.alert_low,
        alarm.danger_low,
    )
    if isinstance(alarm, LevelAlarm):
        return LevelRule(
            alarm.name,
            alarm.sensor,
            alarm.measure,
            setpoint,
            alarm.latching,
            alarm.trip_multiply,
            alarm.first_out_group,
        )
    return VotingRule(
        alarm.name,
        alarm.sensors,
        alarm.vote,
        alarm.measure,
        setpoint,
        alarm.latching,
        alarm.trip_multiply,
        alarm.first_out_group,
    )


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)
