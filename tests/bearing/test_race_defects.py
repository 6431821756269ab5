"""Measured recordings with defects of their samples: damage stays named, or the record is refused.

Each defect is put into recordings that the race test judges right as they are. A sure "normal" of a damaged
machine, or another part, would be the worst answer; a word against a machine in good order the next.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support import race_records

from daqsvc.bearing.race import race_test
from daqsvc.dsp.quality import UnfitError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from support.race_records import Record

pytestmark = [pytest.mark.statistical, pytest.mark.data, pytest.mark.timeout(300)]

DAMAGED = ("105", "130", "169", "185", "209", "222", "234", "3005")
GOOD_ADI = 4
"""Every so many-th of the good bearings on that rig, whose rubs come nearest to knocks."""
SURE = 0.9
"""A record that was put right and shows nothing is called normal with less belief than this."""


@cache
def records(data: Path) -> tuple[Record, ...]:
    drive_end = [r for r in race_records.cwru(data) if r.name in DAMAGED or r.truth == "normal"]
    mfpt = [r for r in race_records.mfpt(data) if r.name in {"baseline_1", "InnerRaceFault_vload_1"}]
    good = [r for r in race_records.adi(data, "Y") if r.truth == "normal"][::GOOD_ADI]
    far = [r for r in race_records.cwru(data, "FE") if r.name in DAMAGED[::3]]
    return (*drive_end, *mfpt, *good, *far)


def outliers(count: int, peaks: float) -> Callable[..., None]:
    def spoil(x: np.ndarray, rate_hz: float, random: np.random.Generator) -> None:
        height = peaks * np.abs(x - x.mean()).max()
        places = random.choice(len(x), count, replace=False)
        x[places] = x.mean() + height * random.choice([-1.0, 1.0], count)

    return spoil


def knock(peaks: float) -> Callable[..., None]:
    def spoil(x: np.ndarray, rate_hz: float, random: np.random.Generator) -> None:
        decay_s = random.uniform(0.001, 0.01)
        t = np.arange(int(8.0 * decay_s * rate_hz)) / rate_hz
        rings = np.exp(-t / decay_s) * np.sin(2.0 * np.pi * random.uniform(500.0, 0.3 * rate_hz) * t)
        place = random.integers(len(x) - len(t))
        x[place : place + len(t)] += peaks * np.abs(x - x.mean()).max() * rings / np.abs(rings).max()

    return spoil


def bump(peaks: float) -> Callable[..., None]:
    """Half a sine of 4 ms: somebody steps on the cable."""

    def spoil(x: np.ndarray, rate_hz: float, random: np.random.Generator) -> None:
        n = int(0.004 * rate_hz)
        place = random.integers(len(x) - n)
        x[place : place + n] += peaks * np.abs(x - x.mean()).max() * np.sin(np.pi * np.arange(n) / n)

    return spoil


def step(deviations: float, decay_s: float = np.inf) -> Callable[..., None]:
    def spoil(x: np.ndarray, rate_hz: float, random: np.random.Generator) -> None:
        place = random.integers(len(x) // 10, 9 * len(x) // 10)
        after_s = np.arange(len(x) - place) / rate_hz
        x[place:] += deviations * x.std() * np.exp(-after_s / decay_s)

    return spoil


def drift(deviations: float) -> Callable[..., None]:
    def spoil(x: np.ndarray, rate_hz: float, random: np.random.Generator) -> None:
        x += deviations * x.std() * np.linspace(0.0, 1.0, len(x))

    return spoil


def packets(share: float, *, held: bool) -> Callable[..., None]:
    def spoil(x: np.ndarray, rate_hz: float, random: np.random.Generator) -> None:
        lost = 0
        while lost < share * len(x):
            length = random.integers(5, 501)
            place = random.integers(1, len(x) - length)
            x[place : place + length] = x[place - 1] if held else 0.0
            lost += length

    return spoil


def flipped_bits(share: float) -> Callable[..., None]:
    """One of 16 bits of a converter whose range is four times the record's peak."""

    def spoil(x: np.ndarray, rate_hz: float, random: np.random.Generator) -> None:
        mean, lsb = x.mean(), 4.0 * np.abs(x - x.mean()).max() / 2**16
        words = np.round((x - mean) / lsb).astype(np.int16).view(np.uint16)
        places = random.choice(len(x), int(share * len(x)), replace=False)
        words[places] ^= (1 << random.integers(0, 16, len(places))).astype(np.uint16)
        x[:] = words.view(np.int16) * lsb + mean

    return spoil


def judged(record: Record, spoil: Callable[..., None], seed: int) -> tuple[str, float]:
    """The verdict and the belief in normal; ``"refused"``."""
    samples = record.samples.astype(np.float64)
    spoil(samples, record.rate_hz, np.random.default_rng([seed, len(samples)]))
    try:
        v = race_test(samples, record.rate_hz, record.speed_rpm, record.bearing)
    except UnfitError:
        return "refused", 0.0
    return v.verdict, v.probability.get("normal", 0.0)


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(outliers(1, 0.7), id="an outlier of 0.7 peaks"),
        pytest.param(outliers(1, 3.0), id="an outlier of 3 peaks"),
        pytest.param(outliers(20, 1.0), id="20 outliers of 1 peak"),
        pytest.param(outliers(20, 1000.0), id="20 outliers of 1000 peaks"),
        pytest.param(knock(1.0), id="a knock of 1 peak"),
        pytest.param(knock(5.0), id="a knock of 5 peaks"),
        pytest.param(knock(50.0), id="a knock of 50 peaks"),
        pytest.param(bump(10.0), id="a bump of 10 peaks"),
        pytest.param(step(0.5), id="a step of 0.5 deviations"),
        pytest.param(step(5.0), id="a step of 5 deviations"),
        pytest.param(step(50.0), id="a step of 50 deviations"),
        pytest.param(step(10.0, decay_s=0.2), id="a step that decays"),
        pytest.param(drift(30.0), id="a drift"),
        pytest.param(packets(0.005, held=False), id="0.5 % of zeros"),
        pytest.param(packets(0.005, held=True), id="0.5 % held"),
        pytest.param(flipped_bits(1e-3), id="0.1 % of bit errors"),
    ],
)
def test_damage_stays_named_and_good_order_good(data: Path, spoil: Callable[..., None]) -> None:
    answers = [(r, *judged(r, spoil, seed=1)) for r in records(data)]
    table = [(r.name, r.truth, verdict, round(normal, 3)) for r, verdict, normal in answers]
    assert not [s for s in table if s[2] not in {s[1], "normal", "refused"}]
    missed = [s for s in table if s[1] != "normal" and s[2] == "normal"]
    assert not [s for s in missed if s[3] >= SURE]
    assert len(missed) <= 1, missed
    assert sum(s[2] == "refused" for s in table) <= 2, table


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("share", [0.02, 0.3])
def test_many_drop_outs_are_refused(data: Path, share: float, *, held: bool) -> None:
    for r in records(data):
        assert judged(r, packets(share, held=held), seed=2)[0] == "refused", r.name


def test_dense_bit_errors_give_no_sure_answer(data: Path) -> None:
    for r in records(data):
        verdict, normal = judged(r, flipped_bits(1e-2), seed=3)
        assert verdict in {r.truth, "refused"} or (verdict == "normal" and normal < SURE), r.name
