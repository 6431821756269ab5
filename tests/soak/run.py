"""One service, machines on buses of every kind, and all that befalls them; kept in books all the while."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import sqlite3
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nothing_lost.broker import Broker, signal_child
from nothing_lost.consumer import Consumer
from nothing_lost.disk import SmallDisk, small_disk
from soak.alarms import Cycle, Evidence, read_journal, told_by
from soak.books import Ledger, TrendBook
from soak.devices import CALM_G, LOUD_G, Plant
from soak.figures import Census, Trend, cpu_s, lowest, rss_bytes
from soak.machines import ANOTHER_SENSOR, BUS_OF, SETPOINTS_G, SPARE, machine_files
from support.tcp_proxy import FaultyProxy

from daqsvc.control import ControlError, ask_reload, ask_status
from daqsvc.settings import parse_machine_file

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine

    Fault = Callable[[], Coroutine[None, None, None]]

ROOT = Path(__file__).parents[2]
PATIENCE_S = 300.0
"""How long to wait for what must happen, on a busy machine, too; nothing is timed by it."""
LOOK_S = 1.0
SETTLED_S, WARM_UP_S = 60.0, 120.0
"""Of a life: until all is open that will be, and until caches and the heaps of all threads are filled."""
SHARE_WITH_KILLS = 1 / 3
"""Of the time; in the rest the process lives on, so that its memory can be watched."""
DISK_MB, FILLS = 64, 15


class SoakError(Exception):
    """Something that must happen did not; the text is a sentence."""


@dataclass
class Report:
    """A soak that is over.

    Attributes:
        violations: what was not kept, a sentence each; empty if all was.
        befell: how often what befell the service.
        lives: how often the process was started.
        ledger: the books of the samples.
        evidence: of the alarms.
        memory: of the process in its last life; None if that was too short to say.
        census: what it had open, at first and at last.
        duration_s: of all.
        cpu_share: of a core that the service took in its last life.
        own_cpu_share: of a core that devices, consumer and books took.
        stood_still_s: how long these stood still each time, starved by the host.
        directory: where its traces are.
    """

    violations: list[str]
    befell: Counter[str]
    lives: int
    ledger: Ledger
    evidence: Evidence
    memory: Trend | None
    census: tuple[Census | None, Census | None]
    duration_s: float
    cpu_share: float
    own_cpu_share: float
    stood_still_s: list[float]
    directory: Path

    def __str__(self) -> str:
        evidence = self.evidence
        raised = sum(turn.active for turn in evidence.turns)
        forgotten = len(evidence.forgotten - evidence.arrivals.keys())
        lines = [
            f"{self.duration_s:.0f} s, {self.lives} lives of the process",
            f"of a core: the service {self.cpu_share:.1%}, devices and books {self.own_cpu_share:.1%}",
            f"these stood still {len(self.stood_still_s)} times, for {sum(self.stood_still_s):.1f} s",
            "what befell it: " + ", ".join(f"{kind} {times}" for kind, times in sorted(self.befell.items())),
            "stream       books  compared   received      lost    of these unsent",
        ]
        lines += [
            f"{name:12} {one.books:5d}  {one.entries:8d}  {one.received:9d}  {one.lost:8d}  {one.unsent:15d}"
            for name, one in self.ledger.totals.items()
        ]
        lines += [
            f"alarms by the scenario: {raised} raised, {len(evidence.turns) - raised} returned",
            f"alarm events: {len(evidence.journal)} in the journal, {len(evidence.arrivals)} arrived",
            f"of these {evidence.repeats} came again; {forgotten} died with the broker",
            f"memory: {self.memory or 'not watched for long enough'}",
            f"open at first: {self.census[0]}; at last: {self.census[1]}",
        ]
        if not self.befell["disk full"]:
            lines.append("no disk was filled: it was not asked for, or this machine lets nobody mount one")
        if self.violations:
            more = len(self.violations) - 20
            lines += [f"NOT KEPT: {sentence}" for sentence in self.violations[:20]]
            lines += [f"and {more} more"] * (more > 0) + [f"see {self.directory}"]
        return "\n".join(lines)


@dataclass
class Soak:
    """Everything that takes part."""

    directory: Path
    seconds: float
    rng: random.Random
    plant: Plant
    broker: Broker
    proxy: FaultyProxy
    consumer: Consumer
    disk: SmallDisk | None
    files: dict[str, str]
    environment: dict[str, str]
    only: tuple[str, ...] = ()
    process: asyncio.subprocess.Process | None = None
    shown: dict[str, dict[str, Any]] = field(default_factory=dict)
    looks: int = 0
    ledger: Ledger = field(default_factory=Ledger)
    evidence: Evidence = field(default_factory=Evidence)
    cycles: dict[str, Cycle] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)
    befell: Counter[str] = field(default_factory=Counter)
    flaps: Counter[str] = field(default_factory=Counter)
    lives: int = 0
    memory: list[tuple[float, int]] = field(default_factory=list)
    first_census: Census | None = None
    last_census: Census | None = None
    _begun_s: float = field(default_factory=time.monotonic)
    _life_s: float = 0.0
    _life_cpu_s: float = 0.0
    _talking: asyncio.Lock = field(default_factory=asyncio.Lock)
    """Held while the service is asked, and while its figures change their meaning."""

    @property
    def store(self) -> Path:
        return self.directory / "disk" / "box"

    @property
    def machine_directory(self) -> Path:
        return self.directory / "plant"

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self._begun_s

    def say(self, sentences: list[str]) -> None:
        """Note what does not hold."""
        self.violations += sentences

    # The service, and what it says.

    async def start(self) -> None:
        """Start the service and wait until it is well."""
        command = [
            sys.executable,
            "-m",
            "daqsvc",
            "run",
            f"{self.machine_directory}",
            "--store",
            f"{self.store}",
        ]
        with (self.directory / "service.log").open("ab") as log:
            self.process = await asyncio.create_subprocess_exec(*command, stderr=log, env=self.environment)
        self.lives += 1
        self.shown, self.memory, self.first_census = {}, [], None
        self._life_s, self._life_cpu_s = time.monotonic(), 0.0
        for name in (file.stem for file in self.machine_directory.glob("*.toml")):
            self.ledger.open(self.plant.devices[name])
        self.ledger.trend = TrendBook("fan/temperature", self.plant.answered)
        await self.well(*self.ledger.books)

    async def stop(self, how: signal.Signals) -> int:
        """End the service; its exit code."""
        assert self.process is not None
        process, self.process = self.process, None
        signal_child(process, how)
        return await asyncio.wait_for(process.wait(), PATIENCE_S)

    async def look(self) -> None:
        """Ask the service how it stands, and hold that against all that is known."""
        disturbances = {name: device.disturbances for name, device in self.plant.devices.items()}
        steady = {name: device.steady for name, device in self.plant.devices.items()}
        try:
            told = await asyncio.to_thread(ask_status, self.store)
        except ControlError:
            return  # it starts, or the machine is very busy
        self.shown = {status["machine"]: status for status in told}
        self.looks += 1
        for name, status in self.shown.items():
            streams = status["figures"]["streams"]
            if (book := self.ledger.books.get(name)) is not None:
                newest = {(one["stream"], one["channel"]): one["value"] for one in status["channels"]}
                device = self.plant.devices[name]
                # What happened to the wire since it was asked may have happened before it has answered.
                undisturbed = steady[name] and device.disturbances == disturbances[name]
                self.say(
                    list(
                        book.enter(
                            streams["casing"], newest["casing", "n"], device.disturbances, steady=undisturbed
                        )
                    )
                )
                device.read_to(book.next_number)
            if name == "fan" and self.ledger.trend is not None:
                self.say(list(self.ledger.trend.enter(streams["temperature"], self.plant.answered)))
            cycle = self.cycles.get(name)
            if cycle is not None and cycle.look(status, time.monotonic_ns()):
                self.plant.devices[name].rms_g = LOUD_G if cycle.active else CALM_G
                self.evidence.turns.append(cycle.turns.pop())

    async def watch(self) -> None:
        """Look again and again, for as long as this is not cancelled."""
        rounds = 0
        while True:
            async with self._talking:
                if self.process is not None:
                    await self.look()
                    self._read_memory()
            rounds += 1
            if rounds % 10 == 0:
                await self.file_alarms()
            await asyncio.sleep(LOOK_S)

    def _read_memory(self) -> None:
        if self.process is not None and self.process.returncode is None:
            self.memory.append((time.monotonic(), rss_bytes(self.process.pid)))
            self._life_cpu_s = cpu_s(self.process.pid)

    async def file_alarms(self) -> None:
        """Take in what the journal and the consumer have got meanwhile."""
        self.evidence.archive(await asyncio.to_thread(self._journalled, self.evidence.read_to))
        arrivals = []
        while self.consumer.arrivals:
            arrivals.append(self.consumer.arrivals.pop(0).payload)
        self.say(told_by(arrivals, self.evidence))

    def _journalled(self, after: int) -> list[Any]:
        with contextlib.suppress(sqlite3.Error):  # while it is being made, or the disk is full
            return read_journal(self.store, after)
        return []

    async def until(self, condition: Callable[[], object], what: str) -> None:
        """Wait for a condition on what the service has said last.

        Raises:
            SoakError: it did not come true, or the service has ended by itself.
        """
        until_s = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > until_s:
                raise SoakError(f"waited {PATIENCE_S:g} s in vain until {what}")
            if self.process is not None and self.process.returncode is not None:
                raise SoakError(
                    f"the service ended by itself with code {self.process.returncode} before {what}; see "
                    f"{self.directory / 'service.log'}"
                )
            await asyncio.sleep(0.05)

    def bus_is(self, name: str, state: str) -> bool:
        """Whether the service says so of the bus of a machine."""
        return name in self.shown and self.shown[name]["buses"][BUS_OF[name]]["state"] == state

    async def well(self, *disturbed: str) -> None:
        """Wait until all is as it should be, and what was disturbed is read on steadily again."""
        for name in self.ledger.books:
            await self.until(partial(self.bus_is, name, "up"), f"the bus of {name} is up")
        for name in disturbed:
            device, book = self.plant.devices[name], self.ledger.books[name]
            by_now = device.count
            await self.until(
                lambda book=book, by_now=by_now: book.entries and book.next_number > by_now,
                f"the service has samples that {name} took after its bus came back",
            )
            device.steady = True
        await self.until(self._outbox_is_well, "the broker has all that is in the journal")

    def _outbox_is_well(self) -> bool:
        if not self.shown:
            return False
        status = next(iter(self.shown.values()))
        outbox = status["outbox"]
        return bool(
            status["outputs"]["mqtt"]["connected"]
            and outbox["journal"] == "written"
            and outbox["waiting"] == 0
            and not status["figures"]["outbox"]["telemetry"]["in_memory"]
            and outbox["depth"] <= 2  # alarms come and go all the while
        )

    async def count(self) -> None:
        """Hold what the process has open against what it had in the same state before."""
        assert self.process is not None
        if time.monotonic() - self._life_s < SETTLED_S:
            return
        until_s = time.monotonic() + PATIENCE_S
        while True:
            async with self._talking:
                self.last_census = await lowest(self.process.pid)
            self.first_census = self.first_census or self.last_census
            different = self.last_census.against(self.first_census)
            if not different:
                return
            if time.monotonic() > until_s:
                self.say([f"in the same state as before the process has {different}"])
                return

    # What befalls it. Each makes all well again.

    def some_s(self, most: float) -> float:
        return self.rng.uniform(0.0, most)

    async def flap(self, name: str) -> None:
        """A bus goes, and comes back."""
        device = self.plant.devices[name]
        device.disturb()
        await self.plant.wires[name].pull()
        await self.until(
            partial(self.bus_is, name, "down"), f"the service says that the bus of {name} is down"
        )
        await asyncio.sleep(self.some_s(3.0))
        if device.keeps and self.flaps[name] % 2 == 0:
            overwritten = device.count + device.keeps
            await self.until(lambda: device.count > overwritten, "what the device keeps is overwritten")
        self.flaps[name] += 1
        await self.plant.wires[name].plug()
        device.disturb()
        await self.well(name)

    async def silence(self, name: str) -> None:
        """A device sends nothing for a while, and goes on counting."""
        device = self.plant.devices[name]
        device.silent = True
        await asyncio.sleep(0.2 + self.some_s(4.0))
        device.silent = False
        await self.well()

    async def broker_killed(self) -> None:
        """The broker forgets everything, and is started again."""
        await self.broker.kill()
        self.proxy.blocked = True
        self.proxy.reset()
        await asyncio.sleep(self.some_s(3.0))
        self.consumer.subscribed.clear()
        await self.broker.start()
        await self.consumer.is_listening()
        # What it had acknowledged and not passed on is its own loss.
        self.evidence.forgotten |= self.proxy.tap.acknowledged.keys() - self.consumer.ids
        self.proxy.tap.acknowledged.clear()
        self.proxy.blocked = False
        await self.well()

    async def disk_full(self) -> None:
        """Somebody else fills the disk again and again, until the journal takes nothing, or has held out."""
        assert self.disk is not None
        assert self.process is not None
        try:
            for _ in range(FILLS):
                # As long as there is something old to delete the journal goes on: then it has held.
                if any(one["outbox"]["journal"] == "not written" for one in self.shown.values()):
                    break
                self.disk.fill(self.process.pid)
                await self.until(lambda n=self.looks: self.looks > n, "the service says how it stands")
            await asyncio.sleep(self.some_s(5.0))
        finally:
            self.disk.free(self.process.pid)
        await self.well()

    async def killed(self) -> None:
        """The process is killed, and started again."""
        async with self._talking:
            await self.look()
            await self.stop(signal.SIGKILL)
            for name in [*self.ledger.books]:
                self.plant.devices[name].disturb()
                self.ledger.close(name)
        await asyncio.sleep(self.some_s(2.0))
        await self.start()

    async def setpoint(self) -> None:
        """An alarm gets another setpoint; every bus goes on without a break."""
        name = self.rng.choice(["pump", "gear", "mill", "saw"])
        file, (low, high) = self.file_of(name), SETPOINTS_G
        text = file.read_text()
        old, new = (low, high) if f"alert = {low}" in text else (high, low)
        file.write_text(text.replace(f"alert = {old}", f"alert = {new}"))
        await self.reload([f"machine {name}: other alarms or setpoints"])
        await self.well()

    async def another_sensor(self) -> None:
        """A machine gets another sensor, and loses it again; its bus begins again, and no other."""
        file = self.file_of("fan")
        for text, how in ((self.files["fan"] + ANOTHER_SENSOR, "new"), (self.files["fan"], "gone")):
            file.write_text(text)
            async with self._anew("fan"):
                asked_before = self.plant.answered
                await self.reload(
                    [
                        f"machine fan: detectors begin again (sensors.count is {how}, bus tcp)",
                        "bus tcp is opened again (units)",
                    ]
                )
                self.ledger.open(self.plant.devices["fan"])
                self.ledger.trend = TrendBook("fan/temperature", asked_before)
            await self.well("fan")
            await asyncio.sleep(self.some_s(3.0))

    async def another_machine(self) -> None:
        """A machine comes, and goes again, with a bus of its own."""
        file = self.file_of(SPARE)
        file.write_text(self.files[SPARE])
        async with self._anew(SPARE):
            await self.reload([f"machine {SPARE} is watched from now on", "bus spare is opened"])
            self.ledger.open(self.plant.devices[SPARE])
        await self.well(SPARE)
        await asyncio.sleep(self.some_s(5.0))
        file.unlink()
        async with self._anew(SPARE):
            self.ledger.close(SPARE)
            await self.reload([f"machine {SPARE} is no longer watched", "bus spare is closed"])
        await self.well()

    async def wrong_file(self) -> None:
        """A machine file with an error is refused, and all goes on."""
        name = self.rng.choice(sorted(self.ledger.books))
        file = self.file_of(name)
        text = file.read_text()
        file.write_text(text.replace("window_s = 1.0", 'window_s = "long"'))
        await self.reload(['pipeline.levels.window_s = "long"'], accepted=False)
        file.write_text(text)
        await self.reload([])
        await self.well()

    def file_of(self, name: str) -> Path:
        """The file of a machine, as the service reads it."""
        return self.machine_directory / f"{name}.toml"

    async def reload(self, wanted: list[str], *, accepted: bool = True) -> None:
        """Have the machine files read again.

        Raises:
            SoakError: the service says something else than what is wanted.
        """
        try:
            answer = await asyncio.to_thread(ask_reload, self.store)
        except ControlError as error:
            raise SoakError(f"a reload was not answered: {error}") from error
        said = "\n".join(answer.lines)
        if answer.accepted != accepted or not all(line in said for line in wanted) or (said and not wanted):
            raise SoakError(f"a reload should say {wanted}, and says {said or answer.reason or 'nothing'!r}")

    @contextlib.asynccontextmanager
    async def _anew(self, name: str) -> AsyncIterator[None]:
        """While this is entered the service begins to count a machine anew, and is asked nothing."""
        async with self._talking:
            await self.look()
            self.plant.devices[name].disturb()
            yield

    async def come_to_rest(self) -> None:
        """Let the alarms stand as they are, and wait until all of them have arrived."""
        at_rest, self.cycles = self.cycles, {}
        for name, cycle in at_rest.items():
            await self.until(
                lambda name=name, cycle=cycle: cycle.stands(self.shown[name]), f"the alarm of {name} stands"
            )
        until_s = time.monotonic() + PATIENCE_S
        while True:
            await self.file_alarms()
            missing = self.evidence.missing()
            if not missing or time.monotonic() > until_s:
                return  # what is missing now is said with all else that does not hold
            await asyncio.sleep(LOOK_S)

    def faults(self) -> dict[str, Fault]:
        """All that can befall it, by what it is called."""
        steady = [name for name in self.plant.devices if name != SPARE]
        faults: dict[str, Fault] = {f"bus {BUS_OF[name]} flaps": partial(self.flap, name) for name in steady}
        faults |= {
            "CAN device silent": partial(self.silence, "pump"),
            "serial device silent": partial(self.silence, "mill"),
            "broker killed": self.broker_killed,
            "process killed": self.killed,
            "another setpoint": self.setpoint,
            "another sensor": self.another_sensor,
            "another machine": self.another_machine,
            "wrong machine file": self.wrong_file,
        }
        if self.disk is not None:
            faults["disk full"] = self.disk_full
        return faults

    async def befall(self) -> None:
        """Have everything befall it once, in any order, and again until the time is over."""
        while self.elapsed_s < self.seconds or not self.befell:
            faults = self.faults()
            faults = {kind: faults[kind] for kind in self.only or faults}
            order = self.rng.sample(sorted(faults), k=len(faults))
            for kind in order:
                late = self.elapsed_s > SHARE_WITH_KILLS * self.seconds and self.befell["process killed"]
                if (kind == "process killed" and late and len(faults) > 1) or (
                    self.elapsed_s > self.seconds and len(self.befell) == len(faults)
                ):
                    continue
                await faults[kind]()
                self.befell[kind] += 1
                await self.count()


async def soak(seconds: float, directory: Path, seed: int = 1, only: tuple[str, ...] = ()) -> Report:
    """Let everything happen for so long, and see what was kept.

    Args:
        seconds: how long; at least until everything has befallen it once.
        directory: an empty one, for all that it leaves behind.
        seed: of what is measured, and of what happens when.
        only: what befalls it, by its names in the report; all of it if empty.
    """
    tests = ROOT / "tests"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([f"{ROOT}", f"{tests}"])}
    (directory / "plant").mkdir()
    async with contextlib.AsyncExitStack() as cleanup:
        disk = await cleanup.enter_async_context(small_disk(directory / "disk", DISK_MB))
        broker = Broker("mosquitto", directory, environment, verbose=False)
        cleanup.push_async_callback(broker.kill)
        await broker.start()
        proxy = await cleanup.enter_async_context(FaultyProxy(broker.port))
        consumer = await cleanup.enter_async_context(Consumer(broker.port, "daqsvc/+/+/+/alarms/#"))
        plant = Plant(directory, seed)
        files = machine_files(plant, directory / "disk" / "box", proxy.port)
        for name, text in files.items():
            if name != SPARE:
                (directory / "plant" / f"{name}.toml").write_text(text)
        plant.wire({name: parse_machine_file(text, directory / name) for name, text in files.items()})
        await cleanup.enter_async_context(plant)
        one = Soak(
            directory,
            seconds,
            random.Random(f"soak {seed}"),
            plant,
            broker,
            proxy,
            consumer,
            disk if isinstance(disk, SmallDisk) else None,
            files,
            environment,
            only,
        )
        try:
            return await _carried_out(one)
        finally:
            if one.process is not None:
                await one.stop(signal.SIGKILL)


async def _carried_out(one: Soak) -> Report:
    own_s, begun_s = time.process_time(), time.monotonic()
    for name in one.files:
        if name != SPARE:
            one.cycles[name] = Cycle(name, active=True, begun_ns=time.monotonic_ns())
            one.plant.devices[name].rms_g = LOUD_G
    async with _beside(one.watch()):
        try:
            await one.start()
            await one.befall()
            await one.come_to_rest()
        except (SoakError, OSError) as error:
            one.say([f"{error}"])
    cpu_share = one._life_cpu_s / max(time.monotonic() - one._life_s, 1e-9)
    for name in [*one.ledger.books]:
        one.ledger.close(name)
    if one.process is not None:
        code = await one.stop(signal.SIGTERM)
        one.say([f"the service ended with code {code} when it was told to"] * (code != 0))
    await one.file_alarms()
    one.say(one.evidence.violations())
    warm = [reading for reading in one.memory if reading[0] > one._life_s + WARM_UP_S]
    try:
        memory = Trend.of(warm)
        one.say(memory.violations())
    except ValueError:
        memory = None
    return Report(
        one.violations,
        one.befell,
        one.lives,
        one.ledger,
        one.evidence,
        memory,
        (one.first_census, one.last_census),
        time.monotonic() - begun_s,
        cpu_share,
        (time.process_time() - own_s) / (time.monotonic() - begun_s),
        one.plant.stood_still_s,
        one.directory,
    )


@contextlib.asynccontextmanager
async def _beside(work: Coroutine[None, None, None]) -> AsyncIterator[None]:
    task = asyncio.create_task(work)
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait({task})
        if not task.cancelled():
            task.result()
