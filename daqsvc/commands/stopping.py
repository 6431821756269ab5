"""Ctrl-C that ends reading a bus, and not the program."""

from __future__ import annotations

import signal
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from daqsvc.commands.arguments import signals_to_end

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def stopping() -> Iterator[threading.Event]:
    """What is set by Ctrl-C and by the signals that end a program."""
    stop = threading.Event()

    def handle(_number: int, _frame: Any) -> None:
        stop.set()

    before = {number: signal.signal(number, handle) for number in signals_to_end()}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
