"""What Home Assistant got and stays retained at the broker, remembered over restarts.

A machine that is taken out of the machine file, renamed or sent under another prefix would stay there as it
was last seen, healthy for ever.
"""

from __future__ import annotations

import asyncio
import json
import logging
from typing import TYPE_CHECKING, Final

from daqsvc.errors.code import coded
from daqsvc.errors.outputs import OUTPUT_STATE, TOPIC_REFUSED
from daqsvc.outbox.files import replace_durably
from daqsvc.publish.mqtt.errors import PublishRefusedError
from daqsvc.publish.mqtt.link import MqttLink

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from daqsvc.publish.mqtt.connection import Connection

log = logging.getLogger(__name__)

FILE: Final = "home-assistant.json"
AGAIN_S = 60.0
"""How long a disk that took nothing is left alone."""
_MOST_BYTES = 65_536


class LeftOver(MqttLink):
    """Removes what an earlier start has sent to Home Assistant and this one does not.

    Args:
        directory: where the topics are remembered that hold a retained message of this box.
        now: those that are sent from now on.
    """

    name = "Home Assistant"

    def __init__(self, directory: Path, now: Iterable[str] = ()) -> None:
        self.now = frozenset(now)
        self._path = directory / FILE
        self._refused: list[str] = []
        self._is_remembered = False
        self._is_unwritable = False

    async def run(self, connection: Connection) -> None:
        """Remove it, and remember what is sent from now on.

        Raises:
            MqttError: the connection is lost.
        """
        await self.take_away(connection)
        await self.until_remembered()

    async def take_away(self, connection: Connection) -> None:
        """Remove what is not sent any more, and try to remember what is sent from now on.

        Raises:
            MqttError: the connection is lost.
        """
        self._refused = []
        for topic in await asyncio.to_thread(self.left_over):
            try:
                await connection.deliver(topic, b"", retain=True)
                log.info("removed from Home Assistant, as the machine file no longer has it: %s", topic)
            except PublishRefusedError as error:
                self._refused.append(topic)
                log.warning(
                    "Home Assistant keeps showing what the machine file no longer has: %s; remove "
                    "the retained message from %s at the broker, or allow this client to",
                    error,
                    topic,
                    extra=coded(TOPIC_REFUSED),
                )
        self._is_remembered = await asyncio.to_thread(self.remember, self._refused)

    async def until_remembered(self) -> None:
        """Try again, as long as the disk does not take what is to be remembered."""
        while not self._is_remembered:
            await asyncio.sleep(AGAIN_S)
            self._is_remembered = await asyncio.to_thread(self.remember, self._refused)

    def left_over(self) -> list[str]:
        """Those that an earlier start has sent and this one does not; blocks."""
        return sorted(self._read() - self.now)

    def remember(self, left_over: Iterable[str] = ()) -> bool:
        """Store what is sent from now on, and what could not be removed; blocks.

        Returns:
            Whether it is written; that it is not is logged once.
        """
        topics = self.now | set(left_over)
        if topics == self._read():
            return True
        try:
            replace_durably(self._path, json.dumps({"topics": sorted(topics)}).encode())
        except OSError as error:
            if not self._is_unwritable:
                log.warning(
                    "%s cannot be written: %s; what Home Assistant gets now may stay there when the "
                    "machine file no longer has it",
                    self._path,
                    error,
                    extra=coded(OUTPUT_STATE),
                )
            self._is_unwritable = True
            return False
        if self._is_unwritable:
            log.info("%s is written again", self._path)
        self._is_unwritable = False
        return True

    def _read(self) -> frozenset[str]:
        try:
            with self._path.open("rb") as file:
                note = json.loads(file.read(_MOST_BYTES))
            return frozenset(topic for topic in note["topics"] if isinstance(topic, str) and topic)
        except FileNotFoundError:
            return frozenset()
        except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
            log.warning("%s is of no use: %s", self._path, error, extra=coded(OUTPUT_STATE))
            return frozenset()
