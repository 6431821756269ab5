"""Samples that get lost, at random and by the frame, and the signals that they are lost of."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.signal import butter, sosfilt

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Samples = NDArray[np.floating[Any]]

RATE_HZ = 2000.0
SHARES = (0.02, 0.1, 0.3, 0.5)
FRAMES = (1, 10, 20, 64)
"""Samples in a frame; 1: each by itself."""


def lost(rng: np.random.Generator, samples: Samples, share: float, frame: int) -> NDArray[np.float32]:
    """The samples with about a ``share`` of them NaN, ``frame`` neighbours at a time."""
    count = len(samples)
    frames = rng.random(count // frame + 2) < share
    begin = rng.integers(frame)
    missing = np.repeat(frames, frame)[begin : begin + count]
    gapped = np.array(samples, dtype=np.float32)
    gapped[missing] = np.nan
    return gapped


def tone(rng: np.random.Generator, count: int, rate_hz: float = RATE_HZ) -> NDArray[np.float64]:
    """A shaft's 1X, somewhere from 20 to 80 Hz, of amplitude 1 in 2 % of noise."""
    t, hz = np.arange(count) / rate_hz, rng.uniform(20.0, 80.0)
    return np.sin(2 * np.pi * hz * t + rng.uniform(0.0, 6.28)) + 0.02 * rng.normal(size=count)


def noise(rng: np.random.Generator, count: int, rate_hz: float = RATE_HZ) -> NDArray[np.float64]:
    """White noise of deviation 1."""
    return rng.normal(size=count)


def machine(rng: np.random.Generator, count: int, rate_hz: float = RATE_HZ) -> NDArray[np.float64]:
    """A 1X, a tone of a gear somewhere from 200 to 800 Hz of half its size, and noise of 0.3."""
    t, hz = np.arange(count) / rate_hz, rng.uniform(200.0, 800.0)
    gear = 0.5 * np.sin(2 * np.pi * hz * t + rng.uniform(0.0, 6.28))
    return tone(rng, count, rate_hz) + gear + 0.3 * rng.normal(size=count)


def loud_above(rng: np.random.Generator, count: int, rate_hz: float = RATE_HZ) -> NDArray[np.float64]:
    """A 1X of 0.05 under a loud bearing from 500 to 900 Hz, as its accelerometer hears it."""
    band = butter(4, [500.0, 900.0], "band", fs=rate_hz, output="sos")
    heard: NDArray[np.float64] = sosfilt(band, rng.normal(size=count + 400))[400:]
    return 0.05 * tone(rng, count, rate_hz) + heard


SIGNALS = {"tone": tone, "noise": noise, "machine": machine, "loud above": loud_above}
