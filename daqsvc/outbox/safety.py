"""Whose a store is: what others may write is not used, as sshd does not use keys that others may write.

The service may run as root, and SQLite opens whatever stands under the names of its files. So nobody but the
service's own user and root may be able to put something there.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import stat
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.outbox.files import SIDE_FILES, is_read_only, remedy, restrict
from daqsvc.outbox.messages import StorePathError, StoreRefusedError

if TYPE_CHECKING:
    from collections.abc import Iterator

JOURNAL, BESIDE = "outbox", ("audit.jsonl", "control.sock")
"""How the names of the files begin that nobody else may have put there."""

_OURS = (JOURNAL, "audit", "command-ids", "sparkplug.", "mqtt-", "home-assistant")
"""How the names of the files of a store begin."""

_LOCK = "outbox.sqlite.lock"
"""It is only read."""

_OPENED = (
    *(f"outbox.sqlite{end}" for end in (*SIDE_FILES, ".sequence", ".sequence.twin", ".ballast")),
    *(f"outbox-{what}.sqlite{end}" for what in ("telemetry", "refused") for end in SIDE_FILES),
    "audit.jsonl",
    "command-ids",
    _LOCK,
)
"""The files of a store that the service opens as they are; others it replaces, or only keeps."""

_NO_GROUP = 65_534
"""The group of nobody: of an account without an entry whose directory has root's group."""

_MOST_LINKS = 40
"""Symbolic links in one path, as the kernel has it."""


def refuse_no_directory(store: Path) -> None:
    """Make sure that a store is a directory, or can be made one.

    Raises:
        StorePathError: something else is in its place, or above it.
        OSError: it cannot be examined.
    """
    for at in (store, *store.parents):
        try:
            mode = at.stat().st_mode
        except (FileNotFoundError, NotADirectoryError):
            continue
        if not stat.S_ISDIR(mode):
            what = f"the store {store} is" if at == store else f"{at}, above the store {store}, is"
            raise StorePathError(
                f"{what} no directory, but a file: name a directory in [store] of the machine file, or "
                "with --store"
            )
        return


def unusable(store: Path) -> str:
    """Why a service of this account cannot use a store; empty if it can, or the store is not there yet.

    Raises:
        StorePathError: it is no directory.
    """
    try:
        refuse_no_directory(store)
        if not store.is_dir():
            return ""
        refuse_unsafe(store)
        refuse_unwritable(store)
        refuse_unopenable(store)
    except StoreRefusedError as error:
        return f"{error}"
    except OSError as error:
        return f"the store {store} cannot be used: {error.strerror}"
    return f"the store {store} cannot be written: {remedy(store)}" if is_read_only(store) else ""


def account() -> str:
    """This process's user, as `chown` takes it."""
    return _account(os.geteuid())


@contextlib.contextmanager
def as_owner_of(store: Path) -> Iterator[None]:
    """Let root look at a store as its owner would: all that root reads there, the owner may put there.

    For the verbs: it is the whole process that has other rights until the end. Others than root keep theirs.
    """
    try:
        owner = store.stat()
    except OSError:
        owner = None  # whoever goes on states what is wrong with it
    if owner is None or owner.st_uid == 0 or os.geteuid() != 0:
        yield
        return
    group, groups = os.getegid(), os.getgroups()
    its_group, its_groups = _groups(owner)
    with contextlib.ExitStack() as back:
        # A container may not let its root change accounts: then it looks as root.
        with contextlib.suppress(PermissionError):
            os.setgroups(its_groups)
            back.callback(os.setgroups, groups)
            os.setegid(its_group)
            back.callback(os.setegid, group)
            os.seteuid(owner.st_uid)
            back.callback(os.seteuid, 0)
        yield


def _groups(owner: os.stat_result) -> tuple[int, list[int]]:
    """The group of who owns a directory, and all of his groups.

    The directory's own group shows nothing: after `chown USER` it is still root's.
    """
    try:
        entry = pwd.getpwuid(owner.st_uid)
    except KeyError:
        group = owner.st_gid or _NO_GROUP
        return group, [group]
    return entry.pw_gid, os.getgrouplist(entry.pw_name, entry.pw_gid)


def refuse_unsafe(store: Path) -> None:
    """Make sure that nobody else can put files into a store.

    Args:
        store: its directory, which exists.

    Raises:
        StoreRefusedError: somebody can, or has; or this account may not look. The text states what to do.
        OSError: it cannot be examined.
    """
    _refuse_path(store)
    try:
        paths = list(store.iterdir())
    except PermissionError:
        refuse_unwritable(store)
        raise
    for path in paths:
        if path.name.startswith(JOURNAL):
            refuse_link(path)
        elif path.name.startswith(BESIDE) and (owner := path.lstat().st_uid) not in _trusted():
            raise StoreRefusedError(_belongs(f"{path}", owner, path))


def refuse_unwritable(store: Path) -> None:
    """Make sure that this account may write in a store; a file system that is read-only may come back.

    Raises:
        StoreRefusedError: it may not; the text states what to do.
        OSError: it cannot be examined.
    """
    if is_read_only(store) or os.access(store, os.R_OK | os.W_OK | os.X_OK, effective_ids=True):
        return
    status = store.stat()
    us, owner = _user(os.geteuid()), _user(status.st_uid)
    if status.st_uid == os.geteuid():
        # Its owner may give himself the right; anybody else needs another owner.
        helps = f"chmod u+rwx {store}"
    else:
        helps = (
            f"it belongs to {owner} and has mode {stat.S_IMODE(status.st_mode):04o}: "
            f"chown -R {account()} {store}, run the service as {owner}, or give it its own directory"
        )
    raise StoreRefusedError(f"the store {store} may not be written by {us}: {helps}")


def refuse_unopenable(store: Path) -> None:
    """Make sure that this account may open what it keeps in a store, which may be a copy that root has made.

    Without its journal the service would run all the same, as on a disk that fails, and lose what it held.

    Raises:
        StoreRefusedError: it may not; the text states what to do.
        OSError: it cannot be examined.
    """
    writable = 0 if is_read_only(store) else os.W_OK
    for path in (store / name for name in _OPENED):
        needed = os.R_OK | (writable if path.name != _LOCK else 0)
        try:
            status = path.lstat()
        except FileNotFoundError:
            continue
        is_ours = not stat.S_ISREG(status.st_mode) or os.access(path, needed, effective_ids=True)
        # The service that ends takes some away just now.
        if is_ours or not os.path.lexists(path):
            continue
        us = account()
        if status.st_uid == os.geteuid():
            raise StoreRefusedError(f"{path} may not be opened by {us}, the owner: chmod u+rw {path}")
        raise StoreRefusedError(
            f"{path} belongs to {_user(status.st_uid)}, and the user of the service, {us}, may not open it: "
            f"chown -R {us} {store}"
        )


def restrict_files(store: Path) -> None:
    """Take from the files of a store what they allow to others than their owner and group.

    Raises:
        OSError: it cannot be examined.
    """
    for path in store.iterdir():
        if path.name.startswith(_OURS):
            restrict(path)


def refuse_link(path: Path) -> None:
    """Make sure that a file is none of another place or kind, if it is there at all.

    Raises:
        StoreRefusedError: it is; the text states what to do.
        OSError: it cannot be examined.
    """
    try:
        status = path.lstat()
    except FileNotFoundError:
        return
    _refuse_file(path, status)


def refuse_foreign(path: Path) -> None:
    """The same for who only reads a file: it may also be of the owner of its store, which is no link either.

    Raises:
        StoreRefusedError, OSError: as above.
    """
    status = path.lstat()
    if not stat.S_ISREG(status.st_mode) or status.st_uid != path.parent.stat().st_uid:
        _refuse_file(path, status)


def whose_to_read(path: Path) -> str:
    """Who may read a file of a store, or what is to be done first."""
    with contextlib.suppress(OSError):
        owner, store = path.lstat().st_uid, path.parent.stat()
        if owner != store.st_uid:
            theirs = f"chown -R {_account(store.st_uid)} {path.parent}"
            return f"it belongs to {_user(owner)} and its store to {_user(store.st_uid)}: {theirs}"
    return "run this as the service's user or as root"


def _refuse_path(store: Path) -> None:
    """Look at each directory on the way to the store, and at each symbolic link."""
    at = Path(store.absolute().anchor)
    waiting = list(reversed(store.absolute().parts[1:]))
    links = 0
    while True:
        status = at.lstat()
        if stat.S_ISLNK(status.st_mode):
            links += 1
            if status.st_uid not in _trusted() or links > _MOST_LINKS:
                raise StoreRefusedError(
                    f"the store {store} is behind {at}, a symbolic link of {_user(status.st_uid)}: name a "
                    "directory that the service's own user has made"
                )
            target = at.parent / at.readlink()
            waiting += reversed(target.parts[1:])
            at = Path(target.anchor)
            continue
        _refuse_directory(at, status, None if waiting else store, f"{at}, above the store {store},")
        if not waiting:
            return
        at /= waiting.pop()


def _refuse_directory(directory: Path, status: os.stat_result, store: Path | None, above: str) -> None:
    """Look at one directory: the ``store``, or with None one ``above`` it."""
    if status.st_uid not in _trusted():
        if store is not None:
            raise StoreRefusedError(_belongs(f"the store {store}", status.st_uid, directory))
        raise StoreRefusedError(
            f"{above} belongs to {_user(status.st_uid)}, who could put another store in its place, and the "
            f"service runs as {_user(os.geteuid())}: give it its own directory, such as /var/lib/daqsvc"
        )
    mode = stat.S_IMODE(status.st_mode)
    is_open = mode & stat.S_IWOTH or (mode & stat.S_IWGRP and status.st_gid != os.getegid())
    if not is_open or (store is None and mode & stat.S_ISVTX):
        return
    raise StoreRefusedError(
        f"{above if store is None else f'the store {store}'} has mode {mode:04o}, so that others may put "
        f"files of theirs into it: {_narrowed(directory, status, is_store=store is not None)}, and look at "
        "what is in it before the next start"
    )


def _narrowed(directory: Path, status: os.stat_result, *, is_store: bool) -> str:
    """What to do about a directory that others may write.

    A volume that is made by root, as Kubernetes makes those of kind emptyDir, could not be written at all if
    it were only taken from the others.
    """
    if status.st_uid == os.geteuid():
        return f"chmod go-w {directory}"
    if not is_store:
        return f"chmod go-w {directory}, or chmod +t it, as root"
    owned = f"chown {account()} {directory} && chmod 700 {directory}"
    return f"{owned}, as root (on Kubernetes: in an init container)"


def _refuse_file(path: Path, status: os.stat_result) -> None:
    if stat.S_ISLNK(status.st_mode):
        raise StoreRefusedError(
            f"{path} is a symbolic link of {_user(status.st_uid)} to {path.readlink()}: the service follows "
            "none in its store; remove it, and move what it points to here if it is the store's"
        )
    if status.st_uid not in _trusted():
        raise StoreRefusedError(_belongs(f"{path}", status.st_uid, path))


def _belongs(what: str, owner: int, path: Path) -> str:
    # What is given to root, the service's own account could not open any more.
    taken = f"chown {account()} {path}, " if os.geteuid() else ""
    return (
        f"{what} belongs to {_user(owner)} and the service runs as {_user(os.geteuid())}: "
        f"{taken}run the service as {_user(owner)}, or give it its own directory"
    )


def _trusted() -> set[int]:
    return {0, os.geteuid()}


def _account(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"{number}"


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"user {number}"
