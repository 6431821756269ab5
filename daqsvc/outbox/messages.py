"""What the outbox holds, and what it raises."""

from __future__ import annotations

import secrets
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daqsvc.errors.service import JOURNAL, STORE_IN_USE, UNUSABLE_STORE

if TYPE_CHECKING:
    from collections.abc import Callable


class OutboxError(Exception):
    """The outbox cannot do what it was asked to; the text names the file and the remedy."""

    code = JOURNAL


class NewerOutboxError(OutboxError):
    """A newer version of the program has written the file: starting again does not help."""

    code = UNUSABLE_STORE


class StoreInUseError(OutboxError):
    """Another process uses the store."""

    code = STORE_IN_USE


class StorePathError(OutboxError):
    """The store cannot be a directory, since a file is in its place: starting again does not help."""

    code = UNUSABLE_STORE


class StoreRefusedError(StorePathError):
    """The store is somebody else's, others may write there, or this account may not: as before."""


class OutboxAwayError(OutboxError):
    """The outbox cannot be used for now: its disk is full, takes no writes, or answers with errors."""


@dataclass(frozen=True, slots=True)
class OutboxMessage:
    """A message for the broker.

    Attributes:
        sequence: its number, never used twice.
        topic: MQTT topic.
        payload: the bytes to publish.
        retain: whether the broker keeps it as the latest of its topic.
        stored: whether it is on disk. While the disk takes no writes, messages go out from memory.
    """

    sequence: int
    topic: str
    payload: bytes
    retain: bool
    stored: bool = True


@dataclass(frozen=True, slots=True)
class TelemetryMessage:
    """A message that may be dropped: the oldest first if there is no room, all when they are too old.

    Attributes:
        number: its place in the order; grows while the service runs.
        topic: MQTT topic.
        payload: the bytes to publish.
        expires_ns: when it is of no use any more, on the monotonic clock.
    """

    number: int
    topic: str
    payload: bytes
    expires_ns: int


@dataclass(frozen=True, slots=True)
class Draft:
    """A message on its way to the disk and the broker, whose payload wants to know its number."""

    topic: str
    payload_of_sequence: Callable[[int], bytes]
    retain: bool

    def message(self, sequence: int) -> OutboxMessage:
        """The message under this number.

        Raises:
            TypeError: the payload is not bytes.
            Exception: whatever the payload's own function raises.
        """
        payload = self.payload_of_sequence(sequence)
        if not isinstance(payload, bytes):
            raise TypeError(f"the payload for {self.topic} is of type {type(payload).__name__}; give bytes")
        self.topic.encode()  # or the database refuses it later, for all others of the commit as well
        return OutboxMessage(sequence, self.topic, payload, self.retain, stored=False)


def new_series() -> str:
    """What the ids of one opening of the outbox begin with: 80 random bits.

    So no copy, no older state and no damage of a store can bring an id back, and no two boxes share one.
    """
    return secrets.token_hex(10)


def event_id(series: str, sequence: int) -> str:
    """The id of a message, unique in the world; it stays with the message however often that is sent."""
    return f"{series}-{sequence}"


def is_sound(number: object, topic: object, payload: object, check: object) -> bool:
    """Whether a row is what was written: ``check`` is its checksum, None in files of the first version."""
    if not (isinstance(number, int) and isinstance(topic, str) and isinstance(payload, bytes)):
        return False
    return check is None or check == checksum(number, topic, payload)


def checksum(number: int, topic: str, payload: bytes) -> int:
    """CRC-32 over what must not change on the disk; `PRAGMA quick_check` sees no flipped bit in a payload."""
    return zlib.crc32(payload, zlib.crc32(f"{number} {topic}\n".encode()))
