"""From a machine file to its alarms: whose they are, and what each of them watches."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.events import Identity
from daqsvc.alarms.rules import DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.settings.models import LevelAlarm

if TYPE_CHECKING:
    from daqsvc.settings.models import MachineFile


def identity(machine: MachineFile) -> Identity:
    """Whose alarms these are."""
    return Identity(machine.site, machine.box, machine.machine.name)


def alarm_rules(machine: MachineFile) -> list[LevelRule | DiagnosisRule]:
    """One rule per alarm."""
    rules: list[LevelRule | DiagnosisRule] = []
    for alarm in machine.alarms:
        if isinstance(alarm, LevelAlarm):
            setpoint = Setpoint(
                alarm.alert,
                alarm.danger,
                alarm.deadband,
                round(alarm.on_delay_s * NS_PER_S),
                round(alarm.off_delay_s * NS_PER_S),
            )
            rules.append(LevelRule(alarm.name, alarm.sensor, alarm.measure, setpoint, alarm.latching))
        else:
            rules.append(DiagnosisRule(alarm.name, alarm.detector, alarm.latching))
    return rules
