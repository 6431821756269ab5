"""Where a record ends in frequency: filtered and upsampled ones have an edge, structures alone make none."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import scipy.signal
from support.race_records import all_records
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.race import race_test
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.occupied import occupied_top_hz

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


def low_passed(samples: Floats, share: float, order: int = 8) -> Floats:
    """Up to a share of half the rate."""
    return np.asarray(scipy.signal.sosfilt(scipy.signal.butter(order, share, output="sos"), samples))


def upsampled(samples: Floats, factor: int) -> Floats:
    return np.asarray(scipy.signal.resample_poly(samples, factor, 1))


@pytest.mark.parametrize(
    ("made", "top_share"),
    [
        (lambda x: low_passed(x, 0.3), 0.38),
        (lambda x: low_passed(x, 0.6), 0.67),
        (lambda x: low_passed(x, 0.3, 4), 0.73),
        (lambda x: upsampled(x, 2), 0.52),
        (lambda x: upsampled(x, 4), 0.26),
        (lambda x: np.round(3000.0 * scipy.signal.resample(x, 3 * len(x))) / 3000.0, 0.33),
    ],
    ids=["low-pass .3", "low-pass .6", "low-pass of 4th order", "times 2", "times 4", "times 3, 16 bit"],
)
def test_the_edge_is_found(made: Callable[[Floats], Floats], top_share: float) -> None:
    top_hz = occupied_top_hz(made(np.random.default_rng(0).standard_normal(60_000)), 2.0)
    assert top_hz == pytest.approx(top_share, abs=0.05)


def test_a_structure_has_no_edge() -> None:
    # Two resonances, and what lies above them 40 dB below.
    noise = np.random.default_rng(1).standard_normal(60_000)
    for share in (0.15, 0.4):
        pole = 0.98 * np.exp(1j * np.pi * share)
        noise = scipy.signal.lfilter([1.0], np.real(np.poly([pole, pole.conj()])), noise)
    assert occupied_top_hz(noise, 2.0) is None


def test_noise_has_no_edge_and_short_records_none_that_could_be_told() -> None:
    assert all(
        occupied_top_hz(np.random.default_rng(seed).standard_normal(20_000), 2.0) is None
        for seed in range(20)
    )
    assert occupied_top_hz(upsampled(np.ones(1000), 4), 2.0) is None


@pytest.mark.data
@pytest.mark.statistical
def test_no_measured_record_has_one_until_it_is_made(data: Path) -> None:
    for record in all_records(data):
        samples = record.samples - record.samples.mean()
        assert occupied_top_hz(samples, record.rate_hz) is None, record.name
        for made, most in ((low_passed(samples, 0.3), 0.6), (upsampled(samples, 4), 0.27)):
            top_hz = occupied_top_hz(made, 2.0)
            assert top_hz is not None, record.name
            assert top_hz < most, record.name


def test_a_bearing_is_judged_by_what_is_there_and_that_is_told() -> None:
    samples = strikes("outer", 10.0, strength=1.2)
    verdict = race_test(upsampled(samples, 4), 4.0 * RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.verdict == "outer"
    assert not verdict.repairs, "its ends are no steps of the mean"
    (told,) = (note for note in verdict.notes if note.startswith("nothing above"))
    assert "at a sample rate of 48000 Hz: low-passed, or sampled at about 12 kHz" in told
    whole = race_test(samples, RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.evidence["outer"].z == pytest.approx(whole.evidence["outer"].z, rel=0.15)
    assert not any(note.startswith("nothing above") for note in whole.notes)


def test_too_little_of_a_band_is_refused() -> None:
    samples = low_passed(strikes("outer", 10.0), 700.0 / (RATE_HZ / 2.0), 12)
    with pytest.raises(UnfitError, match=r"nothing above \d+ Hz .* band 400 to .*; record up to 1200 Hz"):
        race_test(samples, RATE_HZ, SPEED_RPM, BEARING)
