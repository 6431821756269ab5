"""What several machines in one service cost: processor, memory and the lag of the event loop, on a ladder.

Run by ``make bench``. 1, 4, 16 and 64 paper rotors (two probes and a keyphasor at 640 Hz, levels, a bank of
ten models), eight on a CAN FD bus, send in real time from a process of their own. ``daqsvc run`` watches them
in another, which may run on one core only. On a busy computer give the terminal priority: as root,
``echo -20 > /proc/self/autogroup``, for ``nice`` counts within one terminal only. CPU time counts, all
threads and the kernel included: the least of some rounds, as what else the host does only adds to it. The
lag is that of a timer every 10 ms.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from support.many_machines import SAMPLES_PER_FRAME, watched
from targets import Targets

RUNGS = (1, 4, 16, 64)
SETTLED_S = 10.0
"""The device's clock is known, and the bank has measured the healthy machine."""
ROUNDS = 3
ROUND_S = 4.0
MOST_FIRST_MB = 150.0
MOST_FURTHER_MB = 3.0
MOST_LAG_MS = 10.0
MOST_GROWTH = 1.25
"""What a further machine may cost, to what one costs where there are fewer."""


class Rung(NamedTuple):
    """What so many machines take.

    Attributes:
        machines: how many.
        cpu_s: processor time of the service for a second.
        resident_mb: its memory in RAM.
        lag_ms: 99th percentile of how late the event loop is.
        threads: of the service.
        lost: samples that were lost.
        sent: samples that were sent.
    """

    machines: int
    cpu_s: float
    resident_mb: float
    lag_ms: float
    threads: int
    lost: int
    sent: int


def measured(machines: int, core: int, more: str = "") -> Rung:
    """What so many machines take; ``more`` are tables of each machine file."""
    with (
        tempfile.TemporaryDirectory() as folder,
        watched(Path(folder), machines, core=core, more=more) as plant,
    ):
        time.sleep(SETTLED_S)
        costs = []
        for _ in range(ROUNDS):
            cpu_s, begun_s = plant.cpu_s(), time.monotonic()
            time.sleep(ROUND_S)
            costs.append((plant.cpu_s() - cpu_s) / (time.monotonic() - begun_s))
        resident_mb, threads = plant.resident_mb(), plant.threads()
        lag_ms = plant.status(0)["figures"]["loop_lag_ms"]["p99"]
        sent = plant.silence()
        lost = sent.refused * SAMPLES_PER_FRAME
        for machine, samples in enumerate(sent.samples):
            figures = plant.status(machine)["figures"]
            lost += samples - figures["streams"]["shaft"]["samples_received"]
            lost += sum(one["samples_skipped"] for one in figures["detectors"].values())
    return Rung(machines, min(costs), resident_mb, lag_ms, threads, lost, sum(sent.samples))


def further(rungs: list[Rung], figure: str, few: int, many: int) -> float:
    """What each further machine adds to a figure between two rungs."""
    below, above = (next(rung for rung in rungs if rung.machines == n) for n in (few, many))
    return (getattr(above, figure) - getattr(below, figure)) / (many - few)


def main() -> int:
    """Measure and print."""
    targets = Targets()
    core = min(os.sched_getaffinity(0))
    rungs = []
    print(
        "| machines | CPU s a second | ms for each | resident MB | MB each further | lag p99, ms | threads |"
    )
    print("|---|---|---|---|---|---|---|")
    for machines in RUNGS:
        rung = measured(machines, core)
        rungs.append(rung)
        each_mb = f"{further(rungs, 'resident_mb', 1, machines):.2f}" if machines > 1 else ""
        print(
            f"| {machines} | {rung.cpu_s:.3f} | {1e3 * rung.cpu_s / machines:.1f} | {rung.resident_mb:.0f} | "
            f"{each_mb} | {rung.lag_ms:.1f} | {rung.threads} |",
            flush=True,
        )
    first, most = rungs[0], rungs[-1]
    lost, sent = sum(rung.lost for rung in rungs), sum(rung.sent for rung in rungs)
    growth = further(rungs, "cpu_s", 16, 64) / further(rungs, "cpu_s", 4, 16)
    further_mb = further(rungs, "resident_mb", 1, 64)
    targets.ask("no sample lost, 1 to 64 machines", f"{lost} of {sent}", 0.0 if lost or not sent else 1.0)
    targets.ask("64 machines on one core", f"{most.cpu_s:.3f} CPU s a second", 1.0 / most.cpu_s)
    for asked, most_is, unit, found in (
        ("resident memory of one", MOST_FIRST_MB, "MB", first.resident_mb),
        ("resident memory of each further", MOST_FURTHER_MB, "MB", further_mb),
        ("loop lag p99 with 64", MOST_LAG_MS, "ms", most.lag_ms),
    ):
        targets.ask(f"{asked} at most {most_is:g} {unit}", f"{found:.2f} {unit}", most_is / found)
    targets.ask(
        "cost linear in machines, to 25 %",
        f"one of 17 to 64 costs {growth:.2f} times one of 5 to 16",
        MOST_GROWTH / growth,
    )
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
