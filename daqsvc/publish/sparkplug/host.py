"""The primary host application: whether it listens at this broker."""

from __future__ import annotations

import json
from dataclasses import dataclass

from daqsvc.publish.sparkplug.codec import PayloadError
from daqsvc.publish.sparkplug.node import NAMESPACE


@dataclass(slots=True)
class PrimaryHost:
    """What the STATE messages of one host at one broker say.

    Attributes:
        host_id: id of the host application.
        online: what its newest message says; None before the first.
    """

    host_id: str
    online: bool | None = None
    _newest_ms: int = -1

    @property
    def topic(self) -> str:
        """Where it tells its state."""
        return f"{NAMESPACE}/STATE/{self.host_id}"

    def take(self, payload: bytes) -> bool:
        """Take in a STATE message; False if it is older than one before, and changes nothing.

        Raises:
            PayloadError: it is no STATE message of Sparkplug 3.0.
        """
        try:
            told = json.loads(payload)
            online, sent_ms = told["online"], told["timestamp"]
        except (ValueError, KeyError, TypeError, RecursionError):
            raise PayloadError(f"STATE of {self.host_id}: no JSON with online and timestamp") from None
        if not isinstance(online, bool) or isinstance(sent_ms, bool) or not isinstance(sent_ms, int):
            raise PayloadError(f"STATE of {self.host_id}: online is no boolean, or timestamp no whole number")
        if sent_ms < self._newest_ms:
            return False
        self._newest_ms, self.online = sent_ms, online
        return True
