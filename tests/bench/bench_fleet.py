"""What two workers of Dask are worth over one, and what a million recordings would take.

Run by ``make bench``. An archive of orbits is judged by local clusters of one and of two workers, in turns,
each after it has judged some others: what a cluster and compiled kernels take to begin is once a run. Beside
it the costs that grow with the archive and not with the workers are measured: listing, going on with what is
judged, and the table. The best of some rounds is told: what else the host does only adds to it.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
import tracemalloc
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from support.fleet_archives import add_machine, machine_text
from support.orbit_files import Orbit
from targets import Targets

from daqsvc.confined.limits import ResourceLimits
from daqsvc.diagnosis.recorded import RecordingOptions
from daqsvc.fleet.archive import Archive
from daqsvc.fleet.campaign import Campaign, Wanted
from daqsvc.fleet.cluster import connected
from daqsvc.fleet.results import Results, folder_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from daqsvc.fleet.campaign import CampaignSummary

RECORDINGS = 32
REVOLUTIONS = 120
ROUNDS = 1
LISTED = 6400
MACHINES = 10
LEAST_SPEED_UP = 1.7
"""Of two workers on two cores: the client, the scheduler and the kernel work on the same two."""
MILLION = 1_000_000


def wanted() -> Wanted:
    """As the command line does it."""
    return Wanted(RecordingOptions(), ResourceLimits())


def archive_of(folder: Path, recordings: int) -> Path:
    """Four machines, with copies of eight orbits: what a file holds is not what takes time."""
    orbits = [Orbit(REVOLUTIONS, seed=seed).save(folder / f"{seed}.npz") for seed in range(8)]
    for number in range(4):
        place = add_machine(folder / "archive", f"pump-{number}")
        for k in range(recordings // 4):
            shutil.copy(orbits[k % len(orbits)], place / f"{k:04}.npz")
    return folder / "archive"


def judged(archive: Path, results: Path, client: Any) -> tuple[float, CampaignSummary]:
    """Judge an archive; s, and what came of it."""
    begun_s = time.monotonic()
    summary = Campaign(Archive(str(archive)), Results(str(results)), wanted()).run(lambda: client)
    return time.monotonic() - begun_s, summary


def speed_up(folder: Path, targets: Targets) -> float:
    """Compare one worker with two; returns s a recording of one worker."""
    archive = archive_of(folder, RECORDINGS)
    (folder / "few").mkdir()
    few = archive_of(folder / "few", 16)
    best = {1: float("inf"), 2: float("inf")}
    with ExitStack() as stack:
        clients = {workers: stack.enter_context(connected(f"local:{workers}", 2)) for workers in best}
        for workers, client in clients.items():
            client.wait_for_workers(workers)
            judged(few, folder / f"few-{workers}", client)
        for turn in range(ROUNDS):
            for workers, client in clients.items():
                took_s, summary = judged(archive, folder / f"results-{workers}-{turn}", client)
                assert summary.judged == RECORDINGS
                best[workers] = min(best[workers], took_s)
    size = sum(path.stat().st_size for path in archive.rglob("*.npz")) / RECORDINGS
    print(
        f"recordings    {size / 1e6:.2f} MB, {1e3 * best[1] / RECORDINGS:.1f} ms each by one worker, "
        f"{1e3 * best[2] / RECORDINGS:.1f} ms by two"
    )
    ratio = best[1] / best[2]
    if (os.cpu_count() or 1) >= 2:
        targets.ask(
            f"two workers at least {LEAST_SPEED_UP} times as fast", f"{ratio:.2f}", ratio / LEAST_SPEED_UP
        )
    return best[1] / RECORDINGS


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Processor time of this process, and the most memory that Python took meanwhile: s and bytes."""
    begun_s = time.process_time()
    work()
    took_s = time.process_time() - begun_s
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return took_s, peak


def growing(folder: Path, row: dict[str, Any]) -> float:
    """What grows with the archive: listing it, and going on with it; returns s a recording."""
    archive, results = folder / "large", Results(str(folder / "large-results"))
    names = [f"pump-{number:03}" for number in range(MACHINES)]
    per = LISTED // MACHINES
    for name in names:
        place = add_machine(archive, name)
        for k in range(per):
            (place / f"{k:06}.npz").touch()
    listing = Archive(str(archive))
    list_s, list_bytes = timed(lambda: [listing.machine(name) for name in listing.machines()])
    begun_s = time.process_time()
    for name in names:
        for begin in range(0, per, 32):
            rows = [
                {**row, "machine": name, "file": f"{k:06}.npz"} for k in range(begin, min(begin + 32, per))
            ]
            results.add(rows, folder_of(name))
    part_s = time.process_time() - begun_s
    begun_s = time.process_time()
    for name in names:
        results.compact(folder_of(name), lambda one: one)
    compact_s = time.process_time() - begun_s
    files = list((folder / "large-results" / "table").rglob("*.parquet"))
    table_bytes = sum(path.stat().st_size for path in files)
    known_s, known_bytes = timed(
        lambda: [len(results.rows(folder_of(name), ("file", "digest", "stamp"))) for name in names]
    )
    for what, took_s, more in (
        ("listing", list_s, f"{list_bytes / LISTED:,.0f} bytes of memory each"),
        ("known rows", known_s, f"{known_bytes / LISTED:,.0f} bytes of memory each, a machine at a time"),
        ("parts", part_s, f"{LISTED // 32:,} files meanwhile"),
        ("compacting", compact_s, f"{len(files)} files, {table_bytes / LISTED:,.0f} bytes a row"),
    ):
        print(f"{what:<13} {1e6 * took_s / LISTED:,.0f} us a recording, {more}")
    return (list_s + known_s + part_s + compact_s) / LISTED


def main() -> int:
    """Measure and print."""
    targets = Targets()
    assert machine_text()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        each_s = speed_up(folder, targets)
        (one, *_) = Results(str(folder / "results-1-0")).rows(folder_of("pump-0"))
        client_s = growing(folder, one)
    hours, client_minutes = each_s * MILLION / 3600, client_s * MILLION / 60
    print(
        f"a million     {hours:.1f} hours of one worker, and {client_minutes:.0f} minutes of the client: "
        f"that keeps up with {each_s / client_s:.0f} workers"
    )
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
