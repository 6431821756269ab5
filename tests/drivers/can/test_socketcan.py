"""The SocketCAN reader on a stand-in socket: the same bytes and system calls without a CAN kernel."""

from __future__ import annotations

import gc
import resource
import socket
import struct
import weakref
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.bus_tables import can_bus
from support.can_standin import frame_bytes
from support.clocks import SettableClock

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from drivers.base import StreamSpec
from drivers.can.batches import ERROR, EXTENDED, REMOTE, CanBatch, FrameDemultiplexer, IdMatch
from drivers.can.kernel_time import KernelTime
from drivers.can.socketcan import BATCH_FRAMES, DatagramBuffer, SocketCan, open_socketcan
from drivers.frames import FrameLayout

if TYPE_CHECKING:
    from collections.abc import Iterator


def layout(frame_id: int = 0x101, *, extended: bool = False, length: int = 8) -> FrameLayout:
    return FrameLayout.plain(
        frame_id=frame_id,
        extended=extended,
        length=length,
        channels=[("x", 16, "signed", 1.0, 0.0)],
        samples_per_frame=(length - 2) // 2,
        counter_byte=0,
        counter_bits=16,
        first_byte=2,
    )


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, SocketCan]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4 << 20)
    source = SocketCan(theirs, SystemClock())
    with ours:
        yield ours, source
    source.close()


def test_frames_of_both_kinds_come_as_they_were_sent(pair: tuple[socket.socket, SocketCan]) -> None:
    ours, source = pair
    long = bytes(range(64))
    before_ns = SystemClock().monotonic_ns()
    ours.send(frame_bytes(0x101, b"abc"))
    ours.send(frame_bytes(0x1ABC_DEF0, long, extended=True))
    ours.send(frame_bytes(0x7FF, b"", flags=REMOTE))
    batch = source.read(1.0)
    assert batch.ids.tolist() == [0x101, 0x1ABC_DEF0 | EXTENDED, 0x7FF | REMOTE]
    assert batch.lengths.tolist() == [3, 64, 0]
    assert batch.data[0, :3].tobytes() == b"abc"
    assert batch.data[1].tobytes() == long
    assert batch.drained_ns is not None
    now_ns = SystemClock().monotonic_ns()
    # The kernel stamps when a frame is sent; wall and monotonic time are read at slightly different instants.
    assert (batch.arrival_ns >= before_ns - 1_000_000).all()
    assert (batch.arrival_ns <= now_ns).all()
    assert (np.diff(batch.arrival_ns) >= 0).all()


def test_stamps_tell_when_a_frame_came_and_not_when_it_was_read(
    pair: tuple[socket.socket, SocketCan],
) -> None:
    ours, source = pair
    clock = SystemClock()
    ours.send(frame_bytes(1, b"first"))
    between_ns = clock.monotonic_ns()
    while clock.monotonic_ns() < between_ns + 50_000_000:
        pass
    ours.send(frame_bytes(1, b"second"))
    first_ns, second_ns = source.read(1.0).arrival_ns.tolist()
    assert first_ns < between_ns + 1_000_000
    assert second_ns - first_ns > 49_000_000


def test_a_full_batch_says_that_there_may_be_more(pair: tuple[socket.socket, SocketCan]) -> None:
    ours, source = pair
    sent = [frame_bytes(k % 2000, k.to_bytes(4, "little")) for k in range(BATCH_FRAMES + 10)]
    for frame in sent:
        ours.send(frame)
    first = source.read(1.0)
    got = first.data[:, :4].copy().view(np.uint32)[:, 0].tolist()
    assert len(first.ids) == BATCH_FRAMES
    assert first.drained_ns is None
    rest = source.read(1.0)
    got += rest.data[:, :4].copy().view(np.uint32)[:, 0].tolist()
    assert got == list(range(len(sent)))
    assert rest.drained_ns is not None
    assert len(source.read(0.0).ids) == 0


def test_what_is_no_frame_is_counted_and_left_out(pair: tuple[socket.socket, SocketCan]) -> None:
    ours, source = pair
    ours.send(b"too short")
    ours.send(frame_bytes(5, b"good"))
    ours.send(bytes(100))  # cut to the room of one frame by the kernel: takes 72 bytes, is taken as one
    lying = bytearray(frame_bytes(6, b"12345678"))
    lying[4] = 60
    ours.send(bytes(lying))
    batch = source.read(1.0)
    assert batch.malformed == 1
    assert batch.ids.tolist() == [5, 0, 6]
    assert batch.lengths.tolist() == [4, 0, 8], "no payload is longer than what came"


def test_the_other_end_going_away_is_an_error_after_what_it_sent(
    pair: tuple[socket.socket, SocketCan],
) -> None:
    ours, source = pair
    ours.send(frame_bytes(1, b"last"))
    assert source.read(1.0).ids.tolist() == [1]
    ours.close()
    with pytest.raises(OSError, match="the other end has closed the socket"):
        source.read(1.0)


def test_a_bus_that_is_lost_gives_its_memory_back_at_once() -> None:
    """A megabyte each, which a garbage collection that counts objects and not bytes would leave lying."""
    gc.disable()
    try:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        source = SocketCan(theirs, SystemClock())
        memory = weakref.ref(source._buffer)
        theirs.send(b"unread")  # what the other end has not read when it goes makes an error of its going
        ours.close()
        with pytest.raises(OSError, match="closed the socket"):
            source.read(1.0)
        source.close()
        del source
        assert memory() is None
    finally:
        gc.enable()


def test_descriptors_past_1024_are_read() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 1200:
        pytest.skip(f"this process may open {hard} files only")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 1200), hard))
    pairs = []
    try:
        while not pairs or pairs[-1][0].fileno() < 1030:
            pairs.append(socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        ours, theirs = pairs[-1]
        assert theirs.fileno() > 1024
        source = SocketCan(theirs, SystemClock())
        ours.send(frame_bytes(9, b"far"))
        assert source.read(1.0).ids.tolist() == [9]
        assert len(source.read(0.01).ids) == 0
    finally:
        for both in pairs:
            for end in both:
                end.close()
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_an_interface_that_cannot_be_opened_says_why() -> None:
    with pytest.raises(OSError, match=r"no-such-can0|No such device|has no SocketCAN"):
        open_socketcan(can_bus(interface="socketcan", channel="no-such-can0"), [], SystemClock())
    with pytest.raises(OSError, match=r"options \['bitrat'\] mean nothing to SocketCAN"):
        open_socketcan(
            can_bus(interface="socketcan", channel="can0", options={"bitrat": 1}), [], SystemClock()
        )


@pytest.mark.parametrize("step_s", [3600.0, -3600.0, 0.5, -0.5])
def test_a_step_of_the_wall_clock_moves_no_arrival(step_s: float) -> None:
    clock = SettableClock(100 * NS_PER_S, 1_700_000_100 * NS_PER_S)
    time = KernelTime(clock)
    none = np.zeros(4, np.int64)
    true_ns = clock.t_ns + np.array([1, 2, 3, 4]) * 1_000_000_000
    stamps = true_ns + (clock.wall - clock.t_ns)
    clock.advance(5)
    clock.set_wall(step_s)
    stamps[3] += round(step_s * NS_PER_S)  # came after the step
    got = time.monotonic(stamps, none, drained=True)
    if abs(step_s) > 10:
        assert (got == true_ns).all()
    else:  # which side of the step a stamp lies on cannot be told: late by the step at most, never early
        assert ((got - true_ns >= 0) & (got - true_ns <= abs(step_s) * NS_PER_S)).all()
    later = clock.t_ns + np.array([1, 2, 3, 4], np.int64)
    clock.advance(1)
    assert (time.monotonic(later + (clock.wall - clock.t_ns), none, drained=True) == later).all()


def test_a_frame_without_a_stamp_came_when_it_was_read() -> None:
    clock = SettableClock(100 * NS_PER_S, 1_700_000_100 * NS_PER_S)
    got = KernelTime(clock).monotonic(np.zeros(2, np.int64), np.zeros(2, np.int64), drained=True)
    assert got.tolist() == [clock.t_ns] * 2


def test_hardware_stamps_take_the_jitter_of_the_interrupt_off() -> None:
    clock = SettableClock(100 * NS_PER_S, 1_700_000_100 * NS_PER_S)
    time = KernelTime(clock)
    rng = np.random.default_rng(0)
    worst = []
    for _ in range(50):
        true_ns = clock.t_ns + np.sort(rng.integers(0, 100_000_000, 100))
        hardware = (true_ns * (1 + 20e-6)).astype(np.int64) - 5 * NS_PER_S
        software = (
            true_ns + 10_000 + rng.exponential(300_000, 100).astype(np.int64) + (clock.wall - clock.t_ns)
        )
        clock.advance(0.11)
        got = time.monotonic(software, hardware, drained=True)
        worst.append(np.abs(got - true_ns).max())
    assert max(worst[5:]) < 60_000
    assert max(worst[5:]) > 0, "the clocks differ, so this cannot be exact"


def test_dropped_frames_are_counted_from_the_kernels_own_figure() -> None:
    buffer = DatagramBuffer(4, 72)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        for _ in range(4):
            ours.send(frame_bytes(1, b""))
        assert buffer.receive(theirs.fileno()) == 4
    assert buffer.stamps().dropped is None, "nothing asked for"
    stamp = struct.pack("=QiiQQ", 32, 1, 35, 7, 8)
    drops = [struct.pack("=QiiII", 20, 1, 40, n, 0) for n in (0, 3, 5)]
    hardware = struct.pack("=Qii6q", 64, 1, 37, 0, 0, 0, 0, 2, 500)
    for row, message in enumerate([stamp, stamp + drops[1], stamp + hardware + drops[2], stamp + hardware]):
        buffer._control[row, : len(message)] = np.frombuffer(message, np.uint8)
        buffer._control_lengths[row] = len(message)
    stamps = buffer.stamps()
    assert stamps.software_ns.tolist() == [7 * NS_PER_S + 8] * 4
    assert stamps.hardware_ns.tolist() == [0, 0, 2 * NS_PER_S + 500, 2 * NS_PER_S + 500]
    assert stamps.dropped == 5


def batch(frames: list[tuple[int, bytes]]) -> CanBatch:
    data = np.full((len(frames), 64), 0xEE, np.uint8)
    for row, (_, payload) in enumerate(frames):
        data[row, : len(payload)] = np.frombuffer(payload, np.uint8)
    n = len(frames)
    ids = np.array([i for i, _ in frames], np.uint32)
    return CanBatch(ids, np.array([len(p) for _, p in frames], np.int64), data, np.arange(n, dtype=np.int64))


def test_frames_are_sorted_to_streams_in_their_order() -> None:
    layouts = {"a": layout(0x101), "b": layout(0x101, extended=True), "c": layout(0x205, length=64)}
    sorter = FrameDemultiplexer([StreamSpec(name, each, 100.0) for name, each in layouts.items()])
    rng = np.random.default_rng(1)
    frames: list[tuple[int, bytes]] = []
    expected: dict[str, list[tuple[int, int]]] = {name: [] for name in layouts}
    for k in range(200):
        name = "abc"[rng.integers(3)]
        each = layouts[name]
        samples = np.full((1, each.samples_per_frame, 1), k, np.float32)
        payload = each.encode(np.array([k]), samples)[0].tobytes()
        frames.append((each.frame_id | (EXTENDED if each.extended else 0), payload))
        expected[name].append((k, k))
    frames += [(0x101, b"short"), (0x666, b""), (0x101 | REMOTE, b""), (ERROR | 0x40, bytes(8))]
    found = sorter.sort(batch(frames), 0)
    got = {
        name: list(zip(part.counter.tolist(), part.arrival_ns.tolist(), strict=True))
        for name, part in found.frames.items()
    }
    assert got == expected
    assert all((part.samples[:, :, 0] == part.arrival_ns[:, None]).all() for part in found.frames.values())
    assert found.wrong_length == {"a": (1, 5)}
    assert found.unknown == {"0x666 (11 bit)": 1}
    assert found.notes == {"frames_unknown": 1, "frames_remote": 1, "frames_error": 1}
    assert found.errors is not None
    assert not found.errors.bus_off, "this source's error frames tell nothing"


def test_two_streams_may_share_an_id() -> None:
    sorter = FrameDemultiplexer([StreamSpec("a", layout(), 100.0), StreamSpec("b", layout(), 100.0)])
    found = sorter.sort(batch([(0x101, bytes(8))]), 0)
    assert sorted(found.frames) == ["a", "b"]


@pytest.mark.parametrize(
    ("extended", "hit", "missed"),
    [
        (False, 0x101, [0x102, 0x101 | EXTENDED, 0x101 | REMOTE]),
        (True, 0x101 | EXTENDED, [0x101, 0x101 | EXTENDED | REMOTE, 0x901 | EXTENDED]),
    ],
)
def test_the_kernels_filter_takes_what_the_sorter_takes(extended: Any, hit: int, missed: list[int]) -> None:
    match = IdMatch.of(layout(extended=extended))
    assert hit in match
    assert not any(other in match for other in missed)
    assert not match.mask & ERROR, "the kernel takes that for a filter of error frames"
