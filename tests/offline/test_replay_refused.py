"""Snapshots that cannot be replayed are refused in a sentence, whatever is in them."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.given_codes import had
from support.machine_files import TRIAXIAL
from support.paths import ROOT
from support.recorded_rig import recorded_rig

from daqsvc import __version__
from daqsvc.acquisition.samples import SampleBlock
from daqsvc.cli import main
from daqsvc.machine_facts import machine_values
from daqsvc.offline.replay import ReplayError, replay
from daqsvc.settings.load import load_machine_file
from daqsvc.snapshots.contents import CAUSES, DIAGNOSES, MACHINE_JSON, SCHEMA, WINDOWS, Entry, Noted, Snapshot
from daqsvc.snapshots.writing import SnapshotWriter

if TYPE_CHECKING:
    from pathlib import Path

ABOUT: dict[str, Any] = {
    "schema": SCHEMA,
    "version": __version__,
    "begin_ns": 10**9,
    "wall_ns_at_0": 10**18,
    "from_start": True,
    "standings": {},
    "alarms": [],
    "streams": {},
}

LACKED = {"weight": 0, "lasts": False, "times_ns": [10**9], "shares": [0.5], "blind_ns": None}


def machine_json() -> bytes:
    return json.dumps(machine_values(recorded_rig("unused")[0])).encode()


@pytest.mark.parametrize(
    ("about", "files"),
    [
        ({}, {}),
        ({}, {MACHINE_JSON: b"[]"}),
        ({}, {MACHINE_JSON: b'{"site": 7}'}),
        ({"begin_ns": float("inf")}, None),
        ({"wall_ns_at_0": 10**21}, None),
        ({"standings": {"shaft": {"mood": 1}}}, None),
        ({"lacking": {"bank": 7}}, None),
        ({"lacking": {"bank": {"weight": 1}}}, None),
        ({"lacking": {"bank": {**LACKED, "shares": []}}}, None),
        ({"lacking": {"bank": {**LACKED, "shares": [float("inf")]}}}, None),
        ({"lacking": {"bank": {**LACKED, "weight": 10**9}}}, None),
        ({"lacking": {"bank": {**LACKED, "blind_ns": "soon"}}}, None),
        ({"alarms": [{"schema": "daqsvc.alarm/1"}]}, None),
        ({"version": None, "alarms": 7}, None),
    ],
)
async def test_it_is_refused(about: dict[str, Any], files: dict[str, bytes] | None, tmp_path: Path) -> None:
    there = {MACHINE_JSON: machine_json()} if files is None else files
    with pytest.raises(ReplayError) as caught:
        await replay(Snapshot({**ABOUT, **about}, there), None, tmp_path)
    assert "\n" not in f"{caught.value}"


async def test_a_snapshot_without_the_dbc_asks_for_a_machine_file_that_has_it(tmp_path: Path) -> None:
    values = machine_values(load_machine_file(TRIAXIAL))
    with pytest.raises(ReplayError) as caught:
        await replay(Snapshot(ABOUT, {MACHINE_JSON: json.dumps(values).encode()}), None, tmp_path)
    assert f"{caught.value}" == (
        "does not have ../devices/triaxial-accelerometer.dbc, which could not be read when it was written: "
        "name the machine file behind it, in a folder that has this file"
    )


FACTS = {"rate_hz": 640.0, "channels": ["x"], "sensors": ["probe-x"], "units": ["um"]}
MOTOR = ROOT / "config" / "machines" / "motor-accelerometer.toml"


@pytest.mark.parametrize(
    ("streams", "detector", "why"),
    [
        (
            {"shaft": FACTS},
            "rotor-bank",
            f"has samples of shaft, and the detectors of {MOTOR} judge drive-end: give a machine file",
        ),
        (
            {"drive-end": FACTS},
            "rotor-bank",
            f"has samples for the detectors rotor-bank, of which {MOTOR} has none, but ",
        ),
    ],
)
async def test_a_machine_file_of_which_nothing_is_judged_is_refused(
    streams: dict[str, Any], detector: str, why: str, tmp_path: Path
) -> None:
    given = {"detector": detector, "first_index": 0, "count": 1}
    snapshot = Snapshot(
        {**ABOUT, "machine": "laval-rig", "streams": streams},
        {MACHINE_JSON: machine_json()},
        [Entry(2 * 10**9, Noted(WINDOWS, given))],
    )
    with pytest.raises(ReplayError) as caught:
        await replay(snapshot, load_machine_file(MOTOR), tmp_path)
    assert f"{caught.value}".startswith(why)


def test_a_check_of_nothing_is_not_passed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a snapshot.mcap"
    about = {**ABOUT, "streams": {"shaft": FACTS, "other": FACTS}, "causes": ["a \x1b[31mknock"]}
    writer = SnapshotWriter(path, about, {MACHINE_JSON: machine_json()}, 10**18)
    rows = np.zeros((64, 1), np.float32)
    writer.write(
        [
            Entry(10**9, SampleBlock("other", 0, rows, 10**9, 1e9 / 640.0)),
            Entry(10**9, Noted(CAUSES, {"kind": "alarm", "cause": "rotor-fault: raised"})),
            Entry(10**9, Noted(DIAGNOSES, {"detector": "an\x1b[31mother"})),
        ]
    )
    writer.finish()
    assert main(["replay", f"{path}"]) == 0
    first, *between, last = capsys.readouterr().out.splitlines()
    assert any("are not judged again: 1 (an\N{REPLACEMENT CHARACTER}[31mother)" in line for line in between)
    assert first == "made for: a \N{REPLACEMENT CHARACTER}[31mknock; rotor-fault: raised"
    assert last.startswith("nothing was compared")
    assert main(["replay", f"{path}", "--check", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["is_equal"], told["is_compared"]) == (False, False)
    assert told["causes"] == ["a \x1b[31mknock", "rotor-fault: raised"]


def test_what_is_refused_is_shown_and_not_obeyed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "one.mcap"
    about = {**ABOUT, "standings": {"shaft": {"a \x1b[31mmood": 1}}}
    SnapshotWriter(path, about, {MACHINE_JSON: machine_json()}, 10**18).finish()
    assert main(["replay", f"{path}"]) == 3
    err = capsys.readouterr().err
    assert "a \N{REPLACEMENT CHARACTER}[31mmood" in err
    assert err.endswith("[R18]\n")
    had("R18", err)


def test_what_is_no_file_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pipe = tmp_path / "pipe.mcap"
    os.mkfifo(pipe)
    for path in (pipe, tmp_path):
        for command in (["replay", f"{path}"], ["export", f"{pipe}", "--to", f"{tmp_path / 'x.csv'}"]):
            assert main(command) == 3
            assert "it is no file but a folder, pipe or device; give a file" in capsys.readouterr().err
