"""From the alarms of a machine file to the rules that judge them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.rules import Beside, DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.voting import VotingRule
from daqsvc.settings.alarms import DiagnosisAlarm, LevelAlarm
from daqsvc.settings.measures import PHASE_OF

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
        alarm.reference_deg,
        alarm.boundaries,
    )
    rest = (alarm.measure, setpoint, alarm.latching, alarm.trip_multiply, alarm.first_out_group)
    if isinstance(alarm, LevelAlarm):
        return LevelRule(alarm.name, alarm.sensor, *rest, _phase(alarm))
    return VotingRule(alarm.name, alarm.sensors, alarm.vote, *rest)


def _phase(alarm: LevelAlarm) -> Beside | None:
    """The limits of the phase beside those of the amplitude."""
    if (phase := alarm.phase) is None:
        return None
    setpoint = Setpoint(
        phase.alert,
        phase.danger,
        phase.deadband,
        round(alarm.on_delay_s * NS_PER_S),
        round(alarm.off_delay_s * NS_PER_S),
        reference_deg=phase.reference_deg,
    )
    return Beside(PHASE_OF[alarm.measure], setpoint)
