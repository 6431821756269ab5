"""The page's process: started, watched, and ended with the service."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import re
import sys
from collections import deque
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff
from daqsvc.errors.code import coded
from daqsvc.errors.outputs import PAGE_ENDED, PAGE_SAYS
from daqsvc.publish.output import Output

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence
    from pathlib import Path

log = logging.getLogger(__name__)

NOT_THEIRS = ("NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC", "LISTEN_FDS", "LISTEN_PID", "LISTEN_FDNAMES")
"""Of the service's environment what is systemd's way to speak with the service alone."""
WELL_S = 60.0
"""A page that has run for so long has earned a quick restart."""
MOST_LINES = 20
"""Of what one page's process states that go into the log."""
LONGEST_LINE = 500
END_S = 0.2
"""How long it is waited for when the service does not state how long it may take; then it is killed."""


class PageOutput(Output):
    """Starts `daqsvc page` and starts it again when it ends; what it shows it gets over the control socket.

    Args:
        arguments: of the verb, but for the store.
        listen: where it listens, for a person.
        store: of the service.
    """

    def __init__(self, arguments: Sequence[str], listen: str, store: Path) -> None:
        self._command = (
            sys.executable,
            "-m",
            "daqsvc",
            "page",
            f"--store={store}",
            "--with-parent",
            *arguments,
        )
        self._listen = listen
        self._starts = 0
        self._is_up = False
        self._process: asyncio.subprocess.Process | None = None
        self._logged_before: frozenset[str] = frozenset()
        self._stopping = asyncio.Event()
        self._end_s = END_S
        self._ended = asyncio.Event()

    @property
    def pid(self) -> int | None:
        """Of the page's process; None while there is none."""
        return None if self._process is None else self._process.pid

    async def run(self) -> None:
        """Keep it going until `stop`, or until cancelled."""
        try:
            await self._keep_going()
        finally:
            self._ended.set()

    async def stop(self, deadline_s: float) -> None:
        """See `Output.stop`: it may take so long to take leave of browsers, then it is killed."""
        self._end_s = deadline_s
        self._stopping.set()
        await self._ended.wait()

    def figures(self) -> dict[str, Any]:
        """See `Output.figures`."""
        return {"up": int(self._is_up), "starts": self._starts}

    async def _keep_going(self) -> None:
        backoff, logged = Backoff(), ""
        loop = asyncio.get_running_loop()
        while True:
            begun_s = loop.time()
            try:
                why = await self._run_once()
            except OSError as error:
                why = f"it cannot be started: {error.strerror or error}"
            if self._stopping.is_set():
                return
            self.reason, self.code = why, PAGE_ENDED
            if why != logged:
                log.warning(
                    "the page at %s has ended, and is started again: %s",
                    self._listen,
                    why,
                    extra=coded(PAGE_ENDED),
                )
                logged = why
            if loop.time() - begun_s > WELL_S:
                backoff.reset()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(backoff.next_ns() / NS_PER_S):
                    await self._stopping.wait()
                return

    async def _run_once(self) -> str:
        """Start it, and wait for its end; why it has ended."""
        environment = {name: value for name, value in os.environ.items() if name not in NOT_THEIRS}
        process = await asyncio.create_subprocess_exec(
            *self._command,
            stdin=asyncio.subprocess.PIPE,  # it ends when the other end is closed
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            env=environment,
            start_new_session=True,  # Ctrl-C is for the service, which ends it
        )
        self._starts += 1
        self._process = process
        assert process.stdout is not None  # noqa: S101 - pipes were asked for
        assert process.stderr is not None  # noqa: S101
        last: deque[str] = deque(maxlen=1)
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._hear(process.stdout))
                tasks.create_task(self._log_what_it_says(process.stderr, last))
                ending = tasks.create_task(self._end_if_stopped(process))
                await process.wait()
                ending.cancel()
        finally:
            self._is_up, self._process = False, None
            await _end(process, END_S)
        return last[0] if last else f"exit code {process.returncode}"

    async def _end_if_stopped(self, process: asyncio.subprocess.Process) -> None:
        await self._stopping.wait()
        await _end(process, self._end_s)

    async def _hear(self, stdout: asyncio.StreamReader) -> None:
        """Its first line states that it listens."""
        async for line in _lines(stdout):
            if not self._is_up:
                self._is_up, self.reason = True, ""
                log.info("%s", line)

    async def _log_what_it_says(self, stderr: asyncio.StreamReader, last: deque[str]) -> None:
        """Log it, but for why it ends, which is logged once, and what a failed start has logged before."""
        lines: list[str] = []
        async for line in _lines(stderr):
            level, text = _of_log(line)
            why = text.removeprefix("daqsvc page: ")
            last.append(why)
            if why == text and len(lines) < MOST_LINES:
                lines.append(text)
                if text not in self._logged_before:
                    log.log(
                        level, "page: %s", text, extra=coded(PAGE_SAYS if level >= logging.WARNING else None)
                    )
        self._logged_before = frozenset() if self._is_up else frozenset(lines)


_LOG_LINE = re.compile(r"(?:[-0-9]{10} [:,0-9]{8,12} )?(?P<level>[A-Z]+) (?P<text>.*)")
"""What `daqsvc.cli.start_logging` writes there."""


def _of_log(line: str) -> tuple[int, str]:
    """The level and the message of a line of its log; of any other a warning, and all of it."""
    match = _LOG_LINE.fullmatch(line)
    level = None if match is None else logging.getLevelNamesMapping().get(match["level"])
    if match is None or level is None:
        return logging.WARNING, line
    return level, match["text"]


async def _lines(stream: asyncio.StreamReader) -> AsyncIterator[str]:
    """What can be printed of each line, however long it is."""
    while True:
        try:
            line = await stream.readuntil()
        except asyncio.IncompleteReadError as error:
            line = error.partial
            if not line:
                return
        except asyncio.LimitOverrunError as error:
            line = await stream.readexactly(error.consumed)
        text = "".join(one if one.isprintable() else "?" for one in line.decode(errors="replace").rstrip())
        if text:
            yield text[:LONGEST_LINE]


async def _end(process: asyncio.subprocess.Process, within_s: float) -> None:
    """Have it end, by force if it does not within so long: it holds nothing that could be lost."""
    if process.stdin is not None:
        process.stdin.close()
    if process.returncode is not None:
        return
    with contextlib.suppress(ProcessLookupError):
        process.terminate()
    try:
        async with asyncio.timeout(within_s):
            await process.wait()
    except (TimeoutError, asyncio.CancelledError) as error:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        if isinstance(error, asyncio.CancelledError):
            raise
