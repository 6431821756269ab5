"""What the bearings of a machine say together, and how steadily that is stood by."""

from __future__ import annotations

import numpy as np
import pytest

from daqsvc.bearing.identify import BANDS, ResidualChange
from daqsvc.bearing.race.verdict import PARTS, PartEvidence, RaceVerdict
from daqsvc.detectors.bearing.direction import Direction
from daqsvc.detectors.bearing.finding import CLEAR_LOOKS, CONFIRM_LOOKS, WORDS, PersistenceFilter, find


def evidence(severity: float) -> PartEvidence:
    return PartEvidence(
        z=severity,
        depth=1.0,
        severity=severity,
        steadiness=1.0,
        z_limit=5.0,
        limit=3.0,
        steadiness_limit=0.5,
        false_alarm_probability=1e-3,
        order=4.0,
    )


def race(verdict: str, group: tuple[str, ...] | None = None, severity: float = 6.0) -> RaceVerdict:
    group = group or (verdict,)
    parts = [part for part in PARTS if part in group]
    probability = {"normal": 0.1, **{part: 0.9 / len(parts) for part in parts}} if parts else {"normal": 1.0}
    return RaceVerdict(
        verdict=verdict,
        group=group,
        evidence={part: evidence(severity if part in group else 0.5) for part in PARTS},
        probability=probability,
        lines=(),
        margin=2.0,
        speed_rpm=1800.0,
        speed_seen=True,
        revolutions=300.0,
        false_alarm_probability=1e-3,
    )


def change(*, changed: bool) -> ResidualChange:
    rise = np.full(1 + BANDS, 9.0 if changed else 0.0)
    return ResidualChange(changed, rise, np.full(1 + BANDS, 3.0), 5, quiet=False, gain=False)


def test_the_bearing_that_shows_more_decides() -> None:
    found = find({"a": race("outer", severity=4.0), "b": race("inner", severity=9.0)}, None, 1e-3)
    assert (found.verdict, found.where, found.severity) == ("inner", "b", 9.0)
    found = find({"a": race("outer", severity=4.0), "b": race("normal", severity=9.0)}, None, 1e-3)
    assert (found.verdict, found.where) == ("outer", "a")


@pytest.mark.parametrize(
    ("verdicts", "changed", "verdict"),
    [
        (("normal", "normal"), None, "normal"),
        (("normal", "changed"), None, "changed"),
        (("normal", "changed"), False, "normal"),  # significance and size outweigh a level alone
        (("normal", "normal"), True, "changed"),
        (("outer", "normal"), True, "outer"),
        (("outer", "normal"), False, "outer"),
    ],
)
def test_the_innovations_say_whether_anything_has_changed(verdicts, changed, verdict) -> None:
    given = dict(zip("ab", map(race, verdicts), strict=True))
    found = find(given, None if changed is None else change(changed=changed), 1e-3)
    assert (found.verdict, found.group) == (verdict, (verdict,))
    assert set(found.probabilities) == set(WORDS)
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    assert max(found.probabilities, key=found.probabilities.get) == verdict


def direction(*group: str, detected: bool = True, nats: float = 50.0) -> Direction:
    return Direction(detected=detected, group=group, change_nats=nats, limit_nats=10.0)


@pytest.mark.parametrize(
    ("by_lines", "by_direction", "verdict", "group"),
    [
        (race("normal"), direction("outer"), "outer", ("outer",)),
        (race("normal"), direction("ball"), "ball", ("ball",)),
        (race("normal"), direction(), "changed", ("changed",)),
        (race("normal"), direction("inner", "outer", "ball"), "inner_or_outer", ("inner", "outer", "ball")),
        (race("inner_or_outer", ("inner", "outer")), direction("outer"), "outer", ("outer",)),
        (
            race("inner_or_outer", ("inner", "outer")),
            direction("ball"),
            "inner_or_outer",
            ("inner", "outer"),
        ),
        (race("normal"), direction("inner", "ball"), "inner", ("inner", "ball")),
        (race("inner"), direction("inner"), "inner", ("inner",)),
        (race("inner"), direction("inner", "outer", "ball"), "inner", ("inner",)),
        (race("inner"), direction("outer"), "inner_or_outer", ("inner", "outer")),
        (race("inner"), direction("outer", detected=False), "inner_or_outer", ("inner", "outer")),
        (race("inner"), direction("outer", "ball"), "inner", ("inner",)),
        (race("ball"), direction("outer"), "ball", ("ball",)),
    ],
)
def test_the_direction_settles_a_doubt_or_raises_one(by_lines, by_direction, verdict, group) -> None:
    found = find({"a": by_lines}, change(changed=True), 1e-3, {"a": by_direction})
    assert (found.verdict, found.group) == (verdict, group)
    assert sum(found.probabilities.values()) == pytest.approx(1.0)
    assert max(found.probabilities, key=found.probabilities.get) == verdict


def test_the_direction_alone_may_see_a_change() -> None:
    verdicts = {"a": race("normal", severity=2.0), "b": race("normal")}
    still = change(changed=False)
    felt = {"a": direction("inner"), "b": direction(detected=False, nats=1.0)}
    found = find(verdicts, still, 1e-3, felt)
    assert (found.verdict, found.where) == ("inner", "a")
    assert found.probabilities["inner"] == pytest.approx(0.999)
    assert find(verdicts, still, 1e-3, {"a": direction(detected=False)}).verdict == "normal"
    assert find(verdicts, still, 1e-3, {"a": direction()}).verdict == "changed"


def test_of_two_bearings_without_lines_the_one_whose_residual_shows_more_decides() -> None:
    verdicts = {"a": race("normal", severity=9.0), "b": race("normal")}
    felt = {"a": direction("inner", nats=20.0), "b": direction("outer", nats=90.0)}
    found = find(verdicts, None, 1e-3, felt)
    assert (found.verdict, found.where) == ("outer", "b")


def looks(filtered: PersistenceFilter, *words: str) -> list[str]:
    said = []
    for word in words:
        group = ("inner", "outer") if word == "inner_or_outer" else (word,)
        filtered.update(find({"a": race(word, group)}, None, 1e-3))
        said.append(filtered.standing.decision)
    return said


def test_faults_need_two_looks_and_health_eight() -> None:
    filtered = PersistenceFilter()
    assert looks(filtered, "normal", "outer", "normal", "outer") == ["normal"] * 4
    assert looks(filtered, "outer") == ["outer"]
    assert filtered.standing.where == "a"
    assert looks(filtered, *["normal"] * (CLEAR_LOOKS - 1), "outer") == ["outer"] * CLEAR_LOOKS
    assert looks(filtered, *["normal"] * CLEAR_LOOKS) == ["outer"] * (CLEAR_LOOKS - 1) + ["normal"]
    assert CONFIRM_LOOKS == 2


def test_two_names_of_a_fault_are_a_fault() -> None:
    assert looks(PersistenceFilter(), "normal", "changed", "outer") == ["normal", "normal", "outer"]


def test_a_part_once_named_is_not_blurred_but_may_be_renamed() -> None:
    filtered = PersistenceFilter()
    assert looks(filtered, "inner", "inner", *["changed"] * 20) == ["undetermined"] + ["inner"] * 21
    assert looks(filtered, "outer", "ball", "ball") == ["inner", "inner", "ball"]


def test_a_gap_breaks_a_row_of_looks() -> None:
    filtered = PersistenceFilter()
    looks(filtered, "normal", "outer")
    filtered.interrupt()
    assert looks(filtered, "outer", "outer") == ["normal", "outer"]


def test_the_last_look_of_a_short_recording_counts_by_itself() -> None:
    filtered = PersistenceFilter()
    assert filtered.update(find({"a": race("outer")}, None, 1e-3), last=True)
    assert filtered.standing.decision == "outer"
    filtered = PersistenceFilter()
    looks(filtered, "normal")
    assert not filtered.update(find({"a": race("outer")}, None, 1e-3), last=True)
