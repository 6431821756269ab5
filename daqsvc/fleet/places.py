"""Where an archive or results are: a folder, or a prefix of an object store."""

from __future__ import annotations

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
