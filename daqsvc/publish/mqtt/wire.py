"""A socket that looks at what a broker sends, packet by packet, before the MQTT library does.

What goes to the broker is collected, so that the packets of one turn of the event loop leave together.

The library takes what a broker sends on trust: packets of up to 256 MiB, messages of QoS 2 that it keeps
until they are released, kinds of packets that were not asked for. Here, each packet's fixed header (MQTT 5
and 3.1.1, section 2.1) is read first. What no broker may send ends the connection with a sentence.
"""

from __future__ import annotations

import contextlib
import ssl
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import socket

LARGEST_PACKET: Final = 1 << 20
"""Bytes of the largest packet that is taken from a broker; MQTT 5 brokers get this limit."""

CUT_TO: Final = 1 << 18
"""What is left of a larger message of MQTT 3.1.1: too much to be a command, so it is refused as too long."""

_READ_BYTES = 1 << 16
_UNSENT_BYTES = 1 << 18
"""Bytes that may wait to be sent before no more are taken."""

_CONNACK, _PUBLISH, _DISCONNECT = 2, 3, 14
_ANSWERS = {4: "PUBACK", 9: "SUBACK", 11: "UNSUBACK", 13: "PINGRESP"}
_LENGTH_BYTES = 4


class ProtocolViolationError(ConnectionError):
    """The broker has sent what no broker may send."""


class Wire:
    """A connected socket, plain or TLS, as far as the MQTT library uses one.

    Args:
        inner: the socket.
        mqtt5: whether MQTT 5 is spoken, rather than 3.1.1.

    Attributes:
        packets: how many have begun to arrive.
        violation: what the broker has sent against the standard; empty if nothing.
    """

    def __init__(self, inner: socket.socket, *, mqtt5: bool) -> None:
        self.packets = 0
        self.violation = ""
        self._inner = inner
        self._mqtt5 = mqtt5
        self._consented = False
        self._read, self._at = b"", 0
        self._head = bytearray()
        self._ready = bytearray()
        self._passing = 0
        self._discarding = 0
        self._unsent = bytearray()
        self._failure: OSError | None = None

    def recv(self, size: int) -> bytes:
        """Up to ``size`` bytes, none at the end.

        Raises:
            BlockingIOError: there are none now (TLS: `ssl.SSLWantReadError`).
            ProtocolViolationError: see `violation`.
            OSError: the connection is broken.
        """
        if not self._ready and not self._passing and not self._next_packet():
            return b""
        if self._ready:
            data = bytes(self._ready[:size])
            del self._ready[:size]
            return data
        data = self._take(min(size, self._passing))
        self._passing -= len(data)
        return data

    def pending(self) -> int:
        """Bytes that have arrived although the system shows none any more."""
        decoded = self._inner.pending() if isinstance(self._inner, ssl.SSLSocket) else 0
        return decoded + len(self._ready) + len(self._read) - self._at

    def _take(self, most: int) -> bytes:
        """What has arrived, at most so much; read in large pieces, for the library asks for single bytes."""
        if self._at == len(self._read):
            if self._failure is not None:
                raise self._failure
            self._read, self._at = self._inner.recv(_READ_BYTES), 0
        data = self._read[self._at : self._at + most]
        self._at += len(data)
        return data

    def send(self, data: bytes) -> int:
        """Take bytes that `flush` will send; how many were taken.

        Each call of the system costs more than a message: of a flood, many go together.

        Raises:
            BlockingIOError: too many wait already.
        """
        if len(self._unsent) >= _UNSENT_BYTES:
            raise BlockingIOError
        self._unsent += data
        return len(data)

    @property
    def unsent(self) -> int:
        """Bytes that wait to be sent."""
        return len(self._unsent)

    def flush(self) -> None:
        """Send what fits now.

        Raises:
            OSError: the connection is broken; `recv` gives what has arrived until then, and raises it, too.
        """
        try:
            while self._unsent:
                del self._unsent[: self._inner.send(self._unsent)]
        except (BlockingIOError, ssl.SSLWantReadError, ssl.SSLWantWriteError):
            return
        except OSError as error:
            self._failure = error
            with contextlib.suppress(OSError):  # perhaps the broker has sent why it ends the connection
                self._read, self._at = self._read[self._at :] + self._inner.recv(_READ_BYTES), 0
            raise

    def close(self) -> None:
        """Send what still fits, and close the socket."""
        if self._failure is None:
            with contextlib.suppress(OSError):
                self.flush()
        self._inner.close()

    def fileno(self) -> int:
        """The system's number of the socket; -1 once it is closed."""
        return self._inner.fileno()

    def setblocking(self, flag: bool) -> None:  # noqa: FBT001  as of a socket
        """Whether to wait in `recv` and `send`."""
        self._inner.setblocking(flag)

    def settimeout(self, timeout_s: float | None) -> None:
        """How long to wait in `recv`, `send` and `do_handshake`."""
        self._inner.settimeout(timeout_s)

    def do_handshake(self) -> None:
        """Shake hands, with TLS; closes the socket if that fails, which the library would not."""
        if not isinstance(self._inner, ssl.SSLSocket):
            return
        try:
            self._inner.do_handshake()
        except BaseException:
            self._inner.close()
            raise

    @property
    def shown_certificate(self) -> bytes | None:
        """The broker's certificate, DER; None without TLS."""
        return self._inner.getpeercert(binary_form=True) if isinstance(self._inner, ssl.SSLSocket) else None

    def _next_packet(self) -> bool:
        """Drop what is left of a packet that was cut, and read the next one's header; False at the end."""
        while self._discarding:
            dropped = len(self._take(self._discarding))
            if not dropped:
                return False
            self._discarding -= dropped
        while len(self._head) < 2 or self._head[-1] & 0x80:
            if len(self._head) > _LENGTH_BYTES:
                raise self._violated("a packet whose length has more than four bytes")
            byte = self._take(1)
            if not byte:
                return False
            self._head += byte
            if len(self._head) == 1:
                self._check_kind(byte[0])
        self.packets += 1
        first, length = self._head[0], sum((b & 0x7F) << 7 * n for n, b in enumerate(self._head[1:]))
        self._head.clear()
        taken = length
        if length > LARGEST_PACKET:
            if self._mqtt5 or first >> 4 != _PUBLISH:
                raise self._violated(
                    f"a packet of {length} bytes, more than the {LARGEST_PACKET} that are taken"
                )
            # With MQTT 3.1.1 no broker knows how much is too much: one client's message must not end it all.
            taken = CUT_TO
        self._discarding = length - taken
        self._passing = taken
        self._ready += bytes([first]) + _encoded(taken)
        return True

    def _check_kind(self, first: int) -> None:
        kind, flags = first >> 4, first & 0x0F
        if kind == _PUBLISH:
            # Only QoS 0 and 1 are ever subscribed to; QoS 2 would be kept until the broker releases it.
            if flags & 0x04:
                raise self._violated(f"a message with QoS {flags >> 1 & 3}, which nobody asked for")
            return
        if flags:
            raise self._violated(f"a packet with reserved bits set, 0x{first:02x}")
        if kind == _CONNACK and not self._consented:
            self._consented = True
        elif not self._consented or not (kind in _ANSWERS or (kind == _DISCONNECT and self._mqtt5)):
            raise self._violated(f"a packet that no broker may send now, 0x{first:02x}")

    def _violated(self, what: str) -> ProtocolViolationError:
        self.violation = f"it sent {what}"
        return ProtocolViolationError(self.violation)


class WireContext:
    """Has the MQTT library talk over a `Wire`: to the library it is a TLS context, also without TLS.

    Args:
        tls: what to speak TLS with; None for none.
        mqtt5: whether MQTT 5 is spoken.
    """

    check_hostname = True
    """Asked by the library, which then leaves checking the host name to TLS itself."""

    def __init__(self, tls: ssl.SSLContext | None, *, mqtt5: bool) -> None:
        self._tls = tls
        self._mqtt5 = mqtt5

    def wrap_socket(
        self,
        sock: socket.socket,
        *,
        server_hostname: str | None = None,
        do_handshake_on_connect: bool = False,
    ) -> Wire:
        """The socket, watched."""
        if self._tls is None:
            return Wire(sock, mqtt5=self._mqtt5)
        try:
            inner = self._tls.wrap_socket(
                sock, server_hostname=server_hostname, do_handshake_on_connect=do_handshake_on_connect
            )
        except BaseException:
            sock.close()
            raise
        return Wire(inner, mqtt5=self._mqtt5)


def _encoded(length: int) -> bytes:
    """A remaining length (MQTT 5, section 1.5.5)."""
    encoded = bytearray()
    while True:
        length, digit = length >> 7, length & 0x7F
        encoded.append(digit | (0x80 if length else 0))
        if not length:
            return bytes(encoded)
