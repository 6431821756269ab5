"""What an accelerometer on a bearing's housing shows: noise, harmonics, and the knocks of a damaged part."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

RATE_HZ = 12_000.0
SPEED_RPM = 1797.0
TURNS_PER_S = SPEED_RPM / 60.0
INNER, OUTER, BALL, CAGE = 5.4152, 3.5848, 4.7135, 0.3983
"""Strikes per revolution of a 6205, of a spot on either race and on a ball; and its cage."""
OPTIONS = ("--channels", "de", "--fs", "12000", "--speed-rpm", "1797", "--bearing", "6205-2RS")


def healthy(seconds: float, seed: int, *, rate_hz: float = RATE_HZ) -> Floats:
    """The machine in good order in g, float64 ``[n]``: coloured noise and harmonics of the shaft."""
    rng = np.random.default_rng(seed)
    n = round(seconds * rate_hz)
    noise = rng.standard_normal(n + 64)
    taps = np.exp(-np.arange(32) / 6.0) * np.cos(2.0 * np.pi * 0.2 * np.arange(32))
    noisy = 0.05 * np.convolve(noise, taps, mode="same")[:n]
    phase = 2.0 * np.pi * TURNS_PER_S * np.arange(n) / rate_hz + rng.uniform(0.0, 6.0)
    for order, amplitude in ((1, 0.02), (2, 0.03), (4, 0.015), (7, 0.005)):
        noisy += amplitude * np.cos(order * phase + order)
    return noisy


def knocks(
    seconds: float,
    order: float,
    seed: int,
    *,
    size: float = 1.0,
    rate_hz: float = RATE_HZ,
    loaded: float = 0.0,
) -> Floats:
    """Strikes of a damaged part in g, float64 ``[n]``: each rings at 3.1 kHz, their distances jitter by 1 %.

    Args:
        seconds: length.
        order: strikes per revolution.
        seed: of the jitter.
        size: amplitude of a strike.
        rate_hz: sampling rate.
        loaded: how much stronger strikes are once a revolution, where the part passes the loaded zone.
    """
    rng = np.random.default_rng(seed)
    n = round(seconds * rate_hz)
    apart_s = 1.0 / (order * TURNS_PER_S)
    times = np.cumsum(apart_s * (1.0 + 0.01 * rng.standard_normal(int(seconds / apart_s) + 2)))
    times = times[times < seconds - 0.01]
    strikes = np.zeros(n)
    strength = 1.0 + loaded * np.cos(2.0 * np.pi * TURNS_PER_S * times)
    np.add.at(strikes, (times * rate_hz).astype(np.int64), size * strength)
    t = np.arange(round(0.008 * rate_hz)) / rate_hz
    return np.convolve(strikes, np.exp(-t / 0.001) * np.sin(2.0 * np.pi * 3100.0 * t))[:n]


@dataclass
class Housing:
    """A recording of one bearing.

    Args:
        seconds: length.
        order: strikes per revolution; None in good order.
        size: amplitude of a strike in g.
        seed: of everything random.
        rate_hz: sampling rate.
    """

    seconds: float = 10.0
    order: float | None = None
    size: float = 0.6
    seed: int = 1
    rate_hz: float = RATE_HZ

    @property
    def samples(self) -> Floats:
        """In g, float64 ``[n]``."""
        samples = healthy(self.seconds, self.seed, rate_hz=self.rate_hz)
        if self.order is not None:
            loaded = 0.8 if self.order == INNER else 0.0
            samples += knocks(
                self.seconds,
                self.order,
                self.seed + 1000,
                size=self.size,
                rate_hz=self.rate_hz,
                loaded=loaded,
            )
        return samples

    def save(self, path: Path, name: str = "de") -> Path:
        """Write it as a file that states no rate."""
        arrays: dict[str, Any] = {name: self.samples}
        np.savez(path, **arrays)
        return path
