"""Whose a store is: what others may write is not used, as sshd does not use keys that others may write.

The service may run as root, and SQLite opens whatever stands under the names of its files. So nobody but the
service's own user and root may be able to put something there.
"""

from __future__ import annotations

import os
import pwd
import stat
from pathlib import Path

from daqsvc.outbox.files import is_read_only, remedy, restrict
from daqsvc.outbox.messages import StorePathError, StoreRefusedError

JOURNAL, BESIDE = "outbox", ("audit.jsonl", "control.sock")
"""How the names of the files begin that nobody else may have put there."""

_OURS = (JOURNAL, "audit", "command-ids", "sparkplug.", "mqtt-", "home-assistant")
"""How the names of the files of a store begin."""

_MOST_LINKS = 40
"""Symbolic links in one path, as the kernel has it."""


def refuse_no_directory(store: Path) -> None:
    """Make sure that a store is a directory, or can be made one.

    Raises:
        StorePathError: something else is in its place, or above it.
        OSError: it cannot be looked at.
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
    except StoreRefusedError as error:
        return f"{error}"
    except OSError as error:
        return f"the store {store} cannot be used: {error.strerror}"
    return f"the store {store} cannot be written: {remedy(store)}" if is_read_only(store) else ""


def account() -> str:
    """This process's user, as `chown` takes it."""
    try:
        return pwd.getpwuid(os.geteuid()).pw_name
    except KeyError:
        return f"{os.geteuid()}"


def refuse_unsafe(store: Path) -> None:
    """Make sure that nobody else can put files into a store.

    Args:
        store: its directory, which exists.

    Raises:
        StoreRefusedError: somebody can, or has; or this account may not look. The text says what to do.
        OSError: it cannot be looked at.
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
        StoreRefusedError: it may not; the text says what to do.
        OSError: it cannot be looked at.
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
            f"chown -R {account()} {store}, run the service as {owner}, or give it a directory of its own"
        )
    raise StoreRefusedError(f"the store {store} may not be written by {us}: {helps}")


def restrict_files(store: Path) -> None:
    """Take from the files of a store what they allow to others than their owner and group.

    Raises:
        OSError: it cannot be looked at.
    """
    for path in store.iterdir():
        if path.name.startswith(_OURS):
            restrict(path)


def refuse_link(path: Path) -> None:
    """Make sure that a file is none of another place or kind, if it is there at all.

    Raises:
        StoreRefusedError: it is; the text says what to do.
        OSError: it cannot be looked at.
    """
    try:
        status = path.lstat()
    except FileNotFoundError:
        return
    _refuse_file(path, status)


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
            f"service runs as {_user(os.geteuid())}: give it a directory of its own, such as /var/lib/daqsvc"
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
    return (
        f"{what} belongs to {_user(owner)} and the service runs as {_user(os.geteuid())}: "
        f"chown {account()} {path}, run the service as {_user(owner)}, "
        "or give it a directory of its own"
    )


def _trusted() -> set[int]:
    return {0, os.geteuid()}


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return f"user {number}"
