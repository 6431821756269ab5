"""Which part of a rolling bearing is damaged, from one accelerometer on its housing and the shaft's speed."""

from __future__ import annotations

from daqsvc.bearing.race.baseline import RaceBaseline
from daqsvc.bearing.race.judge import race_baseline, race_test
from daqsvc.bearing.race.rules import RaceRules
from daqsvc.bearing.race.verdict import PartEvidence, RaceLine, RaceVerdict
from daqsvc.bearing.race.watch import RaceWatch

__all__ = [
    "PartEvidence",
    "RaceBaseline",
    "RaceLine",
    "RaceRules",
    "RaceVerdict",
    "RaceWatch",
    "race_baseline",
    "race_test",
]
