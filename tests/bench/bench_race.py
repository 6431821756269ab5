"""What the race test costs: the share of a core that one channel of 25.6 kHz takes in steady operation.

Run by ``make bench``. Real time is the reference: windows of 2.5 s, each judged with the 7.5 s before it.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import sys
import time
import tracemalloc

import numpy as np
from targets import Targets

from daqsvc.bearing.geometry import bearing_orders
from daqsvc.bearing.race import RaceWatch, race_test
from daqsvc.bearing.race.judge import WINDOW_S

RATE_HZ = 25_600.0
SPEED_RPM = 1797.0
LIMIT = 0.02


def main() -> int:
    """Measure and print."""
    targets = Targets()
    bearing = bearing_orders("6205-2RS")
    random = np.random.default_rng(0)
    watch = RaceWatch(RATE_HZ, SPEED_RPM, bearing)
    windows = [random.standard_normal(watch.window).astype(np.float32) for _ in range(8)]
    for window in windows:
        watch.evaluate(window)
    spent = []
    for window in windows:
        begin = time.process_time()
        watch.evaluate(window)
        spent.append(time.process_time() - begin)
    share = float(np.median(spent)) / WINDOW_S
    single = []
    for window in windows:
        begin = time.process_time()
        race_test(window, RATE_HZ, SPEED_RPM, bearing)
        single.append(time.process_time() - begin)
    print(f"one window    {1e3 * np.median(single):6.1f} ms CPU for {WINDOW_S} s alone")
    print(f"steady        {1e3 * np.median(spent):6.1f} ms CPU a window with the last 10 s")
    tracemalloc.start()
    watch.evaluate(windows[0])
    before = tracemalloc.get_traced_memory()[0]
    for window in windows:
        watch.evaluate(window)
    print(f"memory        {(tracemalloc.get_traced_memory()[0] - before) / 1024:6.0f} KiB more after 20 s")
    targets.ask(f"at most {LIMIT:.0%} of a core in steady operation", f"{share:.2%}", LIMIT / share)
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
