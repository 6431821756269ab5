"""One machine under watch: from the samples of its streams to what its detectors state."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from daqsvc.acquisition.alignment import SETTLE_NS
from daqsvc.acquisition.ring import RingReader, SampleRing
from daqsvc.acquisition.standing import StreamState
from daqsvc.detectors.make import change_setpoints, detectors
from daqsvc.diagnosis.pipeline import Pipeline
from daqsvc.diagnosis.snapshots import alignment, at_once, patience
from daqsvc.diagnosis.statements import silence_statements
from daqsvc.live_feed import LiveFeed
from daqsvc.recorder import MachineRecorder
from daqsvc.settings.streams import Grid

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.samples import SampleBlock, Window
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.pipeline import KernelThreads
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.settings.models import MachineFile
    from daqsvc.supervision import Progress, Supervisor


class MachineWatch:
    """Rings, grids and detectors of one machine.

    Args:
        machine: the machine file.
        store: directory of the state of its detectors that survives restarts.
        clock: the service's clock.
        report: takes what the detectors state.
        supervisor: keeps its parts going.
        bus_over: why nothing more can come from a bus; empty if something can.
        stream_silent: why nothing comes of a stream, as far as its bus knows; empty if it does not.
        is_prepared_for: whether the driver of a stream still makes itself ready to read it.
        bus_quiet: that nothing at all comes over the bus of a stream, in a clause; empty if something may.
        kernels: threads that its detectors compute in.
        make_reader: makes what hands the samples of a ring to a detector.
        listens: whether its pipeline finds out by itself that a stream is silent.

    Attributes:
        machine: as given.
        store: as given.
        supervisor: as given.
        rings: by stream, and by grid.
        alignment: makes the grids.
        standings: how each stream stands.
        pipeline: runs the detectors.
        recorder: records the samples and the statements; None if the machine file does not ask for it.
        live: tells who looks on.

    Raises:
        AssemblyError: see `daqsvc.detectors.make.detectors`.
    """

    def __init__(
        self,
        machine: MachineFile,
        store: Path,
        clock: Clock,
        report: Callable[[Diagnosis], None],
        supervisor: Supervisor,
        bus_over: Callable[[str], str],
        stream_silent: Callable[[str], str],
        kernels: KernelThreads,
        make_reader: Callable[[SampleRing], RingReader] = RingReader,
        is_prepared_for: Callable[[str], bool] = lambda _stream: False,
        bus_quiet: Callable[[str], str] = lambda _stream: "",
        *,
        listens: bool = True,
    ) -> None:
        self.machine = machine
        self.store = store
        self._clock = clock
        self.supervisor = supervisor
        self._bus_over = bus_over
        self._stream_silent = stream_silent
        self._is_prepared_for = is_prepared_for
        self._bus_quiet = bus_quiet
        watching = detectors(machine, store)
        grids = [*(Grid({name: stream}) for name, stream in machine.streams.items()), *machine.grids]
        self._grids = grids
        self.standings = dict.fromkeys(machine.streams, StreamState())
        settings = machine.recorder
        self.recorder: MachineRecorder | None = None
        if settings is not None:
            self.recorder = MachineRecorder(
                machine, settings, store, clock, supervisor, lambda: self.pipeline.is_judging
            )
        self.live = LiveFeed(machine, clock)
        self.rings = {grid.name: _ring(machine, grid, watching) for grid in grids}
        self.alignment = alignment(machine, clock, self.deliver)
        self.pipeline = Pipeline(
            self.rings,
            watching,
            report,
            clock,
            kernels,
            settling_ns={aligner.name: SETTLE_NS for aligner in self.alignment.aligners},
            patience={grid.name: patience(machine, grid.name, grid.rate_hz) for grid in grids},
            supervisor=supervisor,
            fall_silent=self._fall_silent,
            why_over=self._why_over,
            why_silent=self._why_silent,
            bus_quiet=self._quiet,
            is_prepared_for=self._is_prepared,
            make_reader=make_reader,
            on_read=self._on_read,
            on_processed=self._on_processed,
            listens=listens,
        )

    def deliver(self, block: SampleBlock) -> None:
        """Take in samples of one of its streams."""
        with self.supervisor.sparing_others(f"stream {block.stream}", "a block of its samples is lost"):
            self.rings[block.stream].write(block)
            if self.recorder is not None:
                self.recorder.block(block)
            self.live.block(block)
            self.alignment.accept(block)

    def receiver(self, stream: str) -> Callable[[SampleBlock], None]:
        """What takes in the samples of one stream, whatever that is called in them."""

        def receive(block: SampleBlock) -> None:
            self.deliver(block if block.stream == stream else replace(block, stream=stream))

        return receive

    def stand(self, stream: str, standing: StreamState) -> None:
        """Tell the pipeline how a stream stands, and every grid that it is on: that is no better."""
        self.standings[stream] = standing
        if self.recorder is not None:
            self.recorder.stand(stream, standing)
        self.live.stand(stream, standing)
        for grid in self._grids:
            if stream in grid.streams:
                standings = [self.standings[name] for name in grid.streams]
                worst = next((one for one in standings if one.doubt), StreamState())
                proven = all(one.proven for one in standings)
                self.pipeline.stand(grid.name, worst._replace(proven=proven))

    def take_over(self, before: MachineWatch, buses: Collection[str]) -> None:
        """Go on with what is known of the streams of buses that stay as they are.

        Args:
            before: the machine as it was watched.
            buses: names of these buses.
        """
        for name, stream in self.machine.streams.items():
            if stream.bus in buses and name in before.standings:
                self.stand(name, before.standings[name])

    def change_alarms(self, machine: MachineFile) -> None:
        """Go on by a machine file in which nothing but alarms and setpoints is different."""
        self.machine = machine
        if self.recorder is not None:
            self.recorder.change_machine(machine)
        self.live.end()
        self.live.machine = machine
        with self.supervisor.sparing_others("setpoints", "detectors judge by those of before"):
            change_setpoints(machine, self.pipeline.detectors)

    def active_detectors(self) -> Mapping[str, Sequence[str]]:
        """The detectors that will make statements, with the sensors that these rest on."""
        now_ns = self._clock.monotonic_ns()
        active: dict[str, Sequence[str]] = {}
        for detector in self.pipeline.detectors:
            with self.supervisor.sparing_others(f"detector {detector.name}", "its alarms begin again"):
                active.update({s.detector: s.sensors for s in silence_statements(detector, 0.0, now_ns)})
        return active

    def progress(self) -> dict[str, Progress]:
        """How far each detector has come."""
        return {self.supervisor.named(part): one for part, one in self.pipeline.progress().items()}

    def close(self) -> None:
        """No more samples come."""
        self.live.end()
        for ring in self.rings.values():
            ring.close()

    def let_go(self) -> None:
        """Forget everything, so that its memory is free at once; once its pipeline has ended.

        It and its parts refer to each other. The garbage collector would find them, but would hold up the
        event loop for .1 s, and buses that are polled would lose samples.
        """
        vars(self).clear()

    @property
    def is_over(self) -> bool:
        """Whether no more samples can come."""
        return all(ring.is_closed for ring in self.rings.values())

    def _on_read(self, detector: str, window: Window) -> None:
        if self.recorder is not None:
            self.recorder.read(detector, window)

    def _on_processed(self, detector: Detector, window: Window) -> None:
        if self.recorder is not None:
            self.recorder.processed(detector, window)

    def _fall_silent(self, stream: str, standing: StreamState) -> None:
        """Take in that nothing comes any more of a stream in doubt; a grid stands as its streams do."""
        if stream in self.standings:
            self.stand(stream, standing)

    def _why_over(self, stream: str) -> str:
        """Why nothing more can come of a stream or grid, e.g. that its recording has ended; else empty."""
        streams = next(grid.streams for grid in self._grids if grid.name == stream)
        buses = {self.machine.streams[name].bus for name in streams}
        return next(filter(None, (self._bus_over(bus) for bus in sorted(buses))), "")

    def _why_silent(self, stream: str) -> str:
        """What the bus of a stream or grid knows of why nothing comes; else empty."""
        streams = next(grid.streams for grid in self._grids if grid.name == stream)
        return next(filter(None, (self._stream_silent(name) for name in streams)), "")

    def _quiet(self, stream: str) -> str:
        """That nothing at all comes over the bus of a stream; of a grid one of its buses is enough."""
        streams = next(grid.streams for grid in self._grids if grid.name == stream)
        return next(filter(None, map(self._bus_quiet, streams)), "")

    def _is_prepared(self, stream: str) -> bool:
        """Whether the driver of a stream, or of one of a grid, still makes itself ready."""
        streams = next(grid.streams for grid in self._grids if grid.name == stream)
        return any(map(self._is_prepared_for, streams))


def _ring(machine: MachineFile, grid: Grid, watching: Sequence[Detector]) -> SampleRing:
    wanted = round(machine.pipeline.ring_s * grid.rate_hz)
    # However short a ring is asked for, a detector must find its block in it, and some time to come for it.
    needed = max((4 * d.block for d in watching if d.stream == grid.name), default=1)
    needed = max(needed, 2 * at_once(machine, grid.name))
    return SampleRing(grid.name, grid.channel_names, max(wanted, needed))
