"""The whole chain as separate processes: simulated devices, vcan, service, broker."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.brokers import Consumer, running_mosquitto

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from support.vcan_links import VcanLink

CONFIG = Path(__file__).parents[2] / "config"
MOTOR = CONFIG / "machines" / "motor-accelerometer.toml"
RIG = CONFIG / "machines" / "virtual-rig.toml"
BEARING_DAMAGE = CONFIG / "scenarios" / "bearing-damage.toml"
RATE_HZ = 12_000
PLAYED_S = 5.0
PATIENCE_S = 60.0
LEAST_FAULTS = 5

BAD_LINK = """
title = "A healthy rotor on a bad link"
revolutions = 50.0
[plant]
kind = "rotor"
[[fault]]
kind = "link"
from_s = 0.5
to_s = 4.0
drop = 0.1
duplicate = 0.1
corrupt = 0.1
[[fault]]
kind = "delay"
from_s = 1.0
to_s = 3.0
delay_ms = 2.0
jitter_ms = 3.0
[[fault]]
kind = "silence"
from_s = 4.2
to_s = 4.5
[[fault]]
kind = "babble"
from_s = 2.0
to_s = 3.0
rate_hz = 200.0
"""


@contextlib.asynccontextmanager
async def service(machine: Path, store: Path) -> AsyncIterator[asyncio.subprocess.Process]:
    """``daqsvc run``, stopped at the end as systemd stops it."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "daqsvc", "run", str(machine), "--store", str(store)
    )
    try:
        yield process
        process.send_signal(signal.SIGTERM)
        async with asyncio.timeout(20):
            assert await process.wait() == 0
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()


async def simulate(machine: Path, stream: str, *arguments: object) -> dict[str, Any]:
    """``daqsvc sim`` of one stream; returns what it says that it sent."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "daqsvc", "sim", str(machine), "--stream", stream, *map(str, arguments)),
        stdout=asyncio.subprocess.PIPE,
    )
    output, _ = await process.communicate()
    assert process.returncode == 0
    summary = json.loads(output)
    assert summary["complete"]
    sent: dict[str, Any] = summary["streams"][stream]
    assert sent["frames_unsent"] == 0
    return sent


async def cansend(channel: str, *frames: str) -> None:
    for frame in frames:
        process = await asyncio.create_subprocess_exec("cansend", channel, frame)
        assert await process.wait() == 0


async def eventually(found: Callable[[], Any], what: str, seen: Callable[[], Any]) -> Any:
    """What ``found`` returns once it is true."""
    try:
        async with asyncio.timeout(PATIENCE_S):
            while not (result := found()):
                await asyncio.sleep(0.1)
            return result
    except TimeoutError:
        pytest.fail(f"not within {PATIENCE_S:g} s: {what}; last seen {seen()}")


class Listener:
    """What the service says of itself."""

    def __init__(self, consumer: Consumer) -> None:
        self._consumer = consumer

    def status(self) -> dict[str, Any]:
        """The newest figures."""
        found = self._consumer.on("/status")
        return found[-1].payload["figures"] if found else {}

    def levels(self, alarm: str) -> list[str]:
        """Every level that an alarm was told at."""
        return [m.payload["level"] for m in self._consumer.on("/alarm") if m.payload["alarm"] == alarm]

    async def until(self, true: Callable[[dict[str, Any]], object], what: str) -> dict[str, Any]:
        """The first figures of which something is true."""

        def found() -> dict[str, Any] | None:
            figures = self.status()
            return figures if figures and true(figures) else None

        figures: dict[str, Any] = await eventually(found, what, self.status)
        return figures


def machine_text(channel: str, port: int) -> str:
    """The motor with a second accelerometer on its housing, and the probes of the rig, on one bus."""
    motor, rig = MOTOR.read_text(), RIG.read_text()
    stream = motor[motor.index("[streams.drive-end]") : motor.index("[[sensors]]")]
    housing = stream.replace("drive-end", "housing").replace("0x110", "0x111").replace('"de"', '"h"')
    sensor = motor[motor.index("[[sensors]]") : motor.index("[pipeline]")]
    second = sensor.replace("drive-end", "housing").replace("accel-de", "accel-h").replace('"de"', '"h"')
    shaft = rig[rig.index("[streams.shaft]") : rig.index("[pipeline]")]
    # Unfiltered, for the babbling node to be seen.
    motor = motor.replace("fd = true", "fd = true\nfilter = false")
    motor = motor.replace('channel = "can0"', f'channel = "{channel}"').replace(
        "127.0.0.1:1883", f"127.0.0.1:{port}"
    )
    return f"{motor}\n{housing}\n{second}\n{shaft}"


@pytest.mark.timeout(200)
async def test_what_the_devices_send_is_what_the_service_has(vcan: VcanLink, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    # Far above the alarm's setpoint, so that the chain is used to its end.
    np.savez(tmp_path / "motor.npz", de=rng.normal(0.0, 1.0, int(PLAYED_S * RATE_HZ)))
    (tmp_path / "bad-link.toml").write_text(BAD_LINK)
    machine = tmp_path / "machine.toml"
    with running_mosquitto(tmp_path) as broker:
        machine.write_text(machine_text(vcan.name, broker.port))
        async with Consumer(broker.port) as consumer, service(machine, tmp_path / "store"):
            listener = Listener(consumer)
            await listener.until(lambda f: f["buses"]["can0"]["up"] == 1, "the bus is up")
            recording, bearing, shaft = await asyncio.gather(
                simulate(
                    machine,
                    "drive-end",
                    *("--recording", tmp_path / "motor.npz", "--map", "accel-de=de", "--fs", RATE_HZ),
                ),
                simulate(machine, "housing", "--scenario", BEARING_DAMAGE, "--duration", PLAYED_S),
                simulate(machine, "shaft", "--scenario", tmp_path / "bad-link.toml", "--seed", 5),
            )
            sent = {"drive-end": recording, "housing": bearing, "shaft": shaft}
            assert recording["samples_sent"] == bearing["samples_sent"] == PLAYED_S * RATE_HZ
            injected = shaft["injected"]

            def all_there(figures: dict[str, Any]) -> bool:
                every = [(figures["streams"][name], sent[name]["samples_sent"]) for name in sent]
                return all(s["samples_received"] + s["samples_lost"] >= n for s, n in every)

            figures = await listener.until(all_there, f"every sample stored or counted as lost, of {sent}")
            streams, bus = figures["streams"], figures["buses"]["can0"]
            for name, said in sent.items():
                assert (
                    streams[name]["samples_received"] + streams[name]["samples_lost"] == said["samples_sent"]
                )
                assert streams[name]["frames_rejected"] == streams[name]["frames_late"] == 0
            assert bus["frames_overrun"] == 0
            assert streams["drive-end"]["samples_lost"] == streams["housing"]["samples_lost"] == 0
            for fault in ("dropped", "duplicated", "corrupted", "silenced"):
                assert injected[fault] >= LEAST_FAULTS, fault
            lost = injected["dropped"] + injected["corrupted"] + injected["silenced"]
            assert streams["shaft"]["samples_lost"] == 10 * lost
            assert streams["shaft"]["frames_corrupt"] == injected["corrupted"]
            assert streams["shaft"]["frames_duplicate"] == injected["duplicated"]
            assert bus["frames_unknown"] == injected["babbled"] > 0
            assert "danger" in listener.levels("drive-end-rms")

            await _error_frames_are_the_health_of_the_bus(vcan.name, listener)


async def _error_frames_are_the_health_of_the_bus(channel: str, listener: Listener) -> None:
    # CAN_ERR_CRTL: the controller's buffer has overflowed; it has seen more than 127 receive errors.
    await cansend(channel, "20000004#0001000000000000", "20000204#0010000000000786")
    await eventually(
        lambda: (
            listener.levels("bus-overrun/can0") == ["alert"]
            and listener.levels("bus-controller/can0") == ["alert"]
        ),
        "the overrun and the error-passive controller are alarms",
        listener.status,
    )
    await cansend(channel, "20000040#0000000000000000")  # CAN_ERR_BUSOFF
    await listener.until(lambda f: f["buses"]["can0"]["up"] == 0, "bus-off takes the bus down")
    await eventually(
        lambda: listener.levels("bus-controller/can0") == ["alert", "danger"],
        "it is an alarm, too, which is looked at once a second",
        listener.status,
    )
    await cansend(channel, "20000100#0000000000000000")  # CAN_ERR_RESTARTED
    figures = await listener.until(lambda f: f["buses"]["can0"]["up"] == 1, "the controller has restarted")
    bus = figures["buses"]["can0"]
    assert (bus["rx_overflows"], bus["error_passives"], bus["bus_off"], bus["restarts"]) == (1, 1, 1, 1)
    assert (bus["tx_errors"], bus["rx_errors"]) == (7, 0x86)
    assert (bus["controller_state"], bus["frames_error"], bus["losses"]) == ("error-active", 4, 1)
