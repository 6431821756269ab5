"""How 1X follows the speed of a shaft that hunts: what is learnt, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rotor.test_rotor_watch import NOISE_UM, with_change
from support.rotor_orbits import HEALTHY, RATE_HZ, ROTOR, SPEED_RAD_S, orbits

from daqsvc.rotor.synchronous.baseline import calibrate, with_rotor
from daqsvc.rotor.synchronous.speed_law import EARLIER_SPEEDS, learn, speed_terms
from daqsvc.rotor.synchronous.vectors import FORWARD, synchronous_vectors
from daqsvc.rotor.synchronous.watch import RotorWatch

if TYPE_CHECKING:
    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration

DAMPING_RATIO = 0.03
SLENDER = replace(ROTOR, natural_frequency_hz=SPEED_RAD_S / (2.0 * math.pi), damping_ratio=DAMPING_RATIO)


def following(deviation: np.ndarray) -> np.ndarray:
    """1X of a Laval rotor at its critical speed, over that of a steady speed: its envelope's first order.

    a' = s (a - slope v), with s the pole of the free motion as the shaft sees it.
    """
    slope = SLENDER.speed_slope(SLENDER.natural_frequency_rad_s)[0]
    kept = math.exp(-2.0 * math.pi * DAMPING_RATIO)
    part = np.zeros(len(deviation), dtype=np.complex128)
    for n in range(1, len(deviation)):
        part[n] = kept * part[n - 1] + (1.0 - kept) * slope * deviation[n]
    return 1.0 + part


def hunting(count: int, period: float = 70.0) -> np.ndarray:
    return 0.01 * np.cos(2.0 * math.pi * np.arange(count) / period)


def watched(
    moved: np.ndarray, deviation: np.ndarray, kept: Calibration | None = None, rotor: LavalRotor = SLENDER
) -> tuple[RotorWatch, list[int]]:
    """A watch after these revolutions, and at which it said that the machine has changed."""
    watch = RotorWatch(rotor, RATE_HZ, calibration=kept)
    reports = watch.evaluate(synchronous_vectors(orbits(moved, NOISE_UM, 5, deviation=deviation)))
    return watch, [report.revolution for report in reports if report.departed]


def late_whirl(count: int) -> tuple[np.ndarray, np.ndarray]:
    # The first swings are not kept: a shaft that has always hunted has no begin.
    deviation = hunting(count + 140)
    moved = np.tile(HEALTHY, (count, 1))
    moved[:, FORWARD] *= following(deviation)[140:]
    return moved, deviation[140:]


def test_a_change_that_the_swings_of_1x_hid_is_seen_once_they_are_learnt() -> None:
    moved, deviation = late_whirl(700)
    _, departed = watched(moved, deviation)
    assert departed == []
    moved[400:, FORWARD] += 0.2 * abs(HEALTHY[FORWARD])
    watch, departed = watched(moved, deviation)
    assert departed[0] in range(401, 441)
    assert "unbalance" in watch.finish().group


def test_more_swings_make_it_surer() -> None:
    moved, deviation = late_whirl(700)
    doubts = []
    for count in (90, 200, 400):
        law = watched(moved[:count], deviation[:count])[0].calibration.law
        still = np.array([0.0, deviation.max() / 10.0, 0.0])
        doubts.append(float(law.variance_um2(still)[FORWARD]))
    assert doubts[0] > 4.0 * doubts[1] > 16.0 * doubts[2]


def test_a_change_among_the_lessons_is_not_learnt() -> None:
    """It comes too early to be seen, beside what one swing leaves uncertain."""
    moved, deviation = late_whirl(150)
    healthy = watched(moved[:90], deviation[:90])[0].calibration
    moved[90:, FORWARD] += 0.2 * abs(HEALTHY[FORWARD])
    watch, departed = watched(moved, deviation)
    assert departed == []
    assert watch.calibration is not None
    learnt = watch.calibration.baseline[FORWARD]
    assert learnt == pytest.approx(healthy.baseline[FORWARD], abs=0.5)


@pytest.mark.parametrize(
    ("times", "within", "seen_by"), [(1.5, 640, 700), (2.0, 1440, 750), (3.0, 1440, 500)]
)
def test_a_slow_growth_is_a_change_however_long_it_is_learnt(times: float, within: int, seen_by: int) -> None:
    moved, deviation = late_whirl(seen_by)
    grown = 1.0 + (times - 1.0) * np.clip((np.arange(seen_by) - 60) / within, 0.0, 1.0)
    moved[:, FORWARD] *= grown
    watch, departed = watched(moved, deviation)
    assert departed
    assert watch.calibration is not None
    assert watch.calibration.baseline[FORWARD] == pytest.approx(HEALTHY[FORWARD], rel=0.02)


@pytest.mark.parametrize(("times", "within"), [(1.2, 900), (1.3, 1900)])
def test_a_fault_that_grows_after_some_swings_is_no_lateness(times: float, within: int) -> None:
    """By then little is left that the speed does not explain; what a fault adds to it is not allowed for."""
    moved, deviation = late_whirl(1500)
    moved[:, FORWARD] *= 1.0 + (times - 1.0) * np.clip((np.arange(1500) - 60) / within, 0.0, 1.0)
    watch, departed = watched(moved, deviation)
    assert departed
    assert watch.calibration is not None
    assert watch.calibration.law.off_um[FORWARD] < 1.0


def test_what_is_kept_has_no_part_of_a_change_that_came_and_went() -> None:
    """A return to health takes what was seen before the alarm into the baseline, not into what is kept."""
    moved, deviation = late_whirl(1900)
    healthy = moved[:, FORWARD].copy()
    grown = 1.0 + 0.3 * np.clip((np.arange(1900) - 60) / 540, 0.0, 1.0)
    moved[:, FORWARD] = healthy * grown
    _, departed = watched(moved[:600], deviation[:600])
    grown[departed[0] + 15 :] = 1.08
    moved[:, FORWARD] = healthy * grown
    watch, _ = watched(moved, deviation)
    assert watch.state == "watching"
    assert abs(watch.calibration.baseline[FORWARD]) > 1.05 * abs(HEALTHY[FORWARD])
    assert watch.learnt.baseline[FORWARD] == pytest.approx(HEALTHY[FORWARD], rel=0.02)
    assert watch.learnt.law is watch.calibration.law
    assert watch.learnt.revolutions == 50


def test_a_rotor_calibrated_at_steady_speed_may_be_late_when_it_hunts() -> None:
    moved, deviation = late_whirl(500)
    watch = RotorWatch(SLENDER, RATE_HZ)
    watch.evaluate(synchronous_vectors(orbits(np.tile(HEALTHY, (200, 1)), 1.0, 5)))
    for times in (1.0, 1.5):
        departed = []
        for begin in (0, 20, 40):
            hunts = orbits(moved[begin:] * [1.0, times, 1.0, 1.0, 1.0], 1.0, 6, deviation=deviation[begin:])
            again = RotorWatch(SLENDER, RATE_HZ, calibration=watch.calibration)
            departed += [report for report in again.evaluate(synchronous_vectors(hunts)) if report.departed]
        assert bool(departed) == (times > 1.0)


@pytest.mark.parametrize("lost", [12, 17, 35, 52])
def test_revolutions_left_out_leave_the_rate_known(lost: int) -> None:
    moved, deviation = late_whirl(600)
    vectors = synchronous_vectors(orbits(moved, NOISE_UM, 5, deviation=deviation))
    for begin in (300, 337, 374):
        gap = slice(begin, begin + lost)
        noise = vectors.noise.copy()
        noise[gap] = np.nan
        reports = RotorWatch(SLENDER, RATE_HZ).evaluate(replace(vectors, noise=noise))
        assert len(reports) == 600 - lost
        assert not [report.revolution for report in reports if report.departed]


def test_revolutions_whose_rate_is_not_known_are_not_judged() -> None:
    """After a gap in the keyphasor, and after a start with what was learnt before."""
    moved, deviation = late_whirl(500)
    vectors = synchronous_vectors(orbits(moved, NOISE_UM, 5, deviation=deviation))
    first, _ = watched(moved, deviation)
    watch = RotorWatch(SLENDER, RATE_HZ, calibration=first.calibration)
    started = watch.evaluate(vectors[:20])
    assert watch.evaluate(replace(vectors[20:30], noise=np.full(10, np.nan)), settled=False) == []
    again = watch.evaluate(vectors[30:50])
    for reports in (started, again):
        judged = [report.evidence is not None for report in reports]
        assert judged == [False] * EARLIER_SPEEDS + [True] * (20 - EARLIER_SPEEDS)


def test_learning_goes_on_after_a_restart() -> None:
    moved, deviation = late_whirl(900)
    early = watched(moved[:70], deviation[:70])[0].calibration
    kept = watched(moved[70:], deviation[70:], early)[0].calibration
    assert early is not None
    assert kept is not None
    rate = np.array([0.0, 1e-3, 0.0])
    doubts = [one.law.variance_um2(rate)[FORWARD] - one.law.off_um[FORWARD] ** 2 for one in (early, kept)]
    assert doubts[1] < doubts[0] / 10.0
    assert kept.baseline[FORWARD] == pytest.approx(early.baseline[FORWARD], abs=0.1)
    # Fewer revolutions teach it no better.
    assert watched(moved[:100], deviation[:100], kept)[0].calibration is kept


def test_other_figures_of_the_rotor_take_their_part_of_the_law() -> None:
    moved, deviation = late_whirl(900)
    wrong = replace(SLENDER, natural_frequency_hz=1.05 * SLENDER.natural_frequency_hz)
    kept = watched(moved, deviation, rotor=wrong)[0].calibration
    assert kept is not None
    corrected = with_rotor(kept, SLENDER)
    # A watch takes what was kept as it is: the slope of the one rotor beside the law of the other.
    departed = [watched(moved, deviation, one)[1] for one in (corrected, replace(kept, rotor=SLENDER))]
    assert departed[0] == []
    assert departed[1] != []


def test_the_first_revolutions_teach_nothing() -> None:
    """What they owe to the speed before them is not known."""
    moved, deviation = late_whirl(60)
    cut = synchronous_vectors(orbits(moved, NOISE_UM, 5, deviation=deviation))
    moved[:EARLIER_SPEEDS, FORWARD] *= 1.2
    odd = synchronous_vectors(orbits(moved, NOISE_UM, 5, deviation=deviation))
    laws = [calibrate(one, SLENDER, RATE_HZ).law for one in (cut, odd)]
    assert laws[0].follows_um == pytest.approx(laws[1].follows_um, rel=0.05, abs=1.0)


def test_a_recording_without_noise_can_teach() -> None:
    moved, deviation = late_whirl(90)
    terms = speed_terms(deviation)
    law = learn(moved, terms, np.zeros(5), *SLENDER.speed_slope(SPEED_RAD_S), 5.0)
    assert law is not None
    assert np.isfinite(law.covariance_um2).all()
    # Parts of one doubt, whose squares add up to it.
    whole = law.variance_um2(terms)[:, FORWARD] - law.off_um[FORWARD] ** 2
    np.testing.assert_allclose((law.doubts_um(terms) ** 2).sum(axis=1), whole, rtol=1e-6)


def test_a_steady_speed_teaches_nothing() -> None:
    still = np.random.default_rng(4).normal(0.0, 1e-4, 200)
    moved = np.tile(with_change(), (200, 1))
    assert learn(moved, speed_terms(still), np.full(5, 0.01), 5.0j, 1.0, 5.0) is None


@given(
    speeds=st.lists(st.floats(-0.05, 0.05), min_size=12, max_size=60),
    at=st.integers(1, 11),
)
def test_terms_come_the_same_one_by_one(speeds: list[float], at: int) -> None:
    deviation = np.array(speeds)
    whole = speed_terms(deviation)
    begin = EARLIER_SPEEDS + at % (len(deviation) - EARLIER_SPEEDS)
    for n in range(begin, len(deviation)):
        one = speed_terms(deviation[n : n + 1], deviation[:n])
        np.testing.assert_allclose(one[0], whole[n], atol=1e-12)


@given(rate=st.floats(-1e-3, 1e-3), first=st.floats(-0.01, 0.01))
def test_the_rate_of_an_even_rise_is_its_slope(rate: float, first: float) -> None:
    terms = speed_terms(first + rate * np.arange(30))
    np.testing.assert_allclose(terms[2:, 1], rate, atol=1e-12)
    np.testing.assert_array_equal(terms[:2, 1], 0.0)
    np.testing.assert_allclose(terms[:, 2], terms[:, 0] ** 2)
