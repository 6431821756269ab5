"""The side of systemd in sd_notify(3): a datagram socket, and what a service has sent to it."""

from __future__ import annotations

import os
import socket
import time
from typing import TYPE_CHECKING, Self

import pytest
from support.waiting import PATIENCE_S

if TYPE_CHECKING:
    import subprocess
    from pathlib import Path


class NotifySocket:
    """Takes what is sent; use it as a context manager.

    Args:
        place: folder of the socket; None for an abstract one.
    """

    def __init__(self, place: Path | None) -> None:
        self.address = f"@daqsvc-test-{os.getpid()}-{time.monotonic_ns()}" if place is None else f"{place}/n"
        self.told: list[dict[str, str]] = []
        self.listens_to: subprocess.Popen[str] | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.address.replace("@", "\0") if place is None else self.address)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def next(self, wait_s: float = PATIENCE_S) -> dict[str, str] | None:
        """What is sent next; None if nothing is."""
        self._socket.settimeout(wait_s)
        try:
            text = self._socket.recv(65_536).decode()
        except (TimeoutError, BlockingIOError):
            return None
        self.told.append(dict(line.split("=", 1) for line in text.splitlines()))
        return self.told[-1]

    def until(self, name: str, holds: str = "") -> str:
        """The first value of ``name`` from now on in which ``holds`` stands."""
        until_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < until_s:
            told = self.next(1.0)
            if told is not None and holds in told.get(name, "") and name in told:
                return told[name]
            if told is None and self.listens_to is not None and self.listens_to.poll() is not None:
                break
        pytest.fail(f"{name}={holds} was never told, only {self.told[-20:]}")

    def has_told(self, name: str) -> bool:
        """Whether anything of that name was sent so far; what has arrived is read first."""
        while self.next(0.0) is not None:
            pass
        return any(name in one for one in self.told)
