"""The virtual CAN bus over a Unix socket, as python-can's other interfaces are tested, and its hub."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sim_hw.bus_socket import UnixBus
from sim_hw.bus_socket_hub import Hub, HubError, HubTakenError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PATIENCE_S = 20.0
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)


@pytest.fixture
def path(tmp_path: Path) -> str:
    return str(tmp_path / "can0")


@contextlib.contextmanager
def running(path: str, **options: int) -> Iterator[Hub]:
    hub = Hub(path, **options)
    hub.start()
    try:
        yield hub
    finally:
        hub.stop()


def frame(number: int, **fields: object) -> can.Message:
    return can.Message(arbitration_id=number, is_extended_id=False, data=number.to_bytes(4, "big"), **fields)


def numbers(bus: can.BusABC, wait_s: float = PATIENCE_S, until: int | None = None) -> list[int]:
    """Numbers of the frames that are there, -1 for an error frame; ends with ``until`` if that is given."""
    found: list[int] = []
    while (message := bus.recv(wait_s)) is not None:
        found.append(-1 if message.is_error_frame else message.arbitration_id)
        if found[-1] == until:
            break
    return found


def eventually(true, what: str) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < until_s, what
        time.sleep(0.001)


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
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_every_kind_of_frame_arrives_as_it_was_sent(path: str, sent: list[can.Message]) -> None:
    with UnixBus(path, fd=True) as one, UnixBus(path, fd=True) as other:
        for message in sent:
            one.send(message)
        for message in sent:
            received = other.recv(PATIENCE_S)
            assert received is not None
            assert received.equals(message, timestamp_delta=None, check_channel=False, check_direction=False)
            assert received.is_rx
            assert received.channel == path
        assert one.recv(0) is None, "a frame came back to its sender"


def test_python_can_knows_the_interface(path: str) -> None:
    with (
        can.Bus(interface="unixbus", channel=path, fd=True, bitrate=500_000, data_bitrate=2_000_000) as bus,
        can.Bus(interface="unixbus", channel=path) as classic,
    ):
        assert isinstance(bus, UnixBus)
        assert (bus.protocol, classic.protocol) == (can.CanProtocol.CAN_FD, can.CanProtocol.CAN_20)
        assert str(bus) == f"unixbus {path}"
        before_s = time.time()
        bus.send(frame(1))
        message = classic.recv(PATIENCE_S)
        assert message is not None
        assert before_s - 1e-3 <= message.timestamp <= time.time() + 1e-3


def test_a_classic_end_neither_sees_nor_sends_fd_frames(path: str) -> None:
    with UnixBus(path, fd=True) as bus, UnixBus(path) as classic:
        bus.send(frame(1, is_fd=True))
        bus.send(frame(2))
        assert numbers(classic, until=2) == [2]
        with pytest.raises(can.CanOperationError, match=r"opened without fd, and frame 0x3 .*fd = true"):
            classic.send(frame(3, is_fd=True))


def test_own_frames_come_back_if_asked_for(path: str) -> None:
    with UnixBus(path, receive_own_messages=True) as bus, UnixBus(path) as other:
        bus.send(frame(1))
        other.send(frame(2))
        assert numbers(other, until=1) == [1]
        assert sorted([*numbers(bus, until=1), *numbers(bus, 0.0)]) in ([1], [1, 2])


def test_filters_are_those_of_python_can(path: str) -> None:
    wanted = [{"can_id": 0x100, "can_mask": 0x7F0, "extended": False}]
    with UnixBus(path) as bus, UnixBus(path, can_filters=wanted) as picky:
        for number in (0x0FF, 0x100, 0x10F, 0x110):
            bus.send(frame(number))
        bus.send(can.Message(arbitration_id=0x100, is_extended_id=True))
        assert numbers(picky, until=0x10F) == [0x100, 0x10F]
        picky.set_filters(None)
        bus.send(frame(0x7FF))
        assert numbers(picky, until=0x7FF)[-1] == 0x7FF


def test_everybody_sees_the_same_order(path: str) -> None:
    with contextlib.ExitStack() as stack:
        buses = [stack.enter_context(UnixBus(path, receive_own_messages=True)) for _ in range(4)]

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


def test_the_file_descriptor_tells_of_frames(path: str) -> None:
    with UnixBus(path) as one, UnixBus(path) as other:
        assert select.select([other], [], [], 0)[0] == []
        assert other.recv(0) is None
        assert other.recv(0.01) is None
        one.send(frame(1))
        assert select.select([other], [], [], PATIENCE_S)[0] == [other]
        assert numbers(other, until=1) == [1]
    assert other.fileno() == -1


def test_leaving_ends_a_recv_that_waits(path: str) -> None:
    bus = UnixBus(path)
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


def test_a_slow_reader_is_told_exactly_what_it_lost_and_others_lose_nothing(path: str) -> None:
    sent = 4000
    with running(path, queue_frames=100) as hub, UnixBus(path) as node, UnixBus(path) as quick:
        slow = UnixBus(path)
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


def test_the_notice_stands_where_frames_are_missing(path: str) -> None:
    with running(path, queue_frames=50) as hub, UnixBus(path) as node, UnixBus(path, fd=True) as slow:
        sent = received = 0
        for _ in range(6):
            for _ in range(600):
                node.send(can.Message(arbitration_id=sent, is_extended_id=True))
                sent += 1
            eventually(lambda: hub.counters.frames == sent, "the hub has it")  # noqa: B023 - called at once
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


def test_when_the_hub_ends_the_bus_is_lost_for_all_and_can_be_opened_again(path: str) -> None:
    with running(path):
        one, other = UnixBus(path), UnixBus(path)
        one.send(frame(1))
        one.send(frame(2))
    assert numbers(other, until=2) == [1, 2], "what the hub had taken is handed on"
    with pytest.raises(can.CanOperationError, match=f"unixbus {path} is gone: its hub ended") as lost:
        other.recv(PATIENCE_S)
    assert lost.value.error_code == errno.ENETDOWN
    with pytest.raises(can.CanOperationError, match="is gone"):
        one.send(frame(3))
    with pytest.raises(can.CanInitializationError, match=r"there is no bus at .*daqsvc sim --bus"):
        UnixBus(path, hub="join")
    one.shutdown()
    other.shutdown()
    with UnixBus(path) as again, UnixBus(path, hub="join") as peer:
        again.send(frame(4))
        assert numbers(peer, until=4) == [4]


def test_a_bus_that_all_have_left_is_gone_without_a_trace(path: str, tmp_path: Path) -> None:
    with UnixBus(path), UnixBus(path):
        assert sorted(p.name for p in tmp_path.iterdir()) == ["can0", "can0.lock"]
    eventually(lambda: not list(tmp_path.iterdir()), "socket and lock are removed")


def test_many_may_come_first_at_once(path: str) -> None:
    for _ in range(10):
        with ThreadPoolExecutor(6) as pool:
            buses = list(pool.map(UnixBus, [path] * 6))
        buses[0].send(frame(7))
        assert [numbers(bus, until=7) for bus in buses[1:]] == [[7]] * 5
        for bus in buses:
            bus.shutdown()


def test_a_socket_that_a_dead_process_left_is_no_bus(path: str) -> None:
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    dead.bind(path)
    dead.close()
    with pytest.raises(can.CanInitializationError, match="there is no bus"):
        UnixBus(path, hub="join")
    with UnixBus(path) as one, UnixBus(path, hub="join") as other:
        one.send(frame(1))
        assert numbers(other, until=1) == [1]


def test_a_file_in_the_way_is_not_touched(path: str, tmp_path: Path) -> None:
    (tmp_path / "can0").write_text("dear")
    with pytest.raises(can.CanInitializationError):
        UnixBus(path)
    assert (tmp_path / "can0").read_text() == "dear"
    assert [p.name for p in tmp_path.iterdir()] == ["can0"]


@pytest.mark.parametrize(
    ("channel", "options", "message"),
    [
        ("/tmp/" + "x" * 110, {}, "has 115 bytes, and a Unix socket's may have 1 to 107"),  # noqa: S108
        ("/nowhere/at/all/can0", {}, "No such file or directory; name a path in a directory that is there"),
        ("can0", {"hubb": "join"}, "a unixbus has no option 'hubb'; there are fd, hub"),
        ("can0", {"hub": "maybe"}, 'hub = \'maybe\' of a unixbus must be "start" or "join"'),
    ],
)
def test_what_cannot_be_opened_says_why(
    channel: str, options: dict[str, str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(can.CanInitializationError, match=message):
        can.Bus(interface="unixbus", channel=channel, **options)


def test_only_one_hub_to_a_path(path: str) -> None:
    with running(path), pytest.raises(HubTakenError, match="there is a bus at"):
        Hub(path)
    with running(path):
        pass
    with pytest.raises(HubError):
        Hub("")


@given(st.lists(st.binary(min_size=1, max_size=100), max_size=20))
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_no_frame_is_counted_and_goes_no_further(path: str, packets: list[bytes]) -> None:
    packets = [packet for packet in packets if len(packet) not in {16, 72}]
    with running(path) as hub, UnixBus(path) as one, UnixBus(path) as other:
        for packet in packets:
            os.write(one.fileno(), packet)
        one.send(frame(1))
        assert numbers(other, until=1) == [1]
        eventually(lambda: hub.counters.frames == 1, "the hub has counted it")
        assert hub.counters.malformed == len(packets)
        stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        stranger.connect(path)
        stranger.send(b"hello?")
        assert stranger.recv(10) == b"", "who does not greet is shown out"
        stranger.close()


@given(st.binary(min_size=16, max_size=16) | st.binary(min_size=72, max_size=72))
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_is_in_a_frame_a_reader_survives_it(shared: tuple[UnixBus, UnixBus], packet: bytes) -> None:
    one, other = shared
    os.write(one.fileno(), packet)
    assert other.recv(PATIENCE_S) is not None


@pytest.fixture
def shared(path: str) -> Iterator[tuple[UnixBus, UnixBus]]:
    with UnixBus(path, fd=True) as one, UnixBus(path, fd=True) as other:
        yield one, other


SENDER = """
import sys, can
bus = can.Bus(interface="unixbus", channel=sys.argv[1])
print("joined", flush=True)
sys.stdin.readline()
for number in range(int(sys.argv[2])):
    bus.send(can.Message(arbitration_id=number, is_extended_id=True))
bus.shutdown()
"""


def test_frames_of_a_process_that_started_the_bus_and_ended_arrive(path: str) -> None:
    # The hub lives in the sender and ends with it; nothing it had taken in may be lost.
    sender = subprocess.Popen(
        [sys.executable, "-c", SENDER, path, "3000"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert sender.stdout is not None
    assert sender.stdout.readline() == "joined\n"
    with UnixBus(path, hub="join") as reader:
        sender.stdin.write("go\n")
        sender.stdin.flush()
        assert numbers(reader, until=2999) == list(range(3000))
        with pytest.raises(can.CanOperationError, match="its hub ended"):
            reader.recv(PATIENCE_S)
    sender.communicate(timeout=PATIENCE_S)
    assert sender.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_hub_of_its_own_says_what_it_carried(path: str, number: int) -> None:
    hub = subprocess.Popen(
        [sys.executable, "-m", "sim_hw.bus_socket", path],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert hub.stderr is not None
    assert hub.stderr.readline() == f"bus {path} is up\n"
    with UnixBus(path, hub="join") as one, UnixBus(path, hub="join") as other:
        one.send(frame(1))
        one.send(frame(2))
        assert numbers(other, until=2) == [1, 2]
    hub.send_signal(number)
    output, errors = hub.communicate(timeout=PATIENCE_S)
    assert json.loads(output) == {
        "bus": path,
        "frames": 2,
        "delivered": 2,
        "lost": 0,
        "malformed": 0,
        "clients": 2,
    }
    assert (hub.returncode, errors) == (0, "")
    assert not os.path.exists(path)  # noqa: PTH110
