"""Which part of a rolling bearing is damaged, from one accelerometer on its housing and the shaft's speed."""

from __future__ import annotations

from daqsvc.bearing.race.judge import RaceWatch, race_baseline, race_test
from daqsvc.bearing.race.verdict import PartEvidence, RaceBaseline, RaceLine, RaceRules, RaceVerdict

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
