"""A counter that goes on where it should not: only the host's clock tells, and late frames must not."""

import itertools
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.acquisition.timebase import TimeBase

pytestmark = pytest.mark.property
RATE_HZ = 1000.0
PER_FRAME = 10
FRAME_NS = 10_000_000
START_NS = 3_000_000_000
JITTER_NS = 2_000_000
TICK_NS = 50_000_000


@dataclass
class Frames:
    """What a device sends: its counter in frames, when its last sample was taken, and when it arrives."""

    counter: np.ndarray
    taken_ns: np.ndarray
    arrival_ns: np.ndarray


def sent(first: int, seconds: float, at_s: float, seed: int, ppm: float = 0.0) -> Frames:
    """Frames from counter ``first`` on, that a device sends from ``at_s`` on."""
    n = round(seconds * RATE_HZ / PER_FRAME)
    taken = START_NS + round(at_s * NS_PER_S) + np.rint(np.arange(1, n + 1) * FRAME_NS / (1 + ppm * 1e-6))
    late = np.random.default_rng(seed).uniform(0, JITTER_NS, n)
    arrival = np.maximum.accumulate(taken + late).astype(np.int64)
    return Frames(first + np.arange(n), taken.astype(np.int64), arrival)


def delayed(frames: Frames, until_s: float, speed: float, since_s: float = 0.0) -> Frames:
    """Frames that wait from ``since_s`` until ``until_s``, and then come ``speed`` times as fast as sent."""
    until_ns = START_NS + round(until_s * NS_PER_S)
    held = frames.arrival_ns >= START_NS + round(since_s * NS_PER_S)
    queue_ns = until_ns + np.cumsum(held) * (FRAME_NS / speed)
    arrival = np.where(held, np.maximum(frames.arrival_ns, queue_ns), frames.arrival_ns)
    return Frames(frames.counter, frames.taken_ns, np.maximum.accumulate(arrival).astype(np.int64))


def play(*parts: Frames, batch: int = 1, bits: int = 32) -> tuple[StreamAssembler, list[SampleBlock]]:
    """The frames through an assembler; a sample's value is the time at which it was taken, in ms."""
    blocks: list[SampleBlock] = []
    unit = StreamAssembler(
        "s",
        RATE_HZ,
        counter_bits=bits,
        samples_per_frame=PER_FRAME,
        counts_per_frame=1,
        deliver=blocks.append,
    )
    counter = np.concatenate([part.counter for part in parts])
    arrival_ns = np.concatenate([part.arrival_ns for part in parts])
    taken_ms = (np.concatenate([part.taken_ns for part in parts]) - START_NS) / 1e6
    values = taken_ms[:, None] - np.arange(PER_FRAME - 1, -1, -1)
    ticked_ns = int(arrival_ns[0])
    for at in range(0, len(counter), batch):
        some = slice(at, at + batch)
        n = len(counter[some])
        while ticked_ns < arrival_ns[some][0]:
            unit.tick(ticked_ns)
            ticked_ns += TICK_NS
        unit.accept(
            counter[some] % 2**bits,
            values[some, :, None].astype(np.float32),
            np.ones(n, bool),
            arrival_ns[some],
        )
    unit.flush()
    return unit, blocks


def off_ns(block: SampleBlock) -> float:
    """By how much the block's first sample is stamped too late."""
    return block.t_first_ns - START_NS - float(block.samples[0, 0]) * 1e6


def check_order(unit: StreamAssembler, blocks: list[SampleBlock]) -> None:
    for before, after in itertools.pairwise(blocks):
        assert after.first_index == before.end_index + after.lost_before
    span = blocks[-1].end_index - blocks[0].first_index
    assert span == unit.counters.samples_received + unit.counters.samples_lost


@settings(deadline=None, max_examples=examples(25))
@given(
    seed=st.integers(0, 2**31),
    ran_s=st.floats(3.0, 20.0),
    away_s=st.floats(2.0, 60.0),
    beyond=st.integers(-1, 3000),
    batch=st.sampled_from([1, 3, 40]),
    bits=st.sampled_from([16, 32]),
    backlog_s=st.sampled_from([0.0, 0.04, 0.3]),
)
def test_a_device_that_has_counted_past_its_old_count_is_found_to_have_restarted(
    seed, ran_s, away_s, beyond, batch, bits, backlog_s
) -> None:
    """At any count that the time away does not explain; -1 is a device that stopped counting meanwhile.

    What it has in its buffer when somebody listens again comes at once.
    """
    before = sent(0, ran_s, 0.0, seed)
    first = len(before.counter) + 1 + beyond
    away_frames = away_s * RATE_HZ / PER_FRAME
    if abs(first - len(before.counter) - away_frames) < 140:
        return  # about what it would have counted
    after = sent(first, 6.0, ran_s + away_s, seed + 1)
    after = delayed(after, ran_s + away_s + backlog_s, 1000.0)
    unit, blocks = play(before, after, batch=batch, bits=bits)
    assert unit.time_base.restarts == 1
    assert unit.counters.frames_rejected == 0
    check_order(unit, blocks)
    lost = unit.counters.samples_lost
    assert abs(lost - away_s * RATE_HZ) < 0.004 * away_s * RATE_HZ + 60 + backlog_s * RATE_HZ
    begin = next(k for k, block in enumerate(blocks) if block.quality & Quality.LOSS_ESTIMATED)
    assert all(abs(off_ns(block)) < block.t_error_ns + 5e6 for block in blocks[begin:])
    assert abs(off_ns(blocks[-1])) < 5e6
    assert abs(unit.time_base.drift_ppm) < 2000
    assert unit.time_base.settled


@settings(deadline=None, max_examples=examples(15))
@given(
    seed=st.integers(0, 2**31),
    waited_s=st.floats(0.1, 30.0),
    speed=st.floats(1.3, 1000.0),
    batch=st.sampled_from([1, 3, 40]),
)
def test_frames_that_were_delayed_lose_nothing_and_keep_their_times(seed, waited_s, speed, batch) -> None:
    """As behind a host that was suspended, or a gateway that kept what it could not send."""
    frames = sent(0, waited_s + 26.0, 0.0, seed, ppm=60.0)
    unit, blocks = play(delayed(frames, 20.0 + waited_s, speed, since_s=20.0), batch=batch)
    assert unit.time_base.restarts == 0
    counters = unit.counters
    assert (counters.samples_lost, counters.frames_rejected) == (0, 0)
    assert counters.samples_received == PER_FRAME * len(frames.counter)
    check_order(unit, blocks)
    assert all(abs(off_ns(block)) < block.t_error_ns + 5e6 for block in blocks)


@settings(deadline=None, max_examples=examples(10))
@given(seed=st.integers(0, 2**31), away_s=st.floats(10.0, 7200.0), ppm=st.floats(-150, 150))
def test_a_device_that_counted_on_through_an_outage_of_hours_is_counted_exactly(seed, away_s, ppm) -> None:
    frames = sent(0, away_s + 60.0, 0.0, seed, ppm)
    come = np.r_[0:3000, 3000 + round(away_s * 100) : len(frames.counter)]
    come = come[come < len(frames.counter)]
    unit, blocks = play(
        Frames(frames.counter[come], frames.taken_ns[come], frames.arrival_ns[come]), batch=10
    )
    assert unit.time_base.restarts == 0
    assert unit.counters.samples_lost == PER_FRAME * round(away_s * 100)
    check_order(unit, blocks)


@pytest.mark.parametrize("step_s", [-8.0, -0.9, 0.9, 8.0])
def test_a_time_base_that_every_arrival_contradicts_begins_anew(step_s: float) -> None:
    """However it came to that: the arrivals are suddenly ``step_s`` later than the samples' index tells."""
    base = TimeBase(RATE_HZ, 32, PER_FRAME, 1)
    frames = sent(0, 80.0, 0.0, 1)
    contradicts = frames.taken_ns > START_NS + 60 * NS_PER_S
    arrival_ns = frames.arrival_ns + np.where(contradicts, round(max(step_s, 0.0) * NS_PER_S), 0)
    index = frames.counter * PER_FRAME + np.where(contradicts, round(max(-step_s, 0.0) * RATE_HZ), 0)
    anew = 0
    for k in range(0, len(index), 5):
        some = slice(k, k + 5)
        anew += base._learn(index[some], arrival_ns[some])
        off_ns = abs(base.time_of(int(index[some][-1]) + PER_FRAME - 1) - arrival_ns[some][-1])
        if not 6000 <= k < 6015:  # a tenth of a second may pass until it knows
            assert off_ns < base.error_at(int(index[some][-1])) + 2 * JITTER_NS
    assert anew == 1
    assert off_ns < 2 * JITTER_NS
    assert base.settled
    assert abs(base.state.drift_ppm) < 300


@pytest.mark.parametrize("step_s", [0.05, 0.3, 0.45])
def test_a_step_too_small_to_begin_anew_is_told_as_the_error_of_the_time_base(step_s: float) -> None:
    """Of a device that did not count for that long: told within 2.5 s, for the minute that it lasts."""
    base = TimeBase(RATE_HZ, 32, PER_FRAME, 1)
    frames = sent(0, 140.0, 0.0, 1)
    moved_ns = np.where(frames.taken_ns > START_NS + 60 * NS_PER_S, round(step_s * NS_PER_S), 0)
    index, arrival_ns = frames.counter * PER_FRAME, frames.arrival_ns + moved_ns
    for k in range(0, len(index), 5):
        some = slice(k, k + 5)
        assert not base._learn(index[some], arrival_ns[some])
        newest = int(index[some][-1])
        off_ns = abs(base.time_of(newest + PER_FRAME - 1) - frames.taken_ns[some][-1] - moved_ns[some][-1])
        if not 6000 <= k < 6250:
            assert off_ns < base.error_at(newest) + 2 * JITTER_NS
    assert off_ns < 2 * JITTER_NS
