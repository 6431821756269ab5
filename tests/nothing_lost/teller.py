"""The process that is killed: tells a script to an alarm desk and goes on where it was killed.

It writes down what it knows to be on disk, one short line per fact with one write each, which survives
SIGKILL. After a restart it takes up the script at the first step that may not be on disk altogether, so
that in the end every step has been heard and the whole sequence is known.

Run it as ``python -m nothing_lost.teller STORE WITNESS SEED HOST PORT PROTOCOL``.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import logging
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import paho.mqtt.client as paho
from nothing_lost.script import RULES, SENSORS, Script
from support.alarm_desk import alarm_service
from support.clocks import SteppedClock
from support.mqtt_publishing import mqtt, outputs

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff
from daqsvc.outbox.messages import event_id

if TYPE_CHECKING:
    from collections.abc import Callable

    from nothing_lost.script import Step

    from daqsvc.alarm_service import AlarmService
    from daqsvc.outbox.store import Outbox

QUICK_RETRY = Backoff(NS_PER_S // 20, NS_PER_S // 5)
"""Waits between connections that are short enough to see many outages in a minute."""


@dataclass
class Witness:
    """What the teller has written down.

    Attributes:
        committed_ns: when it learnt that a number is on disk (CLOCK_MONOTONIC), by number.
        committed_ids: the ids of these.
        committed_twice: numbers that were given twice.
        settled: steps whose events are all on disk: these and all before.
        starts: how often the process has begun to tell.
        done: whether the broker has acknowledged everything.
    """

    committed_ns: dict[int, int] = field(default_factory=dict)
    committed_ids: set[str] = field(default_factory=set)
    committed_twice: list[int] = field(default_factory=list)
    settled: int = -1
    starts: int = 0
    done: bool = False

    @classmethod
    def read(cls, path: Path) -> Witness:
        witness = cls()
        for line in path.read_text().splitlines() if path.exists() else ():
            match line.split():
                case ["committed", sequence, t_ns, series]:
                    if int(sequence) in witness.committed_ns:
                        witness.committed_twice.append(int(sequence))
                    witness.committed_ns[int(sequence)] = int(t_ns)
                    witness.committed_ids.add(event_id(series, int(sequence)))
                case ["settled", step]:
                    witness.settled = int(step)
                case ["started"]:
                    witness.starts += 1
                case ["done"]:
                    witness.done = True
        return witness


def settled_to(path: Path) -> int:
    """The last step that a teller has settled, without reading all that it has written."""
    tail = path.read_bytes()[-500:].splitlines() if path.exists() else []
    return max((int(line.split()[1]) for line in tail[1:] if line.startswith(b"settled ")), default=-1)


def may_end(witness: Path) -> Path:
    """The file that lets the teller end, beside its notes: nothing befalls it any more."""
    return witness.with_name("may-end")


class Teller:
    """Takes the script's diagnoses to the desk and writes down what becomes of them."""

    def __init__(self, desk: AlarmService, clock: SteppedClock, witness: Path) -> None:
        self._desk = desk
        self._clock = clock
        self._witness = os.open(witness, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        self._under_way: list[asyncio.Future[int]] = []
        self._submit = desk.outbox.submit
        desk.outbox.submit = self._witnessed_submit  # type: ignore[method-assign]

    def write(self, *words: object) -> None:
        os.write(self._witness, (" ".join(map(str, words)) + "\n").encode())

    def _witnessed_submit(self, *arguments: Any, **options: Any) -> asyncio.Future[int]:
        committed = self._submit(*arguments, **options)
        committed.add_done_callback(
            lambda future: self.write(
                "committed", future.result(), time.monotonic_ns(), self._desk.outbox.series
            )
        )
        self._under_way.append(committed)
        return committed

    async def tell(self, steps: tuple[Step, ...]) -> None:
        settling: list[asyncio.Task[None]] = []
        for step in steps:
            if step.pause_s:
                await asyncio.sleep(step.pause_s)
            self._clock.ahead_ns = step.wall_offset_s * NS_PER_S
            self._under_way = []
            self._desk.take(step.diagnosis(self._desk.manager.identity.machine, self._clock.monotonic_ns()))
            self._desk.outbox.telemetry(f"{self._desk.topics.base}/status", b'{"step": %d}' % step.number)
            before = settling[-1:]
            settling.append(asyncio.create_task(self._settled(step.number, self._under_way, before)))
        await asyncio.gather(*settling)

    async def _settled(
        self, number: int, under_way: list[asyncio.Future[int]], before: list[asyncio.Task[None]]
    ) -> None:
        await asyncio.gather(*before, *under_way)
        self.write("settled", number)


class Bypass:
    """The mutation that the checks must see: straight to the broker, from memory, past the outbox."""

    def __init__(self, outbox: Outbox, host: str, port: int) -> None:
        self._numbers = itertools.count(time.time_ns() // 1_000_000)
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        self._client.reconnect_delay_set(0.05, 0.2)
        self._client.connect_async(host, port)
        self._client.loop_start()
        outbox.submit = self.submit  # type: ignore[method-assign]

    def submit(
        self, topic: str, payload_of_sequence: Callable[[int], bytes], *, retain: bool
    ) -> asyncio.Future[int]:
        number = next(self._numbers)
        self._client.publish(topic, payload_of_sequence(number), qos=1, retain=retain)
        done: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        done.set_result(number)
        return done


def forget_early(outbox: Outbox) -> None:
    """The other mutation: a message counts as sent when it is read, not when it is acknowledged."""
    next_pending = outbox.next_pending

    async def read_and_forget(after: int, limit: int) -> Any:
        messages = await next_pending(after, limit)
        for message in messages:
            outbox.mark_sent(message.sequence)
        return messages

    outbox.next_pending = read_and_forget  # type: ignore[method-assign]


async def first_untold(witness: Witness, outbox: Outbox) -> int:
    """The step to go on with: the last one on disk may have been cut in two, all before it are complete."""
    told = [json.loads(message.payload) for message in await outbox.latest()]
    steps = [alarm["cause"]["window"]["first_index"] for alarm in told]
    return max([witness.settled + 1, *steps])


async def run(arguments: argparse.Namespace) -> None:
    script = Script.of_seed(arguments.seed)
    clock = SteppedClock()
    table = mqtt(
        arguments.port,
        f"daqsvc-{arguments.seed}",
        arguments.host,
        keepalive_s=1,
        protocol=arguments.protocol,
    )
    bypassed = arguments.mutation == "bypass"
    desk = alarm_service(script.identity, RULES, arguments.store, clock, None if bypassed else outputs(table))
    if desk.outputs:
        assert hasattr(desk.outputs["mqtt"], "_backoff")
        desk.outputs["mqtt"]._backoff = QUICK_RETRY
    await desk.open()
    if bypassed:
        Bypass(desk.outbox, arguments.host, arguments.port)
    elif arguments.mutation == "forget-early":
        forget_early(desk.outbox)

    untold = await first_untold(Witness.read(arguments.witness), desk.outbox)
    teller = Teller(desk, clock, arguments.witness)
    teller.write("started")
    clock.ahead_ns = script.steps[min(untold, len(script.steps) - 1)].wall_offset_s * NS_PER_S
    await desk.resume({script.identity.machine: SENSORS})
    running = [asyncio.create_task(each.run()) for each in desk.outputs.values()]
    timekeeper = asyncio.create_task(desk.keep_time())
    await teller.tell(script.steps[untold:])
    while (
        desk.outbox.counters.waiting or desk.outbox.counters.depth or not may_end(arguments.witness).exists()
    ):
        await asyncio.sleep(0.02)
    teller.write("done")
    timekeeper.cancel()
    await desk.settle(timeout_s=2.0)
    await desk.stop(deadline_s=2.0)
    await asyncio.gather(*running)
    await desk.close(timeout_s=2.0)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("store", type=Path)
    parser.add_argument("witness", type=Path)
    parser.add_argument("seed", type=int)
    parser.add_argument("host")
    parser.add_argument("port", type=int)
    parser.add_argument("protocol", choices=("5", "3.1.1"))
    parser.add_argument("--mutation", choices=("none", "bypass", "forget-early"), default="none")
    logging.basicConfig(format="%(relativeCreated)d %(levelname)s %(name)s: %(message)s", level=logging.INFO)
    asyncio.run(run(parser.parse_args()))


if __name__ == "__main__":
    main()
