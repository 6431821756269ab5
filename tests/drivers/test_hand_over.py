"""What a reader hands to the event loop: in order, one batch in a turn, and the others in between."""

from __future__ import annotations

import asyncio
import itertools
import os
import pty
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest
import serial

from drivers.can.driver import BATCHES_UNDER_WAY, CanReader
from drivers.frames import DecodedBatch
from drivers.reconnect import HandOver
from drivers.serial.reader import SerialReader

BATCHES = 16


async def test_batches_of_one_source_let_all_others_have_their_turn() -> None:
    """16 batches of each of two buses wait when the loop comes round; a timer and a task are ready, too."""
    loop = asyncio.get_running_loop()
    order: list[str] = []
    first, second = HandOver(loop), HandOver(loop)

    def hand_over() -> None:
        for k in range(BATCHES):
            first.post(order.append, f"a{k}")
        for k in range(BATCHES):
            second.post(order.append, f"b{k}")

    async def other() -> None:
        while len([what for what in order if what != "other"]) < 2 * BATCHES:
            order.append("other")
            await asyncio.sleep(0)

    thread = threading.Thread(target=hand_over)
    thread.start()
    thread.join()
    await other()
    for name in "ab":
        assert [what for what in order if what[0] == name] == [f"{name}{k}" for k in range(BATCHES)]
    for k in range(BATCHES - 1):
        between = order[order.index(f"a{k}") + 1 : order.index(f"a{k + 1}")]
        assert [what[0] for what in between] == ["o", "b", "o"], order


class Source:
    """A bus that is always full."""

    recovers, error_classes = True, None

    def __init__(self) -> None:
        self.reads = 0

    def read(self, _wait_s: float) -> SimpleNamespace:
        self.reads += 1
        return SimpleNamespace(ids=(), drained_ns=None)

    def gather(self, _stopping: threading.Event) -> None:
        """It never has to."""

    def sort(self, _batch: object, _classes: object) -> DecodedBatch:
        return DecodedBatch()

    def close(self) -> None:
        """Nothing is open."""


async def test_a_bus_that_is_full_is_read_batch_by_batch_in_turns() -> None:
    loop = asyncio.get_running_loop()
    order: list[str] = []
    source: Any = Source()
    reader = CanReader("bus", source, source, lambda _: order.append("batch"), loop)
    reader.start()
    until_s = time.monotonic() + 20
    while source.reads <= BATCHES_UNDER_WAY and time.monotonic() < until_s:
        time.sleep(0.001)  # noqa: ASYNC251 - the loop is to be late
    for _ in range(BATCHES):
        order.append("other")
        await asyncio.sleep(0)
    assert "batch" in order
    assert not any(pair == ("batch", "batch") for pair in itertools.pairwise(order)), order
    await asyncio.to_thread(reader.close)
    reader.finish()
    assert order.count("batch") >= BATCHES_UNDER_WAY, "what was under way at the end is taken, too"


async def test_a_serial_port_is_read_in_turns_too() -> None:
    master, slave = pty.openpty()
    order: list[str] = []
    nothing: Any = None
    with serial.Serial(os.ttyname(slave)) as device:
        reader = SerialReader("port", device, nothing, nothing, nothing, asyncio.get_running_loop())
        for _ in range(BATCHES):
            reader._post(order.append, "batch")
        while order.count("batch") < BATCHES:
            order.append("other")
            await asyncio.sleep(0)
    os.close(master)
    os.close(slave)
    assert order == ["other", *["other", "batch"] * BATCHES]


async def test_an_error_costs_one_batch() -> None:
    """It reaches the loop, as that of any callback; the batches behind it are taken all the same."""
    loop = asyncio.get_running_loop()
    errors: list[object] = []
    loop.set_exception_handler(lambda _, context: errors.append(context["exception"]))
    taken: list[int] = []
    hand = HandOver(loop)
    hand.post(lambda: 1 / 0)
    hand.post(taken.append, 1)
    while not taken:
        await asyncio.sleep(0)
    assert [type(error) for error in errors] == [ZeroDivisionError]


async def test_what_waits_at_the_end_is_taken_at_once_and_once() -> None:
    taken: list[int] = []
    hand = HandOver(asyncio.get_running_loop())
    for k in range(BATCHES):
        hand.post(taken.append, k)
    hand.finish()
    assert taken == list(range(BATCHES))
    for _ in range(3):
        await asyncio.sleep(0)
    assert taken == list(range(BATCHES))


def test_a_loop_that_is_closed_is_said() -> None:
    loop = asyncio.new_event_loop()
    loop.close()
    with pytest.raises(RuntimeError):
        HandOver(loop).post(print)
