"""A message as it stands on the disk, and whether it is still what was written."""

from __future__ import annotations

from typing import TypeAlias

from daqsvc.outbox.messages import is_sound

Row: TypeAlias = tuple[int, str, bytes, int, int, int, int]
"""Number, topic, payload, whether it is retained, whether it is sent, ns since the Unix epoch, checksum."""


def sound_row(raw: tuple[object, ...], unsent: set[int]) -> Row | None:
    """What a row says; None if it has changed on the disk.

    Args:
        raw: its columns as they were read, text as bytes.
        unsent: numbers of messages that another source takes for unsent.
    """
    sequence, name, payload, retain, sent, wall_ns, told = raw
    try:
        topic = name.decode() if isinstance(name, bytes) else None
    except UnicodeDecodeError:
        return None
    if not (isinstance(sequence, int) and isinstance(topic, str) and isinstance(payload, bytes)):
        return None
    if not isinstance(told, int) or not is_sound(sequence, topic, payload, told):
        return None
    is_sent = sent == 1 and sequence not in unsent
    written_ns = wall_ns if isinstance(wall_ns, int) else 0
    return sequence, topic, payload, int(retain != 0), int(is_sent), written_ns, told
