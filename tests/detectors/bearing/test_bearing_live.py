"""Bearings watched live: from samples to the alarm, and what gaps, dead sensors and restarts leave of it."""

from __future__ import annotations

import asyncio
import re
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bearing_signals import INNER, OUTER, RATE_HZ, SPEED_RPM, healthy, knocks
from support.examples import first_of
from support.machine_files import MACHINES

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.bearing.baseline import load_bearing_baseline, save_bearing_baseline
from daqsvc.bearing.geometry import BearingOrders, bearing_orders
from daqsvc.bearing.two_sensors import PairModel
from daqsvc.detectors.bearing.detector import BearingDetector
from daqsvc.detectors.bearing.direction import TwoSensors
from daqsvc.detectors.bearing.housed import HousedBearing
from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.detector import Window
from daqsvc.settings import parse_machine_file
from sim_hw.demo.session import DemoSession, Script
from sim_hw.link_faults import LinkFaults
from sim_hw.plants.bearing import BearingMachine, FaultSignal, levels, simulate
from sim_hw.reproduce.bearing.design import S3

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.bearing.baseline import BearingBaseline
    from daqsvc.diagnosis.record import Diagnosis
    from sim_hw.demo.session import Received
    from sim_hw.plants.bearing import Fault

pytestmark = pytest.mark.integration
EXAMPLE = MACHINES / "bearing.toml"
LOOK_S = 2.5


def two(
    seconds: float, seed: int, order: float | None = None, size: float = 0.6, *, heard: float = 0.25
) -> np.ndarray:
    """Drive end and fan end, float32 ``[n, 2]``; the drive end is damaged, and heard at the fan end."""
    found = np.column_stack([healthy(seconds, seed), healthy(seconds, seed + 1)])
    if order is not None:
        struck = knocks(seconds, order, seed + 2, size=size)
        found += np.outer(struck, [1.0, heard])
    return found.astype(np.float32)


def detector(**more: object) -> BearingDetector:
    orders = bearing_orders("6205-2RS")
    bearings = [
        HousedBearing("drive-end", "accel-de", 0, orders),
        HousedBearing("fan-end", "accel-fe", 1, orders),
    ]
    given = {
        "machine": "motor", "stream": "housing", "rate_hz": RATE_HZ, "speed_rpm": SPEED_RPM,
        "bearings": bearings, "calibrate_s": 10.0, **more,
    }  # fmt: skip
    return BearingDetector(**given)


def feed(
    watch: BearingDetector,
    samples: np.ndarray,
    first: int = 0,
    blocks: int = 1,
    rate_hz: float = RATE_HZ,
) -> Iterator[Diagnosis]:
    """Everything it says, window after window."""
    length, period_ns = watch.block * blocks, NS_PER_S / rate_hz
    for begin in range(0, len(samples) // watch.block * watch.block, length):
        part = samples[begin : begin + length]
        part = part[: len(part) // watch.block * watch.block]
        end_ns = round((first + begin + len(part) - 1) * period_ns)
        yield from watch.process(Window(first + begin, part, end_ns, period_ns))


@pytest.fixture(scope="module")
def learnt() -> BearingBaseline:
    watch = detector(calibrate_s=20.0)
    list(feed(watch, two(20.0, 1)))
    assert watch.baseline is not None
    return watch.baseline


@pytest.mark.long
def test_a_fault_is_raised_by_two_looks_and_taken_back_by_eight(learnt) -> None:
    kept: list[BearingBaseline] = []
    watch = detector(keep=kept.append)
    watch.warm()
    samples = np.concatenate([two(20.0, 11), two(20.0, 13, OUTER), two(40.0, 15)])
    said = list(feed(watch, samples))
    assert [d.end_index for d in said] == [round((k + 1) * LOOK_S * RATE_HZ) for k in range(32)]
    assert [round(d.t_ns / NS_PER_S, 3) for d in said[:2]] == [2.5, 5.0]
    assert all(d.quality == "good" for d in said)
    assert "learning the healthy state: 2 of 10 s" in said[0].reason
    assert len(kept) == 1
    assert said[4].reason == ""
    changes = [(d.end_index / RATE_HZ, d.decision) for d in said if d.changed]
    assert [word for _, word in changes] == ["normal", "outer", "normal"]
    assert changes[0][0] == 2.5
    assert changes[1][0] == 25.0  # two looks after 20 s
    assert 60.0 <= changes[2][0] <= 70.0  # eight looks after what ten seconds remember
    raised = next(d for d in said if d.changed and d.decision == "outer")
    assert raised.severity in {"alert", "danger"}
    assert raised.sensors == ("accel-de",)
    assert raised.probabilities["outer"] > 0.5
    assert sum(raised.probabilities.values()) == pytest.approx(1.0)
    assert raised.statistics["drive-end.outer.severity"] > raised.thresholds["drive-end.outer.severity"]
    assert raised.statistics["drive-end.outer.severity"] > raised.statistics["fan-end.outer.severity"]
    assert raised.statistics["residual.departure"] > raised.thresholds["residual.departure"]
    assert raised.evidence["outer"] > 50.0
    line_order = raised.statistics["line.order"] / OUTER
    assert line_order == pytest.approx(round(line_order), rel=0.015)
    assert raised.units == {"residual.rise": "dB", "speed": "rpm", "line.frequency": "Hz"}
    assert said[0].severity == said[-1].severity == "normal"


def test_where_windows_are_cut_makes_no_difference(learnt) -> None:
    samples = np.concatenate([two(5.0, 21), two(10.0, 23, INNER)])
    one_by_one = list(feed(detector(baseline=learnt), samples))
    in_strides = list(feed(detector(baseline=learnt), samples, blocks=7))
    assert one_by_one == in_strides
    assert one_by_one[-1].decision == "inner"


def test_a_change_of_unknown_cause_needs_a_healthy_state(learnt) -> None:
    hiss = 0.1 * np.random.default_rng(5).standard_normal((round(10.0 * RATE_HZ), 2)).astype(np.float32)
    dry = two(10.0, 31) + hiss
    assert {d.decision for d in feed(detector(calibrate_s=60.0), dry)} == {"normal"}
    said = list(feed(detector(baseline=learnt), dry))
    assert [d.decision for d in said] == ["undetermined", "changed", "changed", "changed"]
    assert said[-1].severity == "alert"
    assert said[-1].sensors == ("accel-de", "accel-fe")


def test_large_innovations_are_danger_until_they_are_clearly_less(learnt) -> None:
    watch = detector(baseline=learnt)
    said = list(feed(watch, two(10.0, 41, OUTER, size=8.0)))
    assert said[-1].statistics["residual.ratio"] > 10.0
    assert said[-1].severity == "danger"
    milder = list(feed(watch, two(10.0, 43, OUTER, size=1.0), first=round(10.0 * RATE_HZ)))
    assert milder[-1].statistics["residual.ratio"] < 8.0
    assert (milder[-1].decision, milder[-1].severity) == ("outer", "alert")


@pytest.mark.long
@pytest.mark.parametrize(
    ("spoil", "quality", "words"),
    [
        (lambda x: x.__setitem__((slice(None), 0), np.nan), "missing", "accel-de: 30000 of 30000 samples"),
        (lambda x: x.__setitem__((slice(9000, 12_000), 0), np.nan), "missing", "3000 of 30000 samples"),
        (lambda x: x.__setitem__((slice(None), 0), 0.25), "not_ok", "accel-de: channel is dead"),
        (lambda x: np.clip(x[:, 0], -0.1, 0.1, out=x[:, 0]), "not_ok", "accel-de: channel is clipped"),
        (lambda x: np.multiply(x[:, 0], 0.02, out=x[:, 0]), "not_ok", "accel-de: .*(quieter|unit)"),
    ],
)
def test_what_cannot_be_judged_clears_nothing(learnt, spoil, quality, words) -> None:
    watch = detector(baseline=learnt)
    said = list(feed(watch, two(7.5, 51, OUTER, heard=0.0)))
    assert said[-1].decision == "outer"
    bad = two(30.0, 53)
    spoilt = bad.reshape(-1, 30_000, 2)
    for look in spoilt:
        spoil(look)
    held = list(feed(watch, bad, first=90_000))
    assert len(held) == 12
    for statement in held:
        assert (statement.quality, statement.decision, statement.changed) == (quality, "outer", False)
        assert statement.severity in {"alert", "danger"}
    assert re.search(words, held[-1].reason)
    (silence,) = watch.silent(3.0, 10**12)
    assert (silence.quality, silence.decision) == ("missing", "outer")
    assert "no samples of stream 'housing' for more than 3.0 s" in silence.reason


def test_a_dead_sensor_does_not_hide_the_other_bearing(learnt) -> None:
    samples = two(10.0, 61, OUTER)[:, ::-1].copy()  # the fan end is damaged now
    samples[:, 0] = 0.0
    said = list(feed(detector(baseline=learnt), samples))
    assert (said[-1].decision, said[-1].quality, said[-1].sensors) == ("outer", "good", ("accel-fe",))
    assert "accel-de: channel is dead" in said[-1].reason


def test_a_gap_begins_anew(learnt) -> None:
    watch = detector(baseline=learnt)
    list(feed(watch, two(5.0, 71)))
    first = list(feed(watch, two(2.5, 73, OUTER), first=round(5.0 * RATE_HZ)))
    assert first[-1].decision == "normal"
    # The second look at the fault comes after a gap: it is the first one again.
    second = list(feed(watch, two(5.0, 75, OUTER), first=round(20.0 * RATE_HZ)))
    assert [d.decision for d in second] == ["normal", "outer"]
    assert second[0].first_index == round(20.0 * RATE_HZ)


def test_a_faulty_or_unsteady_machine_is_not_learnt_as_healthy() -> None:
    watch = detector()
    said = list(feed(watch, two(15.0, 81, INNER)))
    assert watch.baseline is None
    assert 'no healthy state to tell "changed" by: the machine shows inner at drive-end' in said[-1].reason
    unsteady = two(10.0, 83) * np.linspace(1.0, 1.8, round(10.0 * RATE_HZ), dtype=np.float32)[:, np.newaxis]
    watch = detector()
    said = list(feed(watch, unsteady))
    assert watch.baseline is None
    assert "the machine is not steady" in said[-1].reason
    assert said[-1].quality == "good"
    list(feed(watch, two(10.0, 85), first=len(unsteady)))
    assert watch.baseline is not None


PAIR_RATE_HZ = 24_000.0


@pytest.fixture(scope="module")
def pair():
    """A machine of heavy rolling elements, 5 % off its model, with accelerometers on rotor and housing."""
    machine = BearingMachine(
        masses=(S3.m_r, S3.m_b, S3.m_h),
        stiffnesses=(S3.k_s, S3.k_c, S3.k_h),
        dampings=(S3.c_s, S3.c_c, S3.c_h),
    )
    signal = FaultSignal(shaft_hz=SPEED_RPM / 60.0)
    level = levels(machine, signal, snr_db=5.0, rate_hz=PAIR_RATE_HZ)
    rng = np.random.default_rng(1)
    off = machine.mismatched(0.05, rng)

    def run(fault: Fault, seconds: float) -> np.ndarray:
        return simulate(off, signal, fault, level, rng, seconds=seconds, rate_hz=PAIR_RATE_HZ).y

    return {"healthy": run("healthy", 12.5), "inner": run("inner", 7.5), "outer": run("outer", 7.5)}


@pytest.mark.long
@pytest.mark.parametrize(("fault", "sign"), first_of(("inner", 1.0), ("outer", -1.0)))
def test_two_accelerometers_tell_the_race_where_the_lines_do_not(pair, fault, sign) -> None:
    """The bearing is another one than the file says: its lines are not found, and the direction decides."""
    watch = with_pair()
    watch.warm()
    list(feed(watch, pair["healthy"].astype(np.float32), rate_hz=PAIR_RATE_HZ))
    assert list(watch.baseline.residuals) == [("rotor", "housing")]
    first = round(12.5 * PAIR_RATE_HZ)
    said = list(feed(watch, pair[fault].astype(np.float32), first, rate_hz=PAIR_RATE_HZ))
    assert said[-1].decision == fault
    assert sign * said[-1].statistics["drive-end.direction"] > 4.5
    assert said[-1].units["drive-end.direction"] == "dB"
    assert said[-1].probabilities[fault] > 0.5
    blind = detector(rate_hz=PAIR_RATE_HZ, bearings=[HousedBearing("drive-end", "housing", 1, WRONG)])
    both = np.concatenate([pair["healthy"], pair[fault]]).astype(np.float32)
    assert list(feed(blind, both, rate_hz=PAIR_RATE_HZ))[-1].decision == "changed"


WRONG = BearingOrders(inner=9.45, outer=4.55, ball=3.05, cage=4.55 / 14.0)
"""Of another bearing: its lines are not found, and only the direction tells the race."""


def with_pair(**more: object) -> BearingDetector:
    bearing = HousedBearing("drive-end", "housing", 1, WRONG, TwoSensors("rotor", 0, PairModel(S3)))
    return detector(rate_hz=PAIR_RATE_HZ, bearings=[bearing], **more)


def test_a_louder_machine_is_changed_and_no_race_is_named(pair) -> None:
    watch = with_pair()
    list(feed(watch, pair["healthy"].astype(np.float32), rate_hz=PAIR_RATE_HZ))
    hiss = np.random.default_rng(4).standard_normal((round(10.0 * PAIR_RATE_HZ), 2))
    louder = pair["healthy"][: len(hiss)] + 2.0 * pair["healthy"].std(axis=0) * hiss
    first = round(12.5 * PAIR_RATE_HZ)
    said = list(feed(watch, louder.astype(np.float32), first, rate_hz=PAIR_RATE_HZ))
    assert said[-1].decision == "changed"
    assert (
        said[-1].statistics["drive-end.direction.bursts"] < said[-1].thresholds["drive-end.direction.bursts"]
    )


@pytest.mark.long
def test_a_fault_that_stands_at_a_restart_is_no_healthy_machine(pair, tmp_path) -> None:
    """What tells the races by direction is kept with the healthy state, and comes back to the last bit."""
    before = with_pair()
    list(feed(before, pair["healthy"].astype(np.float32), rate_hz=PAIR_RATE_HZ))
    save_bearing_baseline(before.baseline, tmp_path / "bearing.toml")
    kept = load_bearing_baseline(tmp_path / "bearing.toml")
    again, first = with_pair(baseline=kept), round(12.5 * PAIR_RATE_HZ)
    outer = pair["outer"].astype(np.float32)
    said = list(feed(again, outer, rate_hz=PAIR_RATE_HZ))
    assert [d.decision for d in said] == ["undetermined", "outer", "outer"]
    going_on = list(feed(before, outer, first, rate_hz=PAIR_RATE_HZ))
    figures = ("drive-end.direction", "drive-end.direction.change", "drive-end.direction.bursts")
    for name in figures:
        assert [d.statistics[name] for d in said] == [d.statistics[name] for d in going_on]
    (by_hits,) = {d.evidence["outer"] > d.evidence["inner"] for d in said}
    assert by_hits


def machine_file(url: str, rate_hz: float = RATE_HZ) -> object:
    text = EXAMPLE.read_text(encoding="utf-8").replace('"socketcan"', '"virtual"')
    text = text.replace("rate_hz = 25_600.0", f"rate_hz = {rate_hz}").replace("1772.0", f"{SPEED_RPM}")
    text = text.replace("calibrate_s = 30.0", "calibrate_s = 10.0")
    text = text[: text.index("[mqtt]")] + f'[mqtt]\nurl = "{url}"\ninsecure = true\n'
    return parse_machine_file(text, EXAMPLE)


@pytest.mark.long
async def test_damage_reaches_the_alarm_over_the_bus() -> None:
    heard: list[Received] = []
    script = Script(
        title="outer race",
        machine=machine_file,
        stream="housing",
        samples=np.concatenate([two(10.0, 91), two(7.5, 93, OUTER, size=1.0)]).astype(np.float64),
        rate_hz=RATE_HZ,
        faults=LinkFaults(drop=0.0003, seed=1),
    )
    outcome = await DemoSession(script, speed=1000, broker_url=None, on_message=heard.append).run()
    assert outcome.complete
    alarms = [m.payload for m in heard if m.kind == "alarm" and m.payload["alarm"] == "bearing-damage"]
    assert [(p["kind"], p["cause"]["decision"]) for p in alarms] == [("raised", "outer")]
    (raised,) = alarms
    assert raised["cause"]["detector"] == "bearing"
    assert "bearing finds damage of the outer race at drive-end" in raised["message"]
    assert raised["cause"]["sensors"] == ["accel-de"]
    assert raised["cause"]["statistics"]["residual.ratio"] > 1.2
    said = [m.payload for m in heard if m.kind == "diagnosis" and m.payload["detector"] == "bearing"]
    assert len(said) <= 8
    assert outcome.figures["streams"]["housing"]["samples_lost"] > 0


async def test_the_healthy_state_outlives_a_restart(tmp_path) -> None:
    given = machine_file("mqtt://127.0.0.1:1")
    (first,) = (d for d in detectors(given, tmp_path) if d.name == "bearing")
    await asyncio.to_thread(lambda: list(feed(first, two(12.5, 95))))
    assert (tmp_path / "bearing.toml").exists()
    (again,) = (d for d in detectors(given, tmp_path) if d.name == "bearing")
    assert again.baseline is not None
    assert again.baseline.races == first.baseline.races
    hiss = 0.1 * np.random.default_rng(6).standard_normal((round(5.0 * RATE_HZ), 2)).astype(np.float32)
    said = list(feed(again, two(5.0, 97) + hiss))
    assert said[-1].decision == "changed"
