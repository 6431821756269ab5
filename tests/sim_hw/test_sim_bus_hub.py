"""The hub of the virtual CAN bus: who starts it, what ends with it, what it takes from whom."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.examples import examples
from support.formats import fits
from support.unix_buses import frame, numbers, running
from support.waiting import PATIENCE_S, eventually_blocking

from sim_hw.bus_socket import UnixBus
from sim_hw.bus_socket_hub import Hub, HubError, HubTakenError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.integration


def test_when_the_hub_ends_the_bus_is_lost_for_all_and_can_be_opened_again(bus_path: str) -> None:
    with running(bus_path):
        one, other = UnixBus(bus_path), UnixBus(bus_path)
        one.send(frame(1))
        one.send(frame(2))
    assert numbers(other, until=2) == [1, 2], "what the hub had taken is handed on"
    with pytest.raises(can.CanOperationError, match=f"unixbus {bus_path} is gone: its hub ended") as lost:
        other.recv(PATIENCE_S)
    assert lost.value.error_code == errno.ENETDOWN
    with pytest.raises(can.CanOperationError, match="is gone"):
        one.send(frame(3))
    with pytest.raises(can.CanInitializationError, match=r"there is no bus at .*daqsvc sim --bus"):
        UnixBus(bus_path, hub="join")
    one.shutdown()
    other.shutdown()
    with UnixBus(bus_path) as again, UnixBus(bus_path, hub="join") as peer:
        again.send(frame(4))
        assert numbers(peer, until=4) == [4]


def test_a_bus_that_all_have_left_is_gone_without_a_trace(bus_path: str, tmp_path: Path) -> None:
    with UnixBus(bus_path), UnixBus(bus_path):
        assert sorted(p.name for p in tmp_path.iterdir()) == ["can0", "can0.lock"]
    eventually_blocking(lambda: not list(tmp_path.iterdir()), "socket and lock are removed")


def test_many_may_come_first_at_once(bus_path: str) -> None:
    for _ in range(10):
        with ThreadPoolExecutor(6) as pool:
            buses = list(pool.map(UnixBus, [bus_path] * 6))
        buses[0].send(frame(7))
        assert [numbers(bus, until=7) for bus in buses[1:]] == [[7]] * 5
        for bus in buses:
            bus.shutdown()


def test_a_socket_that_a_dead_process_left_is_no_bus(bus_path: str) -> None:
    dead = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    dead.bind(bus_path)
    dead.close()
    with pytest.raises(can.CanInitializationError, match="there is no bus"):
        UnixBus(bus_path, hub="join")
    with UnixBus(bus_path) as one, UnixBus(bus_path, hub="join") as other:
        one.send(frame(1))
        assert numbers(other, until=1) == [1]


def test_a_file_in_the_way_is_not_touched(bus_path: str, tmp_path: Path) -> None:
    (tmp_path / "can0").write_text("dear")
    with pytest.raises(can.CanInitializationError):
        UnixBus(bus_path)
    assert (tmp_path / "can0").read_text() == "dear"
    assert [p.name for p in tmp_path.iterdir()] == ["can0"]


@pytest.mark.parametrize(
    ("channel", "options", "message"),
    [
        ("/tmp/" + "x" * 110, {}, "has 115 bytes, and a Unix socket's may have 1 to 107"),  # noqa: S108
        (
            "/nowhere/at/all/can0",
            {},
            "No such file or directory; name a path in a directory that is there",
        ),
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


def test_only_one_hub_to_a_path(bus_path: str) -> None:
    with running(bus_path), pytest.raises(HubTakenError, match="there is a bus at"):
        Hub(bus_path)
    with running(bus_path):
        pass
    with pytest.raises(HubError):
        Hub("")


@given(st.lists(st.binary(min_size=1, max_size=100), max_size=20))
@settings(max_examples=examples(25), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_no_frame_is_counted_and_goes_no_further(bus_path: str, packets: list[bytes]) -> None:
    packets = [packet for packet in packets if len(packet) not in {16, 72}]
    with running(bus_path) as hub, UnixBus(bus_path) as one, UnixBus(bus_path) as other:
        for packet in packets:
            os.write(one.fileno(), packet)
        one.send(frame(1))
        assert numbers(other, until=1) == [1]
        eventually_blocking(lambda: hub.counters.frames == 1, "the hub has counted it")
        assert hub.counters.malformed == len(packets)
        stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        stranger.connect(bus_path)
        stranger.send(b"hello?")
        assert stranger.recv(10) == b"", "who does not greet is shown out"
        stranger.close()


@given(st.binary(min_size=16, max_size=16) | st.binary(min_size=72, max_size=72))
@settings(max_examples=examples(200), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_is_in_a_frame_a_reader_survives_it(shared: tuple[UnixBus, UnixBus], packet: bytes) -> None:
    one, other = shared
    os.write(one.fileno(), packet)
    assert other.recv(PATIENCE_S) is not None


@pytest.fixture
def shared(bus_path: str) -> Iterator[tuple[UnixBus, UnixBus]]:
    with UnixBus(bus_path, fd=True) as one, UnixBus(bus_path, fd=True) as other:
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


def test_frames_of_a_process_that_started_the_bus_and_ended_arrive(bus_path: str) -> None:
    # The hub lives in the sender and ends with it; nothing it had taken in may be lost.
    sender = subprocess.Popen(
        [sys.executable, "-c", SENDER, bus_path, "3000"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert sender.stdout is not None
    assert sender.stdout.readline() == "joined\n"
    with UnixBus(bus_path, hub="join") as reader:
        sender.stdin.write("go\n")
        sender.stdin.flush()
        assert numbers(reader, until=2999) == list(range(3000))
        with pytest.raises(can.CanOperationError, match="its hub ended"):
            reader.recv(PATIENCE_S)
    sender.communicate(timeout=PATIENCE_S)
    assert sender.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_hub_of_its_own_says_what_it_carried(bus_path: str, number: int) -> None:
    hub = subprocess.Popen(
        [sys.executable, "-m", "sim_hw.bus_socket", bus_path],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert hub.stderr is not None
    assert hub.stderr.readline() == f"bus {bus_path} is up\n"
    with UnixBus(bus_path, hub="join") as one, UnixBus(bus_path, hub="join") as other:
        one.send(frame(1))
        one.send(frame(2))
        assert numbers(other, until=2) == [1, 2]
    hub.send_signal(number)
    output, errors = hub.communicate(timeout=PATIENCE_S)
    assert fits("daqsvc sim", json.loads(output)) == {
        "bus": bus_path,
        "frames": 2,
        "delivered": 2,
        "lost": 0,
        "malformed": 0,
        "clients": 2,
    }
    assert (hub.returncode, errors) == (0, "")
    assert not os.path.exists(bus_path)  # noqa: PTH110


def test_nothing_piles_up_for_an_end_that_only_sends(bus_path: str) -> None:
    """Without that the hub would queue the frames of one device for the next, and wait for it at its end."""
    with running(bus_path, queue_frames=10) as hub:
        with UnixBus(bus_path, receive=False) as one, UnixBus(bus_path, receive=False) as other:
            for number in range(1000):
                (one, other)[number % 2].send(frame(number), PATIENCE_S)
            assert other.recv(0.0) is None
        eventually_blocking(lambda: hub.counters.frames == 1000, "all frames are taken")
        assert (hub.counters.delivered, hub.counters.lost) == (0, 0)


def test_each_frame_that_counts_as_sent_is_carried_even_by_a_bus_that_ends(bus_path: str) -> None:
    """Senders send as fast as they can while the hub is told to stop."""
    sent = [0] * 4

    def send(sender: int) -> None:
        with UnixBus(bus_path, receive=False) as bus, contextlib.suppress(can.CanOperationError):
            while True:
                bus.send(frame(sender), PATIENCE_S)
                sent[sender] += 1

    with ThreadPoolExecutor(len(sent)) as pool, running(bus_path) as hub:
        done = [pool.submit(send, sender) for sender in range(len(sent))]
        eventually_blocking(lambda: min(sent) > 100, "all are sending")
        hub.stop()
        for each in done:
            each.result()
    assert hub.counters.frames == sum(sent)
