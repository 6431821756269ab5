"""The page of ``daqsvc page`` beside the demo, in a separate process as in the field."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import tempfile
from typing import IO, TYPE_CHECKING, NamedTuple

from sim_hw.demo.machines import DemoError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

PORTS = (8420, 0)
"""Where it listens: there, or at a port that is free."""
START_S = 60.0


class PageAddress(NamedTuple):
    """Where the page is.

    Attributes:
        look: for viewers.
        act: for operators, who handle alarms.
    """

    look: str
    act: str


@contextlib.asynccontextmanager
async def page_of(store: Path) -> AsyncIterator[PageAddress]:
    """Serve the page of a store meanwhile; where it is.

    Raises:
        DemoError: it does not start.
    """
    with tempfile.TemporaryFile() as wrong:  # a pipe would have to be read meanwhile
        process, line = None, ""
        for port in PORTS:
            process = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "daqsvc", "page", "--store", f"{store}", "--port", f"{port}"),
                "--operator-link",
                stdout=asyncio.subprocess.PIPE,
                stderr=wrong,
                start_new_session=True,  # Ctrl-C is for the demo, which ends it
            )
            line = await _first_line(process, wrong)
            if " is at http://" in line:
                break
        assert process is not None  # noqa: S101 - there are ports
        try:
            if " is at http://" not in line:
                raise DemoError(f"--page: {line}")
            assert process.stdout is not None  # noqa: S101 - a pipe was asked for
            acting = (await process.stdout.readline()).decode()
            look = line.partition(" is at ")[2].partition(";")[0]
            yield PageAddress(look, acting.removeprefix("who opens ").partition(" ")[0])
        finally:
            if process.returncode is None:
                process.terminate()
            await process.communicate()


async def _first_line(process: asyncio.subprocess.Process, wrong: IO[bytes]) -> str:
    """Where it is; or why it is not, by the end of its output, when it has ended."""
    assert process.stdout is not None  # noqa: S101 - a pipe was asked for
    try:
        async with asyncio.timeout(START_S):
            line = (await process.stdout.readline()).decode()
    except TimeoutError:
        process.kill()
        line = ""
    if line:
        return line.strip()
    await process.communicate()
    wrong.seek(0)
    lines = wrong.read().decode(errors="replace").split("\n")
    return next((line for line in reversed(lines) if line), "the page does not start")
