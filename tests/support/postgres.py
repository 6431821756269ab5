"""A separate real PostgreSQL for tests, on a socket and a loopback port."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from support.ports import LOOPBACK, free_port

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


def make_cluster(directory: Path) -> None:
    """Make the files of a server that has nothing in it yet, of which each `Postgres` has a copy.

    Args:
        directory: where to; it must not exist.
    """
    initdb = programs() / "initdb"
    _run(initdb, "-D", f"{_owned(directory)}/data", "-A", "trust", "-U", "owner", "-E", "UTF8", "--no-sync")


class Postgres:
    """A server that can be crashed and started again.

    What it has written survives that, but not a crash of this computer: it waits for no disk.

    Args:
        directory: for its files; taken away afterwards.
        cluster: what `make_cluster` has made.
    """

    def __init__(self, directory: Path, cluster: Path) -> None:
        self._programs, self._directory, self.port = programs(), directory, free_port()
        _run("cp", "--recursive", f"{cluster}/data", f"{_owned(directory)}")

    @property
    def url(self) -> str:
        """Of its database, as its owner."""
        return f"postgresql://owner@{LOOPBACK}:{self.port}/postgres"

    def url_of(self, role: str) -> str:
        """Of its database, as another."""
        return self.url.replace("owner@", f"{role}@")

    def start(self) -> None:
        """Start and wait until it takes connections; blocks."""
        options = f"-h {LOOPBACK} -p {self.port} -k {self._directory} -c fsync=off"
        self._pg_ctl("-w", "-o", options, "-l", f"{self._directory}/log", "start")

    @property
    def is_running(self) -> bool:
        """Whether it was started and has not ended."""
        return (self._directory / "data" / "postmaster.pid").exists()

    def crash(self) -> None:
        """End at once, as a kill or a power cut would."""
        self._pg_ctl("-m", "immediate", "-w", "stop")

    def _pg_ctl(self, *arguments: str) -> None:
        _run(self._programs / "pg_ctl", "-D", f"{self._directory}/data", *arguments)


def _owned(directory: Path) -> Path:
    """A new directory of whoever runs the server."""
    directory.mkdir(mode=0o700)
    if os.geteuid() == 0:
        shutil.chown(directory, OWNER)
    return directory


def _run(*command: str | Path) -> None:
    user = OWNER if os.geteuid() == 0 else None
    subprocess.run(
        command, check=True, user=user, cwd="/", stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT
    )
