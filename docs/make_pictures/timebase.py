"""The time base: arrivals with jitter, and the line under the earliest of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.acquisition.timebase import BUCKET_NS, TimeBase
from make_pictures.style import BLACK, FAULTY, HEALTHY, QUIET, new

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

RATE_HZ, SAMPLES_PER_FRAME = 6400.0, 128
CLOCK_PPM = 50.0
"""By how much the device samples faster than its nominal rate."""
LATENCY_MS, JITTER_MS = 2.0, 10.0
SECONDS = 12.0
STALL_S = (7.0, 7.5)
"""In which nothing is read: all of it comes at its end."""


def arrivals() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """When the last sample of each frame was taken, and when the frame came, in s, float64 ``[n]`` each."""
    count = int(SECONDS * RATE_HZ / SAMPLES_PER_FRAME)
    period_s = 1.0 / (RATE_HZ * (1.0 + 1e-6 * CLOCK_PPM))
    taken = 1.0 + (np.arange(1, count + 1) * SAMPLES_PER_FRAME - 1) * period_s
    late = 1e-3 * (LATENCY_MS + np.random.default_rng(5).uniform(0.0, JITTER_MS, count))
    came = taken + late
    stalled = (came > 1.0 + STALL_S[0]) & (came < 1.0 + STALL_S[1])
    came[stalled] = 1.0 + STALL_S[1]
    return taken, np.maximum.accumulate(came)


def picture() -> Figure:
    """Above how late each frame came, and what the time base made of it; below how far its line was off."""
    taken, came = arrivals()
    base = TimeBase(RATE_HZ, 32, SAMPLES_PER_FRAME, SAMPLES_PER_FRAME)
    at, line, error = [], [], []
    for number in range(len(taken)):
        counter = np.array([number * SAMPLES_PER_FRAME])
        base.place(counter, np.array([round(came[number] * 1e9)]))
        last = (number + 1) * SAMPLES_PER_FRAME - 1
        at.append(taken[number] - 1.0)
        line.append(1e-6 * (base.time_of(last) - 1e9 * taken[number]))
        error.append(1e-6 * base.error_at(last))
    late_ms = 1e3 * (came - taken)
    seconds, line_ms, error_ms = np.array(at), np.array(line), np.array(error)
    bucket = ((came - 1.0) * 1e9 // BUCKET_NS).astype(int)
    first = [int(np.flatnonzero(bucket == b)[np.argmin(late_ms[bucket == b])]) for b in np.unique(bucket)]
    figure = new(4.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1.0))
    upper.plot(seconds, late_ms, ".", color=QUIET, markersize=2.5, label="arrivals")
    earliest = f"the earliest of each {BUCKET_NS / 1e9:g} s"
    upper.plot(seconds[first], late_ms[first], ".", color=BLACK, markersize=4, label=earliest)
    upper.plot(seconds, line_ms, color=HEALTHY, linewidth=2.0, label="line of the time base")
    upper.set_ylim(0.0, 15.5)
    upper.set_ylabel("ms after the sample")
    upper.set_title(
        f"A device {CLOCK_PPM:g} ppm fast; each frame {LATENCY_MS:g} to {LATENCY_MS + JITTER_MS:g} ms late, "
        f"and a stall of {STALL_S[1] - STALL_S[0]:g} s"
    )
    for axes in (upper, lower):
        axes.axvspan(*STALL_S, color=BLACK, alpha=0.1, linewidth=0)
    upper.legend(loc="upper left", ncols=3)
    known = np.isfinite(error_ms)
    off = line_ms - LATENCY_MS
    stated, true = "error that it states, 95 %", "true error, beside the constant delay"
    band = (-error_ms[known], error_ms[known])
    lower.fill_between(seconds[known], *band, color=HEALTHY, alpha=0.2, linewidth=0, label=stated)
    lower.plot(seconds[known], off[known], color=FAULTY, linewidth=1.4, label=true)
    lower.set_ylim(-0.75, 0.75)
    lower.set_xlim(0.0, SECONDS)
    lower.set_ylabel("ms")
    lower.set_xlabel("s since the first frame")
    lower.legend(loc="upper right", ncols=2)
    return figure
