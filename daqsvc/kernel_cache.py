"""Where compiled kernels are kept: chosen here, before any is imported, so that every account has a place.

Numba by itself looks beside the sources and below the home directory, and raises where it can write neither.
What is kept is code that later starts run, so a place counts only if nobody else may write there.
"""

from __future__ import annotations

import contextlib
import logging
import os
import stat
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daqsvc.errors.code import coded
from daqsvc.errors.service import KERNELS
from daqsvc.notice import notice

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

log = logging.getLogger(__name__)

VARIABLE = "NUMBA_CACHE_DIR"
REMEDY = f"set {VARIABLE} to a directory that the service can write"


SERVICE = Path("/var/cache/daqsvc")
"""The cache directory of the installed service (`config/systemd`): its account finds its kernels there."""


class _UnusableError(Exception):
    """A place cannot be used; states why."""


def prepare(*, say: bool = True, first: Callable[[], bool] = lambda: True) -> None:
    """Choose the directory; call before any kernel is imported. The first one that is compiled is logged.

    It is ``$NUMBA_CACHE_DIR``; else systemd's ``$CACHE_DIRECTORY``; else that of the installed service, if
    this is its account. Else the user's cache directory (XDG); else one in the folder for temporary files
    that only this user may enter. If none of these can be written, kernels are compiled at every start. Both
    of the latter are logged.

    Args:
        say: False in a process whose parent has logged where they are kept.
        first: asked once, when a kernel is compiled: whether no other process has logged it.
    """
    _Compiling.kept, _Compiling.first = _choose(say=say), first


class _Compiling:
    """What is to be logged when a kernel is compiled, once."""

    kept = True
    failed = False
    first: Callable[[], bool] | None = None


def say_compiling() -> None:
    """A kernel is being compiled, as none was kept: the start takes longer than people are used to."""
    first, _Compiling.first = _Compiling.first, None
    # A line beside the results of a verb that has no log is for a person who waits at a terminal.
    if first is not None and (logging.root.handlers or sys.stderr.isatty()) and first():
        when = "first start only; " if _Compiling.kept else ""
        text = f"compiling kernels for this processor ({when}takes up to a minute)"
        if logging.root.handlers:
            notice(log, "%s", text)
        else:
            print(text, file=sys.stderr)  # noqa: T201 - for a person


def say_not_kept(error: OSError) -> None:
    """A kernel could not be written after all."""
    if not _Compiling.failed:
        _Compiling.failed = True
        log.warning(
            "compiled kernels cannot be kept, and the next start compiles them again: %s",
            error,
            extra=coded(KERNELS),
        )


def _choose(*, say: bool) -> bool:
    """Choose the directory; whether what is compiled can be kept."""
    reasons: list[str] = []
    for place in _places(reasons):
        try:
            _make(place)
            if os.environ.get(VARIABLE) != str(place):
                _check_safe(place)
        except _UnusableError as error:
            reasons.append(f"{error}")
            continue
        os.environ[VARIABLE] = str(place)
        return True
    try:
        temporary: Path | None = _temporary()
    except _UnusableError as error:
        temporary = None
        reasons.append(f"{error}")
        _compile_at_every_start()
        consequence = "compiled kernels cannot be kept, and every start compiles them"
    else:
        os.environ[VARIABLE] = str(temporary)
        consequence = f"compiled kernels are kept in {temporary}, where they may be deleted"
    if say:
        log.warning("%s: %s; %s", consequence, ", and ".join(reasons), REMEDY, extra=coded(KERNELS))
    return temporary is not None


def _places(reasons: list[str]) -> Iterator[Path]:
    """What may be asked for, in order of preference; notes what is not even a place."""
    if asked := os.environ.get(VARIABLE):
        yield Path(asked)
    if directory := os.environ.get("CACHE_DIRECTORY", "").split(":")[0]:
        yield Path(directory) / "kernels"
        return
    with contextlib.suppress(OSError):
        if SERVICE.stat().st_uid == os.geteuid():
            yield SERVICE / "kernels"
    try:
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "daqsvc" / "kernels"
    except RuntimeError:
        reasons.append(f"user {os.geteuid()} has no home directory")


def _temporary() -> Path:
    """A directory for this user alone in the folder for temporary files.

    Raises:
        _UnusableError: there is none that can be written, or somebody else has made one of that name.
    """
    try:
        place = Path(tempfile.gettempdir()) / f"daqsvc-kernels-{os.geteuid()}"
    except FileNotFoundError:
        raise _UnusableError("no folder for temporary files can be written") from None
    _make(place, 0o700)
    _check_safe(place)
    return place


def _make(place: Path, mode: int = 0o755) -> None:
    """See that a directory is there and takes files.

    Raises:
        _UnusableError: it is not, or does not.
    """
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        place.mkdir(mode, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=place) as probe:
            probe.write(bytes(4096))
    except OSError as error:
        raise _UnusableError(f"{place} cannot be written ({error.strerror or error})") from None


def _check_safe(place: Path) -> None:
    """See that nobody else may put something in a directory, or another one in its place.

    Raises:
        _UnusableError: somebody may.
    """
    status = place.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid() or status.st_mode & 0o022:
        raise _UnusableError(f"{place} can be written by others")
    for above in place.resolve().parents:
        status = above.stat()
        shared = status.st_mode & stat.S_IWOTH and not status.st_mode & stat.S_ISVTX
        if status.st_uid not in {0, os.geteuid()} or shared:
            raise _UnusableError(f"{place} can be replaced by others, who can write {above}")


def _compile_at_every_start() -> None:
    """Have Numba keep nothing: it has no setting for that, and raises where it finds no place."""
    from numba.core.dispatcher import Dispatcher  # noqa: PLC0415 - heavy, and seldom needed

    dispatcher: Any = Dispatcher
    dispatcher.enable_caching = lambda _self: None
