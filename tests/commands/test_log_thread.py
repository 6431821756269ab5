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

from daqsvc.commands import log_thread
from daqsvc.commands.log_thread import LogThread

if TYPE_CHECKING:
    from collections.abc import Iterator


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


def test_a_reader_that_hangs_costs_lines_and_no_time(
    pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_thread, "MOST_LINES", 100)
    handler = LogThread(pipe[1])
    for n in range(5000):
        handler.emit(record(f"line {n} {'x' * 100}"))  # far more than a pipe and the queue hold
    handler.flush_within(0.05)
    read = b""
    while b"left out" not in read:
        read += os.read(pipe[0], 65536)
    lines = read.decode().splitlines()
    assert lines[0].startswith("line 0 ")
    left_out = next(int(line.split()[0]) for line in lines if line.endswith("it is read too slowly"))
    assert left_out > 100
    os.close(pipe[0])
    handler.end()


def test_who_reads_no_more_is_told_once(pipe: tuple[int, int]) -> None:
    told: list[str] = []
    handler = LogThread(pipe[1])
    handler.on_gone = told.append
    os.close(pipe[0])
    for _ in range(3):
        handler.emit(record("anybody?"))
    handler.flush_within(20.0)
    assert told == ["nobody reads the log any more (Broken pipe)"]
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
