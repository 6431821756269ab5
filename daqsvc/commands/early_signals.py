"""Signals while the program is imported, which takes half a second, and longer on a small box.

To be imported before all that is large. What imports `daqsvc.cli` and is not the program keeps its signals.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

EXIT_INTERRUPTED = 128 + signal.SIGINT
"""What a shell states about a program that SIGINT has ended."""

_came: set[int] = set()
"""Signals that have no handler yet."""


def ignore_until_heard(arguments: Sequence[str]) -> None:
    """From here on, let a SIGHUP that asks the service for a reload not end it, nor SIGUSR1 and SIGUSR2.

    Whoever starts and reloads it in one go is too quick for its own handler (`ProcessGuard`), which takes
    over what came (`take_hang_up`). A handler, and not SIG_IGN: that shows that the service is to outlive its
    terminal.

    Args:
        arguments: of the command line, without the program.
    """
    if arguments[:1] != ["run"]:
        return
    for number in (signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2):
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _note)


def take_hang_up() -> bool:
    """Whether a SIGHUP came since `ignore_until_heard` that was not handled yet."""
    came = signal.SIGHUP in _came
    _came.clear()
    return came


def begin(argv: Sequence[str]) -> None:
    """End quietly by SIGINT until `imported` is called, if this process is the program.

    Args:
        argv: of the process.
    """
    # A worker of a verb (multiprocessing) imports the program again, and has signals of its own.
    if not _is_program(argv) or "multiprocessing" in sys.modules:
        return
    ignore_until_heard(argv[1:])
    # In the background of a shell SIGINT is ignored, and stays so.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def imported() -> None:
    """Have SIGINT interrupt as usual: from now on somebody catches that."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _is_program(argv: Sequence[str]) -> bool:
    """Whether the process is ``daqsvc`` or ``python -m daqsvc``."""
    return f"/{argv[0] if argv else ''}".endswith(("/daqsvc", "/daqsvc/__main__.py"))


def _note(number: int, _frame: object) -> None:
    _came.add(number)


def _end(*_: object) -> None:
    # An exception could be caught by a library that tries what it can import.
    os._exit(EXIT_INTERRUPTED)


begin(sys.argv)
