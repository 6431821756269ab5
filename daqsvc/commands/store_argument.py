"""Which store a verb is about: as ``daqsvc run`` finds it, or the one that there is."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Iterator

    from daqsvc.settings import MachineFile

    Load = Callable[[Path], MachineFile | None]
    """Reads a machine file; None after its errors have been printed."""

JOURNAL = "outbox.sqlite"


class StoreNotFoundError(Exception):
    """No store, or more than one; the text says what to do."""


class BadFileError(Exception):
    """The machine file has errors, which have been printed."""


def store_directory(machine: MachineFile) -> Path:
    """The default place of the journal.

    The machine file's own word first, then systemd's, then the user's state directory (XDG).

    Raises:
        StoreNotFoundError: none of these says anything.
    """
    if machine.store is not None:
        return machine.resolve(machine.store.directory)
    if directory := os.environ.get("STATE_DIRECTORY"):
        return Path(directory.split(":")[0])
    return _state_directory() / f"{machine.site}-{machine.box}-{machine.machine.name}"


def store_doubts(machine: MachineFile) -> Iterator[str]:
    """Why the service could not use the store that a machine file names, if this account ran it.

    Raises:
        AssemblyError: nobody could: it is no directory.
    """
    from daqsvc.outbox.messages import StorePathError  # noqa: PLC0415 - each verb imports only what it needs
    from daqsvc.outbox.safety import account, unusable  # noqa: PLC0415
    from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415

    if machine.store is None:
        return
    at = f"{machine.path}: store.directory = {str(machine.store.directory)!r}"
    try:
        why = unusable(machine.resolve(machine.store.directory))
    except StorePathError as error:
        raise AssemblyError(f"{at}: {error}") from None
    if why:
        yield f"{at}: daqsvc run could not start as {account()}: {why}"


def add_store(parser: argparse.ArgumentParser) -> None:
    """``[FILE | --store DIR]``: whose alarms; to be called when all other arguments are there."""
    either = parser.add_mutually_exclusive_group()
    either.add_argument(
        "file", type=Path, nargs="?", metavar="FILE", help="the machine file that the service runs (TOML)"
    )
    either.add_argument(
        "--store",
        type=Path,
        metavar="DIR",
        help="directory of its alarm journal (default: $STATE_DIRECTORY, else the one there is in "
        "~/.local/state/daqsvc)",
    )
    # argparse shows each for itself, as if both could be given.
    usage = re.sub(r"\[--store DIR\]\s+", "", parser.format_usage())
    parser.usage = usage.removeprefix("usage: ").rstrip().replace("[FILE]", "[FILE | --store DIR]")


def chosen_store(arguments: argparse.Namespace, load: Load) -> Path:
    """The store that the arguments of `add_store` mean.

    Raises:
        BadFileError: the machine file cannot be read.
        StoreNotFoundError: nothing was named, and there is not exactly one store.
    """
    if arguments.store is not None:
        store: Path = arguments.store
        return store
    if arguments.file is not None:
        machine = load(arguments.file)
        if machine is None:
            raise BadFileError
        return store_directory(machine)
    if directory := os.environ.get("STATE_DIRECTORY"):
        return Path(directory.split(":")[0])
    return _only_store(_state_directory())


def _only_store(state: Path) -> Path:
    stores = sorted(journal.parent for journal in state.glob(f"*/{JOURNAL}"))
    if len(stores) == 1:
        return stores[0]
    if not stores:
        raise StoreNotFoundError(
            f"there is no alarm journal below {state}: name the machine file, or its store with --store"
        )
    raise StoreNotFoundError(
        f"there are several alarm journals below {state} ({', '.join(store.name for store in stores)}): "
        "name the machine file, or one of them with --store"
    )


def _state_directory() -> Path:
    try:
        return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "daqsvc"
    except RuntimeError:
        raise StoreNotFoundError(
            f"user {os.geteuid()} has no home directory for the alarm journal: name one with --store, or in "
            "[store] of the machine file"
        ) from None
