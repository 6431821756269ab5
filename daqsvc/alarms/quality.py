"""What the detectors have against the sensors: the ground of quality alarms and of suppression."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.alarms.events import Doubt
from daqsvc.alarms.rules import Finding
from daqsvc.alarms.states import Level

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from daqsvc.alarms.rules import Rule
    from daqsvc.diagnosis.record import Diagnosis

PREFIXES = ("sensor-ok/", "detector-ok/")
"""How the names of quality alarms begin."""


def quality_alarm(detector: str, sensors: Sequence[str]) -> str:
    """The quality alarm that a statement of ``detector`` bears on."""
    if len(sensors) == 1:
        return f"sensor-ok/{sensors[0]}"
    return f"detector-ok/{detector}"


class Doubts:
    """What each detector has against its sensors, from a statement that is not good to the next good one.

    Missing samples do not take back that a sensor was not OK.
    """

    def __init__(self) -> None:
        self._by_detector: dict[str, tuple[str, Doubt]] = {}
        self._unsettled: dict[str, set[str]] = {}

    def take(self, diagnosis: Diagnosis) -> list[str]:
        """Take in a statement; the quality alarms that it bears on."""
        detector = diagnosis.detector
        name = quality_alarm(detector, diagnosis.sensors)
        before = self._by_detector.pop(detector, None)
        if diagnosis.quality == "good":
            for detectors in self._unsettled.values():
                detectors.discard(detector)
        else:
            not_ok = diagnosis.quality == "not_ok" or (before is not None and before[1].not_ok)
            doubt = Doubt(detector, diagnosis.quality, not_ok, diagnosis.reason, tuple(diagnosis.sensors))
            self._by_detector[detector] = (name, doubt)
        # A detector may rest on other sensors than before: then what it had against those is settled, too.
        return [name] if before is None or before[0] == name else [before[0], name]

    def resume(self, doubts: Iterable[Doubt]) -> None:
        """Go on from before a restart."""
        for doubt in doubts:
            self._by_detector[doubt.detector] = (quality_alarm(doubt.detector, doubt.sensors), doubt)

    def unsettle(self, rule: Rule) -> None:
        """Whoever found a sensor of ``rule`` not OK is gone; now its own detectors must find them good."""
        self._unsettled[rule.alarm] = set(rule.detectors)

    def of(self, name: str) -> tuple[Doubt, ...]:
        """What is said against the subject of the quality alarm ``name``, by detector."""
        return tuple(
            sorted(doubt for alarm, doubt in self._by_detector.values() if alarm == name),
        )

    def finding(self, name: str) -> Finding:
        """What the quality alarm ``name`` is to say."""
        subject, doubts = name.partition("/")[2], self.of(name)
        if not doubts:
            return Finding(Level.NORMAL, "good", f"{subject} is good again")
        worst = min(doubts, key=lambda doubt: doubt.quality != "not_ok")
        what = "cannot be judged" if worst.quality == "missing" else "not OK"
        because = f": {worst.reason}" if worst.reason else ""
        said = "|".join(f"{d.detector}={d.quality}{'+not_ok' if d.not_ok else ''}" for d in doubts)
        return Finding(Level.ALERT, said, f"{subject} {what}{because}")

    def not_ok_sensors(self) -> dict[str, str]:
        """The sensors that somebody blames by name, with the reason."""
        return {
            doubt.sensors[0]: doubt.reason or "a sensor is not OK"
            for _, doubt in self._by_detector.values()
            if doubt.not_ok and len(doubt.sensors) == 1
        }

    def silences(self, rule: Rule, sensors: frozenset[str]) -> str | None:
        """Why the alarm of ``rule`` cannot speak while it rests on ``sensors``; None if it can.

        Its own detector says that a sensor is not OK, without saying which, or more of its sensors are blamed
        than it can spare.
        """
        if self._unsettled.get(rule.alarm):
            return "a sensor was not OK before the restart"
        for detector in rule.detectors:
            blamed = self._by_detector.get(detector)
            if rule.spare == 0 and blamed is not None and blamed[1].not_ok:
                return blamed[1].reason or "a sensor is not OK"
        blamed_sensors = self.not_ok_sensors()
        lost = [sensor for sensor in sorted(sensors) if sensor in blamed_sensors]
        return blamed_sensors[lost[0]] if len(lost) > rule.spare else None
