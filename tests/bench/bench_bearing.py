"""How fast the bearing's residual generator and sliding units are, against NumPy sample by sample.

Run by ``make bench``. Prints nanoseconds a sample by block length, the ratio to a NumPy loop over the same
recursions in the same run, and whether the targets are met: 50 ns a sample in blocks of 256 and more, and a
thousand times the loop.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

import numpy as np
from targets import Targets

from daqsvc.bearing.residual import TwoSensorResidual
from daqsvc.bearing.sliding_mode import SlidingGains, SlidingPair
from sim_hw.reproduce.bearing.design import S3
from sim_hw.reproduce.bearing.experiment import DAMPING, INNER_SLOPE, OUTER_SLOPE, STIFFNESS

if TYPE_CHECKING:
    from collections.abc import Callable

RATE_HZ = 48_000.0
BLOCKS = (64, 256, 1024, 4096)
MOST_NS, LEAST_RATIO = 50.0, 1000.0


def best_ns(work: Callable[[], None], samples: int, repeats: int) -> float:
    """Least CPU time of a sample in several rounds, so that what else the machine does counts little."""
    times = []
    for _ in range(9):
        begin = time.process_time_ns()
        for _ in range(repeats):
            work()
        times.append((time.process_time_ns() - begin) / repeats / samples)
    return min(times)


def compiled(block: int) -> float:
    """Nanoseconds a sample of generator and both units, as the service calls them."""
    rng = np.random.default_rng(0)
    y, v = rng.standard_normal((block, 2)), rng.standard_normal(block)
    generator = TwoSensorResidual(S3, RATE_HZ)
    pair = SlidingPair(SlidingGains(inner=1.0, outer=1.0))

    def step() -> None:
        pair.process(generator.process(y, v))

    for _ in range(20):
        step()
    return best_ns(step, block, max(20, 200_000 // block))


def numpy_loop(samples: int) -> float:
    """The generator and the paper's units in their two states, sample by sample, array by array."""
    rng = np.random.default_rng(0)
    y, v = rng.standard_normal((samples, 2)), rng.standard_normal(samples)
    flow = 0.96 * np.eye(6) + 0.04 * np.eye(6, k=1)
    drive, feed, direct = (
        rng.standard_normal((2, 6, 3)),
        rng.standard_normal((2, 3)),
        rng.standard_normal((2, 3)),
    )
    taps = np.array([0.01, -0.13, 1.24, -0.13, 0.01])
    step, units = 0.01, []
    free = np.linalg.inv(np.eye(2) - step * np.array([[0.0, 1.0], [-STIFFNESS, -DAMPING]]))
    for slope in (INNER_SLOPE, OUTER_SLOPE):
        normal = np.array([-slope, 1.0])
        gain = normal / np.linalg.norm(normal)
        units.append((normal @ free, step * gain, normal @ free @ (step * gain)))

    def loop() -> None:
        states, past = np.zeros((2, 6)), np.zeros((5, 3))
        sliding = np.zeros((2, 2))
        for n in range(samples):
            row = np.array([y[n, 0], y[n, 1], v[n]])
            if not np.isfinite(row).all():
                continue
            past = np.vstack((past[1:], row))
            held = taps @ past
            residual = states[:, 0] + feed @ held + direct @ past[2]
            for race in (0, 1):
                states[race] = flow @ states[race] + drive[race] @ held
            for unit, (normal, kick, pull) in enumerate(units):
                forced = sliding[unit] + step * residual
                sign = np.clip(normal @ forced / pull, -1.0, 1.0)
                sliding[unit] = free @ (forced - kick * sign)

    return best_ns(loop, samples, 1)


def main() -> int:
    """Measure and print."""
    targets = Targets()
    by_block = {block: compiled(block) for block in BLOCKS}
    for block, ns in by_block.items():
        print(f"bearing, blocks of {block:4}: {ns:6.1f} ns a sample, {1e3 / ns:5.1f} MS/s")
    worst = max(ns for block, ns in by_block.items() if block >= 256)
    loop = numpy_loop(2_000)
    fastest = by_block[max(BLOCKS)]
    print(f"NumPy sample by sample: {loop / 1e3:.1f} us a sample")
    targets.ask(
        f"at most {MOST_NS:g} ns a sample in blocks of 256 and more", f"{worst:.1f} ns", MOST_NS / worst
    )
    targets.ask(
        f"{LEAST_RATIO:g} times NumPy sample by sample",
        f"{loop / fastest:.0f} times",
        loop / fastest / LEAST_RATIO,
    )
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
