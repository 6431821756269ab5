"""The service: one machine file, one event loop, and everything that runs on it."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from daqsvc.acquisition.alignment import SETTLE_NS
from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from daqsvc.acquisition.ring import SampleRing
from daqsvc.acquisition.standing import StreamState
from daqsvc.alarm_service import AlarmService
from daqsvc.alarms.events import Identity
from daqsvc.alarms.make import alarm_rule
from daqsvc.control import ControlError, ControlServer
from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.pipeline import Pipeline
from daqsvc.diagnosis.snapshots import alignment, at_once, patience
from daqsvc.diagnosis.statements import said_of_silence
from daqsvc.driver_reports import DriverReports
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.publish.make import output_plugins, output_set
from daqsvc.publish.output import output_name
from daqsvc.publish.payloads import Figures
from daqsvc.self_check import BusHealth, conditions
from daqsvc.settings.streams import Grid
from daqsvc.status_report import StatusReport
from daqsvc.supervision import EssentialLostError, Progress, Supervisor, over, stop_all
from daqsvc.threads import CallThreads
from drivers.base import DeviceAbsentError
from drivers.make import bus_drivers, bus_self_checks

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.record import Diagnosis
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
STOP_S = 1.3
"""What all of these may take together, ..."""
CLOSE_S = 0.3
"""... and then the journal to close: within the two seconds in which the service promises to stop."""


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
        on_ending: called when the service begins to end, for whatever reason.
        runtime: directory for the control socket, if not the store.

    Raises:
        AssemblyError: the machine file asks for a driver that is not installed.
        LayoutError: a DBC file does not hold what the machine file says.
    """

    def __init__(
        self,
        machine: MachineFile,
        store: Path,
        clock: Clock | None = None,
        on_ending: Callable[[], None] = lambda: None,
        runtime: Path | None = None,
    ) -> None:
        self.machine = machine
        self.clock: Clock = clock or SystemClock()
        self.lag = LoopLag()
        self.ready = asyncio.Event()
        self.supervisor = Supervisor()
        self._on_ending = on_ending
        self._identity = Identity(machine.site, machine.box, machine.machine.name)
        watching = detectors(machine, store)
        grids = [*(Grid({name: stream}) for name, stream in machine.streams.items()), *machine.grids]
        self._grids = grids
        self._standings = dict.fromkeys(machine.streams, StreamState())
        self.rings = {grid.name: _ring(machine, grid, watching) for grid in grids}
        self.alignment = alignment(machine, self.clock, self._deliver)
        self.drivers: list[Driver] = bus_drivers(machine, self.clock, self._deliver, self._stand)
        self.driver_reports = [
            DriverReports(
                name,
                driver,
                [s for s, stream in machine.streams.items() if stream.bus == name],
                self.supervisor,
            )
            for name, driver in zip(machine.buses, self.drivers, strict=True)
        ]
        settling_ns = {aligner.name: SETTLE_NS for aligner in self.alignment.aligners}
        self.pipeline = Pipeline(
            self.rings,
            watching,
            self._report,
            self.clock,
            settling_ns=settling_ns,
            patience={grid.name: patience(machine, grid.name, grid.rate_hz) for grid in grids},
            supervisor=self.supervisor,
            fall_silent=self._fall_silent,
            why_over=self._why_over,
        )
        self.alarms = AlarmService(
            self._identity,
            [alarm_rule(alarm) for alarm in machine.alarms],
            store,
            self.clock,
            output_set(machine, conditions(bus_self_checks(machine))),
            handling=machine.alarm_handling,
            limits=OutboxLimits.of(machine.store),
            buses=bus_self_checks(machine),
            bus_health=self._bus_health,
            supervisor=self.supervisor,
            progress=self.progress,
        )
        self.report = StatusReport(
            machine, self.clock, self.rings, self.driver_reports, self.alarms, self.figures
        )
        self.control = ControlServer(
            store,
            machine.machine.name,
            self.alarms.execute,
            lambda: self.alarms.outbox.counters.waiting,
            runtime,
            self.report.line,
        )

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set; then hand over what is under way and end within two seconds.

        Blocking calls get threads of their own from here on; the end of the process waits for none of them.

        Raises:
            OutboxError: the journal's directory cannot be used.
            DeviceAbsentError: a device is absent whose bus has ``start = "error"``.
            EssentialLostError: the journal's writer is gone, or the start was cancelled.
        """
        asyncio.get_running_loop().set_default_executor(CallThreads())
        with self.supervisor.hearing():
            starting = asyncio.create_task(self._start(), name="start")
            try:
                # Opening a disk and compiling kernels may take long; a stop does not wait for them.
                await self._until_stopped(stop, starting)
                if starting.cancelled():
                    raise EssentialLostError(
                        "the start of the service was cancelled by something in its process"
                    )
                if starting.done():
                    starting.result()
                    await self._serve(stop)
            finally:
                starting.cancel()
                await asyncio.wait({starting}, timeout=DRAIN_S)
                await self.control.close()
                await self.alarms.close(CLOSE_S)

    async def _start(self) -> None:
        await self.alarms.open()
        await self.pipeline.warm()
        await self._resume()
        try:
            await self.control.open()
        except ControlError as error:
            # Watching the machine matters more than being told what to do.
            logger.error("no commands on this box until this is mended: %s", error)  # noqa: TRY400

    async def _resume(self) -> None:
        """Take over from the journal how the alarms stood when the service ended."""
        now_ns = self.clock.monotonic_ns()
        active_detectors: dict[str, Sequence[str]] = {}
        for detector in self.pipeline.detectors:
            with self.supervisor.sparing_others(f"detector {detector.name}", "its alarms begin anew"):
                active_detectors.update(
                    {s.detector: s.sensors for s in said_of_silence(detector, 0.0, now_ns)}
                )
        await self.alarms.resume(active_detectors)

    async def _serve(self, stop: asyncio.Event) -> None:
        keep = self.supervisor.keep
        helpers = [
            keep("loop lag", self.lag.watch),
            keep("status", self._tell_status),
            keep("alarm times", self.alarms.keep_time),
            keep("journal", self._watch_journal),
        ]
        controlling = keep("control socket", self.control.serve)
        telling = [keep(output_name(path), output.run) for path, output in self.alarms.outputs.items()]
        pipeline = keep(
            "pipeline", self.pipeline.run, may_end=lambda: all(r.is_closed for r in self.rings.values())
        )
        reading = [
            keep(
                f"driver {told.name}",
                driver.run,
                # One that is to be ignored if absent ends, and so does a recording.
                may_end=partial(_has_ended, told),
                fatal=(DeviceAbsentError,),
            )
            for driver, told in zip(self.drivers, self.driver_reports, strict=True)
        ]
        try:
            self.ready.set()
            await self._until_stopped(stop)
        finally:
            self._on_ending()
            left = _Deadline(STOP_S)
            for part in (*telling, pipeline):
                part.leave()
            await stop_all([controlling], left.most(DRAIN_S))
            await stop_all(reading, left.most(RELEASE_S))
            for ring in self.rings.values():
                ring.close()
            await over([pipeline], left.most(DRAIN_S))
            await self.alarms.settle(left.most(DRAIN_S))
            with self.supervisor.sparing_others("status", "the service is stopping anyway"):
                self._publish_status()
            await self.alarms.stop(left.most(GOODBYE_S))
            await stop_all([*helpers, *telling, pipeline], left.most(DRAIN_S))

    async def _until_stopped(self, stop: asyncio.Event, first: asyncio.Task[None] | None = None) -> None:
        """Wait until the service is to stop, or ``first`` is done.

        Raises:
            Exception: something is lost without which the service is useless.
        """
        lost = self.supervisor.lost
        while not (stop.is_set() or lost.done() or (first is not None and first.done())):
            stopped = asyncio.create_task(stop.wait(), name="stop")
            try:
                waited_for: set[asyncio.Future[Any]] = {stopped, lost}
                if first is not None:
                    waited_for.add(first)
                await asyncio.wait(waited_for, return_when=asyncio.FIRST_COMPLETED)
            finally:
                stopped.cancel()
        if lost.done():
            lost.result()

    async def _watch_journal(self) -> None:
        """Have the service end if no alarm can reach the disk any more: as a zombie it would be of no use."""
        reason = await self.alarms.outbox.until_broken()
        self.supervisor.give_up(EssentialLostError(reason))
        await asyncio.Event().wait()

    def _deliver(self, block: SampleBlock) -> None:
        with self.supervisor.sparing_others(f"stream {block.stream}", "a block of its samples is lost"):
            self.rings[block.stream].write(block)
            self.alignment.accept(block)

    def _stand(self, stream: str, standing: StreamState) -> None:
        """Tell the pipeline how a stream stands, and every grid that it is on: that is no better."""
        self._standings[stream] = standing
        for grid in self._grids:
            if stream in grid.streams:
                standings = [self._standings[name] for name in grid.streams]
                worst = next((one for one in standings if one.doubt), StreamState())
                proven = all(one.proven for one in standings)
                self.pipeline.stand(grid.name, worst._replace(proven=proven))

    def _fall_silent(self, stream: str, standing: StreamState) -> None:
        """Take in that nothing comes any more of a stream in doubt; a grid stands as its streams do."""
        if stream in self._standings:
            self._stand(stream, standing)

    def _why_over(self, stream: str) -> str:
        """Why nothing more can come of a stream or grid, e.g. that its recording has ended; else empty."""
        streams = next(grid.streams for grid in self._grids if grid.name == stream)
        buses = {self.machine.streams[name].bus for name in streams}
        over = (one.link.over for one in self.driver_reports if one.name in buses)
        return next(filter(None, over), "")

    def _report(self, diagnosis: Diagnosis) -> None:
        self.report.remember(diagnosis)
        with self.supervisor.sparing_others(
            f"alarms by {diagnosis.detector}", "one of its statements is lost"
        ):
            self.alarms.take(diagnosis)
        for path, output in self.alarms.outputs.items():
            about = f"{output_name(path)} of {diagnosis.detector}"
            with self.supervisor.sparing_others(about, "it is not told of one statement"):
                output.report(diagnosis)

    def _bus_health(self) -> dict[str, BusHealth]:
        health: dict[str, BusHealth] = {}
        for driver in self.driver_reports:
            counters = driver.counters
            health[driver.name] = BusHealth(
                counters.overruns,
                counters.bus_off,
                counters.controller_state,
                counters.frames_unrecorded,
                driver.has_heard,
            )
        return health

    def awaited(self, *, patient: bool = True) -> dict[str, str]:
        """The buses that keep the service from being ready, and what each is waited for.

        One with ``start = "error"`` must deliver samples. Any other must have been tried once, for then the
        service goes on without it as the machine file says.

        Args:
            patient: whether to wait for the latter at all.
        """
        awaited: dict[str, str] = {}
        for driver in self.driver_reports:
            link = driver.link
            if self.machine.buses[driver.name].start == "error":
                if not any(self.rings[stream].started for stream in driver.names):
                    awaited[driver.name] = "no samples have come yet"
            elif patient and not (link.ever_up or link.reason or link.over):
                awaited[driver.name] = "it is being opened"
        return awaited

    def progress(self) -> dict[str, Progress]:
        """How far each part has come that can stall: readers of buses, detectors, the journal's writer."""
        readers = {
            f"driver {driver.name}": Progress(
                link.turns if (link := driver.link).state == "up" and link.turns else None
            )
            for driver in self.driver_reports
        }
        return {**readers, **self.pipeline.progress(), "outbox": self.alarms.outbox.progress}

    async def _tell_status(self) -> None:
        while True:
            await self.clock.sleep_ns(STATUS_EVERY_NS)
            self._publish_status()

    def _publish_status(self) -> None:
        figures = self.figures() if self.alarms.outputs else {}
        for path, output in self.alarms.outputs.items():
            with self.supervisor.sparing_others(output_name(path), "it is not told of one status"):
                output.status(figures)

    def figures(self) -> dict[str, Any]:
        """The service's figures by what they belong to: streams, buses, detectors, alarms, outbox, MQTT."""
        streams: dict[str, Mapping[str, float | str]] = {}
        buses: dict[str, Mapping[str, Any]] = {}
        for driver in self.driver_reports:
            link = driver.link
            buses[driver.name] = {
                "up": int(link.state == "up"),
                "losses": link.losses,
                **asdict(driver.counters),
            }
            for name, (counters, base) in driver.streams.items():
                ring, standing = self.rings[name], self._standings[name]
                streams[name] = {
                    **asdict(counters),
                    "rate_hz": base.rate_hz,
                    "doubt": standing.doubt if standing.silent else base.doubt,
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
            "failures": dict(self.supervisor.failures),
            "alarms": self.alarms.figures(),
            "commands": asdict(self.alarms.commands),
            "control": asdict(self.control.counters),
            "outbox": asdict(self.alarms.outbox.counters),
            **self._figures_of_outputs(),
        }

    def _figures_of_outputs(self) -> dict[str, Mapping[str, Any]]:
        figures: dict[str, Mapping[str, Any]] = {}
        for path, plugin in output_plugins().items():
            if plugin.status_key:
                figures[plugin.status_key] = {}
                with self.supervisor.sparing_others(output_name(path), "its figures are missing"):
                    if path in self.alarms.outputs:
                        of_output = self.alarms.outputs[path].figures()
                        Figures.model_validate(of_output)
                        figures[plugin.status_key] = of_output
        return figures


def _ring(machine: MachineFile, grid: Grid, detectors: Sequence[Detector]) -> SampleRing:
    wanted = round(machine.pipeline.ring_s * grid.rate_hz)
    # However short a ring is asked for, a detector must find its block in it, and some time to come for it.
    needed = max((4 * d.block for d in detectors if d.stream == grid.name), default=1)
    needed = max(needed, 2 * at_once(machine, grid.name))
    return SampleRing(grid.name, grid.channel_names, max(wanted, needed))


def _has_ended(driver: DriverReports) -> bool:
    return bool(driver.link.over)


class _Deadline:
    """The time that there is for several things one after the other.

    Args:
        seconds: for all of them.
    """

    def __init__(self, seconds: float) -> None:
        self._until_s = asyncio.get_running_loop().time() + seconds

    def most(self, seconds: float) -> float:
        """So long, or what is left of it."""
        return max(0.0, min(seconds, self._until_s - asyncio.get_running_loop().time()))
