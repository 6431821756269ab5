"""A start on a disk that is full, takes no writes or fails: watched at once, and stored when that works."""

from __future__ import annotations

import contextlib
import json
import logging

import numpy as np
import pytest
from support.alarm_desk import alarm_service
from support.live_service import play, running
from support.small_disks import mounted
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.events import Identity
from daqsvc.alarms.rules import DiagnosisRule
from daqsvc.alarms.states import AlarmState
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.outbox import journal, reading, writer
from daqsvc.outbox.limits import MIB, OutboxLimits
from daqsvc.outbox.messages import OutboxError
from daqsvc.recording.recording import Recording
from sim_hw.demo.machines import for_recording

pytestmark = pytest.mark.integration
CLOCK = SystemClock()
ALARMS = ("rotor-fault", "bearing-fault")
LATCHING = [DiagnosisRule(alarm, alarm, latching=True) for alarm in ALARMS]
LIMITS = OutboxLimits(reserve_bytes=0, ballast_bytes=MIB // 2)
NO_BALLAST = OutboxLimits(reserve_bytes=0, ballast_bytes=0)


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(writer, "RETRY_MOST_S", 0.1)


@pytest.fixture
def disk(tmp_path):
    with mounted(tmp_path / "disk", "4m") as small:
        yield small


@contextlib.asynccontextmanager
async def desk_in(store, limits=LIMITS):
    """The alarms of a service from its start to its stop."""
    desk = alarm_service(Identity("lab", "edge-1", "rig"), LATCHING, store, CLOCK, None, limits=limits)
    await desk.open()
    try:
        await desk.resume({})
        yield desk
    finally:
        await desk.settle(2.0)
        await desk.close(2.0)


def find(desk, alarm, severity):
    desk.take(Diagnosis("rig", alarm, CLOCK.monotonic_ns(), "shaft", 0, 64, "F1", severity=severity))


def state(desk, alarm):
    return desk.manager.alarms[alarm].state


async def told(desk):
    """What is on disk for the broker: alarm and level."""
    return [
        (payload["alarm"], payload["level"])
        for payload in (json.loads(message.payload) for message in await desk.outbox.pending(0, 1000))
    ]


async def test_the_ballast_makes_room_for_a_start(disk):
    """A box that was switched off with its disk full comes up with all that it knew."""
    store = disk.directory / "store"
    async with desk_in(store) as desk:
        find(desk, "rotor-fault", "danger")
    assert (store / "outbox.sqlite.ballast").stat().st_size == MIB // 2
    disk.fill()
    async with desk_in(store) as desk:
        assert desk.outbox.counters.shut == 0
        assert state(desk, "rotor-fault").is_active
        find(desk, "bearing-fault", "alert")
        await eventually(lambda: desk.outbox.counters.waiting == 0, "it is on disk")
        assert await told(desk) == [("rotor-fault", "danger"), ("bearing-fault", "alert")]
        disk.free()
    assert not (store / "outbox.sqlite.ballast").exists()


@pytest.mark.parametrize("trouble", ["full", "takes no writes", "new and full"])
async def test_without_room_the_alarms_are_watched_at_once_and_stored_later(disk, trouble, caplog):
    store = disk.directory / "store"
    if trouble != "new and full":
        async with desk_in(store, NO_BALLAST) as desk:
            find(desk, "rotor-fault", "danger")
            find(desk, "rotor-fault", "normal")  # and so it latches
        before = [("rotor-fault", "danger"), ("rotor-fault", "danger")]
    else:
        store.mkdir(mode=0o700)
        before = []
    disk.fill()
    if trouble == "takes no writes":
        disk.refuse_writes()
    async with desk_in(store, NO_BALLAST) as desk:
        assert desk.outbox.counters.shut == 1
        await eventually(lambda: "cannot be opened" in caplog.text, "it is said")
        step = desk.outbox.progress.step
        await eventually(lambda: desk.outbox.progress.step != step, "the writer gets on: no watchdog bites")
        if before:
            assert state(desk, "rotor-fault").is_latched, "what stood is known all the same"
        find(desk, "bearing-fault", "danger")
        assert state(desk, "bearing-fault").is_active
        await desk._look_at_disk()
        desk.tick()
        await eventually(lambda: desk.outbox.counters.write_errors > 2, "it is tried again")
        desk.tick()
        assert state(desk, "store/journal").is_active
        remedy = "mount it writable again" if trouble == "takes no writes" else "make room on the disk"
        assert desk._newest["rig", "store/journal"].message.endswith(remedy)
        if trouble == "takes no writes":
            disk.take_writes()
        disk.free()
        await eventually(lambda: not desk.outbox.counters.waiting, "there is room")
        assert desk.outbox.counters.shut == 0
        desk.tick()
        await desk.settle(2.0)
        on_disk = await told(desk)
        assert on_disk[: len(before) + 1] == [*before, ("bearing-fault", "danger")]
        assert desk.outbox.counters.lost == desk.outbox.counters.refused == 0
        assert "can be used again" in caplog.text


async def test_what_could_not_even_be_read_at_the_start_is_taken_over_later(tmp_path, monkeypatch, caplog):
    """The alarm that nobody has judged since stands as it stood; the other one stands as it does now."""
    async with desk_in(tmp_path / "store") as desk:
        for alarm in ALARMS:
            find(desk, alarm, "danger")
    fails = True
    for module, name in ((journal, "connect"), (reading, "_connect")):
        real = getattr(module, name)

        def broken(*arguments, real=real, **options):
            if fails:
                raise OSError(5, "Input/output error")
            return real(*arguments, **options)

        monkeypatch.setattr(module, name, broken)
    async with desk_in(tmp_path / "store") as desk:
        assert desk.outbox.counters.shut == 1
        assert "cannot be read yet" in caplog.text
        find(desk, "bearing-fault", "alert")
        assert state(desk, "rotor-fault") is AlarmState.NORMAL
        fails = False
        await eventually(lambda: not desk.outbox.counters.shut, "the disk answers again")
        await eventually(lambda: not desk.outbox.counters.waiting, "and takes what has waited")
        desk.tick()
        await eventually(lambda: state(desk, "rotor-fault").is_active, "it is taken over")
        assert desk.manager.alarms["bearing-fault"].level.label == "alert"
    async with desk_in(tmp_path / "store") as desk:
        assert desk.manager.alarms["rotor-fault"].level.label == "danger"
        assert desk.manager.alarms["bearing-fault"].level.label == "alert"


async def test_a_disk_that_takes_no_more_writes_ends_nothing_and_what_is_lost_is_said(disk, caplog):
    """Also at the stop: no traceback, and what is lost is said."""
    async with desk_in(disk.directory / "store") as desk:
        find(desk, "rotor-fault", "danger")
        await eventually(lambda: desk.outbox.counters.appended == 1, "it is on disk")
        used = desk.outbox._books.last_sequence
        # No remount while files are open for writing: every write fails all the same.
        disk.fill()
        for _ in range(40):
            find(desk, "bearing-fault", "danger")
            find(desk, "bearing-fault", "normal")
        big = desk.outbox.submit("big", lambda _: bytes(8 * MIB), retain=False)
        await eventually(lambda: desk.outbox.counters.write_errors > 1, "it cannot be written")
        there = await desk.outbox.pending(0, 1000)
        assert [message.stored for message in there if message.topic == "big"] == [False]
        assert there[0].sequence == used
    assert "Traceback" not in caplog.text
    assert isinstance(big.exception(), OutboxError)
    assert desk.outbox.counters.lost >= 1
    assert any(
        "lost" in record.getMessage() and "big (1)" in record.getMessage()
        for record in caplog.records
        if record.levelno == logging.ERROR
    )
    disk.free()
    async with desk_in(disk.directory / "store") as desk:
        numbers = [message.sequence for message in await desk.outbox.pending(0, 1000)]
        assert "big" not in {message.topic for message in await desk.outbox.pending(0, 1000)}
        assert await desk.outbox.append("t", lambda _: b"", retain=False) > max(there[-1].sequence, *numbers)


async def test_the_whole_service_watches_on_a_full_disk(disk):
    samples = np.sqrt(2.0) * np.sin(2 * np.pi * 50.0 * np.arange(4000) / 2000.0)
    machine = for_recording(
        Recording(("accel",), samples[:, None], 2000.0, "test", 0),
        "g",
        {"accel": (0.5, 3.0)},
        "mqtt://127.0.0.1:1",
    )
    disk.fill()
    async with running(machine, disk.directory / "store") as service:
        outbox = service.alarms.outbox
        assert outbox.counters.shut == 1
        await play(service, samples[:, None], 2000.0)
        await eventually(
            lambda: service.alarms.manager.alarms["vibration-accel"].state.is_active, "it is judged"
        )
        await eventually(lambda: service.alarms.manager.alarms["store/disk"].state.is_active, "it is said")
        disk.free()
        await eventually(lambda: not outbox.counters.waiting, "there is room")
        names = [json.loads(message.payload)["alarm"] for message in await outbox.pending(0, 100)]
        assert {"vibration-accel", "store/disk"} <= set(names)


async def test_what_a_start_cannot_mend_is_still_refused(tmp_path):
    (tmp_path / "file").write_text("not a directory")
    with pytest.raises(OutboxError, match="is no directory, but a file: name a directory in"):
        async with desk_in(tmp_path / "file"):
            pass
