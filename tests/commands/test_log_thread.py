"""A log that is read slowly, or not at all, holds nothing up."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

import pytest
from support.waiting import PATIENCE_S

from daqsvc.cli import load, start_logging
from daqsvc.commands import log_thread
from daqsvc.commands.log_flood import LogFlood
from daqsvc.commands.log_thread import LogThread
from daqsvc.notice import NOTICE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


LINES = 5000
"""Far more than a pipe and the queue hold."""


def record(text: str) -> logging.LogRecord:
    return logging.LogRecord("n", logging.INFO, "p", 1, text, None, None)


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """Its reading and its writing end; whatever writes into it ends with it."""
    ends = os.pipe()
    known = set(threading.enumerate())
    yield ends
    for fd in ends:
        with contextlib.suppress(OSError):
            os.close(fd)
    for thread in set(threading.enumerate()) - known:
        thread.join(0.01)


def test_lines_are_written_in_order(pipe: tuple[int, int]) -> None:
    handler = LogThread(pipe[1])
    for n in range(100):
        handler.emit(record(f"line {n}"))
    handler.flush_within(20.0)
    assert os.read(pipe[0], 65536).decode().splitlines() == [f"line {n}" for n in range(100)]
    handler.end()


def test_what_comes_again_and_again_is_limited_by_its_cause() -> None:
    now_s = [0.0]
    flood = LogFlood(lambda: now_s[0])

    def written(count: int, *args: object, text: str = "bus %s has lost %d frames") -> list[str]:
        additions = [
            flood.addition(logging.LogRecord("n", logging.WARNING, "p", 1, text, args, None))
            for _ in range(count)
        ]
        return [one for one in additions if one is not None]

    told = written(500, "can0", 3)
    assert told == [""] * 19 + [" (further lines like this are left out for 60 s)"]
    assert written(1, "can1", 3) == written(1, "can0", 3, text="bus %s is back, %d") == [""], "others are not"
    now_s[0] = 59.9
    assert written(1, "can0", 4) == []
    now_s[0] = 60.0
    assert written(2, "can0", 4) == [" (481 lines like this were left out)", ""]
    for n in range(LINES):
        written(1, n)
    assert len(flood._windows) == 1000


def test_a_flood_does_not_reach_the_reader(pipe: tuple[int, int]) -> None:
    handler = LogThread(pipe[1])
    for _ in range(1000):
        handler.emit(record("again"))
    handler.flush_within(20.0)
    lines = os.read(pipe[0], 65536).decode().splitlines()
    assert lines == ["again"] * 19 + ["again (further lines like this are left out for 60 s)"]
    handler.end()


@pytest.mark.parametrize(
    ("level", "priority"),
    [
        (logging.CRITICAL, 2),
        (logging.ERROR, 3),
        (logging.WARNING, 4),
        (NOTICE, 5),
        (logging.INFO, 6),
        (logging.DEBUG, 7),
    ],
)
def test_the_journal_is_told_the_level_of_each_line(
    level: int,
    priority: int,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stderr = os.fstat(2)
    told = logging.LogRecord("n", level, "p", 1, "one", None, None)
    told.exc_text = "two"  # a traceback has lines of its own

    def formatted() -> str:
        handler = logging.NullHandler()
        start_logging(verbose=False, handler=handler)
        return handler.format(told)

    monkeypatch.setenv("JOURNAL_STREAM", f"{stderr.st_dev}:{stderr.st_ino}")
    assert formatted() == f"<{priority}>{told.levelname} one\n<{priority}>two"
    if level == logging.ERROR:
        file = tmp_path / "broken.toml"
        file.write_text("site = 5\n")
        assert load(file) is None
        assert all(line.startswith(f"<3>{file}") for line in capsys.readouterr().err.splitlines())
    monkeypatch.setenv("JOURNAL_STREAM", "8:1")
    assert formatted() == f"{told.levelname} one\ntwo", "inherited, and stderr goes elsewhere"
    monkeypatch.delenv("JOURNAL_STREAM")
    assert formatted().endswith(f" {told.levelname} one\ntwo")


def test_a_reader_that_hangs_costs_lines_and_no_time(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_thread, "MOST_LINES", 100)
    handler = LogThread(pipe[1])
    for n in range(LINES):
        handler.emit(record(f"line {n} {'x' * 100}"))
    handler.flush_within(0.05)
    read, written, left_out = b"", 0, 0
    try:
        while written + left_out < LINES:
            read += os.read(pipe[0], 65536)
            whole = read[: read.rfind(b"\n") + 1].splitlines()
            written = sum(line.startswith(b"line ") for line in whole)
            left_out = sum(int(line.split()[0]) for line in whole if line.endswith(b"it is read too slowly"))
    finally:
        os.close(pipe[0])
        handler.end()
    assert read.startswith(b"line 0 ")
    assert written + left_out == LINES, "each is written or counted"
    assert left_out > LINES / 2


def test_who_reads_no_more_is_told_once(pipe: tuple[int, int]) -> None:
    told: list[str] = []
    handler = LogThread(pipe[1])
    handler.on_gone = told.append
    os.close(pipe[0])
    for _ in range(3):
        handler.emit(record("anybody?"))
    handler.flush_within(20.0)
    assert told == ["the log is no longer read (Broken pipe)"]
    handler.end()


def test_the_thread_is_replaced_when_it_is_gone(pipe: tuple[int, int]) -> None:
    handler = LogThread(pipe[1])
    handler.end()
    handler.emit(record("still here"))
    handler.flush_within(20.0)
    assert os.read(pipe[0], 100) == b"still here\n"
    handler.end()


LATE = """
import logging
from daqsvc.commands.log_thread import LogThread

class Task:
    def __init__(self):
        self.error = logging.getLogger("n").error
    def __del__(self):
        self.error("of a task that nobody waited for")

logging.basicConfig(handlers=[LogThread(2)])
kept_to_the_end = Task()
"""


def test_a_line_at_the_very_end_of_the_process_is_written_and_hangs_nothing() -> None:
    done = subprocess.run(
        [sys.executable, "-c", LATE], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0
    assert "of a task that nobody waited for" in done.stderr
