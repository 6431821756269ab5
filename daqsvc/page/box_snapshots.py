"""The snapshots that the recorder keeps on this box: which there are, and each in place of a machine.

A snapshot goes by ``MACHINE@NAME``, where NAME is that of its file without the end. No machine has an @.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.confined.limits import ResourceLimits
from daqsvc.page.recorded import NAME, NoPictureError, Playing
from daqsvc.snapshots.contents import SUFFIX
from daqsvc.snapshots.folder import FOLDER
from daqsvc.snapshots.reading import SnapshotError, read_snapshot

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

AT = "@"
MOST_OPEN = 4
"""Snapshots that are held in memory at a time."""
LINGER_S = 5.0
"""How long one is still played after the last viewer has gone."""
MOST_LISTED = 500


class KeptSnapshot(NamedTuple):
    """A snapshot on the box.

    Attributes:
        name: by which it is examined, with its machine.
        time_utc: of its cause, ISO 8601.
        kind: why it was made, e.g. ``"alarm"``.
        size_mb: of its file.
    """

    name: str
    time_utc: str
    kind: str
    size_mb: float


class BoxSnapshots:
    """Snapshots of a store that are shown.

    Args:
        store: its directory.
    """

    def __init__(self, store: Path) -> None:
        self._store = store
        self._open: dict[str, tuple[Playing, asyncio.Task[None]]] = {}
        self._looking: dict[str, int] = {}
        self._opening = asyncio.Lock()

    def kept(self, machine: str) -> list[KeptSnapshot]:
        """Those of a machine, the newest first; blocks.

        Raises:
            OSError: the folder cannot be read.
        """
        snapshots = []
        for path in self._paths(machine):
            named = NAME.fullmatch(path.stem)
            if named is None:
                continue
            with contextlib.suppress(FileNotFoundError):  # it has made room for newer ones just now
                size = path.stat().st_size
                d, t = named["date"], named["time"]
                time_utc = f"{d[:4]}-{d[4:6]}-{d[6:]}T{t[:2]}:{t[2:4]}:{t[4:]}Z"
                snapshots.append(
                    KeptSnapshot(f"{machine}{AT}{path.stem}", time_utc, named["kind"], size / 1e6)
                )
        return sorted(snapshots, key=lambda one: one.name, reverse=True)[:MOST_LISTED]

    def _paths(self, machine: str) -> list[Path]:
        if "/" in machine or machine in {"", ".", ".."}:
            return []
        of_several = self._store / machine / FOLDER
        folder = of_several if of_several.is_dir() else self._store / FOLDER
        return [*folder.glob(f"*{SUFFIX}")] if folder.is_dir() else []

    @contextlib.asynccontextmanager
    async def looking(self, name: str) -> AsyncIterator[Playing]:
        """One that is played meanwhile.

        Args:
            name: with its machine.

        Raises:
            KeyError: there is none of that name.
            NoPictureError: it cannot be shown.
        """
        playing = await self._opened(name)
        self._looking[name] = self._looking.get(name, 0) + 1
        try:
            yield playing
        finally:
            self._looking[name] -= 1
            asyncio.get_running_loop().call_later(LINGER_S, self._perhaps_end, name)

    def _perhaps_end(self, name: str) -> None:
        if not self._looking.get(name):
            self._looking.pop(name, None)
            if name in self._open:
                self._open.pop(name)[1].cancel()

    async def _opened(self, name: str) -> Playing:
        async with self._opening:
            if name not in self._open:
                for other in [one for one in self._open if not self._looking.get(one)]:
                    if len(self._open) >= MOST_OPEN:
                        self._perhaps_end(other)
                if len(self._open) >= MOST_OPEN:
                    raise NoPictureError(
                        f"{MOST_OPEN} snapshots are open already, and more would take too much memory: "
                        "close one"
                    )
                playing = await asyncio.to_thread(self._read, name)
                task = asyncio.create_task(playing.run(), name=f"snapshot {name}")
                self._open[name] = playing, task
            return self._open[name][0]

    def _read(self, name: str) -> Playing:
        machine, _, stem = name.partition(AT)
        path = next((one for one in self._paths(machine) if one.stem == stem), None)
        if path is None or NAME.fullmatch(stem) is None:
            raise KeyError(name)
        try:
            return Playing(read_snapshot(path, ResourceLimits()), name)
        except SnapshotError as error:
            # No path goes out.
            raise NoPictureError(f"{error}".replace(f"{path}", stem)) from error

    async def close(self) -> None:
        """Play none any more."""
        tasks = {task for _, task in self._open.values()}
        self._open.clear()
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
