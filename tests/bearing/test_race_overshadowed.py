"""Which part explains the lines of another, and what is said where the strongest cannot be named."""

from __future__ import annotations

import pytest

from daqsvc.bearing.race.decision import decide
from daqsvc.bearing.race.verdict import PartEvidence, RaceRules

RULES = RaceRules()


def evidence(z: float, depth: float, *, steadiness: float = 1.0, testable: bool = True) -> PartEvidence:
    return PartEvidence(
        z=z,
        depth=depth,
        steadiness=steadiness,
        severity=z * depth,
        z_limit=RULES.z_limit,
        steadiness_limit=RULES.steadiness_limit,
        limit=RULES.severity_limit,
        false_alarm_probability=1e-4,
        order=3.6,
        testable=testable,
    )


NOTHING = evidence(0.0, 0.0)


def test_a_ball_is_not_named_beside_a_far_stronger_race_that_cannot_be() -> None:
    ball = evidence(15.0, 0.5)
    assert decide({"inner": NOTHING, "outer": NOTHING, "ball": ball}, RULES).verdict == "ball"
    knocks = evidence(28.8, 0.4, steadiness=0.26)
    decision = decide({"inner": NOTHING, "outer": knocks, "ball": ball}, RULES)
    assert decision.verdict == "normal"
    assert decision.probability["normal"] < 0.8


def test_a_weak_comb_that_cannot_be_named_keeps_nothing_from_being_named() -> None:
    race = evidence(7.0, 1.0, steadiness=0.2)
    assert decide({"inner": race, "outer": NOTHING, "ball": evidence(9.0, 0.6)}, RULES).verdict == "ball"


def test_a_part_that_is_not_testable_leaves_doubt_where_its_lines_are_large() -> None:
    ball = evidence(38.0, 1.66, testable=False)
    decision = decide({"inner": NOTHING, "outer": NOTHING, "ball": ball}, RULES)
    assert decision.verdict == "normal"
    assert decision.probability["normal"] == pytest.approx(0.5)
    assert decision.margin == pytest.approx(1000.0)


def test_lines_that_are_far_too_regular_for_noise_leave_doubt_however_small() -> None:
    small = {"inner": evidence(9.5, 0.05), "outer": NOTHING, "ball": NOTHING}
    assert decide(small, RULES).probability["normal"] <= 0.9
    less = {**small, "inner": evidence(4.0, 0.05)}
    assert decide(less, RULES).probability["normal"] > 0.99
