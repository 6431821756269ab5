"""A device whose rate is not the one in the machine file is found out, and nothing else is taken for it."""

import logging
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples, first_of

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.standing import StreamState
from daqsvc.acquisition.timebase import rate_in_words

pytestmark = pytest.mark.property
PER_FRAME = 10
START_NS = 3_000_000_000


@pytest.fixture(autouse=True)
def _quiet(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.CRITICAL)


class Stream:
    """A stream of 1000 Hz as the machine file says it, and what is reported about it."""

    def __init__(self, bits: int | None = 32, *, stamped: bool = False) -> None:
        self.told: list[tuple[int, StreamState]] = []
        self.now_ns = 0
        self.unit = StreamAssembler(
            "s",
            1000.0,
            counter_bits=bits,
            samples_per_frame=PER_FRAME,
            counts_per_frame=1,
            deliver=lambda _: None,
            stamped=stamped,
            tell=lambda _, standing: self.told.append((self.now_ns, standing)),
        )

    def play(self, counter: np.ndarray, arrival_ns: np.ndarray) -> None:
        for at in range(len(counter)):
            some = slice(at, at + 1)
            self.now_ns = int(arrival_ns[at])
            samples = np.ones((1, PER_FRAME, 1), np.float32)
            self.unit.accept(counter[some], samples, np.ones(1, bool), arrival_ns[some])
            self.unit.tick(self.now_ns)

    @property
    def doubts(self) -> list[str]:
        said = [standing.doubt.partition(";")[0] for _, standing in self.told if standing.doubt]
        return [doubt for doubt, _ in groupby(said)]  # each is told again while frames come


def sent(rate_hz: float, seconds: float, seed: int, since_s: float = 0.0) -> np.ndarray:
    """Arrivals of frames, ns, with up to 4 ms of delay."""
    n = round(seconds * rate_hz / PER_FRAME)
    t_ns = (since_s + np.arange(n) * PER_FRAME / rate_hz) * 1e9
    late_ns = np.random.default_rng(seed).uniform(0, 4e6, n)
    return START_NS + np.maximum.accumulate(t_ns + late_ns).astype(np.int64)


def sentence(hz: float) -> str:
    return f"the device sends {hz:g} Hz, the file states 1000"


@pytest.mark.parametrize("hz", [500.0, *first_of(5000.0, 900.0, 1100.0, 2000.0)])
@pytest.mark.parametrize("bits", [None, *first_of(32, 8)])
def test_another_rate_is_said_before_anything_is_judged(hz: float, bits: int | None) -> None:
    stream = Stream(bits)
    arrival_ns = sent(hz, 12.0 if bits or abs(hz - 1000) > 200 else 200.0, 1)
    stream.play(np.arange(len(arrival_ns)) % 2 ** (bits or 32), arrival_ns)
    assert len(stream.doubts) == 1
    (told_ns, found), *_ = [(t, s) for t, s in stream.told if s.doubt]
    assert float(found.doubt.split()[3]) == pytest.approx(hz, rel=0.02)
    if abs(hz - 1000) > 200:
        assert told_ns - START_NS < 6.1e9
        assert not any(standing.proven and not standing.doubt for _, standing in stream.told)
    state = stream.unit.time_base
    assert state.doubt == found.doubt
    if bits:
        assert state.rate_hz == pytest.approx(hz, rel=0.01), "the time stamps follow the device"


def test_lines_with_time_stamps_are_counted_by_their_arrivals() -> None:
    """Of a device at half the rate, its stamps make every other sample a missing one."""
    stream = Stream(32, stamped=True)
    arrival_ns = sent(500.0, 12.0, 1)
    stream.play(2 * np.arange(len(arrival_ns)), arrival_ns)
    assert len(stream.doubts) == 1
    assert float(stream.doubts[0].split()[3]) == pytest.approx(500, rel=0.02)


def test_it_is_over_when_the_device_has_the_rate_again() -> None:
    stream = Stream()
    slow, right = sent(500.0, 10.0, 1), sent(1000.0, 30.0, 2, since_s=10.02)
    stream.play(np.arange(len(slow) + len(right)), np.concatenate([slow, right]))
    assert stream.doubts == [sentence(500)]
    assert stream.told[-1][1] == StreamState("", proven=True)
    assert stream.unit.counters.samples_lost == 0


def one_by_one(stated_hz: float, late: dict[int, float], frames: int = 20, hz: float | None = None) -> Stream:
    """A stream of one sample in a frame from its start on; some frames are late by a part of their period."""
    stream = Stream()
    stream.unit = StreamAssembler(
        "s",
        stated_hz,
        counter_bits=16,
        samples_per_frame=1,
        counts_per_frame=1,
        deliver=lambda _: None,
        tell=lambda _, standing: stream.told.append((stream.now_ns, standing)),
    )
    period_ns = 1e9 / (hz or stated_hz)
    for at in range(frames):
        stream.now_ns = START_NS + round((at + late.get(at, 0.0)) * period_ns)
        come = np.array([at]), np.ones((1, 1, 1), np.float32), np.ones(1, bool)
        stream.unit.accept(*come, np.array([stream.now_ns], np.int64))
    return stream


@pytest.mark.parametrize("late", [{2: 0.4}, {0: 0.3, 1: 0.15}, {1: 0.2, 2: 0.35}], ids=str)
@pytest.mark.parametrize("hz", [0.5, 0.2])
def test_a_slow_device_with_a_late_frame_at_its_start_has_its_rate(hz: float, late: dict[int, float]) -> None:
    stream = one_by_one(hz, late)
    assert stream.doubts == []
    assert stream.unit.time_base.rate_hz == pytest.approx(hz, rel=0.02)


def test_a_slow_device_of_another_rate_is_found_out_by_eight_frames() -> None:
    assert one_by_one(0.5, {}, 7, hz=0.8).doubts == []
    stream = one_by_one(0.5, {}, 8, hz=0.8)
    assert stream.doubts == ["the device sends 0.8 Hz, the file states 0.5"]


@pytest.mark.long
@pytest.mark.parametrize("hz", [500.0, 2000.0])
def test_a_device_that_changes_its_rate_while_it_is_watched_is_found_out(hz: float) -> None:
    stream = Stream()
    right, wrong = sent(1000.0, 70.0, 1), sent(hz, 30.0, 2, since_s=70.01)
    stream.play(np.arange(len(right) + len(wrong)), np.concatenate([right, wrong]))
    assert len(stream.doubts) == 1
    assert float(stream.doubts[0].split()[3]) == pytest.approx(hz, rel=0.05)
    assert next(t_ns for t_ns, standing in stream.told if standing.doubt) - START_NS < 86e9


@pytest.mark.long
@settings(deadline=None, max_examples=examples(25))
@given(
    seed=st.integers(0, 2**31),
    bits=st.sampled_from([8, 32, None]),
    loss=st.sampled_from([0.0, 0.01, 0.1, 0.3, 0.5]),
    jitter_ms=st.sampled_from([0.5, 10.0]),
    stalls=st.lists(st.tuples(st.floats(0, 25), st.floats(0.05, 4.0)), max_size=4),
    away=st.lists(st.tuples(st.floats(0, 25), st.floats(0.05, 5.0)), max_size=2),
    backlog_s=st.sampled_from([0.0, 0.5, 2.0]),
    ppm=st.floats(-2000, 2000),
)
def test_nothing_that_happens_on_a_link_is_taken_for_another_rate(
    seed, bits, loss, jitter_ms, stalls, away, backlog_s, ppm
) -> None:
    """Loss, jitter, stalls after which all comes at once, outages, and a backlog at the start."""
    rng = np.random.default_rng(seed)
    n = 3000
    taken_s = np.arange(n) * 0.01 / (1 + ppm * 1e-6)
    arrival_s = taken_s + rng.uniform(0, jitter_ms / 1000, n)
    arrival_s = np.maximum(arrival_s, backlog_s)
    come = rng.random(n) >= loss
    for since, for_s in stalls:
        held = (arrival_s >= since) & (arrival_s < since + for_s)
        arrival_s[held] = since + for_s
    for since, for_s in away:
        come &= (arrival_s < since) | (arrival_s >= since + for_s)
    arrival_ns = START_NS + np.maximum.accumulate(np.rint(arrival_s * 1e9)).astype(np.int64)
    stream = Stream(bits)
    stream.play((np.arange(n) % 2 ** (bits or 32))[come], arrival_ns[come])
    assert stream.doubts == []


def test_a_stream_that_fits_is_proven_within_a_second() -> None:
    stream = Stream()
    arrival_ns = sent(1000.0, 1.0, 3)
    stream.play(np.arange(len(arrival_ns)), arrival_ns)
    assert [standing for _, standing in stream.told] == [
        StreamState("", proven=False),
        StreamState("", proven=True),
    ]
    assert stream.told[-1][0] - START_NS < 0.7e9


def test_what_ends_too_soon_to_be_measured_is_judged_as_it_is() -> None:
    stream = Stream()
    arrival_ns = sent(1000.0, 0.2, 3)
    stream.play(np.arange(len(arrival_ns)), arrival_ns)
    stream.unit.flush()
    assert stream.told[-1][1] == StreamState("", proven=True)


@pytest.mark.parametrize(
    ("rate_hz", "samples_per_count", "remedy"),
    [
        (3601.0, 3, 'write counts = "samples" for the counter'),
        (3601.0, 1, "correct rate_hz in the machine file"),
        (2400.0, 3, "correct rate_hz in the machine file"),
    ],
)
def test_a_rate_that_is_wrong_by_the_samples_of_a_frame_may_be_a_wrong_counts(
    rate_hz: float, samples_per_count: int, remedy: str
) -> None:
    words = rate_in_words(rate_hz, 1e9 / 1200.0, samples_per_count)
    assert words.startswith(f"the device sends {rate_hz:g} Hz, the file states 1200")
    assert remedy in words
