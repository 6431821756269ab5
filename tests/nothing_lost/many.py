"""Many runs at a time, and what became of them together."""

from __future__ import annotations

import asyncio
import shutil
from collections import Counter
from typing import TYPE_CHECKING

from nothing_lost.run import Course, Report, run

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

AMQTT_EVERY = 20

__all__ = ["Report", "courses", "run_all", "table"]


def courses(count: int, first_seed: int = 0) -> list[Course]:
    """So many courses by their seeds, every twentieth on amqtt."""
    return [
        Course(seed, broker="amqtt" if seed % AMQTT_EVERY == AMQTT_EVERY - 1 else "mosquitto")
        for seed in range(first_seed, first_seed + count)
    ]


async def run_all(
    chosen: Sequence[Course],
    directory: Path,
    at_a_time: int,
    tell: Callable[[Report], None] = lambda _: None,
) -> list[Report]:
    """Run the courses, some at a time; most of a run is waiting.

    Args:
        chosen: what to run.
        directory: gets a directory for each run; that of a run without violations is removed.
        at_a_time: how many may be under way.
        tell: hears of every run as soon as it is over.
    """
    room = asyncio.Semaphore(at_a_time)

    async def one(course: Course) -> Report:
        async with room:
            own = directory / f"{course.broker}-{course.mutation}-{course.seed}"
            own.mkdir()
            report = await run(course, own)
            if not report.verdict.violations:
                await asyncio.to_thread(shutil.rmtree, own)
            tell(report)
            return report

    return list(await asyncio.gather(*map(one, chosen)))


def table(reports: Sequence[Report]) -> str:
    """What the runs went through and what was kept, by broker."""
    lines = ["broker      runs   kept  alarms  kills  crashes  repeats  lost by broker  worst delay"]
    for broker in sorted({report.course.broker for report in reports}, reverse=True):
        ours = [report for report in reports if report.course.broker == broker]
        verdicts = [report.verdict for report in ours]
        lines.append(
            f"{broker:10} {len(ours):5d}  {sum(not v.violations for v in verdicts):5d}"
            f"  {sum(v.alarms for v in verdicts):6d}  {sum(r.kills for r in ours):5d}"
            f"  {sum(r.crashes for r in ours):7d}"
            f"  {sum(v.repeats for v in verdicts):7d}  {sum(v.forgotten for v in verdicts):14d}"
            f"  {max(v.worst_delay_s for v in verdicts):9.1f} s"
        )
    befell = Counter(kind for report in reports for kind in report.befell)
    lines.append("what befell them: " + ", ".join(f"{kind} {times}" for kind, times in befell.most_common()))
    return "\n".join(lines)
