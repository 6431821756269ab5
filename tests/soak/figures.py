"""What a process takes: memory, threads, file descriptors, processor time; and whether memory grows."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import stats

from daqsvc.diagnosis.pipeline import THREADS

if TYPE_CHECKING:
    from collections.abc import Sequence

PAGE = os.sysconf("SC_PAGE_SIZE")
TICKS = os.sysconf("SC_CLK_TCK")
MIB = 2**20
BLOCKS = 10
"""Parts that a run is cut into: readings of one part depend on each other, their means hardly."""
SURE = 0.999
RESOLVED_MIB = 6.0
"""Growth over a whole run, however long, that is not told from caches and heaps that still fill."""
MOST_MIB = 16.0
"""What a run may add to its memory at all, after it has warmed up."""


class Census(NamedTuple):
    """What a process has open.

    Attributes:
        threads: of the process, but for those that compute.
        computing: threads of a lower priority than the process has. One starts when all others are busy,
            and one that a call has kept for long ends with it: so there are more of them at times.
        descriptors: what is open how often: files by their names, all sockets alike, and so on.
    """

    threads: int
    computing: int
    descriptors: Counter[str]

    def __str__(self) -> str:
        threads = f"{self.threads} threads and {self.computing} that compute"
        return f"{threads}, {self.descriptors.total()} descriptors"

    def against(self, before: Census) -> str:
        """What is different, in words; empty if nothing is."""
        counts = {"threads": (self.threads, before.threads)} | {
            name: (self.descriptors[name], before.descriptors[name])
            for name in sorted(self.descriptors | before.descriptors)
        }
        different = [f"{now} of {name}, not {then}" for name, (now, then) in counts.items() if now != then]
        if self.computing > THREADS:
            different.append(f"{self.computing} threads that compute, and {THREADS} at most are to stay")
        return "; ".join(different)


def rss_bytes(pid: int) -> int:
    """Resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * PAGE


def census(pid: int) -> Census:
    """Count what a process has open."""
    process, open_now = Path(f"/proc/{pid}"), Counter[str]()
    for descriptor in (process / "fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # it has been closed meanwhile
            # Each terminal, pipe and socket has a number of its own, and each new one another.
            open_now[re.sub(r"pts/\d+|:\[\d+\]", "", f"{descriptor.readlink()}")] += 1
    nices = [nice for task in (process / "task").iterdir() if (nice := _nice(task)) is not None]
    computing = sum(nice > (_nice(process) or 0) for nice in nices)
    return Census(len(nices) - computing, computing, open_now)


def _nice(task: Path) -> int | None:
    """How far the priority of a thread is lowered; None if it has ended meanwhile."""
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return int((task / "stat").read_text().rpartition(")")[2].split()[16])
    return None


async def lowest(pid: int) -> Census:
    """What a process has open when nothing is under way: threads and sockets for single calls come and go."""
    seen = []
    for _ in range(30):
        seen.append(census(pid))
        await asyncio.sleep(0.03)
    least = min((one.descriptors for one in seen), key=Counter.total)
    return Census(min(one.threads for one in seen), min(one.computing for one in seen), least)


def cpu_s(pid: int) -> float:
    """Processor time that a process has taken so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


@dataclass(frozen=True)
class Trend:
    """A line through the memory of a process.

    Attributes:
        slope_mib_h: MiB an hour.
        error_mib_h: half of the interval that holds it, with 99.9 % confidence to each side.
        parts_mib: mean of each tenth.
        hours: how long it was watched.
    """

    slope_mib_h: float
    error_mib_h: float
    parts_mib: tuple[float, ...]
    hours: float

    @classmethod
    def of(cls, readings: Sequence[tuple[float, int]]) -> Trend:
        """The line through readings of time in s and memory in bytes.

        Raises:
            ValueError: there are not enough.
        """
        if len(readings) < 2 * BLOCKS:
            raise ValueError(f"{len(readings)} readings of the memory are too few; watch it for longer")
        parts = np.array_split(np.array(readings), BLOCKS)
        t_h, mib = np.array([[part[:, 0].mean() / 3600.0, part[:, 1].mean() / MIB] for part in parts]).T
        fit = stats.linregress(t_h, mib)
        quantile = float(stats.t.ppf(SURE, BLOCKS - 2))
        hours = (readings[-1][0] - readings[0][0]) / 3600.0
        return cls(float(fit.slope), quantile * float(fit.stderr), tuple(mib.tolist()), hours)

    def violations(self) -> list[str]:
        """Whether memory grows for sure, or by too much, a sentence each."""
        found = []
        if (self.slope_mib_h - self.error_mib_h) * self.hours > RESOLVED_MIB:
            found.append(f"memory grows by {self}")
        if self.parts_mib[-1] - self.parts_mib[0] > MOST_MIB:
            found.append(f"memory was {self.parts_mib[0]:.1f} MiB and is {self.parts_mib[-1]:.1f}")
        return found

    def __str__(self) -> str:
        parts = ", ".join(f"{part:.1f}" for part in self.parts_mib)
        slope = (
            f"{self.slope_mib_h:+.2f} +- {self.error_mib_h:.2f} MiB an hour over {self.hours * 60:.1f} min"
        )
        return f"{slope}; by tenths {parts} MiB"
