"""The layout of an archive: machines, the files that describe each, and its recordings.

``ARCHIVE/MACHINE/machine.toml``, beside it what that names, and the recordings in ``recordings/``.
"""

from __future__ import annotations

import hashlib
import os
import stat
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from daqsvc.fleet import FleetError
from daqsvc.fleet.places import address_of, is_within, place_of, protocols, why
from daqsvc.recording.formats import named_as_can_log, named_as_table

if TYPE_CHECKING:
    from collections.abc import Iterator

MACHINE_FILE = "machine.toml"
RECORDINGS = "recordings"
MOST_DESCRIPTION_BYTES = 64_000_000
"""Of the files that describe one machine: more are recordings in the wrong place."""
_STAMPS = ("mtime", "ETag", "etag", "md5", "content_md5", "LastModified", "last_modified", "created")
"""What stores call that by which a file that was written again is known, the first that there is."""


@dataclass(frozen=True, slots=True)
class ArchivedFile:
    """A file of the archive.

    Attributes:
        path: in the archive's file system.
        name: below the folder that it was looked for in.
        size_bytes: by the listing.
        stamp: by which the listing shows that it was written again.
    """

    path: str
    name: str
    size_bytes: int
    stamp: str


@dataclass(frozen=True, slots=True)
class ArchivedRecording:
    """A recording: one file, or the CAN logs of one folder, which are judged together.

    Attributes:
        file: its path below ``recordings``, in printable Unicode.
        path: in the archive's file system, of the file or the folder.
        parts: its files.
        wrong: why it cannot be read, if the listing shows that.
    """

    file: str
    path: str
    parts: tuple[ArchivedFile, ...]
    wrong: str = ""

    @property
    def size_bytes(self) -> int:
        """Of all its files."""
        return sum(part.size_bytes for part in self.parts)

    @property
    def stamp(self) -> str:
        """Of all its files."""
        if len(self.parts) == 1:
            return self.parts[0].stamp
        return hashlib.sha256(
            repr([(p.name, p.size_bytes, p.stamp) for p in self.parts]).encode()
        ).hexdigest()


@dataclass(frozen=True, slots=True)
class ArchivedMachine:
    """A machine of the archive.

    Attributes:
        name: its folder.
        description: its machine file and what lies beside it, by name.
        recordings: by file.
        others: files among the recordings that are of no kind that is judged.
    """

    name: str
    description: tuple[ArchivedFile, ...]
    recordings: tuple[ArchivedRecording, ...]
    others: int


class Archive:
    """A folder, or the prefix of an object store.

    Args:
        url: a path, or a URL that fsspec knows.

    Raises:
        FleetError: there is no such place, or what reaches it is not installed.
    """

    def __init__(self, url: str) -> None:
        self._fs, self.root = place_of(url)
        self.url = url

    @cached_property
    def is_local(self) -> bool:
        """Whether its files can be read where they lie."""
        return "file" in protocols(self._fs)

    @cached_property
    def address(self) -> str:
        """What reaches it from any process: of a folder the whole path, wherever that process works."""
        return self.root if self.is_local else self.url

    def see_apart(self, results: str) -> None:
        """See that results are not written into the archive: they would be files of a machine there.

        Raises:
            FleetError: they would.
        """
        if is_within(place_of(results), (self._fs, self.root)):
            raise FleetError(
                f"{results} is in the archive {self.url}, of which it would become a part; name a folder "
                "beside it with --results"
            )

    def machines(self) -> list[str]:
        """The folders of the archive that may be machines.

        Raises:
            FleetError: it cannot be listed, or there is none.
        """
        names = sorted(name for name, is_folder, _ in self._entries(self.root) if is_folder)
        if not names:
            raise FleetError(
                f"{self.url} holds no machine; an archive has a folder for each, with {MACHINE_FILE} and "
                f"{RECORDINGS}/ in it"
            )
        return names

    def machine(self, name: str) -> ArchivedMachine | None:
        """What the archive holds of a machine; None if the folder is no machine's.

        Raises:
            FleetError: it cannot be listed.
        """
        folder = f"{self.root}/{name}"
        description: list[ArchivedFile] = []
        recordings: list[ArchivedRecording] = []
        others = 0
        is_machine = False
        for path, below, about in self._walk(folder, ""):
            top, _, rest = below.partition("/")
            if top != RECORDINGS or not rest:
                is_machine |= below == MACHINE_FILE
                if about is not None:
                    description.append(_file(path, below, about))
            elif not (named_as_table(Path(rest)) or named_as_can_log(Path(rest))):
                others += 1
            elif about is None:
                wrong = f"{rest} is no regular file; archive what it leads to"
                recordings.append(ArchivedRecording(printable(rest), path, (), wrong))
            else:
                file = _file(path, rest, about)
                recordings.append(ArchivedRecording(printable(rest), path, (file,)))
        if not (is_machine or recordings):
            return None
        return ArchivedMachine(name, tuple(description), tuple(_with_folders(recordings)), others)

    def read(self, path: str, most_bytes: int) -> bytes:
        """A small file.

        Raises:
            OSError: it cannot be read, or is larger.
        """
        with self.open(path) as file:
            content: bytes = file.read(most_bytes + 1)
        if len(content) > most_bytes:
            raise OSError(f"it is larger than {most_bytes:,} bytes")
        return content

    def open(self, path: str) -> Any:
        """A file, for reading; one that turned into a pipe since it was listed is refused.

        Raises:
            OSError: it cannot be read.
        """
        if not self.is_local:
            return self._fs.open(path, "rb")
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise OSError("it is no regular file")
        return os.fdopen(descriptor, "rb", buffering=0)

    def _walk(self, folder: str, below: str) -> Iterator[tuple[str, str, dict[str, Any] | None]]:
        """The files under a folder: path, path below the first folder, what is known of it.

        None is known of what is no regular file. Links to folders are not followed: they may be circles.
        """
        for name, is_folder, about in sorted(self._entries(folder), key=lambda entry: entry[0]):
            path, inside = f"{folder}/{name}", f"{below}{name}"
            if is_folder and not (below and self.is_local and Path(path).is_symlink()):
                yield from self._walk(path, f"{inside}/")
            elif not is_folder:
                yield path, inside, about

    def _entries(self, folder: str) -> list[tuple[str, bool, dict[str, Any] | None]]:
        """Name, whether it is a folder, and what is known of it; hidden ones are none.

        Raises:
            FleetError: the folder cannot be listed.
        """
        try:
            listed = _scan(folder) if self.is_local else self._list(folder)
        except OSError as error:
            named = printable(address_of(self.url, self._fs, self.root, folder))
            raise FleetError(f"{named} cannot be listed: {why(error)}; correct the path") from None
        return [entry for entry in listed if not entry[0].startswith(".")]

    def _list(self, folder: str) -> list[tuple[str, bool, dict[str, Any] | None]]:
        prefix = folder.rstrip("/")
        return [
            (PurePosixPath(about["name"]).name, about["type"] == "directory", about)
            for about in self._fs.ls(folder, detail=True)
            if about["name"].rstrip("/") != prefix  # some stores list a folder as its own entry
        ]


def _scan(folder: str) -> list[tuple[str, bool, dict[str, Any] | None]]:
    entries: list[tuple[str, bool, dict[str, Any] | None]] = []
    with os.scandir(folder) as listed:
        for entry in listed:
            try:
                status = entry.stat()
            except OSError:  # a link to nothing
                entries.append((entry.name, False, None))
                continue
            about = {"size": status.st_size, "mtime": status.st_mtime_ns}
            regular = stat.S_ISREG(status.st_mode)
            entries.append((entry.name, stat.S_ISDIR(status.st_mode), about if regular else None))
    return entries


def _file(path: str, name: str, about: dict[str, Any]) -> ArchivedFile:
    stamp = next((f"{about[key]}" for key in _STAMPS if about.get(key) is not None), "")
    return ArchivedFile(path, name, int(about.get("size") or 0), stamp)


def _with_folders(recordings: list[ArchivedRecording]) -> Iterator[ArchivedRecording]:
    """The recordings, CAN logs of one folder below ``recordings`` as one, as ``daqsvc analyze`` has it."""
    folders: dict[str, list[ArchivedRecording]] = {}
    for recording in recordings:
        folder = str(PurePosixPath(recording.file).parent)
        if folder == "." or not named_as_can_log(Path(recording.file)):
            yield recording
        else:
            folders.setdefault(folder, []).append(recording)
    for folder, logs in folders.items():
        parts = tuple(part for log in logs for part in log.parts)
        wrong = next((log.wrong for log in logs if log.wrong), "")
        yield ArchivedRecording(folder, str(PurePosixPath(logs[0].path).parent), parts, wrong)


def printable(name: str) -> str:
    """A name that may be no Unicode, as text that a table can hold."""
    try:
        return os.fsencode(name).decode("utf-8", "backslashreplace")
    except UnicodeEncodeError:  # half a surrogate pair, which is no byte of a file system's name either
        return name.encode("utf-8", "backslashreplace").decode()
