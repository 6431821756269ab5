"""What strikes at an order that is none of the bearing's names no part of it, and a note states why."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.signal import lfilter
from support import race_records
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.geometry import bearing_orders
from daqsvc.bearing.race import RaceRules, race_test
from daqsvc.bearing.race.judge import race_features, verdict_of

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


def struck(order: float, *, modulated: float = 0.0) -> NDArray[np.float64]:
    """A good bearing, and strikes of something else at an order, modulated by the cage."""
    x = strikes(None, 10.0)
    turn = SPEED_RPM / 60.0 / RATE_HZ
    random = np.random.default_rng(5)
    at = np.cumsum(1.0 + 0.01 * random.standard_normal(int(order * turn * len(x)))) / order
    place = np.rint(at / turn).astype(int)
    kept = place < len(x)
    impulses = np.zeros(len(x))
    height = 1.0 + modulated * np.cos(2 * np.pi * BEARING.cage * at)
    np.add.at(impulses, place[kept], height[kept])
    pole = np.exp(-2 * np.pi * 200.0 / RATE_HZ + 2j * np.pi * 3000.0 / RATE_HZ)
    return x + 12.0 * lfilter([1.0], [1.0, -pole], impulses).imag


@pytest.mark.parametrize(
    ("order", "part", "factor"),
    [(7.292, "outer", 2), (9.45, "ball", 2), (4.35, "inner", 4), (5.25, "outer", 3)],
)
def test_a_family_without_the_parts_own_order_is_not_the_parts(order: float, part: str, factor: int) -> None:
    verdict = race_test(struck(order), RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.verdict == "normal"
    assert verdict.probability["normal"] < 0.7
    evidence = verdict.evidence[part]
    assert not evidence.testable
    assert "only lines at multiples of order" in evidence.reason
    assert f"{factor} times its own" in evidence.reason
    assert f"{part} not testable here: {evidence.reason}" in verdict.notes


@pytest.mark.parametrize("order", [4.6, 4.65, 4.8])
def test_strikes_that_the_cage_does_not_modulate_are_no_balls(order: float) -> None:
    verdict = race_test(struck(order), RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.verdict == "normal"
    assert "not modulated by the cage" in verdict.evidence["ball"].reason
    assert verdict.probability["normal"] <= 0.5
    if abs(order / BEARING.ball_pass - 1.0) < 0.015:
        assert race_test(struck(order, modulated=0.6), RATE_HZ, SPEED_RPM, BEARING).verdict == "ball"


def test_lines_farther_from_their_place_than_slip_are_none_of_the_outer_race() -> None:
    near = race_test(struck(1.01 * BEARING.outer), RATE_HZ, SPEED_RPM, BEARING)
    assert near.verdict == "outer"
    far = race_test(struck(1.024 * BEARING.outer), RATE_HZ, SPEED_RPM, BEARING)
    assert far.verdict == "normal"
    assert "2.4% from its own 3.585" in far.evidence["outer"].reason


@pytest.mark.parametrize(("part", "order"), [("outer", BEARING.outer), ("inner", BEARING.inner)])
def test_strikes_that_fit_no_part_of_the_stated_bearing_are_told(part: str, order: float) -> None:
    samples = strikes(part, 10.0, strength=2.0)
    assert race_test(samples, RATE_HZ, SPEED_RPM, BEARING).verdict == part
    verdict = race_test(samples, RATE_HZ, SPEED_RPM, bearing_orders("6305-2Z"))
    assert verdict.verdict == "normal"
    assert verdict.probability["normal"] <= 0.9
    (told,) = (note for note in verdict.notes if "fit no part of this bearing" in note)
    assert f"order {order:.2f}"[:-1] in told
    assert f"stand out at {order * SPEED_RPM / 60.0:.0f}"[:-1] in told


# Beside a sideband of a part that is not found, of a harmonic of the cage, or of the shaft.
@pytest.mark.parametrize("order", [4.4, 5.2, 5.9, 6.4, 6.57, 11.2])
def test_a_part_that_is_not_found_explains_no_strikes(order: float) -> None:
    verdict = race_test(struck(order), RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.verdict == "normal"
    assert verdict.probability["normal"] <= 0.9
    (note,) = (note for note in verdict.notes if "fit no part of this bearing" in note)
    assert f"(order {order:.1f}" in note or f"(order {order - 0.1:.1f}" in note


def test_a_part_of_another_bearing_is_not_named_by_multiples_of_stronger_strikes() -> None:
    # Twice the rate of the outer race is that of the inner race of a 7314B.
    verdict = race_test(strikes("outer", 10.0, strength=2.0), RATE_HZ, SPEED_RPM, bearing_orders("7314B"))
    assert verdict.verdict == "normal"
    assert max(verdict.probability[part] for part in ("inner", "outer", "ball")) < 0.5
    assert verdict.probability["normal"] <= 0.5
    assert "stronger strikes at order 3.58" in verdict.evidence["inner"].reason
    assert any("fit no part of this bearing" in note for note in verdict.notes)


@pytest.mark.data
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("record", "designation", "order"),
    [
        *(("130", name, 3.59) for name in ("6312", "ER12K", "7200B", "7202A", "7301A", "7314B")),
        *(("105", name, 5.40) for name in ("7203B", "7215B", "5215", "7302B")),
        ("209", "5215", 5.40),
        *(("234", name, 3.59) for name in ("6212", "7200B", "6020")),
    ],
)
def test_measured_damage_under_a_wrong_designation_has_a_note(
    data: Path, record: str, designation: str, order: float
) -> None:
    (r,) = (r for r in race_records.cwru(data) if r.name == record)
    verdict = race_test(r.samples, r.rate_hz, r.speed_rpm, bearing_orders(designation))
    assert verdict.verdict == "normal"
    assert verdict.probability["normal"] <= 0.9
    (note,) = (note for note in verdict.notes if "fit no part of this bearing" in note)
    assert f"(order {order:.2f}" in note or f"(order {order + 0.01:.2f}" in note


@pytest.mark.parametrize("part", [None, "inner", "outer", "ball"])
def test_no_strikes_are_told_that_are_a_parts_own(part: str | None) -> None:
    for seed in range(3):
        verdict = race_test(strikes(part, 10.0, strength=0.3, seed=seed), RATE_HZ, SPEED_RPM, BEARING)
        assert not any("fit no part" in note for note in verdict.notes)


@pytest.mark.parametrize(
    ("z", "depth", "steadiness", "why"),
    [
        (38.1, 0.54, 0.275, "(z 38.1), but its impacts are too uneven (steadiness 0.275 of 0.287)"),
        (38.1, 0.1, 0.5, "(z 38.1), too small for damage (size 0.10 of 0.12)"),
        (9.5, 0.2, 0.5, "(z 9.5), too small for damage (size 0.20, severity 1.9 of 3.0)"),
    ],
)
def test_a_part_that_stands_out_and_is_not_named_has_a_note(
    z: float, depth: float, steadiness: float, why: str
) -> None:
    rules = RaceRules()
    features = race_features(strikes(None, 10.0), RATE_HZ, SPEED_RPM, BEARING, rules)
    inner = replace(
        features.evidence["inner"],
        z=z,
        depth=depth,
        severity=z * depth,
        steadiness=steadiness,
        steadiness_limit=0.287,
    )
    verdict = verdict_of(replace(features, evidence={**features.evidence, "inner": inner}), rules, None)
    assert verdict.verdict == "normal"
    assert any(note.startswith(f"lines of the inner race stand out {why}") for note in verdict.notes)
