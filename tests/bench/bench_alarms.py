"""How fast an alarm is on disk and at the broker, what a flood and a backlog cost, and what memory they take.

Run by ``make bench``; needs Mosquitto. The disk's own sync and a bare client that keeps nothing are
measured in the same run, so that the ratios hold on any machine.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import paho.mqtt.client as paho
from nothing_lost.broker import LOOPBACK, Broker, mosquitto_program
from support.alarm_desk import alarm_service
from support.mqtt_publishing import mqtt, outputs
from targets import Targets

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import DiagnosisRule
from daqsvc.diagnosis.record import Diagnosis, Severity

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from daqsvc.alarm_service import AlarmService

SINGLE = 300
"""Alarms that are timed one by one."""

FLOOD_PER_S = 500
FLOOD_BEHIND_S = 1.0
PUBACK_P99_MS = 50.0
BACKLOG = 100_000
CLOCK = SystemClock()
RIG = Identity("lab", "edge-1", "rig")
SEVERITIES: tuple[Severity, ...] = ("alert", "danger")


def disk_sync_ms(directory: Path) -> list[float]:
    """What this disk takes to make 4 KiB durable, without any database."""
    took = []
    with (directory / "sync").open("wb", buffering=0) as file:
        for _ in range(SINGLE):
            begun = time.perf_counter()
            file.write(bytes(4096))
            os.fsync(file.fileno())
            took.append(1e3 * (time.perf_counter() - begun))
            time.sleep(0.005)
    return took


def rss_mb() -> float:
    """Memory of this process that is in use."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def p99(values: list[float]) -> float:
    """The 99th percentile."""
    return statistics.quantiles(values, n=100)[98]


class Decider:
    """Decides on alarms: each call changes the one alarm of the desk."""

    def __init__(self, desk: AlarmService) -> None:
        self.alarms = desk
        self.taken = 0

    def take(self) -> None:
        """One diagnosis, one event."""
        severity = SEVERITIES[self.taken % 2]
        self.taken += 1
        self.alarms.take(
            Diagnosis("rig", "rotor-bank", CLOCK.monotonic_ns(), "shaft", 0, 64, severity, severity=severity)
        )


class Timed(Decider):
    """The same with a stop watch: from the decision to the disk, and to the PUBACK."""

    def __init__(self, desk: AlarmService) -> None:
        super().__init__(desk)
        self.to_disk_ms: list[float] = []
        self.to_puback_ms: list[float] = []
        self._decided_s: dict[int, float] = {}
        self._submit, self._mark_sent = desk.outbox.submit, desk.outbox.mark_sent
        desk.outbox.submit = self._timed_submit  # type: ignore[method-assign]
        desk.outbox.mark_sent = self._timed_mark  # type: ignore[method-assign]

    async def until_acknowledged(self, count: int) -> None:
        """Wait for so many PUBACKs."""
        while len(self.to_puback_ms) < count:
            await asyncio.sleep(0.01)

    def _timed_submit(self, *arguments: Any, **options: Any) -> asyncio.Future[int]:
        begun_s = time.perf_counter()
        committed = self._submit(*arguments, **options)

        def on_disk(done: asyncio.Future[int]) -> None:
            self.to_disk_ms.append(1e3 * (time.perf_counter() - begun_s))
            self._decided_s[done.result()] = begun_s

        committed.add_done_callback(on_disk)
        return committed

    def _timed_mark(self, *sequences: int) -> None:
        for sequence in sequences:
            begun_s = self._decided_s.pop(sequence, None)
            if begun_s is not None:
                self.to_puback_ms.append(1e3 * (time.perf_counter() - begun_s))
        self._mark_sent(*sequences)


@contextlib.asynccontextmanager
async def running_desk(store: Path, port: int) -> AsyncIterator[AlarmService]:
    """A desk that publishes to the broker at ``port``."""
    desk = alarm_service(
        RIG, [DiagnosisRule("rotor-fault", "rotor-bank")], store, CLOCK, outputs(mqtt(port, "bench"))
    )
    await desk.open()
    await desk.resume({desk.manager.identity.machine: {"rotor-bank": ("probe-x",)}})
    running = [asyncio.create_task(teller.run()) for teller in desk.outputs.values()]
    try:
        yield desk
    finally:
        await desk.settle(10.0)
        await desk.stop(10.0)
        await asyncio.gather(*running)
        await desk.close(10.0)


async def one_by_one(store: Path, port: int, sync_ms: list[float], targets: Targets) -> None:
    """Time from decision to PUBACK of alarms that come alone."""
    async with running_desk(store, port) as desk:
        timed = Timed(desk)
        for number in range(SINGLE):
            timed.take()
            await timed.until_acknowledged(number + 1)
    disk, puback = timed.to_disk_ms, timed.to_puback_ms
    sync, sync_p99 = statistics.median(sync_ms), p99(sync_ms)
    print(f"disk alone          {sync:7.2f} ms median {sync_p99:7.2f} ms p99 for one sync of 4 KiB")
    for name, values in (("decision to disk  ", disk), ("decision to PUBACK", puback)):
        middle, most = statistics.median(values), p99(values)
        print(
            f"{name}  {middle:7.2f} ms median {most:7.2f} ms p99,"
            f" {middle / sync:.1f} and {most / sync_p99:.1f} times the disk's own"
        )
    most = p99(puback)
    targets.ask(
        f"decision to PUBACK within {PUBACK_P99_MS:g} ms, p99", f"{most:.2f} ms", PUBACK_P99_MS / most
    )


async def flood(store: Path, port: int, seconds: float, targets: Targets) -> None:
    """Whether so many alarms a second are kept up with."""
    async with running_desk(store, port) as desk:
        timed = Timed(desk)
        await asyncio.sleep(1.0)
        before_mb, deepest = rss_mb(), 0
        begun = time.perf_counter()
        while (elapsed := time.perf_counter() - begun) < seconds:
            while timed.taken < elapsed * FLOOD_PER_S:
                timed.take()
            deepest = max(deepest, desk.outbox.counters.depth + desk.outbox.counters.waiting)
            await asyncio.sleep(0.005)
        told = time.perf_counter() - begun
        await timed.until_acknowledged(timed.taken)
        behind_s = time.perf_counter() - begun - told
        puback = timed.to_puback_ms
        print(
            f"flood               {timed.taken / told:7.0f} alarms/s for {told:.0f} s,"
            f" PUBACK after {statistics.median(puback):.1f} ms median {p99(puback):.1f} ms p99,"
            f" at most {deepest} open, the last {1e3 * behind_s:.0f} ms after the end;"
            f" memory {before_mb:.0f} to {rss_mb():.0f} MB"
        )
        targets.ask(
            f"{FLOOD_PER_S} alarms/s kept up with, the last PUBACK within {FLOOD_BEHIND_S:g} s of the end",
            f"{1e3 * behind_s:.0f} ms",
            FLOOD_BEHIND_S / behind_s,
        )


async def backlog(store: Path, broker: Broker, count: int) -> None:
    """How long what has piled up without a broker takes to be delivered, and the memory that it takes."""
    await broker.kill()
    async with running_desk(store, broker.port) as desk:
        decider, counters = Decider(desk), desk.outbox.counters
        before_mb = rss_mb()
        begun = time.perf_counter()
        while decider.taken < count:
            for _ in range(500):
                decider.take()
            while counters.waiting > 2000:
                await asyncio.sleep(0.001)
        while counters.waiting:
            await asyncio.sleep(0.01)
        filled_s = time.perf_counter() - begun
        full_mb = rss_mb()
        await broker.start()
        while not desk.outputs["mqtt"].figures()["connected"]:
            await asyncio.sleep(0.01)
        begun = time.perf_counter()
        most_mb = full_mb
        while counters.depth:
            most_mb = max(most_mb, rss_mb())
            await asyncio.sleep(0.1)
        drained_s = time.perf_counter() - begun
    bare_per_s = await asyncio.to_thread(bare_client, broker.port, count // 5)
    print(f"backlog             {count / filled_s:7.0f} alarms/s to disk, {count} of them")
    print(
        f"drained             {count / drained_s:7.0f} alarms/s,"
        f" {count / drained_s / bare_per_s:.2f} of a bare client that keeps nothing ({bare_per_s:.0f}/s);"
        f" memory {before_mb:.0f} MB before, {full_mb:.0f} full, at most {most_mb:.0f} while draining"
    )


def bare_client(port: int, count: int) -> float:
    """Messages a second of paho alone: QoS 1, twenty in flight, nothing kept."""
    client = paho.Client(paho.CallbackAPIVersion.VERSION2)
    client.max_inflight_messages_set(20)
    client.connect(LOOPBACK, port)
    client.loop_start()
    payload = bytes(900)
    begun = time.perf_counter()
    for at in range(0, count, 1000):
        sent = [client.publish("bench/bare", payload, qos=1) for _ in range(min(1000, count - at))]
        for each in sent:
            each.wait_for_publish()
    spent = time.perf_counter() - begun
    client.disconnect()
    client.loop_stop()
    return count / spent


async def bench(seconds: float, count: int, targets: Targets) -> None:
    """Measure and print."""
    with tempfile.TemporaryDirectory(prefix="bench-alarms-") as name:
        directory = Path(name)
        broker = Broker("mosquitto", directory, dict(os.environ))
        await broker.start()
        try:
            sync_ms = await asyncio.to_thread(disk_sync_ms, directory)
            await one_by_one(directory / "single", broker.port, sync_ms, targets)
            await flood(directory / "flood", broker.port, seconds, targets)
            await backlog(directory / "backlog", broker, count)
        finally:
            await broker.kill()


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flood-s", type=float, default=60.0, help="how long the flood lasts")
    parser.add_argument("--backlog", type=int, default=BACKLOG, help="messages that pile up")
    arguments = parser.parse_args()
    if mosquitto_program() is None:
        print("alarms: not measured, no mosquitto on this machine (apt-get install mosquitto)")
        return 0
    # Every alarm is a line in the log; here there are a hundred thousand.
    logging.getLogger("daqsvc").setLevel(logging.ERROR)
    targets = Targets()
    asyncio.run(bench(arguments.flood_s, arguments.backlog, targets))
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
