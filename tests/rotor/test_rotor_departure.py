"""How often does the departure test cry wolf, and how small a change does it see?"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import poisson

from daqsvc.rotor.synchronous.departure import DepartureTest, Spread, threshold_for

pytestmark = pytest.mark.statistical

SAMPLES = 64
SPREAD = Spread(np.ones(5), float(SAMPLES), 1.0 / (SAMPLES - 5), 0.0)
CALIBRATED = 50
CONFIDENCE = 0.99


def evidence(revolutions, seed, change=0.0, calibrated=CALIBRATED):
    """T and the energy's evidence for white synchronous vectors after a calibration on as white ones."""
    rng = np.random.default_rng(seed)
    count = calibrated + revolutions
    vectors = (rng.standard_normal((count, 5)) + 1j * rng.standard_normal((count, 5))) / math.sqrt(2.0)
    noise = SAMPLES * rng.gamma(SAMPLES - 5, 1.0 / (SAMPLES - 5), count)
    vectors[calibrated:, 1] += change
    vectors -= vectors[:calibrated].mean(axis=0)
    test = DepartureTest(SPREAD, threshold_nats=1e9, energy_threshold_nats=1e9, least_reference=calibrated)
    for _ in range(calibrated):
        test.add(np.zeros(5, dtype=np.complex128), float(noise[:calibrated].mean()), np.zeros(3))
    evidence = [test.add(vectors[i], float(noise[i]), np.zeros(3)) for i in range(calibrated, count)]
    return np.array([e.nats for e in evidence]), np.array([e.energy_nats for e in evidence])


def alarms(statistic, threshold):
    """Departures, each followed by the 128 revolutions of the longest window."""
    count, at = 0, 0
    while len(past := np.flatnonzero(statistic[at:] > threshold)):
        count += 1
        at += int(past[0]) + 128
    return count


def test_false_departures_come_no_oftener_than_is_asked_for():
    runs = [evidence(1000, seed) for seed in range(60)]
    for rate in (2.0, 0.5, 0.1):
        threshold = threshold_for(rate)
        seen = sum(alarms(nats, threshold) for nats, _ in runs)
        expected = rate * len(runs)
        assert seen <= poisson.ppf(CONFIDENCE, expected)
        # Nor is the threshold so high that the rate means nothing.
        assert poisson.cdf(seen, 0.25 * expected) > 1.0 - CONFIDENCE or expected < 10
    assert sum(alarms(energy, 12.0) for _, energy in runs) <= poisson.ppf(CONFIDENCE, 0.05 * len(runs))


@pytest.mark.parametrize("calibrated", [50, 400])
def test_the_smallest_visible_change_is_that_of_the_law(calibrated):
    """Evidence m n_c / (m + n_c) delta^2 passes the threshold: the calibration's length is the limit."""
    threshold = threshold_for(0.1)
    window = 128
    visible = math.sqrt(threshold * (1.0 / window + 1.0 / calibrated))
    seen = {}
    for part in (0.4, 1.4):
        runs = [evidence(140, seed, part * visible, calibrated)[0].max() > threshold for seed in range(40)]
        seen[part] = sum(runs)
    assert seen[0.4] <= 4
    assert seen[1.4] >= 36


def test_a_rate_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="false alarms per 1000 revolutions"):
        threshold_for(0.0)
