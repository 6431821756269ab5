"""The time base against whatever a device may count: it ends, its work is bounded, its books hold."""

import logging
import sys
from itertools import groupby, pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.examples import examples

from daqsvc.acquisition.assembler import StreamAssembler, StreamCounters
from daqsvc.acquisition.clock_line import clock_line
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.acquisition.timebase import TimeBase
from daqsvc.notice import NOTICE

pytestmark = pytest.mark.property
RATE_HZ = 1000.0
PER_FRAME = 2
START_NS = 7_000_000_000
BATCH = 25
FRAMES = 600

COUNTERS = {
    "constant": lambda n, step, rng: np.full(n, int(rng.integers(2**62))),
    "random": lambda n, step, rng: rng.integers(-(2**63), 2**63 - 1, n),
    "alternating": lambda n, step, rng: np.where(np.arange(n) % 2, 0, step * int(rng.integers(1, 2**40))),
    "backwards": lambda n, step, rng: -step * np.arange(n),
    "leaps": lambda n, step, rng: np.cumsum(rng.choice([step, 2**20, 2**40, -(2**30)], n)),
    "two devices": lambda n, step, rng: step * (np.arange(n) // 2 + np.arange(n) % 2 * 5000),
    "restarts": lambda n, step, rng: step * (np.arange(n) % int(rng.integers(2, 50))),
    "sound": lambda n, step, rng: step * np.arange(n),
}
PERIOD_NS = round(PER_FRAME * 1e9 / RATE_HZ)
TIMES = {
    "regular": lambda n, rng: np.arange(n) * PERIOD_NS,
    "all at once": lambda n, rng: np.zeros(n, np.int64),
    "in bursts": lambda n, rng: np.arange(n) // 200 * 200 * PERIOD_NS,
    "slow": lambda n, rng: np.arange(n) * PERIOD_NS * 100,
    "far apart": lambda n, rng: np.cumsum(rng.choice([0, PERIOD_NS, 10**9, 10**13], n)),
    "backwards": lambda n, rng: -np.arange(n) * PERIOD_NS,
    "to and fro": lambda n, rng: np.arange(n) * PERIOD_NS + rng.integers(-(10**9), 10**9, n),
}


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)


def accounted(counters: StreamCounters) -> int:
    """Frames by what became of them, those handed on among them."""
    gone = counters.frames_corrupt + counters.frames_rejected + counters.frames_set_aside
    again = counters.frames_duplicate
    return gone + again + counters.samples_received // PER_FRAME + too_late(counters)


def too_late(counters: StreamCounters) -> int:
    return counters.frames_late


def check(blocks: list[SampleBlock], counters: StreamCounters) -> None:
    """Every frame is counted once, and blocks follow each other."""
    assert accounted(counters) == counters.frames_received
    for before, block in pairwise(blocks):
        assert block.first_index == before.end_index + block.lost_before
        assert block.lost_before >= 0
        assert block.period_ns > 0
    if blocks:
        span = blocks[-1].end_index - blocks[0].first_index
        assert span == counters.samples_received + counters.samples_lost


@settings(deadline=None, max_examples=examples(60))
@given(
    seed=st.integers(0, 2**31),
    counter=st.sampled_from(sorted(COUNTERS)),
    after=st.sampled_from(sorted(COUNTERS)),
    times=st.sampled_from(sorted(TIMES)),
    bits=st.sampled_from([4, 5, 8, 16, 32, 63, 64]),
    step=st.sampled_from([1, 2]),
    batch=st.sampled_from([1, BATCH, FRAMES]),
)
@example(seed=0, counter="constant", after="constant", times="regular", bits=16, step=2, batch=BATCH)
@example(seed=0, counter="random", after="random", times="regular", bits=32, step=2, batch=FRAMES)
def test_whatever_the_counter_every_frame_is_counted_once(
    seed, counter, after, times, bits, step, batch
) -> None:
    rng = np.random.default_rng(seed)
    half = FRAMES // 2
    raw = np.concatenate([COUNTERS[counter](half, step, rng), COUNTERS[after](FRAMES - half, step, rng)])
    unused = 64 - bits
    raw = (raw.astype(np.uint64) << np.uint64(unused)) >> np.uint64(unused)
    t_ns = START_NS + 10**14 + TIMES[times](FRAMES, rng)
    blocks: list[SampleBlock] = []
    unit = StreamAssembler(
        "s",
        RATE_HZ,
        counter_bits=bits,
        samples_per_frame=PER_FRAME,
        counts_per_frame=step,
        deliver=blocks.append,
    )
    samples = np.ones((FRAMES, PER_FRAME, 1), np.float32)
    intact = rng.random(FRAMES) > 0.01
    for at in range(0, FRAMES, batch):
        some = slice(at, at + batch)
        unit.accept(raw[some].view(np.int64), samples[some], intact[some], t_ns[some])
        unit.tick(int(t_ns[some][-1]))
        state = unit.time_base
        assert state.period_ns > 0
        assert not np.isnan(state.error_ns)
    unit.flush()
    assert unit.counters.frames_received == FRAMES
    check(blocks, unit.counters)


@settings(deadline=None, max_examples=examples(200))
@given(
    seed=st.integers(0, 2**31),
    n=st.integers(1, 40),
    counts=st.sampled_from([1, 2, 5, 2**20, 2**62]),
    times=st.sampled_from([1, 3, 10**6, 10**18]),
)
@example(seed=0, n=40, counts=1, times=10**6)
def test_no_arrivals_keep_the_line_from_being_laid(seed, n, counts, times) -> None:
    """Of any counts, alike or far apart, at any times: it is a line with finite figures, or none."""
    rng = np.random.default_rng(seed)
    table = np.empty((n, 5))
    table[:, 0] = rng.integers(0, counts, n)
    table[:, 1] = np.sort(rng.integers(0, times, n))
    table[:, 2] = rng.integers(1, 100, n)
    table[:, 3] = table[:, 0] + rng.random(n)
    table[:, 4] = table[:, 1] - table[:, 3] * 1e6
    line = clock_line(table, 1e6, (-9e5, 1e9))
    told = len(np.unique(table[:, 0])) > 1
    assert line is None or (told and np.isfinite(line).all())


@pytest.mark.gives("B38")
def test_a_counter_that_stands_still_is_said_and_its_stream_set_aside(caplog) -> None:
    caplog.set_level(NOTICE)
    blocks: list[SampleBlock] = []
    unit = StreamAssembler(
        "s", 1000.0, counter_bits=16, samples_per_frame=10, counts_per_frame=1, deliver=blocks.append
    )
    for k in range(300):
        unit.accept(
            np.array([77]), np.ones((1, 10, 1), np.float32), np.ones(1, bool), np.array([k * 10_000_000])
        )
    assert unit.doubt == "the device's counter stands still at 77; check the device"
    assert unit.time_base.doubt == unit.doubt
    counters = unit.counters
    assert (counters.frames_received, counters.frames_rejected) == (300, 0)
    assert counters.frames_duplicate + counters.frames_set_aside == 299
    assert counters.frames_set_aside >= 199
    assert [record.message for record in caplog.records] == [
        f"stream 's': {unit.doubt}. Nothing is judged by it meanwhile"
    ]
    # It counts on: what is missing is estimated by the clock, and nothing is set aside any longer.
    caplog.clear()
    for k in range(300, 600):
        unit.accept(
            np.array([78 + k]), np.ones((1, 10, 1), np.float32), np.ones(1, bool), np.array([k * 10_000_000])
        )
    unit.flush()
    assert unit.doubt == ""
    assert counters.frames_set_aside < 360
    assert blocks[-1].end_index - blocks[0].first_index == pytest.approx(600 * 10, abs=20)
    assert "its samples can be judged by again" in caplog.text


STILL = "the device's counter stands still at 7; check the device"
SENSELESS = "the device's counter makes no sense"
FLOOD = "more than 4 times as many frames"


@pytest.mark.parametrize(
    ("counter", "per_s", "words"),
    [
        ("random", 100, {SENSELESS}),
        ("random", 3000, {SENSELESS, FLOOD}),  # it is both
        ("sound", 3000, {FLOOD}),
        ("sound", 100, set()),
    ],
)
def test_another_trouble_takes_over_from_a_counter_that_stood_still(caplog, counter, per_s, words) -> None:
    caplog.set_level(NOTICE)
    told: list[str] = []
    unit = StreamAssembler(
        "s",
        1000.0,
        counter_bits=16,
        samples_per_frame=10,
        counts_per_frame=1,
        deliver=lambda _: None,
        tell=lambda _, standing: told.append(standing.doubt),
    )

    def play(raw, rate, t_ns):
        one = np.ones((1, 10, 1), np.float32), np.ones(1, bool)
        for k in range(len(raw)):
            unit.accept(raw[k : k + 1] % 2**16, *one, np.array([t_ns + k * 1_000_000_000 // rate]))

    for again, offset_ns in enumerate([0, 11_000_000_000]):
        # Whenever within a look at its frames the device begins to do something else.
        play(np.full(300 + 27 * again, 7), 100, offset_ns)
        assert unit.doubt == STILL
        told.clear()
        t_ns = offset_ns + (300 + 27 * again) * 10_000_000
        play(COUNTERS[counter](5 * per_s, 1, np.random.default_rng(4)), per_s, t_ns)
        assert any(map(unit.doubt.startswith, words)) if words else unit.doubt == ""
        assert [doubt for doubt, _ in groupby([STILL, *told])][1:] == [unit.doubt]
        assert any(unit.doubt in record.message for record in caplog.records)
    play(np.arange(300), 100, 30_000_000_000)
    assert unit.doubt == ""
    assert any("its samples can be judged by again" in record.message for record in caplog.records)


def test_counters_that_make_no_sense_are_set_aside_until_they_do() -> None:
    rng = np.random.default_rng(2)
    told = []
    unit = StreamAssembler(
        "s",
        1000.0,
        counter_bits=32,
        samples_per_frame=1,
        counts_per_frame=1,
        deliver=lambda _: None,
        tell=lambda _, standing: told.append(standing.doubt),
    )
    at = 0
    for counter in [
        *(rng.integers(0, 2**32, 20) for _ in range(200)),
        *(20 * k + np.arange(20) for k in range(200)),
    ]:
        n = len(counter)
        t_ns = (at + np.arange(n)) * 1_000_000
        unit.accept(counter, np.ones((n, 1, 1), np.float32), np.ones(n, bool), t_ns)
        at += n
    unit.flush()
    assert [doubt[:36] for doubt, _ in groupby(told) if doubt] == ["the device's counter makes no sense:"]
    assert told[-1] == ""
    assert 3000 < unit.counters.frames_set_aside < 5000
    assert unit.counters.samples_received > 3000


@pytest.mark.parametrize("rate", [10, 100])
def test_a_flood_is_set_aside_and_counted(rate: int) -> None:
    """Ten and a hundred times the stated rate, every frame a good one."""
    unit = StreamAssembler(
        "s", 1000.0, counter_bits=32, samples_per_frame=1, counts_per_frame=1, deliver=lambda _: None
    )
    n, batch = 200_000, 500
    for at in range(0, n, batch):
        frames = at + np.arange(batch)
        t_ns = frames * (1_000_000 // rate)
        unit.accept(frames, np.ones((batch, 1, 1), np.float32), np.ones(batch, bool), t_ns)
    assert unit.doubt.startswith("more than 4 times as many frames come as the file states (1000 a second)")
    counters = unit.counters
    assert counters.frames_received == n
    assert counters.frames_set_aside > n // 4
    unit.flush()
    assert counters.frames_set_aside + counters.samples_received == n


@pytest.mark.parametrize("kind", ["random", "constant", "backwards", "restarts", "leaps"])
def test_the_work_for_a_frame_does_not_grow_with_the_batch(kind: str) -> None:
    """The interpreter's calls for one batch of 4,000 hostile frames, against those for 40 times fewer."""

    def calls(frames: int) -> int:
        rng = np.random.default_rng(4)
        base = TimeBase(RATE_HZ, 32, PER_FRAME, 1)
        base.place(np.arange(10), START_NS + np.arange(10) * PERIOD_NS)
        raw = COUNTERS[kind](frames, 1, rng) & 0xFFFF_FFFF
        t_ns = START_NS + (10 + np.arange(frames)) * PERIOD_NS
        base.wants_more(raw[:10], t_ns[:10])
        count = 0

        def counted(_frame, _event, _argument) -> None:
            nonlocal count
            count += 1

        before = sys.getprofile()
        sys.setprofile(counted)
        try:
            base.wants_more(raw, t_ns)
            base.place(raw, t_ns)
        finally:
            sys.setprofile(before)
        return count

    calls(100)
    assert calls(4000) <= calls(100) + 200
