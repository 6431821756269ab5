"""The steps of the race test, each on signals whose answer is known."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.fft
from support.race_signals import BEARING, RATE_HZ

from daqsvc.bearing.race.decision import decide
from daqsvc.bearing.race.lines import (
    LineEvidence,
    ModulationDepth,
    best_comb,
    false_alarm_probability,
    fundamental,
    highest_order,
    line_evidence,
    sharpest,
    significance,
)
from daqsvc.bearing.race.verdict import (
    PARTS,
    BandLevels,
    Part,
    PartEvidence,
    RaceBaseline,
    RaceRules,
    band_levels,
)
from daqsvc.dsp.envelope import line_power, running_median, squared_envelope, whiten
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.speed.harmonics import ShaftRate, shaft_rate, slow_series

RULES = RaceRules()
PER_ORDER = 75.0


def test_running_median_follows_a_ramp_and_passes_over_lines() -> None:
    ramp = np.linspace(1.0, 3.0, 4000)
    lines = ramp.copy()
    lines[::97] += 100.0
    medians = running_median(lines, 200)
    assert np.abs(medians[200:-200] - ramp[200:-200]).max() < 0.06


def test_whitening_leaves_phases_and_clips_lines() -> None:
    random = np.random.default_rng(0)
    n = 24_000
    x = random.standard_normal(n) + 50.0 * np.cos(2 * np.pi * 0.25 * np.arange(n))
    band = whiten(scipy.fft.rfft(x), n, RATE_HZ, 400.0, 5760.0, 30.0)
    assert np.abs(band.phase) == pytest.approx(1.0, abs=1e-6)
    assert np.abs(band.clipped).max() == pytest.approx(3.0, abs=1e-5)


def test_the_depth_of_a_known_modulation_is_found() -> None:
    random = np.random.default_rng(1)
    n, index, order, turns = 120_000, 0.4, 3.6, 300.0
    phase = 2 * np.pi * order * turns * np.arange(n) / n
    # Power modulated by 1 + m cos: the squared envelope of white noise has modulation index m.
    x = random.standard_normal(n) * np.sqrt(1.0 + index * np.cos(phase))
    band = whiten(scipy.fft.rfft(x), n, RATE_HZ, 400.0, 5760.0, 30.0)
    power = line_power(squared_envelope(band.clipped, 9000), 9000)
    depth = ModulationDepth(power, np.zeros(9000, dtype=bool), turns)
    assert depth.comb(np.array([order]))[0] == pytest.approx(index, rel=0.15)
    assert sharpest([depth], 3.62, 0.01, turns) == pytest.approx(order, rel=0.006)


def noise_power(bins: int, seed: int = 0) -> np.ndarray:
    """A Hann-windowed periodogram of noise with the unit of one bin per 1/75 order."""
    noise = np.random.default_rng(seed).standard_normal(2 * bins + 100).astype(np.float32)
    return line_power(noise, bins)


def with_lines(power: np.ndarray, orders: list[float], height: float = 60.0) -> np.ndarray:
    lined = power.copy()
    for order in orders:
        lined[round(order * PER_ORDER)] += height * np.median(power)
    return lined


def test_a_line_is_evident_and_the_shafts_are_not() -> None:
    evidence = line_evidence(with_lines(noise_power(2100), [3.6, 5.0]), PER_ORDER)
    assert evidence.at(3.6) > 20.0
    assert evidence.at(5.0) < 1.0
    assert evidence.notched[round(5.0 * PER_ORDER)]
    assert not evidence.notched[round(3.6 * PER_ORDER)]
    assert evidence.at(100.0) == 0.0


def test_a_smeared_line_is_evident_though_no_bin_of_it_is() -> None:
    power = noise_power(2100)
    centre = round(14.4 * PER_ORDER)
    power[centre - 10 : centre + 11] *= 3.0
    narrow = line_evidence(noise_power(2100), PER_ORDER).at(14.4)
    assert line_evidence(power, PER_ORDER).at(14.4) > narrow + 8.0


@pytest.mark.parametrize("part", ["inner", "outer"])
@pytest.mark.parametrize("slip", [-0.01, 0.0, 0.012])
def test_a_slipped_comb_is_found(part: Part, slip: float) -> None:
    order = (1.0 + slip) * fundamental(BEARING, part)
    power = with_lines(noise_power(2100), [h * order for h in (1, 2, 3, 4)])
    view = line_evidence(power, PER_ORDER)
    comb = best_comb((view, view), BEARING, part, 0.015)
    assert comb.order == pytest.approx(order, rel=0.006)
    assert significance(comb.score, part, 75.0, 0.015) > 10.0


def test_what_one_view_does_not_see_does_not_count() -> None:
    lines = [h * BEARING.outer for h in (1, 2, 3, 4)]
    seen = line_evidence(with_lines(noise_power(2100), lines), PER_ORDER)
    blind = line_evidence(noise_power(2100, seed=5), PER_ORDER)
    comb = best_comb((seen, blind), BEARING, "outer", 0.015)
    assert significance(comb.score, "outer", 75.0, 0.015) < 5.0


def test_explained_lines_speak_for_nothing_else() -> None:
    evidence = LineEvidence(np.ones(2100), np.zeros(2100, dtype=bool), PER_ORDER)
    rest = evidence.without(evidence.about([3.6]))
    assert rest.at(3.6) == 0.0
    assert rest.at(3.7) > 0.0
    assert evidence.at(3.6) > 0.0


def test_no_comb_looks_beyond_the_highest_order() -> None:
    assert highest_order(BEARING) > 4.0 * BEARING.inner


def test_false_alarms_get_rarer_with_significance() -> None:
    probabilities = [false_alarm_probability(z) for z in (-3.0, 0.0, 3.0, 5.0, 6.0, 30.0)]
    assert probabilities == sorted(probabilities, reverse=True)
    assert probabilities[0] == 1.0
    assert false_alarm_probability(5.0) == pytest.approx(4e-4)


def tones(orders: list[float], shaft_hz: float, seconds: float = 4.0, seed: int = 0) -> tuple:
    """Spectrum of tones in noise, what lies between its bins, and an envelope that is noise alone."""
    t = np.arange(int(seconds * 2000)) / 2000.0
    random = np.random.default_rng(seed)
    noise = random.standard_normal(len(t))
    spectrum = scipy.fft.rfft(noise + sum(np.cos(2 * np.pi * o * shaft_hz * t + o) for o in orders))
    return spectrum, 1.0 / seconds, random.standard_exponential(len(spectrum))


def found(tones: tuple, stated_hz: float, cage: float = 0.398) -> ShaftRate:
    """The shaft as found in such tones."""
    spectrum, step_hz, envelope = tones
    slow = slow_series(spectrum, step_hz, stated_hz)
    return shaft_rate(*slow, envelope, 1.0 / step_hz, stated_hz, 0.012, cage)


@pytest.mark.parametrize("error", [-0.01, -0.004, 0.0, 0.01])
def test_the_speed_is_taken_from_the_shafts_lines(error: float) -> None:
    shaft = found(tones([1, 2, 3], 30.0), 30.0 * (1.0 + error))
    assert shaft.rate_hz == pytest.approx(30.0, rel=3e-4)
    assert shaft.seen
    assert shaft.sharp


def test_without_harmonics_the_stated_speed_stays() -> None:
    shaft = found(tones([], 30.0), 30.0)
    assert not shaft.seen
    assert not shaft.sharp
    assert shaft.rate_hz == pytest.approx(30.0, rel=0.012)


def test_a_wholly_other_speed_is_named() -> None:
    shaft = found(tones([1, 2, 3], 24.0), 30.0)
    assert shaft.rival_hz == pytest.approx(24.0, rel=0.01)
    assert not shaft.seen
    assert re.search(r"at about 14\d\d rpm than at 1800 rpm.*sampled", shaft.doubt)


def test_a_damaged_balls_line_is_not_taken_for_another_speed() -> None:
    cage_side = [h * (1.0 - BEARING.cage) for h in (1, 2, 3)]
    shaft = found(tones(cage_side, 30.0), 30.0, BEARING.cage)
    assert shaft.rate_hz == pytest.approx(30.0, rel=0.012)


def evidence(**z_and_depth: tuple[float, float]) -> dict[Part, PartEvidence]:
    """Evidence with the default limits; parts not named have none."""
    by_part = {}
    for part in PARTS:
        z, depth = z_and_depth.get(part, (0.0, 0.05))
        ball = part == "ball"
        by_part[part] = PartEvidence(
            z=z,
            depth=depth,
            steadiness=0.7,
            severity=z * depth,
            z_limit=5.0,
            steadiness_limit=0.0 if ball else 0.3,
            limit=2.2 if ball else 3.0,
            false_alarm_probability=false_alarm_probability(z),
            order=1.0,
        )
    return by_part


@pytest.mark.parametrize(
    ("found", "word", "group"),
    [
        ({}, "normal", ("normal",)),
        ({"inner": (20.0, 0.5)}, "inner", ("inner",)),
        ({"outer": (20.0, 0.5), "inner": (10.0, 0.33)}, "outer", ("outer",)),
        ({"outer": (20.0, 0.5), "inner": (20.0, 0.48)}, "outer", ("outer", "inner")),
        ({"outer": (7.0, 0.5), "inner": (7.0, 0.48)}, "inner_or_outer", ("inner", "outer")),
        ({"outer": (20.0, 0.5), "ball": (20.0, 0.8)}, "outer", ("outer", "ball")),
        ({"ball": (20.0, 0.5)}, "ball", ("ball",)),
        ({"outer": (30.0, 0.08)}, "normal", ("normal",)),
        ({"outer": (4.5, 1.0)}, "normal", ("normal",)),
        ({"outer": (10.0, 0.25)}, "normal", ("normal",)),
        ({"ball": (15.0, 0.18)}, "normal", ("normal",)),
    ],
)
def test_a_part_is_named_by_significance_and_size(
    found: dict[str, tuple[float, float]], word: str, group: tuple[str, ...]
) -> None:
    decision = decide(evidence(**found), RULES)
    assert decision.verdict == word
    assert decision.group == group
    assert sum(decision.probability.values()) == pytest.approx(1.0)
    assert decision.margin >= 1.0


def test_knocks_are_not_strikes() -> None:
    parts = evidence(outer=(15.0, 0.3))
    assert decide(parts, RULES).verdict == "outer"
    parts["outer"] = replace(parts["outer"], steadiness=0.22)
    assert decide(parts, RULES).verdict == "normal"


def test_what_is_not_testable_is_not_named() -> None:
    parts = evidence(ball=(30.0, 0.9))
    parts["ball"] = replace(parts["ball"], testable=False)
    assert decide(parts, RULES).verdict == "normal"


def baseline(**z_and_depth: tuple[float, float]) -> RaceBaseline:
    return RaceBaseline(evidence(**z_and_depth), BandLevels((400.0, 800.0), (1.0,)), 1800.0)


@pytest.mark.parametrize(
    ("now", "before", "change", "word"),
    [
        ({}, {}, (0.5, 1.0), "normal"),
        ({}, {}, (2.5, 2.5), "changed"),
        ({}, {}, (-2.5, -2.5), "changed"),
        ({}, {}, (0.5, 3.5), "changed"),
        # Half of the severity will do where the level changed and the lines have grown.
        ({"outer": (10.0, 0.25)}, {}, (3.0, 3.0), "outer"),
        ({"outer": (10.0, 0.25)}, {}, (0.0, 0.0), "normal"),
        ({"outer": (10.0, 0.25)}, {"outer": (9.0, 0.2)}, (3.0, 3.0), "changed"),
        # A line that the machine had in good order counts only if it has grown.
        ({"outer": (20.0, 0.5)}, {"outer": (20.0, 0.45)}, (0.0, 0.0), "normal"),
        ({"outer": (20.0, 0.5)}, {"outer": (10.0, 0.3)}, (0.0, 0.0), "outer"),
    ],
)
def test_a_baseline_finds_changes_and_forgives_old_lines(
    now: dict[str, tuple[float, float]],
    before: dict[str, tuple[float, float]],
    change: tuple[float, float],
    word: str,
) -> None:
    assert decide(evidence(**now), RULES, baseline(**before), change).verdict == word


def test_band_levels_are_mean_squares_and_compare_across_rates() -> None:
    t = np.arange(48_000) / 48_000.0
    fast = 3.0 * np.cos(2 * np.pi * 1000.0 * t) + 0.1 * np.random.default_rng(0).standard_normal(len(t))
    slow = fast[::4]
    high, low = (band_levels(scipy.fft.rfft(x), len(x), r) for x, r in ((fast, 48e3), (slow, 12e3)))
    assert high.power[1] == pytest.approx(4.5, rel=0.01)
    assert len(high.power) > len(low.power)
    assert low.change_db(high)[0] == pytest.approx(0.0, abs=0.1)


def test_another_unit_than_the_baselines_is_named() -> None:
    before = BandLevels((400.0, 800.0, 1600.0, 3200.0), (1.0, 2.0, 0.5))
    now = BandLevels(before.edges_hz, tuple(9.81**2 * p for p in before.power))
    with pytest.raises(UnfitError, match=r"unit differs .* \+19.8 dB"):
        now.change_db(before)
