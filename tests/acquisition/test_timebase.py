"""The time base against devices whose true clock is known."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from daqsvc.acquisition.clock_line import Bucket, clock_line
from daqsvc.acquisition.counter import CounterUnwrapper
from daqsvc.acquisition.timebase import TimeBase

pytestmark = pytest.mark.property
RATE_HZ = 12_000.0
PER_FRAME = 30
START_NS = 5_000_000_000


def arrivals(frames: np.ndarray, rng: np.random.Generator, jitter_ms: float, ppm: float = 0.0) -> np.ndarray:
    """When frames arrive whose last sample was taken on a clock that is ``ppm`` fast."""
    period_ns = 1e9 / RATE_HZ / (1 + ppm * 1e-6)
    taken = START_NS + ((frames + 1) * PER_FRAME - 1) * period_ns
    late = taken + rng.uniform(0, jitter_ms * 1e6, len(frames))
    return np.maximum.accumulate(late).astype(np.int64)  # a bus does not overtake


@pytest.mark.long
@settings(deadline=None)
@given(
    seed=st.integers(0, 2**31),
    ppm=st.floats(-200, 200),
    bits=st.sampled_from([8, 16, 32]),
    counts=st.sampled_from(["samples", "frames"]),
    loss=st.floats(0, 0.3),
)
def test_time_and_drift_come_out_of_ten_ms_of_jitter(seed, ppm, bits, counts, loss) -> None:
    if bits == 8 and counts == "samples":
        counts = "frames"  # 256 samples last 21 ms: narrower than the jitter, and refused by `daqsvc check`
    rng = np.random.default_rng(seed)
    frames = np.flatnonzero(rng.random(12_000) >= loss)  # 30 s
    t_ns = arrivals(frames, rng, 10.0, ppm)
    step = PER_FRAME if counts == "samples" else 1
    base = TimeBase(RATE_HZ, bits, PER_FRAME, step)
    at = 0
    first = None
    while at < len(frames):
        n = int(rng.integers(1, 60))
        chunk = frames[at : at + n]
        indices, kept, restarts, _ = base.place(chunk * step % 2**bits, t_ns[at : at + n])
        first = first if first is not None else indices[0] - chunk[0] * PER_FRAME
        assert kept.all()
        assert not restarts
        np.testing.assert_array_equal(indices - first, chunk * PER_FRAME)
        at += n
    period_ns = 1e9 / RATE_HZ / (1 + ppm * 1e-6)
    for frame in (int(frames[-1]), int(frames[len(frames) // 2])):
        true_ns = START_NS + frame * PER_FRAME * period_ns
        assert abs(base.time_of(frame * PER_FRAME + int(first)) - true_ns) < 500_000
    state = base.state
    assert state.settled
    assert abs(state.drift_ppm - ppm) < 20
    assert 5e6 < state.jitter_ns < 12e6


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**31),
    bits=st.sampled_from([8, 16]),
    outages=st.lists(st.integers(1, 4000), min_size=1, max_size=6),
)
def test_outages_of_any_length_are_counted_exactly(seed, bits, outages) -> None:
    """Frames counted: the 8-bit counter wraps every 0.64 s, outages last up to 10 s."""
    rng = np.random.default_rng(seed)
    runs, at = [], 0
    for outage in outages:
        runs.append(np.arange(at, at + 40))
        at += 40 + outage
    frames = np.concatenate([*runs, np.arange(at, at + 40)])
    # The clock decides only beyond half a wrap, unless the very next count comes: leave those out.
    if any((outage + 1) % 2**bits == 1 for outage in outages):
        return
    base = TimeBase(RATE_HZ, bits, PER_FRAME, 1)
    t_ns = arrivals(frames, rng, 10.0)
    indices, kept, _, _ = base.place(frames % 2**bits, t_ns)
    assert kept.all()
    np.testing.assert_array_equal(indices, frames * PER_FRAME)


@given(
    seed=st.integers(0, 2**31),
    before=st.integers(200, 60_000),
    off=st.integers(0, 2000),
    split=st.integers(1, 79),
)
def test_a_restarted_counter_is_found_and_its_loss_estimated(seed, before, off, split) -> None:
    rng = np.random.default_rng(seed)
    old = np.arange(before - 40, before)
    late = before + off + np.arange(40)
    t_ns = arrivals(np.concatenate([old, late]), rng, 10.0)
    raw = np.concatenate([old, np.arange(40)]) % 2**16
    base = TimeBase(RATE_HZ, 16, PER_FRAME, 1)
    parts = [base.place(raw[:split], t_ns[:split]), base.place(raw[split:], t_ns[split:])]
    indices = np.concatenate([indices for indices, *_ in parts])
    kept = np.concatenate([kept for _, kept, *_ in parts])
    explained = before - 1 + 30 >= 2**16  # the new count may look like a plain loss of frames
    if not explained:
        assert base.state.restarts == 1
        # The last frame of a batch, if it is the first of the new count, comes once more with the next.
        assert kept.sum() == (79 if split == 41 else 80)
        error = indices[41:] - (before + off + np.arange(1, 40)) * PER_FRAME
        assert (np.diff(indices[kept]) > 0).all()
        assert np.abs(error).max() <= RATE_HZ * 0.012  # the jitter bounds the guess


@given(wrong=st.integers(0, 2**16 - 1), at=st.integers(1, 38))
def test_one_impossible_counter_is_left_out_and_nothing_else(wrong, at) -> None:
    frames = np.arange(40)
    raw = (frames * PER_FRAME) % 2**16
    if -1000 < (wrong - raw[at]) < 2500 or wrong > 64_000:
        return  # a value that late or lost frames would explain
    raw[at] = wrong
    base = TimeBase(RATE_HZ, 16, PER_FRAME, PER_FRAME)
    indices, kept, restarts, _ = base.place(raw, arrivals(frames, np.random.default_rng(1), 1.0))
    assert not restarts
    assert not kept[at]
    good = np.delete(indices, at)
    np.testing.assert_array_equal(good, np.delete(frames * PER_FRAME, at))


def test_a_stalled_host_is_no_loss() -> None:
    """Two seconds of frames that all arrive at the end of a stall keep their places."""
    frames = np.arange(2400)
    t_ns = arrivals(frames, np.random.default_rng(0), 1.0)
    t_ns[800:1600] = t_ns[1600]
    base = TimeBase(RATE_HZ, 8, PER_FRAME, 1)
    indices, *_ = base.place(frames % 256, t_ns)
    np.testing.assert_array_equal(indices, frames * PER_FRAME)


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**31),
    bits=st.sampled_from([16, 32]),
    stalled=st.integers(10, 20_000),
    kept=st.integers(0, 2000),
    split=st.integers(1, 500),
)
@example(seed=0, bits=16, stalled=202, kept=2, split=102)
def test_what_a_buffer_loses_while_the_host_is_suspended_is_counted_exactly(
    seed, bits, stalled, kept, split
) -> None:
    """Of up to 50 s of frames the buffer keeps the first ones, which are read with those that come then."""
    frames = np.arange(1000 + stalled + 400)
    t_ns = arrivals(frames, np.random.default_rng(seed), 10.0)
    t_ns[1000 : 1000 + stalled] = t_ns[1000 + stalled]
    lost = slice(1000 + min(kept, stalled), 1000 + stalled)
    frames, t_ns = np.delete(frames, lost), np.delete(t_ns, lost)
    base = TimeBase(RATE_HZ, bits, PER_FRAME, 1)
    begun, split = slice(0, 500), split + 900
    placed = [base.place(frames[begun] % 2**bits, t_ns[begun])]
    parts = (slice(500, split), slice(split, None))
    if base.wants_more(frames[parts[0]] % 2**bits, t_ns[parts[0]]):
        parts = (slice(500, None),)  # the first part has fallen behind, and does not tell why
    placed += [base.place(frames[part] % 2**bits, t_ns[part]) for part in parts]
    assert base.state.restarts == 0
    assert all(kept.all() for _, kept, *_ in placed)
    np.testing.assert_array_equal(np.concatenate([indices for indices, *_ in placed]), frames * PER_FRAME)


def test_time_never_leaves_the_host_clock_before_it_settles() -> None:
    base = TimeBase(RATE_HZ, 16, PER_FRAME, PER_FRAME)
    with pytest.raises(LookupError, match="no frame has arrived"):
        base.time_of(0)
    base.place(np.array([0]), np.array([START_NS]))
    assert base.time_of(PER_FRAME - 1) == START_NS
    assert not base.state.settled


@pytest.mark.parametrize(("bits", "step"), [(3, 1), (65, 1), (4, 4), (8, 64), (16, 0)])
def test_a_counter_that_cannot_work_is_refused(bits: int, step: int) -> None:
    with pytest.raises(ValueError, match="counter"):
        CounterUnwrapper(bits, step, 1000.0, 10)


@given(
    seed=st.integers(0, 2**31),
    n=st.integers(3, 60),
    begin=st.sampled_from([0, 10**6, 10**11]),
    step=st.integers(1, 1000),
)
@example(seed=126, n=3, begin=0, step=3)
def test_the_line_supports_all_arrivals_and_fits_them_best(seed, n, begin, step) -> None:
    """Of all lines that no arrival is ahead of, none leaves less delay over all; every pair is tried."""
    rng = np.random.default_rng(seed)
    nominal_ns = 1e6
    x = begin + step * np.cumsum(rng.integers(1, 4, n))
    late_ns = np.rint(rng.exponential(1e6, n) + 30.0 * (x - begin))
    arrival_ns = x * int(nominal_ns) + late_ns.astype(np.int64)
    # One bucket outweighs the rest: its mean tells nothing, so that only the support is in question.
    wild = [(1, float(at), float(late)) for at, late in zip(x, rng.uniform(-1e12, 1e12, n), strict=True)]
    buckets = [Bucket(int(a), int(b), *rest) for a, b, rest in zip(x, arrival_ns, wild, strict=True)]
    line = clock_line(buckets, nominal_ns, (-1e9, 1e9))
    assert line is not None
    delay = late_ns - (x - begin) * line.slope_ns - (line.offset_ns + begin * line.slope_ns)
    tolerance_ns = 1e-3 + 1e-9 * begin * abs(line.slope_ns)
    assert delay.min() >= -tolerance_ns
    for i in range(n):
        for j in range(i):
            slope = (late_ns[i] - late_ns[j]) / (x[i] - x[j])
            other = late_ns - (x - begin) * slope
            assert (other - other.min()).mean() >= delay.mean() - 1e-6 * delay.mean() - tolerance_ns
    assert line.error_ns > 0.0
