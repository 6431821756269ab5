"""Measured recordings with a speed or a sampling rate that is not theirs: how often is the test fooled?"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support import race_records

from daqsvc.bearing.race import race_test
from daqsvc.dsp.quality import UnfitError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

pytestmark = [pytest.mark.statistical, pytest.mark.data, pytest.mark.timeout(300)]

FACTORS = 3


def outcomes(
    data: Path,
    factors_of: Callable[[int], Sequence[tuple[float, float]]],
    named: frozenset[int] = frozenset(),
) -> Counter[str]:
    """Judge all records with factors on their speed and on their rate, and count.

    Args:
        data: folder of the recordings.
        factors_of: number of a record to pairs of factors.
        named: numbers of records to count on their own, too.
    """
    found: Counter[str] = Counter()
    for number, r in enumerate(race_records.all_records(data)):
        for speed, rate in factors_of(number):
            found["judged"] += 1
            found["of named parts"] += number in named
            try:
                v = race_test(r.samples, rate * r.rate_hz, speed * r.speed_rpm, r.bearing)
            except UnfitError:
                found["refused"] += 1
                found["refused of named parts"] += number in named
                continue
            found["confirmed"] += v.speed_seen
            found["wrong part"] += v.verdict not in {"normal", r.truth}
            found["right"] += v.verdict == r.truth
            found["sure of normal"] += v.probability["normal"] > 0.5
    return found


def test_wrong_speeds_are_refused_or_not_confirmed(data: Path) -> None:
    def some(number: int) -> list[tuple[float, float]]:
        random = np.random.default_rng(number)
        signs = random.choice([-1.0, 1.0], FACTORS)
        return [(factor, 1.0) for factor in 1.0 + signs * random.uniform(0.04, 0.3, FACTORS)]

    named = {
        number
        for number, r in enumerate(race_records.all_records(data))
        if race_test(r.samples, r.rate_hz, r.speed_rpm, r.bearing).verdict == r.truth != "normal"
    }
    assert named
    counts = outcomes(data, some, frozenset(named))
    assert counts["confirmed"] <= 0.03 * counts["judged"]
    # A healthy machine beside a louder one, and one whose speed is wrong, look alike: neither is sure.
    assert counts["refused of named parts"] >= 0.8 * counts["of named parts"]
    assert counts["sure of normal"] <= 0.06 * counts["judged"]
    assert counts["wrong part"] <= 0.01 * counts["judged"]


def test_wrong_sampling_rates_name_no_wrong_part(data: Path) -> None:
    counts = outcomes(data, lambda _: [(1.0, rate) for rate in (0.5, 10.0 / 12.0, 2.0)])
    assert counts["confirmed"] <= 0.03 * counts["judged"]
    assert counts["wrong part"] == 0


def test_speeds_wrong_by_little_are_put_right(data: Path) -> None:
    counts = outcomes(data, lambda _: [(0.986, 1.0), (1.014, 1.0)])
    # Of 57 records 33 are right as stated.
    assert counts["right"] >= 2 * 33 - 2
    assert counts["refused"] + counts["wrong part"] == 0
