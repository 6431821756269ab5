"""Streams on one grid: what comes out is the signal at the right instants, or is missing."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.aligned_streams import Device, aligned
from support.examples import examples

from daqsvc.acquisition.alignment import AlignedSource, Aligner
from daqsvc.acquisition.alignment_source import FractionalDelay
from daqsvc.acquisition.ring import SampleRing
from daqsvc.acquisition.samples import Quality, SampleBlock

pytestmark = pytest.mark.property
START_NS = 10**15
WAIT_NS = 200_000_000


def blocks_of(
    stream, rate_hz, signal, cuts, *, offset_ns=0, first_index=0, error_ns=0.0, lost=(), latency_ns=0
):
    """Blocks between ``cuts`` of a signal that is a function of the time in ns after the start.

    The time base is exact but for the latency. What lies in ``lost``, pairs of sample numbers, is lost.
    """
    period_ns = 1e9 / rate_hz
    made, missing = [], 0
    for begin, end in pairwise(cuts):
        if any(a <= begin < b for a, b in lost):
            missing += end - begin
            continue
        t_ns = offset_ns + np.arange(begin, end) * period_ns
        made.append(
            SampleBlock(
                stream,
                first_index + begin,
                signal(t_ns).astype(np.float32)[:, None],
                START_NS + round(t_ns[0]) + latency_ns,
                period_ns,
                missing,
                t_error_ns=error_ns,
            )
        )
        missing = 0
    return made


def merged(*streams):
    """Blocks in the order in which their last sample is taken."""
    return sorted((b for s in streams for b in s), key=lambda b: b.t_first_ns + len(b.samples) * b.period_ns)


def sine(hz):
    return lambda t_ns: np.sin(2 * np.pi * hz * 1e-9 * t_ns)


def run(aligner_sources, blocks, **options):
    out = []
    aligner = Aligner("grid", aligner_sources, out.append, **{"max_wait_ns": WAIT_NS, **options})
    for block in blocks:
        aligner.accept(block)
    return aligner, out


def joined(out):
    end = out[0].first_index
    for block in out:
        assert block.first_index == end + block.lost_before
        end = block.first_index + len(block.samples)
    return np.concatenate([block.samples for block in out])


@given(
    band=st.floats(0.01, 0.4),
    phase=st.floats(0, 6.28),
    ratio=st.one_of(st.floats(0.1, 1.0), st.floats(1.0, 10.0)),
    begin=st.floats(0, 5),
)
def test_a_tone_up_to_0_4_of_the_lower_rate_is_interpolated_well(band, phase, ratio, begin) -> None:
    delay = FractionalDelay(ratio)
    per_sample = 2 * np.pi * band * min(ratio, 1.0)
    tone = np.sin(per_sample * np.arange(6 * delay.reach + 20) + phase).astype(np.float32)
    places = delay.reach + begin + np.arange(0, 3 * delay.reach, 1.0 / ratio)
    values = delay(tone[:, None], places)[:, 0]
    np.testing.assert_allclose(values, np.sin(per_sample * places + phase), atol=1e-4)


@given(ratio=st.floats(0.1, 0.8), above=st.floats(0.6, 2.0), phase=st.floats(0, 6.28))
def test_a_slower_grid_is_not_aliased_into(ratio, above, phase) -> None:
    """From 0.6 of the lower rate up to half the higher one nothing is left."""
    delay = FractionalDelay(ratio)
    per_sample = 2 * np.pi * min(above * ratio, 0.5)
    tone = np.sin(per_sample * np.arange(6 * delay.reach) + phase).astype(np.float32)
    places = delay.reach + np.arange(0, 3 * delay.reach, 1.0 / ratio)
    assert np.abs(delay(tone[:, None], places)).max() < 2e-4


@given(level=st.floats(-1e6, 1e6, width=32), places=st.lists(st.floats(20, 70), min_size=1))
def test_a_constant_stays_what_it_is(level, places) -> None:
    values = FractionalDelay()(np.full((100, 1), level, np.float32), np.array(places))
    np.testing.assert_allclose(values, level, rtol=2e-7)


@given(
    missing=st.sets(st.integers(0, 119), max_size=4),
    bad=st.sampled_from([np.nan, np.inf, -np.inf]),
    places=st.lists(st.floats(-50, 200), min_size=1, max_size=50),
    ratio=st.sampled_from([0.5, 1.0, 2.0]),
)
def test_a_value_is_missing_exactly_where_a_sample_around_it_is(missing, bad, places, ratio) -> None:
    delay = FractionalDelay(ratio)
    samples = np.ones((120, 2), np.float32)
    samples[sorted(missing), 0] = bad
    values = delay(samples, np.array(places))
    for place, value in zip(places, values, strict=True):
        around = range(math.floor(place) - delay.reach + 1, math.floor(place) + delay.reach + 1)
        inside = around.start >= 0 and around.stop <= 120
        assert np.isfinite(value[1]) == inside
        assert np.isfinite(value[0]) == (inside and not missing.intersection(around))


@st.composite
def cut(draw, n):
    inner = draw(st.lists(st.integers(1, n - 1), max_size=12, unique=True))
    return [0, *sorted(inner), n]


@settings(max_examples=examples(40))
@given(
    data=st.data(), rate_hz=st.floats(300, 3000), offset_ms=st.floats(-20, 20), latency_ms=st.floats(0, 30)
)
def test_rows_hold_the_signal_at_the_references_instants(data, rate_hz, offset_ms, latency_ms) -> None:
    """However the blocks are cut, at any two rates, with latencies that are known."""
    signal = sine(0.3 * min(rate_hz, 1000.0))
    cuts, latency_ns = data.draw(cut(math.ceil(rate_hz))), round(latency_ms * 1e6)
    a = blocks_of("a", 1000.0, signal, data.draw(cut(1000)), first_index=7)
    late = {"offset_ns": offset_ms * 1e6, "latency_ns": latency_ns}
    b = blocks_of("b", rate_hz, signal, cuts, first_index=-50, **late)
    sources = [AlignedSource("a", ("x",), 1000.0), AlignedSource("b", ("y",), rate_hz, latency_ns)]
    _, out = run(sources, merged(a, b), max_wait_ns=2_000_000_000)
    if not out:
        return  # nothing but one late block of everything
    rows = joined(out)
    # The grid begins with the latest block of the reference when there is one of the other stream.
    begin = out[0].first_index - 7
    assert begin in {block.first_index - 7 for block in a}
    true = signal((begin + np.arange(len(rows))) * 1e6)
    np.testing.assert_allclose(rows[:, 0], true, atol=1e-6)
    there = np.isfinite(rows[:, 1])
    np.testing.assert_allclose(rows[there, 1], true[there], atol=2e-3)
    # Missing only at the begin, where the filter lacks samples.
    lead_s = 17.0 / min(rate_hz, 1000.0) + max(offset_ms, 0.0) / 1e3
    assert there[max(0, math.ceil(lead_s * 1000.0) - begin) :].all()


@settings(max_examples=examples(40))
@given(gap=st.integers(0, 60), length=st.integers(1, 10))
def test_what_is_lost_is_missing_for_the_reach_of_the_filter_and_no_longer(gap, length) -> None:
    cuts = list(range(0, 1001, 10))
    lost = [(300 + 10 * (gap % 30), 300 + 10 * (gap % 30) + 10 * length)]
    a = blocks_of("a", 1000.0, sine(50.0), cuts)
    b = blocks_of("b", 1000.0, sine(50.0), cuts, lost=lost, offset_ns=250_000)
    sources = [AlignedSource("a", ("x",), 1000.0), AlignedSource("b", ("y",), 1000.0)]
    aligner, out = run(sources, merged(a, b))
    rows = joined(out)
    # Row k lies between samples k - 1 and k of the other stream, and rests on 16 of them either way.
    begin, end = lost[0]
    missing = np.flatnonzero(~np.isfinite(rows[17:, 1])) + 17
    np.testing.assert_array_equal(missing, np.arange(begin - 15, end + 16))
    assert aligner.counters["b"].rows_missing == int(np.isnan(rows[:, 1]).sum())
    assert np.isfinite(rows[:, 0]).all()


@pytest.mark.parametrize("dead", ["a", "b"])
def test_a_dead_stream_is_not_waited_for_and_is_taken_in_when_it_is_back(dead) -> None:
    """From 1 s to 3 s one of the streams is silent, the reference or the other one."""
    cuts = list(range(0, 5001, 10))
    lost = {dead: [(1000, 3000)]}
    signal = sine(50.0)
    a = blocks_of("a", 1000.0, signal, cuts, lost=lost.get("a", []))
    b = blocks_of("b", 1000.0, signal, cuts, lost=lost.get("b", []), offset_ns=250_000)
    out = []
    sources = [AlignedSource("a", ("x",), 1000.0), AlignedSource("b", ("y",), 1000.0)]
    aligner = Aligner("grid", sources, out.append, max_wait_ns=WAIT_NS)
    furthest = 0
    for block in merged(a, b):
        aligner.accept(block)
        now = (block.t_first_ns - START_NS) // 1_000_000 + len(block.samples)
        furthest = max(furthest, now - (out[-1].first_index + len(out[-1].samples)) if out else 0)
    # Rows are behind by what a stream may be late, the reach of the filter, and a block or two.
    assert furthest <= 200 + 16 + 40
    rows = joined(out)
    column = "ab".index(dead)
    silent = np.isnan(rows[:, column])
    assert silent[1020:2980].all()
    assert not silent[3020:].any()
    assert np.isfinite(rows[17:, 1 - column]).all()
    true = signal(np.arange(len(rows)) * 1e6)
    for samples in rows.T:
        there = np.isfinite(samples)
        np.testing.assert_allclose(samples[there], true[there], atol=2e-3)


@pytest.mark.parametrize("restarted", ["a", "b"])
def test_where_the_reference_goes_on_at_a_guess_a_row_is_a_break(restarted) -> None:
    """Of another stream only the instants count, and those its time base tells."""
    cuts = list(range(0, 2001, 10))
    streams = {
        name: [
            replace(block, quality=Quality.PLACE_ESTIMATED)
            if name == restarted and block.first_index == 1230
            else block
            for block in blocks_of(name, 1000.0, sine(50.0), cuts, lost=[(1000, 1230)])
        ]
        for name in "ab"
    }
    sources = [AlignedSource(name, ("x",), 1000.0) for name in "ab"]
    _, out = run(sources, merged(*streams.values()))
    assert len(joined(out)) > 1500
    breaks = [block.first_index for block in out if block.as_block().quality & Quality.PLACE_ESTIMATED]
    assert breaks == ([1230] if restarted == "a" else [])


def test_an_hour_without_anything_is_not_written_row_by_row() -> None:
    hour = 3_600_000
    cuts = [*range(0, 1001, 10), *range(hour, hour + 1001, 10)]
    sources = [AlignedSource(name, ("x",), 1000.0) for name in "ab"]
    streams = [blocks_of(name, 1000.0, sine(50.0), cuts, lost=[(1000, hour)]) for name in "ab"]
    aligner, out = run(sources, merged(*streams))
    rows = joined(out)
    assert len(rows) < 20_000
    assert sum(block.lost_before for block in out) > hour - 20_000
    assert np.isfinite(rows[-900:]).all()
    # And a ring takes it: every index is the reference's.
    ring = SampleRing("grid", aligner.channels, 5000)
    for block in out:
        ring.write(block.as_block())
    assert ring.end_index == out[-1].first_index + len(out[-1].samples)
    np.testing.assert_array_equal(ring.read(ring.end_index - 900, 900), rows[-900:])


@pytest.mark.gives("B39")
def test_samples_that_nobody_can_place_are_left_out_and_said_so(caplog: pytest.LogCaptureFixture) -> None:
    cuts = list(range(0, 100_001, 50))
    sources = [AlignedSource(name, ("x",), 1000.0) for name in "ab"]
    a = blocks_of("a", 1000.0, sine(50.0), cuts, error_ns=150e3)
    b = blocks_of("b", 1000.0, sine(50.0), cuts, error_ns=200e3)
    aligner, out = run(sources, merged(a, b))
    rows = joined(out)
    assert np.isnan(rows[:, 1]).all()
    assert np.isfinite(rows[:, 0]).all()
    assert {block.quality for block in out} == {Quality.TIME_UNSETTLED}
    assert aligner.error_ns["b"] == pytest.approx(math.hypot(150e3, 200e3), rel=0.1)
    assert aligner.counters["b"].rows_withheld == len(rows)
    # The grid did not wait for ever for them.
    assert out[0].first_index == pytest.approx(30_000, abs=100)
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 1
    assert "stream 'b' can be put on the grid of 'a' to 25" in told[0]
    assert "max_error_us = 200" in told[0]
    _, out = run(sources, merged(a, b), max_error_ns=400e3)
    assert np.isfinite(joined(out)[17:]).all()


def test_what_the_time_bases_learn_makes_no_step_in_the_signal() -> None:
    """The other stream's clock is found to be 150 us off at once: the rows glide there."""
    cuts = list(range(0, 8001, 10))
    a = blocks_of("a", 1000.0, sine(20.0), cuts)
    b = [
        replace(block, t_first_ns=block.t_first_ns + 150_000 * (block.first_index >= 3000))
        for block in blocks_of("b", 1000.0, sine(20.0), cuts, error_ns=50e3)
    ]
    _, out = run([AlignedSource(name, ("x",), 1000.0) for name in "ab"], merged(a, b))
    rows = joined(out)
    phases = [np.unwrap(np.angle(demodulated(column))) for column in rows.T]
    late_us = (phases[0] - phases[1]) / (2e-6 * np.pi * 20.0)
    assert abs(late_us[2000]) < 2.0
    assert abs(np.diff(late_us[500:7500])).max() < 2.0  # no more than 1 us in 1 ms
    assert late_us[-200] == pytest.approx(150.0, abs=5.0)
    # And the error says so while it does.
    errors = np.concatenate([np.full(len(block.samples), block.error_ns[1]) for block in out])
    assert errors[2000] < 60e3
    assert errors[3100:3200].min() > 100e3
    assert errors[-200] < 60e3


def demodulated(samples):
    """Complex amplitude of 20 Hz over a turn of it, row by row."""
    turning = samples[17:] * np.exp(-2j * np.pi * 20.0e-3 * np.arange(len(samples) - 17))
    return np.convolve(turning, np.ones(50) / 50.0, mode="valid")


@pytest.mark.long
@settings(max_examples=examples(6))
@given(seed=st.integers(0, 2**31), ppm=st.floats(-50, 50), lost=st.floats(0, 0.05))
def test_devices_with_clocks_of_their_own_end_up_on_one_grid(seed, ppm, lost) -> None:
    """Through time bases that have only late arrivals to go by."""
    devices = [
        Device("a", 1600.0, ppm, lost=lost),
        Device("b", 2000.0, -ppm, lost=lost, latency_ns=3e6, begins_ns=5_001_234_567.0),
    ]
    _, rows = aligned(devices, sine(25.0), 14.0, seed, max_error_ns=1e6)
    late = rows.samples[-3200:]
    there = np.isfinite(late).all(axis=1)
    assert there.mean() > (1 - lost) ** 8 - 0.2
    slope = 2 * np.pi * 25.0
    error_s = np.abs(late[there, 1] - late[there, 0]).max() / slope
    assert error_s < 300e-6


@pytest.mark.parametrize("names", [["a"], ["a", "a"]])
def test_a_grid_needs_two_different_streams(names) -> None:
    with pytest.raises(ValueError, match="name two or more streams"):
        Aligner("grid", [AlignedSource(name, ("x",), 100.0) for name in names], print)
