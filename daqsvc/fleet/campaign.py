"""One pass over an archive: what is not judged yet goes to the cluster, what comes back into the table."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict

import daqsvc
from daqsvc.fleet import FleetError
from daqsvc.fleet.archive import printable
from daqsvc.fleet.judging import OtherVersionError, RecordingBatch, describe_machine, judge_batch
from daqsvc.fleet.report import VERDICT_COLUMNS, verdict_of
from daqsvc.fleet.results import folder_of
from daqsvc.fleet.table import KEYS, begun_row
from daqsvc.rounding import counted
from daqsvc.settings.failures import one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from daqsvc.confined.limits import ResourceLimits
    from daqsvc.diagnosis.recorded import RecordingOptions
    from daqsvc.fleet.archive import Archive, ArchivedMachine, ArchivedRecording
    from daqsvc.fleet.judging import Judged
    from daqsvc.fleet.results import Results
    from daqsvc.fleet.table import Row

MOST_RECORDINGS = 32
MOST_BYTES = 256_000_000
"""Of a batch: what is lost with a worker, and what is written at a time."""
BATCHES_PER_WORKER = 8
_QUEUED_PER_WORKER = 3
_COUNT_WORKERS_S = 10.0
_JUDGED_AGAIN = {"lost", "pending"}
"""Of a batch whose worker died before it had handed over what it found: the scheduler has it judged again."""


class Key(NamedTuple):
    """What a judgement depends on."""

    digest: str | None
    machine_digest: str
    version: str


class CampaignJson(TypedDict):
    """What came of an archive.

    Attributes:
        machines: machines in the archive.
        recordings: recordings in the archive.
        judged_before: recordings that an earlier run has judged.
        judged_now: recordings that this run has judged.
        not_judged: recordings that could not be judged.
        verdicts: how many recordings have each verdict.
        files_of_other_kinds: files among the recordings that are of no kind that is judged.
        folders_left_out: folders that are no machine's.
        machines_failed: machines that could not be examined, and why.
    """

    machines: int
    recordings: int
    judged_before: int
    judged_now: int
    not_judged: int
    verdicts: dict[str, int]
    files_of_other_kinds: int
    folders_left_out: list[str]
    machines_failed: dict[str, str]


@dataclass
class CampaignSummary:
    """What came of a run.

    Attributes:
        machines: in the archive.
        recordings: in the archive.
        before: of these, judged by an earlier run.
        judged: judged by this one.
        refused: that could not be judged, by an earlier run or this one.
        verdicts: of all in the archive, how many have each, as `daqsvc.fleet.report.verdict_of` has it.
        others: files among the recordings that are of no kind that is judged.
        left_out: folders that are no machine's.
        failed: machines that could not be examined, and why; what the results have of them stays.
    """

    machines: int = 0
    recordings: int = 0
    before: int = 0
    judged: int = 0
    refused: int = 0
    verdicts: Counter[str] = field(default_factory=Counter)
    others: int = 0
    left_out: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)

    def as_json(self) -> CampaignJson:
        """A JSON object."""
        return {
            "machines": self.machines,
            "recordings": self.recordings,
            "judged_before": self.before,
            "judged_now": self.judged,
            "not_judged": self.refused,
            "verdicts": dict(sorted(self.verdicts.items())),
            "files_of_other_kinds": self.others,
            "folders_left_out": self.left_out,
            "machines_failed": self.failed,
        }


@dataclass(frozen=True)
class Wanted:
    """How an archive is to be judged.

    Attributes:
        options: what is stated of all recordings.
        limits: what reading one may take.
        verify: whether to look into files that by size and time are as they were.
        retry: whether to try again what could not be judged.
        judge: what workers do.
    """

    options: RecordingOptions
    limits: ResourceLimits
    verify: bool = False
    retry: bool = False
    judge: Callable[[RecordingBatch], Judged] = judge_batch


class _MachineRun:
    """A machine while its recordings are judged.

    Raises:
        FleetError: its machine file or its results cannot be read.
    """

    def __init__(self, archive: Archive, machine: ArchivedMachine, results: Results, wanted: Wanted) -> None:
        self.folder = folder_of(machine.name)
        self.left = 0
        """Batches that have not come back."""
        self._results = results
        results.repair(self.folder)
        digest, wrong = describe_machine(archive, machine, wanted.options)
        self._there = {recording.file for recording in machine.recordings}
        self._current: dict[str, Key] = {}
        self._renewed: dict[str, tuple[int, str]] = {}
        self._newest: dict[str, str] = {}
        known: dict[str, Row] = {}
        for row in results.rows(self.folder, KEYS):
            if (
                (row["machine_digest"], row["version"]) == (digest, daqsvc.__version__)
                and row["digest"] is not None
                and (row["judged"] or not wanted.retry)
            ):
                other = known.get(row["file"])
                # As `Results.compact` has it: of what holds the same, the row that was judged.
                if other is None or row["judged"] or other["digest"] != row["digest"]:
                    known[row["file"]] = row
        self.todo: list[ArchivedRecording] = []
        for recording in machine.recordings:
            there = known.get(recording.file)
            if (
                there is None
                or wanted.verify
                or (there["size_bytes"], there["stamp"]) != (recording.size_bytes, recording.stamp)
            ):
                self.todo.append(recording)
            else:
                self._current[recording.file] = Key(there["digest"], digest, daqsvc.__version__)
        self._batch = RecordingBatch(
            archive.address,
            machine.name,
            machine.description,
            digest,
            wrong,
            wanted.options,
            wanted.limits,
            daqsvc.__version__,
            (),
            {},
        )
        self._known = {file: row["digest"] for file, row in known.items()}

    def batches(self, most: int) -> Iterator[RecordingBatch]:
        """What is to be done, each with up to so many recordings."""
        pieces: list[list[ArchivedRecording]] = []
        size = 0
        for recording in self.todo:
            if not pieces or len(pieces[-1]) >= most or size + recording.size_bytes > MOST_BYTES:
                pieces.append([])
                size = 0
            pieces[-1].append(recording)
            size += recording.size_bytes
        self.left = len(pieces)
        for piece in pieces:
            known = {r.file: self._known[r.file] for r in piece if r.file in self._known}
            yield replace(self._batch, recordings=tuple(piece), known=known)

    def add(self, judged: Judged) -> None:
        """Write down what came back."""
        if judged.rows:
            name = self._results.add(judged.rows, self.folder)
            self._newest.update((row["file"], name) for row in judged.rows)
        for row in judged.rows:
            self._current[row["file"]] = Key(row["digest"], row["machine_digest"], row["version"])
        for file, seen in judged.unchanged.items():
            self._current[file] = Key(self._known[file], self._batch.machine_digest, self._batch.version)
            self._renewed[file] = seen

    def finish(self, summary: CampaignSummary) -> None:
        """Make one table of it, with one row a recording, and count what is in it."""

        def change(row: Row) -> Row | None:
            key = Key(row["digest"], row["machine_digest"], row["version"])
            if self._current.get(row["file"], key) != key:
                return None
            if row["file"] in self._renewed:
                size, stamp = self._renewed[row["file"]]
                return {**row, "size_bytes": size, "stamp": stamp}
            return row

        self._results.compact(self.folder, change, self._newest)
        for row in self._results.rows(self.folder, ("file", "judged", *VERDICT_COLUMNS)):
            if row["file"] not in self._there:
                continue
            if row["judged"]:
                summary.verdicts[verdict_of(row)] += 1
            else:
                summary.refused += 1


class Campaign:
    """Judges what an archive holds and the results do not.

    Args:
        archive: the recordings.
        results: where the table is.
        wanted: how.
        progress: called with the recordings that are done and those in all.
        say: called with a sentence for a person at the terminal.
    """

    def __init__(
        self,
        archive: Archive,
        results: Results,
        wanted: Wanted,
        progress: Callable[[int, int], None] = lambda _done, _all: None,
        say: Callable[[str], None] = lambda _text: None,
    ) -> None:
        self._archive = archive
        self._results = results
        self._wanted = wanted
        self._progress = progress
        self._say = say
        self._done = 0
        self._suspects: list[tuple[_MachineRun, RecordingBatch]] = []
        self._folders: dict[str, str] = {}
        self.summary = CampaignSummary()

    def run(self, client: Callable[[], Any]) -> CampaignSummary:
        """Judge all of it.

        Args:
            client: connects to the cluster; called if there is something to judge.

        Raises:
            FleetError: the archive or the results cannot be used, or the cluster is lost.
        """
        begun = datetime.now(UTC)
        machines = list(self._machines())
        todo = sum(len(machine.todo) for machine in machines)
        self._done = self.summary.before = self.summary.recordings - todo
        for machine in machines:
            if not machine.todo:
                machine.finish(self.summary)
        if todo:
            self._judge(client(), machines, todo)
        about = {
            "begun": begun.isoformat(),
            "ended": datetime.now(UTC).isoformat(),
            "version": daqsvc.__version__,
            "archive": self._archive.url,
            **self.summary.as_json(),
        }
        self._results.note_run(begun.strftime("%Y%m%dT%H%M%S.%fZ"), about)
        return self.summary

    def _machines(self) -> Iterator[_MachineRun]:
        failed = self.summary.failed
        for name in self._archive.machines():
            try:
                run = self._machine(name)
            except (FleetError, OSError) as error:  # of one machine: the others are judged all the same
                failed[printable(name)] = one_line(printable(f"{error}"))
                continue
            if run is not None:
                yield run
        if not self.summary.machines and failed:
            raise FleetError(next(iter(failed.values())))
        if not self.summary.machines:
            raise FleetError(
                f"no folder of {self._archive.url} has a machine.toml and recordings/ in it; lay them out so"
            )

    def _machine(self, name: str) -> _MachineRun | None:
        """A machine; None if the folder is no machine's.

        Raises:
            FleetError, OSError: it cannot be judged.
        """
        machine = self._archive.machine(name)
        if machine is None:
            self.summary.left_out.append(printable(name))
            return None
        folder = folder_of(name)
        if folder in self._folders:
            raise FleetError(f"{name} is written as {self._folders[folder]} is; give it another name")
        run = _MachineRun(self._archive, machine, self._results, self._wanted)
        self._folders[folder] = name
        self.summary.machines += 1
        self.summary.recordings += len(machine.recordings)
        self.summary.others += machine.others
        return run

    def _judge(self, client: Any, machines: Iterable[_MachineRun], todo: int) -> None:
        workers = max(1, sum(client.nthreads().values()))
        what = f"{counted(todo, 'recording')} to judge, {counted(workers, 'worker')}"
        self._say(f"{what}; dashboard: {client.dashboard_link}")
        most = min(MOST_RECORDINGS, max(1, todo // (BATCHES_PER_WORKER * workers)))
        batches = ((machine, batch) for machine in machines for batch in machine.batches(most))
        self._work(client, batches)
        # Of what was on a worker that died again and again only one recording is to blame: each by itself.
        suspects, self._suspects = self._suspects, []
        alone: list[tuple[_MachineRun, RecordingBatch]] = []
        for machine, batch in suspects:
            machine.left += len(batch.recordings) - 1
            alone += [(machine, replace(batch, recordings=(one,))) for one in batch.recordings]
        self._work(client, iter(alone), alone=True)

    def _work(
        self, client: Any, batches: Iterator[tuple[_MachineRun, RecordingBatch]], *, alone: bool = False
    ) -> None:
        """Keep the workers busy until all batches are back.

        Args:
            client: of the cluster.
            batches: what there is to do.
            alone: one at a time in all the cluster, and whatever loses its worker is to blame.
        """
        from distributed import as_completed  # noqa: PLC0415 - of the extra

        running: dict[Any, tuple[_MachineRun, RecordingBatch]] = {}
        completed = as_completed(loop=client.loop)
        room, counted_s = 1, -math.inf
        while True:
            if not alone and time.monotonic() - counted_s > _COUNT_WORKERS_S:
                room = max(1, _QUEUED_PER_WORKER * sum(client.nthreads().values()))
                counted_s = time.monotonic()
            for work in islice(batches, max(0, room - len(running))):
                future = client.submit(self._wanted.judge, work[1], pure=False)
                running[future] = work
                completed.add(future)
            if not running:
                return
            future = next(completed)
            if future.status in _JUDGED_AGAIN:
                completed.add(future)
                continue
            machine, batch_done = running.pop(future)
            judged = self._outcome(future, batch_done, alone=alone)
            if judged is None:
                self._suspects.append((machine, batch_done))
                continue
            machine.add(judged)
            self.summary.judged += len(judged.rows)
            self._done += len(judged.rows) + len(judged.unchanged)
            self._progress(self._done, self.summary.recordings)
            machine.left -= 1
            if not machine.left:
                machine.finish(self.summary)

    def _outcome(self, future: Any, batch: RecordingBatch, *, alone: bool) -> Judged | None:
        """What a worker found; None if it was lost over it.

        Raises:
            FleetError: the cluster is lost, or its workers cannot do it.
        """
        from distributed import KilledWorker  # noqa: PLC0415 - of the extra

        from daqsvc.fleet.judging import Judged  # noqa: PLC0415

        if future.status == "finished":
            judged: Judged = future.result()
            return judged
        if future.status != "error":
            raise FleetError(
                "the scheduler of the cluster was lost; what was judged is written, and the same command "
                "goes on"
            )
        error = future.exception()
        if isinstance(error, OtherVersionError):
            raise FleetError(f"{error}")
        if not isinstance(error, KilledWorker):
            raise FleetError(
                f"a worker could not begin ({type(error).__name__}: {error}); install 'daqsvc[fleet]' of "
                "this version there"
            )
        if not alone:
            return None
        (recording,) = batch.recordings
        row = begun_row(printable(batch.machine), batch.machine_digest, batch.version, recording)
        row["reason"] = (
            "each process that judged it was killed, several in a row (out of memory?); give workers more "
            "memory, or cut it into shorter ones"
        )
        return Judged([row], {})
