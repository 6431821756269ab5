"""Chunks of trends: what goes in comes out, within what rounding allows; nothing else is taken for one."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daqsvc.history.points import (
    FORM,
    MANTISSA_BITS,
    MOST,
    RECORD,
    DamagedChunkError,
    Step,
    empty,
    gathered,
    merge,
    pack,
    spread,
    summed_up,
    unpack,
    weighed,
)

values = st.floats(width=32, allow_infinity=False, allow_subnormal=False).filter(lambda v: not abs(v) >= MOST)


@given(step=st.sampled_from(Step), some=st.lists(values, min_size=1, max_size=50), seed=st.integers(0, 99))
def test_a_chunk_comes_out_as_it_went_in(step: Step, some: list[float], seed: int) -> None:
    dense = empty(step)
    places = np.random.default_rng(seed).integers(0, dense.size, len(some))
    dense.reshape(-1)[places] = some
    found = unpack(pack(dense), step)
    assert found.shape == dense.shape
    assert (np.isnan(found) == np.isnan(dense)).all()
    known = ~np.isnan(dense)
    np.testing.assert_allclose(found[known], dense[known], rtol=2.0 ** -(MANTISSA_BITS + 1))


@given(st.binary(max_size=200))
def test_what_is_no_chunk_is_refused(data: bytes) -> None:
    with pytest.raises(DamagedChunkError):
        unpack(data, Step.HOUR)


def test_a_chunk_of_another_step_is_refused() -> None:
    for other in (Step.SECOND, Step.HOUR):
        with pytest.raises(DamagedChunkError):
            unpack(pack(empty(other)), Step.MINUTE)


def test_a_chunk_that_unpacks_to_far_more_is_not_unpacked() -> None:
    bomb = pack(np.full((3, 4_000_000), 1.0, np.float32))
    assert len(bomb) < 100_000
    with pytest.raises(DamagedChunkError, match="is not of 8640 bytes"):
        unpack(bomb, Step.HOUR)


def records(*rows: tuple[int, int, float, float, float]) -> np.ndarray:
    return np.array(list(rows), RECORD)


def test_seconds_sum_up_to_minutes_weighed_by_their_statements() -> None:
    seconds = records((59, 1, 5, 5, 5), (60, 3, 1, 2, 3), (61, 4, -4, 3, 9), (60, 1, 2, 4, 2))
    minutes = summed_up(seconds, Step.MINUTE)
    assert minutes.tolist() == [(0, 1, 5, 5, 5), (60, 8, -4, 2.75, 9)]


@given(st.lists(st.tuples(st.integers(0, 3599), st.floats(-1e6, 1e6, width=32)), max_size=80))
def test_whatever_the_order_sums_agree(rows: list[tuple[int, float]]) -> None:
    seconds = records(*((t, 1, v, v, v) for t, v in rows))
    at_once = summed_up(seconds, Step.HOUR)
    by_minutes = summed_up(summed_up(seconds[::-1], Step.MINUTE), Step.HOUR)
    assert at_once["n"].tolist() == by_minutes["n"].tolist() == ([len(rows)] if rows else [])
    assert at_once["low"].tolist() == by_minutes["low"].tolist()
    assert at_once["high"].tolist() == by_minutes["high"].tolist()
    np.testing.assert_allclose(at_once["mean"], by_minutes["mean"], rtol=1e-4, atol=1.0)


def test_points_find_their_places_and_back() -> None:
    begin_s = 5 * Step.MINUTE.span_s
    minutes = records((begin_s + 60, 1, 1, 2, 3), (begin_s + 86_340, 1, 4, 5, 6))
    dense = spread(minutes, Step.MINUTE, begin_s)
    assert np.flatnonzero(~np.isnan(dense[1])).tolist() == [1, 1439]
    assert gathered(dense, Step.MINUTE, begin_s).tolist() == minutes.tolist()


def test_where_a_clock_was_set_back_extremes_of_both_stay() -> None:
    first = spread(records((0, 1, 1, 2, 3), (60, 1, 1, 1, 1)), Step.MINUTE, 0)
    second = spread(records((0, 1, 2, 4, 9)), Step.MINUTE, 0)
    assert gathered(merge(first, second), Step.MINUTE, 0).tolist() == [(0, 1, 1, 4, 9), (60, 1, 1, 1, 1)]


def test_how_many_statements_there_were_is_kept_with_their_mean() -> None:
    for step in Step:
        points = records((0, 7, 2, 2, 2), (step, 123_456, 3, 3, 3))
        found = gathered(unpack(pack(spread(points, step, 0)), step), step, 0)
        assert found["n"].tolist() == pytest.approx([7, 123_456], rel=2e-5)
        later = spread(records((step, 2, 4, 4, 4)), step, 0)
        assert gathered(merge(spread(points, step, 0), later), step, 0)["n"].tolist() == [7, 2]


def without_numbers(chunk: bytes) -> bytes:
    """As it was written before numbers were kept."""
    return FORM + zlib.compress(zlib.decompressobj().decompress(chunk[1:]))


@pytest.mark.parametrize(("step", "rows"), [(Step.SECOND, 1), (Step.MINUTE, 3), (Step.HOUR, 3)])
def test_chunks_of_old_are_read_and_those_of_today_by_versions_of_old(step: Step, rows: int) -> None:
    chunk = pack(spread(records((0, 7, 1, 2, 3), (step, 9, 4, 5, 6)), step, 0))
    # What a version of old asks of a chunk.
    unzip = zlib.decompressobj()
    assert len(unzip.decompress(chunk[1:], rows * 4 * step.span_s // step)) == rows * 4 * step.span_s // step
    assert unzip.eof
    assert not unzip.unconsumed_tail
    found = gathered(unpack(without_numbers(chunk), step), step, 0)
    assert found["mean"].tolist() == [2, 5]
    assert found["n"].tolist() == [0, 0], "not known"


def test_points_without_a_number_weigh_as_a_usual_one() -> None:
    packed = records((0, 0, 1, 1, 1), (60, 0, 2, 2, 2), (120, 50, 3, 3, 3))
    assert weighed(packed, records((180, 60, 4, 4, 4), (240, 2, 5, 5, 5)))["n"].tolist() == [
        50,
        50,
        50,
        60,
        2,
    ]
    assert weighed(packed[:2], records())["n"].tolist() == [1, 1]


@pytest.mark.parametrize("count", [0.0, -1.0, np.nan, np.inf, 1e20])
def test_a_number_that_cannot_be_is_not_known(count: float) -> None:
    dense = spread(records((0, 7, 1, 2, 3)), Step.HOUR, 0)
    dense[-1, 0] = count
    assert gathered(dense, Step.HOUR, 0).tolist() == [(0, 0, 1, 2, 3)]
