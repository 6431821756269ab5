"""A real PostgreSQL of its own for tests, on a socket and a loopback port."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.ports import LOOPBACK, free_port

if TYPE_CHECKING:
    from collections.abc import Sequence

OWNER = "nobody"
"""Who runs it where the tests are root's, as PostgreSQL is not for root."""


def programs() -> Path:
    """Where its programs are; skips the test if there is none, unless it is required."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    if found:
        return found[-1].parent
    reason = "no PostgreSQL on this machine (apt-get install postgresql)"
    if os.environ.get("DAQSVC_REQUIRE_POSTGRES") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


class Postgres:
    """A server that can be crashed and started again.

    Args:
        directory: for its files; taken away afterwards.
    """

    def __init__(self, directory: Path) -> None:
        self._programs, self._directory, self.port = programs(), directory, free_port()
        directory.mkdir(mode=0o700)
        if os.geteuid() == 0:
            shutil.chown(directory, OWNER)
        self._run("initdb", "-D", f"{directory}/data", "-A", "trust", "-U", "owner", "-E", "UTF8")

    @property
    def url(self) -> str:
        """Of its database, as its owner."""
        return f"postgresql://owner@{LOOPBACK}:{self.port}/postgres"

    def url_of(self, role: str) -> str:
        """Of its database, as another."""
        return self.url.replace("owner@", f"{role}@")

    def start(self) -> None:
        """Start and wait until it takes connections; blocks."""
        listen = f"-h {LOOPBACK} -p {self.port} -k {self._directory}"
        self._run(
            "pg_ctl",
            "-D",
            f"{self._directory}/data",
            "-w",
            "-o",
            listen,
            "-l",
            f"{self._directory}/log",
            "start",
        )

    @property
    def is_running(self) -> bool:
        """Whether it was started and has not ended."""
        return (self._directory / "data" / "postmaster.pid").exists()

    def crash(self) -> None:
        """End at once, as a kill or a power cut would."""
        self._run("pg_ctl", "-D", f"{self._directory}/data", "-m", "immediate", "-w", "stop")

    def _run(self, program: str, *arguments: str) -> None:
        command: Sequence[str] = [str(self._programs / program), *arguments]
        user = OWNER if os.geteuid() == 0 else None
        subprocess.run(
            command, check=True, user=user, cwd="/", stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT
        )
