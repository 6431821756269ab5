from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples

from sim_hw.link_faults import Fault, FaultCounts, LinkFaults

pytestmark = pytest.mark.property
LENGTH = 16
rates = st.floats(0, 0.25)
links = st.builds(
    LinkFaults,
    drop=rates,
    duplicate=rates,
    reorder=rates,
    corrupt=rates,
    seed=st.integers(0, 2**32),
    reorder_within_ns=st.integers(0, 20_000_000),
)
schedules = st.lists(st.integers(0, 8_000_000), max_size=200).map(
    lambda gaps: np.cumsum(gaps, dtype=np.int64)
)


@given(links, schedules)
def test_what_is_counted_is_what_happens(link, t_ns):
    plan = link.plan(t_ns, LENGTH)
    sent = Counter(plan.frame[plan.fault != Fault.DROPPED].tolist())
    counts = plan.injected
    assert counts.frames_in == len(t_ns)
    assert sum(sent.values()) == counts.frames_in - counts.dropped + counts.duplicated
    assert sum(1 for frame in range(len(t_ns)) if sent[frame] == 0) == counts.dropped
    assert sum(1 for times in sent.values() if times == 2) == counts.duplicated
    assert max(sent.values(), default=0) <= 2
    changed = np.unpackbits(plan.flips, axis=1).sum(axis=1)
    assert np.count_nonzero(changed) == counts.corrupted
    assert set(changed[plan.fault == Fault.CORRUPTED].tolist()) <= {1, 2, 3}
    assert not changed[plan.fault != Fault.CORRUPTED].any()


@given(links, schedules)
def test_held_frames_are_overtaken_by_an_intact_frame_and_soon(link, t_ns):
    plan = link.plan(t_ns, LENGTH)
    assert np.all(np.diff(plan.t_ns) >= 0)
    delay = plan.t_ns - t_ns[plan.frame] if len(t_ns) else np.zeros(0)
    held = plan.fault == Fault.REORDERED
    assert not delay[~held].any()
    assert np.all(delay <= link.reorder_within_ns)
    intact = (plan.fault == Fault.NONE) | (plan.fault == Fault.DUPLICATED)
    for event in np.flatnonzero(held):
        earlier = plan.frame[:event][intact[:event]]
        assert earlier.max() > plan.frame[event]
    # Nothing else leaves its place.
    assert np.all(np.diff(plan.frame[~held]) >= 0)
    late = np.flatnonzero(np.diff(np.maximum.accumulate(plan.frame), prepend=-1) <= 0)
    assert np.count_nonzero(plan.fault[late] != Fault.DUPLICATED) == np.count_nonzero(held)


@given(links, schedules)
def test_second_copies_follow_the_first_at_once(link, t_ns):
    plan = link.plan(t_ns, LENGTH)
    for event in np.flatnonzero(plan.fault == Fault.DUPLICATED):
        assert plan.frame[event - 1] == plan.frame[event]
        assert plan.fault[event - 1] == Fault.NONE


@given(links, schedules)
def test_the_first_and_the_last_frame_arrive(link, t_ns):
    plan = link.plan(t_ns, LENGTH)
    for end in {0, len(t_ns) - 1} if len(t_ns) else ():
        assert plan.fault[plan.frame == end].tolist() == [Fault.NONE]


@given(links, schedules)
@settings(max_examples=examples(30))
def test_same_seed_same_faults(link, t_ns):
    one, other = link.plan(t_ns, LENGTH), link.plan(t_ns, LENGTH)
    for name in ("t_ns", "frame", "fault", "flips"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


def test_rates_are_those_asked_for():
    t_ns = np.arange(40_000) * 1_000_000
    counts = LinkFaults(drop=0.01, duplicate=0.02, reorder=0.03, corrupt=0.04, seed=5).plan(t_ns, 8).injected
    assert counts.dropped == pytest.approx(400, rel=0.15)
    assert counts.duplicated == pytest.approx(800, rel=0.15)
    assert counts.reordered == pytest.approx(1200, rel=0.15)
    assert counts.corrupted == pytest.approx(1600, rel=0.15)
    assert counts.lost == counts.dropped + counts.corrupted
    other = LinkFaults(drop=0.01, duplicate=0.02, reorder=0.03, corrupt=0.04, seed=6).plan(t_ns, 8)
    assert other.injected != counts


def test_frames_too_far_apart_cannot_overtake_and_are_not_counted():
    t_ns = np.arange(1000) * 6_000_000
    plan = LinkFaults(reorder=1.0, reorder_within_ns=5_000_000).plan(t_ns, 8)
    assert plan.injected == FaultCounts(frames_in=1000)
    assert np.array_equal(plan.frame, np.arange(1000))


def test_all_dropped_but_the_ends():
    plan = LinkFaults(drop=1.0).plan(np.arange(5) * 1000, 8)
    assert plan.frame[plan.fault != Fault.DROPPED].tolist() == [0, 4]


@pytest.mark.parametrize(
    ("rates", "message"),
    [
        ({"drop": -0.1}, "drop = -0.1"),
        ({"corrupt": 1.5}, "corrupt = 1.5"),
        ({"drop": float("nan")}, "drop = nan"),
        ({"drop": 0.6, "reorder": 0.6}, "add up to 1.2"),
        ({"reorder_within_ns": -1}, "reorder_within_ns is -1"),
    ],
)
def test_rates_that_cannot_be_are_refused(rates, message):
    with pytest.raises(ValueError, match=message):
        LinkFaults(**rates)


def test_a_schedule_that_goes_back_is_refused():
    with pytest.raises(ValueError, match="back in time"):
        LinkFaults().plan(np.array([1, 0]), 8)


def test_counts_add_up():
    assert FaultCounts(5, 1, 2, 3, 4) + FaultCounts(50, 10, 20, 30, 40) == FaultCounts(55, 11, 22, 33, 44)
