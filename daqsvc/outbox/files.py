"""Files of the outbox: durable names, one owner, connections that are checked, the corrupt set aside."""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import sqlite3
import stat
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.errors.code import coded
from daqsvc.errors.service import UNUSABLE_STORE
from daqsvc.outbox.messages import StoreInUseError

if TYPE_CHECKING:
    from typing import BinaryIO

log = logging.getLogger(__name__)

FileError = (sqlite3.Error, OSError, UnicodeDecodeError)
"""What goes wrong with a file. Names out of a damaged one are no text, which comes as the last of these."""

SIDE_FILES = ("", "-wal", "-shm")
"""Suffixes of the files that make up one SQLite database."""

WAL_PAGES = 1000
"""Pages in the write-ahead log from which on they are moved to the database: about 4 MiB."""

WAL_MAX_BYTES = 8 * 1024 * 1024
"""The write-ahead log is cut to this when it starts again."""

ASIDE_KEPT = 3
"""Corrupt files that are kept; a failing disk must not fill itself with them."""

MODE = 0o640
"""Most that the files of a store allow, whatever the umask: alarms are nobody's business but the group's."""

NEW_MODE, NEW_DIRECTORY_MODE, PARENT_MODE = 0o600, 0o700, 0o755
"""What new files, the store and directories above it allow at most, whatever the umask."""

_DAMAGED = {
    sqlite3.SQLITE_CORRUPT,
    sqlite3.SQLITE_NOTADB,
    sqlite3.SQLITE_ERROR,
    sqlite3.SQLITE_SCHEMA,
    sqlite3.SQLITE_TOOBIG,
    sqlite3.SQLITE_CONSTRAINT,
    sqlite3.SQLITE_MISMATCH,
    sqlite3.SQLITE_FORMAT,
}


class NewerFileError(sqlite3.DatabaseError):
    """A newer version of the program has written a database.

    Args:
        version: of its tables.
    """

    def __init__(self, version: int) -> None:
        super().__init__(f"its form is {version}, which a newer version of daqsvc has written")
        self.version = version


_NO_ROOM = {errno.ENOSPC, errno.EDQUOT}

_MAY_PASS = {
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_NOMEM,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_CANTOPEN,
}

_MAY_PASS_TOO = _NO_ROOM | {errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ESTALE}

NS_PER_MS = 1_000_000


def restrict(path: Path) -> None:
    """Take from a file whatever it allows beyond `MODE`, if the file system knows modes.

    By name: closing a handle of a database would undo this process's locks on it.
    """
    try:
        status = path.lstat()
        if stat.S_ISREG(status.st_mode) and stat.S_IMODE(status.st_mode) & ~MODE:
            path.chmod(status.st_mode & MODE)
    except FileNotFoundError:
        return
    except OSError as error:
        log.info("%s stays as readable as it is: %s", path, error)


def sync_directory(directory: Path) -> None:
    """Make new, renamed and deleted names in ``directory`` survive a power cut."""
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_directory(directory: Path) -> None:
    """Create ``directory`` and what is missing above it, durably."""
    _make_directory(directory, NEW_DIRECTORY_MODE)


def _make_directory(directory: Path, mode: int) -> None:
    if directory.is_dir():
        return
    _make_directory(directory.parent, PARENT_MODE)
    directory.mkdir(mode, exist_ok=True)
    sync_directory(directory.parent)


def create(path: Path, flags: int = os.O_RDWR) -> int:
    """Open a file that only its owner may read, made if need be; never through a symbolic link.

    Returns:
        Its descriptor.
    """
    return os.open(path, flags | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, NEW_MODE)


def read_whole(path: Path, most: int) -> bytes:
    """The first ``most`` bytes of a file; never through a symbolic link, and never waiting for a pipe."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
        return file.read(most)


def replace_durably(path: Path, content: bytes) -> None:
    """Give ``path`` a new content: after a power cut it has either the old or the new one, whole."""
    draft = path.with_name(path.name + ".new")
    draft.unlink(missing_ok=True)
    with os.fdopen(create(draft, os.O_WRONLY | os.O_EXCL), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)
    sync_directory(path.parent)


def append_durably(path: Path, content: bytes) -> None:
    """Add to the end of a file that is there; after a power cut some of it may be missing.

    Raises:
        OSError: it is not there, or was not written whole.
    """
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC | os.O_NOFOLLOW), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def overwrite_durably(descriptor: int, content: bytes) -> None:
    """Write over the beginning of a file, in place: that takes no room on a full disk."""
    written = os.pwrite(descriptor, content, 0)
    if written < len(content):
        raise OSError(errno.EIO, f"only {written} of {len(content)} bytes were written")
    os.fsync(descriptor)


def sync_file(path: Path) -> None:
    """Have the content of a file survive a power cut."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def take_possession(path: Path) -> BinaryIO:
    """Keep other processes out of the store: two writers would give the same numbers and fight at the broker.

    The system gives the lock back however this process ends.

    Args:
        path: the lock file.

    Raises:
        StoreInUseError: another process has it.
    """
    lock = os.fdopen(_lock_file(path), "rb")
    try:
        restrict(path)
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise StoreInUseError(
            f"another daqsvc uses the store {path.parent}; stop it if it watches the same machine, else give "
            f"this one its own directory, e.g. {path.parent}/NAME, in [store] of its machine file; or "
            "have one service watch all these machines"
        ) from None
    except BaseException:
        lock.close()
        raise
    return lock


def is_possessed(path: Path) -> bool:
    """Whether a process has taken possession of a store, by the word of the kernel; nothing is locked.

    Args:
        path: the lock file.
    """
    try:
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC | os.O_NOFOLLOW)
        try:
            place = f" {_device_of(handle)}:{os.fstat(handle).st_ino} "
        finally:
            os.close(handle)
        locks = Path("/proc/locks").read_text(encoding="ascii").splitlines()
    except OSError:
        return False
    # "1: FLOCK  ADVISORY  WRITE 4711 08:01:131075 0 EOF"
    return any(" FLOCK " in lock and place in lock for lock in locks)


def _device_of(handle: int) -> str:
    """The device of an open file as ``/proc/locks`` writes it, which is that of its mount.

    Files of one inode number lie on any number of file systems; `os.fstat` tells other devices on some.
    """
    about = Path(f"/proc/self/fdinfo/{handle}").read_text(encoding="ascii").splitlines()
    mount = next((line.split()[1] for line in about if line.startswith("mnt_id:")), "")
    for line in Path("/proc/self/mountinfo").read_text(errors="replace").splitlines():
        number, _, device, *_ = line.split()
        if number == mount:
            major, minor = map(int, device.split(":"))
            return f"{major:02x}:{minor:02x}"
    device_number = os.fstat(handle).st_dev
    return f"{os.major(device_number):02x}:{os.minor(device_number):02x}"


def is_read_only(directory: Path) -> bool:
    """Whether a directory is on a file system that is mounted read-only; no if it cannot be asked.

    For one that is not there, the nearest directory above it is asked: it would be made there.
    """
    for at in (directory, *directory.parents):
        try:
            return bool(os.statvfs(at).f_flag & os.ST_RDONLY)
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError:
            return False
    return False


def remedy(directory: Path) -> str:
    """What to do about a disk that takes no writes."""
    if is_read_only(directory):
        return "its file system is read-only: mount it writable again"
    return "make room on the disk"


def _lock_file(path: Path) -> int:
    """The lock file; one that is there can be locked on a disk that takes no writes, too."""
    try:
        return os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        return create(path)


def connect(
    path: Path | str, *, synchronous: str, wal_pages: int = WAL_PAGES, thorough: bool = False
) -> sqlite3.Connection:
    """A connection for one writer, the file checked.

    Args:
        path: the database; ``":memory:"`` for one without a file.
        synchronous: ``"FULL"`` to have each commit on the disk, ``"OFF"`` to leave it to the system.
        wal_pages: pages in the write-ahead log from which on they are moved to the database.
        thorough: have indices and tables compared as well.

    Raises:
        sqlite3.Error: the file is corrupt (see `is_corrupt`) or cannot be used.
        OSError: it cannot be made.
    """
    if isinstance(path, Path):
        if not os.path.lexists(path):
            # SQLite would ask the umask; the files beside a database get the mode of the database.
            os.close(create(path))
        for suffix in SIDE_FILES:
            restrict(path.with_name(path.name + suffix))
    connection = sqlite3.connect(path, isolation_level=None, timeout=5.0)
    try:
        # Before anything is written: it decides how a new file is laid out.
        connection.execute("PRAGMA auto_vacuum = INCREMENTAL")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute(f"PRAGMA synchronous = {synchronous}")
        connection.execute(f"PRAGMA wal_autocheckpoint = {wal_pages}")
        connection.execute(f"PRAGMA journal_size_limit = {WAL_MAX_BYTES}")
        check(connection, thorough=thorough)
    except BaseException:
        connection.close()
        raise
    return connection


def check(connection: sqlite3.Connection, *, thorough: bool = False) -> None:
    """See whether a database is sound.

    Raises:
        sqlite3.DatabaseError: it is not, see `is_corrupt`.
    """
    how = "integrity_check" if thorough else "quick_check"
    verdict = connection.execute(f"PRAGMA {how}(1)").fetchone()[0]
    if verdict != "ok":
        raise corruption(str(verdict))


def pragma(connection: sqlite3.Connection, name: str) -> int:
    """The value of a numeric pragma."""
    value: int = connection.execute(f"PRAGMA {name}").fetchone()[0]
    return value


def used_bytes(connection: sqlite3.Connection) -> int:
    """What the database needs on the disk, but for free pages and the write-ahead log."""
    pages = pragma(connection, "page_count") - pragma(connection, "freelist_count")
    return pages * pragma(connection, "page_size")


def free_bytes(directory: Path) -> int:
    """What this process may still write on the disk of ``directory``."""
    disk = os.statvfs(directory)
    return disk.f_bavail * disk.f_frsize


def set_aside(path: Path, wall_ns: int) -> Path:
    """Rename a corrupt database; the oldest of more than `ASIDE_KEPT` such files are deleted.

    Returns:
        The new name.
    """
    stamp = wall_ns // NS_PER_MS
    while (aside := path.with_name(f"{path.name}.corrupt-{stamp}")).exists():
        stamp += 1
    for suffix in SIDE_FILES:
        part = path.with_name(path.name + suffix)
        if part.exists():
            part.rename(aside.with_name(aside.name + suffix))
    earlier = [
        old for old in path.parent.glob(f"{path.name}.corrupt-*") if not old.name.endswith(SIDE_FILES[1:])
    ]
    for old in sorted(earlier, key=lambda old: old.stat().st_mtime_ns)[:-ASIDE_KEPT]:
        if old != aside:
            delete(old)
    sync_directory(path.parent)
    return aside


def put_by(path: Path, version: int, wall_ns: int) -> Path:
    """Rename a sound database whose tables are of a newer version; such files are never deleted.

    Args:
        path: the database, which is not open anywhere.
        version: of its tables.
        wall_ns: wall clock, ns since the Unix epoch.

    Returns:
        The new name.

    Raises:
        OSError: it cannot be renamed.
    """
    stamp = wall_ns // NS_PER_MS
    while (aside := path.with_name(f"{path.name}.version-{version}-{stamp}")).exists():
        stamp += 1
    # The database last: what a crash leaves under the old name is found, and put by, at the next start.
    for suffix in reversed(SIDE_FILES):
        part = path.with_name(path.name + suffix)
        if part.exists():
            part.rename(aside.with_name(aside.name + suffix))
    sync_directory(path.parent)
    log.warning(
        "%s was written by a newer version of daqsvc (its form is %d); it is kept as %s, and a new one is "
        "begun; to have what waits in it sent, install that version again and, with the service stopped, "
        "give the file its old name",
        path,
        version,
        aside.name,
        extra=coded(UNUSABLE_STORE),
    )
    return aside


def refuse_newer(connection: sqlite3.Connection, known: int) -> int:
    """The version that a database gives for its tables.

    Args:
        connection: to the database.
        known: the newest version that this program knows.

    Raises:
        NewerFileError: a newer program has written it.
        sqlite3.DatabaseError: no program gives such a version.
    """
    version = pragma(connection, "user_version")
    if version > known:
        raise NewerFileError(version)
    if version < 0:
        raise corruption(f"schema version {version}")
    return version


def delete(path: Path) -> None:
    """Delete a database."""
    for suffix in SIDE_FILES:
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def is_corrupt(error: Exception) -> bool:
    """Whether an error states that the file itself is broken, rather than the disk full or busy.

    All statements of the outbox are constants, so one that a file does not understand, or whose constraints
    it violates, is a sign of damage as well. So does one whose message Python cannot decode.
    """
    if isinstance(error, sqlite3.OperationalError) and f"{error}".startswith("Could not decode"):
        return True  # Python's own words for text that is none
    return isinstance(error, UnicodeDecodeError) or _primary_code(error) in _DAMAGED


def may_pass(error: Exception) -> bool:
    """Whether an error shows that the disk is full, takes no writes or fails, rather than what to correct."""
    return _primary_code(error) in _MAY_PASS or getattr(error, "errno", None) in _MAY_PASS_TOO


def is_full(error: Exception) -> bool:
    """Whether an error states that there is no room left on the disk."""
    return _primary_code(error) == sqlite3.SQLITE_FULL or getattr(error, "errno", None) in _NO_ROOM


def corruption(verdict: str) -> sqlite3.DatabaseError:
    """The error that states that a file is corrupt."""
    error = sqlite3.DatabaseError(verdict)
    error.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
    return error


def _primary_code(error: Exception) -> int | None:
    code = getattr(error, "sqlite_errorcode", None)
    return None if code is None else code & 0xFF
