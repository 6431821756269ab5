"""What a worker makes of recordings, in this process: rows as `daqsvc analyze` would have it."""

from __future__ import annotations

import errno
import json
import os
from typing import TYPE_CHECKING, Any

import pytest
from support.file_bombs import write as write_bomb
from support.fleet_archives import add_hostile, add_machine, add_recordings
from support.orbit_files import Orbit

import daqsvc
from daqsvc.confined import process
from daqsvc.confined.limits import ResourceLimits
from daqsvc.diagnosis.recorded import RecordingOptions
from daqsvc.errors.recordings import DAMAGED
from daqsvc.fleet import FleetError, judging
from daqsvc.fleet.archive import Archive
from daqsvc.fleet.campaign import Campaign, Wanted
from daqsvc.fleet.failures import is_passing
from daqsvc.fleet.judging import Judged, OtherVersionError, RecordingBatch, describe_machine, judge_batch
from daqsvc.fleet.results import Results, folder_of
from daqsvc.fleet.table import COLUMNS, begun_row
from daqsvc.offline.runner import Runner
from daqsvc.recording import RecordingError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.integration


def batch_of(
    url: str, machine: str = "pump", version: str = daqsvc.__version__, **known: Any
) -> RecordingBatch:
    archive = Archive(url)
    found = archive.machine(machine)
    assert found is not None
    options = RecordingOptions()
    digest, wrong = describe_machine(archive, found, options)
    limits = ResourceLimits(1_000_000_000)
    description, recordings = found.description, found.recordings
    return RecordingBatch(
        url, machine, description, digest, wrong, options, limits, version, recordings, known.get("known", {})
    )


def by_file(judged: Judged) -> dict[str, dict[str, Any]]:
    return {row["file"]: row for row in judged.rows}


def test_a_row_is_what_analyze_says_of_the_recording(analyze: Callable[..., Any], tmp_path: Path) -> None:
    add_recordings(add_machine(tmp_path, "pump"), 2, changed_from=1)
    found = by_file(judge_batch(batch_of(str(tmp_path))))
    files = sorted(tmp_path.glob("pump/recordings/*"))
    _, told, _ = analyze(tmp_path / "pump" / "machine.toml", *files)
    assert [one["verdict"] for one in told] == ["normal", "unbalance"]
    for file, one in zip(files, told, strict=True):
        row = found[file.name]
        one["recording"] = f"pump/recordings/{file.name}"
        assert json.loads(row["analysis"]) == one
        assert tuple(row) == COLUMNS
        assert (row["verdict"], row["group"]) == (one["verdict"], one["group"])
        assert row["probability"] == one["probabilities"][one["verdict"]]
        assert (row["judged"], row["reason"], row["size_bytes"]) == (True, None, file.stat().st_size)
    assert found["2026-03-02.npz"]["alarms"] == 1
    assert found["2026-03-02.npz"]["recorded"].isoformat() == "2026-03-02T00:00:00+00:00"


def test_a_file_that_is_corrupt_cut_hostile_or_enormous_costs_its_row(tmp_path: Path) -> None:
    recordings = add_machine(tmp_path, "pump")
    reasons = add_hostile(recordings)
    found = by_file(judge_batch(batch_of(str(tmp_path))))
    assert found.pop("sound.npz")["verdict"] == "normal"
    assert set(found) == set(reasons)
    for file, part in reasons.items():
        assert found[file]["judged"] is False
        assert found[file]["reason"]
        assert part in found[file]["reason"], file
        assert str(tmp_path) not in found[file]["reason"], file


def test_a_store_of_objects_gives_the_same_rows(tmp_path: Path) -> None:
    import fsspec

    recordings = add_machine(tmp_path, "pump")
    add_recordings(recordings, 1)
    write_bomb(recordings, "a.npz")
    store = fsspec.filesystem("memory")
    store.put(str(tmp_path / "pump"), "/fleet-of-rows/pump", recursive=True)
    try:
        here = by_file(judge_batch(batch_of(str(tmp_path))))
        there = by_file(judge_batch(batch_of("memory://fleet-of-rows")))
    finally:
        store.rm("/fleet-of-rows", recursive=True)
    assert len(here) == 2
    for file, row in here.items():
        assert {**row, "stamp": ""} == {**there[file], "stamp": ""}


def test_a_machine_file_that_cannot_be_used_costs_the_rows_of_its_machine(tmp_path: Path) -> None:
    recordings = add_machine(tmp_path, "pump")
    add_recordings(recordings, 2)
    machine = tmp_path / "pump" / "machine.toml"
    machine.write_text(machine.read_text().replace("rate_hz = 1600.0", "rate_hz = -1.0"))
    rows = judge_batch(batch_of(str(tmp_path))).rows
    assert [row["judged"] for row in rows] == [False, False]
    assert all("pump/machine.toml" in row["reason"] and "rate_hz" in row["reason"] for row in rows)
    assert all(str(tmp_path) not in row["reason"] for row in rows)
    machine.unlink()
    rows = judge_batch(batch_of(str(tmp_path))).rows
    assert ["has no machine.toml" in row["reason"] for row in rows] == [True, True]


def test_machines_with_equal_files_are_each_named(tmp_path: Path) -> None:
    for name in ("pump-1", "pump-2"):
        (add_machine(tmp_path, name) / "other.csv").write_text("a,b\n1,2\n2,3\n3,5\n")
        (row,) = judge_batch(batch_of(str(tmp_path), name)).rows
        assert f"{name}/machine.toml" in row["reason"]


def test_a_machine_file_that_cannot_be_read_at_the_moment_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_recordings(add_machine(tmp_path, "pump"), 2)
    batch = batch_of(str(tmp_path))

    def fail(*_: object) -> bytes:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(judging, "_runners", {})
    with monkeypatch.context() as patch:
        patch.setattr(Archive, "read", fail)
        rows = judge_batch(batch).rows
        with pytest.raises(FleetError, match=r"pump/machine\.toml cannot be read: Input/output error; what"):
            batch_of(str(tmp_path))
    assert [(row["judged"], row["digest"]) for row in rows] == [(False, None)] * 2
    assert all(row["reason"].endswith("the next run tries it again") for row in rows)
    assert [row["judged"] for row in judge_batch(batch).rows] == [True, True]


@pytest.mark.parametrize(("kills", "judged"), [(1, True), (2, False)])
def test_a_reader_that_is_killed_is_not_the_recording(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kills: int,
    judged: bool,  # noqa: FBT001 - a parameter of the test
) -> None:
    """The process that reads is really killed, while it is asked; once is made good at once."""
    add_recordings(add_machine(tmp_path, "pump"), 1)
    batch = batch_of(str(tmp_path))
    assert judge_batch(batch).rows[0]["judged"]
    left, ask = kills, process._ask

    def killing(running: Any, *arguments: Any, **named: Any) -> Any:
        nonlocal left
        if left:
            left -= 1
            running.process.kill()
        return ask(running, *arguments, **named)

    monkeypatch.setattr(process, "_ask", killing)
    # Its channels are listed before it is read: the first of both meets the kill.
    (row,) = judge_batch(batch).rows
    assert left == 0
    assert row["judged"] is judged, row["reason"]
    assert (row["digest"] is None) is not judged
    if not judged:
        assert "SIGKILL" in row["reason"]
        assert row["reason"].endswith("the next run tries it again")


def raised(cause: Exception) -> Exception:
    """What a caller sees of an error that it is not shown the cause of."""

    def fail() -> None:
        raise cause

    def read() -> None:
        try:
            fail()
        except Exception:  # noqa: BLE001 - it is what is looked at
            raise RecordingError("cannot be read", DAMAGED) from None

    with pytest.raises(RecordingError) as error:
        read()
    return error.value


def there(message: str) -> Exception:
    """What the process that reads says."""
    return process.RaisedThereError("RecordingError", f"/a/b.npz cannot be read: {message}")


@pytest.mark.parametrize(
    ("error", "passing"),
    [
        (raised(process.ConfinedError("memory", "too much")), True),
        (raised(process.ConfinedError("time", "it takes more processor time than it may")), True),
        (raised(process.ConfinedError("crash", "its reader was ended by SIGKILL")), True),
        (raised(process.ConfinedError("crash", "its reader was ended by SIGTERM")), True),
        (raised(process.ConfinedError("crash", "its reader was ended by SIGSEGV")), False),
        (raised(there("Input/output error; copy it again")), True),
        (raised(there("Invalid argument; copy it again")), False),
        (raised(there("it is cut short")), False),
        (raised(OSError(errno.EIO, "x")), True),
        (raised(OSError("CRC check failed")), False),
        (raised(MemoryError()), True),
        (ValueError("no verdict"), False),
    ],
)
def test_what_passes_and_what_is_of_the_recording(
    error: Exception,
    passing: bool,  # noqa: FBT001 - a parameter of the test
) -> None:
    assert is_passing(error) is passing


def test_text_that_is_no_unicode_costs_no_more_than_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_recordings(add_machine(tmp_path, "pump"), 1)
    batch = batch_of(str(tmp_path))
    judge = Runner.judge

    def said(self: Runner, *arguments: Any) -> Any:
        outcome = judge(self, *arguments)
        outcome.json["data_quality"]["problems"].append("half of a pair: \ud800")
        return outcome

    monkeypatch.setattr(Runner, "judge", said)
    (row,) = judge_batch(batch).rows
    assert row["problems"][-1] == "half of a pair: \\ud800"


def test_what_holds_what_it_held_is_not_judged_again(tmp_path: Path) -> None:
    recordings = add_machine(tmp_path, "pump")
    add_recordings(recordings, 2)
    first = judge_batch(batch_of(str(tmp_path)))
    known = {row["file"]: row["digest"] for row in first.rows}
    Orbit(seed=50).save(recordings / "2026-03-02.npz")
    again = judge_batch(batch_of(str(tmp_path), known=known))
    assert list(by_file(again)) == ["2026-03-02.npz"]
    assert list(again.unchanged) == ["2026-03-01.npz"]


def test_the_digest_of_a_machine_is_of_all_that_lies_beside_its_file(tmp_path: Path) -> None:
    recordings = add_machine(tmp_path, "pump")
    add_recordings(recordings, 1)
    digests = [batch_of(str(tmp_path)).machine_digest]
    (recordings / "notes.txt").write_text("a recording more or less is not the machine")
    assert batch_of(str(tmp_path)).machine_digest == digests[0]
    for text in ("a", "b"):
        (tmp_path / "pump" / "healthy.toml").write_text(text)
        digests.append(batch_of(str(tmp_path)).machine_digest)
    assert len(set(digests)) == 3


def test_can_logs_of_a_folder_are_one_recording(tmp_path: Path) -> None:
    recordings = add_machine(tmp_path, "pump")
    for name in ("monday/can0.blf", "monday/can1.blf", "single.log", "monday/run.npz"):
        (recordings / name).parent.mkdir(exist_ok=True)
        (recordings / name).write_bytes(b"x")
    found = Archive(str(tmp_path)).machine("pump")
    assert found is not None
    assert sorted((one.file, len(one.parts)) for one in found.recordings) == [
        ("monday", 2),
        ("monday/run.npz", 1),
        ("single.log", 1),
    ]


def test_another_version_of_a_worker_judges_nothing(tmp_path: Path) -> None:
    add_machine(tmp_path, "pump")
    with pytest.raises(OtherVersionError, match=r"a worker has daqsvc .* and this is 0\.0\.9"):
        judge_batch(batch_of(str(tmp_path), version="0.0.9"))


def test_a_run_counts_a_recording_by_what_it_says_of_its_machine(tmp_path: Path) -> None:
    """Levels and bearings among it, as the report has it."""
    archive = Archive(str(tmp_path / "archive"))
    recordings = add_machine(tmp_path / "archive", "pump")
    said: tuple[dict[str, Any], ...] = (
        {"worst_severity": "alert"},
        {"worst_severity": "normal"},
        {"verdict": "normal", "bearing_verdict": "outer"},
    )
    for k in range(len(said)):
        (recordings / f"{k}.csv").write_text("as it was")
    machine = archive.machine("pump")
    assert machine is not None
    digest, _ = describe_machine(archive, machine, RecordingOptions())
    rows = [
        {**begun_row("pump", digest, daqsvc.__version__, recording), "digest": "d", "judged": True, **values}
        for recording, values in zip(machine.recordings, said, strict=True)
    ]
    results = Results(str(tmp_path / "results"))
    results.add(rows, folder_of("pump"))
    campaign = Campaign(archive, results, Wanted(RecordingOptions(), ResourceLimits()))
    summary = campaign.run(lambda: pytest.fail("there is nothing to judge"))
    assert (summary.before, summary.verdicts) == (3, {"alert": 1, "normal": 1, "outer": 1})
