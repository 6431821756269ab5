"""Reading files that a person named, which may be anything: devices, pipes, or far too large."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from daqsvc.errors.machine_file import BAD_PATH, TOO_LARGE, UNREADABLE_FILE

if TYPE_CHECKING:
    from daqsvc.errors.code import Code

_LONGEST_PATH = 1024
_LONGEST_NAME = 255
"""Bytes of a name in a folder that Linux takes."""


class UnreadableFileError(Exception):
    """A file that cannot be read; the text is to be read after its name.

    Attributes:
        remedy: what to do about it.
        code: of the kind of mistake.
    """

    def __init__(self, message: str, remedy: str, code: Code) -> None:
        super().__init__(message)
        self.remedy = remedy
        self.code = code


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """The content of an ordinary file, or of a link to one.

    Args:
        path: the file.
        most_bytes: a larger one is refused before it is read.

    Raises:
        UnreadableFileError: it is absent, no ordinary file, too large, or may not be read.
    """
    try:
        # Without waiting: to open a pipe that nobody writes to would take for ever.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError as error:
        raise _cannot_be_opened(path, error) from error
    try:
        kind = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(kind):
            raise UnreadableFileError("is a directory", "name a file in it", UNREADABLE_FILE)
        if not stat.S_ISREG(kind):
            raise UnreadableFileError(
                "is no ordinary file, but a device, pipe or socket", "name a file", UNREADABLE_FILE
            )
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            data = file.read(most_bytes + 1)
    except OSError as error:
        raise _cannot_be_opened(path, error) from error
    finally:
        os.close(descriptor)
    if len(data) > most_bytes:
        limit = f"{most_bytes / 1e6:.3g} MB"
        raise UnreadableFileError(f"is larger than {limit}", "check whether it is the right file", TOO_LARGE)
    return data


def _cannot_be_opened(path: Path, error: OSError) -> UnreadableFileError:
    if isinstance(error, FileNotFoundError):
        return UnreadableFileError("there is no such file", "correct the path", UNREADABLE_FILE)
    if isinstance(error, PermissionError):
        return UnreadableFileError(
            "may not be read by this user", f"chmod a+r {path}, or run as a user who may", UNREADABLE_FILE
        )
    return UnreadableFileError(
        f"cannot be read: {error.strerror or error}", "make the file readable", UNREADABLE_FILE
    )


def shortened(text: str, most: int) -> str:
    """A text with its end left out if it is too long."""
    return text if len(text) <= most else f"{text[: most - 4]} ..."


def _usable_path(path: Path) -> Path:
    """A path that the system takes, with ``~`` made the home that is meant."""
    text = str(path)
    if not text.isprintable() or len(text) > _LONGEST_PATH or any(map(_too_long, path.parts)):
        raise PydanticCustomError(
            "path_text",
            "is no path: it is too long, or holds what cannot be printed",
            {"remedy": "correct it", "code": BAD_PATH},
        )
    if "$" in text:
        raise PydanticCustomError(
            "path_variable",
            "holds a variable of the shell, which is not replaced here",
            {
                "remedy": 'write the path in full, or from "~", the home of the user that runs the service',
                "code": BAD_PATH,
            },
        )
    try:
        return path.expanduser()
    except RuntimeError:
        raise PydanticCustomError(
            "path_home",
            "begins at a home that is not known here",
            {"remedy": "write the path in full, e.g. /var/lib/daqsvc", "code": BAD_PATH},
        ) from None


def _too_long(name: str) -> bool:
    return len(os.fsencode(name)) > _LONGEST_NAME


FilePath: TypeAlias = Annotated[Path, Field(strict=False), AfterValidator(_usable_path)]
"""A path as people write it, ``~`` put in; a relative one starts at the directory of the machine file."""
