"""Which machine files the alarms of a store are of: two files of the same names must not share it by mistake.

The alarms of a machine that its file no longer has are closed at a start. So a copy of a file, left with the
name of the machine, would close those of the first one. A file that was moved or renamed is the same machine.
"""

from __future__ import annotations

import json
import logging
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.errors.code import with_code
from daqsvc.errors.service import UNUSABLE_STORE
from daqsvc.notice import notice
from daqsvc.outbox.files import read_whole, replace_durably
from daqsvc.outbox.messages import StorePathError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.alarms.events import Identity

log = logging.getLogger(__name__)

FILE = "outbox.sqlite.machines"
"""Beside the journal: by the name of each machine, its file."""

_MOST_BYTES = 1 << 20


class StoreOfAnotherFileError(StorePathError):
    """The store is that of another machine file with the same names; states which, and the remedy."""


def noted_files(store: Path) -> dict[str, Path]:
    """By machine, the file that a store was used with last; empty if that is not known."""
    try:
        noted = json.loads(read_whole(store / FILE, _MOST_BYTES))
    except (OSError, ValueError):  # of before files were noted, not readable, or damaged
        return {}
    if not isinstance(noted, dict):
        return {}
    return {name: Path(file) for name, file in noted.items() if isinstance(file, str)}


def note_files(store: Path, files: Mapping[str, Path]) -> None:
    """Note the machine files that a store is used with; a disk that cannot take it is no fault.

    Args:
        store: directory of the journal.
        files: by machine, its file.
    """
    noted = {name: f"{file.absolute()}" for name, file in files.items()}
    if {name: f"{file}" for name, file in noted_files(store).items()} == noted:
        return
    try:
        replace_durably(store / FILE, f"{json.dumps(noted, indent=1)}\n".encode())
    except (OSError, ValueError) as error:
        log.info("%s is not written: %s; it is tried again at the next start", store / FILE, error)


def other_file(store: Path, identity: Identity, file: Path) -> Path | None:
    """The other file of the same names whose store this is; None if there is none.

    One that is gone was moved, renamed or replaced, and one that has other names by now has another store.

    Args:
        store: directory of the journal.
        identity: site, box and machine of the file.
        file: that is to be used with the store.
    """
    other = noted_files(store).get(identity.machine)
    if other is None:
        return None
    try:
        if other.samefile(file):
            return None
        text = other.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return other  # somebody is editing it
    machine = tables.get("machine")
    names = (
        tables.get("site"),
        tables.get("box"),
        machine.get("name") if isinstance(machine, dict) else None,
    )
    return other if names == (identity.site, identity.box, identity.machine) else None


def take_store(store: Path, files: Mapping[Identity, Path], *, on_purpose: bool) -> None:
    """See that a store is that of these machine files, or of no file, or was theirs before they were moved.

    Args:
        store: directory of the journal.
        files: by the names of each machine, its file.
        on_purpose: whether a person has named the store, so that one of another file is taken over.

    Raises:
        StoreOfAnotherFileError: it is that of another file, which is still there.
    """
    noted = noted_files(store)
    for identity, file in files.items():
        other = other_file(store, identity, file)
        if other is not None and not on_purpose:
            raise StoreOfAnotherFileError(with_code(in_words(store, identity, file, other), UNUSABLE_STORE))
        before = noted.get(identity.machine)
        if before is not None and (other is not None or not before.exists()):
            notice(log, "the store %s was that of %s; now it is that of %s", store, before, file.absolute())


def in_words(store: Path, identity: Identity, file: Path, other: Path) -> str:
    """Why a file must not be used with the store of another one, and what to do."""
    return (
        f"the store {store} is that of {other}: {file} has the same site {identity.site!r}, box "
        f"{identity.box!r} and machine {identity.machine!r}, and would close its alarms. Remedy: write "
        f"another name = ... in [machine] of {file}. If {file} takes the place of {other}, delete {other}, "
        f"or name the store: daqsvc run {file} --store {store}"
    )
