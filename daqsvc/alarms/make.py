"""From the alarms of a machine file to the rules that judge them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.rules import DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.voting import VotingRule
from daqsvc.settings.alarms import DiagnosisAlarm, LevelAlarm

if TYPE_CHECKING:
    from daqsvc.alarms.rules import Rule
    from daqsvc.settings.alarms import Alarm


def alarm_rule(alarm: Alarm) -> Rule:
    """The rule of one alarm."""
    if isinstance(alarm, DiagnosisAlarm):
        return DiagnosisRule(
            alarm.name, alarm.detector, alarm.latching, alarm.evidence_nats, alarm.first_out_group
        )
    setpoint = Setpoint(
        alarm.alert,
        alarm.danger,
        alarm.deadband,
        round(alarm.on_delay_s * NS_PER_S),
        round(alarm.off_delay_s * NS_PER_S),
        alarm.alert_low,
        alarm.danger_low,
    )
    rest = (alarm.measure, setpoint, alarm.latching, alarm.trip_multiply, alarm.first_out_group)
    if isinstance(alarm, LevelAlarm):
        return LevelRule(alarm.name, alarm.sensor, *rest)
    return VotingRule(alarm.name, alarm.sensors, alarm.vote, *rest)
