"""One randomised run: a teller, a proxy, a broker, a consumer, and what befalls them."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import random
import signal
import sqlite3
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nothing_lost.broker import Broker, BrokerName, signal_child
from nothing_lost.checker import Evidence, Verdict, journal_of
from nothing_lost.consumer import Consumer
from nothing_lost.disk import small_disk
from nothing_lost.script import Script
from nothing_lost.teller import Witness, may_end, settled_to
from support.tcp_proxy import FaultyProxy

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from nothing_lost.disk import Disk

TESTS = Path(__file__).parents[1]
FINISH_S = 60.0
"""How long a teller that nobody disturbs any more may take to its end; nothing is timed by it."""

NOTICED_S = 6.0
"""How long it may take until the journal finds that its disk has room again."""

DISTURBANCES = 7
KILLS_AT_LEAST = 2
Mutation = Literal["none", "bypass", "forget-early"]


@dataclass(frozen=True)
class Course:
    """What a run is made of; everything else follows from the seed.

    Attributes:
        seed: of the script and of what befalls it.
        broker: which one.
        mutation: what is broken on purpose.
        befalls: names of what shall befall it, in place of what the seed says.
    """

    seed: int
    broker: BrokerName = "mosquitto"
    mutation: Mutation = "none"
    befalls: tuple[str, ...] = ()

    @property
    def protocol(self) -> str:
        """amqtt hangs on a CONNECT of MQTT 5."""
        return "3.1.1" if self.broker == "amqtt" or self.seed % 4 == 0 else "5"

    @property
    def fills_the_disk(self) -> bool:
        """Every third run."""
        return self.seed % 3 == 0


@dataclass
class Report:
    """A run that is over: what was kept, and what it was put through."""

    course: Course
    verdict: Verdict
    befell: list[str]
    kills: int
    crashes: int
    duration_s: float
    directory: Path

    def __str__(self) -> str:
        lines = [f"seed {self.course.seed} on {self.course.broker}: {', '.join(self.befell)}"]
        return "\n  ".join([*lines, *self.verdict.violations[:10], f"see {self.directory}"])


@dataclass
class Stage:
    """Everything that can be disturbed."""

    course: Course
    directory: Path
    proxy: FaultyProxy
    broker: Broker
    consumer: Consumer
    disk: Disk | None
    rng: random.Random
    environment: dict[str, str]
    teller: asyncio.subprocess.Process | None = None
    befell: list[str] = field(default_factory=list)
    kills: int = 0
    failures: list[str] = field(default_factory=list)
    crashes: int = 0
    disk_is_full: bool = False
    disk_was_full: bool = False
    disk_excuses: bool = False
    killed_on_full_disk: bool = False
    freed_s: float = 0.0
    restart_after_s: float = 0.0
    forgotten: dict[str, bytes] = field(default_factory=dict)

    @property
    def store(self) -> Path:
        return self.directory / "store"

    @property
    def witness(self) -> Path:
        return self.directory / "witness"

    async def supervise(self) -> None:
        """Start the teller again whenever it ends, as systemd would, until it ends of itself."""
        with (self.directory / "teller.log").open("ab") as log:
            while True:
                self.disk_excuses = self.disk_is_full
                self.teller = await asyncio.create_subprocess_exec(
                    sys.executable, "-m", "nothing_lost.teller", str(self.store / "box"), str(self.witness),
                    str(self.course.seed), "127.0.0.1", str(self.proxy.port), self.course.protocol,
                    "--mutation", self.course.mutation,
                    stdout=log, stderr=log, env=self.environment,
                )  # fmt: skip
                code = await self.teller.wait()
                if code == 0:
                    return
                killed = code == -signal.SIGKILL
                self.crashes += not killed
                if not (killed or self.disk_excuses):
                    self.failures.append(f"the teller ended by itself with code {code}; see teller.log")
                    return
                await asyncio.sleep(self.restart_after_s if killed else 0.2)

    def signal_teller(self, number: signal.Signals) -> bool:
        """Whether there was one to receive it."""
        return self.teller is not None and signal_child(self.teller, number)

    async def end(self) -> None:
        """Leave no teller behind."""
        if self.signal_teller(signal.SIGKILL) and self.teller is not None:
            await self.teller.wait()

    # What may befall it. Each takes a moment and leaves everything well again, except for what it broke.

    def some_s(self, least: float, most: float) -> float:
        return self.rng.uniform(least, most)

    async def kill(self) -> None:
        self.restart_after_s = self.some_s(0.0, 0.2)
        while not self.signal_teller(signal.SIGKILL):
            if self.teller is not None and self.teller.returncode == 0:
                return
            await asyncio.sleep(0.01)
        self.kills += 1
        is_full = self.disk_is_full or time.monotonic() - self.freed_s < NOTICED_S
        self.killed_on_full_disk |= self.disk_was_full and is_full

    async def kill_twice(self) -> None:
        """The second time while it starts."""
        await self.kill()
        await asyncio.sleep(self.restart_after_s + self.some_s(0.0, 0.6))
        await self.kill()

    async def suspend(self) -> None:
        self.signal_teller(signal.SIGSTOP)
        await asyncio.sleep(self.some_s(0.1, 0.6))
        self.signal_teller(signal.SIGCONT)

    async def suspend_for_long(self) -> None:
        """Longer than the broker waits for a sign of life."""
        self.signal_teller(signal.SIGSTOP)
        await asyncio.sleep(4.0)
        self.signal_teller(signal.SIGCONT)

    async def reset(self) -> None:
        self.proxy.reset()

    async def reset_in_a_packet(self) -> None:
        self.proxy.reset_after(self.rng.randrange(1, 4000))
        await asyncio.sleep(self.some_s(0.1, 0.3))

    async def refuse(self) -> None:
        self.proxy.blocked = True
        self.proxy.reset()
        await asyncio.sleep(self.some_s(0.1, 0.7))
        self.proxy.blocked = False

    async def half_open(self) -> None:
        """Reset after a silence, as by a gateway that has lost its table."""
        self.proxy.silence()
        await asyncio.sleep(self.some_s(0.1, 0.5))
        self.proxy.reset()

    async def half_open_for_good(self) -> None:
        self.proxy.silence()

    async def latency(self) -> None:
        self.proxy.latency_s = self.some_s(0.005, 0.1)
        await asyncio.sleep(self.some_s(0.2, 0.6))
        self.proxy.latency_s = 0.0

    async def one_byte_slices(self) -> None:
        self.proxy.slice_bytes = 1
        await asyncio.sleep(self.some_s(0.1, 0.4))
        self.proxy.slice_bytes = 0

    async def frozen_broker(self) -> None:
        self.broker.freeze()
        await asyncio.sleep(self.some_s(0.1, 0.8))
        self.broker.thaw()

    async def consumer_away(self) -> None:
        await self.consumer.nap(self.some_s(0.1, 0.6))

    async def broker_restart(self) -> None:
        """The broker forgets everything, but only after it has passed on what it had acknowledged."""
        self.proxy.blocked = True
        self.proxy.reset()
        await self.consumer.has(set(self.proxy.tap.acknowledged), timeout_s=5.0)
        await self._another_broker()

    async def broker_kill(self) -> None:
        """The broker forgets everything at any moment: what it had acknowledged is its own loss."""
        await self.broker.kill()
        self.proxy.blocked = True
        self.proxy.reset()
        self.forgotten |= self.proxy.tap.acknowledged
        await self._another_broker()

    async def _another_broker(self) -> None:
        await self.broker.kill()
        await asyncio.sleep(self.some_s(0.0, 0.4))
        self.consumer.subscribed.clear()
        await self.broker.start()
        await self.consumer.is_listening()
        self.proxy.blocked = False

    async def disk_full(self) -> None:
        if self.disk is None or self.teller is None:
            return
        self.disk_is_full = self.disk_was_full = self.disk_excuses = True
        self.disk.fill(self.teller.pid)
        await asyncio.sleep(self.some_s(0.1, 0.6))
        if self.rng.random() < 0.4:
            await self.kill()
            await asyncio.sleep(self.some_s(0.0, 0.8))
        self.disk.free(self.teller.pid)
        self.disk_is_full, self.freed_s = False, time.monotonic()

    def plan(self) -> list[tuple[int, Callable[[], Coroutine[None, None, None]]]]:
        """What will befall this run, each with the step of the script that is told by then."""
        if self.course.befalls:
            plan = [getattr(self, name) for name in self.course.befalls]
        else:
            plan = [self.kill] * KILLS_AT_LEAST
            plan += self.rng.choices(self._kinds(), k=DISTURBANCES - KILLS_AT_LEAST)
            plan += [self.disk_full] if self.disk is not None else []
            self.rng.shuffle(plan)
        last = len(Script.of_seed(self.course.seed).steps) - 10
        return list(zip(sorted(self.rng.sample(range(last), k=len(plan))), plan, strict=True))

    def _kinds(self) -> list[Callable[[], Coroutine[None, None, None]]]:
        kinds = [
            self.kill, self.kill_twice, self.suspend,
            self.reset, self.reset_in_a_packet, self.refuse, self.half_open, self.half_open_for_good,
            self.latency, self.one_byte_slices, self.frozen_broker, self.broker_restart, self.broker_kill,
        ]  # fmt: skip
        # amqtt itself mixes up what it has kept for a consumer that comes back.
        return kinds if self.course.broker == "amqtt" else [*kinds, self.consumer_away]

    async def up_to_date(self, timeout_s: float) -> None:
        """Wait until the consumer has all that is on disk but what the broker forgot, and each last state."""
        last_step = Script.of_seed(self.course.seed).steps[-1].number
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            await asyncio.sleep(0.05)
            if Witness.read(self.witness).settled < last_step:
                continue
            with contextlib.suppress(sqlite3.Error):  # of a journal that is being made or written
                journal = journal_of(self.store / "box")
                last_states = {json.loads(payload)["alarm"]: name for name, payload in journal.items()}
                wanted = journal.keys() - self.forgotten.keys() | set(last_states.values())
                if wanted <= self.consumer.ids:
                    return

    async def disturb(self) -> None:
        """Let the plan happen; what only slows things down goes on while the next is happening."""
        meanwhile = []
        for step, befalls in self.plan():
            while settled_to(self.witness) < step:
                await asyncio.sleep(0.02)
            await asyncio.sleep(self.some_s(0.0, 0.05))
            self.befell.append(befalls.__name__.replace("_", " "))
            if befalls in (self.latency, self.one_byte_slices, self.suspend):
                meanwhile.append(asyncio.create_task(befalls()))
            else:
                await befalls()
        await asyncio.gather(*meanwhile)


async def run(course: Course, directory: Path) -> Report:
    """Let a run happen and judge it.

    Args:
        course: what to run.
        directory: an empty one, for everything that the run leaves behind.
    """
    begun_s = time.monotonic()
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")])}
    async with contextlib.AsyncExitStack() as cleanup:
        store = directory / "store"
        if course.fills_the_disk:
            disk: Disk | None = await cleanup.enter_async_context(small_disk(store))
        else:
            store.mkdir()
            disk = None
        broker = Broker(course.broker, directory, environment)
        cleanup.push_async_callback(broker.kill)
        await broker.start()
        proxy = await cleanup.enter_async_context(FaultyProxy(broker.port))
        consumer = await cleanup.enter_async_context(Consumer(broker.port))
        rng = random.Random(f"disturbances {course.seed}")
        stage = Stage(course, directory, proxy, broker, consumer, disk, rng, environment)
        cleanup.push_async_callback(stage.end)
        teller = asyncio.create_task(stage.supervise())
        disturb = asyncio.create_task(stage.disturb())
        cleanup.push_async_callback(_cancel, teller, disturb)

        await asyncio.wait({teller, disturb}, timeout=2 * FINISH_S, return_when=asyncio.FIRST_COMPLETED)
        if disturb.done():
            disturb.result()
        else:
            stage.failures.append(f"what should befall it did not: {stage.befell[-1]} has no end")
        await _cancel(disturb)
        proxy.heal()
        # A teller that ended before its broker forgets everything could not tell it again.
        await stage.up_to_date(FINISH_S if course.mutation == "none" else 5.0)
        may_end(stage.witness).touch()
        await asyncio.wait({teller}, timeout=FINISH_S)
        if teller.done():
            teller.result()
        journal = journal_of(store / "box")

        evidence = Evidence(
            Script.of_seed(course.seed),
            Witness.read(stage.witness),
            journal,
            list(consumer.arrivals),
            stage.forgotten,
            set(proxy.tap.acknowledged) if stage.disk_was_full else set(),
            stage.killed_on_full_disk,
        )
        verdict = Verdict.on(evidence)
        verdict.violations[:0] = stage.failures
        return Report(
            course, verdict, stage.befell, stage.kills, stage.crashes, time.monotonic() - begun_s, directory
        )


async def _cancel(*tasks: asyncio.Task[None]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
