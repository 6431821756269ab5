"""Devices that sample one signal on different clocks, and whose blocks come late by chance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.acquisition.alignment import AlignedSource, Aligner
from daqsvc.acquisition.assembler import StreamAssembler

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from daqsvc.acquisition.alignment import AlignedBlock
    from daqsvc.acquisition.clock import DrivenClock
    from daqsvc.acquisition.samples import SampleBlock

    Signal = Callable[[NDArray[np.float64]], NDArray[np.float64]]

START_NS = 5_000_000_000
BLOCKS_PER_S = 100
LATEST_NS = 5e6


def uniform(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Anything from 0 to 5 ms."""
    return rng.uniform(0.0, LATEST_NS, n)


def exponential(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """1.2 ms on average, without a limit."""
    return rng.exponential(1.2e6, n)


def bursts(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Every now and then some 25 blocks in a row are 1 to 4 ms later still: the host is busy."""
    late, at = uniform(n, rng), 0
    while at < n:
        calm, busy = int(rng.exponential(40)), int(rng.exponential(25))
        late[at + calm : at + calm + busy] += rng.uniform(1e6, 4e6)
        at += calm + busy + 1
    return late


def busy(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Uniform, but for two spells of 1 to 4 s in which all are 5 ms later still."""
    late = uniform(n, rng)
    for _ in range(2):
        begin = int(rng.integers(0, n))
        late[begin : begin + int(rng.uniform(1.0, 4.0) * BLOCKS_PER_S)] += 5e6
    return late


def rarely_small(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """99 of 100 blocks are 2 to 5 ms late, the others 0 to 5."""
    return np.where(rng.random(n) < 0.01, rng.uniform(0.0, LATEST_NS, n), rng.uniform(2e6, LATEST_NS, n))


def soft(n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """0 to 5 ms, with a probability that begins at nothing."""
    return LATEST_NS * np.sqrt(rng.random(n))


@dataclass
class Device:
    """A device on the way to an aligner.

    Attributes:
        stream: its name.
        rate_hz: its nominal rate.
        ppm: by how much its clock is fast.
        delays: how late its blocks are.
        latency_ns: what every one of them is late besides.
        begins_ns: when it takes its first sample.
        silent_s: from when to when nothing comes from it.
        lost: share of its blocks that are lost.
    """

    stream: str
    rate_hz: float = 6400.0
    ppm: float = 0.0
    delays: Callable[[int, np.random.Generator], NDArray[np.float64]] = uniform
    latency_ns: float = 0.0
    begins_ns: float = START_NS
    silent_s: tuple[float, float] = (np.inf, np.inf)
    lost: float = 0.0
    blocks: int = 0

    @property
    def per_block(self) -> int:
        return round(self.rate_hz / BLOCKS_PER_S)

    @property
    def period_ns(self) -> float:
        return 1e9 / self.rate_hz / (1.0 + self.ppm * 1e-6)

    def taken_ns(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """When samples are taken, in ns after `START_NS`."""
        return np.asarray(self.begins_ns - START_NS + index * self.period_ns, np.float64)


def arrivals(device: Device, duration_s: float, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Pairs of arrival time and block number, in order of arrival."""
    n = int(duration_s * BLOCKS_PER_S)
    taken_ns = device.taken_ns((np.arange(n) + 1) * device.per_block - 1)
    late_ns = np.maximum.accumulate(taken_ns + device.delays(n, rng) + device.latency_ns)
    arrival_ns = (START_NS + late_ns).astype(np.int64)
    come = rng.random(n) >= device.lost
    come &= (taken_ns < device.silent_s[0] * 1e9) | (taken_ns >= device.silent_s[1] * 1e9)
    device.blocks = int(come.sum())
    return [(int(arrival_ns[k]), int(k)) for k in np.flatnonzero(come)]


def play(
    devices: Sequence[Device],
    signal: Signal,
    duration_s: float,
    seed: int,
    deliver: Callable[[SampleBlock], None],
    *,
    stalled_s: tuple[float, float] = (np.inf, np.inf),
    clock: DrivenClock | None = None,
) -> None:
    """Send a signal, which is a function of the time in ns after `START_NS`, through the devices.

    While the receiver is stalled nothing is read. What has come meanwhile is read at once, one stream
    after the other. A clock is driven along.
    """
    stall_ns = [START_NS + t * 1e9 for t in stalled_s]
    rng = np.random.default_rng(seed)
    events = []
    for device in devices:
        assembler = StreamAssembler(
            device.stream,
            device.rate_hz,
            counter_bits=32,
            samples_per_frame=device.per_block,
            counts_per_frame=device.per_block,
            deliver=deliver,
        )
        events += [(t, device.stream, k, device, assembler) for t, k in arrivals(device, duration_s, rng)]
    read = [(int(stall_ns[1]) if stall_ns[0] <= e[0] < stall_ns[1] else e[0], *e[1:]) for e in events]
    for arrival_ns, _, block, device, assembler in sorted(read, key=lambda event: event[:3]):
        if clock is not None:
            clock.advance_to(arrival_ns)
        index = block * device.per_block + np.arange(device.per_block)
        samples = signal(device.taken_ns(index)).astype(np.float32)
        assembler.accept(
            index[:1], samples[None, :, None], np.ones(1, np.bool_), np.array([arrival_ns], np.int64)
        )


@dataclass
class Rows:
    """What came out of an aligner, joined.

    Attributes:
        first_index: of the first row.
        samples: float32 ``[n, channels]``.
        error_ns: float64 ``[n]``, what was said of the second source.
    """

    first_index: int
    samples: NDArray[np.float32]
    error_ns: NDArray[np.float64]


def aligned(
    devices: Sequence[Device],
    signal: Signal,
    duration_s: float,
    seed: int,
    *,
    stalled_s: tuple[float, float] = (np.inf, np.inf),
    **options: Any,
) -> tuple[Aligner, Rows]:
    """The rows of a grid over devices, the reference first; checks that none is left out or doubled."""
    blocks: list[AlignedBlock] = []
    sources = [AlignedSource(d.stream, ("a",), d.rate_hz, round(d.latency_ns)) for d in devices]
    aligner = Aligner("grid", sources, blocks.append, **options)
    play(
        devices,
        signal,
        duration_s,
        seed,
        aligner.accept,
        stalled_s=stalled_s,
        clock=options.get("clock"),
    )
    end = blocks[0].first_index
    for block in blocks:
        assert block.first_index == end
        assert block.lost_before == 0
        end += len(block.samples)
    samples = np.concatenate([block.samples for block in blocks])
    error_ns = np.concatenate([np.full(len(b.samples), b.error_ns[1]) for b in blocks])
    return aligner, Rows(blocks[0].first_index, samples, error_ns)
