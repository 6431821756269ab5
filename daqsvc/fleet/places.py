"""Where an archive or results are: a folder, or a prefix of an object store."""

from __future__ import annotations

import os
from pathlib import PurePath
from typing import Any

from daqsvc.fleet import FleetError


def place_of(url: str) -> tuple[Any, str]:
    """The file system of a URL, and the path in it, without a slash at its end.

    Args:
        url: a path or a URL that fsspec knows; it need not exist.

    Raises:
        FleetError: what reaches it is not installed.
    """
    import fsspec.core  # noqa: PLC0415 - of the extra

    try:
        files, root = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise FleetError(f"{url} cannot be reached: {error}") from None
    return files, root.rstrip("/") or "/"


def protocols(files: Any) -> set[str]:
    """How a file system is called in URLs."""
    return {files.protocol} if isinstance(files.protocol, str) else set(files.protocol)


def address_of(url: str, files: Any, root: str, path: str) -> str:
    """A path in a file system, as a person has named the place that it is in.

    Args:
        url: the place, as it was given.
        files: its file system.
        root: the path of the place there.
        path: at or below it.
    """
    return path if "file" in protocols(files) else f"{url.rstrip('/')}{path.removeprefix(root)}"


def why(error: OSError) -> str:
    """What has gone wrong, in words: stores report no more than the path of what they do not have."""
    if error.strerror:
        return error.strerror
    return "No such file or directory" if isinstance(error, FileNotFoundError) else f"{error}"


def is_within(place: tuple[Any, str], whole: tuple[Any, str]) -> bool:
    """Whether a place is the same as another, or in it.

    Args:
        place: file system and path of it.
        whole: the same of the other.
    """
    (files, path), (other_files, other) = place, whole
    if not protocols(files) & protocols(other_files):
        return False
    if "file" in protocols(files):
        path, other = os.path.realpath(path), os.path.realpath(other)
    return PurePath(path).is_relative_to(other)
