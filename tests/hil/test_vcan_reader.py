"""The SocketCAN reader on a CAN interface of the kernel."""

from __future__ import annotations

import contextlib
import errno
import os
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bus_tables import can_bus
from support.can_standin import frame_bytes

from daqsvc.acquisition.clock import NS_PER_S, SystemClock
from drivers.can.batches import ERROR, EXTENDED, REMOTE, STANDARD_ID, CanBatch, IdMatch
from drivers.can.socketcan import SocketCan, dropped_frames, open_socketcan

if TYPE_CHECKING:
    from support.vcan_links import VcanLink

ALL = IdMatch(0, 0)


PATIENCE_S = 10.0


def opened(vcan: VcanLink, *matches: IdMatch, **options: object) -> contextlib.closing[SocketCan]:
    bus = can_bus(**({"interface": "socketcan", "channel": vcan.name, "fd": True} | options))
    return contextlib.closing(open_socketcan(bus, matches, SystemClock()))


def read_all(source: SocketCan, frames: int) -> list[CanBatch]:
    """What comes until so many frames are accounted for; they may reach the socket after they were sent."""
    batches: list[CanBatch] = []
    deadline_s = time.monotonic() + PATIENCE_S
    while sum(len(batch.ids) + batch.overrun for batch in batches) < frames:
        assert time.monotonic() < deadline_s, f"{frames} frames do not come: {batches}"
        batches.append(source.read(0.01))
    batches.append(source.read(0.05))
    return batches


def ids_of(batches: list[CanBatch]) -> list[int]:
    return np.concatenate([batch.ids for batch in batches]).tolist()


def test_classic_and_fd_frames_come_in_order_with_their_time(vcan: VcanLink) -> None:
    clock = SystemClock()
    with opened(vcan, ALL) as source, vcan.sender() as sender:
        before_ns = clock.monotonic_ns()
        sender.send(frame_bytes(0x123, b"12345678"))
        sender.send(frame_bytes(0x1234_5678, bytes(range(64)), extended=True))
        after_ns = clock.monotonic_ns()
        time.sleep(0.05)
        batch = source.read(1.0)
    assert batch.ids.tolist() == [0x123, 0x1234_5678 | EXTENDED]
    assert batch.lengths.tolist() == [8, 64]
    assert batch.data[1].tobytes() == bytes(range(64))
    # Stamped when they came and not 50 ms later; the two clocks are read some microseconds apart.
    assert before_ns - 2_000_000 < batch.arrival_ns[0] <= batch.arrival_ns[1] < after_ns + 2_000_000


def test_the_kernel_passes_on_only_what_some_stream_has(vcan: VcanLink) -> None:
    wanted = IdMatch(0x101, STANDARD_ID | EXTENDED | REMOTE)
    with (
        opened(vcan, wanted) as filtered,
        opened(vcan, wanted, filter=False) as open_to_all,
        vcan.sender() as sender,
    ):
        for frame_id, extended, flags in [
            (0x100, False, 0),
            (0x101, False, 0),
            (0x101, True, 0),
            (0x101, False, REMOTE),
            (0x101, False, 0),
        ]:
            sender.send(frame_bytes(frame_id, b"", extended=extended, flags=flags))
        error = frame_bytes(ERROR | 0x40, bytes(8))
        sender.send(error)
        assert len(ids_of(read_all(open_to_all, 6))) == 6
        assert ids_of(read_all(filtered, 3)) == [0x101, 0x101, ERROR | 0x40]


def test_a_flood_is_accounted_for_to_the_frame(vcan: VcanLink) -> None:
    frames_sent = 50_000
    got: list[np.ndarray] = []
    overrun = 0
    done = threading.Event()

    def flood() -> None:
        with vcan.sender() as sender:
            for k in range(frames_sent):
                while True:
                    try:
                        sender.send(frame_bytes(0x101, k.to_bytes(8, "little")))
                    except OSError as error:
                        if error.errno != errno.ENOBUFS:
                            raise
                    else:
                        break
        done.set()

    thread = threading.Thread(target=flood)
    with opened(vcan, ALL, receive_buffer_bytes=128 << 10) as source:
        thread.start()
        try:
            while True:
                ended = done.is_set()
                batch = source.read(0.02)
                overrun += batch.overrun
                got.append(batch.data[:, :8].copy().view(np.int64)[:, 0])
                if ended and not len(batch.ids):
                    break
                time.sleep(0.02)  # too slow on purpose
        finally:
            thread.join()
    numbers = np.concatenate(got)
    assert (np.diff(numbers) > 0).all()
    assert len(numbers) + overrun == frames_sent
    assert overrun > 0, "the flood overran nothing: the test shows nothing"


def test_drops_are_known_even_if_no_frame_follows(vcan: VcanLink) -> None:
    with opened(vcan, ALL, receive_buffer_bytes=4096) as source, vcan.sender() as sender:
        for k in range(500):
            sender.send(frame_bytes(1, k.to_bytes(4, "little")))
        time.sleep(0.05)
        dropped = dropped_frames(source._socket)
        batches = read_all(source, 500)
    assert 0 < dropped < 500
    assert sum(b.overrun for b in batches) == dropped
    assert sum(len(b.ids) for b in batches) == 500 - dropped


def test_an_interface_that_goes_down_gives_what_it_had_and_then_the_reason(vcan: VcanLink) -> None:
    with opened(vcan, ALL) as source:
        with vcan.sender() as sender:
            for k in range(5):
                sender.send(frame_bytes(k, b""))
            time.sleep(0.05)  # what still is on its way to the socket goes down with the interface
            vcan.down()
        assert source.read(0.1).ids.tolist() == list(range(5))
        with pytest.raises(OSError, match="Network is down") as raised:
            source.read(0.1)
        assert raised.value.errno == errno.ENETDOWN
    with pytest.raises(OSError, match=rf"interface {vcan.name} is down; set it up with"):
        opened(vcan, ALL)
    vcan.remove()
    with pytest.raises(OSError, match="No such device"):
        opened(vcan, ALL)


def test_sockets_opened_and_closed_leave_no_descriptor(vcan: VcanLink) -> None:
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(100):
        with opened(vcan, ALL):
            pass
        vcan.down()
        with pytest.raises(OSError, match="is down"):
            opened(vcan, ALL)
        vcan.up()
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_a_step_of_the_wall_clock_moves_no_arrival(vcan: VcanLink) -> None:
    if os.environ.get("DAQSVC_HIL_GUEST") != "1":
        pytest.skip("sets the wall clock, and this machine is no guest; test_socketcan.py has it, too")
    clock = SystemClock()
    arrivals: list[int] = []
    sent: list[int] = []
    with opened(vcan, ALL) as source, vcan.sender() as sender:
        for step_s in (0, 3600, -7200, 3600):
            sender.send(frame_bytes(1, b""))
            sent.append(clock.monotonic_ns())
            time.clock_settime_ns(time.CLOCK_REALTIME, time.time_ns() + step_s * NS_PER_S)
            sender.send(frame_bytes(1, b""))
            sent.append(clock.monotonic_ns())
            arrivals += [t_ns for batch in read_all(source, 2) for t_ns in batch.arrival_ns.tolist()]
    assert np.abs(np.array(arrivals) - np.array(sent)).max() < 50_000_000
