"""All randomised runs with a table of what they were put through: ``make nothing-lost``."""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
import sys
import tempfile
import time
from pathlib import Path

from nothing_lost.broker import mosquitto_program
from nothing_lost.many import Report, courses, run_all, table


def main() -> int:
    parser = argparse.ArgumentParser(prog="nothing_lost", description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--at-a-time", type=int, default=10)
    arguments = parser.parse_args()
    if mosquitto_program() is None:
        print("no mosquitto on this machine; install it with: apt-get install mosquitto", file=sys.stderr)
        return 2

    def tell(report: Report) -> None:
        if report.verdict.violations:
            print(f"LOST  {report}", flush=True)

    begun_s = time.monotonic()
    directory = Path(tempfile.mkdtemp(prefix="nothing-lost-"))
    chosen = courses(arguments.runs, arguments.first_seed)

    async def run_them() -> list[Report]:
        """End tidily when told to: processes and small disks outlive whoever forgets them."""
        work = asyncio.ensure_future(run_all(chosen, directory, arguments.at_a_time, tell))
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, work.cancel)
        return await work

    try:
        reports = asyncio.run(run_them())
    except (KeyboardInterrupt, asyncio.CancelledError):
        print("stopped", file=sys.stderr)
        return 130
    print(table(reports))
    with contextlib.suppress(OSError):
        directory.rmdir()  # unless it holds the traces of a run that failed
    print(f"{time.monotonic() - begun_s:.0f} s in all")
    return 1 if any(report.verdict.violations for report in reports) else 0


if __name__ == "__main__":
    sys.exit(main())
