"""From the alarms of a machine file to the rules that judge them."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.rules import Beside, DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.voting import VotingRule
from daqsvc.settings.alarms import DiagnosisAlarm, LevelAlarm
from daqsvc.settings.measures import PHASE_OF

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.alarms.rules import Rule
    from daqsvc.settings.alarms import Alarm


_VALUE = "value"
"""The measure of a trend value."""


def alarm_rule(alarm: Alarm, value_names: Mapping[str, Mapping[float, str]] = MappingProxyType({})) -> Rule:
    """The rule of one alarm.

    Args:
        alarm: its table in the machine file.
        value_names: by sensor, what some of its values mean; see `MachineFile.value_names`.
    """
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
        named = value_names.get(alarm.sensor, {}) if alarm.measure == _VALUE else {}
        return LevelRule(alarm.name, alarm.sensor, *rest, _phase(alarm), tuple(named.items()))
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
