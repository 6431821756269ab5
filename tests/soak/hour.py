"""An hour of a machine's time in some minutes: does the whole service, in this process, take more and more?

The clock of the service is driven, as in the demo: a device sends as fast as its samples are judged. Alarms
come and go all the while, and go to a broker.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import can
import numpy as np
from nothing_lost.broker import Broker
from soak.figures import Trend, lowest, rss_bytes
from support.live_service import running, watch_of
from support.machine_files import LAVAL

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from daqsvc.commands.start_memory import share_heaps
from daqsvc.settings import parse_machine_file
from drivers.can.plugin import frame_layout

if TYPE_CHECKING:
    from daqsvc.service import Service

RATE_HZ, SPEED_HZ = 640.0, 10.0
STEP_FRAMES = 8
PATIENCE_S = 300.0
CALM_UM, LOUD_UM, TURN_S = 15.0, 90.0, 2.5
"""The shaft whirls so far, and the other way every so many seconds."""
WARM_UP = 1 / 2
"""Of the time: rings, queues and the cache of the journal fill, and all has happened many times."""
TEXT = LAVAL.read_text().replace('interface = "socketcan"', 'interface = "virtual"').partition("[mqtt]")[0]
assert "chatter_raises = 5" in TEXT
TEXT = TEXT.replace("chatter_raises = 5", "chatter_raises = 0")
MQTT = '\n[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\ninsecure = true\n'


@dataclass(frozen=True)
class Outcome:
    """What came of it.

    Attributes:
        violations: what was not kept, a sentence each.
        machine_s: how much time has passed for the machine.
        real_s: and how much in the world.
        samples: that were received.
        lost: that were not.
        windows: judged by all detectors.
        events: of alarms.
        memory: of the process, by the machine's time.
    """

    violations: list[str]
    machine_s: float
    real_s: float
    samples: int
    lost: int
    windows: int
    events: int
    memory: str


class Device:
    """A shaft that whirls, and a device that sends where it is."""

    def __init__(self, service: Service, bus: can.BusABC, clock: DrivenClock) -> None:
        self._watch, self._driver, self._bus, self._clock = watch_of(service), service.drivers[0], bus, clock
        self._layout = frame_layout(self._watch.machine, "shaft")
        self.sent = 0
        self._begun_ns = clock.monotonic_ns()

    @property
    def machine_s(self) -> float:
        """Time that it has sampled for."""
        return self.sent / RATE_HZ

    @property
    def received(self) -> int:
        """Samples that came over the bus."""
        return self._driver.streams["shaft"][0].samples_received

    @property
    def behind(self) -> int:
        """Samples that are on the bus, or not judged yet."""
        return self.sent - self.received + self._watch.pipeline.behind_samples

    async def step(self) -> None:
        """Send some frames, and let the service follow.

        Raises:
            TimeoutError: it does not.
        """
        per_frame = self._layout.samples_per_frame
        first = self.sent + per_frame * np.arange(STEP_FRAMES)
        self.sent += STEP_FRAMES * per_frame
        turns = (first[:, None] + np.arange(per_frame)) * (SPEED_HZ / RATE_HZ)
        loud = int(turns[0, 0] / SPEED_HZ / TURN_S) % 2
        whirl = LOUD_UM if loud else CALM_UM
        xy = [whirl * np.cos(2 * np.pi * turns), whirl * np.sin(2 * np.pi * turns) - 10.0]
        samples = np.stack([*xy, np.where(turns % 1 < 0.1, -2.0, -10.0)], axis=2)
        self._clock.advance_to(self._begun_ns + round(self.sent * NS_PER_S / RATE_HZ))
        for row in self._layout.encode(first, samples):
            data = row.tobytes()
            self._bus.send(
                can.Message(arbitration_id=self._layout.frame_id, is_extended_id=False, is_fd=True, data=data)
            )
        until_s = time.monotonic() + PATIENCE_S
        limit = 2 * max(detector.block for detector in self._watch.pipeline.detectors)
        await asyncio.sleep(0)
        while self.behind > limit + STEP_FRAMES * per_frame:
            if time.monotonic() > until_s:
                raise TimeoutError(f"the service has been {self.behind} samples behind for {PATIENCE_S:g} s")
            await asyncio.sleep(0.0005)


async def pass_time(machine_s: float, folder: Path) -> Outcome:
    """Let so much of the machine's time pass.

    Args:
        machine_s: how much.
        folder: an empty one.
    """
    broker = Broker("mosquitto", folder, dict(os.environ), verbose=False)
    clock = DrivenClock()
    machine = parse_machine_file(TEXT + MQTT.format(port=broker.port), LAVAL)
    violations: list[str] = []
    await broker.start()
    try:
        async with running(machine, folder / "store", clock) as service:
            connected = lambda: service.figures()["mqtt"]["connected"]  # noqa: E731
            while not (service.drivers[0].link.state == "up" and connected()):
                await asyncio.sleep(0.01)
            channel = machine.buses["can0"].model_dump()["channel"]
            begun_s, readings, at_first = time.monotonic(), [], None
            with can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD) as bus:
                device = Device(service, bus, clock)
                while device.machine_s < machine_s:
                    await device.step()
                    if device.machine_s > WARM_UP * machine_s:
                        at_first = at_first or await lowest(os.getpid())
                        if not readings or device.machine_s - readings[-1][0] >= machine_s / 1000:
                            readings.append((device.machine_s, rss_bytes(os.getpid())))
                await _settled(device)
                at_last = await lowest(os.getpid())
            real_s = time.monotonic() - begun_s
            figures = service.figures()
    finally:
        await broker.kill()
    memory = Trend.of(readings)
    violations += memory.violations()
    if at_first is None or (different := at_last.against(at_first)):
        violations.append(f"the process has {different if at_first else 'not been watched'}")
    stream, events = figures["streams"]["shaft"], figures["alarms"]["events"]
    if stream["samples_received"] != device.sent or stream["samples_lost"]:
        violations.append(
            f"{device.sent} samples were sent, {stream['samples_received']} received and "
            f"{stream['samples_lost']} lost"
        )
    if events < machine_s / TURN_S:
        violations.append(
            f"there were {events} alarm events; the shaft has changed {machine_s / TURN_S:.0f} times"
        )
    detectors: dict[str, Any] = figures["detectors"]
    for name, detector in detectors.items():
        if detector["samples_skipped"] or detector["failures"]:
            violations.append(f"{name} has skipped samples or failed: {detector}")
    windows = sum(detector["windows"] for detector in detectors.values())
    return Outcome(
        violations,
        device.machine_s,
        real_s,
        stream["samples_received"],
        stream["samples_lost"],
        windows,
        events,
        f"{memory}",
    )


async def _settled(device: Device) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while device.received < device.sent and time.monotonic() < until_s:
        await asyncio.sleep(0.01)


def main() -> int:
    parser = argparse.ArgumentParser(prog="soak.hour", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0, help="of the machine's time")
    arguments = parser.parse_args()
    share_heaps()  # as `daqsvc run` does
    with tempfile.TemporaryDirectory(prefix="soak-hour-") as folder:
        outcome = asyncio.run(pass_time(arguments.seconds, Path(folder)))
    print(json.dumps(asdict(outcome)))
    return 1 if outcome.violations else 0


if __name__ == "__main__":
    sys.exit(main())
