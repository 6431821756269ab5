"""A speed that is wrong is refused, put right, or said not to be confirmed: no part is named by it.

A shaft that does not turn evenly is followed, and what it smears is not taken for a bearing.
"""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
import scipy.fft
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.geometry import bearing_orders
from daqsvc.bearing.race import race_test
from daqsvc.bearing.race.decision import refuse_rivals
from daqsvc.bearing.race.track import shaft_track
from daqsvc.bearing.race.verdict import PartEvidence
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.speed.harmonics import ShaftRate, shaft_rate, slow_series

SHAFT_HZ = 29.5
SECONDS = 4.0
BINS_HZ = 1.0 / SECONDS


def shaft_of(lines_hz: list[float], stated_hz: float, seed: int = 0) -> ShaftRate:
    """The shaft as found in lines of these frequencies and noise, with an envelope that is noise alone."""
    t = np.arange(int(SECONDS * 2000)) / 2000.0
    random = np.random.default_rng(seed)
    series = random.standard_normal(len(t)) + sum(np.cos(2 * np.pi * hz * t + hz) for hz in lines_hz)
    envelope = random.standard_exponential(len(t) // 2)
    slow = slow_series(scipy.fft.rfft(series), BINS_HZ, stated_hz)
    return shaft_rate(*slow, envelope, SECONDS, stated_hz, 0.012, BEARING.cage)


def harmonics(shaft_hz: float, orders: range = range(1, 7)) -> list[float]:
    return [order * shaft_hz for order in orders]


def test_the_true_speed_is_confirmed() -> None:
    shaft = shaft_of(harmonics(SHAFT_HZ), SHAFT_HZ)
    assert shaft.seen
    assert not shaft.doubt


@pytest.mark.parametrize("error", [-0.028, -0.018, -0.014, 0.014, 0.018, 0.028])
def test_a_speed_wrong_by_less_than_three_percent_is_put_right(error: float) -> None:
    shaft = shaft_of(harmonics(SHAFT_HZ), (1.0 + error) * SHAFT_HZ)
    assert shaft.rate_hz == pytest.approx(SHAFT_HZ, rel=1e-3)
    assert shaft.seen


def test_wrong_speeds_are_hardly_ever_confirmed() -> None:
    random = np.random.default_rng(5)
    confirmed, trials = 0, 60
    for seed in range(trials):
        factor = 1.0 + random.choice([-1.0, 1.0]) * random.uniform(0.04, 0.3)
        try:
            confirmed += shaft_of(harmonics(SHAFT_HZ), factor * SHAFT_HZ, seed).seen
        except UnfitError:
            continue
    assert confirmed <= 0.03 * trials


def test_noise_confirms_no_speed() -> None:
    assert sum(shaft_of([], SHAFT_HZ, seed).seen for seed in range(40)) <= 1


@pytest.mark.parametrize(("mains_hz", "stated_hz"), [(60.0, 29.95), (50.0, 24.9), (50.0, 49.95)])
def test_lines_of_the_mains_confirm_no_speed(mains_hz: float, stated_hz: float) -> None:
    shaft = shaft_of(harmonics(mains_hz, range(1, 5)), stated_hz)
    assert not shaft.seen
    assert "mains" in shaft.doubt or "only even" in shaft.doubt


def test_lines_of_the_mains_pull_no_speed_away() -> None:
    lines = harmonics(29.53) + harmonics(60.0, range(1, 4))
    assert shaft_of(lines, 29.95).rate_hz == pytest.approx(29.53, rel=1e-3)


@pytest.mark.parametrize(
    ("factor", "said"), [(0.5, "only even harmonics stand out"), (2.0, "half orders stand out")]
)
def test_half_and_double_the_speed_are_not_confirmed(factor: float, said: str) -> None:
    shaft = shaft_of(harmonics(SHAFT_HZ, range(1, 16)), factor * SHAFT_HZ)
    assert not shaft.seen
    assert said in shaft.doubt
    assert f"{60.0 * SHAFT_HZ:.0f} rpm" in shaft.doubt


@pytest.mark.parametrize("rate_hz", [10_000.0, 16_000.0, 9_000.0])
@pytest.mark.parametrize("part", ["inner", "outer", "ball"])
def test_a_wrong_sampling_rate_is_refused(part: str, rate_hz: float) -> None:
    samples = strikes(part, strength=1.5)
    assert race_test(samples, RATE_HZ, SPEED_RPM, BEARING).verdict == part
    with pytest.raises(UnfitError, match=r"shaft speed or sample rate is (wrong|in doubt)"):
        race_test(samples, rate_hz, SPEED_RPM, BEARING)


def beside(samples: np.ndarray, other_rpm: float) -> np.ndarray:
    """The same with the harmonics of a machine nearby, and none of its own that can be seen."""
    t = np.arange(len(samples)) / RATE_HZ
    own = sum(
        share * np.cos(2 * np.pi * k * SPEED_RPM / 60.0 * t + k)
        for k, share in ((1, 0.5), (2, 0.3), (3, 0.2))
    )
    hum = sum(0.6 * np.cos(2 * np.pi * k * other_rpm / 60.0 * t + k * k) for k in range(1, 9))
    return samples - own + hum


@pytest.mark.parametrize("share", [0.72, 1.338])
def test_a_machine_nearby_is_told_and_leaves_no_sure_normal(share: float) -> None:
    verdict = race_test(beside(strikes(None, 10.0), share * SPEED_RPM), RATE_HZ, SPEED_RPM, BEARING)
    assert (verdict.verdict, verdict.speed_seen) == ("normal", False)
    assert verdict.probability["normal"] <= 0.5
    told = next(note for note in verdict.notes if "not confirmed" in note)
    assert "those of a machine nearby, unless the speed or the sample rate is wrong" in told
    assert f"at about {share * SPEED_RPM:.0f} rpm than at {SPEED_RPM:g} rpm" in told


@pytest.mark.parametrize("part", ["inner", "outer", "ball"])
def test_a_machine_nearby_hides_no_damage(part: str) -> None:
    verdict = race_test(
        beside(strikes(part, 10.0, strength=2.5), 0.72 * SPEED_RPM), RATE_HZ, SPEED_RPM, BEARING
    )
    assert verdict.verdict == part


def beside_own(samples: np.ndarray, off: float) -> np.ndarray:
    """The same with a louder machine nearby that turns nearly as fast."""
    t = np.arange(len(samples)) / RATE_HZ
    return samples + sum(
        3.0 / k * np.cos(2 * np.pi * k * (1.0 + off) * SPEED_RPM / 60.0 * t + k * k) for k in range(1, 8)
    )


@pytest.mark.parametrize("off", [-0.029, -0.02, 0.029])
@pytest.mark.parametrize("part", ["inner", "outer", "ball", None])
def test_a_louder_machine_that_turns_nearly_as_fast_does_not_take_the_speed(
    part: str | None, off: float
) -> None:
    samples = beside_own(strikes(part, 10.0, strength=2.0), off)
    verdict = race_test(samples, RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.speed_rpm == pytest.approx(SPEED_RPM, rel=1e-3)
    assert verdict.speed_seen
    assert verdict.verdict == (part or "normal")
    (told,) = (note for note in verdict.notes if "louder shaft" in note)
    assert f"stand out at {(1.0 + off) * SPEED_RPM:.1f} rpm" in told
    if part is None:
        assert verdict.probability["normal"] <= 0.5, "this machine may be the louder one"


@pytest.mark.parametrize("off", [-0.029, 0.029])
@pytest.mark.parametrize("part", ["inner", "outer", "ball"])
def test_the_speed_of_a_machine_nearby_names_no_wrong_part(part: str, off: float) -> None:
    # This machine is the louder one, and its speed was stated as that of the other.
    samples = beside_own(strikes(part, 10.0, strength=2.0), off)
    t = np.arange(len(samples)) / RATE_HZ
    samples += sum(6.0 / k * np.cos(2 * np.pi * k * SPEED_RPM / 60.0 * t + k) for k in range(1, 8))
    with contextlib.suppress(UnfitError):  # it may be refused
        assert race_test(samples, RATE_HZ, (1.0 + off) * SPEED_RPM, BEARING).verdict in {part, "normal"}


def part_evidence(z: float, depth: float, order: float, limit: float) -> PartEvidence:
    return PartEvidence(z, depth, 1.0, z * depth, 5.0, 0.3, limit, 1e-4, order)


def test_a_part_is_not_named_where_its_lines_and_the_harmonics_agree_on_another_speed() -> None:
    # Lines of the inner race at 29.5 Hz; stated so that they lie where the ball's would.
    stated_hz = SHAFT_HZ * BEARING.inner / BEARING.ball_pass
    # Only two harmonics: too few to refuse the speed as such.
    shaft = shaft_of(harmonics(SHAFT_HZ, range(1, 3)), stated_hz, seed=3)
    assert not shaft.seen
    nothing = part_evidence(0.0, 0.05, 4.0, 3.0)
    ball = part_evidence(20.0, 0.8, BEARING.ball_pass, 7.7)
    evidence = {"inner": nothing, "outer": nothing, "ball": ball}
    with pytest.raises(UnfitError, match=r"lines of the ball at .* those of the inner race at 17\d\d rpm"):
        refuse_rivals(evidence, BEARING, shaft, 0.015)
    refuse_rivals(evidence | {"ball": nothing}, BEARING, shaft, 0.015)


def test_a_speed_that_harmonics_speak_against_leaves_no_sure_normal() -> None:
    t = np.arange(60_000) / RATE_HZ
    shaft_hz = SPEED_RPM / 60.0
    half = sum(np.cos(2 * np.pi * k * 0.5 * shaft_hz * t + k) for k in range(1, 16))
    verdict = race_test(
        np.random.default_rng(0).standard_normal(len(t)) + 0.3 * half, RATE_HZ, SPEED_RPM, BEARING
    )
    assert not verdict.speed_seen
    assert any("half orders" in note for note in verdict.notes)
    assert verdict.verdict == "normal"
    assert verdict.probability["normal"] <= 0.5


RECORD_S = 8.0
TIME_S = np.arange(int(RECORD_S * RATE_HZ)) / RATE_HZ


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
    steady = strikes("inner", RECORD_S)
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
