"""A process that dies at a chosen step of its work on files, as by kill -9."""

from __future__ import annotations

import os
import sqlite3
import sys
import traceback
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

STEPS = ("open", "close", "mkdir", "rename", "replace", "unlink", "fsync", "pwrite", "write", "chmod")
"""Functions of `os` before each of which the process may die. So it may before each SQL statement."""

DIED, FAILED = 77, 78


def dies_at(step: int, work: Callable[[], object]) -> int:
    """Run ``work`` in a separate process that dies before file operation number ``step``.

    Returns:
        How many operations it did: fewer than ``step`` if it came to its end.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child:
        os.close(writer)
        with os.fdopen(reader, "rb") as told:
            output = told.read()
        _, status = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(status)
        assert code in {0, DIED}, output.decode()
        return step if code == DIED else int(output)
    done = 0
    quit_ = os._exit
    write = os.write

    def count(*_: object) -> None:
        nonlocal done
        done += 1
        if done == step:
            quit_(DIED)

    def counted(function: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object, **options: object) -> object:
            count()
            return function(*arguments, **options)

        return call

    try:
        connect = sqlite3.connect

        def traced(*arguments: object, **options: object) -> sqlite3.Connection:
            count()
            connection: sqlite3.Connection = connect(*arguments, **options)  # type: ignore[call-overload]
            connection.set_trace_callback(count)
            return connection

        sqlite3.connect = traced  # type: ignore[assignment]
        for name in STEPS:
            setattr(os, name, counted(getattr(os, name)))
        work()
        write(writer, b"%d" % done)
        quit_(0)
    except BaseException:  # noqa: BLE001 - nothing of this process may go on in the tests
        write(writer, traceback.format_exc().encode())
        sys.stderr.flush()
    quit_(FAILED)
    raise AssertionError
