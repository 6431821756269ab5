"""Two devices with different clocks on one grid: the same signal by arrival, and as the grid has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.alignment import AlignedBlock, AlignedSource, Aligner
from daqsvc.acquisition.assembler import StreamAssembler
from make_pictures.style import FAULTY, HEALTHY, new

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

START_NS = 5_000_000_000
RATE_HZ, PER_BLOCK, SECONDS = 1600.0, 16, 20.0
SIGNAL_HZ = 25.0
LATEST_MS = 5.0


@dataclass(frozen=True)
class Device:
    """One that samples the signal.

    Attributes:
        stream: its name.
        ppm: by how much its clock is fast.
        latency_ms: of all its blocks; besides, each is late by 0 to 5 ms by chance.
    """

    stream: str
    ppm: float
    latency_ms: float

    def taken_s(self, index: NDArray[np.int64]) -> Floats:
        """When samples are taken, in s after the start."""
        return np.asarray(index / (RATE_HZ * (1.0 + 1e-6 * self.ppm)), dtype=np.float64)


DEVICES = (Device("keyphasor", 50.0, 2.0), Device("probe", -50.0, 7.0))


def signal(seconds: Floats) -> Floats:
    """What both devices sample."""
    return np.asarray(np.sin(2.0 * np.pi * SIGNAL_HZ * seconds), dtype=np.float64)


def play() -> tuple[list[AlignedBlock], dict[str, Floats]]:
    """The grid's blocks, and by stream when each block came, in s after the start, less its latency."""
    random, blocks = np.random.default_rng(4), []
    sources = [AlignedSource(d.stream, ("a",), RATE_HZ, round(1e6 * d.latency_ms)) for d in DEVICES]
    aligner = Aligner("grid", sources, blocks.append)
    came, events = {}, []
    for place, device in enumerate(DEVICES):
        count = int(SECONDS * RATE_HZ / PER_BLOCK)
        last_s = device.taken_s((np.arange(count) + 1) * PER_BLOCK - 1)
        late_s = 1e-3 * (device.latency_ms + random.uniform(0.0, LATEST_MS, count))
        arrival_s = np.maximum.accumulate(last_s + late_s)
        came[device.stream] = arrival_s - 1e-3 * device.latency_ms
        assembler = StreamAssembler(
            device.stream,
            RATE_HZ,
            counter_bits=32,
            samples_per_frame=PER_BLOCK,
            counts_per_frame=PER_BLOCK,
            deliver=aligner.accept,
        )
        events += [(START_NS + round(1e9 * t), place, k, assembler) for k, t in enumerate(arrival_s)]
    for arrival_ns, place, block, assembler in sorted(events, key=lambda event: event[:3]):
        index = block * PER_BLOCK + np.arange(PER_BLOCK)
        samples = signal(DEVICES[place].taken_s(index)).astype(np.float32)[None, :, None]
        assembler.accept(index[:1], samples, np.ones(1, np.bool_), np.array([arrival_ns]))
    return blocks, came


def picture() -> Figure:
    """Left by arrival, right on the grid; below how far the grid is off, by the phase of the signal."""
    blocks, came = play()
    figure = new(4.4)
    axes = figure.subplot_mosaic([["arrival", "grid"], ["error", "error"]], height_ratios=(1.3, 1.0))
    begin_s, end_s = 15.0, 15.1
    for device, color in zip(DEVICES, (HEALTHY, FAULTY), strict=True):
        index = np.arange(int(SECONDS * RATE_HZ))
        # Taken by itself a block would be placed by its arrival.
        at = came[device.stream][index // PER_BLOCK] + (index % PER_BLOCK - PER_BLOCK + 1) / RATE_HZ
        shown = (at > begin_s) & (at < end_s)
        axes["arrival"].plot(
            at[shown],
            signal(device.taken_s(index[shown])),
            ".",
            color=color,
            markersize=4,
            label=device.stream,
        )
    samples = np.concatenate([block.samples for block in blocks]).astype(np.float64)
    rows = blocks[0].first_index + np.arange(len(samples))
    taken = DEVICES[0].taken_s(rows)
    shown = (taken > begin_s) & (taken < end_s)
    for column, color, size in ((0, HEALTHY, 6), (1, FAULTY, 2.5)):
        axes["grid"].plot(taken[shown], samples[shown, column], ".", color=color, markersize=size)
    axes["arrival"].set_title("placed by arrival")
    axes["arrival"].set_ylabel("signal, amplitudes")
    axes["arrival"].legend(loc="lower center", ncols=2)
    axes["grid"].set_title("on the grid")
    for name in ("arrival", "grid"):
        axes[name].set_xlim(begin_s, end_s)
        axes[name].set_ylim(-1.6, 1.2)
        axes[name].set_xlabel("s")
    error(axes["error"], taken, samples[:, 1], blocks)
    return figure


def error(axes: Axes, taken: Floats, values: Floats, blocks: list[AlignedBlock]) -> None:
    """How far the second stream is off on the grid, period by period of the signal, and what is stated."""
    period = round(RATE_HZ / SIGNAL_HZ)
    count = len(values) // period * period
    turned = values[:count] * np.exp(-2j * np.pi * SIGNAL_HZ * taken[:count])
    phase = np.angle(1j * turned.reshape(-1, period).mean(axis=1))
    at = taken[:count].reshape(-1, period).mean(axis=1)
    stated_us = np.repeat([1e-3 * block.error_ns[1] for block in blocks], [len(b.samples) for b in blocks])
    band = np.where(np.isfinite(stated_us), stated_us, np.nan)[::period]
    stated = "error that it states, 95 %"
    axes.fill_between(taken[::period], -band, band, color=HEALTHY, alpha=0.2, linewidth=0, label=stated)
    axes.plot(at, 1e6 * phase / (2.0 * np.pi * SIGNAL_HZ), color=FAULTY, linewidth=1.4, label="true error")
    axes.set_ylim(-320.0, 200.0)
    axes.set_xlim(0.0, SECONDS)
    axes.set_ylabel("error, us")
    axes.set_xlabel("s since the start; before the first value the grid has not begun")
    axes.legend(loc="lower right", ncols=2)
