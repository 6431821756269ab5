"""The alarms that are there by themselves: people may act on them before they are first raised."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.alarms.conditions import ALARM_FLOOD, TRIP_MULTIPLY
from daqsvc.alarms.quality import quality_alarm

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from daqsvc.settings.alarms import AlarmHandling


class Expected:
    """Names of the alarms that can come without a rule of the machine file.

    Args:
        handling: states whether there can be a flood, and a start-up that lasts too long.
    """

    def __init__(self, handling: AlarmHandling) -> None:
        self.conditions = set(handling_conditions(handling))
        """Those of the service itself."""
        self.quality: dict[str, dict[str, Sequence[str]]] = {}
        """Those about whether a sensor can be judged: their detectors, with the sensors these rest on."""

    def note(self, active_detectors: Mapping[str, Sequence[str]], conditions: Iterable[str]) -> None:
        """Learn more of them.

        Args:
            active_detectors: the detectors that will make statements, with the sensors that these rest on.
            conditions: names of what the service will report about itself.
        """
        for detector, sensors in active_detectors.items():
            self.quality.setdefault(quality_alarm(detector, sensors), {})[detector] = sensors
        self.conditions.update(conditions)

    @property
    def names(self) -> set[str]:
        """All of them."""
        return self.quality.keys() | self.conditions


def handling_conditions(handling: AlarmHandling) -> list[str]:
    """The conditions that the alarms themselves may bring: a flood, and a start-up that lasts too long."""
    there = ((ALARM_FLOOD, handling.flood_alarms > 0), (TRIP_MULTIPLY, handling.start_up is not None))
    return [name for name, is_there in there if is_there]
