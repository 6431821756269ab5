"""The words of a verdict about a rotor."""

from __future__ import annotations

from dataclasses import replace

from daqsvc.detectors.shaft.verdict import Instant, RotorVerdict
from daqsvc.dsp.quality.recorded import DataQuality


def test_a_clear_verdict_does_not_say_that_it_cannot_be_told_from_others():
    verdict = RotorVerdict(
        recording="a.npz",
        quality=DataQuality(0),
        verdict="unmodelled",
        group=("unmodelled", "rub"),
        named=True,
        probabilities={"unmodelled": 0.9995, "rub": 0.0005},
        departure=Instant(0, 0.0, 0),
        onset=Instant(0, 0.0, 0),
    )
    assert "unmodelled or rub (unmodelled above 99.9 %, but rub is not excluded)" in verdict.describe()
    open_one = replace(verdict, probabilities={"unmodelled": 0.6, "rub": 0.4})
    assert "unmodelled or rub (cannot be told apart; unmodelled 60.0 %)" in open_one.describe()
    three = replace(verdict, group=("unmodelled", "rub", "unbalance"))
    assert "but rub and unbalance are not excluded)" in three.describe()
