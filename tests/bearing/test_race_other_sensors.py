"""Damage of the drive end's bearing as other sensors hear it: no limit was chosen with them in view."""

# ruff: noqa: T201 - the figures are part of what it is for

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import pytest
from scipy.io import loadmat
from support import race_records

from daqsvc.bearing.geometry import bearing_orders
from daqsvc.bearing.race import race_test

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.statistical, pytest.mark.data, pytest.mark.timeout(300)]


def heard(data: Path, sensor: str, designation: str) -> Counter[tuple[str, str]]:
    """Damage of the drive end, and what a bearing's orders find at the fan end (FE) or the base (BA)."""
    found: Counter[tuple[str, str]] = Counter()
    bearing = bearing_orders(designation)
    for r in race_records.cwru(data):
        path = data / "cwru" / f"{r.name}.mat"
        channels = {k: v for k, v in loadmat(path).items() if k.endswith(f"{sensor}_time")}
        own = [k for k in channels if k.startswith(f"X{int(r.name):03d}")] or list(channels)
        if own:
            v = race_test(channels[own[0]].ravel(), r.rate_hz, r.speed_rpm, bearing)
            found[r.truth, v.verdict] += 1
    return found


@pytest.mark.parametrize("sensor", ["FE", "BA"])
def test_other_sensors_hear_the_same_part_or_none(data: Path, sensor: str) -> None:
    verdicts = heard(data, sensor, "6205-2RS")
    for part in ("inner", "outer", "ball"):
        of_part = sum(count for (truth, _), count in verdicts.items() if truth == part)
        print(f"{sensor}: {part} named in {verdicts[part, part]} of {of_part}")
    assert not [pair for pair in verdicts if pair[1] not in {pair[0], "normal"}]
    assert verdicts["inner", "inner"] + verdicts["outer", "outer"] >= 15


def test_the_base_shows_no_damage_of_the_fan_ends_good_bearing(data: Path) -> None:
    verdicts = heard(data, "BA", "6203-2RS")
    assert sum(verdicts.values()) >= 25
    assert {verdict for _, verdict in verdicts} == {"normal"}
