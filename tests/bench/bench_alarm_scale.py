"""What alarms cost by their number: a diagnosis among 10 to 10,000 of them, a flood of 1000 to the broker.

Run by ``make bench``; the flood needs Mosquitto. Every sensor is found too high, not OK and good again in
turn, so that levels, suppression, quality alarms, chatter, first-out and the flood itself all have work.
"""

# ruff: noqa: T201 - printing is what it is for

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import logging
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from nothing_lost.broker import Broker, mosquitto_program
from support.alarm_desk import alarm_service
from support.alarm_rig import alarm_handling
from support.mqtt_publishing import mqtt, outputs
from targets import Targets

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.events import Identity
from daqsvc.alarms.manager import AlarmManager, LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.voting import VotingRule
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.home_assistant.settings import HomeAssistant
from daqsvc.publish.output import Watched
from daqsvc.publish.payloads import status_payload
from daqsvc.service import LoopLag

if TYPE_CHECKING:
    from daqsvc.alarms.rules import Rule
    from daqsvc.dsp.quality import Quality

CLOCK = SystemClock()
RIG = Identity("lab", "edge-1", "rig")
HANDLING = alarm_handling(chatter=(5, 60, 60), flood=(10, 600))
SETPOINT = Setpoint(alert=4.0, danger=8.0, deadband=1.0)
COUNTS = (10, 100, 1000, 10_000)
LEAST_DIAGNOSES = 20_000
MOST_TIMES = 4.0
"""What a diagnosis among 10,000 alarms may cost of one among 10; a walk over all would be 1000 times it."""

FLOOD_ALARMS = 1000
FLOOD_EVENTS_PER_S = 533
"""32,000 in a minute."""
SHARE_OF_A_CORE = 0.20
LAG_P99_MS = 10.0
BEHIND_S = 1.0
ROUND: tuple[tuple[float, Quality], ...] = ((2.0, "good"), (9.0, "good"), (9.0, "not_ok"), (2.0, "good"))


def rules(count: int) -> list[Rule]:
    """One alarm on the level of each sensor, and a vote on every third."""
    probes = [f"probe-{i}" for i in range(count)]
    levels = [LevelRule(f"level-{probe}", probe, "rms", SETPOINT) for probe in probes]
    voters = zip(*(probes[i::3] for i in range(3)), strict=False)
    return [*levels, *(VotingRule(f"vote-{three[0]}", three, 2, "rms", SETPOINT) for three in voters)]


def active_detectors(count: int) -> dict[str, tuple[str, ...]]:
    """The detectors of so many sensors."""
    return {f"levels/probe-{i}": (f"probe-{i}",) for i in range(count)}


def statement(number: int, count: int) -> Diagnosis:
    """The ``number``-th statement about ``count`` sensors, one after the other."""
    turn, sensor = divmod(number, count)
    value, quality = ROUND[(turn + sensor) % len(ROUND)]
    return Diagnosis(
        machine="rig",
        detector=f"levels/probe-{sensor}",
        t_ns=CLOCK.monotonic_ns(),
        stream="shaft",
        first_index=0,
        end_index=64,
        decision="normal",
        statistics={"rms": value, "peak": 2.0 * value, "crest_factor": 2.0},
        units={"rms": "um", "peak": "um"},
        thresholds={"rms.alert": 4.0, "rms.danger": 8.0},
        quality=quality,
        reason="" if quality == "good" else "gap voltage is -23 V, outside -18 to -2 V",
        sensors=(f"probe-{sensor}",),
        model="levels/1",
    )


def cost_us(count: int) -> tuple[float, float]:
    """Time of the processor for one diagnosis among so many sensors, in us, and events that it makes."""
    manager = AlarmManager(RIG, rules(count), CLOCK, handling=HANDLING)
    manager.resume([], active_detectors(count))
    for number in range(count):
        manager.take(statement(number, count))
    turns = max(LEAST_DIAGNOSES // count, 2)
    said = [statement(number, count) for number in range(count, (turns + 1) * count)]
    before = manager.counters.events
    begun_s = time.process_time()
    for diagnosis in said:
        manager.take(diagnosis)
    manager.tick()
    spent_s = time.process_time() - begun_s
    return 1e6 * spent_s / len(said), (manager.counters.events - before) / len(said)


def by_number(targets: Targets) -> None:
    """What a diagnosis costs among few and among many alarms."""
    costs = {}
    for count in COUNTS:
        costs[count], events = cost_us(count)
        print(
            f"diagnosis           {costs[count]:7.1f} us among {count:5d} sensors, {events:.2f} events each"
        )
    ratio = costs[COUNTS[-1]] / costs[COUNTS[0]]
    targets.ask(
        f"a diagnosis among {COUNTS[-1]} sensors costs at most {MOST_TIMES:g} times one among {COUNTS[0]}",
        f"{ratio:.2f} times",
        MOST_TIMES / ratio,
    )


class Rig:
    """A desk with its broker, Home Assistant's summary, and what the service does every second."""

    def __init__(self, count: int, store: Path, port: int) -> None:
        names = (*(rule.alarm for rule in rules(count)), *(f"sensor-ok/probe-{i}" for i in range(count)))
        told = outputs(mqtt(port, "bench"), Watched("rig", alarms=names), home_assistant=HomeAssistant())
        self.alarms = alarm_service(RIG, rules(count), store, CLOCK, told, handling=HANDLING)
        self.lag = LoopLag()
        self._count = count
        self._said = 0

    async def flood(self, events_per_s: float, seconds: float) -> None:
        """So many events a second for so long; of how many diagnoses, the alarms decide."""
        begun_s = time.perf_counter()
        counters = self.alarms.manager.counters
        before, told_s = counters.events, 0
        while (elapsed_s := time.perf_counter() - begun_s) < seconds:
            while counters.events - before < elapsed_s * events_per_s:
                self.alarms.take(statement(self._said, self._count))
                self._said += 1
            if elapsed_s > told_s:
                told_s += 1
                status_payload("lab", "edge-1", {"alarms": self.alarms.figures()}, CLOCK).to_json()
            await asyncio.sleep(0.01)


async def to_the_broker(directory: Path, port: int, seconds: float, targets: Targets) -> None:
    """A flood of 1000 alarms: share of a core, lag of the loop, and whether it is kept up with."""
    rig = Rig(FLOOD_ALARMS, directory / "store", port)
    desk, counters = rig.alarms, rig.alarms.outbox.counters
    await desk.open()
    await desk.resume(active_detectors(FLOOD_ALARMS))
    running = [asyncio.create_task(teller.run()) for teller in desk.outputs.values()]
    helpers = [asyncio.create_task(desk.keep_time()), asyncio.create_task(rig.lag.watch())]
    try:
        while not desk.outputs["mqtt"].figures()["connected"]:
            await asyncio.sleep(0.1)
        await rig.flood(FLOOD_EVENTS_PER_S, 2.0)
        gc.freeze()  # as daqsvc run does once it is ready
        rig.lag.forget()
        begun_s, spent_s, before = time.perf_counter(), time.process_time(), desk.manager.counters.events
        await rig.flood(FLOOD_EVENTS_PER_S, seconds)
        took_s, spent_s = time.perf_counter() - begun_s, time.process_time() - spent_s
        told = desk.manager.counters.events - before
        ended_s = time.perf_counter()
        while counters.depth or counters.waiting:
            await asyncio.sleep(0.01)
        behind_s = time.perf_counter() - ended_s
        share, lag = spent_s / took_s, rig.lag.figures_ms()
    finally:
        await desk.settle(10.0)
        await desk.stop(10.0)
        await asyncio.gather(*running)
        for helper in helpers:
            helper.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await helper
        await desk.close(10.0)
    print(
        f"flood               {told / took_s:7.0f} events/s of {FLOOD_ALARMS} sensors for {took_s:.0f} s,"
        f" {100 * share:.1f} % of a core, loop lag {lag['p50']:.2f} ms median {lag['p99']:.2f} ms p99,"
        f" the last PUBACK {1e3 * behind_s:.0f} ms after the end"
    )
    name = f"a flood of {FLOOD_ALARMS} alarms, {FLOOD_EVENTS_PER_S} events/s,"
    targets.ask(
        f"{name} takes at most {SHARE_OF_A_CORE:.0%} of a core", f"{share:.1%}", SHARE_OF_A_CORE / share
    )
    targets.ask(
        f"{name} leaves the loop's lag within {LAG_P99_MS:g} ms, p99",
        f"{lag['p99']:.2f} ms",
        LAG_P99_MS / lag["p99"],
    )
    targets.ask(
        f"{name} is at the broker within {BEHIND_S:g} s of its end",
        f"{1e3 * behind_s:.0f} ms",
        BEHIND_S / behind_s,
    )


async def bench(seconds: float, targets: Targets) -> None:
    """The flood, to a broker of its own."""
    with tempfile.TemporaryDirectory(prefix="bench-alarm-scale-") as name:
        broker = Broker("mosquitto", Path(name), dict(os.environ))
        await broker.start()
        try:
            await to_the_broker(Path(name), broker.port, seconds, targets)
        finally:
            await broker.kill()


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flood-s", type=float, default=20.0, help="how long the flood lasts")
    arguments = parser.parse_args()
    # Every alarm is a line in the log; here there are tens of thousands.
    logging.getLogger("daqsvc").setLevel(logging.ERROR)
    targets = Targets()
    by_number(targets)
    if mosquitto_program() is None:
        print("flood: not measured, no mosquitto on this machine (apt-get install mosquitto)")
    else:
        asyncio.run(bench(arguments.flood_s, targets))
    return targets.exit_code


if __name__ == "__main__":
    sys.exit(main())
