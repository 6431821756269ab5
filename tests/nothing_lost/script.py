"""What a run tells: a known sequence of diagnoses, and the alarm events that must come of it.

The expectation is worked out here with a dictionary of levels, by no code of the service.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.diagnosis.record import Diagnosis, Severity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.dsp.quality import Quality

HOUR_S = 3600
PAUSES_S = (0.0, 0.0, 0.005, 0.03, 0.07)

SENSORS: dict[str, tuple[str, ...]] = {
    "rotor-bank": ("probe-x", "probe-y"),
    "race-test": ("accelerometer",),
    "levels/probe-z": ("probe-z",),
}
"""The detectors of the machine, with the sensors that they rest on."""

ALARM_OF = {"rotor-bank": "rotor-fault", "race-test": "race-fault", "levels/probe-z": "z-rms"}
QUALITY_ALARM_OF = {
    "rotor-bank": "detector-ok/rotor-bank",
    "race-test": "sensor-ok/accelerometer",
    "levels/probe-z": "sensor-ok/probe-z",
}
RULES: Sequence[LevelRule | DiagnosisRule] = (
    DiagnosisRule("rotor-fault", "rotor-bank"),
    DiagnosisRule("race-fault", "race-test"),
    LevelRule("z-rms", "probe-z", "rms", Setpoint(alert=2.0, danger=3.0)),
)
RMS: dict[Severity, float] = {"normal": 1.0, "alert": 2.5, "danger": 3.5}
SEVERITIES: tuple[Severity, ...] = ("normal", "alert", "danger")


class Expected(NamedTuple):
    """An alarm event as anybody can foresee it: the step that causes it, the alarm, its new level."""

    step: int
    alarm: str
    level: Severity


@dataclass(frozen=True)
class Step:
    """One diagnosis.

    Attributes:
        number: position in the script; every payload carries it as the first sample of its window.
        detector: who speaks.
        severity: what it finds.
        quality: ``missing`` holds the alarm and raises the quality alarm.
        pause_s: how long to wait before.
        wall_offset_s: how far the wall clock is off by then.
    """

    number: int
    detector: str
    severity: Severity
    quality: Quality
    pause_s: float
    wall_offset_s: int

    def diagnosis(self, machine: str, t_ns: int) -> Diagnosis:
        """The diagnosis, whose last sample was taken at ``t_ns`` on the monotonic clock."""
        return Diagnosis(
            machine=machine,
            detector=self.detector,
            t_ns=t_ns,
            stream="shaft",
            first_index=self.number,
            end_index=self.number + 1,
            decision=self.severity,
            severity=self.severity,
            changed=True,
            statistics={"rms": RMS[self.severity]},
            quality=self.quality,
            reason="" if self.quality == "good" else "samples are missing",
            sensors=SENSORS[self.detector],
        )


@dataclass(frozen=True)
class Script:
    """The steps of one machine, from all normal to all normal."""

    identity: Identity
    steps: tuple[Step, ...]

    @classmethod
    def of_seed(cls, seed: int, length: int = 150) -> Script:
        """The script of a seed: ``length`` steps, then one for each detector that makes it normal."""
        rng = random.Random(f"script {seed}")
        severity: dict[str, Severity] = dict.fromkeys(SENSORS, "normal")
        wall_offset_s = 0
        steps = []
        for number in range(length):
            detector = rng.choice(list(SENSORS))
            missing = rng.random() < 0.1
            if not missing:
                severity[detector] = rng.choice(SEVERITIES)
            if rng.random() < 0.04:
                wall_offset_s = rng.choice((-HOUR_S, 0, HOUR_S))
            quality: Quality = "missing" if missing else "good"
            pause_s = rng.choice(PAUSES_S)
            steps.append(Step(number, detector, severity[detector], quality, pause_s, wall_offset_s))
        steps += [
            Step(length + extra, detector, "normal", "good", 0.0, wall_offset_s)
            for extra, detector in enumerate(SENSORS)
        ]
        return cls(Identity("lab", f"edge-{seed}", f"machine-{seed}"), tuple(steps))

    def expected(self) -> list[Expected]:
        """The alarm events that the script must lead to, each once, in this order."""
        level: dict[str, Severity] = {}
        events: list[Expected] = []

        def becomes(step: int, alarm: str, now: Severity) -> None:
            if level.get(alarm, "normal") != now:
                level[alarm] = now
                events.append(Expected(step, alarm, now))

        for step in self.steps:
            good = step.quality == "good"
            becomes(step.number, QUALITY_ALARM_OF[step.detector], "normal" if good else "alert")
            if good:
                becomes(step.number, ALARM_OF[step.detector], step.severity)
        return events
