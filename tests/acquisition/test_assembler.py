"""The assembler against a bus that drops, repeats, overtakes and corrupts frames on purpose."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.ring import SampleRing
from daqsvc.acquisition.samples import Quality, SampleBlock

pytestmark = pytest.mark.property
PER_FRAME = 4
RATE_HZ = 1000.0
FRAME_NS = 4_000_000


def assembler(blocks: list[SampleBlock], bits: int = 16, window_ms: int = 10) -> StreamAssembler:
    return StreamAssembler(
        "s",
        RATE_HZ,
        counter_bits=bits,
        samples_per_frame=PER_FRAME,
        counts_per_frame=PER_FRAME,
        deliver=blocks.append,
        reorder_window_ns=window_ms * 1_000_000,
    )


def payload(frames: list[int]) -> np.ndarray:
    index = np.array(frames)[:, None] * PER_FRAME + np.arange(PER_FRAME)
    return index.astype(np.float32)[:, :, None]


faults = st.lists(
    st.sampled_from(["", "", "", "", "drop", "duplicate", "overtaken", "corrupt"]), min_size=1, max_size=120
)


@settings(deadline=None)
@given(plan=faults, batch=st.integers(1, 17), first=st.integers(0, 2**17))
def test_every_fault_is_counted_exactly_and_every_sample_lands_in_its_place(plan, batch, first) -> None:
    # Clean frames around: nobody can miss what came before the first frame or after the last.
    plan = ["", "", *plan, "", "", "", ""]
    for i, fault in enumerate(plan):
        if fault == "overtaken":  # by the next frame: what overtakes a frame must itself arrive
            plan[i + 1] = ""
    sent: list[tuple[int, bool]] = []
    held: list[tuple[int, bool]] = []
    overtaken = 0
    for i, fault in enumerate(plan):
        frame = first + i
        if fault == "drop":
            continue
        if fault == "overtaken":
            held.append((frame, True))
            continue
        sent.append((frame, fault != "corrupt"))
        if fault == "duplicate":
            sent.append((frame, True))
        if held and fault != "corrupt":
            sent += held
            overtaken += 1
            held = []
    blocks: list[SampleBlock] = []
    unit = assembler(blocks, window_ms=24)
    for at in range(0, len(sent), batch):
        part = sent[at : at + batch]
        frames = [frame for frame, _ in part]
        unit.accept(
            np.array(frames, np.int64) * PER_FRAME % 2**16,
            payload(frames),
            np.array([ok for _, ok in part]),
            np.array([max(f for f, _ in sent[: at + k + 1]) * FRAME_NS for k in range(len(part))]),
        )
    unit.flush()
    gone = [i for i, fault in enumerate(plan) if fault in {"drop", "corrupt"}]
    counters = unit.counters
    assert counters.frames_received == len(sent)
    assert counters.frames_corrupt == plan.count("corrupt")
    assert counters.frames_duplicate == plan.count("duplicate")
    assert counters.frames_reordered == overtaken
    assert (counters.frames_late, counters.frames_rejected) == (0, 0)
    assert counters.samples_lost == PER_FRAME * len(gone)
    assert unit.frames_lost - counters.frames_corrupt == plan.count("drop")
    assert counters.samples_received == PER_FRAME * (len(plan) - len(gone))

    ring = SampleRing("s", ("a",), 4096)
    for block in blocks:
        ring.write(block)
    values = ring.read(ring.oldest_index, ring.end_index - ring.oldest_index)[:, 0]
    expected = np.arange(len(plan) * PER_FRAME, dtype=np.float32) + PER_FRAME * first
    for i in gone:
        expected[i * PER_FRAME : (i + 1) * PER_FRAME] = np.nan
    np.testing.assert_array_equal(values, expected)


def feed(unit: StreamAssembler, frames: list[int], t_ns: int = 0) -> None:
    n = len(frames)
    raw = np.array(frames, np.int64) * PER_FRAME % 2**16
    unit.accept(raw, payload(frames), np.ones(n, bool), np.full(n, t_ns, np.int64))


def test_a_frame_later_than_the_window_is_late_and_its_copy_a_repeat() -> None:
    blocks: list[SampleBlock] = []
    unit = assembler(blocks)
    feed(unit, [0, 1, 2, 4, 5, 6, 7, 8, 9])
    assert unit.counters.samples_lost == PER_FRAME
    feed(unit, [3])
    feed(unit, [3, 2])
    assert (unit.counters.frames_late, unit.counters.frames_duplicate) == (1, 2)
    assert [b.lost_before for b in blocks if b.lost_before] == [PER_FRAME]


def test_a_gap_is_given_up_when_the_stream_falls_silent() -> None:
    blocks: list[SampleBlock] = []
    unit = assembler(blocks)
    feed(unit, [0, 1, 2, 3, 4])
    feed(unit, [6], t_ns=20_000_000)
    unit.tick(21_000_000)
    assert blocks[-1].end_index == 5 * PER_FRAME
    unit.tick(21_000_000 + 100_000_000)
    assert blocks[-1].first_index == 6 * PER_FRAME
    assert blocks[-1].lost_before == PER_FRAME


@pytest.mark.gives("B37")
def test_a_restart_starts_a_new_run_with_its_loss_marked_as_estimated(caplog) -> None:
    blocks: list[SampleBlock] = []
    unit = assembler(blocks)
    for frame in range(5000, 5010):
        feed(unit, [frame], t_ns=frame * FRAME_NS)
    for frame in range(4):
        feed(unit, [frame], t_ns=(5100 + frame) * FRAME_NS)
    unit.flush()
    assert unit.time_base.restarts == 1
    after = next(b for b in blocks if b.quality & Quality.LOSS_ESTIMATED)
    assert [b for b in blocks if b.quality & Quality.PLACE_ESTIMATED] == [after]
    assert after.lost_before == 90 * PER_FRAME  # the silence: no frame is left out
    assert unit.counters.frames_rejected == 0
    assert "fits neither" not in caplog.text
    assert caplog.text.count("the device has restarted its counter") == 1


def test_patience_starts_afresh_with_every_gap() -> None:
    """Two frames are always under way: something is held back all the time, but never for long."""
    blocks: list[SampleBlock] = []
    unit = assembler(blocks)
    for k in range(0, 200, 2):
        for frame in [0, 2] if k == 0 else [k + 2, k - 1]:
            feed(unit, [frame], t_ns=(k + 2) * FRAME_NS)
            unit.tick((k + 2) * FRAME_NS)
    assert unit.counters.frames_late == 0
    assert unit.counters.samples_lost == 0
    assert unit.counters.frames_reordered > 90


@pytest.mark.gives("B35")
def test_gaps_are_told_once(caplog: pytest.LogCaptureFixture) -> None:
    unit = assembler([])
    feed(unit, [0, 1, 2, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 15, 16])
    assert unit.counters.gaps == 2
    assert [r.message for r in caplog.records] == [
        "stream 's': samples are missing before index 16, by now 4; further gaps are only counted"
    ]
