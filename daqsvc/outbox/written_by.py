"""Which version of the program has written a store last: for whoever goes back to an earlier one."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from daqsvc import __version__
from daqsvc.outbox.files import read_whole, replace_durably

if TYPE_CHECKING:
    from pathlib import Path

log = logging.getLogger(__name__)

_MOST_BYTES = 64


def version_file(path: Path) -> Path:
    """Where the version stands, beside the journal ``path``."""
    return path.with_name(path.name + ".version")


def written_by(path: Path) -> str:
    """The version that has opened the journal ``path`` last; empty if that is not known."""
    try:
        return read_whole(version_file(path), _MOST_BYTES).decode("ascii", "replace").strip()
    except OSError:  # of before versions were noted, or not readable: then nothing is reported of it
        return ""


def note_version(path: Path) -> None:
    """Note that this version has opened the journal ``path``; a disk that cannot take it is no fault."""
    if written_by(path) == __version__:
        return
    try:
        replace_durably(version_file(path), f"{__version__}\n".encode())
    except OSError as error:
        log.info("%s is not written: %s; it is tried again at the next start", version_file(path), error)
