"""Snapshots that cannot be replayed are refused in a sentence, whatever is in them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest
from support.recorded_rig import recorded_rig

from daqsvc import __version__
from daqsvc.offline.replay import ReplayError, replay
from daqsvc.machine_facts import machine_values
from daqsvc.snapshots.contents import MACHINE_JSON, SCHEMA, Snapshot

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
        ({"alarms": [{"schema": "daqsvc.alarm/1"}]}, None),
        ({"version": None, "alarms": 7}, None),
    ],
)
async def test_it_is_refused(about: dict[str, Any], files: dict[str, bytes] | None, tmp_path: Path) -> None:
    there = {MACHINE_JSON: machine_json()} if files is None else files
    with pytest.raises(ReplayError) as caught:
        await replay(Snapshot({**ABOUT, **about}, there), None, tmp_path)
    assert "\n" not in f"{caught.value}"
