"""What the service relies on, asked of every driver over its own transport."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import tracemalloc
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
from conformance.rig import LOOK_S, Rig, lasting_threads, numbers_of, open_files
from conformance.transport import STREAM

from daqsvc.acquisition import counter_sense
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.samples import Quality
from drivers.base import DeviceAbsentError
from drivers.serial import reader

if TYPE_CHECKING:
    from collections.abc import Iterator

    from conformance.transport import Transport

pytestmark = pytest.mark.timeout(240)


@pytest.fixture(autouse=True)
def _gather_for_a_moment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each frame is waited for, and simulated time stands still while bytes of a serial line gather."""
    monkeypatch.setattr(reader, "GATHER_NS", 5_000_000)


LOSSES = 100
WARM_LOSSES = 10
COMPILERS = ("numba", "llvmlite")
LEAK_BYTES_A_LOSS = 1500
"""What the time base and the assembler remember of a gap, up to a bound, weighs half of this; a queue, a
socket's reader or a thread that is kept for every loss weighs more."""


async def test_what_is_sent_is_delivered_in_its_place(transport: Transport) -> None:
    async with Rig(transport) as rig:
        await rig.until_up()
        await rig.send(30, at_once=3)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.samples_lost == 0
    assert len(rig.stored) == 30 * transport.samples_per_frame
    assert all(block.stream == STREAM for block in rig.blocks)
    assert all(not block.quality & Quality.AFTER_LOSS for block in rig.blocks)


async def test_a_driver_that_was_stopped_can_run_again(transport: Transport) -> None:
    rig = Rig(transport)
    for _ in range(3):
        rig.begin()
        await rig.until_up()
        await rig.send(5)
        await rig.end()
        assert rig.driver.link.state == "down"
        delivered = rig.counters.samples_received
        # Nobody listens now: these are lost, and the driver must know.
        await transport.time.pass_ns(5 * transport.samples_per_frame * rig.period_ns)
        rig.skip_to_now()
        await asyncio.sleep(0.01)
        assert rig.counters.samples_received == delivered, "a driver that was stopped delivers"
    rig.check_books()
    rig.check_indices()
    assert rig.counters.samples_lost > 0
    assert rig.driver.link.losses == 0, "to be stopped is no loss"
    assert rig.counters.frames_received == 15, "something was read twice"


@pytest.mark.needs("be absent")
async def test_absent_at_start_is_an_error_if_the_machine_file_says_so(transport: Transport) -> None:
    transport.device.go_away()
    rig = Rig(transport, start="error")
    task = rig.begin()
    await _until_done(rig, task)
    with pytest.raises(DeviceAbsentError, match=rig.driver.name):
        await task
    assert rig.driver.link.state == "down"
    assert rig.driver.counters.open_failures == 1


@pytest.mark.needs("be absent")
async def test_absent_at_start_is_left_alone_if_the_machine_file_says_so(transport: Transport) -> None:
    transport.device.go_away()
    rig = Rig(transport, start="ignore")
    task = rig.begin()
    await _until_done(rig, task)
    await task
    assert rig.driver.link.state == "down"
    assert rig.driver.link.reason


@pytest.mark.needs("be absent")
async def test_absent_at_start_is_tried_again_until_it_is_there(transport: Transport) -> None:
    transport.device.go_away()
    async with Rig(transport) as rig:
        await rig.until(lambda: rig.driver.counters.open_failures >= 3, "three tries", NS_PER_S // 50)
        assert rig.driver.link.state == "down"
        transport.device.come_back()
        await rig.until_up()
        await rig.send(5)
    rig.check_books()
    assert rig.counters.samples_received == 5 * transport.samples_per_frame


@pytest.fixture
def _no_log() -> Iterator[None]:
    """The test runner keeps the records of the log; they are not to be weighed."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.long
@pytest.mark.needs("be absent")
@pytest.mark.usefixtures("_no_log")
async def test_a_hundred_losses_leave_nothing_behind(transport: Transport) -> None:
    held: list[_Held] = []
    async with Rig(transport) as rig:
        await rig.until_up()
        tracemalloc.start()
        try:
            for k in range(1, LOSSES + 1):
                await rig.send(2)
                transport.device.go_away()
                await rig.until_down()
                transport.device.come_back()
                await rig.until_up()
                if k in {WARM_LOSSES, LOSSES}:
                    rig.forget()
                    held.append(await _held(rig))
        finally:
            tracemalloc.stop()
        await rig.send(3)
        assert rig.driver.link.losses == LOSSES
    rig.check_books()
    rig.check_indices()
    before, after = held
    assert after.tasks <= before.tasks
    assert after.threads <= before.threads
    assert after.files <= before.files
    assert after.nbytes - before.nbytes < (LOSSES - WARM_LOSSES) * LEAK_BYTES_A_LOSS


class _Held(NamedTuple):
    """What the process holds."""

    tasks: int
    threads: int
    files: int
    nbytes: int


async def _held(rig: Rig) -> _Held:
    """The least of a while, in which the driver may be at work now and then."""
    gc.collect()
    looks = []
    for _ in range(20):
        looks.append((len(asyncio.all_tasks()), len(lasting_threads()), open_files()))
        await rig.transport.time.pass_ns(rig.transport.poll_ns)
        await asyncio.sleep(LOOK_S)
    tasks, threads, files = (min(kind) for kind in zip(*looks, strict=True))
    # A kernel that is needed for the first time, on a busy computer perhaps late, is no leak of a driver.
    others = [tracemalloc.Filter(inclusive=False, filename_pattern=f"*/{name}/*") for name in COMPILERS]
    traces = tracemalloc.take_snapshot().filter_traces(others)
    return _Held(tasks, threads, files, sum(one.size for one in traces.statistics("filename")))


@pytest.mark.needs("be absent")
async def test_losses_at_any_moment_are_counted(transport: Transport) -> None:
    rng = np.random.default_rng(5)
    async with Rig(transport) as rig:
        await rig.until_up()
        for _ in range(20):
            await rig.send(int(rng.integers(1, 6)), at_once=int(rng.integers(1, 4)))
            transport.device.go_away()
            # What is sent into the void is lost.
            await transport.device.send(*rig.next_samples(int(rng.integers(1, 4))))
            await rig.until_down()
            for _ in range(int(rng.integers(0, 3))):
                await transport.time.pass_ns(int(rng.integers(1, NS_PER_S)))
            transport.device.come_back()
            await rig.until_up()
        await rig.send(3)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.samples_lost > 0


@pytest.mark.needs("drop")
async def test_frames_dropped_are_counted_as_samples_lost(transport: Transport) -> None:
    async with Rig(transport) as rig:
        await rig.until_up()
        await rig.send(5)
        transport.device.drop(3)
        await rig.send(8)
        transport.device.drop()
        await rig.send(8)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.samples_lost == 4 * transport.samples_per_frame
    assert rig.counters.gaps == 2


@pytest.mark.needs("drop")
async def test_what_is_held_back_for_a_late_frame_is_handed_over_at_the_end(transport: Transport) -> None:
    async with Rig(transport) as rig:
        await rig.until_up()
        await rig.send(5)
        transport.device.drop()
        await rig.send(2)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.samples_received == 6 * transport.samples_per_frame
    assert rig.counters.samples_lost == transport.samples_per_frame


@pytest.mark.needs("duplicate")
async def test_frames_that_come_twice_are_delivered_once(transport: Transport) -> None:
    async with Rig(transport) as rig:
        await rig.until_up()
        for _ in range(3):
            await rig.send(4)
            transport.device.duplicate()
        await rig.send(4)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.frames_duplicate == 3
    assert rig.counters.samples_lost == 0


@pytest.mark.needs("reorder")
async def test_frames_that_were_overtaken_are_put_back(transport: Transport) -> None:
    async with Rig(transport) as rig:
        await rig.until_up()
        for _ in range(3):
            await rig.send(4)
            transport.device.reorder()
        await rig.send(4)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.frames_reordered == 3
    assert rig.counters.samples_lost == 0


@pytest.mark.needs("corrupt")
async def test_frames_that_were_corrupted_are_lost_and_counted(transport: Transport) -> None:
    async with Rig(transport) as rig:
        await rig.until_up()
        for _ in range(3):
            await rig.send(4)
            transport.device.corrupt()
        await rig.send(4)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.frames_corrupt == 3
    assert rig.counters.samples_lost == 3 * transport.samples_per_frame


async def test_any_mix_of_faults_ends_with_exact_books(transport: Transport) -> None:
    rng = np.random.default_rng(11)
    device = transport.device
    faults = {
        "drop": lambda: device.drop(int(rng.integers(1, 4))),
        "duplicate": device.duplicate,
        "reorder": device.reorder,
        "corrupt": device.corrupt,
    }
    possible = sorted(faults.keys() - transport.cannot.keys())
    befell: list[str] = []
    async with Rig(transport) as rig:
        await rig.until_up()
        await rig.send(3)
        for _ in range(60 if possible else 0):
            befell.append(str(rng.choice(possible)))
            faults[befell[-1]]()
            await rig.send(int(rng.integers(4, 7)), at_once=int(rng.integers(1, 4)))
        await rig.send(6)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.frames_duplicate == befell.count("duplicate")
    assert rig.counters.frames_reordered == befell.count("reorder")
    assert rig.counters.frames_corrupt == befell.count("corrupt")
    assert rig.counters.samples_received == device.samples_on_wire


async def test_a_device_that_falls_silent_is_missed(transport: Transport) -> None:
    async with Rig(transport) as rig:
        await rig.until_up()
        await rig.send(5)
        transport.device.silence()
        await rig.send(7)
        transport.device.speak()
        await rig.until_up()
        await rig.send(5)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.samples_lost >= 7 * transport.samples_per_frame


async def test_a_counter_that_wraps_goes_on(transport: Transport) -> None:
    modulus = transport.counter_modulus
    per_frame = transport.samples_per_frame
    async with Rig(transport, first_index=(modulus // per_frame - 10) * per_frame) as rig:
        await rig.until_up()
        rig.sent = 0  # however long the link took to come up
        rig.restart_time()
        await rig.send(8)
        if "drop" not in transport.cannot:
            transport.device.drop(4)
        await rig.send(20)
    rig.check_books()
    rig.check_indices()
    assert rig.blocks[-1].end_index > modulus
    assert rig.counters.samples_lost == (0 if "drop" in transport.cannot else 4 * per_frame)


@pytest.mark.needs("reset counter")
async def test_a_counter_that_restarts_is_followed(transport: Transport) -> None:
    async with Rig(transport) as rig:
        await rig.until_up()
        await rig.send(50, to_be_continued=True)
        transport.device.reset_counter()
        await rig.send(20)
    jitter = 0 if transport.time.exact and not transport.poll_ns else transport.jitter_ns // rig.period_ns + 1
    # Where a counter restarts only the clock tells how many are missing, and that is as late as the reader.
    rig.check_books(estimated=jitter + (rig.late_ns // rig.period_ns if transport.poll_ns else 0))
    _, time_base = rig.driver.streams[STREAM]
    assert time_base.restarts == 1
    estimated = [block for block in rig.blocks if block.quality & Quality.LOSS_ESTIMATED]
    assert len(estimated) <= 1
    assert sum(bool(block.quality & Quality.PLACE_ESTIMATED) for block in rig.blocks) == 1
    assert len(rig.stored) >= 70 * transport.samples_per_frame, "none is missing"


@pytest.mark.long
@pytest.mark.needs("overflow")
async def test_a_consumer_that_cannot_keep_up_costs_samples_and_not_memory(
    transport: Transport, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What a thread reads while the wire fills may be more than a bus holds back: that is a flood, looked at
    # elsewhere.
    monkeypatch.setattr(counter_sense, "BACKLOG_FRAMES", 10 * transport.overflow_frames)
    async with Rig(transport) as rig:
        await rig.until_up()
        await rig.send(5)
        frames = transport.overflow_frames
        if transport.time.exact:
            await transport.time.pass_ns(frames * transport.samples_per_frame * rig.period_ns)
        index, samples = rig.next_samples(frames)
        # The event loop does not turn: nobody takes what the driver reads.
        transport.device.flood(index, samples)
        assert transport.device.samples_on_wire < rig.sent, "the wire took everything: flood it with more"
        await rig.settle()
        await rig.send(5)
    rig.check_books()
    rig.check_indices()
    assert rig.counters.samples_lost > 0


@pytest.mark.long
async def test_samples_get_the_time_at_which_they_were_taken(transport: Transport) -> None:
    async with Rig(transport) as rig:
        await rig.until_up()
        frames = int(3.5 * transport.rate_hz / transport.samples_per_frame)
        await rig.send(frames)
        _, time_base = rig.driver.streams[STREAM]
        assert time_base.settled
    settled = [block for block in rig.blocks if not block.quality & Quality.TIME_UNSETTLED]
    assert settled
    off_ns = np.concatenate(
        [
            block.t_first_ns
            + np.rint(np.arange(len(block.samples)) * block.period_ns).astype(np.int64)
            - rig.taken_ns(numbers_of(block.samples))
            for block in settled
        ]
    )
    latency_ns = float(np.median(off_ns))
    assert -transport.jitter_ns <= latency_ns <= transport.latency_ns + transport.jitter_ns
    assert float(np.abs(off_ns - latency_ns).max()) <= transport.jitter_ns


@pytest.mark.parametrize("present", [True, False], ids=["present", "absent"])
async def test_a_driver_ends_wherever_it_is_cancelled(transport: Transport, present: bool) -> None:  # noqa: FBT001
    if not present:
        transport.device.go_away()
    loop_turns = [*range(25), *range(25, 60, 5)]
    rig = Rig(transport)
    await _cancelled_after(rig, 40)  # the pool of the event loop has its threads now
    before = (len(asyncio.all_tasks()), lasting_threads())
    for turns in loop_turns:
        await _cancelled_after(rig, turns)
        assert len(asyncio.all_tasks()) == before[0], f"a task is left behind after {turns} turns"
        await rig.until_gone(before[1])
    files = open_files()
    for turns in loop_turns[::6]:
        await _cancelled_after(rig, turns)
    await rig.until_closed(files)
    # And it has left the bus free for the next.
    if not present:
        transport.device.come_back()
    async with Rig(transport) as fresh:
        await fresh.until_up()
        await fresh.send(5)
    fresh.check_books()
    # A device that is polled may still hold what the cancelled drivers have not fetched, and nothing else.
    left_over = fresh.counters.samples_received - 5 * transport.samples_per_frame
    assert 0 <= left_over <= (rig.sent if transport.poll_ns else 0)


async def _cancelled_after(rig: Rig, turns: int) -> None:
    """Run the driver for so many turns of the event loop, the later ones longer, and cancel it."""
    task = rig.begin()
    for turn in range(turns):
        if turn == 30:
            await rig.device.send(*rig.next_samples(1))
        await asyncio.sleep(LOOK_S if turn > 20 else 0)
        if turn > 20:
            await rig.transport.time.pass_ns(NS_PER_S // 100)
    task.cancel()
    async with asyncio.timeout(10):
        with contextlib.suppress(asyncio.CancelledError):
            await task
    assert task.done()
    for _ in range(3):  # the far end, in this process too, may still be at accepting the connection
        await asyncio.sleep(0)


async def _until_done(rig: Rig, task: asyncio.Task[Any]) -> None:
    async with asyncio.timeout(20):
        while not task.done():
            await rig.transport.time.pass_ns(NS_PER_S // 50)
            await asyncio.sleep(LOOK_S)
