"""Ids of alarm events: no two events in the world share one, whatever becomes of a store."""

from __future__ import annotations

import json
import shutil

import pytest
from support.alarm_desk import alarm_service

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.events import Identity
from daqsvc.alarms.rules import DiagnosisRule
from daqsvc.diagnosis.record import Diagnosis

pytestmark = pytest.mark.integration


async def told_by(store, site="lab"):
    """The ids of the events of a box without a clock of its own, from one start to its end."""
    clock = DrivenClock(wall_start_ns=0)
    desk = alarm_service(
        Identity(site, "edge-1", "rig"), [DiagnosisRule("rotor-fault", "rotor-bank")], store, clock, None
    )
    await desk.open()
    await desk.resume({})
    for decision, severity in (("F1", "alert"), ("healthy", "normal")) * 3:
        clock.advance_to(clock.monotonic_ns() + 1_000_000_000)
        desk.take(
            Diagnosis("rig", "rotor-bank", clock.monotonic_ns(), "shaft", 0, 64, decision, severity=severity)
        )
    await desk.settle(5.0)
    ids = {json.loads(message.payload)["id"] for message in await desk.outbox.pending(0, 1000)}
    await desk.close(5.0)
    return ids


async def test_two_sites_with_boxes_of_one_name_and_no_clock_share_no_id(tmp_path):
    here, there = await told_by(tmp_path / "a", "lab"), await told_by(tmp_path / "b", "plant")
    assert len(here) == len(there) == 6
    assert not here & there


async def test_a_store_that_is_copied_or_put_back_brings_no_id_again(tmp_path):
    before = await told_by(tmp_path / "store")
    shutil.copytree(tmp_path / "store", tmp_path / "backup")
    after = await told_by(tmp_path / "store") - before
    copied = await told_by(tmp_path / "backup") - before
    assert len(after) == len(copied) == 6
    assert not after & copied
