"""The ring against a plain list that keeps everything."""

import asyncio

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daqsvc.acquisition.ring import RingClosed, RingNotYet, RingOverrun, RingReader, SampleRing
from daqsvc.acquisition.samples import INT64_MAX, INT64_MIN, SampleBlock

pytestmark = pytest.mark.property
PERIOD_NS = 1000.0


def block(first: int, values: list[float], lost: int = 0) -> SampleBlock:
    samples = np.array([[v, -v] for v in values], np.float32).reshape(len(values), 2)
    return SampleBlock("s", first, samples, int(first % 10**6 * PERIOD_NS), PERIOD_NS, lost)


class ListModel:
    """Every sample ever written, NaN where lost."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.first = 0
        self.rows: list[float] = []

    def write(self, first: int, values: list[float], lost: int) -> None:
        if not self.rows and lost == 0:
            self.first = first
        elif not self.rows:
            self.first = first - lost
        self.rows += [float("nan")] * lost + values

    @property
    def end(self) -> int:
        return self.first + len(self.rows)

    @property
    def oldest(self) -> int:
        return max(self.first, self.end - self.capacity)


writes = st.lists(
    st.tuples(st.lists(st.floats(-1e6, 1e6, width=32), max_size=12), st.integers(0, 25)),
    min_size=1,
    max_size=30,
)
starts = st.one_of(
    st.integers(0, 10**6),
    st.integers(INT64_MIN, INT64_MIN + 5),
    st.integers(-50, 0),
    st.integers(INT64_MAX - 1200, INT64_MAX - 1150),
)


@given(capacity=st.integers(1, 17), start=starts, plan=writes, reads=st.data())
def test_ring_reads_what_a_list_would(capacity, start, plan, reads) -> None:
    ring = SampleRing("s", ("a", "b"), capacity)
    model = ListModel(capacity)
    at = start
    for values, gap in plan:
        lost = gap if model.rows else 0
        if at + lost + len(values) > INT64_MAX:
            with pytest.raises(OverflowError):
                block(at + lost, values, lost)
            return
        ring.write(block(at + lost, values, lost))
        model.write(at + lost, values, lost)
        at += lost + len(values)
        assert ring.end_index == model.end
        assert ring.oldest_index == model.oldest
        first = reads.draw(st.integers(model.oldest - 3, model.end + 1), label="first")
        count = reads.draw(st.integers(0, model.end - first + 2 if first <= model.end else 2), label="count")
        if first + count > model.end:
            with pytest.raises(RingNotYet):
                ring.read(first, count)
        elif first < model.oldest:
            with pytest.raises(RingOverrun) as caught:
                ring.read(first, count)
            assert caught.value.lost == model.oldest - first
        else:
            rows = model.rows[first - model.first : first - model.first + count]
            expected = np.array([[v, -v] for v in rows], np.float32).reshape(count, 2)
            np.testing.assert_array_equal(ring.read(first, count), expected)


@given(
    capacity=st.integers(4, 40),
    chunks=st.lists(st.integers(1, 30), min_size=1, max_size=40),
    size=st.integers(1, 4),
    read_every=st.integers(1, 6),
)
def test_a_reader_gets_every_sample_or_its_exact_count(capacity, chunks, size, read_every) -> None:
    async def main() -> None:
        ring = SampleRing("s", ("a", "b"), capacity)
        reader = RingReader(ring)
        at = 7
        got: list[float] = []
        accounted = 7
        for i, n in enumerate(chunks):
            ring.write(block(at, [float(at + k) for k in range(n)]))
            at += n
            if i % read_every == 0:
                while (
                    reader.behind >= size
                    and ring.end_index - max(reader.position or 0, ring.oldest_index) >= size
                ):
                    chunk = await reader.read(size, 3)
                    if accounted == 7 and not got:
                        accounted = chunk.first_index - chunk.skipped
                    assert chunk.first_index == accounted + chunk.skipped
                    accounted = chunk.first_index + len(chunk.samples)
                    got += chunk.samples[:, 0].tolist()
                    assert len(chunk.samples) % size == 0
        assert got == sorted(got)
        assert len(set(got)) == len(got)

    asyncio.run(main())


@given(
    capacity=st.integers(4, 40),
    pieces=st.lists(st.tuples(st.integers(0, 60), st.integers(1, 20)), min_size=1, max_size=40),
    read_every=st.integers(1, 6),
)
def test_what_a_reader_missed_is_told_from_what_never_came(capacity, pieces, read_every) -> None:
    async def main() -> None:
        ring = SampleRing("s", ("a", "b"), capacity)
        reader = RingReader(ring)
        there: list[bool] = []
        missed = 0
        for i, (lost, n) in enumerate(pieces):
            ring.write(block(len(there) + lost, [1.0] * n, lost))
            there += [False] * lost + [True] * n
            if i % read_every == 0 and reader.behind:
                before = ring.oldest_index if reader.position is None else reader.position
                skipped_before = reader.samples_skipped
                chunk = await reader.read(1, 64)
                passed_over = there[before : chunk.first_index]
                assert chunk.skipped == len(passed_over)
                assert reader.samples_skipped - skipped_before == passed_over.count(True)
                missed += passed_over.count(True)
        assert reader.samples_skipped == missed

    asyncio.run(main())


async def test_waiting_ends_when_the_index_is_there() -> None:
    ring = SampleRing("s", ("a", "b"), 10)
    near = asyncio.ensure_future(ring.wait_for(3))
    far = asyncio.ensure_future(ring.wait_for(6))
    await asyncio.sleep(0)
    ring.write(block(0, [0, 1, 2]))
    await asyncio.sleep(0)
    assert near.done()
    assert not far.done()
    ring.write(block(5, [5, 6], lost=2))
    await far


async def test_a_cancelled_wait_leaves_the_others_waiting() -> None:
    ring = SampleRing("s", ("a", "b"), 10)
    gone, stays = asyncio.ensure_future(ring.wait_for(1)), asyncio.ensure_future(ring.wait_for(1))
    await asyncio.sleep(0)
    gone.cancel()
    await asyncio.sleep(0)
    ring.write(block(0, [1.0]))
    await stays
    assert gone.cancelled()


async def test_closing_ends_every_wait() -> None:
    ring = SampleRing("s", ("a", "b"), 10)
    waiting = asyncio.ensure_future(RingReader(ring).read(4, 1))
    await asyncio.sleep(0)
    ring.close()
    with pytest.raises(RingClosed):
        await waiting
    with pytest.raises(RingClosed):
        await ring.wait_for(1)


async def test_a_window_around_a_trigger_waits_for_its_end() -> None:
    ring = SampleRing("s", ("a", "b"), 100)
    ring.write(block(0, list(range(10))))
    window = asyncio.ensure_future(ring.window(8, before=5, after=4))
    await asyncio.sleep(0)
    assert not window.done()
    ring.write(block(10, list(range(10, 20))))
    assert (await window)[:, 0].tolist() == list(range(3, 12))


def test_time_follows_the_blocks_and_survives_more_blocks_than_anchors() -> None:
    ring = SampleRing("s", ("a", "b"), 20_000)
    for k in range(6000):
        samples = np.zeros((2, 2), np.float32)
        ring.write(SampleBlock("s", 2 * k, samples, 10_000 + 2000 * k, PERIOD_NS))
    assert ring.time_of(11_999) == 10_000 + 11_999_000
    assert ring.time_of(8_001) == 10_000 + 8_001_000
    assert ring.time_of(12_500) == 10_000 + 12_500_000
    assert ring.time_of(10) == 10_000 + 10_000  # older than any anchor: extrapolated


def test_blocks_that_do_not_follow_are_refused() -> None:
    ring = SampleRing("s", ("a", "b"), 10)
    ring.write(block(0, [1.0]))
    with pytest.raises(ValueError, match="does not follow 1"):
        ring.write(block(3, [1.0]))
    with pytest.raises(ValueError, match="1 channels, the ring 2"):
        ring.write(SampleBlock("s", 1, np.zeros((1, 1), np.float32), 0, 1.0))
