"""Lines beside the shaft's harmonics: found, told from what they look like, and the mains named as that."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from support.formats import fits
from support.rotor_orbits import HEALTHY, PER_REV, ROTOR, orbits

from daqsvc.cli import main
from daqsvc.dsp.speed.revolutions import Revolutions
from daqsvc.rotor.synchronous.nonsynchronous import LastPositions
from daqsvc.rotor.synchronous.vectors import synchronous_vectors
from daqsvc.rotor.synchronous.watch import RotorWatch, WatchRules

NOISE_UM = 2.8
HEALTHY_REVOLUTIONS = 150
TWO_POLE_HZ = 49.6  # a motor of two poles that slips by .8 %


def watched(
    shaft_hz,
    added,
    *,
    revolutions=400,
    vectors=None,
    rules=None,
    seed=3,
    before=0.0,
    missing=None,
):
    """The watch and its reports; ``added`` is a motion in um of the time in s, after the healthy part."""
    count = HEALTHY_REVOLUTIONS + revolutions
    rows = np.tile(HEALTHY, (count, 1)) if vectors is None else vectors
    cut = orbits(rows, NOISE_UM, seed)
    samples = np.arange(count * PER_REV)
    motion = added(samples / (PER_REV * shaft_hz))
    motion = np.where(samples < HEALTHY_REVOLUTIONS * PER_REV, before * motion, motion)
    xy = cut.xy + np.column_stack((motion.real, motion.imag))
    if missing is not None:
        xy[missing] = np.nan
    cut = replace(cut, xy=xy)
    rotor = replace(ROTOR, natural_frequency_hz=shaft_hz)
    watch = RotorWatch(rotor, PER_REV * shaft_hz, rules=rules)
    reports = watch.evaluate(synchronous_vectors(cut), cut)
    return watch, reports


def round_line(hz, um):
    return lambda t: um * np.exp(2j * math.pi * hz * t + 0.3j)


def flat_line(hz, um):
    """As cables pick it up: the same in both probes, but for the gain."""
    return lambda t: um * (1.0 + 0.3j) * np.cos(2.0 * math.pi * hz * t + 0.3)


@pytest.mark.parametrize("line", [round_line, flat_line])
@pytest.mark.parametrize("um", [4.0, 12.0])
@pytest.mark.parametrize(
    ("shaft_hz", "hz", "mains"),
    [
        (TWO_POLE_HZ, 49.97, 1),  # beside 1X
        (TWO_POLE_HZ, 100.05, 2),  # beside 2X
        (24.7, 100.0, 2),  # beside 4X
        (24.7, 50.0, 1),  # beside 2X
        (59.4, 120.1, 2),
        (83.0, 50.0, 1),  # below 1X
    ],
)
def test_the_mains_are_named_and_no_fault_of_the_rotor_is(shaft_hz, hz, mains, um, line):
    watch, reports = watched(shaft_hz, line(hz, um))
    found = watch.finish()
    assert found.group == ("unmodelled",)
    assert found.named
    assert found.line.mains == mains
    assert found.line.is_the_change
    assert found.line.frequency_hz == pytest.approx(hz, abs=0.04)
    assert found.line.order == pytest.approx(hz / shaft_hz, abs=0.001)
    rms = um if line is round_line else um * math.sqrt(1.09 / 2.0)
    assert found.line.amplitude_um == pytest.approx(rms, rel=0.08)
    # It beats for ever, and is one alarm all the same, by then ...
    assert not any(report.departed for report in reports if report.revolution > HEALTHY_REVOLUTIONS + 60)
    # ... and nothing of the rotor is named any more.
    late = [one.identification for one in reports if one.revolution > HEALTHY_REVOLUTIONS + 60]
    assert {one.group for one in late} == {("unmodelled",)}


def test_what_is_said_of_the_mains():
    watch, _ = watched(TWO_POLE_HZ, flat_line(50.0, 4.0))
    sentence = watch.finish().line.describe()
    assert "at 50.00 Hz (1.008X) came with the change: the mains, as cables pick them up" in sentence
    watch, _ = watched(TWO_POLE_HZ, round_line(100.0, 4.0))
    assert "twice the mains, as an induction motor pulls" in watch.finish().line.describe()
    watch, _ = watched(TWO_POLE_HZ, round_line(-0.47 * TWO_POLE_HZ, 6.0))
    assert "X) came with the change: backward, at no harmonic of the shaft" in (
        watch.finish().line.describe()
    )


def test_a_whirl_is_a_line_with_its_sense_and_stays_unmodelled():
    watch, _ = watched(TWO_POLE_HZ, round_line(0.47 * TWO_POLE_HZ, 6.0))
    found = watch.finish()
    assert found.verdict == "unmodelled"
    assert found.line.forward
    assert found.line.mains == 0
    assert found.line.order == pytest.approx(0.47, abs=0.001)
    assert not found.line.is_the_change  # what whirls is for a person to say


def test_more_unbalance_is_no_mains_though_the_shaft_turns_at_their_frequency():
    # 49.97 Hz: a revolution cannot tell the two, and a steady orbit is the shaft's.
    for shaft_hz in (49.97, 50.0, 100.0):
        watch, _ = watched(shaft_hz, round_line(shaft_hz, 6.0))
        found = watch.finish()
        assert "unbalance" in found.group
        assert found.line is None


@pytest.mark.parametrize("revolutions", [100, 400])
def test_unbalance_that_grows_is_no_mains(revolutions):
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + revolutions, 1))
    rows[HEALTHY_REVOLUTIONS:, 1] *= np.linspace(1.0, 3.0, revolutions)
    watch, reports = watched(49.9, np.zeros_like, revolutions=revolutions, vectors=rows)
    assert watch.finish().line is None
    assert all(one.identification is None or one.identification.line is None for one in reports)


def test_a_fault_is_named_beside_a_weaker_line():
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 400, 1))
    rows[HEALTHY_REVOLUTIONS:, 1] *= 2.0
    watch, _ = watched(TWO_POLE_HZ, round_line(150.7, 3.0), vectors=rows)
    assert watch.finish().line.order == pytest.approx(150.7 / TWO_POLE_HZ, abs=0.001)
    watch, _ = watched(TWO_POLE_HZ, round_line(100.0, 3.0), vectors=rows)
    found = watch.finish()
    assert found.line.mains == 2
    assert not found.line.is_the_change
    assert found.evidence["unbalance"] > found.evidence["static_load"]


def test_a_line_that_was_there_before_is_no_news():
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 200, 1))
    rows[HEALTHY_REVOLUTIONS:, 1] *= 2.0
    watch, _ = watched(24.7, round_line(35.0, 3.0), revolutions=200, vectors=rows, before=1.0)
    assert watch.finish().line is None
    watch, _ = watched(24.7, round_line(35.0, 3.0), revolutions=200, vectors=rows)
    assert watch.finish().line.frequency_hz == pytest.approx(35.0, abs=0.05)


def test_what_modulates_1x_is_no_line_beside_it():
    def hunting(t):
        whirl = abs(HEALTHY[1]) * np.exp(2j * math.pi * TWO_POLE_HZ * t)
        return 0.4 * np.sin(2.0 * math.pi * 0.9 * t) * whirl

    watch, _ = watched(TWO_POLE_HZ, hunting)
    found = watch.finish()
    assert found is not None
    assert found.line is None


def test_a_speed_that_is_only_stated_makes_no_line_of_1x():
    # The shaft turns at 50.1 Hz, and 49.6 Hz are stated, within 1 %.
    def turning(t):
        return 30.0 * (np.exp(2j * math.pi * 50.1 * t) - np.exp(2j * math.pi * 49.6 * t))

    watch, _ = watched(49.6, turning, rules=WatchRules(speed_uncertainty=0.01))
    found = watch.finish()
    assert found is None or found.line is None
    watch, _ = watched(49.6, turning)
    assert watch.finish().line is not None


def test_missing_samples_do_not_hide_the_mains():
    rng = np.random.default_rng(8)
    missing = rng.random((HEALTHY_REVOLUTIONS + 400) * PER_REV) < 0.02
    watch, _ = watched(TWO_POLE_HZ, flat_line(50.0, 6.0), missing=missing)
    found = watch.finish()
    assert found.group == ("unmodelled",)
    assert found.line.mains == 1


def test_a_machine_without_the_mains_again_is_healthy_again():
    line = flat_line(50.0, 8.0)
    gone_s = (HEALTHY_REVOLUTIONS + 200) / TWO_POLE_HZ
    watch, reports = watched(TWO_POLE_HZ, lambda t: np.where(t < gone_s, line(t), 0.0), revolutions=1400)
    assert reports[-1].state == "watching"
    assert watch.finish() is None


def test_faults_named_after_the_mains_have_gone_are_those_of_the_rotor():
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 1200, 1))
    rows[HEALTHY_REVOLUTIONS + 200 :, 1] *= 2.0
    line = flat_line(50.0, 8.0)
    gone_s = (HEALTHY_REVOLUTIONS + 200) / TWO_POLE_HZ
    watch, _ = watched(
        TWO_POLE_HZ, lambda t: np.where(t < gone_s, line(t), 0.0), revolutions=1200, vectors=rows
    )
    assert "unbalance" in watch.finish().group


def test_positions_lie_on_one_grid_whatever_the_revolutions_are_long():
    kept = LastPositions(1000.0)
    rng = np.random.default_rng(4)
    z = rng.standard_normal(40_000) + 1j * rng.standard_normal(40_000)
    at, revolution, lost = 17, 0, []
    while at < 39_000:
        length = int(rng.integers(99, 104))
        revolution += 1
        if revolution % 50 == 0:
            lost.append((at, at + length))
        else:
            kept.add(revolution, at, np.arange(length) / length, z[at : at + length])
        at += length
    stretch = kept.stretch(1, revolution + 1)
    each = stretch.averaged
    assert each == 3
    assert stretch.rate_hz == pytest.approx(1000.0 / 3)
    first = -(-17 // each) * each
    expected = z[first : first + each * len(stretch.z)].reshape(-1, each).mean(axis=1)
    assert np.allclose(stretch.z[stretch.there], expected[stretch.there], atol=1e-6)
    gone = ~stretch.there
    inside = np.zeros(len(gone), dtype=bool)
    for begin, end in lost:
        inside[max(0, (begin - first) // each) : -(-(end - first) // each)] = True
    assert gone.any()
    assert not (gone & ~inside).any()
    turns = stretch.turns[stretch.there]
    assert (np.diff(turns) > 0.0).all()
    assert stretch.revolutions == pytest.approx(revolution - 1, abs=2.0)


def test_too_many_missing_samples_are_no_stretch():
    kept = LastPositions(1000.0)
    z = np.full(32, np.nan, dtype=np.complex128)
    for revolution in range(1, 20):
        kept.add(revolution, 32 * revolution, np.arange(32) / 32, z)
    assert kept.stretch(1, 20) is None
    assert kept.stretch(100, 120) is None


def test_orbits_cut_elsewhere_are_the_same():
    """A watch that is handed revolution by revolution sees what it sees of all at once."""
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 300, 1))
    cut = orbits(rows, NOISE_UM, 5)
    t = np.arange(len(cut.xy)) / (PER_REV * TWO_POLE_HZ)
    motion = np.where(t * TWO_POLE_HZ < HEALTHY_REVOLUTIONS, 0.0, flat_line(50.0, 6.0)(t))
    cut = replace(cut, xy=cut.xy + np.column_stack((motion.real, motion.imag)))
    vectors = synchronous_vectors(cut)
    rotor = replace(ROTOR, natural_frequency_hz=TWO_POLE_HZ)
    together, apart = (RotorWatch(rotor, PER_REV * TWO_POLE_HZ) for _ in range(2))
    together.evaluate(vectors, cut)
    for i in range(len(vectors)):
        part = slice(PER_REV * i, PER_REV * (i + 1))
        one = Revolutions(
            first_index=PER_REV * i,
            xy=cut.xy[part],
            angle_rad=cut.angle_rad[part],
            starts=np.zeros(1, dtype=np.int64),
            period_samples=cut.period_samples[i : i + 1],
            trusted=cut.trusted[i : i + 1],
        )
        apart.evaluate(vectors[i : i + 1], one)
    assert together.finish().line == apart.finish().line
    assert together.finish().line.mains == 1


@pytest.fixture
def hum(tmp_path):
    """A recording of 16 s in which cables pick up the mains after 5 s."""
    rate_hz, rng = 3200.0, np.random.default_rng(1)
    t = np.arange(int(16 * rate_hz)) / rate_hz
    angle = 2.0 * math.pi * TWO_POLE_HZ * t
    z = 20.0 * np.exp(1j * angle) - 10.0j
    z += 2.0 * (rng.standard_normal(len(t)) + 1j * rng.standard_normal(len(t)))
    z += np.where(t > 5.0, flat_line(49.99, 6.0)(t), 0.0)
    mark = np.where(angle % (2.0 * math.pi) < 0.2, 5.0, 0.0)
    np.savez(tmp_path / "hum.npz", x=z.real, y=z.imag, kph=mark, fs=rate_hz)
    known = ["--natural-frequency-hz", "60", "--damping-ratio", ".1", "--clearance-um", "150"]
    return ["analyze", str(tmp_path / "hum.npz"), "--probes", "x,y", "--keyphasor", "kph", *known]


def test_a_recording_of_hum_is_told_as_hum(hum, capsys):
    assert main([*hum, "--json"]) == 0
    document = fits("daqsvc analyze", json.loads(capsys.readouterr().out))
    assert (document["verdict"], document["group"]) == ("unmodelled", ["unmodelled"])
    line = document["line"]
    assert line["frequency_hz"] == pytest.approx(49.99, abs=0.02)
    assert line["order"] == pytest.approx(49.99 / TWO_POLE_HZ, abs=0.001)
    assert line["mains"] == 1
    assert line["forward"] in {True, False}
    assert document["level"]["unmodelled"]["nonsynchronous_um"] == pytest.approx(
        line["amplitude_um"] / math.sqrt(2.0), rel=0.01
    )
    assert main(hum) == 0
    output = capsys.readouterr().out
    assert "hum.npz: unmodelled (above 99.9 %)" in output
    assert "um at 49.99 Hz (1.008X) came with the change: the mains, as cables pick them up" in output
