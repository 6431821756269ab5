"""Of which topics the journal ever had a retained message, apart from the journal itself.

After damage this tells the alarms that the broker may show in a state that is no longer known from those
that were never raised.

Each line of the file holds topics that came together, with a checksum. New ones get a line of their own: in a
flood of alarms each commit brings some, and must not write down again all those before.
"""

from __future__ import annotations

import json
import logging
import zlib
from typing import TYPE_CHECKING

from daqsvc.outbox.files import append_durably, read_whole, replace_durably, restrict

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

log = logging.getLogger(__name__)

MOST_BYTES = 16 * 1024 * 1024
"""Of a longer file nothing is believed; a machine has some hundred alarms."""


class KnownTopics:
    """The topics, and the file that keeps them.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._topics: frozenset[str] | None = None
        self._is_sound = False
        """Whether the file lists all of them, so that a line can be added to it."""

    @property
    def topics(self) -> frozenset[str] | None:
        """The topics; None if they are not known."""
        return self._topics

    def open(self, latest: Iterable[str], *, is_whole: bool) -> None:
        """Read the file.

        Args:
            latest: what the journal knows.
            is_whole: whether these are all: then the file can be made again, if it is damaged or missing.
        """
        restrict(self._path)
        topics = self._read()
        self._is_sound = topics is not None
        self._topics = frozenset() if topics is None and is_whole else topics
        self.add(latest)

    def add(self, topics: Iterable[str]) -> None:
        """There will be messages of these; durable when this returns, unless the disk takes no writes."""
        if self._topics is None:
            return
        new = frozenset(topics) - self._topics
        if not new:
            return
        self._topics |= new
        try:
            if self._is_sound:
                # Not sound until it has succeeded: a disk that is full may have taken half of the line.
                self._is_sound = False
                append_durably(self._path, _line(new))
            else:
                replace_durably(self._path, _line(self._topics))
            self._is_sound = True
        except OSError as error:
            log.info("topics %s cannot be written: %s", self._path, error)

    def _read(self) -> frozenset[str] | None:
        try:
            return _understood(read_whole(self._path, MOST_BYTES + 1))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            log.info("topics %s cannot be read: %s", self._path, error)
        return None


def _line(topics: Iterable[str]) -> bytes:
    content = json.dumps(sorted(topics)).encode()
    return b"%08x %b\n" % (zlib.crc32(content), content)


def _understood(content: bytes) -> frozenset[str]:
    """The topics in a file.

    Raises:
        ValueError: it is damaged, was cut off, or is too long.
    """
    if not 0 < len(content) <= MOST_BYTES:
        raise ValueError(f"it is empty or has more than {MOST_BYTES} bytes")
    topics: set[str] = set()
    for line in content.splitlines(keepends=True):
        check, _, listed = line.partition(b" ")
        if not listed.endswith(b"\n") or check != b"%08x" % zlib.crc32(listed[:-1]):
            raise ValueError("a line of it is damaged or was cut off")
        topics.update(json.loads(listed))
    return frozenset(topics)
