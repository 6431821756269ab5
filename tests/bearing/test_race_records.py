"""The race test on measured machines, one rule for all, and its false alarms in noise.

Every count is a fact about these records, not an estimate for others; where a probability is stated, so is
its confidence. `make bench-data` judges all of them and their windows; here each record is judged once.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support import race_records
from support.race_signals import BEARING, SPEED_RPM

from daqsvc.bearing.race import race_baseline, race_test

if TYPE_CHECKING:
    from pathlib import Path

    from support.race_records import Record

    from daqsvc.bearing.race import RaceVerdict

pytestmark = [pytest.mark.statistical, pytest.mark.timeout(300)]

WINDOW_S = 2.5


@cache
def drive_end(data: Path) -> tuple[Record, ...]:
    return tuple(race_records.cwru(data))


def judge(record: Record, speed: float = 1.0, seconds: float | None = None) -> RaceVerdict:
    samples = record.samples if seconds is None else record.samples[: int(seconds * record.rate_hz)]
    return race_test(samples, record.rate_hz, speed * record.speed_rpm, record.bearing)


def wrong(record: Record, verdict: RaceVerdict) -> bool:
    """Another part named than the damaged one, or any where none is."""
    return verdict.verdict not in {record.truth, "normal"}


@pytest.mark.data
class TestCwru:
    def test_24_of_30_right_and_none_wrong(self, data: Path) -> None:
        verdicts = {r.name: (r, judge(r)) for r in drive_end(data)}
        assert not [name for name, (r, v) in verdicts.items() if wrong(r, v)]
        missed = {name for name, (r, v) in verdicts.items() if v.verdict != r.truth}
        # Four that Smith and Randall could not diagnose either (N1), and both records of OR014@6.
        assert missed <= {"118", "119", "3001", "3002", "197", "198"}

    @pytest.mark.parametrize("speed", [0.99, 1.01])
    def test_a_speed_wrong_by_one_percent_costs_one_record_at_most(self, data: Path, speed: float) -> None:
        verdicts = [(r, judge(r, speed)) for r in drive_end(data)]
        assert not [r.name for r, v in verdicts if wrong(r, v)]
        assert sum(v.verdict == r.truth for r, v in verdicts) >= 31 - 6 - 1

    def test_two_and_a_half_seconds_serve_for_the_races(self, data: Path) -> None:
        verdicts = [(r, judge(r, seconds=WINDOW_S)) for r in drive_end(data)]
        assert not [r.name for r, v in verdicts if wrong(r, v)]
        races = [(r, v) for r, v in verdicts if r.truth in {"inner", "outer"} and r.grade != "N1"]
        assert sum(v.verdict == r.truth for r, v in races) >= len(races) - 2

    def test_the_healthy_far_bearing_of_a_damaged_machine_is_not_named(self, data: Path) -> None:
        assert [r.name for r in race_records.cwru(data, "FE") if judge(r).verdict != "normal"] == []

    def test_a_baseline_finds_every_damage_and_names_no_wrong_part(self, data: Path) -> None:
        healthy = next(r for r in drive_end(data) if r.truth == "normal")
        baseline = race_baseline(healthy.samples, healthy.rate_hz, healthy.speed_rpm, healthy.bearing)
        for r in drive_end(data):
            if r.truth != "normal":
                v = race_test(r.samples, r.rate_hz, r.speed_rpm, r.bearing, baseline=baseline)
                assert v.verdict in {r.truth, "changed"}, r.name

    def test_a_healthy_half_against_the_other_is_normal(self, data: Path) -> None:
        healthy = next(r for r in drive_end(data) if r.truth == "normal")
        first, second = np.array_split(healthy.samples, 2)
        baseline = race_baseline(first, healthy.rate_hz, healthy.speed_rpm, healthy.bearing)
        v = race_test(second, healthy.rate_hz, healthy.speed_rpm, healthy.bearing, baseline=baseline)
        assert v.verdict == "normal"
        assert abs(v.level_db) < 0.5


@pytest.mark.data
@pytest.mark.parametrize("speed", [0.99, 1.0, 1.01])
def test_mfpt_6_of_6(data: Path, speed: float) -> None:
    assert [r.name for r in race_records.mfpt(data) if judge(r, speed).verdict != r.truth] == []


@pytest.mark.data
@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_adi_races_are_named_and_good_bearings_never(data: Path, axis: str) -> None:
    verdicts = [(r, judge(r)) for r in race_records.adi(data, axis)]
    assert not [r.name for r, v in verdicts if wrong(r, v)]
    races = [(r, v) for r, v in verdicts if r.truth in {"inner", "outer"}]
    assert [r.name for r, v in races if v.verdict != r.truth] == []
    # 2 BSF lies so close to 4X that two seconds cannot tell them apart: said, not guessed.
    slow = [v for r, v in verdicts if r.name.startswith("1800")]
    assert all("ball not testable here" in " ".join(v.notes) for v in slow)


def test_no_alarm_in_gaussian_noise() -> None:
    # 400 windows without an alarm: the rate is below 0.75 % at 95 % confidence. `make bench-data` runs 2500.
    random = np.random.default_rng(2024)
    z = []
    for _ in range(400):
        v = race_test(random.standard_normal(30_000), 12_000.0, SPEED_RPM, BEARING)
        assert v.verdict == "normal"
        z.append([e.z for e in v.evidence.values()])
    significance = np.array(z)
    # The null is calibrated: mean and deviation within five standard errors, and a thin tail.
    assert np.all(np.abs(significance.mean(axis=0)) < 0.3)
    assert np.all(np.abs(significance.std(axis=0) - 1.0) < 0.25)
    assert (significance > 4.0).mean() < 0.01
