"""The log of a service, written by a thread: a slow reader, or none, delays nothing else."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import queue
import sys
import threading
import time
from typing import TYPE_CHECKING

from daqsvc.commands.log_flood import LogFlood

if TYPE_CHECKING:
    from collections.abc import Callable

MOST_LINES = 10_000
"""Lines that may wait to be written; further ones are left out, and counted in the log."""

_GONE = {errno.EIO, errno.EPIPE, errno.ENXIO}


class LogThread(logging.Handler):
    """Writes the log to a file descriptor.

    Args:
        fd: e.g. 2 for stderr.

    Attributes:
        on_gone: called once, on the thread, when nothing reads the log any more, with the reason; None if
            that does not matter.
    """

    def __init__(self, fd: int) -> None:
        super().__init__()
        self.on_gone: Callable[[str], None] | None = None
        self._fd = fd
        self._lines: queue.Queue[str | None] = queue.Queue(MOST_LINES)
        self._left_out = 0
        self._flood = LogFlood()
        self._thread = threading.Thread(target=self._write_on, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`; never waits."""
        try:
            addition = self._flood.addition(record)
            if addition is None:
                return
            self._lines.put_nowait(f"{self.format(record)}{addition}")
        except queue.Full:
            self._left_out += 1
        except Exception:  # noqa: BLE001 - of whoever logs what cannot be formatted
            self.handleError(record)
        if sys.is_finalizing():  # then no thread runs any more, and to start one would hang
            self.end_of_process()
        elif not self._thread.is_alive():
            self._thread = threading.Thread(target=self._write_on, name="log", daemon=True)
            self._thread.start()

    def flush_within(self, timeout_s: float) -> None:
        """Wait until everything is written, at most so long."""
        until_s = time.monotonic() + timeout_s
        while self._lines.unfinished_tasks and time.monotonic() < until_s:
            time.sleep(0.005)

    def end(self) -> None:
        """Have the thread end when it has written what waits; another line starts another thread."""
        self._lines.put(None)
        self._thread.join()

    def end_of_process(self) -> None:
        """Write what waits on the calling thread; for when no other runs any more."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._write(self._lines.get_nowait() or "")

    def _write_on(self) -> None:
        while True:
            line = self._lines.get()
            try:
                if line is None:
                    return
                self._write(line)
                if self._left_out:
                    left_out, self._left_out = self._left_out, 0
                    self._write(f"{left_out} lines of the log were left out: it is read too slowly")
            finally:
                self._lines.task_done()

    def _write(self, line: str) -> None:
        left = f"{line}\n".encode(errors="backslashreplace")
        try:
            while left:
                left = left[os.write(self._fd, left) :]
        except BlockingIOError:
            self._left_out += 1
            time.sleep(0.05)
        except OSError as error:
            if error.errno in _GONE and self.on_gone is not None:
                gone, self.on_gone = self.on_gone, None
                gone(f"the log is no longer read ({error.strerror})")
