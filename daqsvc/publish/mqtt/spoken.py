"""Which MQTT version a broker speaks: found out once, remembered over restarts.

A broker that does not know MQTT 5 states it, closes the connection or, misled by the longer packet, waits for
more of it, in which case only time tells.
"""

from __future__ import annotations

import contextlib
import json
import logging
from typing import TYPE_CHECKING, Final

from daqsvc.outbox.files import replace_durably
from daqsvc.publish.mqtt.connection import CONSENT_S
from daqsvc.publish.mqtt.errors import NoConsentError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

log = logging.getLogger(__name__)

FILE: Final = "mqtt-version.json"

REMEMBERED_NS: Final = 86_400 * 10**9
"""After so long MQTT 5 is tried again: the broker may be a newer one by now."""

HASTE_S: Final = 2.0
ROUND_TRIPS: Final = 20
"""An MQTT 5 broker answers to a CONNECT at once: it is given so long, or so many times what reaching it
took."""

_UNSUPPORTED = 132
_MOST_BYTES = 4096


class Spoken:
    """The version to speak next.

    Args:
        directory: where it is remembered.
        host: of the broker.
        port: of the broker.
        wanted: ``"auto"`` to find out.
        wall_ns: wall clock, ns since the Unix epoch.
    """

    def __init__(
        self, directory: Path, host: str, port: int, wanted: str, wall_ns: Callable[[], int]
    ) -> None:
        self.mqtt5 = wanted != "3.1.1"
        self._automatic = wanted == "auto"
        self._path = directory / FILE
        self._broker = f"{host}:{port}"
        self._wall_ns = wall_ns
        self._known = not self._automatic
        self._read = False

    def recall(self) -> None:
        """Read what an earlier run has found out, once; blocks."""
        if self._read or not self._automatic:
            return
        self._read = True
        try:
            with self._path.open("rb") as file:
                note = json.loads(file.read(_MOST_BYTES))
            age_ns = self._wall_ns() - int(note["wall_ns"])
            if note["broker"] == self._broker and note["version"] == "3.1.1" and 0 <= age_ns < REMEMBERED_NS:
                self.mqtt5, self._known = False, True
        except FileNotFoundError:
            return
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            log.info("%s is of no use: %s", self._path, error)

    def consent_s(self, reached_s: float) -> float:
        """How long to wait for the broker's consent.

        Args:
            reached_s: how long it took to reach it.
        """
        if self._known or not self.mqtt5:
            return CONSENT_S
        return min(max(HASTE_S, ROUND_TRIPS * reached_s), CONSENT_S)

    def agreed(self) -> None:
        """The broker has taken a connection in the present version; blocks."""
        if self._known:
            return
        self._known = True
        if self.mqtt5:
            with contextlib.suppress(OSError):  # it would only cost time at the next start
                self._path.unlink(missing_ok=True)
            return
        note = {"broker": self._broker, "version": "3.1.1", "wall_ns": self._wall_ns()}
        try:
            replace_durably(self._path, json.dumps(note).encode())
        except OSError as error:
            log.info(
                "%s cannot be written: %s; the version is found out again after a restart", self._path, error
            )

    def falls_back(self, error: Exception) -> bool:
        """Choose the other version if the failure may come of this one; whether that is 3.1.1."""
        code = getattr(getattr(error, "rc", None), "value", None)
        if not self._automatic or not (isinstance(error, NoConsentError) or code == _UNSUPPORTED):
            return False
        self._known = not self.mqtt5  # in haste once only: a slow broker of MQTT 5 gets its time
        self.mqtt5 = not self.mqtt5
        return not self.mqtt5
