"""What the recorder costs: the same machines with and without ``[recorder]``, processor and memory as ratios.

Run by ``make bench``. 16 paper rotors (two probes and a keyphasor at 640 Hz, levels, a bank of ten models)
send in real time from a process of their own to one service on one core: without a recorder, with one that
holds what a snapshot would begin with, and with one that writes everything down.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import os
import sys

from bench_machines import measured
from targets import Targets

MACHINES = 16
HOLDS = "\n[recorder]\nreserve_mb = 0\n"
WRITES = f"{HOLDS}continuous = true\n"
MOST_HOLDING = 1.35
MOST_WRITING = 1.6
MOST_MEMORY = 1.35


def main() -> int:
    """Measure and print."""
    targets = Targets()
    core = min(os.sched_getaffinity(0))
    print("| recorder | CPU s a second | to without | resident MB | to without | lag p99, ms | lost |")
    print("|---|---|---|---|---|---|---|")
    without = measured(MACHINES, core)
    holding, writing = (measured(MACHINES, core, more) for more in (HOLDS, WRITES))
    rungs = {"none": without, "holds": holding, "writes": writing}
    for name, rung in rungs.items():
        print(
            f"| {name} | {rung.cpu_s:.3f} | {rung.cpu_s / without.cpu_s:.2f} | {rung.resident_mb:.0f} | "
            f"{rung.resident_mb / without.resident_mb:.2f} | {rung.lag_ms:.1f} | {rung.lost} |"
        )
    lost = sum(rung.lost for rung in rungs.values())
    targets.ask("no sample lost", f"{lost}", 0.0 if lost else 1.0)
    for name, most in (("holds", MOST_HOLDING), ("writes", MOST_WRITING)):
        cpu = rungs[name].cpu_s / without.cpu_s
        memory = rungs[name].resident_mb / without.resident_mb
        targets.ask(f"a recorder that {name}: at most {most:g} times the processor", f"{cpu:.2f}", most / cpu)
        targets.ask(
            f"a recorder that {name}: at most {MOST_MEMORY:g} times the memory",
            f"{memory:.2f}",
            MOST_MEMORY / memory,
        )
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
