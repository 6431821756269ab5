"""Detection and isolation on two sensors: what they refuse, and what they make of plain cases."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from daqsvc.bearing import likelihood
from daqsvc.bearing.isolation import IsolationRule, isolation_spectrum
from daqsvc.bearing.likelihood import WhittleDetector, detection_spectrum
from daqsvc.bearing.residual import TwoSensorResidual
from daqsvc.bearing.two_sensors import HealthyPair, TwoSensorMonitor, learn_pair
from sim_hw.reproduce.bearing.design import S1, S3

if TYPE_CHECKING:
    from collections.abc import Iterator

RATE_HZ = 48_000.0


def detection(residual: np.ndarray, **more: float) -> WhittleDetector:
    return WhittleDetector(S3, RATE_HZ, detection_spectrum(residual, RATE_HZ), **more)


def isolation_rule(residual: np.ndarray, **more: float) -> IsolationRule:
    return IsolationRule(S3, RATE_HZ, isolation_spectrum(residual, RATE_HZ), **more)


def noise(seconds: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((round(seconds * RATE_HZ), 2))


def separated(y: np.ndarray) -> np.ndarray:
    return TwoSensorResidual(S3, RATE_HZ).process(y)


def hits(races: tuple[int, ...], size: float, count: int = 40) -> np.ndarray:
    """Half a second of residual with dips of the races in turn on the healthy machine's."""
    residual = separated(noise(0.6, 9))[-round(0.5 * RATE_HZ) :]
    dip = np.diff(np.hanning(20), n=1, prepend=0.0)
    D = (S3.k_s / S3.m_r, S3.k_c / S3.m_h)
    for i in range(count):
        race = races[i % len(races)]
        begin = 200 + 590 * i
        residual[begin : begin + len(dip), race] += size * D[race] * dip
    return residual


@pytest.fixture(scope="module", autouse=True)
def _quick_limits() -> Iterator[None]:
    """Limits from a fifth of the simulated frames: right within a few percent, which these cases clear."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(likelihood, "DRAWN_FRAMES", 40_000)
        yield


@pytest.fixture(scope="module")
def healthy() -> np.ndarray:
    return separated(noise(3.0))


@pytest.fixture(scope="module")
def detector(healthy) -> WhittleDetector:
    return detection(healthy)


@pytest.fixture(scope="module")
def rule(healthy) -> IsolationRule:
    return isolation_rule(healthy)


@pytest.fixture(scope="module")
def pair() -> HealthyPair:
    return learn_pair(S3, RATE_HZ, noise(3.0))


@pytest.mark.parametrize(("races", "verdict"), [((0,), "inner"), ((1,), "outer"), ((0, 1), "ball")])
def test_hits_name_their_race(detector, rule, races, verdict):
    window = hits(races, 1e-6)
    assert detector.judge(window).detected
    isolation = rule.judge(window)
    assert isolation.verdict == verdict
    assert isolation.group[0] == verdict
    assert isolation.hits >= 30


def test_noise_leaves_the_race_open(rule):
    isolation = rule.judge(separated(noise(0.5, 1)))
    assert isolation.verdict == "inner_or_outer"
    assert set(isolation.group) == {"inner", "outer", "ball"}


def test_a_window_of_missing_samples_only_is_open(rule):
    assert rule.judge(np.full((1000, 2), np.nan)).hits == 0


def test_missing_samples_do_not_alarm(detector):
    window = separated(noise(1.0, 2))
    window[20_000:20_400] = np.nan
    assert not detector.judge(window).detected


def test_a_rarer_false_alarm_has_a_higher_limit(healthy):
    window = separated(noise(0.6, 3))
    limits = [detection(healthy, false_alarm_rate=rate).judge(window).limit for rate in (0.1, 0.01, 0.001)]
    assert limits == sorted(limits)
    assert limits[0] < limits[-1]


def test_a_rate_too_low_for_the_bearing_leaves_every_fault_open():
    """The rolling elements of S1 answer at 12.9 kHz: at 6 kHz no line tells its races apart."""
    y = np.random.default_rng(0).standard_normal((30_000, 2))
    residual = TwoSensorResidual(S1, 6_000.0).process(y)
    rule = IsolationRule(S1, 6_000.0, isolation_spectrum(residual, 6_000.0))
    assert not len(rule.lines_hz)
    assert rule.judge(100.0 * residual).verdict == "inner_or_outer"


@pytest.mark.parametrize("louder", [(2.0, 2.0), (3.0, 1.0), (1.0, 3.0)])
def test_steady_noise_is_a_change_and_no_race(pair, louder):
    monitor = TwoSensorMonitor(pair)
    finding = monitor.evaluate(noise(0.5, 7) * louder)
    assert (finding.verdict, finding.group) == ("changed", ("changed",))
    assert finding.detection.detected
    assert 0.7 < finding.bursts < 1.3
    assert finding.isolation is None


def test_a_level_that_differs_from_run_to_run_is_no_fault(pair):
    louder = 10.0 ** (1.5 / 20.0) * noise(2.5, 8)
    assert TwoSensorMonitor(pair, false_alarm_rate=1e-4).evaluate(louder).detection.detected
    allowing = TwoSensorMonitor(pair, false_alarm_rate=1e-4, repeatability_db=0.8)
    assert not allowing.evaluate(louder).detection.detected


def test_a_spectrum_of_another_rate_is_refused(pair):
    with pytest.raises(ValueError, match=r"\d+ lines; there are \d+ at 24000 samples"):
        WhittleDetector(S3, 24_000.0, pair.detection)
    with pytest.raises(ValueError, match=r"lines; there are \d+ at 24000 samples"):
        IsolationRule(S3, 24_000.0, pair.isolation)


def test_short_records_and_dead_sensors_are_named():
    with pytest.raises(ValueError, match=r"0\.02 s of healthy residual"):
        detection(noise(0.02))
    with pytest.raises(ValueError, match=r"0\.50 s of healthy residual"):
        isolation_rule(noise(0.5))
    dead = noise(2.0)
    dead[:, 1] = 0.0
    with pytest.raises(ValueError, match="both accelerometers are alive"):
        detection(dead)
    with pytest.raises(ValueError, match=r"false-alarm rate of 0\.9"):
        detection(noise(2.0), false_alarm_rate=0.9)
    with pytest.raises(ValueError, match=r"mismatch of 0\.7"):
        isolation_rule(noise(2.0), mismatch=0.7)
    with pytest.raises(ValueError, match="use longer windows"):
        detection(noise(2.0)).judge(noise(0.004))


def test_the_monitor_is_calm_on_the_machine_that_it_has_learnt(pair):
    monitor = TwoSensorMonitor(pair)
    y = noise(2.0, 5)
    findings = [monitor.evaluate(part) for part in np.split(y, 4)]
    assert [finding.verdict for finding in findings] == ["normal"] * 4
    assert all(finding.isolation is None and finding.units is None for finding in findings)
