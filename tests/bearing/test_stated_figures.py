"""Figures in remedies for records of a bearing: who follows them is not refused again."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.impact import healthy_spectrum
from daqsvc.bearing.race import RaceRules, judge, race_test
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.accelerometers import checked

if TYPE_CHECKING:
    from numpy.typing import NDArray

FRAME = 1024


def stated(error: pytest.ExceptionInfo[Exception], pattern: str) -> float:
    """The figure in a message."""
    match = re.search(pattern, f"{error.value}")
    assert match is not None, error.value
    return float(match[1])


def noise(samples: int) -> NDArray[np.float64]:
    return np.random.default_rng(1).normal(size=samples)


def test_a_record_at_the_rate_that_is_stated_is_accepted() -> None:
    band_hz = 400.05, 20_000.0
    with pytest.raises(UnfitError, match="sample rate") as caught:
        checked(noise(20_000), 1000.0, SPEED_RPM, band_hz)
    rate_hz = stated(caught, r"sample with ([0-9.]+) Hz or more")
    assert len(checked(noise(20_000), rate_hz, SPEED_RPM, band_hz).values) == 20_000


def test_a_record_up_to_the_frequency_that_is_stated_is_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    rules = replace(RaceRules(), low_hz=400.05)
    samples = strikes("outer", 5.0)
    monkeypatch.setattr(judge, "_occupied", lambda *_: 700.0)
    with pytest.raises(UnfitError, match="nothing above") as caught:
        race_test(samples, RATE_HZ, SPEED_RPM, BEARING, rules)
    top_hz = stated(caught, r"record up to ([0-9.]+) Hz or more")
    monkeypatch.setattr(judge, "_occupied", lambda *_: top_hz)
    assert race_test(samples, RATE_HZ, SPEED_RPM, BEARING, rules).verdict


@pytest.mark.parametrize("rate_hz", [24_000.0, 24_010.0, 51_200.0])
def test_a_healthy_residual_as_long_as_is_stated_is_accepted(rate_hz: float) -> None:
    kept = np.ones(FRAME // 2 + 1, dtype=np.bool_)

    def learn(seconds: float) -> int:
        residual = noise(2 * round(seconds * rate_hz)).reshape(-1, 2)
        return healthy_spectrum(residual, rate_hz, FRAME, kept, 24, "detection").frames

    with pytest.raises(ValueError, match="healthy residual") as caught:
        learn(0.1)
    assert learn(stated(caught, r"([0-9.]+) s or more without gaps")) >= 24
