"""The service: one machine or several, one event loop, and everything that runs on it."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from daqsvc.alarm_service import AlarmService
from daqsvc.alarms.events import Identity
from daqsvc.alarms.make import alarm_rule
from daqsvc.alarms.manager import AlarmManager
from daqsvc.control import (
    ControlError,
    ControlServer,
    ReloadRefusedError,
    ReloadTooLateError,
    SnapshotNotMadeError,
)
from daqsvc.diagnosis.pipeline import THREADS, KernelThreads, kernel_failed
from daqsvc.driver_reports import DriverReports
from daqsvc.errors.code import coded
from daqsvc.errors.command_line import COMMAND_REFUSED, NO_SUCH_MACHINE
from daqsvc.errors.service import CONTROL_SOCKET, TOO_SLOW
from daqsvc.machine_watch import MachineWatch
from daqsvc.notice import notice
from daqsvc.outbox.files import make_directory
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.publish.looking import Looking
from daqsvc.publish.machine_figures import MACHINES, of_machine
from daqsvc.publish.make import output_plugins, output_set
from daqsvc.publish.output import output_name
from daqsvc.publish.payloads import Figures
from daqsvc.recorder import SnapshotRefusedError
from daqsvc.reload import Changes, changes
from daqsvc.self_check import BusHealth, conditions
from daqsvc.settings.problems import AssemblyError, MachineFileError
from daqsvc.status_report import StatusReport
from daqsvc.supervision import EssentialLostError, Progress, StallWatch, Supervisor, over, stop_all
from daqsvc.threads import CallThreads
from drivers.base import DeviceAbsentError
from drivers.frames import LayoutError
from drivers.make import bus_driver, bus_drivers, bus_self_checks

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.ring import SampleRing
    from daqsvc.acquisition.samples import SampleBlock
    from daqsvc.acquisition.standing import StreamState
    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.box import Box
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.publish.output import OutputSet
    from daqsvc.settings.models import MachineFile
    from daqsvc.supervision import Part
    from drivers.base import Driver

logger = logging.getLogger(__name__)

STATUS_EVERY_NS = NS_PER_S
LAG_EVERY_S = 0.1
LAG_REMEMBERED = round(60.0 / LAG_EVERY_S)
SUSPENDED_S = 1.0
"""A loop that is later than this was not busy: the process was suspended, or the host starved it."""
RELEASE_S = 0.6
"""What drivers may take to release their buses."""
DRAIN_S = 0.3
"""What the pipeline may take to finish, and again what the disk may take for the events of it."""
GOODBYE_S = 0.5
"""What the broker may take to get the rest."""
STOP_S = 1.3
"""What all of these may take together, ..."""
CLOSE_S = 0.3
"""... and then the journal to close: within the two seconds in which the service promises to stop."""


class LoopLag:
    """How late the event loop gets round to things: a timer's lateness, 10 times a second for a minute.

    Attributes:
        suspensions: how often it did not run for longer than `SUSPENDED_S`.
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
                    "the process did not run for %.1f s (suspended, or starved by the host); samples that no "
                    "buffer could hold meanwhile are counted as lost",
                    late_s,
                    extra=coded(TOO_SLOW),
                )

    def forget(self) -> None:
        """Begin the figures again."""
        self._late_s.clear()

    def figures_ms(self) -> dict[str, float]:
        """Median, 99th percentile and maximum of the lateness, in ms."""
        if not self._late_s:
            return {"p50": 0.0, "p99": 0.0, "max": 0.0}
        late_ms = 1000.0 * np.fromiter(self._late_s, np.float64)
        p50, p99 = np.percentile(late_ms, [50, 99])
        return {"p50": float(p50), "p99": float(p99), "max": float(late_ms.max())}


class Service:
    """Acquires, diagnoses and reports, as the machine files of a box state.

    Args:
        box: the machine files.
        store: directory of the journal.
        clock: the service's clock.
        on_ending: called when the service begins to end, for whatever reason.
        runtime: directory for the control socket, if not the store.
        read_again: reads the machine files again, for `reload`; blocks, and raises `MachineFileError`. None
            if there are none.
        on_reload: called with True when a reload begins to change something, and with False when it is over.
        files: what is read again, as it was named.
        end_patience: factor on what each part may take to end; 1 for the two seconds that are promised.

    Raises:
        AssemblyError: the machine file asks for a driver that is not installed.
        LayoutError: a DBC file does not hold what the machine file states.
    """

    def __init__(
        self,
        box: Box,
        store: Path,
        clock: Clock | None = None,
        on_ending: Callable[[], None] = lambda: None,
        runtime: Path | None = None,
        read_again: Callable[[], Box] | None = None,
        on_reload: Callable[[bool], None] = lambda _: None,
        files: Sequence[Path] = (),
        end_patience: float = 1.0,
    ) -> None:
        self.box = box
        self.clock: Clock = clock or SystemClock()
        self.lag = LoopLag()
        self.ready = asyncio.Event()
        self.supervisor = Supervisor()
        self._store = store
        self._read_again = read_again
        self._on_ending = on_ending
        self._end_patience = end_patience
        self._on_reload = on_reload
        self._reloading = asyncio.Lock()
        self._is_ending = False
        self._begun_ns = self.clock.monotonic_ns()
        self._parts = Parts()
        self._kernels = KernelThreads(THREADS, kernel_failed(self.supervisor))
        own = box.own
        self.watches = {name: self._watch(box, name) for name in box.machines}
        self.streams: dict[str, BoxStream] = {}
        self._receivers: dict[str, Callable[[SampleBlock], None]] = {}
        self._join_streams()
        self.drivers: list[Driver] = bus_drivers(own, self.clock, self._deliver, self._stand)
        self.driver_reports = [
            self._reports_of(box, name, driver) for name, driver in zip(own.buses, self.drivers, strict=True)
        ]
        self.stalls = StallWatch(self.progress)
        self.alarms = AlarmService(
            self._alarms_of(own),
            store,
            self.clock,
            _output_set(box),
            others=[self._alarms_of(machine) for machine in box.others],
            limits=OutboxLimits.of(own.store),
            buses=bus_self_checks(own),
            bus_health=self._bus_health,
            supervisor=self.supervisor,
            stalls=self.stalls,
            heard=self._record_alarm,
            snapshot=self.snapshot,
            look=self.look,
        )
        self.reports = {name: self._status_report(name) for name in self.watches}
        self.control = ControlServer(
            store,
            self.alarms.managers,
            self.alarms.execute,
            lambda: self.alarms.outbox.counters.waiting,
            runtime,
            self._status_line,
            self.reload,
            files,
            self.snapshot,
            self.look,
        )

    def _watch(self, box: Box, name: str) -> MachineWatch:
        return MachineWatch(
            box.machines[name],
            self._store if box.is_single else self._store / name,
            self.clock,
            self._report,
            self.supervisor if box.is_single else self.supervisor.within(name),
            self._why_bus_over,
            partial(self._why_silent, name),
            self._kernels,
            is_prepared_for=partial(self._is_prepared_for, name),
            bus_quiet=partial(self._bus_quiet, name),
        )

    def _join_streams(self) -> None:
        """Let the samples of each stream go to the machine that it belongs to by now."""
        self.streams = {
            self.box.stream_key(machine, stream): BoxStream(watch, stream)
            for machine, watch in self.watches.items()
            for stream in watch.machine.streams
        }
        self._receivers = {key: one.watch.receiver(one.name) for key, one in self.streams.items()}

    def _reports_of(self, box: Box, name: str, driver: Driver) -> DriverReports:
        streams = [key for key, stream in box.own.streams.items() if stream.bus == name]
        return DriverReports(name, driver, streams, self.supervisor)

    def _status_report(self, name: str) -> StatusReport:
        figures = partial(self.figures_of, name)
        return StatusReport(
            self.watches[name], self.clock, self.driver_reports, self.alarms, figures, self._begun_ns
        )

    async def _status_line(self, machine: str | None) -> bytes | tuple[str, ...]:
        """The state of a machine, or of the only one; the names of all if there is no such machine."""
        if machine is None and len(self.reports) == 1:
            [machine] = self.reports
        report = self.reports.get(machine or "")
        return tuple(self.reports) if report is None else await report.line()

    def look(
        self, machine: str | None, streams: Collection[str], *, before_bytes: int | None = None
    ) -> Looking | tuple[str, ...]:
        """Begin to look at a machine, or the only one; see `daqsvc.publish.looking.Look`."""
        name = next(iter(self.watches)) if machine is None and len(self.watches) == 1 else machine
        watch = self.watches.get(name or "")
        if watch is None or name is None:
            return tuple(self.watches)
        latest = self.reports[name].latest
        newest = self.alarms.newest(name)
        looker = watch.live.look(streams, latest, newest, watch.standings, watch.rings, before_bytes)
        return Looking(looker.lines, partial(watch.live.leave, looker))

    def _alarms_of(self, machine: MachineFile) -> AlarmManager:
        names = machine.value_names
        return AlarmManager(
            Identity(machine.site, machine.box, machine.machine.name),
            [alarm_rule(alarm, names) for alarm in machine.alarms],
            self.clock,
            handling=machine.alarm_handling,
        )

    async def run(self, stop: asyncio.Event) -> None:
        """Run until ``stop`` is set; then hand over what is under way and end within two seconds.

        Blocking calls get their own threads from here on; the end of the process waits for none of them.

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
                await self.alarms.close(CLOSE_S * self._end_patience)

    async def _start(self) -> None:
        await self.alarms.open()
        for watch in self.watches.values():
            await self._prepare(watch)
        # Take over from the journal the states of the alarms when the service ended.
        await self.alarms.resume({name: watch.active_detectors() for name, watch in self.watches.items()})
        for name, watch in self.watches.items():
            if watch.recorder is not None:
                watch.recorder.take_over(self.alarms.newest(name))
        try:
            await self.control.open()
        except ControlError as error:
            # Watching the machine matters more than taking commands.
            logger.error(  # noqa: TRY400 - the message is enough
                "no commands on this box until this is corrected: %s", error, extra=coded(CONTROL_SOCKET)
            )

    async def _prepare(self, watch: MachineWatch) -> None:
        if watch.store != self._store:
            with watch.supervisor.sparing_others("store", "its detectors keep nothing over restarts"):
                await asyncio.to_thread(make_directory, watch.store)
        await watch.pipeline.warm()

    async def _serve(self, stop: asyncio.Event) -> None:
        keep, parts = self.supervisor.keep, self._parts
        helpers = [
            keep("loop lag", self.lag.watch),
            keep("status", self._tell_status),
            keep("alarm times", self.alarms.keep_time),
            keep("journal", self._watch_journal),
        ]
        controlling = keep("control socket", self.control.serve)
        self._start_outputs()
        for name in self.watches:
            self._start_pipeline(name)
        for driver, reports in zip(self.drivers, self.driver_reports, strict=True):
            self._start_driver(driver, reports, fatal=(DeviceAbsentError,))
        try:
            self.ready.set()
            await self._until_stopped(stop)
        finally:
            self._on_ending()
            self._is_ending = True
            left = _Deadline(STOP_S, self._end_patience)
            if parts.reload is not None:
                parts.reload.cancel()
                await asyncio.wait({parts.reload}, timeout=left.most(DRAIN_S))
            telling, pipelines = [*parts.outputs.values()], [*parts.pipelines.values()]
            recorders = [*parts.recorders.values()]
            for part in (*telling, *pipelines):
                part.leave()
            await stop_all([controlling], left.most(DRAIN_S))
            await stop_all(parts.drivers.values(), left.most(RELEASE_S))
            for watch in self.watches.values():
                watch.close()
            await over(pipelines, left.most(DRAIN_S))
            await stop_all(recorders, left.most(DRAIN_S))
            await self.alarms.settle(left.most(DRAIN_S))
            with self.supervisor.sparing_others("status", "the service is stopping anyway"):
                self._publish_status()
            await self.alarms.stop(left.most(GOODBYE_S))
            await stop_all([*helpers, *telling, *pipelines], left.most(DRAIN_S))

    def _start_outputs(self) -> None:
        for path, output in self.alarms.outputs.items():
            self._parts.outputs[path] = self.supervisor.keep(output_name(path), output.run)

    def _start_pipeline(self, name: str) -> None:
        watch = self.watches[name]
        keep = watch.supervisor.keep
        self._parts.pipelines[name] = keep("pipeline", watch.pipeline.run, may_end=partial(_is_over, watch))

        if (recorder := watch.recorder) is not None:
            self._parts.recorders[name] = keep("recorder", recorder.run)

    def _start_driver(
        self, driver: Driver, reports: DriverReports, *, fatal: tuple[type[Exception], ...] = ()
    ) -> None:
        # One that is to be ignored if absent ends, and so does a recording.
        ends = partial(_has_ended, reports)
        keep = self.supervisor.keep
        self._parts.drivers[reports.name] = keep(
            f"driver {reports.name}", driver.run, may_end=ends, fatal=fatal
        )

    async def snapshot(self, machine: str | None, reason: str) -> str:
        """Make a snapshot; returns its file when it is complete.

        Args:
            machine: of which one; None for the only one.
            reason: who has asked, in words.

        Raises:
            SnapshotNotMadeError: there is no such machine, it has no recorder, or the disk did not take it.
        """
        name = next(iter(self.watches)) if machine is None and len(self.watches) == 1 else machine
        watch = None if name is None else self.watches.get(name)
        if watch is None:
            why = "name a machine" if name is None else f"this service does not watch {name!r:.80}"
            raise SnapshotNotMadeError(f"{why}; it watches {', '.join(self.watches)}", NO_SUCH_MACHINE)
        if watch.recorder is None:
            raise SnapshotNotMadeError(
                f"{watch.machine.path} has no table [recorder]; write one", COMMAND_REFUSED
            )
        try:
            return str(await watch.recorder.snapshot(reason))
        except SnapshotRefusedError as refused:
            raise SnapshotNotMadeError(f"{refused}", refused.code) from None

    async def reload(self, *, dry_run: bool = False) -> list[str]:
        """Read the machine files again and go on with them, by what is different.

        They are applied as a whole or not at all. What has not changed goes on: its bus stays open, its
        samples go on being counted, its detectors know what they knew. Alarms stand as they did.

        Args:
            dry_run: only state what would be done.

        Returns:
            What was done, a line each; nothing if nothing is different.

        Raises:
            ReloadRefusedError: the files cannot be used, or not while the service runs.
        """
        if self._read_again is None:
            raise ReloadRefusedError(["this service was not made of files"])
        async with self._reloading:
            try:
                box = await asyncio.to_thread(self._read_again)
                diff = await asyncio.to_thread(changes, self.box, box)
                if dry_run or not diff:
                    return diff.lines()
                made = await self._make(box, diff)
                if self._is_ending:
                    raise ReloadTooLateError
            except MachineFileError as error:
                raise ReloadRefusedError([f"{problem}" for problem in error.problems]) from error
            except (AssemblyError, LayoutError) as error:
                raise ReloadRefusedError([f"{error}"]) from error
            # Its own task: whoever has asked for it may go away, the service may not stay in between.
            going_on = self._parts.reload = asyncio.create_task(
                self._go_on_with(box, diff, made), name="reload"
            )
            self._on_reload(True)
            try:
                await asyncio.wait({going_on})
            finally:
                self._on_reload(False)
            if going_on.cancelled():
                raise ReloadTooLateError
            going_on.result()
            for line in diff.lines():
                notice(logger, "reloaded: %s", line)
            return diff.lines()

    async def _make(self, box: Box, diff: Changes) -> Made:
        """Make all that is new, before anything of what runs is touched.

        Raises:
            AssemblyError, LayoutError: that cannot be done.
        """
        names = (*diff.machines_anew, *diff.machines_new)
        watches = {name: await asyncio.to_thread(self._watch, box, name) for name in names}
        drivers = {
            name: bus_driver(box.own, name, self.clock, self._deliver, self._stand, at_start=False)
            for name in (*diff.buses_anew, *diff.buses_new)
        }
        for watch in watches.values():
            await self._prepare(watch)
        return Made(watches, drivers)

    async def _go_on_with(self, box: Box, diff: Changes, made: Made) -> None:
        before, parts = self.watches, self._parts
        ending = [parts.drivers.pop(name) for name in (*diff.buses_gone, *diff.buses_anew)]
        await stop_all(ending, RELEASE_S)
        # From here to the next await samples change over from the old to the new.
        self.box = box
        self.watches = {name: made.watches.get(name) or before[name] for name in box.machines}
        for name, watch in made.watches.items():
            if name in before:
                watch.take_over(before[name], box.own.buses.keys() - {*diff.buses_new, *diff.buses_anew})
        self._join_streams()
        drivers = dict(zip((one.name for one in self.driver_reports), self.drivers, strict=True))
        reports = {one.name: one for one in self.driver_reports}
        drivers |= made.drivers
        reports |= {name: self._reports_of(box, name, driver) for name, driver in made.drivers.items()}
        self.drivers[:] = [drivers[name] for name in box.own.buses]
        self.driver_reports[:] = [reports[name] for name in box.own.buses]
        replaced = [before[name] for name in (*diff.machines_gone, *diff.machines_anew)]
        pipelines = [parts.pipelines.pop(name) for name in (*diff.machines_gone, *diff.machines_anew)]
        for part in pipelines:
            part.leave()
        for watch in replaced:
            watch.close()
        await over(pipelines, DRAIN_S)
        await stop_all(pipelines, DRAIN_S)
        gone = (*diff.machines_gone, *diff.machines_anew)
        recorders = [parts.recorders.pop(name) for name in gone if name in parts.recorders]
        await stop_all(recorders, DRAIN_S)
        for watch, part in zip(replaced, pipelines, strict=True):
            if part.over.done():
                watch.let_go()
        await self._change_alarms(box, diff)
        self.reports = {
            name: self._status_report(name) if name in made.watches else self.reports[name]
            for name in self.watches
        }
        for name, watch in made.watches.items():
            if watch.recorder is not None:
                watch.recorder.take_over(self.alarms.newest(name))
            self._start_pipeline(name)
        for name, driver in made.drivers.items():
            self._start_driver(driver, reports[name])

    async def _change_alarms(self, box: Box, diff: Changes) -> None:
        """Go on with the alarms of the new files, which stand as they did."""
        for name in diff.alarms_anew:
            self.watches[name].change_alarms(box.machines[name])
        telling = [*self._parts.outputs.values()] if diff.outputs else []
        if diff.outputs:
            for part in telling:
                part.leave()
            await self.alarms.stop(GOODBYE_S)
            await stop_all(telling, DRAIN_S)
            self._parts.outputs.clear()
        anew = {*diff.machines_anew, *diff.machines_new, *diff.alarms_anew}
        # In a thread, for what outputs are made of may have to be imported.
        outputs = await asyncio.to_thread(self.alarms.made_by, _output_set(box)) if diff.outputs else None
        self.alarms.change(
            [self._alarms_of(box.machines[name]) for name in box.machines if name in anew],
            gone=diff.machines_gone,
            buses=bus_self_checks(box.own),
            active_detectors={name: watch.active_detectors() for name, watch in self.watches.items()},
            outputs=outputs,
        )
        if diff.outputs:
            self._start_outputs()

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
            self._receivers[block.stream](block)

    def _stand(self, stream: str, standing: StreamState) -> None:
        """Report the state of a stream to its machine."""
        one = self.streams[stream]
        one.watch.stand(one.name, standing)

    def _why_bus_over(self, bus: str) -> str:
        """Why nothing more can come from a bus, e.g. that its recording has ended; else empty."""
        return next((one.link.over for one in self.driver_reports if one.name == bus), "")

    def _why_silent(self, machine: str, stream: str) -> str:
        """What the bus of a stream of a machine knows of why no samples of it come; else empty."""
        bus = self.box.machines[machine].streams[stream].bus
        links = (one.link for one in self.driver_reports if one.name == bus)
        return next((link.why_silent(self.box.stream_key(machine, stream)) for link in links), "")

    def _bus_quiet(self, machine: str, stream: str) -> str:
        """That nothing at all comes over the bus of a stream of a machine; empty if that is not known."""
        bus = self.box.machines[machine].streams[stream].bus
        return next((one.link.quiet() for one in self.driver_reports if one.name == bus), "")

    def _is_prepared_for(self, machine: str, stream: str) -> bool:
        """Whether the driver of a stream of a machine still makes itself ready."""
        watched = self.box.machines.get(machine)
        # A reload may have removed either, while the old pipeline still ends.
        if watched is None or stream not in watched.streams:
            return False
        bus = watched.streams[stream].bus
        return any(one.link.preparing for one in self.driver_reports if one.name == bus)

    def _report(self, diagnosis: Diagnosis) -> None:
        self.reports[diagnosis.machine].remember(diagnosis)
        if (recorder := self.watches[diagnosis.machine].recorder) is not None:
            recorder.diagnosis(diagnosis)
        self.watches[diagnosis.machine].live.diagnosis(diagnosis)
        with self.supervisor.sparing_others(
            f"alarms by {diagnosis.detector}", "one of its statements is lost"
        ):
            self.alarms.take(diagnosis)
        for path, output in self.alarms.outputs.items():
            about = f"{output_name(path)} of {diagnosis.detector}"
            with self.supervisor.sparing_others(about, "it does not get one statement"):
                output.report(diagnosis)

    def _record_alarm(self, event: AlarmEvent) -> None:
        watch = self.watches.get(event.identity.machine)
        if watch is None:
            return
        if watch.recorder is not None:
            watch.recorder.alarm(event)
        watch.live.alarm(event)

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
        service goes on without it as the machine file states.

        Args:
            patient: whether to wait for the latter at all.
        """
        awaited: dict[str, str] = {}
        for driver in self.driver_reports:
            link = driver.link
            if self.box.own.buses[driver.name].start == "error":
                if not any(self.streams[stream].ring.started for stream in driver.names):
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
        parts = {part: p for watch in self.watches.values() for part, p in watch.progress().items()}
        return {**readers, **parts, "outbox": self.alarms.outbox.progress}

    async def _tell_status(self) -> None:
        while True:
            await self.clock.sleep_ns(STATUS_EVERY_NS)
            self._publish_status()

    def _publish_status(self) -> None:
        figures = self.figures() if self.alarms.outputs else {}
        for path, output in self.alarms.outputs.items():
            with self.supervisor.sparing_others(output_name(path), "it does not get one status"):
                output.status(figures)

    def figures(self) -> dict[str, Any]:
        """The service's figures by what they belong to: streams, buses, detectors, alarms, outbox, MQTT."""
        machines = {machine: {"alarms": self.alarms.figures_of(machine)} for machine in self.alarms.managers}
        figures = self._figures(self.watches, self.box.own.buses, self.alarms.figures())
        return figures if self.box.is_single else {**figures, MACHINES: machines}

    def figures_of(self, machine: str) -> dict[str, Any]:
        """The figures of one machine, by the names of its file."""
        if self.box.is_single:
            return self.figures()
        watches, buses = {machine: self.watches[machine]}, self.box.machines[machine].buses
        alarms = self.alarms.figures_of(machine)
        figures = {**self._figures(watches, buses, alarms), MACHINES: {machine: {"alarms": alarms}}}
        return of_machine(figures, machine, buses)

    def _figures(
        self, watches: Mapping[str, MachineWatch], on: Collection[str], alarms: Mapping[str, Any]
    ) -> dict[str, Any]:
        """The figures of the service, and of some machines on some buses."""
        streams: dict[str, Mapping[str, float | str]] = {}
        buses: dict[str, Mapping[str, Any]] = {}
        for driver in self.driver_reports:
            if driver.name not in on:
                continue
            link = driver.link
            buses[driver.name] = {
                "up": int(link.state == "up"),
                "losses": link.losses,
                **asdict(driver.counters),
            }
            for name, (counters, base) in driver.streams.items():
                if self.streams[name].watch not in watches.values():
                    continue
                ring, standing = self.streams[name].ring, self.streams[name].standing
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
            "grids": self._of_machines(watches, lambda watch: watch.alignment.figures()),
            "detectors": self._of_machines(
                watches,
                lambda watch: {name: asdict(counted) for name, counted in watch.pipeline.counters.items()},
            ),
            "loop_lag_ms": self.lag.figures_ms(),
            "suspensions": self.lag.suspensions,
            "failures": dict(self.supervisor.failures),
            "alarms": alarms,
            "commands": asdict(self.alarms.commands),
            "control": asdict(self.control.counters),
            "outbox": asdict(self.alarms.outbox.counters),
            **self._figures_of_outputs(),
            **_figures_of_recorders(watches),
        }

    def _of_machines(
        self, watches: Mapping[str, MachineWatch], figures: Callable[[MachineWatch], Mapping[str, Any]]
    ) -> dict[str, Any]:
        """Figures of machines by their names on the box."""
        return {
            self.box.stream_key(machine, name): one
            for machine, watch in watches.items()
            for name, one in figures(watch).items()
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


@dataclass(slots=True)
class Parts:
    """What is kept going: outputs by the path of their table, drivers by bus, the rest by machine.

    And the reload that is under way, or was the last.
    """

    outputs: dict[str, Part] = field(default_factory=dict)
    pipelines: dict[str, Part] = field(default_factory=dict)
    recorders: dict[str, Part] = field(default_factory=dict)
    drivers: dict[str, Part] = field(default_factory=dict)
    reload: asyncio.Task[None] | None = None


class Made(NamedTuple):
    """What a reload has made: of machines and buses that are new, or begin again."""

    watches: dict[str, MachineWatch]
    drivers: dict[str, Driver]


def _figures_of_recorders(watches: Mapping[str, MachineWatch]) -> dict[str, Any]:
    recorders = {name: watch.recorder for name, watch in watches.items()}
    figures = {name: one.figures() for name, one in recorders.items() if one is not None}
    return {"recorders": figures} if figures else {}


def _output_set(box: Box) -> OutputSet:
    return output_set(box.own, conditions(bus_self_checks(box.own)), box.others)


class BoxStream(NamedTuple):
    """A stream of a machine.

    Attributes:
        watch: of the machine.
        name: in the file of the machine.
    """

    watch: MachineWatch
    name: str

    @property
    def ring(self) -> SampleRing:
        """Its newest samples."""
        return self.watch.rings[self.name]

    @property
    def standing(self) -> StreamState:
        """Whether anything can be judged by it."""
        return self.watch.standings[self.name]


def _is_over(watch: MachineWatch) -> bool:
    return watch.is_over


def _has_ended(driver: DriverReports) -> bool:
    return bool(driver.link.over)


class _Deadline:
    """The time that there is for several things one after the other.

    Args:
        seconds: for all of them.
        patience: factor on this and on what each of them may take.
    """

    def __init__(self, seconds: float, patience: float) -> None:
        self._patience = patience
        self._until_s = asyncio.get_running_loop().time() + patience * seconds

    def most(self, seconds: float) -> float:
        """So long, or what is left of it."""
        return max(0.0, min(self._patience * seconds, self._until_s - asyncio.get_running_loop().time()))
