"""The folder of a machine's snapshots: room on its disk, the names of files, and which of them go."""

from __future__ import annotations

import os
import shutil
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.snapshots.contents import SUFFIX
from daqsvc.snapshots.writing import SnapshotWriter

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping
    from pathlib import Path


FOLDER = "snapshots"
"""Of the machine's part of the store."""
NS_PER_DAY = 86_400 * NS_PER_S
BYTES_PER_MB = 1_000_000


class SnapshotFolder:
    """Every method blocks.

    Args:
        store: directory of the machine's part of the store.
        max_mb: size of all snapshots.
        keep_days: how old they may become.
        reserve_mb: free space on the disk that is left to the alarms.

    Attributes:
        directory: where the snapshots are.
        deleted: how many have gone so far.
    """

    def __init__(self, store: Path, max_mb: int, keep_days: float, reserve_mb: int) -> None:
        self.directory = store / FOLDER
        self.deleted = 0
        self.most_bytes = max_mb * BYTES_PER_MB
        self._keep_ns = round(keep_days * NS_PER_DAY)
        self._reserve_mb = reserve_mb

    def new(
        self, kind: str, cause_ns: int, about: Mapping[str, Any], files: Mapping[str, bytes]
    ) -> SnapshotWriter:
        """Make a file.

        Args:
            kind: why.
            cause_ns: when there was cause to, on the monotonic clock.
            about: its first message.
            files: by name, what goes with it.

        Raises:
            OSError: it cannot be made.
        """
        self.directory.mkdir(mode=0o750, exist_ok=True)
        self.see_space()
        wall_ns: int = about["wall_ns_at_0"]
        cause = datetime.fromtimestamp((cause_ns + wall_ns) / NS_PER_S, UTC)
        while True:
            name = f"{cause:%Y%m%dT%H%M%S}.{cause.microsecond:06d}Z-{kind}{SUFFIX}"
            try:
                return SnapshotWriter(self.directory / name, about, files, wall_ns)
            except FileExistsError:
                # Two of one moment, or of a clock that was set back.
                cause = cause.replace(microsecond=(cause.microsecond + 1) % 1_000_000)

    def finish(self, writer: SnapshotWriter, kind: str) -> Path:
        """Close a file, and give it the name of its cause.

        Raises:
            OSError: the disk does not take it.
        """
        writer.finish()
        return self._named(writer, kind)

    def finish_what_was_taken(self, writer: SnapshotWriter, kind: str) -> Path:
        """The same after an error, behind the last that the disk has taken whole.

        Raises:
            OSError: the disk does not take the end either.
        """
        writer.finish_what_was_taken()
        return self._named(writer, kind)

    def _named(self, writer: SnapshotWriter, kind: str) -> Path:
        stem = writer.path.name.rpartition("-")[0]
        writer.path = writer.path.rename(writer.path.with_name(f"{stem}-{kind}{SUFFIX}"))
        return writer.path

    def see_space(self) -> None:
        """Leave the alarms room on the disk.

        Raises:
            OSError: there is too little.
        """
        free = shutil.disk_usage(self.directory).free
        if free < self._reserve_mb * BYTES_PER_MB:
            raise OSError(
                f"{self.directory} has {free / 1e6:.0f} MB free, of which reserve_mb = "
                f"{self._reserve_mb} in [recorder] belong to the alarms; make room on the disk"
            )

    def make_room(self, now_wall_ns: int, spared: Collection[str]) -> None:
        """Delete what is too old or too much, the oldest first, and those of alarms last.

        Args:
            now_wall_ns: wall time.
            spared: names of files that stay: they are being written, or were just now. Their sizes count.

        Raises:
            OSError: the folder cannot be read.
        """
        kept: list[tuple[bool, str, int]] = []
        total = 0
        with os.scandir(self.directory) as entries:
            for one in entries:
                if not one.name.endswith(SUFFIX) or not one.is_file(follow_symlinks=False):
                    continue
                status = one.stat()
                if one.name in spared:
                    total += status.st_size
                elif status.st_mtime_ns < now_wall_ns - self._keep_ns:
                    self._delete(one.name)
                else:
                    total += status.st_size
                    kept.append((one.name.endswith(f"-alarm{SUFFIX}"), one.name, status.st_size))
        for _, name, size in sorted(kept):
            if total <= self.most_bytes:
                break
            self._delete(name)
            total -= size

    def _delete(self, name: str) -> None:
        (self.directory / name).unlink(missing_ok=True)
        self.deleted += 1
