"""Lines beside the shaft's harmonics: found, told from what they look like, and the mains named as that."""

from __future__ import annotations

import json
import math
import re
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


BESIDE = [
    (TWO_POLE_HZ, 49.97, 1, flat_line),  # beside 1X
    (TWO_POLE_HZ, 49.97, 0, round_line),  # another machine: cables give both probes the same
    (TWO_POLE_HZ, 100.05, 2, flat_line),  # beside 2X
    (TWO_POLE_HZ, 100.05, 2, round_line),
    (24.7, 100.0, 2, flat_line),  # beside 4X
    (24.7, 100.0, 2, round_line),
    (24.7, 50.0, 1, flat_line),  # beside 2X
    (59.4, 120.1, 2, round_line),
    (83.0, 50.0, 1, flat_line),  # below 1X
    (31.3, 32.6, 0, round_line),  # another machine
]


@pytest.mark.parametrize("um", [4.0, 12.0])
@pytest.mark.parametrize(("shaft_hz", "hz", "mains", "line"), BESIDE)
def test_what_is_not_the_rotors_is_named_as_that(shaft_hz, hz, mains, um, line):
    watch, reports = watched(shaft_hz, line(hz, um), revolutions=700)
    found = watch.finish()
    assert found.group == ("unmodelled",)
    assert found.named
    assert found.by_line
    assert found.line.mains == mains
    assert found.line.forward is (None if line is flat_line else True)
    assert found.line.frequency_hz == pytest.approx(hz, abs=0.04)
    assert found.line.order == pytest.approx(hz / shaft_hz, abs=0.001)
    rms = um if line is round_line else um * math.sqrt(1.09 / 2.0)
    assert found.line.amplitude_um == pytest.approx(rms, rel=0.08)
    # It beats for ever, and is one alarm all the same, by the time that it is known ...
    slow = 3.0 / abs(hz / shaft_hz - 1.0) if mains == 0 else 60
    late = [one for one in reports if one.revolution > HEALTHY_REVOLUTIONS + max(slow, 100)]
    assert late
    assert not any(report.departed for report in late)
    # ... and nothing of the rotor is named any more.
    assert {one.identification.group for one in late} == {("unmodelled",)}


@pytest.mark.parametrize(("shaft_hz", "hz", "mains", "line"), BESIDE)
def test_a_fault_that_comes_after_a_line_is_named(shaft_hz, hz, mains, line):
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 1000, 1))
    begin = HEALTHY_REVOLUTIONS + 600
    rows[begin:, 1] *= 1.5
    watch, reports = watched(shaft_hz, line(hz, 8.0), vectors=rows, revolutions=1000)
    before = next(one for one in reports if one.revolution == begin - 1)
    assert before.identification.group == ("unmodelled",)
    found = watch.finish()
    assert "unbalance" in found.group
    assert "unmodelled" not in found.group
    assert not found.by_line
    assert found.line.mains == mains
    assert found.line.frequency_hz == pytest.approx(hz, abs=0.1)
    assert abs(found.change[1]) == pytest.approx(0.5 * abs(HEALTHY[1]), rel=0.1)
    again = [one.revolution for one in reports if one.departed and one.revolution > begin]
    assert len(again) <= 2


@pytest.mark.parametrize(("shaft_hz", "hz", "mains", "line"), BESIDE)
def test_a_fault_that_comes_with_a_line_is_named(shaft_hz, hz, mains, line):
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 600, 1))
    rows[HEALTHY_REVOLUTIONS:, 0] += 8.0j
    watch, _ = watched(shaft_hz, line(hz, 8.0), vectors=rows, revolutions=600)
    found = watch.finish()
    assert "static_load" in found.group
    assert found.line.mains == mains


@pytest.mark.parametrize(
    ("shaft_hz", "hz", "line"),
    [(41.0, 50.0, flat_line), (83.0, 50.0, flat_line), (41.0, 100.0, round_line), (33.0, 50.0, flat_line)],
)
def test_a_line_from_the_beginning_hides_no_fault(shaft_hz, hz, line):
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 400, 1))
    rows[HEALTHY_REVOLUTIONS:, 0] += 6.0j
    watch, _ = watched(shaft_hz, line(hz, 9.0), vectors=rows, before=1.0)
    found = watch.finish()
    assert "static_load" in found.group
    assert found.line is None


@pytest.mark.parametrize(
    ("shaft_hz", "order"), [(100.0, 0.5), (120.0, 0.5), (150.0, 1 / 3), (40.0, 1.5), (20.0, 2.5)]
)
def test_what_a_rub_leaves_at_a_part_of_the_speed_is_not_called_the_mains(shaft_hz, order):
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 400, 1))
    rows[HEALTHY_REVOLUTIONS:, 1] *= 1.2
    rows[HEALTHY_REVOLUTIONS:, 3] += 2.0
    watch, _ = watched(shaft_hz, flat_line(order * shaft_hz, 20.0), vectors=rows)
    found = watch.finish()
    assert found.line.order == pytest.approx(order, abs=0.002)
    assert found.line.mains == 0
    assert not found.by_line
    assert "the mains have this frequency, too" in found.line.describe()


@pytest.mark.parametrize(("shaft_hz", "hz"), [(106.4, 50.04), (133.0, 60.0), (83.0, -50.0)])
def test_a_whirl_at_their_frequency_is_not_called_the_mains(shaft_hz, hz):
    watch, _ = watched(shaft_hz, round_line(hz, 30.0))
    found = watch.finish()
    assert (found.line.mains, found.line.forward) == (0, hz > 0)
    assert not found.by_line
    assert "the mains have this frequency, too" in found.line.describe()


@pytest.mark.parametrize("phase", [0.0, 0.2])
def test_poles_that_pass_modulate_1x_and_are_no_unbalance(phase):
    whirl = HEALTHY[1]

    def passing(t):
        swing = np.sin(2.0 * math.pi * 0.8 * t)
        modulated = (1.0 + 0.3 * swing) * np.exp(1j * phase * swing)
        return whirl * np.exp(2j * math.pi * TWO_POLE_HZ * t) * (modulated - 1.0)

    watch, reports = watched(TWO_POLE_HZ, passing, revolutions=900)
    found = watch.finish()
    assert found.group == ("unmodelled",)
    assert found.by_line
    assert (found.line.modulates, found.line.poles) == (1, 2)
    assert re.match("1X is modulated at 0.(79|80|81) Hz since the change, by lines of", found.line.describe())
    assert "as often as the poles of an induction motor of 2 poles pass" in found.line.describe()
    late = [one for one in reports if one.revolution > HEALTHY_REVOLUTIONS + 350]
    assert not any(report.departed for report in late)


def test_what_is_said_of_a_line():
    watch, _ = watched(TWO_POLE_HZ, flat_line(50.0, 4.0))
    sentence = watch.finish().line.describe()
    assert "X) came with the change: these are the mains, as cables pick them up" in sentence
    watch, _ = watched(TWO_POLE_HZ, round_line(100.0, 4.0))
    assert "it is at twice the mains, as an induction motor pulls" in watch.finish().line.describe()
    watch, _ = watched(TWO_POLE_HZ, round_line(-0.47 * TWO_POLE_HZ, 6.0))
    sentence = watch.finish().line.describe()
    assert "X) came with the change: it goes backward, at no harmonic of the shaft" in sentence
    assert "mains" not in sentence


def test_a_whirl_is_a_line_with_its_sense_and_stays_unmodelled():
    watch, _ = watched(TWO_POLE_HZ, round_line(0.47 * TWO_POLE_HZ, 6.0))
    found = watch.finish()
    assert found.verdict == "unmodelled"
    assert found.line.forward
    assert found.line.mains == 0
    assert found.line.order == pytest.approx(0.47, abs=0.001)
    assert not found.by_line  # what whirls is for a person to say


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


def test_a_line_that_was_there_before_is_no_news():
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 200, 1))
    rows[HEALTHY_REVOLUTIONS:, 1] *= 2.0
    watch, _ = watched(24.7, round_line(35.0, 3.0), revolutions=200, vectors=rows, before=1.0)
    assert watch.finish().line is None
    watch, _ = watched(24.7, round_line(35.0, 3.0), revolutions=200, vectors=rows)
    assert watch.finish().line.frequency_hz == pytest.approx(35.0, abs=0.05)


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
            z[at : at + length] = np.nan
        kept.add(revolution, at, np.arange(length) / length, z[at : at + length])
        at += length
    stretch = kept.stretch(1, revolution + 1)
    each = stretch.averaged
    assert each == 3
    assert stretch.rate_hz == pytest.approx(1000.0 / 3)
    first = -(-17 // each) * each
    blocks = z[first : first + each * len(stretch.z)].reshape(-1, each)
    known = np.isfinite(blocks)
    whole, none = known.all(axis=1), ~known.any(axis=1)
    assert np.allclose(stretch.z[whole], blocks[whole].mean(axis=1), atol=1e-6)
    assert none.any()
    assert not stretch.there[none].any()
    assert len(lost) > 5
    turns = stretch.turns[stretch.there]
    assert (np.diff(turns) > 0.0).all()
    assert stretch.revolutions == pytest.approx(revolution - 1, abs=2.0)


def test_revolutions_that_nobody_counted_end_a_stretch():
    kept = LastPositions(1000.0)
    z = np.ones(32, dtype=np.complex128)
    for revolution in range(1, 101):
        lost = 40 if revolution > 60 else 0
        kept.add(revolution, 32 * (revolution + lost), np.arange(32) / 32, z)
    assert kept.stretch(1, 101).revolutions == pytest.approx(40.0, abs=0.1)
    for revolution in range(101, 121):
        kept.add(revolution, 32 * revolution, np.arange(32) / 32, z)  # the stream has begun again
    assert kept.stretch(1, 121).revolutions == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize("jump", [40, -100, -1, 10**7])
def test_a_gap_leaves_a_line_where_it_is(jump):
    """Revolutions that are lost between two blocks have no number."""
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 700, 1))
    cut = orbits(rows, NOISE_UM, 5)
    at = np.arange(len(cut.xy))
    begin = (HEALTHY_REVOLUTIONS + 300) * PER_REV
    index = np.where(at < begin, at, at + jump * PER_REV)
    motion = np.where(at < HEALTHY_REVOLUTIONS * PER_REV, 0.0, 8.0) * np.exp(
        2j * math.pi * 100.0 * (index % (1000 * PER_REV)) / (PER_REV * TWO_POLE_HZ)
    )
    cut = replace(cut, xy=cut.xy + np.column_stack((motion.real, motion.imag)))
    vectors = synchronous_vectors(cut)
    watch = RotorWatch(replace(ROTOR, natural_frequency_hz=TWO_POLE_HZ), PER_REV * TWO_POLE_HZ)
    reports = watch.evaluate(vectors[: begin // PER_REV], part_of(cut, 0, begin, 0))
    reports += watch.evaluate(vectors[begin // PER_REV :], part_of(cut, begin, len(at), index[begin]))
    found = watch.finish()
    assert found.by_line
    assert found.line.order == pytest.approx(100.0 / TWO_POLE_HZ, abs=0.002)
    assert not any(one.departed for one in reports if one.revolution > HEALTHY_REVOLUTIONS + 300)


def part_of(cut, begin, end, first_index):
    """Some of the revolutions of an orbit, with another index of the first sample."""
    return Revolutions(
        first_index=int(first_index),
        xy=cut.xy[begin:end],
        angle_rad=cut.angle_rad[begin:end],
        starts=np.arange((end - begin) // PER_REV, dtype=np.int64) * PER_REV,
        period_samples=cut.period_samples[begin // PER_REV : end // PER_REV],
        trusted=cut.trusted[begin // PER_REV : end // PER_REV],
    )


def test_a_line_that_has_ended_is_forgotten_soon():
    for hz, line, ended in ((50.0, flat_line, 250), (100.0, round_line, 600), (50.0, flat_line, 600)):
        ended_s = (HEALTHY_REVOLUTIONS + ended) / TWO_POLE_HZ
        motion = line(hz, 8.0)
        watch, reports = watched(
            TWO_POLE_HZ, lambda t, m=motion, e=ended_s: np.where(t < e, m(t), 0.0), revolutions=ended + 700
        )
        back = next(
            one.revolution
            for one in reports
            if one.revolution > HEALTHY_REVOLUTIONS + ended and one.state == "watching"
        )
        assert back - HEALTHY_REVOLUTIONS - ended < 320
        assert watch.finish() is None
        after = [
            one.identification.group
            for one in reports
            if one.revolution > HEALTHY_REVOLUTIONS + ended and one.identification is not None
        ]
        assert set(after) <= {("unmodelled",), ("small_change",)}


def test_faults_beside_a_line_are_changes_of_their_own():
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 1800, 1))
    for begin in (600, 1200):
        rows[HEALTHY_REVOLUTIONS + begin : HEALTHY_REVOLUTIONS + begin + 300, 1] *= 1.5
    watch, reports = watched(TWO_POLE_HZ, round_line(100.0, 8.0), vectors=rows, revolutions=1800)
    assert watch.finish().by_line
    steps = [
        (one.revolution - HEALTHY_REVOLUTIONS, one.identification.verdict)
        for one in reports
        if one.departed and one.identification is not None and one.identification.line is not None
    ]
    assert [name for _, name in steps[-4:]] == ["unbalance", "unmodelled"] * 2
    for (at, _), expected in zip(steps[-4:], (600, 900, 1200, 1500), strict=True):
        assert expected < at < expected + 200


def test_a_whip_at_twice_the_mains_is_no_motor():
    rows = np.tile(HEALTHY, (HEALTHY_REVOLUTIONS + 400, 1))
    rows[HEALTHY_REVOLUTIONS:, 1] *= 1.2
    watch, _ = watched(58.46, round_line(-99.97, 40.0), vectors=rows)
    found = watch.finish()
    assert found.line.mains == 0
    assert "unmodelled" in found.group
    assert "the mains have this frequency, too" in found.line.describe()


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
    assert line["forward"] is None
    assert line["is_the_change"] is True
    assert document["level"]["unmodelled"]["nonsynchronous_um"] == pytest.approx(
        line["amplitude_um"] / math.sqrt(2.0), rel=0.01
    )
    assert main(hum) == 0
    output = capsys.readouterr().out
    assert "hum.npz: unmodelled (above 99.9 %)" in output
    assert "um at 49.99 Hz (1.008X) came with the change: these are the mains, as cables pick" in output
    assert "pick them up; no fault of the rotor" in output
    # Without a mean position rub and unmodelled changes are one group, but this is none of them.
    assert main([*hum, "--ac-coupled", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["group"] == ["unmodelled"]


@pytest.mark.parametrize("per_rev", [8, 10, 12, 16, 33])
def test_few_samples_a_revolution_are_enough(per_rev):
    """Twelve show the sixth harmonic and its opposite alike."""
    count = HEALTHY_REVOLUTIONS + 400
    cut = orbits(np.tile(HEALTHY, (count, 1)), 1.0, 3, per_rev=per_rev)
    t = np.arange(count * per_rev) / (per_rev * TWO_POLE_HZ)
    motion = np.where(t * TWO_POLE_HZ < HEALTHY_REVOLUTIONS, 0.0, flat_line(50.0, 6.0)(t))
    cut = replace(cut, xy=cut.xy + np.column_stack((motion.real, motion.imag)))
    watch = RotorWatch(replace(ROTOR, natural_frequency_hz=TWO_POLE_HZ), per_rev * TWO_POLE_HZ)
    watch.evaluate(synchronous_vectors(cut), cut)
    found = watch.finish()
    assert found.group == ("unmodelled",)
    assert (found.by_line, found.line.mains) == (True, 1)
