"""Alarms over a restart of the service: nothing is raised twice, nothing stays active for ever."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.brokers import Consumer
from support.live_service import play, running
from support.ports import free_port
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.outbox.store import Outbox
from daqsvc.recording.recording import Recording
from sim_hw.demo.broker import EmbeddedBroker
from sim_hw.demo.machines import for_recording

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.service import Service
    from daqsvc.settings import MachineFile

pytestmark = pytest.mark.integration
RATE_HZ = 2000.0
LOUD, QUIET = 1.0, 0.1
ALARM = "vibration-accel"


def noise(rms: float) -> np.ndarray[Any, Any]:
    return rms * np.random.default_rng(0).normal(size=(round(RATE_HZ), 1))


def machine(port: int, **alarm: Any) -> MachineFile:
    recording = Recording(("accel",), noise(LOUD), RATE_HZ, __file__, 0)  # type: ignore[arg-type]
    made = for_recording(recording, "g", {"accel": (0.5, 5.0)}, f"mqtt://127.0.0.1:{port}")
    return made.model_copy(update={"alarms": [made.alarms[0].model_copy(update=alarm)]})


async def shake(service: Service, rms: float) -> None:
    """Play a second of noise."""
    await play(service, noise(rms), RATE_HZ)


async def heard(service: Service, alarm: str, state: str) -> None:
    def is_so() -> bool:
        status = service.alarms.manager.alarms.get(alarm)
        return (
            status is not None and status.state.value == state and not service.alarms.outbox.counters.waiting
        )

    await eventually(is_so, f"{alarm} is {state}")


async def journal(store: Path) -> list[dict[str, Any]]:
    """All that was said and never reached a broker."""
    outbox = Outbox(store / "outbox.sqlite", SystemClock())
    await outbox.open()
    try:
        return [json.loads(message.payload) for message in await outbox.pending(0, 1000)]
    finally:
        await outbox.close()


def of(told: list[dict[str, Any]], alarm: str) -> list[dict[str, Any]]:
    return [event for event in told if event["alarm"] == alarm]


async def test_what_cleared_while_the_service_was_dead_does_not_stay_active_at_the_broker(
    tmp_path: Path,
) -> None:
    killed = tmp_path / "killed"
    async with EmbeddedBroker() as broker:
        file = machine(broker.port)
        async with running(file, tmp_path / "first") as service:
            await shake(service, LOUD)
            await heard(service, ALARM, "active_unacknowledged")
            # What a kill leaves: the journal as it is in the midst of things, without any goodbye.
            shutil.copytree(tmp_path / "first", killed, ignore=shutil.ignore_patterns("control.sock"))
        async with running(file, killed) as service:
            await shake(service, QUIET)
            await heard(service, ALARM, "returned_unacknowledged")
            await eventually(lambda: service.alarms.outbox.counters.depth == 0, "the broker has it all")
        async with Consumer(broker.port) as late:
            await eventually(lambda: late.on(f"/alarms/{ALARM}"), "the retained state comes")
            (state,) = late.on(f"/alarms/{ALARM}")
    assert state.payload["kind"] == "returned"
    assert state.payload["previous"] == {"state": "active_unacknowledged", "level": "alert"}


@pytest.mark.long
async def test_a_latching_alarm_keeps_its_occurrence_over_restarts(tmp_path: Path) -> None:
    file = machine(free_port(), latching=True)
    async with running(file, tmp_path) as service:
        await shake(service, LOUD)
        await heard(service, ALARM, "active_unacknowledged")
    async with running(file, tmp_path) as service:
        await shake(service, LOUD)
        await shake(service, QUIET)
        await heard(service, ALARM, "latched_unacknowledged")
    async with running(file, tmp_path) as service:
        await heard(service, ALARM, "latched_unacknowledged")
        await shake(service, LOUD)
        await heard(service, ALARM, "active_unacknowledged")
    told = of(await journal(tmp_path), ALARM)
    assert [event["kind"] for event in told] == ["raised", "latched", "recurred"]
    assert len({event["occurrence"] for event in told}) == 1
    assert told[2]["previous"]["state"] == "latched_unacknowledged"


@pytest.mark.long
async def test_a_sensor_that_came_back_while_the_service_was_down_is_told(tmp_path: Path) -> None:
    file = machine(free_port())
    async with running(file, tmp_path) as service:
        await heard(service, "sensor-ok/accel", "active_unacknowledged")
    async with running(file, tmp_path) as service:
        assert service.alarms.manager.alarms["sensor-ok/accel"].state.is_active
        # What was missing before the restart is good again when that has lasted for some seconds.
        await play(service, np.tile(noise(QUIET), (6, 1)), RATE_HZ)
        await heard(service, "sensor-ok/accel", "returned_unacknowledged")
    told = of(await journal(tmp_path), "sensor-ok/accel")
    # The bus may fall silent again before the service has stopped.
    assert [event["kind"] for event in told][:2] == ["raised", "returned"]
    assert told[0]["occurrence"] == told[1]["occurrence"]


async def test_an_alarm_that_the_machine_file_no_longer_has_is_returned(tmp_path: Path) -> None:
    name, port = "shaking", free_port()
    async with running(machine(port), tmp_path) as service:
        await shake(service, LOUD)
        await heard(service, ALARM, "active_unacknowledged")
    for _ in range(2):
        async with running(machine(port, name=name), tmp_path) as service:
            assert set(service.alarms.manager.alarms) == {name}
    told = of(await journal(tmp_path), ALARM)
    assert [event["kind"] for event in told] == ["raised", "returned"]
    assert told[1]["state"] == told[1]["level"] == "normal"
    assert told[1]["occurrence"] == told[0]["occurrence"]
    assert "the machine file no longer has it" in told[1]["message"]
