"""The table of results: a folder a machine with Parquet files, written elsewhere and renamed.

While a run goes on, what comes is in many small files ``part-*.parquet``; when a machine is done they become
one, ``table-*.parquet``. A file's name is the digest of what it holds: what is written twice is there once.

Nothing but Parquet files is ever in ``table/``, so that readers can be given the folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import json
import os
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import quote

from daqsvc.fleet import FleetError
from daqsvc.fleet.archive import printable
from daqsvc.fleet.places import address_of, place_of, protocols, why
from daqsvc.fleet.table import COLUMNS, schema

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from daqsvc.fleet.table import Row

ROWS_PER_FILE = 50_000
TABLE = "table"
_RUNS, _COMPACTING, _WRITING = "runs", "compacting", "writing"
_LOCK = ".lock"
_PUTS_WHOLE = {"memory", "s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "adl", "oss"}
"""Stores in which an object is there as a whole or not at all."""

_LONGEST_FOLDER = 200
"""Of the 255 bytes that file systems allow, with room for what stands before and behind."""

Change: TypeAlias = Callable[["Row"], "Row | None"]
"""What becomes of a row; None if it is superseded."""


class Results:
    """The results of a fleet.

    Args:
        url: the folder, a path or a URL that fsspec knows; it need not exist.

    Raises:
        FleetError: what reaches it is not installed.
    """

    def __init__(self, url: str) -> None:
        self._fs, self.root = place_of(url)
        self.url = url

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Be the only one that writes, where files can be locked: in a folder of this computer.

        A folder in which nothing was written, as its archive or its cluster is not there, is left as it was.

        Raises:
            FleetError: another run is writing, or the folder cannot be written.
        """
        if not self._is_local:
            yield
            return
        folder = Path(self.root)
        try:
            made = [one for one in (folder, *folder.parents) if not one.exists()]
            folder.mkdir(parents=True, exist_ok=True)
            lock = (folder / _LOCK).open("w")
        except OSError as error:
            raise FleetError(
                f"{self.url} cannot be written: {error.strerror}; name another with --results"
            ) from None
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # A run that wrote nothing may have removed it since: it keeps no other run away any more.
                is_held = os.path.samestat(os.fstat(lock.fileno()), (folder / _LOCK).stat())
            except OSError:
                is_held = False
            if not is_held:
                raise FleetError(
                    f"another run is writing into {self.url}; wait for its end, or name another with "
                    "--results"
                )
            try:
                yield
            finally:
                _remove_unused(folder, made)

    def folders(self) -> list[str]:
        """The folders of the machines that there are results of, in order.

        Raises:
            FleetError: the results cannot be listed.
        """
        names = (path.rpartition("/")[2] for path in self._list(f"{self.root}/{TABLE}"))
        return [name for name in names if name.startswith("machine=")]

    def rows(self, folder: str, columns: Sequence[str] = COLUMNS) -> list[Row]:
        """The rows of a machine, by file; of one file those that were added last behind.

        Args:
            folder: of the machine, one of `folders`, or `folder_of` it.
            columns: that are wanted; ``file`` is one of them.

        Raises:
            FleetError: a file is no table of results.
        """
        rows: list[Row] = []
        for path in self._tables(folder):  # finished ones first: what was added later comes after
            rows += self._read(path, columns)
        rows.sort(key=lambda row: row["file"])
        return rows

    def add(self, rows: Iterable[Row], folder: str) -> str:
        """Write rows; when this returns they are there, in the file of this name."""
        content = _parquet(list(rows))
        name = f"part-{_name(content)}.parquet"
        self._put(f"{self.root}/{TABLE}/{folder}/{name}", content)
        return name

    def repair(self, folder: str) -> None:
        """Finish what an earlier run has begun with the files of a machine."""
        journal = f"{self.root}/{_COMPACTING}/{folder}.json"
        if not self._fs.exists(journal):
            return
        begun = json.loads(self._fs.cat_file(journal))
        if all(self._fs.exists(f"{self.root}/{TABLE}/{folder}/{name}") for name in begun["written"]):
            self._remove(f"{self.root}/{TABLE}/{folder}/{name}" for name in begun["superseded"])
        self._remove([journal])

    def compact(self, folder: str, change: Change, newest: Mapping[str, str] | None = None) -> None:
        """Make one table of the files of a machine, in the order of its recordings, each with one row.

        Of rows that depend on the same, the one of a recording that was judged is kept, and else the last. A
        run that tried again what could not be judged may have been killed.

        Args:
            folder: of the machine.
            change: what becomes of each row.
            newest: by recording, the file that `add` put its row into; any other row of it is superseded.
        """
        newest = newest or {}
        before = self._tables(folder)
        rows: dict[tuple[str, str, str, str], Row] = {}
        for path in before:
            name = path.rpartition("/")[2]
            for row in self._read(path, COLUMNS):
                if newest.get(row["file"], name) != name or (kept := change(row)) is None:
                    continue
                key = (kept["file"], kept["digest"] or "", kept["machine_digest"], kept["version"])
                if kept["judged"] or key not in rows or not rows[key]["judged"]:
                    rows[key] = kept
        ordered = [rows[key] for key in sorted(rows)]
        pieces = [ordered[k : k + ROWS_PER_FILE] for k in range(0, len(ordered), ROWS_PER_FILE)]
        tables = {f"table-{_name(content)}.parquet": content for content in map(_parquet, pieces)}
        superseded = [name for path in before if (name := path.rpartition("/")[2]) not in tables]
        if not superseded:
            return
        journal = f"{self.root}/{_COMPACTING}/{folder}.json"
        self._put(journal, json.dumps({"written": list(tables), "superseded": superseded}).encode())
        for name, content in tables.items():
            self._put(f"{self.root}/{TABLE}/{folder}/{name}", content)
        self.repair(folder)

    def note_run(self, name: str, about: Mapping[str, Any]) -> None:
        """Keep what is known of a run, its times among it, outside of the table."""
        self._put(f"{self.root}/{_RUNS}/{name}.json", json.dumps(about, indent=1).encode())

    @cached_property
    def _is_local(self) -> bool:
        return "file" in self._protocols

    @cached_property
    def _protocols(self) -> set[str]:
        return protocols(self._fs)

    def _tables(self, folder: str) -> list[str]:
        """The files of a machine, finished tables before what was added to them."""
        paths = [path for path in self._list(f"{self.root}/{TABLE}/{folder}") if path.endswith(".parquet")]
        return sorted(paths, key=lambda path: not path.rpartition("/")[2].startswith("table-"))

    def _list(self, folder: str) -> list[str]:
        try:
            return sorted(path.rstrip("/") for path in self._fs.ls(folder, detail=False, refresh=True))
        except FileNotFoundError:
            return []
        except OSError as error:
            named = printable(address_of(self.url, self._fs, self.root, folder))
            raise FleetError(f"{named} cannot be listed: {why(error)}") from None

    def _read(self, path: str, columns: Sequence[str]) -> list[Row]:
        import pyarrow as pa  # noqa: PLC0415 - of the extra
        import pyarrow.parquet as pq  # noqa: PLC0415

        try:
            content = io.BytesIO(self._fs.cat_file(path))
            table = pq.ParquetFile(content).read(columns=list(columns)).to_pylist()
        except (OSError, ValueError, KeyError, pa.ArrowException) as error:
            raise FleetError(
                f"{path} is no table of results ({type(error).__name__}); remove it, and what it held is "
                "judged again"
            ) from None
        if table and set(columns) - set(table[0]):
            raise FleetError(f"{path} lacks columns of results; remove it, and what it held is judged again")
        rows: list[Row] = table
        return rows

    def _put(self, path: str, content: bytes) -> None:
        """Write a file so that it is there as a whole or not at all.

        Raises:
            FleetError: it cannot be written.
        """
        try:
            if self._is_local:
                _put_local(Path(path), Path(self.root) / _WRITING, content)
            elif self._protocols & _PUTS_WHOLE:
                self._fs.pipe_file(path, content)
            else:
                folder, _, name = path.rpartition("/")
                self._fs.makedirs(folder, exist_ok=True)
                self._fs.makedirs(f"{self.root}/{_WRITING}", exist_ok=True)
                self._fs.pipe_file(f"{self.root}/{_WRITING}/{name}", content)
                self._fs.mv(f"{self.root}/{_WRITING}/{name}", path)
        except OSError as error:
            raise FleetError(
                f"{path} cannot be written: {error.strerror or error}; what is there stays, and the same "
                "command goes on with it"
            ) from None

    def _remove(self, paths: Iterable[str]) -> None:
        for path in paths:
            with contextlib.suppress(FileNotFoundError):
                self._fs.rm_file(path)


def folder_of(machine: str) -> str:
    """The folder of a machine, named as Hive names partitions.

    A name that would be too long for a file system is cut, and is made unique by its digest.
    """
    text = printable(machine)
    quoted = quote(text, safe=" ")
    if len(quoted) > _LONGEST_FOLDER:
        digest = hashlib.sha256(text.encode()).hexdigest()[:16]
        while len(quoted) + 1 + len(digest) > _LONGEST_FOLDER:
            text = text[:-1]
            quoted = quote(text, safe=" ")
        quoted = f"{quoted}~{digest}"
    return f"machine={quoted}"


def _remove_unused(folder: Path, made: Iterable[Path]) -> None:
    """Remove the lock of a folder that holds nothing else, and of the folders above those that were made."""
    with contextlib.suppress(OSError):  # somebody else writes there, or it is read-only now: it stays
        if [one.name for one in folder.iterdir()] == [_LOCK]:
            (folder / _LOCK).unlink()
            for one in made:
                one.rmdir()


def _put_local(path: Path, beside: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    beside.mkdir(exist_ok=True)
    written = beside / path.name
    with written.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    written.replace(path)
    descriptor = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _parquet(rows: list[Row]) -> bytes:
    import pyarrow as pa  # noqa: PLC0415 - of the extra
    import pyarrow.parquet as pq  # noqa: PLC0415

    content = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows, schema()), content, compression="zstd")
    return content.getvalue()


def _name(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:20]
