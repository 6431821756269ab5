"""Archives of a fleet, made up; and ``daqsvc analyze --cluster`` over them, as separate processes."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq
from support.file_bombs import write as write_bomb
from support.formats import fits
from support.machine_files import MACHINES
from support.orbit_files import SPEED_RPM, UNBALANCE, Orbit
from support.paths import ROOT

REVOLUTIONS = 120
_PROGRAM = Path(__file__).with_name("fleet_program.py")


def machine_text() -> str:
    """The example machine with a calibrated rotor, turning as the orbits of `Orbit` do."""
    text = (MACHINES / "rotor-synchronous.toml").read_text()
    for key, value in {"speed_rpm": SPEED_RPM, "natural_frequency_hz": 60.0, "clearance_um": 200.0}.items():
        text = re.sub(rf"^{key} = [\d.]+", f"{key} = {value}", text, flags=re.MULTILINE)
    return text


def add_machine(archive: Path, name: str) -> Path:
    """A machine of an archive; returns the folder of its recordings."""
    recordings = archive / name / "recordings"
    recordings.mkdir(parents=True)
    (archive / name / "machine.toml").write_text(machine_text())
    return recordings


def add_recordings(recordings: Path, count: int, *, changed_from: int | None = None, seed: int = 0) -> None:
    """A recording a day, of a machine that is unbalanced from one of them on."""
    for day in range(count):
        change = 0.0 if changed_from is None or day < changed_from else UNBALANCE
        Orbit(REVOLUTIONS, change, seed=seed + day).save(recordings / f"2026-03-{day + 1:02}.npz")


def add_hostile(recordings: Path) -> dict[str, str]:
    """Files that cannot be judged, and a part of the reason for each."""
    sound = Orbit(REVOLUTIONS, seed=99).save(recordings / "sound.npz").read_bytes()
    (recordings / "cut.npz").write_bytes(sound[: len(sound) // 2])
    (recordings / "noise.mat").write_bytes(bytes(range(256)) * 40)
    (recordings / "empty.csv").write_bytes(b"")
    write_bomb(recordings, "a.npz")
    with (recordings / "enormous.wav").open("wb") as file:
        file.truncate(10**13)
    os.mkfifo(recordings / "pipe.npz")
    (recordings / "nowhere.npz").symlink_to("no/such/file")
    Path(os.fsdecode(bytes(recordings) + b"/caf\xe9.csv")).write_text("a,b\n1,2\n")
    return {
        "cut.npz": "cannot be read",
        "noise.mat": "cannot be read",
        "empty.csv": "",
        "a.npz": "too large",
        "enormous.wav": "are read",
        "pipe.npz": "no regular file",
        "nowhere.npz": "no regular file",
        "caf\\xe9.csv": "",
    }


def start_program(*arguments: object, cwd: Path | None = None) -> subprocess.Popen[str]:
    """Start `support.fleet_program`, in this folder unless another is given."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    return subprocess.Popen(
        [sys.executable, _PROGRAM, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
        cwd=cwd,
    )


def start_analyze(
    *arguments: object, connect_s: float = 60.0, cwd: Path | None = None
) -> subprocess.Popen[str]:
    """Start ``daqsvc analyze ... --json`` with batches of one recording."""
    return start_program(connect_s, "analyze", *arguments, "--json", cwd=cwd)


def ended(process: subprocess.Popen[str]) -> tuple[int, dict[str, Any], str]:
    """Exit code, summary and stderr of a process that `start_analyze` or `start_program` started."""
    out, err = process.communicate(timeout=240)
    summary = json.loads(out) if out else {}
    # Of the verb, the summary names the file of its results as well.
    return process.returncode, fits("daqsvc analyze", summary) if "results" in summary else summary, err


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    """The workers of a local cluster."""
    found = []
    for child in psutil.Process(process.pid).children():
        with contextlib.suppress(psutil.Error):
            if any("spawn_main" in word for word in child.cmdline()):
                found.append(child.pid)
    return found


def parts(results: Path) -> list[Path]:
    """The files of a table, unfinished ones too."""
    return sorted((results / "table").rglob("*.parquet"))


def contents(results: Path) -> dict[str, bytes]:
    """All of a table, by file."""
    return {str(path.relative_to(results)): path.read_bytes() for path in parts(results)}


def rows(results: Path | str) -> list[dict[str, Any]]:
    """The rows of a table by machine and file."""
    found = [
        row for path in parts(Path(results)) for row in pq.read_table(path, partitioning=None).to_pylist()
    ]
    return sorted(found, key=lambda row: (row["machine"], row["file"]))


def kill(pid: int) -> None:
    """End a process as the kernel does when memory runs out."""
    os.kill(pid, signal.SIGKILL)
