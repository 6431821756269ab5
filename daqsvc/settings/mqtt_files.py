"""Files with what the box shows to a broker: what can be said of them before anybody connects."""

from __future__ import annotations

import os
import stat
from typing import TYPE_CHECKING

from daqsvc.settings.problems import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from daqsvc.settings.models import MachineFile

LONGEST_PASSWORD = 65_535
"""Bytes of the longest password that MQTT can carry."""


def credential_files(draft: MachineFile) -> Iterator[Finding]:
    """What is wrong with the files of ``[mqtt]`` that are there; reads the password's first line.

    A file that is missing, or that this user must not read, may be there when the service runs.
    """
    mqtt = draft.mqtt
    if mqtt is None:
        return
    for key in ("password_file", "ca_file", "cert_file", "key_file"):
        given: Path | None = getattr(mqtt, key)
        if given is None:
            continue
        path = draft.resolve(given)
        try:
            mode = path.stat().st_mode
        except OSError:
            continue
        if not stat.S_ISREG(mode):
            yield Finding(
                ("mqtt", key),
                "is no regular file, and reading it might never end",
                "name a file with that content",
            )
        elif key in {"password_file", "key_file"}:
            yield from _secret(key, path, mode)


def _secret(key: str, path: Path, mode: int) -> Iterator[Finding]:
    if mode & stat.S_IROTH:
        yield Finding(
            ("mqtt", key),
            "can be read by every user of this machine",
            f"chmod o-rwx {path}, and replace what is in it",
            fatal=False,
        )
    if key == "password_file" and _first_line_bytes(path) > LONGEST_PASSWORD:
        yield Finding(
            ("mqtt", key),
            f"has a first line of more than {LONGEST_PASSWORD} bytes, which MQTT cannot carry",
            "write the password, and nothing else, into its first line",
        )


def _first_line_bytes(path: Path) -> int:
    """Bytes of the first line, as far as it matters; 0 if this user must not read it."""
    try:
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError:
        return 0
    with os.fdopen(handle, "rb") as file:
        return len(file.read(LONGEST_PASSWORD + 2).partition(b"\n")[0].rstrip(b"\r"))
