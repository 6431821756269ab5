"""The soak, with a table of what the service was put through and what was kept: ``make soak``."""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import argparse
import asyncio
import contextlib
import shutil
import signal
import sys
import tempfile
from pathlib import Path

from nothing_lost.broker import mosquitto_program
from soak.run import Report, soak


def main() -> int:
    parser = argparse.ArgumentParser(prog="soak", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", action="append", default=[], metavar="WHAT", help="what befalls it")
    arguments = parser.parse_args()
    if mosquitto_program() is None:
        print("no mosquitto on this machine; install it with: apt-get install mosquitto", file=sys.stderr)
        return 2
    directory = Path(tempfile.mkdtemp(prefix="soak-"))

    async def run_it() -> Report:
        """End tidily when told to: processes and small disks outlive whoever forgets them."""
        work = asyncio.ensure_future(
            soak(arguments.seconds, directory, arguments.seed, tuple(arguments.only))
        )
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, work.cancel)
        return await work

    try:
        report = asyncio.run(run_it())
    except (KeyboardInterrupt, asyncio.CancelledError):
        print("stopped", file=sys.stderr)
        return 130
    print(report)
    if not report.violations:
        with contextlib.suppress(OSError):
            shutil.rmtree(directory)
    return 1 if report.violations else 0


if __name__ == "__main__":
    sys.exit(main())
