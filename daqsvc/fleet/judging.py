"""What a worker does: some recordings of one machine to rows of the table, by the runner of `analyze`.

Everything that a worker needs is in a `RecordingBatch`; what it leaves behind is in a folder that is removed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import tempfile
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

import daqsvc
from daqsvc.fleet import FleetError
from daqsvc.fleet.archive import MACHINE_FILE, MOST_DESCRIPTION_BYTES, RECORDINGS, Archive, printable
from daqsvc.fleet.failures import is_passing
from daqsvc.fleet.table import add_analysis, begun_row
from daqsvc.settings.failures import error_text, one_line

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.confined.limits import ResourceLimits
    from daqsvc.diagnosis.recorded import RecordingOptions
    from daqsvc.fleet.archive import ArchivedFile, ArchivedMachine, ArchivedRecording
    from daqsvc.fleet.reading import PatientRunner
    from daqsvc.fleet.table import Row

    T = TypeVar("T")

_PIECE_BYTES = 1 << 22
_MOST_FILES = 1000
_LONGEST_REASON = 2000
_MOST_ENCODED = 4
"""Text needs so many bytes for each that it states, at most: a larger file than this cannot be read."""


class OtherVersionError(Exception):
    """The worker has another version of daqsvc, whose verdicts may be others."""


@dataclass(frozen=True, slots=True)
class RecordingBatch:
    """Recordings of one machine, and what judging them depends on.

    Attributes:
        archive: where it is, for any process.
        machine: name of the machine.
        description: its machine file and what lies beside it; empty if that is not to be used.
        machine_digest: of these; see `describe_machine`.
        wrong: why the machine file cannot be used, if that is known.
        options: what is stated of all recordings.
        limits: what reading a recording may take.
        version: of daqsvc.
        recordings: to be judged.
        known: by file, the digest that it had when it was judged by this machine file and this version.
    """

    archive: str
    machine: str
    description: tuple[ArchivedFile, ...]
    machine_digest: str
    wrong: str
    options: RecordingOptions
    limits: ResourceLimits
    version: str
    recordings: tuple[ArchivedRecording, ...]
    known: dict[str, str]


@dataclass(frozen=True, slots=True)
class Judged:
    """What came of a batch.

    Attributes:
        rows: of the recordings that were judged, or could not be.
        unchanged: by file, size and stamp of those that were written again and hold what they held.
    """

    rows: list[Row]
    unchanged: dict[str, tuple[int, str]]


def describe_machine(
    archive: Archive, machine: ArchivedMachine, options: RecordingOptions
) -> tuple[str, str]:
    """The digest of a machine file and all that lies beside it; and why it cannot be used, or nothing.

    What options state of the recordings is part of the digest.

    Raises:
        FleetError: one of them cannot be read. There is no digest then, and rows cannot be distinguished.
    """
    digest, name = hashlib.sha256(), printable(machine.name)
    if any((options.channels, options.rate_hz is not None, options.unit is not None)):
        digest.update(repr((sorted(options.channels.items()), options.rate_hz, options.unit)).encode())
    names = [file.name for file in machine.description]
    if MACHINE_FILE not in names:
        return digest.hexdigest(), one_line(
            f"{name} has no {MACHINE_FILE} beside {RECORDINGS}/; put it there"
        )
    wrong = ""
    if len(names) > _MOST_FILES or sum(f.size_bytes for f in machine.description) > MOST_DESCRIPTION_BYTES:
        wrong = (
            f"beside {name}/{MACHINE_FILE} lie more than {_MOST_FILES} files or "
            f"{MOST_DESCRIPTION_BYTES // 10**6} MB; move recordings into {name}/{RECORDINGS}"
        )
        names = [MACHINE_FILE]
    for file in machine.description:
        if file.name in names:
            try:
                content = archive.read(file.path, MOST_DESCRIPTION_BYTES)
            except OSError as error:
                raise FleetError(
                    f"{name}/{printable(file.name)} cannot be read: {error.strerror or error}; what is known "
                    "of this machine stays, and the next run tries it again"
                ) from None
            digest.update(repr((file.name, hashlib.sha256(content).hexdigest())).encode())
    return digest.hexdigest(), one_line(wrong)


def judge_batch(batch: RecordingBatch) -> Judged:
    """Judge the recordings of a batch, one after the other.

    Raises:
        OtherVersionError: this process has another version.
    """
    if daqsvc.__version__ != batch.version:
        raise OtherVersionError(
            f"a worker has daqsvc {daqsvc.__version__} and this is {batch.version}; install the same there"
        )
    # One at a time, however many threads the worker has: they share the process that reads.
    with (
        _judging,
        _own_limits(batch.limits),
        tempfile.TemporaryDirectory(prefix="daqsvc-fleet-", dir=_scratch()) as folder,
    ):
        return _judge(batch, Path(folder))


_judging = Lock()


def _scratch() -> str | None:
    """The folder of the worker, which Dask removes if the process is killed."""
    from distributed import get_worker  # noqa: PLC0415 - of the extra

    try:
        return str(get_worker().local_directory)
    except ValueError:  # this process is none
        return None


@contextlib.contextmanager
def _own_limits(limits: ResourceLimits) -> Iterator[None]:
    from daqsvc import kernel_cache  # noqa: PLC0415 - in the worker
    from daqsvc.recording.recording import get_limits, set_limits  # noqa: PLC0415

    kernel_cache.prepare(say=False, first=lambda: False)
    before = get_limits()
    set_limits(limits)
    try:
        yield
    finally:
        set_limits(before)


def _judge(batch: RecordingBatch, folder: Path) -> Judged:
    archive = Archive(batch.archive)
    runner, wrong, passing = None, batch.wrong, False
    if not wrong:
        try:
            runner = _runner(archive, batch)
        except Exception as error:  # noqa: BLE001 - a machine file of somebody else: its rows state it
            passing = is_passing(error)
            wrong = f"{batch.machine}/{MACHINE_FILE} cannot be used: {error}"
            wrong = _archived_reason(_again(wrong) if passing else wrong, archive, _kept_in(batch))
    rows: list[Row] = []
    unchanged: dict[str, tuple[int, str]] = {}
    for recording in batch.recordings:
        row = begun_row(printable(batch.machine), batch.machine_digest, batch.version, recording)
        row["reason"] = recording.wrong or wrong or _too_large(recording, batch.limits)
        if recording.wrong or passing or _too_large(recording, batch.limits):
            rows.append(row)
            continue
        try:
            path, row["digest"] = _fetched(archive, batch.machine, recording, folder)
        except (OSError, MemoryError) as error:
            why = (error.strerror or error) if isinstance(error, OSError) else "memory ran out"
            where = f"{batch.machine}/{RECORDINGS}/{recording.file}"
            row["reason"] = _archived_reason(_again(f"{where} cannot be read: {why}"), archive)
            rows.append(row)
            continue
        if batch.known.get(recording.file) == row["digest"]:
            unchanged[recording.file] = (recording.size_bytes, recording.stamp)
            continue
        if runner is not None:
            _add_judgement(row, runner, path, (archive, folder, _kept_in(batch)))
        rows.append(row)
        if not archive.is_local:
            shutil.rmtree(folder / batch.machine, ignore_errors=True)
    return Judged(rows, unchanged)


def _add_judgement(row: Row, runner: PatientRunner, path: Path, places: tuple[Archive, Path, Path]) -> None:
    """Fill in what the runner states; without a digest if another run may get further with the same bytes."""
    filled = dict(row)
    try:
        analysis = runner.judge(str(path), None).json
        add_analysis(filled, _archived(analysis, _prefixes(*places)))
    except Exception as error:  # noqa: BLE001 - whatever a file brings about costs its row
        passing = is_passing(error)
        reason = f"daqsvc failed at it: {error_text(error)}" + ("" if passing else "; report this")
        row["reason"] = _archived_reason(reason, *places)
    else:
        row.update(filled)
        passing = runner.is_passing
    if row["judged"]:
        return
    if passing:
        row.update(digest=None, reason=_again(row["reason"]))
    elif _MORE_MEMORY in row["reason"]:
        row["reason"] = f"{row['reason']}; then have it tried again (--retry)"


_MORE_MEMORY = "--max-memory"
"""In a reason: with this option it may be judged."""


def _again(reason: str) -> str:
    """A reason that is none of what the recording holds."""
    return f"{reason}; the next run tries it again"


def _too_large(recording: ArchivedRecording, limits: ResourceLimits) -> str:
    most = _MOST_ENCODED * limits.content_bytes
    if recording.size_bytes <= most:
        return ""
    return (
        f"{recording.file} has {recording.size_bytes / 1e9:,.3g} GB, and up to {most / 1e9:,.3g} GB are "
        "read; allow more memory (--max-memory), or cut it into shorter ones"
    )


def _fetched(archive: Archive, machine: str, recording: ArchivedRecording, folder: Path) -> tuple[Path, str]:
    """Where the recording can be read on this computer, and the digest of what it holds.

    Raises:
        OSError: it cannot be read, or has grown.
    """
    if archive.is_local:
        digests = [_copied(archive, part, None) for part in recording.parts]
        path = Path(recording.path)
    else:
        place = folder / machine / RECORDINGS
        digests = [_copied(archive, part, place / part.name) for part in recording.parts]
        path = place / recording.file
    if len(digests) == 1:
        return path, digests[0]
    named = sorted((Path(part.name).name, one) for part, one in zip(recording.parts, digests, strict=True))
    return path, hashlib.sha256(repr(named).encode()).hexdigest()


def _copied(archive: Archive, part: ArchivedFile, to: Path | None) -> str:
    """The digest of a file, which is written to another place as well if one is given.

    Raises:
        OSError: see `_fetched`.
    """
    digest, count = hashlib.sha256(), 0
    with contextlib.ExitStack() as stack:
        source = stack.enter_context(archive.open(part.path))
        copy = None
        if to is not None:
            to.parent.mkdir(parents=True, exist_ok=True)
            copy = stack.enter_context(to.open("wb"))
        while piece := source.read(_PIECE_BYTES):
            count += len(piece)
            if count > part.size_bytes:
                raise OSError(f"{part.name} grows while it is read")
            digest.update(piece)
            if copy is not None:
                copy.write(piece)
    return digest.hexdigest()


def _kept_in(batch: RecordingBatch) -> Path:
    """The folder that the machine files of this process are in, by their digests."""
    return _kept_folder(os.getpid()) / batch.machine_digest[:32]


@lru_cache(1)
def _kept_folder(_process: int) -> Path:
    import atexit  # noqa: PLC0415 - once a process

    folder = Path(tempfile.mkdtemp(prefix="daqsvc-fleet-", dir=_scratch()))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _runner(archive: Archive, batch: RecordingBatch) -> PatientRunner:
    """The runner of the machine, made once a process.

    Raises:
        Exception: the machine file cannot be read or used.
    """
    # Machines may have equal files, and what a runner reports names the machine.
    key = (batch.machine_digest, batch.machine)
    kept = _runners.get(key)
    if kept is None:
        kept = _made_runner(archive, batch)
        if len(_runners) >= _MOST_RUNNERS:
            _runners.pop(next(iter(_runners)))
        _runners[key] = kept
    return kept


_MOST_RUNNERS = 8
_runners: dict[tuple[str, str], PatientRunner] = {}


def _made_runner(archive: Archive, batch: RecordingBatch) -> PatientRunner:
    from daqsvc.fleet.reading import PatientRunner  # noqa: PLC0415 - brings all detectors
    from daqsvc.settings import MachineFileError, load_machine_file  # noqa: PLC0415

    folder = _kept_in(batch) / batch.machine
    for file in batch.description:
        place = folder / file.name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(archive.read(file.path, MOST_DESCRIPTION_BYTES))
    runner = PatientRunner(partial(load_machine_file, folder / MACHINE_FILE), batch.options)
    try:
        runner.prepare()
    except MachineFileError as error:
        first, more = error.problems[0], len(error.problems) - 1
        raise ValueError(f"{first}" + (f" (and {more} more)" if more else "")) from None
    return runner


def _prefixes(archive: Archive, *folders: Path) -> tuple[str, ...]:
    """What paths begin with that differs from worker to worker."""
    root = (f"{archive.root}/",) if archive.is_local else ()
    return (*root, *(f"{folder}/" for folder in folders))


def _archived_reason(text: str, archive: Archive, *folders: Path) -> str:
    """A reason on one line, with paths as in the archive."""
    reason: str = _archived(text, _prefixes(archive, *folders))
    return one_line(reason)[:_LONGEST_REASON]


def _archived(value: Any, prefixes: tuple[str, ...]) -> Any:
    """A JSON value with paths as in the archive, and no text that is not Unicode."""
    if isinstance(value, dict):
        return {_archived(key, prefixes): _archived(one, prefixes) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_archived(one, prefixes) for one in value]
    if isinstance(value, str):
        for prefix in prefixes:
            value = value.replace(prefix, "")
        return printable(value)
    return value
