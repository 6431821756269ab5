"""Levels of windows that lack samples, against those of the same windows when they are whole.

``DAQSVC_SEEDS=300 pytest -s`` takes as many windows as docs/alarms.md states, and prints its figures.
"""

# ruff: noqa: T201 - the figures are part of what it is for

from __future__ import annotations

import numpy as np
import pytest
from support.gapped_signals import FRAMES, RATE_HZ, SHARES, SIGNALS, lost
from support.rotor_runs import seeds

from daqsvc.detectors.levels.detector import LevelChannel, LevelDetector
from daqsvc.diagnosis.detector import Window
from daqsvc.dsp.quality.missing import MOST_MISSING

pytestmark = pytest.mark.statistical
WINDOW = 1000
WINDOWS = seeds(60)
MEASURES = ("rms", "peak", "crest_factor", "velocity_rms")


def judged(samples):
    """The statements about windows one by one, as if each were the first."""
    channel = LevelChannel("a", 0, "m/s2")
    detector = LevelDetector("m", "s", RATE_HZ, [channel], window_s=WINDOW / RATE_HZ)
    return detector.process(Window(0, samples.astype(np.float32).reshape(-1, 1), 10**9, 1e9 / RATE_HZ))


@pytest.fixture(scope="module", params=SIGNALS)
def pairs(request):
    """For each share and frame, statements about whole windows and about what was left of them."""
    found = {}
    for share in SHARES:
        for frame in FRAMES:
            rng = np.random.default_rng(hash_of(request.param, share, frame))
            whole = np.concatenate([SIGNALS[request.param](rng, WINDOW) for _ in range(WINDOWS)])
            gapped = np.concatenate([lost(rng, part, share, frame) for part in np.split(whole, WINDOWS)])
            found[share, frame] = list(zip(judged(whole), judged(gapped), strict=True))
    return request.param, found


def hash_of(name, share, frame):
    return [len(name), round(100 * share), frame]


def ratios(both, measure, *, squared=False):
    """Of what is left to what was whole, of the windows in which the measure is given."""
    given = [
        gapped.statistics[measure] / whole.statistics[measure]
        for whole, gapped in both
        if measure in gapped.statistics
    ]
    return np.array(given) ** (2 if squared else 1)


def test_rms_and_velocity_have_no_bias(pairs):
    """The mean of the power is that of whole windows, within three standard errors of the mean and 1 %.

    Where chance makes the velocity of single windows worthless they are withheld, and there are less of them:
    those withheld are the low ones, so the mean is taken where nearly none is.
    """
    name, found = pairs
    for (share, frame), both in found.items():
        for measure in ("rms", "velocity_rms"):
            judgeable = [pair for pair in both if pair[1].statistics]
            off = 100.0 * (ratios(judgeable, measure) - 1.0)
            if len(off):
                deviation = f"{measure} {off.mean():.1f} ± {off.std():.1f} %"
                print(f"{name}, {share:.0%} lost, frames of {frame}: {deviation}")
            power = ratios(judgeable, measure, squared=True)
            if len(power) < 0.95 * len(judgeable):
                assert measure == "velocity_rms", (share, frame)
                continue
            error = 3.0 * power.std() / np.sqrt(len(power)) + 0.01
            assert abs(power.mean() - 1.0) < error, (name, measure, share, frame, power.mean(), error)


def test_what_is_called_good_is_within_the_stated_error(pairs):
    """RMS within 3 %, velocity 20 %, peak 25 % low at most, in 99 of 100 windows that are called good."""
    name, found = pairs
    off = {"rms": 0.03, "peak": 0.25, "velocity_rms": 0.2}
    good = [(w, g) for both in found.values() for w, g in both if g.quality == "good" and g.missing_share]
    for measure, most in off.items():
        worst = np.quantile(abs(ratios(good, measure) - 1.0), 0.99) if good else 0.0
        assert worst < most, (name, measure, worst)
    if name != "loud above":
        assert len(good) > 50


def test_bounds_hold(pairs):
    """Those of RMS and peak always; those of the velocity in 98 of 100 windows at least."""
    name, found = pairs
    for (share, frame), both in found.items():
        inside = []
        for whole, gapped in both:
            for measure, (low, high) in gapped.bounds.items():
                value = whole.statistics[measure]
                if measure in {"rms", "peak", "crest_factor"}:
                    assert low <= value * (1.0 + 1e-6), (name, measure, share, frame)
                elif measure == "velocity_rms":
                    inside.append(low <= value <= high)
        assert sum(inside) >= 0.98 * len(inside) - 1, (name, share, frame, np.mean(inside))


def test_beyond_a_few_per_cent_every_level_is_uncertain_and_says_so(pairs):
    _, found = pairs
    for both in found.values():
        for _, gapped in both:
            missing = gapped.missing_share
            if missing <= MOST_MISSING:
                assert set(gapped.bounds) <= {"velocity_rms"}
            elif missing <= 0.5:
                assert set(gapped.bounds) == {"mean", "peak_to_peak", *MEASURES}
            else:
                assert not gapped.statistics
            assert (gapped.quality == "good") == (missing <= MOST_MISSING and not gapped.bounds)
            assert bool(gapped.reason) == (gapped.quality != "good")


def test_a_loud_bearing_makes_no_velocity(pairs):
    """One sample in fifty lost, filled in, makes a velocity that is a fifth too high."""
    name, found = pairs
    if name != "loud above":
        return
    for both in found.values():
        for whole, gapped in both:
            if gapped.quality == "good":
                assert gapped.statistics["velocity_rms"] < 1.2 * whole.statistics["velocity_rms"]
