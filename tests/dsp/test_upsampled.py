"""Records that were stored at a multiple of their rate are recognised by the grid that they keep to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import scipy.signal
from support.race_records import all_records, cwru
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.race import race_test
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.upsampled import Upsampling, upsampling

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


def held(samples: Floats, factor: int) -> Floats:
    return np.repeat(samples, factor)


def joined(samples: Floats, factor: int) -> Floats:
    """By straight lines; the last sample is held."""
    place = np.arange(factor * len(samples))
    return np.interp(place, place[::factor], samples)


def rounded(samples: Floats, step: float) -> Floats:
    return step * np.round(samples / step)


@pytest.mark.parametrize("factor", [2, 3, 4, 16])
@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("step", [0.0, 0.01], ids=["exact", "rounded"])
def test_the_grid_of_an_upsampled_record_is_found(factor: int, first: int, step: float) -> None:
    noise = np.random.default_rng(factor).standard_normal(20_000)
    for made, is_held in ((held(noise, factor), True), (joined(noise, factor), False)):
        stored = rounded(made, step) if step else made
        assert upsampling(stored[factor - first :]) == Upsampling(factor, first, is_held)


def test_an_upsampled_record_with_wrong_samples_is_recognised_all_the_same() -> None:
    samples = held(np.random.default_rng(0).standard_normal(20_000), 4)
    samples[1001::5000] += 1.0
    found = upsampling(samples)
    assert found is not None
    assert found.factor == 4


def test_what_was_sampled_at_its_rate_keeps_to_no_grid() -> None:
    noise = np.random.default_rng(1).standard_normal(50_000)
    angle = 0.01 * np.arange(len(noise))
    stepped = noise + np.where(np.arange(len(noise)) > 20_000, 1e4, 0.0)
    for samples in (
        noise,
        np.sin(angle),
        stepped,
        rounded(noise, 1.0),
        rounded(noise, 3.0),
        np.zeros(50_000),
        np.where(np.arange(50_000) % 100 == 0, 1.0, 0.0),
        strikes("inner", 3.0),
    ):
        assert upsampling(samples) is None
    assert upsampling(held(noise, 4)[:100]) is None, "too short to be told"


@pytest.mark.data
@pytest.mark.statistical
def test_no_measured_record_keeps_to_a_grid(data: Path) -> None:
    for record in all_records(data):
        assert upsampling(record.samples.astype(np.float64)) is None, record.name


@pytest.mark.parametrize(
    ("upsample", "how"),
    [(held, "each sample 4 times"), (joined, "4 samples on each straight line")],
    ids=["held", "joined"],
)
def test_an_upsampled_record_is_judged_by_what_was_measured(
    upsample: Callable[[Floats, int], Floats], how: str
) -> None:
    samples = strikes("outer", 10.0, strength=1.2)
    verdict = race_test(upsample(samples, 4), 4.0 * RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.verdict == "outer"
    assert not verdict.repairs
    assert (
        f"the channel was sampled at 12000 Hz and upsampled ({how}): only what was measured is used"
    ) in verdict.notes
    assert any("nothing above 6000 Hz" in note for note in verdict.notes)
    whole = race_test(samples, RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.evidence["outer"].z == pytest.approx(whole.evidence["outer"].z, rel=0.15)


def test_drop_outs_of_an_upsampled_record_are_bridged() -> None:
    samples = strikes("outer", 10.0, strength=1.2)
    samples[30_000:30_200] = samples[30_000]
    verdict = race_test(held(samples, 4), 4.0 * RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.verdict == "outer"
    assert any("stands still 1 time" in repair and "at 2.5 s" in repair for repair in verdict.repairs)


@pytest.mark.parametrize("upsample", [held, joined])
def test_a_record_that_was_sampled_too_slowly_is_refused_however_fast_it_is_stored(
    upsample: Callable[[Floats, int], Floats],
) -> None:
    slow = strikes("outer", 10.0)[::12]
    with pytest.raises(UnfitError) as refused:
        race_test(upsample(slow, 12), RATE_HZ, SPEED_RPM, BEARING)
    assert "was sampled at 1000 Hz and upsampled (" in str(refused.value)
    assert "which leaves the band 400 to 480 Hz" in str(refused.value)
    assert "sample with 2500 Hz or more" in str(refused.value)


@pytest.mark.parametrize("ratio", [2.3, 2.5, 3.7])
def test_a_record_that_was_held_at_no_whole_ratio_is_not_called_dead(ratio: float) -> None:
    samples = strikes("outer", 10.0)
    stored = samples[(np.arange(int(ratio * len(samples))) / ratio).astype(int)]
    with pytest.raises(UnfitError, match=r"was sampled at about 12 kHz and upsampled: \d+% .* an even pace"):
        race_test(stored, ratio * RATE_HZ, SPEED_RPM, BEARING)


@pytest.mark.parametrize("part", [None, "outer"])
def test_a_steep_low_pass_makes_no_steps_and_no_wrong_samples(part: str | None) -> None:
    rate_hz = 48_000.0
    low = scipy.signal.butter(8, 1000.0, fs=rate_hz, output="sos")
    samples = scipy.signal.sosfiltfilt(low, strikes(part, 5.0, rate_hz=rate_hz))
    assert not race_test(samples, rate_hz, SPEED_RPM, BEARING).repairs


@pytest.mark.data
@pytest.mark.statistical
@pytest.mark.parametrize("upsample", [held, joined])
@pytest.mark.parametrize("name", ["130", "3005"])
def test_a_measured_record_has_no_other_repairs_when_it_is_upsampled(
    data: Path, name: str, upsample: Callable[[Floats, int], Floats]
) -> None:
    (r,) = (r for r in cwru(data) if r.name == name)
    whole = race_test(r.samples, r.rate_hz, r.speed_rpm, r.bearing)
    verdict = race_test(upsample(r.samples, 4), 4.0 * r.rate_hz, r.speed_rpm, r.bearing)
    assert (verdict.verdict, verdict.repairs) == (whole.verdict, whole.repairs)


def test_a_coarse_converter_is_told_and_the_bearing_judged_where_its_strikes_are_clear() -> None:
    samples = strikes("outer", 10.0, strength=3.0)
    step = 1.6 * float(np.std(samples[:60]))
    coarse = rounded(samples, step)
    assert np.mean(np.diff(coarse) == 0.0) > 0.2
    verdict = race_test(coarse, RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.verdict == "outer"
    assert any(f"resolution is coarse: steps of {step:.3g}" in note for note in verdict.notes)


def test_a_converter_too_coarse_to_show_anything_is_not_called_dead() -> None:
    coarse = rounded(np.random.default_rng(2).standard_normal(60_000), 2.0)
    with pytest.raises(UnfitError, match=r"is too coarse: it moves in steps of 2, and \d+% .*; set a more"):
        race_test(coarse, RATE_HZ, SPEED_RPM, BEARING)


def test_a_coarse_channel_with_missing_samples_is_no_dead_one() -> None:
    coarse = rounded(np.random.default_rng(2).standard_normal(60_000), 2.0)
    coarse[500:520] = np.nan
    with pytest.raises(UnfitError, match=r"is too coarse: it moves in steps of 2"):
        race_test(coarse, RATE_HZ, SPEED_RPM, BEARING)


def test_a_channel_that_moves_once_is_dead() -> None:
    samples = np.zeros(60_000)
    samples[1000] = 5.0
    with pytest.raises(UnfitError, match=r"is dead: 100% of its samples repeat the one before"):
        race_test(samples, RATE_HZ, SPEED_RPM, BEARING)


def test_a_channel_that_mostly_rests_is_dead_if_its_converter_is_fine() -> None:
    samples = strikes("outer", 10.0)
    samples[40_000:] = samples[40_000]
    with pytest.raises(UnfitError, match=r"is dead: 67% of its samples repeat the one before"):
        race_test(samples, RATE_HZ, SPEED_RPM, BEARING)
