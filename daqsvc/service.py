"""The service: one machine file, one event loop, and everything that runs on it."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc import assembly, assembly_drivers
from daqsvc.acquisition.alignment import SETTLE_NS
from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from daqsvc.acquisition.ring import SampleRing
from daqsvc.alarm_desk import AlarmDesk
from daqsvc.assembly_alarms import alarm_handling, alarm_rules, identity
from daqsvc.assembly_alignment import alignment
from daqsvc.assembly_mqtt import mqtt_settings, sparkplug_settings
from daqsvc.assembly_store import outbox_limits
from daqsvc.assembly_streams import at_once, patience
from daqsvc.control import ControlError, ControlServer
from daqsvc.diagnosis.pipeline import Pipeline
from daqsvc.publish.payloads import diagnosis_payload, status_payload
from daqsvc.self_check import BusHealth
from daqsvc.settings.alignment import Grid
from drivers.can_errors import CanCounters

if TYPE_CHECKING:
    from collections.abc import Coroutine, Mapping, Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.publish.mqtt import MqttPublisher
    from daqsvc.settings.models import MachineFile
    from drivers.base import Driver

logger = logging.getLogger(__name__)

STATUS_EVERY_NS = NS_PER_S
LAG_EVERY_S = 0.01
LAG_REMEMBERED = 6000
SUSPENDED_S = 1.0
"""A loop that is later than this was not busy: the process was suspended, or the host starved it."""
RELEASE_S = 0.6
"""What drivers may take to let go of their buses."""
DRAIN_S = 0.3
"""What the pipeline may take to finish, and again what the disk may take for the events of it."""
GOODBYE_S = 0.5
"""What the broker may take to get the rest."""
CLOSE_S = 0.3
"""What the journal may take to close. All together: the two seconds in which the service promises to stop."""


class LoopLag:
    """How late the event loop gets round to things: a timer's lateness, every 10 ms for a minute.

    Attributes:
        suspensions: how often it stood still for longer than `SUSPENDED_S`.
    """

    def __init__(self) -> None:
        self.suspensions = 0
        self._late_s: deque[float] = deque(maxlen=LAG_REMEMBERED)

    async def watch(self) -> None:
        """Measure until cancelled; real time, whatever clock the samples have."""
        loop = asyncio.get_running_loop()
        while True:
            due_s = loop.time() + LAG_EVERY_S
            await asyncio.sleep(LAG_EVERY_S)
            late_s = loop.time() - due_s
            self._late_s.append(late_s)
            if late_s > SUSPENDED_S:
                self.suspensions += 1
                logger.warning(
                    "the process stood still for %.1f s (suspended, or starved by the host); samples that no "
                    "buffer could hold meanwhile are counted as lost",
                    late_s,
                )

    def forget(self) -> None:
        """Begin the figures anew."""
        self._late_s.clear()

    def figures_ms(self) -> dict[str, float]:
        """Median, 99th percentile and maximum of the lateness, in ms."""
        if not self._late_s:
            return {"p50": 0.0, "p99": 0.0, "max": 0.0}
        late_ms = 1000.0 * np.fromiter(self._late_s, np.float64)
        p50, p99 = np.percentile(late_ms, [50, 99])
        return {"p50": float(p50), "p99": float(p99), "max": float(late_ms.max())}


class Service:
    """Acquires, diagnoses and tells, as a machine file says.

    Args:
        machine: the machine file.
        store: directory of the journal.
        clock: the service's clock.

    Raises:
        AssemblyError: the machine file asks for a driver that is not installed.
        LayoutError: a DBC file does not hold what the machine file says.
    """

    def __init__(self, machine: MachineFile, store: Path, clock: Clock | None = None) -> None:
        self.machine = machine
        self.clock: Clock = clock or SystemClock()
        self.lag = LoopLag()
        self.ready = asyncio.Event()
        self._identity = identity(machine)
        detectors = assembly.detectors(machine, store)
        grids = [*(Grid({name: stream}) for name, stream in machine.streams.items()), *machine.grids]
        self.rings = {grid.name: _ring(machine, grid, detectors) for grid in grids}
        self.alignment = alignment(machine, self.clock, self._deliver)
        self.drivers: list[Driver] = assembly_drivers.drivers(machine, self.clock, self._deliver)
        settling_ns = {aligner.name: SETTLE_NS for aligner in self.alignment.aligners}
        self.pipeline = Pipeline(
            self.rings,
            detectors,
            self._report,
            self.clock,
            settling_ns=settling_ns,
            patience={grid.name: patience(machine, grid.name, grid.rate_hz) for grid in grids},
        )
        self.desk = AlarmDesk(
            self._identity,
            alarm_rules(machine),
            store,
            self.clock,
            mqtt_settings(machine),
            handling=alarm_handling(machine),
            limits=outbox_limits(machine),
            sparkplug=sparkplug_settings(machine, store),
            buses={name: bus.driver for name, bus in machine.buses.items()},
            bus_health=self._bus_health,
        )
        self.control = ControlServer(
            store, machine.machine.name, self.desk.obey, lambda: self.desk.outbox.counters.waiting
        )

    @property
    def publisher(self) -> MqttPublisher | None:
        """The way to the broker; None if the machine file has none."""
        return self.desk.publisher

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set; then hand over what is under way and end within two seconds.

        Raises:
            OutboxError: the journal's directory cannot be used.
            DeviceAbsentError: a device is absent whose bus has ``start = "error"``.
        """
        starting = self._task(self._start(), "start")
        stopped = self._task(stop.wait(), "stop")
        try:
            # Opening a disk and compiling kernels may take long; a stop does not wait for them.
            await asyncio.wait({starting, stopped}, return_when=asyncio.FIRST_COMPLETED)
            if starting.done():
                starting.result()
                await self._serve(stopped)
        finally:
            await _cancel([starting, stopped], DRAIN_S)
            await self.control.close()
            await self.desk.close(CLOSE_S)

    async def _start(self) -> None:
        await self.desk.open()
        await self.pipeline.warm()
        await self._resume()
        try:
            await self.control.open()
        except ControlError as error:
            # Watching the machine matters more than being told what to do.
            logger.error("no commands on this box: %s", error)  # noqa: TRY400 - the message says it all

    async def _resume(self) -> None:
        """Take over from the journal how the alarms stood when the service ended."""
        now_ns = self.clock.monotonic_ns()
        said = [s for detector in self.pipeline.detectors for s in detector.silent(0.0, now_ns)]
        await self.desk.resume({s.detector: s.sensors for s in said})

    async def _serve(self, stopped: asyncio.Task[Any]) -> None:
        helpers = [
            self._task(self.lag.watch(), "loop lag"),
            self._task(self._tell_status(), "status"),
            self._task(self.desk.keep_time(), "alarm times"),
        ]
        publishing = None if self.publisher is None else self._task(self.desk.run(), "mqtt")
        pipeline = self._task(self.pipeline.run(), "pipeline")
        reading = [self._task(driver.run(), f"driver {driver.name}") for driver in self.drivers]
        everything = [*helpers, *reading, pipeline, stopped, *([publishing] if publishing else [])]
        try:
            self.ready.set()
            await self._until_stopped(stopped, everything)
        finally:
            await self.control.close()
            await _cancel(reading, RELEASE_S)
            for ring in self.rings.values():
                ring.close()
            await asyncio.wait([pipeline], timeout=DRAIN_S)
            await self.desk.settle(DRAIN_S)
            self._publish_status()
            await self.desk.stop(GOODBYE_S)
            await _cancel(everything, DRAIN_S)

    async def _until_stopped(self, stopped: asyncio.Task[Any], tasks: list[asyncio.Task[Any]]) -> None:
        waiting = set(tasks)
        while not stopped.done():
            done, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                # A driver that is to be ignored if absent may end; nothing may fail unheard.
                task.result()

    @staticmethod
    def _task(work: Coroutine[Any, Any, Any], name: str) -> asyncio.Task[Any]:
        return asyncio.create_task(work, name=name)

    def _deliver(self, block: SampleBlock) -> None:
        self.rings[block.stream].write(block)
        self.alignment.accept(block)

    def _report(self, diagnosis: Diagnosis) -> None:
        self.desk.take(diagnosis)
        if self.publisher is not None:
            payload = diagnosis_payload(self._identity, diagnosis, self.clock).to_json()
            self.publisher.telemetry(f"{self.machine.machine.name}/diagnosis/{diagnosis.detector}", payload)

    def _bus_health(self) -> dict[str, BusHealth]:
        found: dict[str, BusHealth] = {}
        for driver in self.drivers:
            counters = driver.counters
            found[driver.name] = (
                BusHealth(
                    counters.overruns, counters.bus_off, counters.controller_state, counters.frames_unrecorded
                )
                if isinstance(counters, CanCounters)
                else BusHealth(counters.overruns, counters.bus_off, None)
            )
        return found

    async def _tell_status(self) -> None:
        while True:
            await self.clock.sleep_ns(STATUS_EVERY_NS)
            self._publish_status()

    def _publish_status(self) -> None:
        if self.desk.sparkplug is not None:
            self.desk.sparkplug.reach(there=any(driver.link.state == "up" for driver in self.drivers))
        if self.publisher is not None:
            payload = status_payload(self.machine.site, self.machine.box, self.figures(), self.clock)
            self.publisher.telemetry("status", payload.to_json())

    def figures(self) -> dict[str, Any]:
        """The service's figures by what they belong to: streams, buses, detectors, alarms, outbox, MQTT."""
        streams: dict[str, Mapping[str, float]] = {}
        buses: dict[str, Mapping[str, Any]] = {}
        for driver in self.drivers:
            counted = asdict(driver.counters)
            up = int(driver.link.state == "up")
            buses[driver.name] = {"up": up, "losses": driver.link.losses, **counted}
            for name, (counters, base) in driver.streams.items():
                ring = self.rings[name]
                streams[name] = {
                    **asdict(counters),
                    "drift_ppm": base.drift_ppm,
                    "jitter_ms": base.jitter_ns / 1e6,
                    "time_settled": int(base.settled),
                    "counter_restarts": base.restarts,
                    "end_index": ring.end_index,
                }
        return {
            "streams": streams,
            "buses": buses,
            "grids": self.alignment.figures(),
            "detectors": {name: asdict(c) for name, c in self.pipeline.counters.items()},
            "loop_lag_ms": self.lag.figures_ms(),
            "suspensions": self.lag.suspensions,
            "alarms": self.desk.figures(),
            "commands": asdict(self.desk.commands),
            "control": asdict(self.control.counters),
            "outbox": asdict(self.desk.outbox.counters),
            "mqtt": {} if self.publisher is None else self.publisher.figures(),
            "sparkplug": {} if self.desk.sparkplug is None else asdict(self.desk.sparkplug.counters),
        }


def _ring(machine: MachineFile, grid: Grid, detectors: Sequence[Detector]) -> SampleRing:
    wanted = round(machine.pipeline.ring_s * grid.rate_hz)
    # However short a ring is asked for, a detector must find its block in it, and some time to come for it.
    needed = max((4 * d.block for d in detectors if d.stream == grid.name), default=1)
    needed = max(needed, 2 * at_once(machine, grid.name))
    return SampleRing(grid.name, grid.channel_names, max(wanted, needed))


async def _cancel(tasks: list[asyncio.Task[Any]], patience_s: float) -> None:
    running = {task for task in tasks if not task.done()}
    if not running:
        return
    for task in running:
        task.cancel()
    ended, hanging = await asyncio.wait(running, timeout=patience_s)
    for task in ended:
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.error("%s failed while the service stopped", task.get_name(), exc_info=error)
    for task in hanging:
        logger.error("%s does not stop within %g s and is left behind", task.get_name(), patience_s)
