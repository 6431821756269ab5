"""What goes wrong with a node is what was planned, and a receiver's books agree with the plan."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.examples import examples

from daqsvc.acquisition.assembler import StreamAssembler
from drivers.frames import FrameLayout
from sim_hw.link_faults import Fault, FaultCounts, LinkFaults
from sim_hw.node_faults import BABBLER, EVER, Babble, CountRestart, Drift, FaultWindow, FrameDelay, NodeFaults

pytestmark = pytest.mark.property
RATE_HZ = 1000.0
PER_FRAME = 5
SAMPLES = 3000
LENGTH = 16
NS_PER_S = 1_000_000_000
LAYOUT = FrameLayout.plain(
    frame_id=0x101,
    length=LENGTH,
    channels=[("x", 16, "signed", 1.0, 0.0)],
    samples_per_frame=PER_FRAME,
    counter_byte=0,
    counter_bits=32,
    first_byte=4,
    crc_byte=14,
)


def plan_of(faults: NodeFaults, samples: int = SAMPLES, first_index: int = 0):
    return faults.plan(samples, RATE_HZ, samples_per_frame=PER_FRAME, length=LENGTH, first_index=first_index)


times_s = st.integers(0, 3000).map(lambda ms: ms / 1000)
windows = (
    st.tuples(times_s, times_s).filter(lambda w: w[0] < w[1]).map(lambda w: FaultWindow(*w))
    | times_s.map(FaultWindow)
    | st.just(EVER)
)


@st.composite
def apart(draw, most: int = 3):
    """Windows that do not overlap."""
    marks = sorted(draw(st.sets(st.integers(0, 3000), min_size=0, max_size=2 * most)))
    return [FaultWindow(a / 1000, b / 1000) for a, b in zip(marks[::2], marks[1::2], strict=False)]


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
node_faults = st.builds(
    NodeFaults,
    drift=st.lists(st.builds(Drift, windows, st.floats(-5000, 5000)), max_size=2),
    brown_out=apart(2),
    counter_reset_s=st.lists(st.integers(1, 3000).map(lambda ms: ms / 1000), max_size=2),
    silence=st.lists(windows, max_size=2),
    link=apart().flatmap(lambda ws: st.tuples(*[st.tuples(st.just(w), links) for w in ws])),
    delay=st.lists(st.builds(FrameDelay, windows, st.floats(0, 0.02), st.floats(0, 0.02)), max_size=2),
    babble=st.lists(
        st.builds(Babble, windows.filter(lambda w: w.end_s < math.inf), st.floats(1, 500)), max_size=2
    ),
    seed=st.integers(0, 2**32),
)


@given(node_faults, st.integers(0, 10**6))
def test_what_is_counted_is_what_happens(faults: NodeFaults, first_index: int) -> None:
    plan = plan_of(faults, first_index=first_index)
    counts = plan.injected()
    own = plan.frame != BABBLER
    sent = Counter(plan.frame[own & plan.sends].tolist())
    frames = len(plan.schedule.t_ns)
    assert counts.frames_in == frames
    assert sum(sent.values()) == counts.sent
    assert set(plan.frame[own].tolist()) == set(range(frames))
    assert sum(sent[f] == 0 for f in range(frames)) == counts.dropped + counts.silenced
    assert sum(times == 2 for times in sent.values()) == counts.duplicated
    assert np.count_nonzero(plan.flips.any(axis=1)) == counts.corrupted
    assert np.count_nonzero(~own) == counts.babbled
    assert counts.babbled == sum(
        math.ceil((b.window.end_s - b.window.start_s) * b.rate_hz - 1e-9) for b in faults.babble
    )
    assert np.all(np.diff(plan.t_ns) >= 0)
    # Counts stop where the playing stops.
    half = len(plan.t_ns) // 2
    assert (
        plan.injected(half)
        + FaultCounts.of(
            plan.fault[half:],
            delayed=int(plan.late[half:].sum()),
            brown_outs=int((plan.mark[half:] == CountRestart.BROWN_OUT).sum()),
            counter_resets=int((plan.mark[half:] == CountRestart.COUNTER_RESET).sum()),
        )
        == counts
    )


@given(node_faults)
def test_samples_are_taken_once_in_order_and_only_with_power(faults: NodeFaults) -> None:
    schedule = plan_of(faults).schedule
    taken = (schedule.sample[:, None] + np.arange(PER_FRAME)).ravel()
    assert np.all(np.diff(taken) > 0)
    assert np.all(np.diff(schedule.t_ns) > 0)
    for off in faults.brown_out:
        assert not off.holds(schedule.t_ns).any()
    begins = schedule.mark != CountRestart.NONE
    assert np.all(schedule.count[begins] == 0)
    goes_on = ~begins[1:]
    assert np.all(np.diff(schedule.count)[goes_on] == PER_FRAME)
    assert np.all(np.diff(schedule.sample)[goes_on] == PER_FRAME)
    # A reset loses no sample, and a brown-out no more than lasts as long as it, and a frame that it cuts off.
    assert np.all(np.diff(schedule.sample)[schedule.mark[1:] == CountRestart.COUNTER_RESET] == PER_FRAME)
    off_s = sum(max(min(w.end_s, 3.1) - w.start_s, 0) for w in faults.brown_out)
    most = PER_FRAME * (1 + len(faults.brown_out))
    assert SAMPLES - len(taken) <= off_s * RATE_HZ * 1.01 + most


@given(node_faults)
def test_faults_keep_to_their_windows_and_leave_the_ends_alone(faults: NodeFaults) -> None:
    plan = plan_of(faults)
    due_ns = plan.schedule.t_ns[plan.frame]
    silenced = plan.fault == Fault.SILENCED
    allowed = np.zeros(len(due_ns), bool)
    for window in faults.silence:
        allowed |= window.holds(due_ns)
    assert not (silenced & ~allowed).any()
    by_link = np.isin(plan.fault, [Fault.DROPPED, Fault.DUPLICATED, Fault.REORDERED, Fault.CORRUPTED])
    allowed = np.zeros(len(due_ns), bool)
    for window, _ in faults.link:
        allowed |= window.holds(due_ns)
    assert not (by_link & ~allowed).any()
    begins = np.flatnonzero(plan.schedule.mark)
    ends = {0, len(plan.schedule.mark) - 1, *begins.tolist(), *(begins - 1).tolist()} - {-1}
    for end in ends:
        assert plan.fault[plan.frame == end].tolist() == [Fault.NONE]


@given(node_faults)
def test_a_delayed_frame_is_late_by_no_more_than_its_window_says_and_overtakes_nobody(
    faults: NodeFaults,
) -> None:
    plan = plan_of(NodeFaults(delay=faults.delay, babble=faults.babble, seed=faults.seed))
    own = plan.frame != BABBLER
    due_ns = plan.schedule.t_ns
    assert np.array_equal(plan.frame[own], np.arange(len(due_ns)))
    late_ns = plan.t_ns[own] - due_ns
    assert np.array_equal(plan.late[own], late_ns > 0)
    assert plan.injected().delayed == np.count_nonzero(late_ns)
    most_ns = sum(d.delay_s + d.jitter_s for d in faults.delay) * NS_PER_S
    assert late_ns.min() >= 0
    assert late_ns.max() <= most_ns + 2
    alone = [d for d in faults.delay if d.jitter_s == 0]
    if len(alone) == len(faults.delay) == 1:
        inside = alone[0].window.holds(due_ns)
        assert np.all(np.abs(late_ns[inside] - alone[0].delay_s * NS_PER_S) <= 1)


@given(node_faults)
@settings(max_examples=examples(30))
def test_same_seed_same_faults(faults: NodeFaults) -> None:
    one, other = plan_of(faults), plan_of(faults)
    for name in ("t_ns", "frame", "fault", "flips", "late", "mark", "babble_id"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


@given(st.floats(-5000, 5000), windows)
def test_a_drifting_clock_takes_its_samples_early_or_late_by_as_much(ppm: float, window: FaultWindow) -> None:
    t_s = plan_of(NodeFaults(drift=[Drift(window, ppm)])).schedule.t_ns / NS_PER_S
    # What the node's clock shows at these times is when it takes a sample.
    drifted = np.clip(t_s, window.start_s, window.end_s) - window.start_s
    shown_s = t_s + 1e-6 * ppm * drifted
    due_s = (PER_FRAME * np.arange(len(t_s)) + PER_FRAME - 1) / RATE_HZ
    assert np.abs(shown_s - due_s).max() < 2e-9


def test_without_faults_the_frames_are_those_of_the_schedule() -> None:
    plan = plan_of(NodeFaults())
    assert plan.injected() == FaultCounts(frames_in=SAMPLES // PER_FRAME)
    assert np.array_equal(plan.t_ns, plan.schedule.t_ns)
    assert np.array_equal(plan.schedule.count, PER_FRAME * np.arange(SAMPLES // PER_FRAME))
    assert not plan.flips.any()


def test_a_link_s_faults_alone_are_its_own_plan() -> None:
    link = LinkFaults(drop=0.1, duplicate=0.1, reorder=0.1, corrupt=0.1, seed=4, reorder_within_ns=20_000_000)
    plan = plan_of(NodeFaults.of_link(link))
    alone = link.plan(plan.schedule.t_ns, LENGTH)
    assert plan.injected() == alone.injected
    for name in ("t_ns", "frame", "fault", "flips"):
        assert np.array_equal(getattr(plan, name), getattr(alone, name))


def received(plan, samples: np.ndarray, reorder_window_ns: int = 100_000_000):
    """What a stream's assembler makes of what is on the bus, each frame arriving when it is sent."""
    blocks = []
    assembler = StreamAssembler(
        "shaft",
        RATE_HZ,
        counter_bits=32,
        samples_per_frame=PER_FRAME,
        counts_per_frame=PER_FRAME,
        deliver=blocks.append,
        reorder_window_ns=reorder_window_ns,
    )
    payloads = LAYOUT.encode(
        plan.schedule.count, samples[plan.schedule.sample[:, None] + np.arange(PER_FRAME)][..., None]
    )
    for event in np.flatnonzero(plan.sends & (plan.frame != BABBLER)):
        payload = payloads[plan.frame[event]] ^ plan.flips[event]
        decoded = LAYOUT.decode(payload[None])
        at_ns = np.array([NS_PER_S + plan.t_ns[event]])
        assembler.accept(decoded.counter, decoded.samples, decoded.intact, at_ns)
    assembler.flush()
    return assembler.counters, blocks


@pytest.mark.long
@given(node_faults)
@settings(max_examples=examples(40))
def test_a_receiver_s_books_agree_to_the_sample(faults: NodeFaults) -> None:
    # With one count throughout, the receiver can know everything.
    faults = NodeFaults(
        drift=faults.drift, silence=faults.silence, link=faults.link, delay=faults.delay, seed=faults.seed
    )
    plan = plan_of(faults)
    counts = plan.injected()
    samples = np.arange(SAMPLES, dtype=np.float64)
    books, blocks = received(plan, samples)
    assert books.samples_received + books.samples_lost == PER_FRAME * counts.frames_in
    assert books.samples_lost == PER_FRAME * counts.lost
    assert (books.frames_corrupt, books.frames_duplicate) == (counts.corrupted, counts.duplicated)
    stored = np.concatenate([block.samples[:, 0] for block in blocks])
    missing = np.isin(plan.fault, [Fault.DROPPED, Fault.SILENCED, Fault.CORRUPTED])
    gone = set(plan.frame[missing].tolist())
    kept = [f for f in range(counts.frames_in) if f not in gone]
    assert np.array_equal(stored, (PER_FRAME * np.array(kept)[:, None] + np.arange(PER_FRAME)).ravel())


@given(st.integers(400, 2000), st.integers(50, 850), st.booleans())
@settings(max_examples=examples(20))
def test_a_receiver_follows_a_restart_without_losing_a_frame(at_ms: int, off_ms: int, reset: bool) -> None:  # noqa: FBT001
    assume(at_ms + off_ms < 2900)
    start_s = at_ms / 1000
    faults = (
        NodeFaults(counter_reset_s=[start_s])
        if reset
        else NodeFaults(brown_out=[FaultWindow(start_s, start_s + off_ms / 1000)])
    )
    plan = plan_of(faults)
    counts = plan.injected()
    assert (counts.counter_resets, counts.brown_outs) == ((1, 0) if reset else (0, 1))
    # Further back than frames are overtaken, a count is one that begins again.
    books, blocks = received(plan, np.arange(SAMPLES, dtype=np.float64), reorder_window_ns=20_000_000)
    assert books.frames_rejected == 0
    assert books.samples_received == PER_FRAME * counts.frames_in
    # What is lost meanwhile can only be estimated, from the receiver's clock.
    off = 0 if reset else SAMPLES - PER_FRAME * counts.frames_in
    assert books.samples_lost == pytest.approx(off, abs=PER_FRAME)
    assert np.all(np.diff([block.first_index for block in blocks]) > 0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FaultWindow(2.0, 1.0), "from 2 to 1 s; it must begin at 0 or later"),
        (lambda: FaultWindow(-1.0), "from -1 to inf s"),
        (lambda: Drift(EVER, 20_000.0), "a drift of 20000 ppm"),
        (lambda: Drift(EVER, math.nan), "a drift of nan ppm"),
        (lambda: FrameDelay(EVER, -1.0), "a delay of -1 s"),
        (lambda: FrameDelay(EVER, 0.0, math.inf), "a jitter of inf s"),
        (lambda: Babble(EVER, 100.0), "must stop some time"),
        (lambda: Babble(FaultWindow(0, 1), 0.0), "babbles 0 frames a second"),
        (lambda: NodeFaults(counter_reset_s=[0.0]), "reset at 0 s; that must be after the start"),
        (
            lambda: NodeFaults(brown_out=[FaultWindow(1, 3), FaultWindow(2, 4)]),
            "two brown-outs at once, from 1 and from 2 s",
        ),
        (
            lambda: NodeFaults(link=[(EVER, LinkFaults()), (FaultWindow(2, 4), LinkFaults())]),
            "two link faults at once, from 0 and from 2 s",
        ),
    ],
)
def test_faults_that_cannot_be_are_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
