"""A progress bar on a terminal, for what takes longer than a person likes to wait."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import TYPE_CHECKING, Protocol, TextIO

if TYPE_CHECKING:
    from collections.abc import Iterator

PATIENCE_S = 2.0
"""Time until a bar is shown."""
_WIDTH = 40


class Bar(Protocol):
    """Shows how much is done."""

    def update(self, done: int, total: int) -> None:
        """Show it."""
        ...

    def close(self) -> None:
        """Take the bar away."""
        ...


class _PlainBar:
    """One line that is written over and over."""

    def __init__(self, label: str, stream: TextIO) -> None:
        self._label = label
        self._stream = stream
        self._shown = ""

    def update(self, done: int, total: int) -> None:
        filled = _WIDTH * done // max(total, 1)
        line = f"{self._label} [{'#' * filled}{'.' * (_WIDTH - filled)}] {100 * done // max(total, 1)} %"
        if line != self._shown:
            self._stream.write(f"\r{line}")
            self._stream.flush()
            self._shown = line

    def close(self) -> None:
        self._stream.write(f"\r{' ' * len(self._shown)}\r")
        self._stream.flush()


class _RichBar:
    """The bar of rich, where it is installed."""

    def __init__(self, label: str, stream: TextIO) -> None:
        from rich.console import Console  # noqa: PLC0415 - only where a person waits
        from rich.progress import Progress  # noqa: PLC0415

        self._progress = Progress(console=Console(file=stream), transient=True)
        self._task = self._progress.add_task(label, total=None)
        self._progress.start()

    def update(self, done: int, total: int) -> None:
        self._progress.update(self._task, completed=done, total=total)

    def close(self) -> None:
        self._progress.stop()


class ProgressInterval:
    """Shows a bar once something has taken `PATIENCE_S`, and only on a terminal.

    Args:
        label: what is going on.
        stream: where to show it; standard error unless given.
        patience_s: how long to wait before there is a bar.
    """

    def __init__(self, label: str, stream: TextIO | None = None, patience_s: float = PATIENCE_S) -> None:
        self._label = label
        self._stream = sys.stderr if stream is None else stream
        # Seconds of a person's patience, not of the machine's time: no clock of the service is asked.
        self._show_after = time.monotonic() + patience_s
        self._bar: Bar | None = None

    def update(self, done: int, total: int) -> None:
        """Report how much is done."""
        if self._bar is None:
            if done >= total or not self._stream.isatty() or time.monotonic() < self._show_after:
                return
            try:
                self._bar = _RichBar(self._label, self._stream)
            except ModuleNotFoundError:
                self._bar = _PlainBar(self._label, self._stream)
        self._bar.update(done, total)

    def close(self) -> None:
        """Take the bar away, if there is one."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[ProgressInterval]:
    """A bar that is gone at the end, whatever happens."""
    bar = ProgressInterval(label)
    try:
        yield bar
    finally:
        bar.close()
