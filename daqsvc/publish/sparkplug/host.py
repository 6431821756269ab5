"""The primary host application: whether it listens at this broker."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass

from daqsvc.errors.code import coded
from daqsvc.errors.outputs import HOST_MISSING
from daqsvc.notice import notice
from daqsvc.publish.sparkplug.codec import PayloadError
from daqsvc.publish.sparkplug.node import NAMESPACE

STATES = (f"{NAMESPACE}/STATE/", "STATE/")
"""What the topics of hosts' states begin with: of Sparkplug 3.0, and of 2.2."""

log = logging.getLogger(__name__)

_WORDS = {b"ONLINE": True, b"OFFLINE": False}


@dataclass(slots=True)
class PrimaryHost:
    """What the STATE messages of one host at one broker state.

    Attributes:
        host_id: id of the host application.
        online: what its newest message states; None before the first.
    """

    host_id: str
    online: bool | None = None
    _newest_ms: int = -1

    @property
    def topics(self) -> tuple[str, ...]:
        """Where it may tell its state, that of Sparkplug 3.0 first."""
        return tuple(f"{begin}{self.host_id}" for begin in STATES)

    def take(self, topic: str, payload: bytes) -> bool:
        """Take in a STATE message; False if it changes nothing.

        One of 3.0 that is older than one before changes nothing, and one of 2.2, which has no time, nothing
        once the host has sent its state as of 3.0.

        Args:
            topic: one of `topics`.
            payload: the bytes.

        Raises:
            PayloadError: it is no STATE message.
        """
        if topic != self.topics[0]:
            return self._take_word(payload)
        try:
            state = json.loads(payload)
            online, sent_ms = state["online"], state["timestamp"]
        except (ValueError, KeyError, TypeError, RecursionError):
            raise PayloadError(f"STATE of {self.host_id}: no JSON with online and timestamp") from None
        if not isinstance(online, bool) or isinstance(sent_ms, bool) or not isinstance(sent_ms, int):
            raise PayloadError(f"STATE of {self.host_id}: online is no boolean, or timestamp no whole number")
        if sent_ms < self._newest_ms:
            return False
        self._newest_ms, self.online = sent_ms, online
        return True

    def _take_word(self, payload: bytes) -> bool:
        """Take in a state as of Sparkplug 2.2: one word."""
        online = _WORDS.get(payload)
        if online is None:
            raise PayloadError(f"STATE of {self.host_id}: neither ONLINE nor OFFLINE")
        if self._newest_ms >= 0:
            return False
        self.online = online
        return True


class HostReports:
    """What the log shows about the primary host over all sessions: that it is missing, or there."""

    def __init__(self) -> None:
        self._reported: set[str] = set()

    def missing(self, sentence: str) -> None:
        """Log that the host is missing, each sentence once until it is there."""
        if sentence not in self._reported:
            self._reported.add(sentence)
            log.warning("%s", sentence, extra=coded(HOST_MISSING))

    def there(self, host_id: str) -> None:
        """Log that the host is there, if it was logged as missing."""
        if self._reported:
            self._reported.clear()
            notice(log, "Sparkplug: primary host %s is online; births, alarms and figures go out", host_id)
