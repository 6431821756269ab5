"""The table of results: what is written is whole, and what was begun is finished."""

from __future__ import annotations

import fcntl
import json
import os
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import pytest
from support.fleet_archives import parts

from daqsvc.fleet import FleetError
from daqsvc.fleet.results import Results, folder_of
from daqsvc.fleet.table import COLUMNS, recorded_at

if TYPE_CHECKING:
    from pathlib import Path

PUMP = folder_of("pump")


def row(file: str, **values: Any) -> dict[str, Any]:
    basic = {"machine": "pump", "file": file, "machine_digest": "m", "version": "1", "digest": file}
    return {**dict.fromkeys(COLUMNS), "judged": True, "verdict": "normal", **basic, **values}


def files(results: Results) -> list[str]:
    return [one["file"] for one in results.rows(PUMP)]


@pytest.mark.parametrize("url", ["{tmp_path}/results", "memory://results-of-{name}"])
def test_parts_become_one_table_in_the_order_of_the_recordings(url: str, tmp_path: Path) -> None:
    results = Results(url.format(tmp_path=tmp_path, name=tmp_path.name))
    results.add([row("c"), row("a")], PUMP)
    results.add([row("b", group=["normal"], recorded=datetime(2026, 1, 1, tzinfo=UTC))], PUMP)
    assert files(results) == ["a", "b", "c"]
    assert results.folders() == [PUMP]
    before = results.rows(PUMP)
    results.compact(PUMP, lambda one: one)
    assert results.rows(PUMP) == before
    results.add([row("b", digest="new")], PUMP)
    results.compact(PUMP, lambda one: None if one["digest"] == "b" else one)
    assert [one["digest"] for one in results.rows(PUMP)] == ["a", "new", "c"]


@pytest.mark.parametrize("name", ["x", "y", "z", "v"])
def test_what_was_tried_again_replaces_what_could_not_be_judged(name: str, tmp_path: Path) -> None:
    """Whatever the files are called, of the same recording by the same machine file and version."""
    results = Results(str(tmp_path))
    refused = row("a", judged=False, verdict=None, reason="no memory")
    results.add([refused], PUMP)
    results.compact(PUMP, lambda one: one)
    part = results.add([row("a", verdict=name)], PUMP)
    assert [one["verdict"] for one in results.rows(PUMP)] == [None, name], "the last stands behind"
    killed = [row["verdict"] for row in after_compaction(tmp_path, {})]
    assert killed == [name], "a run that was killed before it had made one table"
    results.add([refused, row("b")], PUMP)
    again = {**refused, "reason": "no time"}
    part = results.add([again], PUMP)
    assert [row["reason"] for row in after_compaction(tmp_path, {"a": part})] == ["no time", None]


def after_compaction(place: Path, newest: dict[str, str]) -> list[dict[str, Any]]:
    results = Results(str(place))
    results.compact(PUMP, lambda one: one, newest)
    return results.rows(PUMP)


def test_a_table_does_not_depend_on_the_parts_that_it_came_in(tmp_path: Path) -> None:
    rows = [row(name) for name in "abcdef"]
    names = []
    for number, size in enumerate((1, 2, 6)):
        results = Results(str(tmp_path / f"{number}"))
        for k in range(0, 6, size):
            results.add(rows[k : k + size][::-1], PUMP)
        results.add(rows[:1], PUMP)
        results.compact(PUMP, lambda one: one)
        names.append([(path.name, path.read_bytes()) for path in parts(tmp_path / f"{number}")])
    assert names[0] == names[1] == names[2]
    assert len(names[0]) == 1


@pytest.mark.parametrize("written", [0, 1])
def test_what_a_kill_has_left_half_done_is_finished(
    written: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between any two of its writes: readers and the next run see every recording."""
    results = Results(str(tmp_path))
    results.add([row("a")], PUMP)
    results.add([row("b")], PUMP)
    put, count = results._put, 0

    def dying(path: str, content: bytes) -> None:
        nonlocal count
        if count > written:
            raise KeyboardInterrupt
        count += 1
        put(path, content)

    monkeypatch.setattr(results, "_put", dying)
    monkeypatch.setattr(results, "_remove", lambda _paths: dying("", b""))
    with pytest.raises(KeyboardInterrupt):
        results.compact(PUMP, lambda one: one)
    after = Results(str(tmp_path))
    assert set(files(after)) == {"a", "b"}
    after.repair(PUMP)
    assert files(after) == ["a", "b"]
    after.compact(PUMP, lambda one: one)
    assert files(after) == ["a", "b"]
    assert len(parts(tmp_path)) == 1
    assert not any((tmp_path / "compacting").iterdir())


def test_nothing_but_whole_tables_lies_where_readers_look(tmp_path: Path) -> None:
    results = Results(str(tmp_path))
    with results.lock():
        results.add([row("a")], PUMP)
        results.compact(PUMP, lambda one: one)
        results.note_run("now", {"judged": 1})
        with pytest.raises(FleetError, match="another run is writing into"), Results(str(tmp_path)).lock():
            pass
    found = [path for path in (tmp_path / "table").rglob("*") if path.is_file()]
    assert [path.suffix for path in found] == [".parquet"]
    assert json.loads((tmp_path / "runs" / "now.json").read_text()) == {"judged": 1}


def test_a_folder_in_which_nothing_was_written_is_left_as_it_was(tmp_path: Path) -> None:
    place = tmp_path / "made" / "results"
    with Results(str(place)).lock():
        assert (place / ".lock").exists()
    assert not any(tmp_path.iterdir())
    place.mkdir(parents=True)
    with Results(str(place)).lock():
        pass
    assert not any(place.iterdir())
    with Results(str(place)).lock():
        Results(str(place)).note_run("now", {})
    assert (place / ".lock").exists(), "what holds results keeps it"


def test_a_lock_that_was_removed_meanwhile_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs that both found one, of which the first has removed it, and then a third."""
    lock = fcntl.flock

    def late(file: Any, how: int) -> None:
        (tmp_path / ".lock").unlink()
        lock(file, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with pytest.raises(FleetError, match="another run is writing into"), Results(str(tmp_path)).lock():
        pass


def test_what_is_no_table_is_named(tmp_path: Path) -> None:
    results = Results(str(tmp_path))
    results.add([row("a")], PUMP)
    path = parts(tmp_path)[0]
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(FleetError, match=rf"{path.name} is no table of results .*; remove it"):
        results.rows(PUMP)


def test_a_place_that_cannot_be_reached_or_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(FleetError, match="nonsense://x cannot be reached"):
        Results("nonsense://x")
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(FleetError, match="cannot be written: Not a directory"),
        Results(str(tmp_path / "file" / "results")).lock(),
    ):
        pass


def test_a_machine_of_any_name_has_a_folder() -> None:
    assert folder_of("fan 1") == "machine=fan 1"
    assert folder_of("a=b/c%") == "machine=a%3Db%2Fc%25"
    assert os.sep not in folder_of("../x")
    assert folder_of(os.fsdecode(b"caf\xe9")) == "machine=caf%5Cxe9"
    assert folder_of("\ud800") == "machine=%5Cud800"
    long = {
        folder_of(cut + "\N{CYRILLIC SMALL LETTER EN}" * 60 + end) for cut in ("", "a", "ab") for end in "xy"
    }
    assert len(long) == 6
    assert all(len(name) <= 208 and "\N{REPLACEMENT CHARACTER}" not in unquote(name) for name in long)


@pytest.mark.parametrize(
    ("file", "time"),
    [
        ("2026-03-04.npz", "2026-03-04T00:00:00+00:00"),
        ("2026/pump_20260304T1530.csv", "2026-03-04T15:30:00+00:00"),
        ("20260304_153059.npz", "2026-03-04T15:30:59+00:00"),
        ("2026-03-04T15-30-59-alarm.mcap", "2026-03-04T15:30:59+00:00"),
        ("2025-01-01/2026-03-04 15:30.wav", "2026-03-04T15:30:00+00:00"),
        ("run-7.npz", None),
        ("2026-02-31.npz", None),
        ("120260304.npz", None),
    ],
)
def test_the_time_of_a_recording_is_in_its_name(file: str, time: str | None) -> None:
    found = recorded_at(file)
    assert (found and found.isoformat()) == time
