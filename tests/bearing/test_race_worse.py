"""What a critical reader tried on the race test: measured records, made worse in ways that happen."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.race_records import cwru

from daqsvc.bearing.race import race_test

if TYPE_CHECKING:
    from pathlib import Path

    from support.race_records import Record


pytestmark = [pytest.mark.statistical, pytest.mark.data, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def records(data: Path) -> dict[str, Record]:
    return {record.name: record for record in cwru(data)}


@pytest.mark.parametrize("name", ["258", "259"])
def test_noise_never_makes_a_ball_of_the_sidebands_of_a_damaged_outer_race(
    records: dict[str, Record], name: str
) -> None:
    record = records[name]
    verdicts = []
    for level_db in (10.0, 5.0, 0.0):
        for seed in range(4):
            noise = np.random.default_rng(seed).standard_normal(len(record.samples))
            noisy = record.samples + noise * record.samples.std() * 10.0 ** (-level_db / 20.0)
            verdicts.append(race_test(noisy, record.rate_hz, record.speed_rpm, record.bearing).verdict)
    assert set(verdicts) <= {"outer", "normal"}
    assert verdicts.count("outer") >= 6


def test_halves_exchanged_make_no_ball_of_a_damaged_outer_race(records: dict[str, Record]) -> None:
    record = records["158"]
    exchanged = np.roll(record.samples, len(record.samples) // 2)
    verdict = race_test(exchanged, record.rate_hz, record.speed_rpm, record.bearing)
    assert verdict.verdict in {"outer", "normal"}
    assert verdict.probability["normal"] < 0.8
