"""Of which topics the journal ever had a retained message, apart from the journal itself.

After damage this tells the alarms that the broker may show in a state that nobody knows any more from those
that were never raised.
"""

from __future__ import annotations

import json
import logging
import zlib
from typing import TYPE_CHECKING

from daqsvc.outbox.files import read_whole, replace_durably, restrict

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

    @property
    def topics(self) -> frozenset[str] | None:
        """The topics; None if nobody knows them."""
        return self._topics

    def open(self, latest: Iterable[str], *, is_whole: bool) -> None:
        """Read the file.

        Args:
            latest: what the journal knows.
            is_whole: whether these are all: then the file can be made anew, if it is damaged or missing.
        """
        restrict(self._path)
        told = self._read()
        self._topics = frozenset() if told is None and is_whole else told
        self.add(latest)

    def add(self, topics: Iterable[str]) -> None:
        """There will be messages of these; durable when this returns, unless the disk takes no writes."""
        if self._topics is None or self._topics.issuperset(topics := list(topics)):
            return
        self._topics = self._topics.union(topics)
        content = json.dumps(sorted(self._topics)).encode()
        try:
            replace_durably(self._path, b"%08x %b\n" % (zlib.crc32(content), content))
        except OSError as error:
            log.info("topics %s cannot be written: %s", self._path, error)

    def _read(self) -> frozenset[str] | None:
        try:
            told, _, content = read_whole(self._path, MOST_BYTES).rstrip(b"\n").partition(b" ")
            if int(told, 16) == zlib.crc32(content):
                return frozenset(json.loads(content))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            log.info("topics %s cannot be read: %s", self._path, error)
        return None
