"""What a bus loses, and a controller that goes off it, reach whoever takes the alarms."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

import pytest
from support.live_service import running
from support.machine_files import MACHINES
from support.waiting import PATIENCE_S, eventually

from daqsvc.alarms.states import Level
from daqsvc.settings import parse_machine_file
from drivers.can.errors import ErrorCounts
from drivers.frames import DecodedBatch
from drivers.serial import driver as serial_driver
from sim_hw.nodes.serial_node import PseudoTerminal

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.service import Service
    from drivers.can.driver import CanDriver

pytestmark = pytest.mark.integration
MOTOR = MACHINES / "motor-accelerometer.toml"
SERIAL = MACHINES / "serial-probes.toml"


def how(service: Service, alarm: str) -> tuple[Level, str]:
    status = service.alarms.manager.alarms[alarm]
    return status.level, status.message


async def test_an_overrun_and_a_bus_off_are_alarms_that_return(tmp_path: Path) -> None:
    text = MOTOR.read_text().replace('interface = "socketcan"', 'interface = "virtual"')
    machine = parse_machine_file(text.partition("[mqtt]")[0], MOTOR)
    async with running(machine, tmp_path / "store") as service:
        driver: CanDriver = service.drivers[0]  # type: ignore[assignment]
        service.alarms.tick()
        assert "bus-overrun/can0" not in service.alarms.manager.alarms, "nothing has happened"
        driver.accept(DecodedBatch(notes={"frames_overrun": 3}))
        driver.accept(DecodedBatch(errors=ErrorCounts({"bus_off": 1}, "bus-off")))
        service.alarms.tick()
        level, message = how(service, "bus-overrun/can0")
        assert level is Level.ALERT
        assert "what bus can0 carries is lost" in message
        assert how(service, "bus-controller/can0")[0] is Level.DANGER
        assert "bus-recording/can0" not in service.alarms.manager.alarms
        driver.counters.frames_unrecorded += 1
        service.alarms.tick()
        level, message = how(service, "bus-recording/can0")
        assert level is Level.ALERT
        assert "frames of bus can0 are missing from its recording" in message
        driver.accept(DecodedBatch(errors=ErrorCounts({"restarts": 1}, "error-active")))
        service.alarms.tick()
        assert how(service, "bus-controller/can0")[0] is Level.DANGER, "it has only just come back"


async def test_a_first_start_raises_no_alarm_of_silence_while_kernels_are_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = threading.Event()
    monkeypatch.setattr(serial_driver, "_warm", lambda *_: compiled.wait(PATIENCE_S))
    text = SERIAL.read_text().partition("[mqtt]")[0]
    for number, line in enumerate(line for line in text.splitlines() if line.startswith('port = "')):
        text = text.replace(line, f'port = "{tmp_path / str(number)}"')
    with PseudoTerminal(tmp_path / "0"), PseudoTerminal(tmp_path / "1"):
        async with running(parse_machine_file(text, SERIAL), tmp_path / "store") as service:
            alarms = service.alarms.manager.alarms
            await asyncio.sleep(3.5)  # longer than a stream of waveforms may be silent
            assert not [one for one in alarms.values() if one.level is not Level.NORMAL]
            compiled.set()
            await eventually(lambda: [one for one in alarms.values() if one.level is not Level.NORMAL])
