"""Accelerations of a bearing's housing, made for the race test: strikes that ring, noise, and a shaft."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter

from daqsvc.bearing.geometry import bearing_orders

if TYPE_CHECKING:
    from numpy.typing import NDArray

RATE_HZ = 12_000.0
SPEED_RPM = 1797.0
BEARING = bearing_orders("6205-2RS")


def strikes(
    part: str | None,
    seconds: float = 5.0,
    *,
    strength: float = 1.0,
    seed: int = 0,
    rate_hz: float = RATE_HZ,
    speed_rpm: float = SPEED_RPM,
) -> NDArray[np.float64]:
    """A bearing with damage of one part, or none: slip, load zone, ringing at 3 kHz, noise, harmonics."""
    random = np.random.default_rng(seed)
    n = int(seconds * rate_hz)
    turn = speed_rpm / 60.0 / rate_hz * np.arange(n)
    x = random.standard_normal(n)
    for harmonic, share in ((1, 0.5), (2, 0.3), (3, 0.2)):
        x += share * np.cos(2 * np.pi * harmonic * turn + harmonic)
    if part is not None:
        order = {"inner": BEARING.inner, "outer": BEARING.outer, "ball": BEARING.ball_pass}[part]
        count = int(order * turn[-1]) + 2
        at = np.cumsum(1.0 + 0.01 * random.standard_normal(count)) / order
        if part == "inner":
            height = 1.0 + 0.8 * np.cos(2 * np.pi * at)
        elif part == "ball":
            height = 1.0 + 0.6 * np.cos(2 * np.pi * BEARING.cage * at)
        else:
            height = np.ones(count)
        place = np.rint(at / turn[1]).astype(int)
        kept = place < n
        impulses = np.zeros(n)
        np.add.at(impulses, place[kept], height[kept])
        pole = np.exp(-2 * np.pi * 200.0 / rate_hz + 2j * np.pi * 3000.0 / rate_hz)
        ringing = lfilter([1.0], [1.0, -pole], impulses).imag
        x += 4.0 * strength * ringing
    return x
