"""One run of the demo: a simulated device, the whole service, a broker, and a consumer behind it.

The consumer (`Listener`) knows nothing of the service but its broker. The result of a run is in `summarise`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import math
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, TypeVar
from urllib.parse import urlsplit

import aiomqtt
import can

from daqsvc.acquisition.clock import DrivenClock, SystemClock
from daqsvc.box import Box
from daqsvc.detectors.rotor_bank.settings import ROTOR_BANK
from daqsvc.service import Service
from daqsvc.snapshots.contents import SUFFIX
from daqsvc.snapshots.folder import FOLDER
from drivers.can.plugin import frame_layout
from drivers.fields import LayoutError
from sim_hw.demo.broker import EmbeddedBroker
from sim_hw.demo.machines import DemoError
from sim_hw.demo.page import page_of
from sim_hw.node_faults import NodeFaults
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.pacing import DrivenPacer, RealTimePacer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from daqsvc.acquisition.assembler import StreamCounters
    from daqsvc.machine_watch import MachineWatch
    from daqsvc.settings import MachineFile
    from drivers.frames import FrameLayout
    from sim_hw.demo.page import PageAddress
    from sim_hw.nodes.pacing import Pacer
    from sim_hw.scenario import Onset


CONNECT_S = 10.0
FAREWELL_S = 5.0
DEFAULT_PORT = 1883


@dataclass(frozen=True, slots=True)
class Received:
    """One message.

    Attributes:
        kind: ``"diagnosis"``, ``"alarm"``, ``"status"`` or ``"availability"``, from its schema.
        topic: where it came.
        payload: its JSON.
    """

    kind: str
    topic: str
    payload: dict[str, Any]


class Listener:
    """Subscribes to everything below a topic and hands messages on until the box goes offline.

    Args:
        url: the broker, ``mqtt://host:port``.
        base: topic of the box.
        on_message: called with each message.
    """

    def __init__(self, url: str, base: str, on_message: Callable[[Received], None]) -> None:
        parts = urlsplit(url)
        self._host, self._port = parts.hostname or "localhost", parts.port or DEFAULT_PORT
        self._base = base
        self._on_message = on_message
        self._subscribed = asyncio.Event()
        self._been_online = False
        self._offline = asyncio.Event()
        self.messages = 0

    async def run(self) -> None:
        """Listen until cancelled.

        Raises:
            aiomqtt.MqttError: the broker is not there.
        """
        quiet = logging.getLogger(f"{__name__}.aiomqtt")
        quiet.setLevel(logging.CRITICAL)
        client = aiomqtt.Client(self._host, self._port, timeout=CONNECT_S, logger=quiet)
        async with client:
            await client.subscribe(f"{self._base}/#", qos=1)
            self._subscribed.set()
            async for message in client.messages:
                self._take(str(message.topic), bytes(message.payload or b""), retained=bool(message.retain))

    def _take(self, topic: str, payload: bytes, *, retained: bool) -> None:
        if retained or not payload:
            return  # what an earlier run has left behind
        try:
            content = json.loads(payload)
        except (ValueError, RecursionError):
            return  # of somebody else, on a broker of the user's
        if not isinstance(content, dict):
            return
        kind = str(content.get("schema", "")).removeprefix("daqsvc.").split("/")[0]
        self.messages += 1
        if kind == "availability":
            online = content["state"] == "online"
            self._been_online |= online
            if self._been_online and not online:
                self._offline.set()
        self._on_message(Received(kind, topic, content))

    async def subscribed(self) -> None:
        """Wait until nothing that is published from now on can be missed."""
        await self._subscribed.wait()

    async def farewell(self) -> bool:
        """Wait until the box has reported that it goes offline; False if that takes too long."""
        try:
            await asyncio.wait_for(self._offline.wait(), FAREWELL_S)
        except TimeoutError:
            return False
        return True


logger = logging.getLogger(__name__)

T = TypeVar("T")

LINK_UP_S = 20.0
KERNELS_S = 300.0
"""What a slow box may take to compile the kernels, at the first run."""
LAST_FRAMES_S = 5.0
END_PATIENCE = 50.0
"""How many times as long as on a box the service may take to end: the computer of a demo may be busy."""


@dataclass(frozen=True)
class Script:
    """What to play, and for whom.

    Attributes:
        title: what a person reads.
        machine: makes the machine file, given the address of the broker.
        stream: name of the stream that is played.
        samples: ``[n, channels]`` in the units of the stream's sensors.
        rate_hz: samples per second.
        onsets: what changes when; empty for a recording.
        samples_per_rev: to count delays in revolutions; None if the shaft is not known.
        faults: of the node and its link.
        seed: of everything random, which the summary names.
        detector: the one whose decisions are compared with ``onsets``.
    """

    title: str
    machine: Callable[[str], MachineFile]
    stream: str
    samples: NDArray[np.float64]
    rate_hz: float
    onsets: Sequence[Onset] = ()
    samples_per_rev: float | None = None
    faults: NodeFaults | None = None
    seed: int = 0
    detector: str = ROTOR_BANK

    @property
    def duration_s(self) -> float:
        """How long it lasts in simulated time."""
        return len(self.samples) / self.rate_hz

    def goes_on_from(self, index: int, per_frame: int) -> NDArray[np.float64]:
        """Most of the samples again, so that they can follow sample ``index``, and themselves.

        The shaft is turned as it would be then, and they are whole frames.
        """
        per_rev = 1 if self.samples_per_rev is None else round(self.samples_per_rev)
        begin = index % per_rev
        whole = math.lcm(per_rev, per_frame)
        count = (len(self.samples) - begin) // whole * whole
        return self.samples[begin : begin + count] if count else self.samples


@dataclass(slots=True)
class DemoOutcome:
    """What came of a run.

    Attributes:
        diagnoses: payloads of the diagnoses that changed a decision, in order of arrival.
        figures: the service's last figures.
        injected: what the link did to the frames, by fault.
        frames_in: frames that the device made, whatever the link did to them.
        frames_sent: frames that went onto the bus.
        samples_sent: samples that were played.
        messages: messages that the consumer got from the broker.
        complete: whether the consumer received the last message of the service.
        alarms: alarm events that it got.
        real_s: how long the playing took.
        snapshots: files of the snapshots that alarms have left, and that are kept.
        snapshots_gone: how many are not kept, as they were not asked for.
    """

    diagnoses: list[dict[str, Any]] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    injected: dict[str, int] = field(default_factory=dict)
    frames_in: int = 0
    frames_sent: int = 0
    samples_sent: int = 0
    messages: int = 0
    complete: bool = False
    alarms: int = 0
    real_s: float = 0.0
    snapshots: list[Path] = field(default_factory=list)
    snapshots_gone: int = 0


class DemoSession:
    """Plays a script.

    Args:
        script: what to play.
        speed: simulated over real time; 1 for real time, on the real clock.
        broker_url: an MQTT broker; None to start one inside the process.
        on_message: called with each message that came back from the broker.
        snapshots: where the snapshots are kept that alarms leave; None: they go with the demo.
        on_page: called with where the page is, which is served meanwhile; None for no page.
        again: play it again and again once it was played, until `enough`. What comes of that is not in the
            outcome's diagnoses.
    """

    def __init__(
        self,
        script: Script,
        *,
        speed: float,
        broker_url: str | None,
        on_message: Callable[[Received], None],
        snapshots: Path | None = None,
        on_page: Callable[[PageAddress], None] | None = None,
        again: bool = False,
    ) -> None:
        self.script = script
        self.speed = speed
        self.service: Service | None = None
        self.node: CanNode | None = None
        self.outcome = DemoOutcome()
        self._broker_url = broker_url
        self._on_message = on_message
        self._snapshots = snapshots
        self._on_page = on_page
        self._again = again
        self._enough = asyncio.Event()
        self._is_repeating = False
        self._frames_before = 0
        """Frames that were sent when what is played now began."""

    def enough(self) -> bool:
        """End in order if it is played again by now; whether that is so, and it was not asked before."""
        is_first = not self._enough.is_set()
        self._enough.set()
        return self._is_repeating and is_first

    async def run(self) -> DemoOutcome:
        """Play it from the beginning to the end.

        Raises:
            DemoError: the broker cannot be reached or was lost, the service did not start, or there is no
                folder for the snapshots.
            Exception: what ``on_message`` raised; the service has been stopped.
        """
        async with contextlib.AsyncExitStack() as stack:
            url = self._broker_url
            if url is None:
                url = (await stack.enter_async_context(EmbeddedBroker())).url
            machine = self.script.machine(url)
            store = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="daqsvc-demo-")))
            # Also of what is broken off.
            stack.push_async_callback(self._keep_snapshots, await asyncio.to_thread(self._folder), store)
            if self._on_page is not None:
                self._on_page(await stack.enter_async_context(page_of(store)))
            listener = Listener(url, f"daqsvc/{machine.site}/{machine.box}", self._take)
            listening = await stack.enter_async_context(_task(listener.run()))
            await _first(listener.subscribed(), listening, f"the broker {url} does not answer", LINK_UP_S)
            try:
                await _unless_ended(listening, self._serve(machine, store))
                self.outcome.complete = await _unless_ended(listening, listener.farewell())
            except aiomqtt.MqttError as error:
                raise DemoError(
                    f"the broker {url} was lost while the demo played ({error}); check that it runs, and "
                    "play again"
                ) from error
            self.outcome.messages = listener.messages
        return self.outcome

    def _folder(self) -> Path | None:
        """Make the folder for snapshots, if they are to be kept; blocks.

        Raises:
            DemoError: it cannot be made.
        """
        if self._snapshots is not None:
            try:
                self._snapshots.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                named = f"--snapshots: the folder {self._snapshots}"
                raise DemoError(f"{named} cannot be made: {error.strerror}; name another") from error
        return self._snapshots

    async def _keep_snapshots(self, folder: Path | None, store: Path) -> None:
        made = sorted((store / FOLDER).glob(f"*{SUFFIX}"))
        if folder is None:
            self.outcome.snapshots_gone = len(made)
            return
        try:
            for one in made:
                kept = await asyncio.to_thread(shutil.move, one, folder / one.name)
                self.outcome.snapshots.append(Path(kept))
        except OSError as error:
            raise DemoError(
                f"--snapshots: {folder} does not take the snapshots: {error.strerror}; name another folder"
            ) from error

    async def _serve(self, machine: MachineFile, store: Path) -> None:
        clock = SystemClock() if self.speed == 1 else DrivenClock()
        service = self.service = Service(Box.single(machine), store, clock, end_patience=END_PATIENCE)
        stop = asyncio.Event()
        async with _task(service.run(stop)) as running:
            await _first(service.ready.wait(), running, "the service did not start", KERNELS_S)
            try:
                await _first(_links_up(service), running, "bus and broker did not come up", LINK_UP_S)
                channel = machine.buses["can0"].model_dump()["channel"]
                with can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD) as bus:
                    try:
                        await _unless_ended(running, self._play(bus, service, clock))
                    except TimeoutError as error:
                        raise DemoError(f"playing has stopped: {error}") from error
                await self._last_frames(service)
            finally:
                # Also when playing is broken off: the service stops as it does in the field.
                stop.set()
                await asyncio.wait({running})
            running.result()
        self.outcome.figures = service.figures()

    async def _play(self, bus: can.BusABC, service: Service, clock: SystemClock | DrivenClock) -> None:
        script = self.script
        layout = frame_layout(_watch(service).machine, script.stream)
        node = self.node = _node(bus, layout, script)
        pacer = self._pacer(service, clock)
        begun_s = asyncio.get_running_loop().time()
        await node.play(pacer)
        self.outcome.real_s = asyncio.get_running_loop().time() - begun_s
        self.outcome.frames_sent, self.outcome.samples_sent = node.frames_sent, node.samples_sent
        done = node.injected
        self.outcome.frames_in = done.frames_in
        self.outcome.injected = {
            "dropped": done.dropped,
            "duplicated": done.duplicated,
            "reordered": done.reordered,
            "corrupted": done.corrupted,
        }
        if self._again:
            await self._repeat(bus, service, clock)

    def _pacer(self, service: Service, clock: SystemClock | DrivenClock) -> Pacer:
        if not isinstance(clock, DrivenClock):
            return RealTimePacer(clock)
        block = max((d.block for d in _watch(service).pipeline.detectors), default=0)
        limit = 2 * block + round(0.1 * self.script.rate_hz)
        return DrivenPacer(clock, self.backlog, limit, speed=self.speed)

    async def _repeat(self, bus: can.BusABC, service: Service, clock: SystemClock | DrivenClock) -> None:
        """Play it again and again, without the faults of the link; the device goes on counting."""
        self._is_repeating = True
        script = self.script
        layout = frame_layout(_watch(service).machine, script.stream)
        first_index = len(script.samples) // layout.samples_per_frame * layout.samples_per_frame
        samples = script.goes_on_from(first_index, layout.samples_per_frame)
        async with _task(self._enough.wait()) as enough:
            while not enough.done():
                self._frames_before = self.outcome.frames_sent
                node = self.node = CanNode(
                    bus, layout, samples, script.rate_hz, first_index=first_index, clip=True
                )
                async with _task(node.play(self._pacer(service, clock))) as playing:
                    await asyncio.wait({playing, enough}, return_when=asyncio.FIRST_COMPLETED)
                    if playing.done():
                        playing.result()
                self.outcome.frames_sent += node.frames_sent
                self.outcome.samples_sent += node.samples_sent
                first_index += len(samples)

    def counters(self) -> StreamCounters | None:
        """Counters of the stream that is played, once there is a service."""
        if self.service is None:
            return None
        for driver in self.service.drivers:
            if self.script.stream in driver.streams:
                return driver.streams[self.script.stream][0]
        return None

    def backlog(self) -> int:
        """Samples that are on the bus, or have come off it and have not been diagnosed yet.

        What the node took while it was silent or off never goes onto the bus, and is not waited for.
        """
        counters = self.counters()
        if self.service is None or self.node is None or counters is None:
            return 0
        on_the_way = self._frames_before + self.node.frames_sent - counters.frames_received
        return on_the_way * self.node.samples_per_frame + _watch(self.service).pipeline.behind_samples

    async def _last_frames(self, service: Service) -> None:
        """Let the frames that are still on the bus arrive."""
        counters = self.counters()
        assert counters is not None  # noqa: S101 - the script's stream is in its machine file
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_FRAMES_S):
                await _until(lambda: counters.frames_received >= self.outcome.frames_sent)
                block = max((d.block for d in _watch(service).pipeline.detectors), default=0)
                await _until(lambda: _watch(service).pipeline.behind_samples <= block)

    def _take(self, message: Received) -> None:
        if message.kind == "alarm":
            self.outcome.alarms += 1
        if message.kind == "diagnosis" and message.payload["changed"] and not self._is_repeating:
            self.outcome.diagnoses.append(message.payload)
        self._on_message(message)


def _node(bus: can.BusABC, layout: FrameLayout, script: Script) -> CanNode:
    """The device; a value beyond what its frames can hold is saturated, as by a converter, and reported."""
    try:
        return CanNode(bus, layout, script.samples, script.rate_hz, faults=script.faults)
    except LayoutError as error:
        logger.warning("%s. The device saturates such values, as an analogue input does", error)
        return CanNode(bus, layout, script.samples, script.rate_hz, faults=script.faults, clip=True)


def _watch(service: Service) -> MachineWatch:
    """The one machine of the demo."""
    [watch] = service.watches.values()
    return watch


async def _links_up(service: Service) -> None:
    publisher = service.alarms.outputs.get("mqtt")
    await _until(lambda: all(driver.link.state == "up" for driver in service.drivers))
    await _until(lambda: publisher is None or bool(publisher.figures()["connected"]))


async def _until(true: Callable[[], bool]) -> None:
    while not true():  # noqa: ASYNC110 - counters have no event to wait for
        await asyncio.sleep(0.01)


async def _first(wanted: Any, task: asyncio.Task[None], failure: str, limit_s: float) -> None:
    """Wait for ``wanted``, unless ``task`` fails before or it takes too long."""
    waiting = asyncio.ensure_future(wanted)
    try:
        await asyncio.wait({waiting, task}, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
        if task.done() and not task.cancelled() and (error := task.exception()) is not None:
            raise DemoError(f"{failure} ({error})") from error
        if not waiting.done():
            raise DemoError(f"{failure} within {limit_s:g} s")
    finally:
        waiting.cancel()


async def _unless_ended(task: asyncio.Task[None], work: Coroutine[Any, Any, T]) -> T:
    """The result of ``work``, broken off if ``task`` ends before; then what that raised is raised."""
    async with _task(work) as working:
        await asyncio.wait({working, task}, return_when=asyncio.FIRST_COMPLETED)
        if working.done():
            return working.result()
    task.result()
    raise DemoError("the service or its listener ended before everything was played; play it again")


@contextlib.asynccontextmanager
async def _task(work: Coroutine[Any, Any, T]) -> AsyncIterator[asyncio.Task[T]]:
    """A task that is cancelled at the end, if it still runs; its failure is raised where it is awaited."""
    task = asyncio.create_task(work)
    try:
        yield task
    finally:
        task.cancel()
        await asyncio.wait({task})
        if not task.cancelled():
            task.exception()


class DemoOnset(TypedDict):
    """A mode that the machine came into.

    Attributes:
        mode: name of the mode.
        onset_rev: revolution at which it came.
        declared_rev: revolution at which it was declared; null if it never was.
        delay_rev: revolutions between the two; null if it never was declared.
    """

    mode: str
    onset_rev: float
    declared_rev: float | None
    delay_rev: float | None


class DemoSamples(TypedDict):
    """What became of the samples.

    Attributes:
        sent: samples that the device sent.
        left_over: samples at the end that do not fill a frame.
        received: samples that the service received.
        lost: samples that were lost on the way.
        skipped_by_detectors: samples that detectors left out, as they were too slow.
    """

    sent: int
    left_over: int
    received: int
    lost: int
    skipped_by_detectors: int


class DemoFaultsCounted(TypedDict):
    """Frames by what was wrong with them, as the service counted.

    Attributes:
        dropped: frames that did not come.
        duplicated: frames that came twice.
        reordered: frames that came behind a later one.
        corrupted: frames that were damaged.
    """

    dropped: int
    duplicated: int
    reordered: int
    corrupted: int


class DemoFrames(TypedDict):
    """What became of the frames.

    Attributes:
        sent: frames that the device sent.
        received: frames that the service received.
        injected: what the link did to frames, by fault.
        counted: the same as the service counted it.
        not_sent: when the device sent nothing, in words.
        late: frames that came too late.
        rejected: frames that were no frames of the device.
    """

    sent: int
    received: int
    injected: dict[str, int]
    counted: DemoFaultsCounted
    not_sent: list[str]
    late: int
    rejected: int


class DemoClock(TypedDict):
    """The clock of the device, as the service measured it.

    Attributes:
        drift_ppm: how far it runs off its rate.
        jitter_ms: how irregularly blocks arrived.
    """

    drift_ppm: float
    jitter_ms: float


class DemoSummary(TypedDict):
    """The last line.

    Attributes:
        type: what the line is.
        title: what was shown.
        seed: seed of the random numbers.
        speed: speed over real time; 0 for as fast as it goes.
        simulated_s: time that was simulated, in s.
        real_s: time that it took, in s.
        declared: modes that were declared, in order.
        onsets: modes that the machine came into, in order.
        wrong_declarations: declarations while the machine was in another mode.
        samples: what became of the samples.
        frames: what became of the frames.
        clock: the clock of the device, as the service measured it.
        loop_lag_ms: lateness of the event loop, by percentile.
        alarm_events: events of alarms.
        messages: messages that came over the broker.
        snapshots: files of snapshots that were made.
        snapshots_gone: snapshots that were deleted again, as there were too many.
        complete: whether the demo went on to its end.
    """

    type: Literal["summary"]
    title: str
    seed: int
    speed: float
    simulated_s: float
    real_s: float
    declared: list[str]
    onsets: list[DemoOnset]
    wrong_declarations: int
    samples: DemoSamples
    frames: DemoFrames
    clock: DemoClock
    loop_lag_ms: dict[str, float]
    alarm_events: int
    messages: int
    snapshots: list[str]
    snapshots_gone: int
    complete: bool


class DemoMessage(TypedDict):
    """A message of the service, with all keys of its payload: `schema` has its name.

    Attributes:
        type: kind of the message.
        topic: topic of the message.
    """

    type: Literal["diagnosis", "alarm", "status"]
    topic: str


class DemoPage(TypedDict):
    """Where the page is, with `--page` only.

    Attributes:
        type: what the line is.
        address: address to look at the machine.
        operator: address to handle alarms.
    """

    type: Literal["page"]
    address: str
    operator: str


def summarise(script: Script, outcome: DemoOutcome, *, speed: float) -> DemoSummary:
    """The summary as one JSON object.

    A declaration is a change of the decision of the script's detector. Its delay counts from the onset of the
    mode, in revolutions. It is wrong if the machine was in another mode. Samples at the end that do not fill
    a frame are left over: a device would send them with the next ones.
    """
    declared = [
        (str(payload["decision"]), int(payload["window"]["end_index"]))
        for payload in outcome.diagnoses
        if payload["detector"] == script.detector
    ]
    figures = outcome.figures
    stream = figures["streams"][script.stream]
    frames_lost = stream["samples_lost"] // max(outcome.samples_sent // max(outcome.frames_in, 1), 1)
    return {
        "type": "summary",
        "title": script.title,
        "seed": script.seed,
        "speed": speed,
        "simulated_s": script.duration_s,
        "real_s": outcome.real_s,
        "declared": [mode for mode, _ in declared],
        "onsets": _onsets(script, declared),
        "wrong_declarations": sum(not _true_at(script.onsets, mode, at) for mode, at in declared)
        if script.onsets
        else 0,
        "samples": {
            "sent": outcome.samples_sent,
            "left_over": len(script.samples) - outcome.samples_sent,
            "received": stream["samples_received"],
            "lost": stream["samples_lost"],
            "skipped_by_detectors": sum(d["samples_skipped"] for d in figures["detectors"].values()),
        },
        "frames": {
            "sent": outcome.frames_sent,
            "received": stream["frames_received"],
            "injected": outcome.injected,
            "counted": {
                "dropped": frames_lost - stream["frames_corrupt"],
                "duplicated": stream["frames_duplicate"],
                "reordered": stream["frames_reordered"],
                "corrupted": stream["frames_corrupt"],
            },
            "not_sent": _not_sent(script),
            "late": stream["frames_late"],
            "rejected": stream["frames_rejected"],
        },
        "clock": {"drift_ppm": stream["drift_ppm"], "jitter_ms": stream["jitter_ms"]},
        "loop_lag_ms": figures["loop_lag_ms"],
        "alarm_events": outcome.alarms,
        "messages": outcome.messages,
        "snapshots": [f"{path}" for path in outcome.snapshots],
        "snapshots_gone": outcome.snapshots_gone,
        "complete": outcome.complete,
    }


def _not_sent(script: Script) -> list[str]:
    """When the device sends nothing, in words: frames that it would have sent count as lost, too."""
    if not isinstance(script.faults, NodeFaults):
        return []  # none, or a link's only
    seconds = {
        what: sum(min(window.end_s, script.duration_s) - window.start_s for window in windows)
        for what, windows in (("silence", script.faults.silence), ("brown-out", script.faults.brown_out))
    }
    return [f"{length:g} s of {what}" for what, length in seconds.items() if length > 0.0]


def _onsets(script: Script, declared: Sequence[tuple[str, int]]) -> list[DemoOnset]:
    rows: list[DemoOnset] = []
    per_rev = script.samples_per_rev or 1.0
    for i, onset in enumerate(script.onsets):
        end = script.onsets[i + 1].sample if i + 1 < len(script.onsets) else len(script.samples)
        at = next((at for mode, at in declared if mode == onset.mode and onset.sample <= at <= end), None)
        rows.append(
            {
                "mode": onset.mode,
                "onset_rev": onset.at_rev,
                "declared_rev": None if at is None else at / per_rev,
                "delay_rev": None if at is None else (at - onset.sample) / per_rev,
            }
        )
    return rows


def _true_at(onsets: Sequence[Onset], mode: str, sample: int) -> bool:
    true = onsets[0].mode
    for onset in onsets:
        if onset.sample <= sample:
            true = onset.mode
    return mode == true
