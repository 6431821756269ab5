"""Live and recorded data are judged by the same functions, with the same limits, in the same words."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bearing_signals import RATE_HZ, SPEED_RPM, healthy

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.bearing.geometry import bearing_orders
from daqsvc.detectors.bearing.detector import BearingDetector
from daqsvc.detectors.bearing.housed import HousedBearing
from daqsvc.detectors.bearing.recorded import analyse_bearings
from daqsvc.detectors.bearing.verdict import BearingSetup
from daqsvc.detectors.levels.detector import LevelChannel, LevelDetector
from daqsvc.diagnosis.detector import Window
from daqsvc.dsp.probes import Probe
from daqsvc.dsp.quality.clipped import clipped_at, ends_cut_off, refuse_clipped
from daqsvc.dsp.quality.missing import ACCELEROMETER_SHARE, lacking
from daqsvc.dsp.quality.probes import RevolutionJudge
from daqsvc.dsp.quality.rate import SAME_RATE, ArrivalRate, rate_of_stamps
from daqsvc.dsp.quality.unit import LENGTH_UNITS, to_um
from daqsvc.recording.recording import Recording

if TYPE_CHECKING:
    from collections.abc import Callable

SENSOR = "accel-de"
LOOK_S = 2.5


def spoilt(spoil: Callable[[np.ndarray], object]) -> np.ndarray:
    # As a ring holds them.
    samples = healthy(LOOK_S, 7).astype(np.float32).astype(np.float64)
    spoil(samples)
    return samples


def live(samples: np.ndarray) -> str:
    bearing = HousedBearing("drive-end", SENSOR, 0, bearing_orders("6205-2RS"))
    watch = BearingDetector(
        machine="motor", stream="housing", rate_hz=RATE_HZ, speed_rpm=SPEED_RPM, bearings=[bearing]
    )
    window = Window(0, samples.astype(np.float32)[:, np.newaxis], NS_PER_S, NS_PER_S / RATE_HZ)
    (said,) = watch.process(window)
    assert said.quality != "good"
    return said.reason


def recorded(samples: np.ndarray) -> str:
    recording = Recording((SENSOR,), samples[:, np.newaxis], RATE_HZ, Path("x.csv"), 0)
    setup = BearingSetup(
        channels=(SENSOR,), speed_rpm=SPEED_RPM, bearings={SENSOR: bearing_orders("6205-2RS")}
    )
    return f"{SENSOR}: {analyse_bearings(recording, setup).unfit.get(SENSOR, '')}"


def clip(samples: np.ndarray) -> None:
    limit = 1.2 * samples.std()
    np.clip(samples, -limit, limit, out=samples)


def die(samples: np.ndarray) -> None:
    samples[len(samples) // 3 :] = samples[0]


@pytest.mark.parametrize(("spoil", "word"), [(clip, "is clipped"), (die, "is dead")])
def test_an_accelerometer_is_refused_in_the_same_words_live_and_recorded(
    spoil: Callable[[np.ndarray], object], word: str
) -> None:
    samples = spoilt(spoil)
    assert word in live(samples)
    assert live(samples) == recorded(samples)


@pytest.mark.parametrize(
    ("scale", "words"),
    [(1e37, "at sample 0"), (1e13, "beyond 1e+12"), (1e-14, "moves by"), (1e-30, "moves by")],
)
def test_what_no_sensor_measures_in_any_unit_is_refused_before_it_overflows(scale: float, words: str) -> None:
    samples = scale * spoilt(lambda _: None)
    if scale > 1.0:
        samples[0] = scale
    samples = samples.astype(np.float32).astype(np.float64)
    said = live(samples)
    assert words in said
    assert "which no sensor" in said
    assert "; correct its scale or unit, or replace" in said
    assert recorded(samples).split(": ")[-1].removeprefix("channel ") == said.split(": ")[-1].removeprefix(
        f"{SENSOR} "
    ).removeprefix("channel ")


@pytest.mark.parametrize("value", [1e37, -1e37])
def test_one_impossible_sample_costs_a_look_a_revolution_and_a_level_their_trust(value: float) -> None:
    samples = spoilt(lambda _: None)
    samples[100] = value
    assert f"{SENSOR}: {SENSOR} holds {value:.4g} at sample 100 (1 of" in live(samples)
    level = LevelDetector("motor", "housing", RATE_HZ, [LevelChannel(SENSOR, 0, "g")], window_s=LOOK_S)
    column = samples.astype(np.float32)[:, np.newaxis]
    (said,) = level.process(Window(0, column, NS_PER_S, NS_PER_S / RATE_HZ))
    assert (said.quality, dict(said.statistics)) == ("not_ok", {})
    assert said.reason.startswith(f"{SENSOR} holds {value:.4g} at sample 100")
    turn = np.random.default_rng(1).standard_normal((64, 2))
    judge = RevolutionJudge((Probe("x", 0, 0.0), Probe("y", 1, 90.0)))
    assert judge.judge(turn, 0.0).quality == "good"
    turn[5, 1] = value
    judged = judge.judge(turn, 0.0)
    assert judged.quality == "not_ok"
    assert judged.reason.startswith(f"y holds {value:.4g} at sample 5 (1 of 64")
    turn[5, 1] = 0.0
    assert judge.judge(turn, 0.0).quality == "good", "it is not looked at again"


@pytest.mark.parametrize(("share", "unfit"), [(0.9, False), (1.1, True)])
def test_the_same_share_of_samples_may_be_missing_live_and_recorded(share: float, *, unfit: bool) -> None:
    samples = spoilt(lambda _: None)
    at = np.random.default_rng(3).permutation(len(samples))
    samples[at[: round(share * ACCELEROMETER_SHARE * len(samples))]] = np.nan
    assert ("lacks" in recorded(samples)) == unfit
    assert bool(lacking(SENSOR, samples)) == unfit


def test_what_stands_still_is_not_called_clipped() -> None:
    still = np.full(640, 3.5)
    assert clipped_at(still) is None
    assert not ends_cut_off(still, 8)
    refuse_clipped(still)


def test_peaks_at_a_limit_are_found_with_the_samples_that_are_there() -> None:
    sine = np.sin(np.linspace(0.0, 40.0, 4000))
    assert not ends_cut_off(sine, 8)
    clipped = np.minimum(sine, 0.8)
    clipped[::7] = np.nan
    assert ends_cut_off(clipped, 8) == {0.8: int(np.count_nonzero(clipped == 0.8))}


def test_a_wrong_rate_is_seen_by_stamps_and_by_arrivals() -> None:
    rate_hz = 1.0 / 1.06
    stamps = rate_of_stamps(np.arange(500) / (1000.0 * rate_hz), surely_time=True)
    assert stamps is not None
    assert not stamps.agrees(1000.0)
    assert stamps.agrees(1000.0 * rate_hz * (1.0 + 0.9 * SAME_RATE))
    arrivals = ArrivalRate(1000.0)
    arrivals.add(np.rint(np.arange(20_000) * 1e6 / rate_hz).astype(np.int64))
    assert arrivals.rate_hz == pytest.approx(1000.0 * rate_hz, rel=1e-3)
    assert not arrivals.fits


@pytest.mark.parametrize("stall_s", [0.0, 4.0])
@pytest.mark.parametrize("wakes_s", [1e-4, 0.004, 0.02, 0.1])
@pytest.mark.parametrize(("sent_hz", "stated_hz"), [(800.0, 800.0), (800.0, 1000.0), (50.0, 50.0)])
def test_frames_that_come_in_bursts_are_of_no_fast_device(sent_hz, stated_hz, wakes_s, stall_s):
    # What sends them wakes up at times, once after a stall, and sends all that are due, 5 us apart.
    sent_s = np.arange(round(30.0 * sent_hz)) / sent_hz
    woken_s = np.ceil(sent_s / wakes_s) * wakes_s
    woken_s[(woken_s > 10.0) & (woken_s < 10.0 + stall_s)] = 10.0 + stall_s
    apart_s = 5e-6 * np.arange(len(sent_s))
    arrival_ns = np.rint(1e9 * (np.maximum.accumulate(woken_s - apart_s) + apart_s)).astype(np.int64)
    arrivals, measured = ArrivalRate(stated_hz), set()
    for block in np.split(
        arrival_ns, np.searchsorted(arrival_ns, np.arange(7_000_000, arrival_ns[-1], 7_000_000))
    ):
        if len(block):
            arrivals.add(block)
            measured.add(arrivals.rate_hz)
    known = measured - {None}
    assert known
    assert max(known) < 1.1 * max(sent_hz, stated_hz)


def test_lengths():
    assert LENGTH_UNITS == ("m", "mm", "um", "mil")
    lengths = np.array([[1.0, np.nan], [-2.0, 0.0]])
    for unit, um in {"m": 1e6, "mm": 1e3, "um": 1.0, "mil": 25.4}.items():
        assert np.array_equal(to_um(lengths, unit), lengths * um, equal_nan=True)


def test_other_units_of_length_are_refused():
    with pytest.raises(ValueError, match="'inch' is not a unit of length; use m, mm, um, mil"):
        to_um(np.ones(2), "inch")
