"""A quality alarm that stands says so when its cause is another one, and not when only figures differ."""

from __future__ import annotations

from daqsvc.alarms.quality import SensorHealth
from daqsvc.diagnosis.record import Diagnosis

SILENCE = "no samples of stream 's' for more than {} s; check bus and device"
RATE = "the device sends {} Hz, the file states 50"


def test_a_wrong_rate_takes_over_from_silence() -> None:
    doubts = SensorHealth()
    found = []
    for reason in (SILENCE.format(2.0), SILENCE.format(7.5), RATE.format(100.1), RATE.format(99)):
        doubts.update(
            Diagnosis("m", "levels", 1, "s", 5, 5, "N", quality="missing", reason=reason, sensors=("a",))
        )
        found.append(doubts.finding("sensor-ok/a"))
    silent, longer, rate, other_rate = found
    assert silent.identity == longer.identity
    assert rate.identity == other_rate.identity
    assert silent.identity != rate.identity
    assert RATE.format(99) in other_rate.sentence
