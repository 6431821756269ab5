"""Streams on one grid after the process stood still: what comes late and at once is not lost to it."""

from __future__ import annotations

import numpy as np
import pytest
from support.aligned_streams import START_NS, Device, aligned, exponential, uniform
from support.examples import first_of
from test_alignment_grid import START_NS as GRID_START_NS
from test_alignment_grid import WAIT_NS, blocks_of, joined, sine

from daqsvc.acquisition.alignment import AlignedSource, Aligner
from daqsvc.acquisition.clock import DrivenClock

pytestmark = pytest.mark.property
SOURCES = [AlignedSource(name, ("x",), 1000.0) for name in "ab"]
CUTS = list(range(0, 9001, 10))


def taken_ns(block):
    return block.t_first_ns + round(len(block.samples) * block.period_ns)


def read_after(blocks, stall_ms):
    """Pairs of when a block is read and the block: none during the stall, then one stream after the other."""
    begin_ns, end_ns = (GRID_START_NS + t * 1_000_000 for t in stall_ms)
    times = [end_ns if begin_ns <= taken_ns(b) < end_ns else taken_ns(b) for b in blocks]
    return sorted(zip(times, blocks, strict=True), key=lambda read: (read[0], read[1].stream))


@pytest.mark.parametrize("first", ["a", "b"])
def test_the_buffers_of_one_stream_are_read_before_those_of_the_next(first) -> None:
    """Five seconds of one stream, the reference or the other one, and only then those of the other."""
    rows = []
    clock = DrivenClock(GRID_START_NS)
    sources = sorted(SOURCES, key=lambda source: source.stream != first)
    aligner = Aligner("grid", sources, rows.append, max_wait_ns=WAIT_NS, clock=clock)
    blocks = [block for name in "ab" for block in blocks_of(name, 1000.0, sine(50.0), CUTS)]
    for read_ns, block in read_after(blocks, (2000, 7000)):
        clock.advance_to(read_ns)
        aligner.accept(block)
    assert np.isfinite(joined(rows)[17:]).all()
    assert len(joined(rows)) > 8900


@pytest.mark.parametrize("dead", ["a", "b"])
def test_by_the_clock_a_dead_stream_is_waited_for_no_longer_than_by_the_samples(dead) -> None:
    rows = []
    clock = DrivenClock(GRID_START_NS)
    aligner = Aligner("grid", SOURCES, rows.append, max_wait_ns=WAIT_NS, clock=clock)
    lost = {dead: [(1000, 9000)]}
    blocks = [b for name in "ab" for b in blocks_of(name, 1000.0, sine(50.0), CUTS, lost=lost.get(name, []))]
    behind = []
    for block in sorted(blocks, key=taken_ns):
        clock.advance_to(taken_ns(block))
        aligner.accept(block)
        made = rows[-1].first_index + len(rows[-1].samples) if rows else 0
        behind.append((clock.monotonic_ns() - GRID_START_NS) // 1_000_000 - made)
    assert max(behind) <= 200 + 16 + 40
    alive = "ba".index(dead)
    assert np.isfinite(joined(rows)[17:, alive]).all()
    assert np.isnan(joined(rows)[1020:, 1 - alive]).all()


def test_what_comes_for_longer_than_is_remembered_is_not_forgotten_for_the_others_sake() -> None:
    """Twenty seconds of the reference at once: what would fall out of memory goes out alone."""
    rows = []
    aligner = Aligner("grid", SOURCES, rows.append, max_wait_ns=WAIT_NS, clock=DrivenClock(GRID_START_NS))
    cuts = list(range(0, 21_001, 10))
    a, b = (blocks_of(name, 1000.0, sine(50.0), cuts) for name in "ab")
    for block in [*a[:10], *b[:10], *a[10:], *b[10:]]:
        aligner.accept(block)
    there = np.isfinite(joined(rows))
    assert there[:, 0].all()
    # The last seconds were still waited for.
    assert there[-7000:].all()
    assert len(there) > 20_800


@pytest.mark.parametrize("delays", [uniform, exponential])
@pytest.mark.parametrize("seed", first_of(0, 1))
def test_a_stall_without_loss_costs_no_row_and_no_trust(delays, seed) -> None:
    """Five seconds in which nothing is read, after 25 s; then all of it comes with one time of arrival."""
    devices = [
        Device("a", 1600.0, 20.0, delays=delays, latency_ns=1e6),
        Device("b", 2000.0, -20.0, delays=delays, latency_ns=3e6, begins_ns=5_001_234_567.0),
    ]
    _, rows = aligned(
        devices,
        sine(25.0),
        38.0,
        seed,
        stalled_s=(25.0, 30.0),
        clock=DrivenClock(START_NS),
    )
    after = slice(25 * 1600 - rows.first_index, None)
    assert np.isfinite(rows.samples[after]).all()
    assert rows.error_ns[after].max() < 200_000.0
    error_s = np.abs(rows.samples[after, 1] - rows.samples[after, 0]).max() / (2 * np.pi * 25.0)
    assert error_s < 100e-6
