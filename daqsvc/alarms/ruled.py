"""The alarms that have a rule, found by what a diagnosis brings: a detector, or sensors."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from daqsvc.alarms.alarm import Alarm
    from daqsvc.alarms.rules import Rule, Watch


class Ruled:
    """An alarm with its rule, the rule's memory, and the sensors that it rests on.

    Args:
        place: which one it is of the alarms with a rule, from 0; events of one diagnosis come in this order.
        alarm: the alarm.
        rule: its rule.
    """

    def __init__(self, place: int, alarm: Alarm, rule: Rule) -> None:
        self.place = place
        self.alarm = alarm
        self.rule = rule
        self.watch: Watch = rule.watch()
        self.sensors = frozenset(rule.sensors)
        """Changed by `RuledAlarms.rest` only, which also finds the alarm by them."""


class RuledAlarms:
    """All alarms that have a rule, in the order in which they were added.

    A diagnosis costs only the alarms that it is about, however many others there are.
    """

    def __init__(self) -> None:
        self._by_name: dict[str, Ruled] = {}
        self._by_detector: defaultdict[str, list[Ruled]] = defaultdict(list)
        self._by_sensor: defaultdict[str, dict[int, Ruled]] = defaultdict(dict)

    def __iter__(self) -> Iterator[Ruled]:
        """All of them, in order."""
        return iter(self._by_name.values())

    def add(self, alarm: Alarm, rule: Rule) -> None:
        """Add the alarm of ``rule``; each name once."""
        ruled = self._by_name[alarm.name] = Ruled(len(self._by_name), alarm, rule)
        for detector in dict.fromkeys(rule.detectors):
            self._by_detector[detector].append(ruled)
        for sensor in ruled.sensors:
            self._by_sensor[sensor][ruled.place] = ruled

    def named(self, name: str) -> Ruled | None:
        """The alarm of that name; None if no rule has it."""
        return self._by_name.get(name)

    def fed_by(self, detector: str) -> Sequence[Ruled]:
        """Those that the diagnoses of ``detector`` feed, in order."""
        return self._by_detector.get(detector, ())

    def touched(self, detector: str, sensors: Collection[str]) -> Sequence[Ruled]:
        """Those that ``detector`` feeds or that rest on one of ``sensors``, in order."""
        if not sensors:
            return self.fed_by(detector)
        touched = {ruled.place: ruled for ruled in self.fed_by(detector)}
        for sensor in sensors:
            touched |= self._by_sensor.get(sensor, {})
        return [touched[place] for place in sorted(touched)]

    def rest(self, ruled: Ruled, sensors: frozenset[str]) -> None:
        """From now on ``ruled`` rests on ``sensors``."""
        for sensor in ruled.sensors - sensors:
            del self._by_sensor[sensor][ruled.place]
        for sensor in sensors - ruled.sensors:
            self._by_sensor[sensor][ruled.place] = ruled
        ruled.sensors = sensors
