"""Ports of loopback that nobody else gets, also while nothing listens on them.

A test that stops its broker and starts it again needs the same port then. What the kernel gives for the
asking it gives to the next one, too: a broker of another test, whose clients then came to this one.
"""

from __future__ import annotations

import fcntl
import itertools
import os
import socket
import tempfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

LOOPBACK = "127.0.0.1"

FIRST, LAST = 10_240, 32_767
"""Below those that the kernel gives (`/proc/sys/net/ipv4/ip_local_port_range`)."""
EACH = 128
"""Ports of a process."""


def free_port() -> int:
    """A port that is free, and that is given to no other process for as long as this one lives."""
    for port in itertools.islice(_ports(os.getpid()), EACH):
        with socket.socket() as probe:
            try:
                probe.bind((LOOPBACK, port))
            except OSError:
                continue  # of an earlier test, which is not over, or of something else on this computer
            return port
    raise AssertionError(f"all {EACH} ports of this process are in use")


@cache
def _ports(_process: int) -> Iterator[int]:
    """The ports of a process, again and again; it keeps them by a lock on a file."""
    folder = Path(tempfile.gettempdir()) / f"daqsvc-test-ports-{os.geteuid()}"
    folder.mkdir(exist_ok=True)
    for first in range(FIRST, LAST - EACH, EACH):
        lock = os.open(folder / f"{first}", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(lock)
            continue
        return itertools.cycle(range(first, first + EACH))
    raise AssertionError(f"other processes have all ports from {FIRST} to {LAST}")
