"""The virtual CAN bus over a Unix socket, as python-can's other interfaces are tested."""

from __future__ import annotations

import contextlib
import select
import threading
import time

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.examples import examples
from support.unix_buses import frame, numbers, running
from support.waiting import PATIENCE_S, eventually_blocking

from sim_hw.bus_socket import UnixBus

pytestmark = pytest.mark.integration
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)

messages = st.one_of(
    st.builds(
        lambda i, x, data: can.Message(arbitration_id=i if x else i & 0x7FF, is_extended_id=x, data=data),
        st.integers(0, 2**29 - 1),
        st.booleans(),
        st.binary(max_size=8),
    ),
    st.builds(
        lambda i, dlc: can.Message(arbitration_id=i, is_extended_id=False, is_remote_frame=True, dlc=dlc),
        st.integers(0, 2**11 - 1),
        st.integers(0, 8),
    ),
    st.builds(
        lambda i, n, fill, brs, esi: can.Message(
            arbitration_id=i,
            is_fd=True,
            data=bytes([fill]) * n,
            bitrate_switch=brs,
            error_state_indicator=esi,
        ),
        st.integers(0, 2**29 - 1),
        st.sampled_from(FD_LENGTHS),
        st.integers(0, 255),
        st.booleans(),
        st.booleans(),
    ),
    st.builds(
        lambda i, data: can.Message(
            arbitration_id=i, is_extended_id=False, is_error_frame=True, data=data, dlc=8
        ),
        st.integers(0, 0x1FF),
        st.binary(min_size=8, max_size=8),
    ),
)


@given(st.lists(messages, min_size=1, max_size=30))
@settings(max_examples=examples(40), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_kind_of_frame_arrives_as_it_was_sent(bus_path: str, sent: list[can.Message]) -> None:
    with UnixBus(bus_path, fd=True) as one, UnixBus(bus_path, fd=True) as other:
        for message in sent:
            one.send(message)
        for message in sent:
            received = other.recv(PATIENCE_S)
            assert received is not None
            assert received.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)
            assert received.is_rx
            assert received.channel == bus_path
        assert one.recv(0) is None, "a frame came back to its sender"


def test_python_can_knows_the_interface(bus_path: str) -> None:
    with (
        can.Bus(
            interface="unixbus", channel=bus_path, fd=True, bitrate=500_000, data_bitrate=2_000_000
        ) as bus,
        can.Bus(interface="unixbus", channel=bus_path) as classic,
    ):
        assert isinstance(bus, UnixBus)
        assert (bus.protocol, classic.protocol) == (can.CanProtocol.CAN_FD, can.CanProtocol.CAN_20)
        assert str(bus) == f"unixbus {bus_path}"
        before_s = time.time()
        bus.send(frame(1))
        message = classic.recv(PATIENCE_S)
        assert message is not None
        assert before_s - 1e-3 <= message.timestamp <= time.time() + 1e-3


def test_a_classic_end_neither_sees_nor_sends_fd_frames(bus_path: str) -> None:
    with UnixBus(bus_path, fd=True) as bus, UnixBus(bus_path) as classic:
        bus.send(frame(1, is_fd=True))
        bus.send(frame(2))
        assert numbers(classic, until=2) == [2]
        with pytest.raises(can.CanOperationError, match=r"opened without fd, and frame 0x3 .*fd = true"):
            classic.send(frame(3, is_fd=True))


def test_a_classic_end_loses_no_fd_frames_since_it_is_not_sent_any(bus_path: str) -> None:
    with (
        running(bus_path, queue_frames=16) as hub,
        UnixBus(bus_path, fd=True) as bus,
        UnixBus(bus_path) as classic,
    ):
        for k in range(2000):
            bus.send(frame(k % 0x700, is_fd=True))
        bus.send(frame(0x7FF))
        assert numbers(classic, until=0x7FF) == [0x7FF]
        assert (classic.frames_lost, hub.counters.lost) == (0, 0)


def test_own_frames_come_back_if_asked_for(bus_path: str) -> None:
    with UnixBus(bus_path, receive_own_messages=True) as bus, UnixBus(bus_path) as other:
        bus.send(frame(1))
        other.send(frame(2))
        assert numbers(other, until=1) == [1]
        assert sorted([*numbers(bus, until=1), *numbers(bus, 0.0)]) in ([1], [1, 2])


def test_filters_are_those_of_python_can(bus_path: str) -> None:
    wanted = [{"can_id": 0x100, "can_mask": 0x7F0, "extended": False}]
    with UnixBus(bus_path) as bus, UnixBus(bus_path, can_filters=wanted) as picky:
        for number in (0x0FF, 0x100, 0x10F, 0x110):
            bus.send(frame(number))
        bus.send(can.Message(arbitration_id=0x100, is_extended_id=True))
        assert numbers(picky, until=0x10F) == [0x100, 0x10F]
        picky.set_filters(None)
        bus.send(frame(0x7FF))
        assert numbers(picky, until=0x7FF)[-1] == 0x7FF


def test_everybody_sees_the_same_order(bus_path: str) -> None:
    with contextlib.ExitStack() as stack:
        buses = [stack.enter_context(UnixBus(bus_path, receive_own_messages=True)) for _ in range(4)]

        def send(k: int) -> None:
            for i in range(100):
                buses[k].send(frame(100 * k + i))

        threads = [threading.Thread(target=send, args=(k,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        seen = [[bus.recv(PATIENCE_S).arbitration_id for _ in range(400)] for bus in buses]
    assert sorted(seen[0]) == list(range(400))
    assert seen[1:] == [seen[0]] * 3


def test_the_file_descriptor_tells_of_frames(bus_path: str) -> None:
    with UnixBus(bus_path) as one, UnixBus(bus_path) as other:
        assert select.select([other], [], [], 0)[0] == []
        assert other.recv(0) is None
        assert other.recv(0.01) is None
        one.send(frame(1))
        assert select.select([other], [], [], PATIENCE_S)[0] == [other]
        assert numbers(other, until=1) == [1]
    assert other.fileno() == -1


def test_leaving_ends_a_recv_that_waits(bus_path: str) -> None:
    bus = UnixBus(bus_path)
    failed: list[Exception] = []

    def wait() -> None:
        try:
            bus.recv(None)
        except can.CanOperationError as error:
            failed.append(error)

    waiting = threading.Thread(target=wait)
    waiting.start()
    bus.shutdown()
    waiting.join(PATIENCE_S)
    assert not waiting.is_alive()
    assert "was left" in str(failed[0])
    bus.shutdown()  # twice is once


def test_a_slow_reader_is_told_exactly_what_it_lost_and_others_lose_nothing(bus_path: str) -> None:
    sent = 4000
    with running(bus_path, queue_frames=100) as hub, UnixBus(bus_path) as node, UnixBus(bus_path) as quick:
        slow = UnixBus(bus_path)
        for i in range(sent):
            node.send(frame(i % 0x700))
            assert quick.recv(PATIENCE_S).arbitration_id == i % 0x700
        assert quick.frames_lost == 0
        # The loss is told even if nothing follows it.
        received = numbers(slow, wait_s=0.5)
        frames = [number for number in received if number >= 0]
        assert slow.frames_lost == sent - len(frames) == hub.counters.lost > 0
        # The buffer overflows once, at the end: what came before is whole, and the notice follows it.
        assert received == [*(i % 0x700 for i in range(len(frames))), -1]
        node.send(frame(0x7FE))
        assert numbers(slow, until=0x7FE) == [0x7FE], "a reader that has caught up gets everything again"
        slow.shutdown()


def test_the_notice_stands_where_frames_are_missing(bus_path: str) -> None:
    with (
        running(bus_path, queue_frames=50) as hub,
        UnixBus(bus_path) as node,
        UnixBus(bus_path, fd=True) as slow,
    ):
        sent = received = 0
        for _ in range(6):
            for _ in range(600):
                node.send(can.Message(arbitration_id=sent, is_extended_id=True))
                sent += 1
            eventually_blocking(lambda: hub.counters.frames == sent, "the hub has it")  # noqa: B023 - called at once
            expected = received
            for _ in range(300):
                before = slow.frames_lost
                message = slow.recv(PATIENCE_S)
                expected += slow.frames_lost - before
                if not message.is_error_frame:
                    assert message.arbitration_id == expected
                    expected += 1
            received = expected
        assert slow.frames_lost > 0
