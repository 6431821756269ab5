"""Packets that a broker might send, and messages that a client might, right and wrong in every field.

Seeded: the same numbers make the same packets.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import random

BASE = "daqsvc/lab/edge-1"
COMMANDS = f"{BASE}/rig/commands"

TOPICS = (
    "/",
    "$SYS/broker/uptime",
    "notice",
    "company/notice",
    "company/site/notice",
    BASE,
    f"{BASE}/",
    f"{BASE}/rig",
    f"{BASE}/rig/commands",
    f"{COMMANDS}/",
    f"{COMMANDS}/acknowledge",
    f"{COMMANDS}/acknowledge",
    f"{COMMANDS}/shelve",
    f"{COMMANDS}/acknowledge/response",
    f"{COMMANDS}/acknowledge/below",
    f"{COMMANDS}/reboot",
    f"{BASE}/{'x' * 300}/commands/acknowledge",
    f"{BASE}/pump/commands/acknowledge",
    f"{BASE}/rig/alarms/rotor-fault",
    f"{BASE}/availability",
    "daqsvc/lab/edge-2/rig/commands/acknowledge",
    "homeassistant/status",
    "homeassistant/device/daqsvc_2flab_2fedge-1_2frig/config",
    "spBv1.0/lab/NCMD/edge-1",
    "\u202e/µm",
)

ODD_TOPICS = (
    "",
    "#",
    "+",
    f"{COMMANDS}/+",
    f"{BASE}/+/commands/acknowledge",
    f"{COMMANDS}/{'x' * 65_000}",
    "\u0000",
    "a\u0000b",
    "\ufeff",
    "\ud800",
)
"""Topics that no message may have."""

COMMAND = {
    "schema": "daqsvc.command/1",
    "id": "c1",
    "alarm": "rotor-fault",
    "by": "Ada",
    "issued_at": "2020-01-01T00:00:00Z",
}
"""A command in every respect, but far too old."""

VALUES: tuple[Any, ...] = (
    None,
    True,
    -1,
    1e308,
    2**70,
    "",
    "x" * 5000,
    "\ud800",
    "a\nb",
    "\u202e",
    "9999-12-31T23:59:59Z",
    "0001-01-01T00:00:00Z",
    "2020-01-01T00:00:00+23:59",
    [],
    {},
    [[[[]]]],
    float("nan"),
    float("inf"),
)

DISCOVERIES = (
    {"components": {"\ud800": {"platform": "sensor"}}},
    {"components": {"x": {"platform": "\ud800"}}},
    {"components": {f"n{n}": {"platform": "sensor"} for n in range(5000)}},
    {"components": {"x" * 70_000: {"platform": "sensor"}}},
    {"components": {"": {"platform": ""}, "+/#": {"platform": "a/b"}}},
    {"components": [1]},
    {"components": {"x": 1}},
    [1],
    "\ud800",
)


def payload(dice: random.Random) -> bytes:
    """What a message might contain."""
    made = dice.choice(
        (
            dice.randbytes(dice.choice((0, 1, 7, 100, 5000))),
            dice.choice((b"[", b'{"a":')) * dice.choice((10, 1000, 20_000)),
            json.dumps(dice.choice(DISCOVERIES)).encode(),
            b"online",
            *(b"",) * 5,
        )
    )
    return made or _command(dice)


def _command(dice: random.Random) -> bytes:
    """What is nearly a command."""
    kind = dice.randrange(4)
    told: dict[str, Any] = dict(COMMAND)
    for _ in range(dice.randrange(3)):
        key = dice.choice((*COMMAND, "reason", "occurrence", "duration_s", "expires_s", "\ud800", "x"))
        told[key] = dice.choice(VALUES)
    if dice.random() < 0.1:
        told.pop(dice.choice(list(told)))
    payload = json.dumps(told).encode()
    if kind == 0:
        at = dice.randrange(len(payload))
        return payload[:at] + dice.randbytes(dice.randrange(4)) + payload[at + dice.randrange(4) :]
    if kind == 1:
        return payload + b"x" * dice.choice((1, 4096, 300_000))
    return payload


def varint(number: int, least: int = 1) -> bytes:
    """A variable byte integer of at least so many bytes, of more than are allowed too."""
    digits = bytearray()
    while True:
        number, digit = number >> 7, number & 0x7F
        more = number or len(digits) + 1 < least
        digits.append(digit | (0x80 if more else 0))
        if not more:
            return bytes(digits)


@dataclass
class Grammar:
    """What a broker sends.

    Attributes:
        dice: what makes each packet this one.
        mqtt5: the version.
        wrong: how likely each part of a packet is to be wrong; with 0 all packets are what a broker may send.
    """

    dice: random.Random
    mqtt5: bool
    wrong: float

    def packet(self, under_way: int) -> bytes:
        """One packet; ``under_way`` is a packet id that the box may wait for."""
        dice = self.dice
        if self._errs():
            return dice.randbytes(dice.choice((1, 2, 5, 40)))
        kind = dice.choice((3, 3, 3, 3, 3, 3, 4, 9, 11, 13))
        if self._errs():
            kind = dice.randrange(16)
        flags = dice.choice((0, 1, 2, 3, 11)) if kind == 3 else 0
        if self._errs():
            flags = dice.randrange(16)
        body = self._body(kind, flags, under_way)
        if self._errs():
            body = body[: dice.randrange(len(body) + 1)]
        length, least = len(body), 1
        if self._errs():
            length = dice.choice((0, 1, len(body) + 7, 2_000_000, 268_435_455))
        if self._errs():
            least = dice.choice((2, 4, 5))
        return bytes([kind << 4 | flags]) + varint(length, least) + body

    def _errs(self) -> bool:
        return self.dice.random() < self.wrong

    def _body(self, kind: int, flags: int, under_way: int) -> bytes:
        dice = self.dice
        mid = dice.choice((1, under_way, dice.randrange(1, 65_536), 65_535))
        number = (0 if self._errs() else mid).to_bytes(2, "big")
        properties = self._properties(kind) if self.mqtt5 else b""
        code = bytes([dice.choice((0, 1, 0x80, 0x87, 0x97))])
        if self._errs():
            code = dice.choice((b"\x8e", b"\xff", b"", bytes([dice.randrange(256)])))
        if kind == 3:
            topic = dice.choice(ODD_TOPICS if self._errs() else TOPICS)
            return self._text(topic) + (number if flags & 6 else b"") + properties + payload(dice)
        bodies = {
            2: bytes([dice.choice((0, 1, 255))]) + code + properties,
            4: number + (dice.choice((b"", code, code + properties)) if self.mqtt5 else b""),
            9: number + properties + code,
            11: number + (properties + code if self.mqtt5 else b""),
            13: b"",
            14: dice.choice((b"", code, code + properties)),
        }
        return bodies.get(kind, dice.randbytes(dice.randrange(30)))

    def _text(self, said: str) -> bytes:
        raw = (
            self.dice.randbytes(self.dice.randrange(20))
            if self._errs()
            else said.encode("utf-8", "surrogatepass")
        )
        length = self.dice.choice((0, 1, len(raw) + 1, 65_535)) if self._errs() else len(raw)
        return length.to_bytes(2, "big") + raw

    def _properties(self, kind: int) -> bytes:
        """Properties of MQTT 5, with their length."""
        dice = self.dice
        content = b""
        if kind == 3 and dice.random() < 0.3:
            content += b"\x08" + self._text(dice.choice(("operators/ada", *TOPICS[7:])))
        if kind == 3 and dice.random() < 0.3:
            content += b"\x09" + self._text("x" * dice.choice((1, 300, 60_000)))
        if dice.random() < 0.2:
            content += b"\x26" + self._text("name") + self._text("value")
        if self._errs():
            content += varint(dice.choice((1, 2, 11, 17, 22, 33, 34, 35, 39, 42, 99)), dice.choice((1, 2, 5)))
            content += dice.randbytes(dice.choice((0, 1, 2, 4, 4, 5)))
        length = dice.choice((0, len(content) + 1, 127, 268_435_455)) if self._errs() else len(content)
        return varint(length, dice.choice((2, 4, 5)) if self._errs() else 1) + content
