"""``daqsvc analyze ARCHIVE --cluster``: workers, scheduler and client that come and go change nothing."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.fleet_archives import (
    add_hostile,
    add_machine,
    add_recordings,
    contents,
    ended,
    kill,
    parts,
    rows,
    start_analyze,
    start_program,
    workers_of,
)
from support.made_once import made_once
from support.orbit_files import Orbit
from support.paths import ROOT
from support.waiting import eventually_blocking

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
COUNT = 22
"""Recordings of the long tests; those of `add_hostile` come in addition."""


def made_archive(folder: Path) -> tuple[Path, int]:
    """Two machines, one of which gets unbalanced, and what cannot be judged; and how many recordings."""
    archive = folder / "archive"
    add_recordings(add_machine(archive, "fan 1"), COUNT // 2, changed_from=8)
    hostile = add_machine(archive, "007")
    add_recordings(hostile, COUNT // 2, seed=100)
    return archive, COUNT + len(add_hostile(hostile)) + 1


@pytest.fixture(scope="session")
def judged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int, dict[str, bytes]]:
    """An archive, how many recordings it has, and its results by one process."""

    def make(folder: Path) -> tuple[Path, int, dict[str, bytes]]:
        archive, count = made_archive(folder)
        code, summary, err = ended(start_analyze(archive, "--cluster", "local:1"))
        assert (code, summary["recordings"], summary["judged_now"]) == (3, count, count), err
        return archive, count, contents(folder / "archive-results")

    return made_once(tmp_path_factory, "fleet", make)


@pytest.mark.long
def test_an_archive_is_judged_once(tmp_path: Path) -> None:
    """The short form of all that follows: a run, what it says, and one that finds nothing to do."""
    archive = tmp_path / "archive"
    recordings = add_machine(archive, "pump")
    add_recordings(recordings, 2, changed_from=1)
    (recordings / "cut.npz").write_bytes(b"PK")
    (recordings / "notes.txt").write_text("of another kind")
    (archive / "other").mkdir()
    code, summary, err = ended(start_analyze(archive, "--cluster", "local:1"))
    results = str(archive) + "-results"
    assert code == 3
    assert re.fullmatch(r"3 recordings to judge, 1 worker; dashboard: http://127\.0\.0\.1:\d+/status\n", err)
    assert summary == {
        "machines": 1,
        "recordings": 3,
        "judged_before": 0,
        "judged_now": 3,
        "not_judged": 1,
        "verdicts": {"normal": 1, "unbalance": 1},
        "files_of_other_kinds": 1,
        "folders_left_out": ["other"],
        "machines_failed": {},
        "results": results,
    }
    before = contents(tmp_path / "archive-results")
    assert len(before) == 1
    code, summary, err = ended(start_analyze(archive, "--cluster", "local:1"))
    assert (code, err) == (3, "")
    assert (summary["judged_before"], summary["judged_now"]) == (3, 0)
    assert contents(tmp_path / "archive-results") == before


@pytest.mark.long
@pytest.mark.parametrize("workers", [2, 3])
def test_the_table_is_equal_to_the_byte_by_however_many_workers(
    judged: tuple[Path, int, dict[str, bytes]], workers: int, tmp_path: Path
) -> None:
    archive, count, expected = judged
    arguments = (archive, "--cluster", f"local:{workers}", "--results", tmp_path / "results")
    code, summary, _ = ended(start_analyze(*arguments))
    assert (code, summary["judged_now"]) == (3, count)
    assert contents(tmp_path / "results") == expected


@pytest.mark.long
def test_a_worker_that_is_killed_changes_nothing(
    judged: tuple[Path, int, dict[str, bytes]], tmp_path: Path
) -> None:
    archive, count, expected = judged
    run = start_analyze(archive, "--cluster", "local:2", "--results", tmp_path / "results")
    eventually_blocking(lambda: len(parts(tmp_path / "results")) >= 3, "some are judged")
    kill(workers_of(run)[0])
    code, summary, err = ended(run)
    assert (code, summary["judged_now"]) == (3, count), err
    assert err.count("\n") == 1, "nothing but what there is to do"
    assert contents(tmp_path / "results") == expected


@pytest.mark.long
def test_a_run_that_is_killed_goes_on_where_it_was(
    judged: tuple[Path, int, dict[str, bytes]], tmp_path: Path
) -> None:
    archive, count, expected = judged
    results = tmp_path / "results"
    arguments = (archive, "--cluster", "local:2", "--results", results)
    run = start_analyze(*arguments)
    eventually_blocking(lambda: len(parts(results)) >= 3, "some are judged")
    workers = workers_of(run)
    kill(run.pid)
    run.communicate()
    eventually_blocking(lambda: not any(map(is_running, workers)), "the workers end with it")
    written = [row for row in rows(results) if row["digest"] is not None]
    assert 3 <= len(written) < count
    code, summary, err = ended(start_analyze(*arguments))
    assert (code, summary["judged_before"], summary["judged_now"]) == (
        3,
        len(written),
        count - len(written),
    ), err
    assert contents(results) == expected


@pytest.mark.long
def test_a_scheduler_that_is_lost_loses_nothing(
    judged: tuple[Path, int, dict[str, bytes]], tmp_path: Path
) -> None:
    archive, count, expected = judged
    results = tmp_path / "results"
    with dask(tmp_path, "scheduler") as (scheduler, address):
        run = start_analyze(archive, "--cluster", address, "--results", results, connect_s=2.0)
        code, _, err = ended(run)
        assert code == 1
        assert f"the scheduler at {address} has no worker" in err
        with dask(tmp_path, "worker", address, "--nthreads", "1", "--no-dashboard"):
            run = start_analyze(archive, "--cluster", address, "--results", results)
            eventually_blocking(lambda: len(parts(results)) >= 3, "some are judged")
            kill(scheduler.pid)
            code, _, err = ended(run)
    assert code == 1
    assert "scheduler of the cluster was lost; what was judged is written" in err
    assert err.count("\n") == 2, "what there is to do, and that"
    written = [row for row in rows(results) if row["digest"] is not None]
    code, summary, err = ended(start_analyze(archive, "--cluster", "local:1", "--results", results))
    assert (code, summary["judged_now"]) == (3, count - len(written)), err
    assert contents(results) == expected


@pytest.mark.long
def test_a_recording_that_kills_whoever_judges_it_is_a_row(tmp_path: Path) -> None:
    recordings = add_machine(tmp_path / "archive", "pump")
    add_recordings(recordings, 3)
    Orbit(30).save(recordings / "deadly.npz")
    code, summary, err = ended(start_program("deadly", tmp_path / "archive", tmp_path / "results"))
    assert code == 0, err
    assert (summary["verdicts"], summary["not_judged"]) == ({"normal": 3}, 1)
    (deadly,) = (row for row in rows(tmp_path / "results") if not row["judged"])
    assert deadly["file"] == "deadly.npz"
    assert "each process that judged it was killed" in deadly["reason"]


@pytest.mark.long
def test_what_changes_is_judged_anew_and_replaces_its_row(tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    recordings = add_machine(archive, "pump")
    add_recordings(recordings, 3)

    def judged_now(*options: str) -> int:
        code, summary, err = ended(start_analyze(archive, "--cluster", "local:1", *options))
        assert code in {0, 3}, err
        return int(summary["judged_now"])

    results = tmp_path / "archive-results"
    assert judged_now() == 3
    os.utime(recordings / "2026-03-01.npz", ns=(1, 1))
    add_recordings(recordings, 1, changed_from=0, seed=1)
    shutil.copy(recordings / "2026-03-02.npz", recordings / "2026-03-04.npz")
    assert judged_now() == 2, "the first and the new one"
    assert [row["verdict"] for row in rows(results)] == ["unbalance", "normal", "normal", "normal"]
    os.utime(recordings / "2026-03-02.npz", ns=(1, 1))
    assert judged_now() == 0, "it holds what it held"
    assert rows(results)[1]["stamp"] == "1"
    status = (recordings / "2026-03-03.npz").stat()
    content = (recordings / "2026-03-03.npz").read_bytes()
    (recordings / "2026-03-03.npz").write_bytes(content[:-1] + b"x")
    os.utime(recordings / "2026-03-03.npz", ns=(status.st_atime_ns, status.st_mtime_ns))
    assert judged_now() == 0, "by size and time it is as it was"
    assert judged_now("--verify") == 1
    assert judged_now("--retry") == sum(not row["judged"] for row in rows(results))
    machine = archive / "pump" / "machine.toml"
    machine.write_text(machine.read_text() + "\n# another calibration\n")
    assert judged_now() == 4
    assert len(rows(results)) == 4


@pytest.mark.long
def test_other_programs_read_the_table(judged: tuple[Path, int, dict[str, bytes]]) -> None:
    import duckdb
    import polars as pl

    archive, count, _ = judged
    table = archive.parent / "archive-results" / "table"
    expected = sorted((row["machine"], row["file"], row["verdict"]) for row in rows(table.parent))
    assert len(expected) == count
    found = duckdb.read_parquet(f"{table}/**/*.parquet").project("machine, file, verdict")
    frame = pl.scan_parquet(table).select("machine", "file", "verdict").collect()
    key = [tuple(map(str, row)) for row in expected]
    assert sorted(tuple(map(str, row)) for row in found.fetchall()) == sorted(key)
    assert sorted(tuple(map(str, row)) for row in frame.rows()) == sorted(key)


@pytest.mark.long
def test_what_is_tried_again_with_more_memory_is_judged(tmp_path: Path) -> None:
    recordings = add_machine(tmp_path / "archive", "pump")
    add_recordings(recordings, 2)
    with np.load(recordings / "2026-03-02.npz") as short:
        np.savez(recordings / "2026-03-02.npz", **short, ballast=np.zeros(4_000_000))
    results = tmp_path / "archive-results"

    def run(*options: str) -> tuple[int, int]:
        code, summary, err = ended(start_analyze(tmp_path / "archive", "--cluster", "local:1", *options))
        assert code in {0, 3}, err
        return code, summary["judged_now"]

    assert run("--max-memory", "0.05") == (3, 2)
    _, large = rows(results)
    assert large["reason"].endswith("; then have it tried again (--retry)"), large["reason"]
    assert run("--max-memory", "1", "--retry") == (0, 1)
    assert [row["judged"] for row in rows(results)] == [True, True]


@pytest.mark.long
def test_the_working_folders_of_workers_do_not_matter(tmp_path: Path) -> None:
    add_recordings(add_machine(tmp_path / "archive", "pump"), 1)
    (tmp_path / "archive" / "pump" / "recordings" / "cut.npz").write_bytes(b"PK")
    (tmp_path / "elsewhere").mkdir()
    expected = {}
    with (
        dask(tmp_path, "scheduler") as (_, address),
        dask(tmp_path / "elsewhere", "worker", address, "--nthreads", "1", "--no-dashboard"),
    ):
        for cluster in (address, "local:1"):
            options = ("archive", "--cluster", cluster, "--results", cluster[:5])
            code, _, err = ended(start_analyze(*options, cwd=tmp_path))
            assert code == 3, err
            expected[cluster[:5]] = contents(tmp_path / cluster[:5])
    assert [row["verdict"] for row in rows(tmp_path / "local")] == ["normal", None]
    assert expected["tcp:/"] == expected["local"]


@pytest.mark.long
def test_one_machine_that_cannot_be_named_or_read_does_not_stop_the_others(tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    long = "насос-на-линии-розлива-номер-один-в-цехе-семь"
    latin = os.fsdecode(b"caf\xe9")
    for name in ("pump", long, latin, "caf\\xe9", "broken"):
        add_recordings(add_machine(archive, name), 1)
    (archive / "broken" / "machine.toml").unlink()
    (archive / "broken" / "machine.toml").symlink_to("/proc/self/mem")
    (archive / os.fsdecode(b"left-\xe9")).mkdir()
    code, summary, err = ended(start_analyze(archive, "--cluster", "local:1"))
    assert code == 3, err
    assert summary["verdicts"] == {"normal": 3}
    assert summary["folders_left_out"] == ["left-\\xe9"]
    failed = summary["machines_failed"]
    assert set(failed) == {"broken", "caf\\xe9"}
    assert "broken/machine.toml cannot be read: Input/output error" in failed["broken"]
    assert "is written as" in failed["caf\\xe9"]
    assert {row["machine"] for row in rows(tmp_path / "archive-results")} == {"pump", long, "caf\\xe9"}
    code, summary, _ = ended(start_analyze(archive, "--cluster", "local:1"))
    assert (code, summary["judged_now"]) == (3, 0)


def is_running(pid: int) -> bool:
    import psutil

    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


class dask:  # noqa: N801 - reads as the program that it runs
    """``dask scheduler`` or ``dask worker``, on loopback; gives the process and its address."""

    def __init__(self, folder: Path, what: str, *arguments: str) -> None:
        self._log = folder / f"{what}.log"
        self._what = what
        self._arguments = arguments
        self._folder = folder

    def __enter__(self) -> tuple[subprocess.Popen[bytes], str]:
        options = ["--host", "127.0.0.1"]
        options += ["--port", "0", "--dashboard-address", "127.0.0.1:0"] if self._what == "scheduler" else []
        options += ["--local-directory", str(self._folder)] if self._what == "worker" else []
        code = f"from distributed.cli import dask_{self._what} as verb; verb.main()"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, *self._arguments, *options],
                stderr=log,
                stdout=log,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
                cwd=self._folder,
            )
        if self._what == "worker":
            return self._process, ""
        pattern = re.compile(r"Scheduler at:\s+(tcp://127\.0\.0\.1:\d+)")
        eventually_blocking(lambda: pattern.search(self._log.read_text()), "the scheduler listens")
        found = pattern.search(self._log.read_text())
        assert found
        return self._process, found[1]

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
