"""What a broker may send, header by header, and which topic it ends the connection for."""

from __future__ import annotations

import contextlib
import socket

import pytest

from daqsvc.publish.mqtt.suspects import FIRST_BAR_S, LONGEST_BAR_S, REASON, Suspects
from daqsvc.publish.mqtt.wire import CUT_TO, LARGEST_PACKET, ProtocolViolationError, Wire

CONSENT = b"\x20\x02\x00\x00"


@pytest.fixture
def pair():
    near, far = socket.socketpair()
    near.setblocking(False)
    far.setblocking(False)
    yield near, far
    near.close()
    far.close()


def read(wire, size=1):
    """All that comes, asked for in pieces of a size."""
    found = b""
    try:
        while piece := wire.recv(size):
            found += piece
    except BlockingIOError:
        pass
    return found


@pytest.mark.parametrize("size", [1, 3, 4096])
@pytest.mark.parametrize(
    "sent",
    [
        CONSENT,
        CONSENT + b"\x30\x04\x00\x01ax" + b"\x33\x05\x00\x01a\x00\x01",
        CONSENT + b"\x40\x02\x00\x01" + b"\x90\x03\x00\x01\x01" + b"\xb0\x02\x00\x01" + b"\xd0\x00",
        b"\x30\x04\x00\x01ax" + CONSENT,
        CONSENT + b"\x30\x80\x01" + b"x" * 128,
    ],
)
def test_what_a_broker_may_send_passes_as_it_is(pair, size, sent):
    near, far = pair
    wire = Wire(near, mqtt5=False)
    for byte in sent:  # in as many pieces as a network may make of it
        far.send(bytes([byte]))
    assert read(wire, size) == sent
    assert not wire.violation
    assert wire.pending() == 0


@pytest.mark.parametrize(
    ("sent", "mqtt5", "words"),
    [
        (b"\x10\x00", True, "no broker may send now, 0x10"),
        (b"\x40\x02\x00\x01", True, "no broker may send now, 0x40"),
        (CONSENT + CONSENT, True, "no broker may send now, 0x20"),
        (CONSENT + b"\x50\x02\x00\x01", True, "0x50"),
        (CONSENT + b"\x62\x02\x00\x01", True, "reserved bits set, 0x62"),
        (CONSENT + b"\x34\x05\x00\x01a\x00\x01", True, "a message with QoS 2"),
        (CONSENT + b"\x36\x05\x00\x01a\x00\x01", False, "a message with QoS 3"),
        (CONSENT + b"\xe0\x00", False, "0xe0"),
        (CONSENT + b"\xf0\x00", True, "0xf0"),
        (CONSENT + b"\x00\x00", True, "0x00"),
        (CONSENT + b"\x30\x80\x80\x80\x80\x01", True, "whose length has more than four bytes"),
        (CONSENT + b"\x30\x80\x80\x80\x01", True, "2097152 bytes, more than the 1048576"),
        (CONSENT + b"\x90\x80\x80\x80\x01", False, "2097152 bytes"),
    ],
)
def test_what_no_broker_may_send_ends_the_connection_with_a_sentence(pair, sent, mqtt5, words):
    near, far = pair
    far.send(sent)
    wire = Wire(near, mqtt5=mqtt5)
    with pytest.raises(ProtocolViolationError, match=words):
        read(wire)
    assert words in wire.violation


def test_of_a_message_that_is_too_long_the_beginning_passes_and_the_rest_is_dropped(pair):
    near, far = pair
    wire = Wire(near, mqtt5=False)
    length = LARGEST_PACKET + 1
    header = b"\x32" + bytes([length & 0x7F | 0x80, length >> 7 & 0x7F | 0x80, length >> 14])
    sent, found = CONSENT + header + b"x" * length + CONSENT[:0] + b"\xd0\x00", b""
    while sent:
        sent = sent[far.send(sent[:50_000]) :]
        found += read(wire, 4096)
    assert found == CONSENT + b"\x32\x80\x80\x10" + b"x" * CUT_TO + b"\xd0\x00"


def test_the_end_is_the_end(pair):
    near, far = pair
    far.send(CONSENT + b"\x30\x7f")
    far.close()
    assert read(Wire(near, mqtt5=True)) == CONSENT + b"\x30\x7f"


def test_the_topic_that_was_alone_under_way_twice_is_left_alone_for_ever_longer():
    suspects = Suspects()
    assert suspects.lost((), 0.0) is None
    for _ in range(2):
        assert not suspects.careful
        assert suspects.lost(("a", "b"), 0.0) is None
    assert suspects.careful
    assert suspects.lost(("b",), 0.0) is None
    assert suspects.lost(("b",), 0.0) == "b"
    assert suspects.careful, "there may be more of them"
    assert suspects.barred(FIRST_BAR_S - 1) == {"b": REASON}
    assert suspects.reason("b", FIRST_BAR_S) is None
    at_s, for_s = FIRST_BAR_S, FIRST_BAR_S
    for _ in range(20):
        assert suspects.lost(("a", "b"), at_s) == "b", "it is known by now"
        for_s = min(2 * for_s, LONGEST_BAR_S)
        assert suspects.reason("b", at_s + for_s - 1)
        at_s += for_s
        assert suspects.reason("b", at_s) is None
    suspects.acknowledged("b")
    assert suspects.lost(("b",), at_s) is None, "it is nothing special any more"


def test_a_broker_that_was_away_ended_no_connection_for_a_message():
    suspects = Suspects()
    for _ in range(10):
        assert suspects.lost(("a",), 0.0) is None
        suspects.away()
    assert not suspects.careful
    for topic in "abcdefgh":
        assert suspects.lost((topic,), 0.0) is None, "another one each time"
    suspects.settled()
    assert not suspects.careful


class Counted:
    """A socket that counts how often it is asked to send, and may be broken."""

    def __init__(self, inner):
        self._inner, self.sends, self.error = inner, 0, None

    def __getattr__(self, name):
        return getattr(self._inner, name)

    def send(self, data):
        self.sends += 1
        if self.error is not None:
            raise self.error
        return self._inner.send(data)


def test_the_packets_of_a_turn_leave_together_and_in_order(pair):
    near, far = pair
    counted = Counted(near)
    wire = Wire(counted, mqtt5=True)
    assert [wire.send(piece) for piece in (b"one", b"two", b"three")] == [3, 3, 5]
    assert (counted.sends, wire.unsent) == (0, 11)
    wire.flush()
    assert (counted.sends, wire.unsent) == (1, 0)
    assert far.recv(100) == b"onetwothree"


def test_what_the_system_does_not_take_waits_and_of_too_much_nothing_is_taken(pair):
    near, far = pair
    wire = Wire(near, mqtt5=True)
    sent, taken = b"", b""
    with contextlib.suppress(BlockingIOError):
        for number in range(1000):
            sent += bytes([number % 251]) * wire.send(bytes([number % 251]) * 30_000)
            wire.flush()
    assert 0 < wire.unsent < 1_000_000, "it has ended before all of them"
    while wire.unsent:
        taken += far.recv(1 << 20)
        wire.flush()
    while len(taken) < len(sent):
        taken += far.recv(1 << 20)
    assert taken == sent


def test_a_connection_that_breaks_gives_what_has_arrived_and_then_says_so(pair):
    """An error of sending is told once; the broker's reason may have come before it."""
    near, far = pair
    counted = Counted(near)
    wire = Wire(counted, mqtt5=True)
    far.send(CONSENT)
    wire.send(b"lost")
    counted.error = OSError("no route to host")
    with pytest.raises(OSError, match="no route"):
        wire.flush()
    assert wire.recv(2) + wire.recv(2) == CONSENT
    with pytest.raises(OSError, match="no route"):
        wire.recv(1)
    wire.close()


def test_the_last_word_is_sent_before_the_socket_is_closed(pair):
    near, far = pair
    wire = Wire(near, mqtt5=True)
    wire.send(b"\xe0\x00")
    wire.close()
    assert far.recv(10) == b"\xe0\x00"
