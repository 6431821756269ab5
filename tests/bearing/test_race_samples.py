"""What single wrong samples, steps, knocks and drop-outs leave of the race test's verdict."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.race import race_test
from daqsvc.bearing.race.decision import MOST_MARGIN, less_confident
from daqsvc.bearing.race.verdict import RaceRules
from daqsvc.dsp.envelope import levelled
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.accelerometers import checked
from daqsvc.dsp.quality.outliers import Prewhitening, blanked, despiked, find_transients, merged
from daqsvc.dsp.quality.stuck import dropouts

REVOLUTION = round(60.0 * RATE_HZ / SPEED_RPM)
BAND_HZ = (400.0, 0.48 * RATE_HZ)
PARTS = ("inner", "outer", "ball", None)


def judge(samples: np.ndarray) -> object:
    return race_test(samples, RATE_HZ, SPEED_RPM, BEARING)


def check(samples: np.ndarray) -> object:
    return checked(samples, RATE_HZ, SPEED_RPM, (RaceRules().low_hz, RaceRules().high_hz))


def ringing(height: float, seconds: float = 0.02, hz: float = 2200.0) -> np.ndarray:
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return height * np.exp(-t / 0.003) * np.sin(2.0 * np.pi * hz * t)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("seed", range(3))
def test_a_channel_without_defects_comes_back_as_it_is(part: str | None, seed: int) -> None:
    samples = strikes(part, strength=2.5, seed=seed)
    sound = check(samples)
    np.testing.assert_array_equal(sound.values, samples - samples.mean())
    assert sound.repairs == ()
    assert sound.stretches == ()


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize(("count", "factor"), [(1, 3.0), (1, 1000.0), (20, 6.0), (20, 1000.0)])
def test_outliers_are_counted_replaced_and_told(part: str | None, count: int, factor: float) -> None:
    clean = strikes(part, strength=1.5, seed=4)
    samples = clean.copy()
    places = np.sort(np.random.default_rng(count).choice(np.arange(200, 59_800), count, replace=False))
    samples[places] = factor * np.abs(clean).max() * np.resize([1.0, -1.0], count)
    sound = check(samples)
    assert sound.repairs[0].startswith(f"{count} sample{'s' * (count > 1)} that no housing can follow, at ")
    assert f"{places[0] / RATE_HZ:.4g}" in sound.repairs[0]
    v = judge(samples)
    assert v.verdict == (part or "normal")
    assert sound.repairs[0] in v.notes
    assert v.repairs == sound.repairs
    # What the neighbours predict is nearer to the truth than the channel's own deviation is.
    error = sound.values[places] - (clean[places] - samples.mean())
    assert np.sqrt(np.mean((error - error.mean()) ** 2)) < 1.2 * clean.std()


def test_the_first_and_the_last_sample_may_be_wrong() -> None:
    samples = strikes("outer", seed=5)
    samples[[0, -1]] = 400.0, -700.0
    assert judge(samples).verdict == "outer"


def test_signs_that_flip_are_put_right() -> None:
    # Below 4 kHz only, as behind an anti-aliasing filter: there a flipped sign is seen.
    samples = sosfiltfilt(
        butter(6, 4_000.0, fs=RATE_HZ, output="sos"), strikes("inner", strength=3.0, seed=6)
    )
    places = np.random.default_rng(6).choice(
        np.flatnonzero(np.abs(samples) > samples.std()), 12, replace=False
    )
    flipped = samples.copy()
    flipped[places] *= -1.0
    sound = check(flipped)
    assert "12 samples that no housing can follow" in sound.repairs[0]
    np.testing.assert_allclose(
        sound.values[places], samples[places] - flipped.mean(), atol=0.2 * samples.std()
    )


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("height", [3.0, 10.0, 50.0])
def test_a_step_is_taken_out(part: str | None, height: float) -> None:
    samples = strikes(part, strength=1.5, seed=7)
    step = height * samples.std()
    samples[23_456:] += step
    v = judge(samples)
    assert v.verdict == (part or "normal")
    assert any("the channel's mean moves in 1 step (+" in note and "at 1.955 s" in note for note in v.repairs)
    sound = check(samples)
    assert abs(sound.values[30_000:].mean() - sound.values[:20_000].mean()) < 0.05 * step


def test_a_drift_is_followed_and_told() -> None:
    samples = strikes("outer", seed=8)
    samples += np.linspace(0.0, 30.0, len(samples))
    v = judge(samples)
    assert v.verdict == "outer"
    assert [note for note in v.repairs if "mean moves from 0.0" in note and "to 29." in note] == list(
        v.repairs
    )


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("factor", [3.0, 50.0])
def test_a_knock_is_left_out(part: str | None, factor: float) -> None:
    samples = strikes(part, strength=1.5, seed=9)
    struck = ringing(factor * np.abs(samples).max())
    samples[31_000 : 31_000 + len(struck)] += struck
    v = judge(samples)
    assert v.verdict == (part or "normal")
    assert any(note.startswith("1 knock much louder than the machine, at 2.57") for note in v.repairs)


def test_strikes_of_every_revolution_are_no_knocks() -> None:
    signal = np.random.default_rng(0).standard_normal(60_000)
    signal[150::REVOLUTION] = 40.0
    assert find_transients(signal, RATE_HZ, REVOLUTION) == []
    signal[30_000:30_020] = 200.0
    ((first, last),) = find_transients(signal, RATE_HZ, REVOLUTION)
    assert 29_900 < first <= 30_000
    assert 30_020 <= last < 30_120


def test_too_many_knocks_are_refused() -> None:
    samples = strikes(None, seed=10)
    for place in range(1_200, 56_000, 11_000):
        samples[place : place + 2_400] += 60.0 * np.random.default_rng(place).standard_normal(2_400)
    with pytest.raises(UnfitError, match=r"channel is much louder for \d+% of its time, first at 0\.\d+ s"):
        judge(samples)


def packets(share: float, *, held: bool, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    samples = strikes("outer", seed=seed)
    while np.mean(np.diff(samples) == 0.0) < share:
        length = random.integers(5, 200)
        begin = random.integers(1, len(samples) - length)
        samples[begin : begin + length] = samples[begin - 1] if held else 0.0
    return samples


@pytest.mark.parametrize("held", [False, True])
def test_drop_outs_are_bridged_if_few_and_refused_if_many(*, held: bool) -> None:
    v = judge(packets(0.004, held=held, seed=11))
    assert v.verdict == "outer"
    assert "the channel stands still" in v.repairs[0]
    assert "% of its samples), first at" in v.repairs[0]
    for share in (0.02, 0.3):
        with pytest.raises(UnfitError, match=r"channel stands still .* check what drops its samples out"):
            judge(packets(share, held=held, seed=12))


@pytest.mark.parametrize("level", [0.0, -50.0, 50.0])
def test_drop_outs_to_a_value_beyond_all_others_are_no_clipping(level: float) -> None:
    samples = strikes("outer", seed=18)
    for begin in range(1_000, 59_000, 6_000):
        samples[begin : begin + 20] = level
    assert "the channel stands still 10 times" in judge(samples).repairs[0]
    clipped = np.clip(strikes("inner", seed=18), -2.5, 2.5)
    clipped[1_000:1_010] = 2.5
    assert not dropouts(clipped).any()


def test_a_coarse_converter_rests_by_itself() -> None:
    assert not dropouts(np.round(0.6 * strikes(None, seed=13))).any()
    fine = strikes(None, seed=13)
    assert not dropouts(fine).any()
    fine[500:506] = fine[499]
    assert np.flatnonzero(dropouts(fine)).tolist() == [499, 500, 501, 502, 503, 504, 505]


def test_normal_is_never_sure_of_samples_that_were_put_right() -> None:
    samples = strikes(None, seed=14)
    clean = judge(samples)
    assert clean.notes == ()
    assert clean.probability["normal"] > 0.999
    samples[20_000] = 300.0
    v = judge(samples)
    assert v.verdict == "normal"
    assert v.probability["normal"] < 0.95
    assert sum(v.probability.values()) == pytest.approx(1.0)
    assert v.margin <= MOST_MARGIN


def test_doubt_grows_with_what_is_against_the_samples_and_takes_nothing_from_a_part() -> None:
    sure = {"normal": 0.9, "inner": 0.1}
    assert less_confident(sure, 0, 0, 0.0) == sure
    shares = [
        less_confident(sure, notes, 0, lost)["normal"]
        for notes, lost in [(1, 0.0), (2, 0.0), (2, 0.1), (9, 1.0)]
    ]
    assert all(before > after for before, after in itertools.pairwise(shares))
    assert shares[-1] == pytest.approx(0.45)
    named = {"changed": 0.2, "outer": 0.8}
    assert less_confident(named, 3, 3, 0.3) == named


def test_a_shape_is_a_wrong_sample_only_if_nothing_else_is_there() -> None:
    noise = np.random.default_rng(15).standard_normal(60_000)
    whitening = Prewhitening(noise, RATE_HZ, *BAND_HZ)
    single, struck = noise.copy(), noise.copy()
    single[30_000] += 60.0
    struck[30_000 : 30_000 + 240] += ringing(60.0)
    repaired = despiked(single, whitening(single), whitening, REVOLUTION)
    assert repaired.spikes == (30_000,)
    assert repaired.steps == ()
    left = despiked(struck, whitening(struck), whitening, REVOLUTION)
    assert left.spikes == ()
    assert left.values is struck


def test_whitening_makes_noise_of_unit_deviation_whatever_single_events_do() -> None:
    noise = np.convolve(np.random.default_rng(16).standard_normal(60_000), [1.0, 1.6, 0.8], mode="same")
    noise[7_000:7_050] += 1e4
    whitened = Prewhitening(noise, RATE_HZ, *BAND_HZ)(noise)[20_000:]
    assert whitened.std() == pytest.approx(1.0, abs=0.1)
    density = np.abs(np.fft.rfft(whitened[: 2**15]).reshape(-1)[2**11 : 15_000]) ** 2
    thirds = [part.mean() for part in np.array_split(density, 3)]
    assert max(thirds) < 1.3 * min(thirds)


def test_blanking_fades_and_levelling_leaves_no_line() -> None:
    samples = np.random.default_rng(17).standard_normal(3_000) + 5.0
    samples[1_000:1_200] += 100.0
    faded = blanked(samples, [(950, 1_250)], RATE_HZ)
    assert np.abs(faded[990:1_210] - 5.0).max() < 1.0
    np.testing.assert_array_equal(faded[:950], samples[:950])
    np.testing.assert_array_equal(faded[1_250:], samples[1_250:])
    envelope = np.ones(100, dtype=np.float32)
    envelope[40:60] = 0.0
    np.testing.assert_array_equal(levelled(envelope, np.array([[0.4, 0.6]])), 1.0)
    assert levelled(envelope, np.empty((0, 2))) is envelope
    assert merged([(5, 9), (1, 3), (2, 4)]) == [(1, 4), (5, 9)]


def test_missing_samples_are_noted_and_nothing_is_put_right() -> None:
    samples = strikes("inner", seed=19)
    samples[[100, 5_000]] = np.nan
    samples[40_000:40_030] = np.nan
    sound = check(samples)
    assert sound.notes == ("32 samples are missing: bridged; check the bus and the device",)
    assert sound.repairs == ()
    ((first, last),) = sound.stretches
    assert first < 40_000
    assert last > 40_030
    assert judge(samples).verdict == "inner"
