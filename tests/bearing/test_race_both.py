"""Two damaged races are told as two, one as one; only what cannot be told apart is left open."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support import race_records
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.race import race_test
from daqsvc.bearing.race.decision import decide
from daqsvc.bearing.race.verdict import PartEvidence, RaceRules

WEAK = PartEvidence(0.0, 0.05, 1.0, 0.0, 5.0, 0.3, 3.0, 1e-4, 4.0)


def test_two_damaged_races_are_told_as_two() -> None:
    samples = strikes("inner", strength=1.5, seed=1) + strikes("outer", strength=1.6, seed=2)
    v = race_test(samples, RATE_HZ, SPEED_RPM, BEARING)
    assert v.both
    assert v.verdict in {"inner", "outer"}
    assert v.group[0] == v.verdict
    assert set(v.group) == {"inner", "outer"}
    assert any("both may be damaged" in note for note in v.notes)


@pytest.mark.parametrize("part", ["inner", "outer"])
@pytest.mark.parametrize("seed", range(4))
def test_one_damaged_race_is_one(part: str, seed: int) -> None:
    v = race_test(strikes(part, strength=2.0, seed=seed), RATE_HZ, SPEED_RPM, BEARING)
    assert (v.verdict, v.group, v.both) == (part, (part,), False)


@pytest.mark.parametrize(
    ("inner_z", "outer_z", "verdict", "group"),
    [
        (20.0, 30.0, "outer", ("outer", "inner")),
        (30.0, 20.0, "inner", ("inner", "outer")),
        # Both pass their limits, but barely: which it is remains open.
        (6.2, 6.4, "inner_or_outer", ("inner", "outer")),
        (30.0, 6.4, "inner", ("inner",)),
    ],
)
def test_both_must_stand_by_themselves(
    inner_z: float, outer_z: float, verdict: str, group: tuple[str, ...]
) -> None:
    inner, outer = (replace(WEAK, z=z, depth=0.5, severity=0.5 * z) for z in (inner_z, outer_z))
    decision = decide({"inner": inner, "outer": outer, "ball": WEAK}, RaceRules())
    assert (decision.verdict, decision.group) == (verdict, group)
    assert decision.both == (verdict != "inner_or_outer" and len(group) == 2)


@pytest.mark.data
@pytest.mark.parametrize(("one", "other"), [("105", "130"), ("106", "131"), ("209", "130")])
def test_the_sum_of_two_measured_machines_shows_both(data, one: str, other: str) -> None:
    records = {r.name: r for r in race_records.cwru(data)}
    first, second = records[one].samples, records[other].samples
    n = min(len(first), len(second))
    v = race_test(
        first[:n] / first.std() + second[:n] / second.std(), RATE_HZ, records[one].speed_rpm, BEARING
    )
    assert v.both
    for name in (one, other):
        alone = race_test(records[name].samples, RATE_HZ, records[name].speed_rpm, BEARING)
        assert not alone.both
