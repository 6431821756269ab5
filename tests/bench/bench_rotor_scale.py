"""How the rotor bank scales: machines on one core, and the time to the first result of a new process.

Run by ``make bench``. Every machine has its own bank of the paper's four modes and gets its quarter
revolution in turn, as the pipeline would hand it over. Ratios to one machine are measured in the same run.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench_rotor import PER_REV, bank, orbit
from targets import Targets

MACHINES = (1, 2, 4, 8, 16, 32, 64)
BLOCK = PER_REV // 4


def microseconds(machines: int) -> float:
    """CPU time of a quarter revolution of one machine among several, the least of some rounds."""
    banks, block = [bank() for _ in range(machines)], orbit(BLOCK)
    rounds = max(2, 256 // machines)
    times = []
    for _ in range(7):
        begin = time.process_time_ns()
        for _ in range(rounds):
            for one in banks:
                one.process(*block)
        times.append((time.process_time_ns() - begin) / rounds / machines / 1000.0)
    return min(times)


def first_result_s(cache: str) -> tuple[float, float]:
    """Wall and CPU time from the start of a process to its first report, interpreter and imports included."""
    code = "from bench_rotor import bank, orbit; bank().process(*orbit(16))"
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache, "PYTHONPATH": str(Path(__file__).parent)}
    begin, before = time.perf_counter(), os.times()
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    after = os.times()
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - begin, cpu_s


def main() -> int:
    """Measure and print."""
    targets = Targets()
    one = each = 0.0
    for machines in MACHINES:
        each = microseconds(machines)
        one = one or each
        print(
            f"{machines:3} machines  {each:6.1f} us per machine and quarter revolution, "
            f"{each / one:.2f} times that of one"
        )
    # Linear to within what the processor's caches do.
    targets.ask("cost linear in machines, to 10 %", f"{each / one:.2f} per machine with 64", 1.1 * one / each)
    with tempfile.TemporaryDirectory() as cache:
        first_result_s(cache)
        wall_s, cpu_s = min(first_result_s(cache) for _ in range(3))
        print(f"first result  {wall_s:6.2f} s after a process starts ({cpu_s:.2f} s CPU), warm kernel cache")
    targets.ask("first result within 3 s", f"{wall_s:.2f} s", 3.0 / wall_s)
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
