"""Which store a verb is about: as ``daqsvc run`` finds it, or the one that there is."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.commands.complaint import complain
from daqsvc.commands.machine_files import load_machines, read_box
from daqsvc.errors.code import with_code
from daqsvc.errors.command_line import NO_STORE, OTHER_FILES
from daqsvc.errors.service import UNUSABLE_STORE

if TYPE_CHECKING:
    import argparse
    from collections.abc import Iterator, Sequence

    from daqsvc.alarms.events import Identity
    from daqsvc.box import Box
    from daqsvc.commands.machine_files import Load
    from daqsvc.settings import MachineFile

JOURNAL = "outbox.sqlite"


class StoreNotFoundError(Exception):
    """No store, or more than one; the text states what to do."""

    code = NO_STORE


class BadFileError(Exception):
    """The machine file has errors, which have been printed."""


class OtherFileError(Exception):
    """The store is that of another machine file than the one that was named; states which, and the remedy."""

    code = UNUSABLE_STORE


class ChosenStore(NamedTuple):
    """What the arguments of a verb mean.

    Attributes:
        directory: of the store.
        machine: the machine that is meant; None for all.
        machines: those of the machine files that were named, where the store is theirs for certain.
        other: a sentence if the store is that of another machine file than the one named; else empty.
        instead: what to do about that.
    """

    directory: Path
    machine: str | None
    machines: tuple[str, ...] = ()
    other: str = ""
    instead: str = ""

    def tell_other(self, verb: str) -> None:
        """Say on stderr that what is shown is of another machine file, if so."""
        if self.other:
            complain(verb, f"{self.other}. Remedy: {self.instead}", UNUSABLE_STORE)

    def refuse_other(self) -> None:
        """Do nothing to the alarms of another machine file.

        Raises:
            OtherFileError: the store is that of another one.
        """
        if self.other:
            raise OtherFileError(f"nothing was done: {self.other}. Remedy: {self.instead}")


def store_directory(box: Box) -> Path:
    """The default place of the journal of a box.

    The machine file's own word first, then systemd's, then the user's state directory (XDG).

    Raises:
        StoreNotFoundError: none of these states anything.
    """
    own = box.own
    if own.store is not None:
        return own.resolve(own.store.directory)
    return _default_directory(own, f"-{own.machine.name}" if box.is_single else "")


def store_in_words(box: Box) -> str:
    """Where `daqsvc run` keeps the journal of a box, and why there."""
    try:
        store = store_directory(box)
    except StoreNotFoundError:
        return "none: this user has no home directory; name one in [store]"
    if box.own.store is not None:
        return f"{store}"
    with contextlib.suppress(RuntimeError, ValueError):
        store = Path("~") / store.relative_to(Path.home())
    return f"{store}, where [store] names no other; under systemd, the state directory of the unit"


def files_by_identity(box: Box) -> dict[Identity, Path]:
    """The machine files of a box, by the names of their machines."""
    from daqsvc.alarms.events import Identity  # noqa: PLC0415 - only what a verb needs

    return {Identity(one.site, one.box, name): one.path for name, one in box.machines.items()}


def doubts_of_owner(box: Box) -> Iterator[str]:
    """Why `daqsvc run` would refuse the store of a box: it is that of another file of the same names."""
    from daqsvc.outbox.machine_files import in_words, other_file  # noqa: PLC0415 - as above

    with contextlib.suppress(StoreNotFoundError):
        store = store_directory(box)
        for identity, file in files_by_identity(box).items():
            if (other := other_file(store, identity, file)) is not None:
                yield with_code(in_words(store, identity, file, other), UNUSABLE_STORE)


def _default_directory(machine: MachineFile, end: str = "") -> Path:
    if directory := os.environ.get("STATE_DIRECTORY"):
        return Path(directory.split(":")[0])
    return _state_directory() / f"{machine.site}-{machine.box}{end}"


def store_doubts(machine: MachineFile) -> Iterator[str]:
    """Why the service could not use the store that a machine file names, if this account ran it.

    Root learns what would keep the owner of the store from using it: nobody lets the service run as root.

    Raises:
        AssemblyError: nobody could: it is no directory, or a newer version of the program has written it.
    """
    from daqsvc.commands.tables import harmless  # noqa: PLC0415 - only what a verb needs
    from daqsvc.outbox.files import is_read_only  # noqa: PLC0415
    from daqsvc.outbox.messages import NewerOutboxError, StorePathError  # noqa: PLC0415
    from daqsvc.outbox.reading import refuse_newer_header  # noqa: PLC0415
    from daqsvc.outbox.safety import account, as_owner_of, unusable  # noqa: PLC0415
    from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415

    if machine.store is None:
        return
    at = f"{machine.path}: store.directory = {str(machine.store.directory)!r}"
    try:
        store = machine.resolve(machine.store.directory)
        with as_owner_of(store):
            # The owner chooses the names of its files, and what is in them.
            who, why = account(), harmless(unusable(store))
            was_read = _refuse_newer(store)
        if why and not was_read:
            refuse_newer_header(store / JOURNAL)  # only this account may be able to read it
    except (NewerOutboxError, StorePathError) as error:
        raise AssemblyError(f"{at}: {harmless(f'{error}')}", code=UNUSABLE_STORE) from None
    if why and is_read_only(store):
        what = f"daqsvc run would keep the alarms in memory only, and lose them at its end: {why}"
        yield with_code(f"{at}: {what}", UNUSABLE_STORE)
    elif why:
        yield with_code(f"{at}: daqsvc run could not start as {who}: {why}", UNUSABLE_STORE)


def _refuse_newer(store: Path) -> bool:
    """See `refuse_newer`; whether this account may read the journal at all."""
    from daqsvc.outbox.messages import StoreRefusedError  # noqa: PLC0415 - only what a verb needs
    from daqsvc.outbox.reading import refuse_newer  # noqa: PLC0415

    # A separate message covers that: it is only this account that may not use it.
    with contextlib.suppress(StoreRefusedError):
        refuse_newer(store / JOURNAL)
        return os.access(store / JOURNAL, os.R_OK, effective_ids=True)
    return False


def add_store(parser: argparse.ArgumentParser, *, of_a_machine: bool = True) -> None:
    """``[FILE | --store DIR]``: whose alarms; to be called when all other arguments are there.

    Args:
        parser: of the verb.
        of_a_machine: whether the verb can be about one of several machines, by ``--machine``.
    """
    either = parser.add_mutually_exclusive_group()
    either.add_argument(
        "file",
        type=Path,
        nargs="?",
        metavar="FILE",
        help="machine file (TOML) that the service runs, or the directory of its machine files",
    )
    either.add_argument(
        "--store",
        type=Path,
        metavar="DIR",
        help="directory of the alarm journal (default: $STATE_DIRECTORY, else the only store in "
        "~/.local/state/daqsvc)",
    )
    if of_a_machine:
        parser.add_argument(
            "--machine", metavar="NAME", help="name of the machine, if the service watches several"
        )
    # argparse shows each for itself, as if both could be given.
    usage = re.sub(r"\[--store DIR\]\s+", "", parser.format_usage())
    parser.usage = usage.removeprefix("usage: ").rstrip().replace("[FILE]", "[FILE | --store DIR]")


def chosen_store(arguments: argparse.Namespace, load: Load, *, all_sound: bool = False) -> ChosenStore:
    """The store that the arguments of `add_store` mean.

    Args:
        arguments: of the command line.
        load: reads a machine file; None after its errors have been printed.
        all_sound: whether all files of a directory must be sound; else those that are may tell the store.

    Raises:
        BadFileError: the machine file cannot be read.
        StoreNotFoundError: nothing was named, and there is not exactly one store; or it is no directory.
    """
    chosen, box = _chosen(arguments, load, all_sound=all_sound)
    _refuse_file(chosen.directory)
    return chosen if box is None else _compared(chosen, box)


def _compared(chosen: ChosenStore, box: Box) -> ChosenStore:
    """With what to know where the store is that of another file, as ``daqsvc run`` would refuse it.

    A copy with the same text is no other machine: people keep one beside the file that the service runs.
    """
    from daqsvc.commands.tables import harmless  # noqa: PLC0415 - only what a verb needs
    from daqsvc.outbox.machine_files import other_file  # noqa: PLC0415 - as above

    for identity, file in files_by_identity(box).items():
        if chosen.machine not in {None, identity.machine}:
            continue
        other = other_file(chosen.directory, identity, file)
        if other is None or _have_one_text(file, other):
            continue
        words = (
            f"{file} has the same site {identity.site!r}, box {identity.box!r} and machine "
            f"{identity.machine!r} as {other}, with which the service was started: values and alarms are "
            f"those of {other}"
        )
        instead = (
            f"name {other} if you mean them; if {file} is another machine, write another name = ... in "
            f"[machine] of it; if it takes the place of {other}, run the service with it"
        )
        return chosen._replace(other=harmless(words), instead=harmless(instead))
    return chosen


def _have_one_text(file: Path, other: Path) -> bool:
    with contextlib.suppress(OSError):
        return file.read_bytes() == other.read_bytes()
    return False


def _chosen(arguments: argparse.Namespace, load: Load, *, all_sound: bool) -> tuple[ChosenStore, Box | None]:
    """The store, and the box of the machine files if they were named and are sound."""
    machine: str | None = getattr(arguments, "machine", None)
    if arguments.store is not None:
        return ChosenStore(arguments.store, machine), None
    if arguments.file is not None:
        return _of_file(arguments.file, load, machine, all_sound=all_sound)
    if directory := os.environ.get("STATE_DIRECTORY"):
        return ChosenStore(Path(directory.split(":")[0]), machine), None
    return ChosenStore(_only_store(_state_directory()), machine), None


def _refuse_file(store: Path) -> None:
    from daqsvc.outbox.messages import StorePathError  # noqa: PLC0415 - only what a verb needs
    from daqsvc.outbox.safety import refuse_no_directory  # noqa: PLC0415

    try:
        refuse_no_directory(store)
    except StorePathError as error:
        raise StoreNotFoundError(f"{error}") from None
    except OSError:
        return  # the reader of the journal reports what this account may not do


def _of_file(
    path: Path, load: Load, machine: str | None, *, all_sound: bool
) -> tuple[ChosenStore, Box | None]:
    from daqsvc.box import BOX  # noqa: PLC0415 - each verb imports only what it needs

    box, sound = load_machines([path], load)
    if box is None:
        if all_sound:
            raise BadFileError
        try:
            store = _of_sound(path, sound)
        except BadFileError:
            # The service may run well by what the file was before.
            print("or name the store with --store DIR", file=sys.stderr)  # noqa: T201 - after the errors
            raise
        return ChosenStore(store, machine, (*(one.machine.name for one in sound), BOX)), None
    store = store_directory(box)
    if not box.is_single:
        return ChosenStore(store, machine, (*box.machines, BOX)), box
    # Also where the file names the store: other files may name the same one.
    machine = machine or box.own.machine.name
    if box.own.store is None and not _is_used(store):
        for other in _of_its_box(path, box.own):
            if _is_used(other):
                return ChosenStore(other, machine), box
    return ChosenStore(store, machine, tuple(box.machines)), box


def _of_sound(path: Path, sound: Sequence[MachineFile]) -> Path:
    """The store by the sound files of a directory: the service goes on with what others were before.

    Raises:
        BadFileError: they do not tell one store.
    """
    named = {one.resolve(one.store.directory) for one in sound if one.store is not None}
    stores = named or {_default_directory(one) for one in sound}
    # Without [store] in any, one of those with errors may have it.
    if len(stores) != 1 or not (named or all(map(_is_used, stores))):
        raise BadFileError
    [store] = stores
    what = f"the store is taken from the other machine files: {store}"
    complain(f"{path}", what, OTHER_FILES)
    return store


def _of_its_box(path: Path, own: MachineFile) -> Iterator[Path]:
    """Which stores the machine of a file may have together with others."""
    from daqsvc.settings import MachineFileError  # noqa: PLC0415 - as above

    try:
        box = read_box([path.parent])
    except MachineFileError:
        box = None  # its neighbours are none of its business, as a rule
    if box is not None and own.machine.name in box.machines:
        yield store_directory(box)
    yield _default_directory(own)


def _is_used(store: Path) -> bool:
    """Whether a service has a journal in a directory, or runs on it."""
    from daqsvc.control import SOCKET  # noqa: PLC0415 - as above

    # The directory of another account shows nothing.
    return any(os.path.lexists(store / name) for name in (JOURNAL, SOCKET))


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
