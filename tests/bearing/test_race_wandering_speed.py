"""A shaft that does not turn evenly is followed, and what it smears is not taken for a bearing."""

from __future__ import annotations

import numpy as np
import pytest
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.geometry import bearing_orders
from daqsvc.bearing.race import race_test
from daqsvc.bearing.race.track import shaft_track

SECONDS = 8.0
TIME_S = np.arange(int(SECONDS * RATE_HZ)) / RATE_HZ


def ramped(samples: np.ndarray, share: float) -> np.ndarray:
    """The same machine while its speed rises by a share."""
    u = np.arange(len(samples)) / len(samples)
    return np.interp(u + 0.5 * share * (u**2 - u), u, samples)


def hunting(seed: int, shaft_hz: float = 30.0) -> np.ndarray:
    """A machine in good order: noise that 1X, 2X and 4X modulate, at a speed that hunts by half a percent."""
    turned = 2 * np.pi * shaft_hz * (TIME_S + 0.005 / (2 * np.pi * 0.3) * np.sin(2 * np.pi * 0.3 * TIME_S))
    loudness = 1.0 + 0.6 * np.cos(4 * turned) + 0.4 * np.cos(turned) + 0.3 * np.cos(2 * turned)
    return np.random.default_rng(seed).standard_normal(len(TIME_S)) * loudness + np.sin(turned)


@pytest.mark.parametrize("designation", ["6203", "6205-2RS"])
@pytest.mark.parametrize("shaft_hz", [25.0, 60.0])
def test_a_speed_that_hunts_makes_no_fault(designation: str, shaft_hz: float) -> None:
    for seed in range(3):
        x = hunting(seed, shaft_hz)
        assert race_test(x, RATE_HZ, 60.0 * shaft_hz, bearing_orders(designation)).verdict == "normal"


def test_a_speed_that_hunts_is_followed_and_told() -> None:
    verdict = race_test(hunting(0), RATE_HZ, SPEED_RPM, BEARING)
    assert any("the speed wanders by" in note for note in verdict.notes)


@pytest.mark.parametrize("share", [0.01, -0.02])
def test_a_damaged_race_is_found_while_the_speed_rises_or_falls(share: float) -> None:
    steady = strikes("inner", SECONDS)
    verdict = race_test(ramped(steady, share), RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.verdict == "inner"
    steady_verdict = race_test(steady, RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.evidence["inner"].z > 0.7 * steady_verdict.evidence["inner"].z
    assert not any("wanders" in note for note in steady_verdict.notes)


def test_a_track_makes_a_ramp_even() -> None:
    n = 8000
    u = np.arange(n) / n
    turned = 2 * np.pi * 240.0 * (u + 0.01 * (u**2 - u))
    x = np.cos(turned) + 0.6 * np.cos(3 * turned) + 0.2 * np.random.default_rng(0).standard_normal(n)
    track = shaft_track(x, np.random.default_rng(1).standard_normal(n), 240.0)
    assert track is not None
    assert track.wander == pytest.approx(0.02, abs=0.004)
    even = np.abs(np.fft.rfft(track.even(x))) ** 2
    assert even[719:722].sum() > 0.8 * even[700:740].sum()


def test_noise_has_no_track() -> None:
    for seed in range(20):
        x, y = np.random.default_rng(seed).standard_normal((2, 6000))
        assert shaft_track(x, y, 150.0) is None
