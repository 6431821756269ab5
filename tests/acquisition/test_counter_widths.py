"""Counters of every width from 4 to 64 bits, as DBC files have them, from the payload to a place in time."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.counter import LEAST_BITS, MOST_BITS, CounterUnwrapper
from daqsvc.acquisition.samples import Quality, SampleBlock
from drivers.frames import Field, FrameLayout

pytestmark = pytest.mark.property
RATE_HZ = 100.0
FRAME_NS = 10_000_000
widths = st.integers(LEAST_BITS, MOST_BITS)


def layout(bits: int, start: int = 0) -> FrameLayout:
    """A 16-bit sample in the last bytes of 16, and a counter that lies across bytes."""
    return FrameLayout(
        frame_id=0x201,
        extended=False,
        length=16,
        channels=("x",),
        fields=((Field(112, 16, "unsigned"),),),
        scale=np.ones((1, 1)),
        offset=np.zeros((1, 1)),
        counter=Field(start, bits),
        counts="frames",
    )


def assembler(blocks: list[SampleBlock], bits: int) -> StreamAssembler:
    return StreamAssembler(
        "s", RATE_HZ, counter_bits=bits, samples_per_frame=1, counts_per_frame=1, deliver=blocks.append
    )


@settings(deadline=None)
@given(
    bits=widths,
    start_bit=st.integers(0, 40),
    begins=st.integers(0, 2**64 - 1),
    gaps=st.lists(st.integers(0, 300), min_size=1, max_size=40),
    batch=st.integers(1, 9),
)
def test_loss_is_counted_exactly_whatever_the_width(bits, start_bit, begins, gaps, batch) -> None:
    # After half a wrap of silence the very next count is taken for the very next frame.
    gaps = [gap + 1 if gap and gap % 2**bits == 0 else gap for gap in gaps]
    frames = np.cumsum([0, *(1 + gap for gap in gaps)])
    counts = [(begins + int(frame)) % 2**bits for frame in frames]
    unit_layout = layout(bits, start_bit)
    payloads = np.zeros((len(frames), 16), np.uint8)
    for payload, count, frame in zip(payloads, counts, frames.tolist(), strict=True):
        number = count << start_bit | frame << 112
        payload[:] = np.frombuffer(number.to_bytes(16, "little"), np.uint8)
    decoded = unit_layout.decode(payloads)
    blocks: list[SampleBlock] = []
    unit = assembler(blocks, bits)
    for at in range(0, len(frames), batch):
        part = slice(at, at + batch)
        unit.accept(
            decoded.counter[part], decoded.samples[part], decoded.intact[part], FRAME_NS * frames[part]
        )
    unit.flush()
    assert unit.counters.samples_received == len(frames)
    assert unit.counters.samples_lost == sum(gaps)
    assert (unit.counters.frames_rejected, unit.time_base.restarts) == (0, 0)
    index = np.concatenate([np.arange(b.first_index, b.end_index) for b in blocks])
    np.testing.assert_array_equal(index - index[0], frames)
    assert index[0] == begins % 2 ** min(bits, 32)


@pytest.mark.parametrize("bits", [1, 3, 65])
def test_a_counter_that_tells_nothing_is_refused(bits: int) -> None:
    with pytest.raises(ValueError, match=f"a counter has 4 to 64 bits, not {bits}"):
        CounterUnwrapper(bits, 1, RATE_HZ, 1)


@settings(deadline=None)
@given(bits=widths, first=st.integers(0, 2**20), again=st.integers(0, 2**20), held=st.booleans())
def test_a_sender_that_begins_anew_goes_on_with_the_next_index(bits, first, again, held) -> None:
    blocks: list[SampleBlock] = []
    unit = assembler(blocks, bits)
    at_ns = 0
    for begin in (first, again):
        counts = (begin + np.array([0, 1, 2, 3, 5 if held else 4])) % 2 ** min(bits, 62)
        at_ns += FRAME_NS
        unit.accept(counts, np.zeros((5, 1, 1), np.float32), np.ones(5, bool), np.full(5, at_ns, np.int64))
        unit.begin_afresh()
    assert unit.counters.samples_received == 10
    assert unit.counters.samples_lost == (2 if held else 0)
    assert (unit.counters.frames_rejected, unit.time_base.restarts) == (0, 0)
    index = np.concatenate([np.arange(b.first_index, b.end_index) for b in blocks])
    assert index[-1] - index[0] == (11 if held else 9)
    anew = [b.first_index - blocks[0].first_index for b in blocks if b.quality & Quality.PLACE_ESTIMATED]
    assert anew == [6 if held else 5]


def test_a_sender_without_a_counter_that_begins_anew_loses_nothing() -> None:
    blocks: list[SampleBlock] = []
    unit = StreamAssembler(
        "s", RATE_HZ, counter_bits=None, samples_per_frame=1, counts_per_frame=1, deliver=blocks.append
    )
    for begin_ns in (0, 5_000_000_000):
        arrival_ns = begin_ns + FRAME_NS * np.arange(50)
        unit.accept(np.zeros(50, np.int64), np.zeros((50, 1, 1), np.float32), np.ones(50, bool), arrival_ns)
        unit.begin_afresh()
    assert (unit.counters.samples_received, unit.counters.samples_lost) == (100, 0)
    assert blocks[-1].end_index - blocks[0].first_index == 100
