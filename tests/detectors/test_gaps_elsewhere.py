"""What is measured of a shaft, a rotor and a bearing while samples are lost: without bias, or not at all."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from support.bearing_signals import OUTER, SPEED_RPM, healthy, knocks
from support.bearing_signals import RATE_HZ as BEARING_HZ
from support.gapped_signals import FRAMES, SHARES, lost
from support.rotor_orbits import HEALTHY, orbits
from support.shaft_channels import channels_of, feed

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.manager import AlarmManager, Identity
from daqsvc.bearing.geometry import bearing_orders
from daqsvc.bearing.identify import NotIdentifiableError, learn_healthy
from daqsvc.bearing.race.judge import race_test
from daqsvc.detectors.bearing.detector import BearingDetector
from daqsvc.detectors.bearing.housed import HousedBearing
from daqsvc.detectors.rotor_bank.detector import RotorBankDetector, RotorMode
from daqsvc.detectors.rotor_synchronous.detector import RotorSynchronousDetector
from daqsvc.diagnosis.detector import Window
from daqsvc.dsp.orders import order_vectors
from daqsvc.dsp.probes import Probe
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe, KeyphasorTracker
from daqsvc.dsp.speed.steadiness import SpeedError, measure_speed
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.model import RotorParameters
from daqsvc.rotor.synchronous.vectors import synchronous_vectors
from sim_hw.plants import rotor as plant
from sim_hw.plants.rotor import keyphasor_voltage

pytestmark = pytest.mark.statistical
GAPS = [(share, frame) for share in SHARES for frame in FRAMES]
FEW_GAPS = [
    pytest.param(share, frame, marks=() if (share, frame) in {(0.3, 20), (0.5, 1)} else pytest.mark.long)
    for share in SHARES[1:]
    for frame in FRAMES
]
PER_REV = 64
NAMES = {"speed": 0.5, "1x.amplitude": 0.15, "mean.x": 0.15, "mean.y": 0.15, "noise": 0.05}
"""What the rotor's detectors state, and how far the mean may be off with gaps, of 28 um of whirl."""
KEYPHASOR = KeyphasorProbe("keyphasor", 2, -6.0)
PROBES = (Probe("probe-x", 0, 0.0), Probe("probe-y", 1, 90.0))


def without(rng, samples, share, frame, begin=0):
    """Rows ``[n, channels]`` of which some are lost from ``begin`` on."""
    gapped = np.array(samples)
    missing = np.isnan(lost(rng, np.zeros(len(samples) - begin), share, frame))
    gapped[begin:][missing] = np.nan
    return gapped


@pytest.mark.parametrize(("share", "frame"), GAPS)
def test_synchronous_vectors_have_no_bias(share, frame):
    count, noise_um = 400, 2.0
    whole = orbits(np.tile(HEALTHY, (count, 1)), noise_um, 1)
    found = synchronous_vectors(replace(whole, xy=without(np.random.default_rng(1), whole.xy, share, frame)))
    usable = found.usable
    assert usable.mean() > 0.75 or share > 0.02
    if usable.sum() < 30:
        assert share >= 0.3, "a revolution with more than a quarter missing is not fitted"
        return
    off = found.vectors[usable] - HEALTHY
    assert np.abs(off.mean(axis=0)).max() < 4.0 * off.std(axis=0).max() / np.sqrt(usable.sum())
    # Fewer samples tell less, and hardly less than their number.
    assert off.std(axis=0).max() < 1.15 * noise_um * np.sqrt(2.0 / (0.75 * PER_REV))
    assert found.noise[usable].mean() == pytest.approx(2.0 * noise_um**2, rel=0.05)


@pytest.mark.parametrize(("share", "frame"), GAPS)
def test_orders_have_no_bias_or_are_refused(share, frame):
    rng = np.random.default_rng(2)
    hz, rate_hz = 24.87, 2000.0
    t = np.arange(40_000) / rate_hz
    samples = np.sin(2 * np.pi * hz * t) + 0.3 * np.sin(4 * np.pi * hz * t) + 0.2 * rng.normal(size=len(t))
    gapped = lost(rng, samples, share, frame).astype(np.float64)
    if share > 0.25:
        with pytest.raises(ValueError, match="samples are missing"):
            order_vectors(gapped, rate_hz, 1490.0)
        return
    found = order_vectors(gapped, rate_hz, 1490.0)
    first, second = np.abs(found.amplitudes[:, :2, 0]).mean(axis=0)
    assert (first, second) == (pytest.approx(1.0, abs=0.01), pytest.approx(0.3, abs=0.01))
    assert found.speed_rpm == pytest.approx(60.0 * hz, abs=0.05)
    assert found.residual_rms.mean() == pytest.approx(0.2, rel=0.03)


@pytest.mark.parametrize(("share", "frame"), GAPS)
def test_speed_and_angle_by_a_keyphasor_have_no_bias(share, frame):
    rng = np.random.default_rng(3)
    rate_hz, rpm = 12_000.0, 1797.0
    turns = np.arange(30_000) / rate_hz * rpm / 60.0
    volts = keyphasor_voltage(turns) + 0.02 * rng.normal(size=len(turns))
    gapped = lost(rng, volts, share, frame).astype(np.float64)
    tracker = KeyphasorTracker(threshold=-6.0, hysteresis=0.5, period_samples=rate_hz * 60.0 / rpm)
    angle = tracker.process(gapped).angle_rad
    off = np.angle(np.exp(1j * (angle - 2 * np.pi * turns)))
    known = np.isfinite(off)
    assert known.mean() > 0.85
    assert np.degrees(np.abs(off[known]).max()) < 0.5
    assert 60.0 * rate_hz / tracker.period_samples == pytest.approx(rpm, rel=1e-4)
    try:
        speed = measure_speed(gapped, KEYPHASOR, rate_hz)
    except SpeedError:
        assert share >= 0.1, "it is refused where too many pulses are lost to tell which"
    else:
        assert speed.rpm == pytest.approx(rpm, rel=1e-4)
        assert speed.drift < 1e-3


def rotor_bank():
    modes = (RotorMode("N", 0.18), RotorMode("F1", 0.10, "alert"))
    rotor = RotorParameters(
        natural_frequency_hz=10.0,
        damping_ratio=0.18,
        eccentricity_um=10.0,
        clearance_um=100.0,
        static_sag_um=10.0,
    )
    return RotorBankDetector(
        machine="rig",
        stream="shaft",
        rate_hz=640.0,
        speed_rpm=600.0,
        probes=PROBES,
        keyphasor=KEYPHASOR,
        rotor=rotor,
        modes=modes,
        noise_um=19.6,
    )


def rotor_synchronous():
    return RotorSynchronousDetector(
        machine="rig",
        stream="shaft",
        rate_hz=640.0,
        speed_rpm=600.0,
        probes=PROBES,
        reference=KEYPHASOR,
        rotor=LavalRotor(
            natural_frequency_hz=10.5, damping_ratio=0.16, clearance_um=100.0, static_sag_um=10.0
        ),
    )


@pytest.mark.parametrize(("share", "frame"), FEW_GAPS)
@pytest.mark.parametrize("faulty", [True, False], ids=["damping lost", "healthy"])
@pytest.mark.parametrize(("make", "noise_um"), [(rotor_bank, 19.6), (rotor_synchronous, 2.0)])
def test_a_rotor_s_decision_neither_comes_nor_goes_with_the_samples(make, noise_um, faulty, share, frame):
    change = [plant.Change(55.0, plant.PlantParameters(damping_ratio=0.10))] if faulty else []
    motion = plant.simulate(plant.PlantParameters(), change, revolutions=130.0, samples_per_rev=PER_REV)
    begin = 85 * PER_REV
    samples = without(np.random.default_rng(4), channels_of(motion, noise_um), share, frame, begin)
    said = feed(make(), samples, 640.0, block=PER_REV, first_index=0)
    before = [d for d in said if d.end_index <= begin][-1]
    assert before.severity == ("alert" if faulty else "normal")
    lossy = [d for d in said if d.end_index > begin]
    assert len(lossy) >= 3
    assert {d.severity for d in lossy} == {before.severity}
    assert {d.decision for d in lossy if d.quality != "good"} <= {d.decision for d in lossy}
    assert any(d.quality == "missing" for d in lossy) or share < 0.3


def bearing_watch(**more):
    bearing = HousedBearing("drive-end", "accel-de", 0, bearing_orders("6205-2RS"))
    return BearingDetector(
        machine="motor",
        stream="housing",
        rate_hz=BEARING_HZ,
        speed_rpm=SPEED_RPM,
        bearings=[bearing],
        **more,
    )


def looks(watch, samples):
    """What a bearing's detector says of samples of one accelerometer."""
    said = []
    for begin in range(0, len(samples) - watch.block + 1, watch.block):
        part = samples[begin : begin + watch.block, np.newaxis].astype(np.float32)
        t_ns = round((begin + watch.block) / BEARING_HZ * 1e9)
        said += watch.process(Window(begin, part, t_ns, 1e9 / BEARING_HZ))
    return said


def rotor_samples(noise_um, revolutions=200.0):
    return channels_of(plant.simulate(plant.PlantParameters(), [], revolutions=revolutions), noise_um)


@pytest.mark.parametrize(("share", "frame"), [(0.1, 1), (0.3, 20), (0.5, 20), (0.2, 64)])
@pytest.mark.parametrize("make", [rotor_bank, rotor_synchronous])
def test_a_rotor_s_detectors_state_what_is_missing_and_raise_one_quality_alarm_for_it(make, share, frame):
    whole = rotor_samples(2.0, 300.0)
    begin, end = 85 * PER_REV, 215 * PER_REV
    samples = whole.copy()
    samples[:end] = without(np.random.default_rng(8), whole[:end], share, frame, begin)
    missing = ~np.isfinite(samples[begin:end]).all(axis=1)
    said = feed(make(), samples, 640.0, block=PER_REV, first_index=0)
    assert all(d.missing_share == 0.0 for d in said if d.end_index < begin)
    lossy = [d for d in said if begin + PER_REV < d.end_index <= end]
    assert np.mean([d.missing_share for d in lossy]) == pytest.approx(missing.mean(), abs=0.06)
    assert said[-1].missing_share == 0.0
    alarms = AlarmManager(Identity("lab", "box", "rig"), [], DrivenClock())
    events = [(e.alarm, e.kind.value) for d in said for e in alarms.take(d)]
    flickers = len([1 for a, b in pairwise(said) if (a.quality == "good") != (b.quality == "good")])
    name = f"detector-ok/{said[0].detector}"
    assert [kind for kind in events if kind[1] != "changed"] in ([(name, "raised"), (name, "returned")], [])
    assert bool(events) is (flickers > 0)


@pytest.mark.parametrize(("share", "frame"), [(0.02, 1), (0.005, 20), (0.3, 20)])
def test_a_bearing_s_detector_states_what_is_missing(share, frame):
    samples = lost(np.random.default_rng(9), housing(10.0, 31, 0.0), share, frame)
    said = looks(bearing_watch(calibrate_s=60.0), samples)
    stated = np.mean([d.missing_share for d in said])
    assert stated == pytest.approx(np.isnan(samples[: said[-1].end_index]).mean(), rel=1e-6)
    assert {d.quality for d in said} == ({"missing"} if share > 0.01 else {"good"})


def test_a_bearing_is_not_found_normal_while_its_second_accelerometer_lacks_samples():
    # Only where it is and which: the pair is looked at against a healthy machine, and there is none.
    two = SimpleNamespace(rotor="accel-rotor", column=1, model=None)
    housed = HousedBearing("drive-end", "accel-de", 0, bearing_orders("6205-2RS"), two)
    watch = BearingDetector(
        machine="motor", stream="housing", rate_hz=BEARING_HZ, speed_rpm=SPEED_RPM, bearings=[housed],
        calibrate_s=60.0,
    )  # fmt: skip
    both = np.column_stack([housing(10.0, 61, 0.0), housing(10.0, 63, 0.0)]).astype(np.float32)
    both[len(both) // 2 :, 1] = lost(np.random.default_rng(12), both[len(both) // 2 :, 1], 0.3, 20)
    said = []
    for begin in range(0, len(both) - watch.block + 1, watch.block):
        t_ns = round((begin + watch.block) / BEARING_HZ * 1e9)
        said += watch.process(Window(begin, both[begin : begin + watch.block], t_ns, 1e9 / BEARING_HZ))
    assert [d.quality for d in said] == ["good", "good", "missing", "missing"]
    assert [d.missing_share for d in said] == pytest.approx([0.0, 0.0, 0.3, 0.3], abs=0.05)
    assert "accel-rotor: " in said[-1].reason
    assert said[-1].decision == "normal"


@pytest.mark.parametrize(("share", "frame"), [(0.005, 1), (0.005, 20)])
def test_what_a_bearing_s_detector_measures_in_spite_of_gaps_has_no_bias(share, frame):
    rng = np.random.default_rng(10)
    healthy_s = housing(20.0, 41, 0.0)
    learnt = bearing_watch(calibrate_s=15.0)
    looks(learnt, healthy_s)
    assert learnt.baseline is not None
    rises, sizes = [], []
    for seed in (51, 53, 55):
        damaged = housing(5.0, seed, 0.3)
        pair = [
            looks(bearing_watch(baseline=learnt.baseline), one)
            for one in (damaged, lost(rng, damaged, share, frame))
        ]
        for whole, gapped in zip(*pair, strict=True):
            assert gapped.quality == "good"
            rises.append(gapped.statistics["residual.rise"] - whole.statistics["residual.rise"])
            names = [name for name in whole.statistics if name.endswith("outer.size")]
            sizes += [gapped.statistics[n] / whole.statistics[n] for n in names if whole.statistics[n] > 0]
    # Of the 2 dB that count as a change.
    assert abs(np.mean(rises)) < 0.1
    assert np.abs(rises).max() < 0.3
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("share", "frame"), [(0.02, 1), (0.1, 1), (0.1, 20), (0.3, 20), (0.5, 20)])
@pytest.mark.parametrize("make", [rotor_bank, rotor_synchronous])
def test_what_a_rotor_s_detectors_measure_in_spite_of_gaps_has_no_bias(make, share, frame):
    whole = rotor_samples(2.0)
    begin = 85 * PER_REV
    gapped = without(np.random.default_rng(11), whole, share, frame, begin)
    figures = []
    for samples in (whole, gapped):
        said = feed(make(), samples, 640.0, block=PER_REV, first_index=0)
        good = [d for d in said if d.end_index > begin + 4 * PER_REV and d.quality == "good"]
        stated = [(name, d.statistics[name]) for d in good for name in NAMES if name in d.statistics]
        figures.append({name: np.array([v for n, v in stated if n == name]) for name in NAMES})
    for name, tolerance in NAMES.items():
        if len(figures[1][name]) < 3:
            assert share >= 0.3 or not len(figures[0][name])
            continue
        assert figures[1][name].mean() == pytest.approx(figures[0][name].mean(), abs=tolerance), name


def housing(seconds, seed, size):
    found = healthy(seconds, seed)
    return (found + knocks(seconds, OUTER, seed + 1, size=size) if size else found).astype(np.float64)


@pytest.mark.parametrize(
    ("share", "frame"), [(0.005, 1), (0.005, 20), *[(s, f) for s in SHARES for f in (1, 20)]]
)
def test_the_race_test_says_the_same_or_refuses(share, frame):
    samples = lost(np.random.default_rng(5), housing(5.0, 1, 0.6), share, frame).astype(np.float64)
    orders = bearing_orders("6205-2RS")
    if share > 0.01:
        with pytest.raises(UnfitError, match="lacks"):
            race_test(samples, BEARING_HZ, SPEED_RPM, orders)
        return
    assert race_test(samples, BEARING_HZ, SPEED_RPM, orders).verdict == "outer"


@pytest.mark.parametrize("share", SHARES)
def test_a_bearing_s_alarm_neither_comes_nor_goes_with_the_samples(share):
    rng = np.random.default_rng(6)
    bearing = HousedBearing("drive-end", "accel-de", 0, bearing_orders("6205-2RS"))
    keyphasor = KeyphasorProbe("keyphasor", 1, -6.0)

    def volts(count):
        return keyphasor_voltage(np.arange(count) / BEARING_HZ * SPEED_RPM / 60.0)

    for size, decision in ((0.6, "outer"), (0.0, "normal")):
        watch = BearingDetector(
            machine="motor",
            stream="housing",
            rate_hz=BEARING_HZ,
            speed_rpm=SPEED_RPM,
            bearings=[bearing],
            keyphasor=keyphasor,
            calibrate_s=60.0,
        )
        whole = housing(7.5, 11, size)
        # Then it is the other way round, as far as the samples that are left show.
        other = housing(25.0, 13, 0.0 if size else 0.6)
        after = lost(rng, np.ones(len(other)), share, 20)
        samples = np.concatenate((whole, other * after))
        pulses = np.concatenate((volts(len(whole)), volts(len(other)) * after))
        both = np.column_stack((samples, pulses)).astype(np.float32)
        said = []
        for begin in range(0, len(both) - watch.block + 1, watch.block):
            part = both[begin : begin + watch.block]
            said += watch.process(Window(begin, part, 10**9 + begin, 1e9 / BEARING_HZ))
        assert [d.decision for d in said[2:]] == [decision] * len(said[2:])
        assert {d.quality for d in said[3:]} == {"missing"}
        assert all("samples are missing" in d.reason for d in said[3:])


@pytest.mark.parametrize(
    ("share", "frame"), [(0.01, 1), (0.02, 20), (0.1, 20), (0.2, 100), (0.3, 64), (0.1, 1)]
)
def test_a_healthy_bearing_learnt_with_gaps_is_that_without_or_is_refused(share, frame):
    samples = housing(20.0, 21, 0.0)[:, np.newaxis]
    whole = learn_healthy(samples, BEARING_HZ, most_order=16)
    gaps = without(np.random.default_rng(7), samples, share, frame)
    try:
        gapped = learn_healthy(gaps, BEARING_HZ, most_order=16)
    except NotIdentifiableError as error:
        assert share >= 0.1
        assert "give a recording without gaps" in str(error)  # noqa: PT017 - it may be learnt as well
        return
    # What counts as a change is 2 dB of all bands together, and 3 dB of one.
    assert np.abs(gapped.mean_db - whole.mean_db).max() < 0.2
