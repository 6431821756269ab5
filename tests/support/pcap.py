"""TCP conversations out of a capture file, in plain Python: classic pcap, Ethernet, IPv4."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_LITTLE_ENDIAN_US = 0xA1B2C3D4
_ETHERNET = 1
_IPV4, _TCP, _SYN = 0x0800, 6, 0x02


class End(NamedTuple):
    """Address and port of one side."""

    address: bytes
    port: int


class Segment(NamedTuple):
    """Bytes that one side has sent in one go, without those sent before."""

    from_server: bool
    data: bytes


@dataclass(slots=True)
class Conversation:
    """One TCP connection as far as it was captured; the bytes of each side in their order.

    Attributes:
        segments: what both have sent, in the order of capture.
        holes: how often bytes of one side are missing from the capture.
    """

    segments: list[Segment] = field(default_factory=list)
    holes: int = 0
    _next: dict[bool, int] = field(default_factory=dict)

    def add(self, sequence: int, data: bytes, *, from_server: bool) -> None:
        """Take a segment; what it repeats is left out."""
        wanted = self._next.get(from_server, sequence)
        repeated = (wanted - sequence + 2**31) % 2**32 - 2**31
        if repeated >= len(data):
            return
        if repeated < 0:
            self.holes += 1
        data = data[max(repeated, 0) :]
        self._next[from_server] = (wanted + max(-repeated, 0) + len(data)) % 2**32
        self.segments.append(Segment(from_server, data))


def conversations(path: Path, server_port: int) -> list[Conversation]:
    """All conversations with a server's port, by the time of their first segment."""
    found: list[Conversation] = []
    under_way: dict[tuple[End, End], Conversation] = {}
    for source, target, sequence, flags, data in _segments(path):
        from_server = source.port == server_port
        if not from_server and target.port != server_port:
            continue
        ends = (target, source) if from_server else (source, target)
        if ends not in under_way or (flags & _SYN and under_way[ends].segments):
            under_way[ends] = Conversation()
            found.append(under_way[ends])
        if data:
            under_way[ends].add(sequence, data, from_server=from_server)
    return [conversation for conversation in found if conversation.segments]


def _segments(path: Path) -> Iterator[tuple[End, End, int, int, bytes]]:
    """Source, target, sequence number, flags and bytes of every TCP segment of a capture."""
    raw = path.read_bytes()
    magic, *_, link = struct.unpack_from("<IHHiIII", raw)
    assert (magic, link) == (_LITTLE_ENDIAN_US, _ETHERNET), f"{path} is no capture of the kind read here"
    at = 24
    while at < len(raw):
        _, _, kept, _ = struct.unpack_from("<IIII", raw, at)
        packet, at = raw[at + 16 : at + 16 + kept], at + 16 + kept
        if struct.unpack_from(">H", packet, 12)[0] != _IPV4:
            continue
        ip = packet[14:]
        ip = ip[: struct.unpack_from(">H", ip, 2)[0]]  # a short Ethernet frame is padded
        if ip[9] != _TCP:
            continue
        tcp = ip[4 * (ip[0] & 0x0F) :]
        source, target, sequence = struct.unpack_from(">HHI", tcp)
        yield End(ip[12:16], source), End(ip[16:20], target), sequence, tcp[13], tcp[4 * (tcp[12] >> 4) :]
