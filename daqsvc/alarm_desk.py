"""The alarm desk: diagnoses in; alarms on disk and at the broker out.

Everything that must not be lost passes here and nowhere else: an event leaves the alarm manager, gets its
number and its place on disk from the outbox, and is published from there. The desk knows nothing of buses,
samples or detectors, so it can be tried by itself.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from daqsvc.alarms.manager import AlarmManager
from daqsvc.alarms.states import Level
from daqsvc.outbox.store import Outbox
from daqsvc.publish.mqtt import MqttPublisher
from daqsvc.publish.payloads import alarm_payload
from daqsvc.publish.recall import recall
from daqsvc.publish.topics import Topics

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.events import AlarmEvent, Identity
    from daqsvc.alarms.rules import DiagnosisRule, LevelRule
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.publish.mqtt import MqttSettings

logger = logging.getLogger(__name__)


class AlarmDesk:
    """Alarms of one machine, from diagnosis to broker.

    Use: `open`, `resume`, then `take` as diagnoses come while `run` runs; `settle`, `stop`, `close`.

    Args:
        identity: whose alarms these are.
        rules: one per alarm.
        store: directory of the journal.
        clock: the service's clock.
        mqtt: how to reach the broker; None keeps everything in the journal.
    """

    def __init__(
        self,
        identity: Identity,
        rules: Sequence[LevelRule | DiagnosisRule],
        store: Path,
        clock: Clock,
        mqtt: MqttSettings | None,
    ) -> None:
        self.identity = identity
        self.manager = AlarmManager(identity, rules, clock)
        self.outbox = Outbox(store / "outbox.sqlite", clock)
        self.publisher = (
            None if mqtt is None else MqttPublisher(mqtt, identity.site, identity.box, self.outbox, clock)
        )
        self.topics = Topics("daqsvc" if mqtt is None else mqtt.topic_root, identity.site, identity.box)
        self._under_way: set[asyncio.Future[int]] = set()

    async def open(self) -> None:
        """Open the journal.

        Raises:
            OutboxError: its directory cannot be used.
        """
        await self.outbox.open()

    async def resume(self, speakers: Mapping[str, Sequence[str]]) -> None:
        """Take over from the journal how the alarms stood when the service ended.

        Args:
            speakers: the detectors that will make statements, with the sensors that these rest on.
        """
        told = recall(await self.outbox.latest(), self.topics)
        for event in self.manager.resume(told, speakers):
            self._post(event)

    async def run(self) -> None:
        """Publish until `stop`; returns at once without a broker."""
        if self.publisher is not None:
            await self.publisher.run()

    def take(self, diagnosis: Diagnosis) -> None:
        """Take in a diagnosis; what follows from it is on its way to the disk when this returns."""
        for event in self.manager.take(diagnosis):
            self._post(event)

    async def settle(self, timeout_s: float) -> None:
        """Wait until the events that are under way are on disk, at most so long."""
        if self._under_way:
            await asyncio.wait(set(self._under_way), timeout=timeout_s)

    async def stop(self, deadline_s: float) -> None:
        """Hand over to the broker what is left, and end `run`; see `MqttPublisher.stop`."""
        if self.publisher is not None:
            await self.publisher.stop(deadline_s)

    async def close(self, timeout_s: float) -> None:
        """Close the journal; see `Outbox.close`."""
        await self.outbox.close(timeout_s)

    def _post(self, event: AlarmEvent) -> None:
        loud = logging.WARNING if event.to_level is not Level.NORMAL else logging.INFO
        logger.log(loud, "alarm %s %s: %s", event.alarm, event.kind, event.message)
        committed = self.outbox.submit(
            self.topics.alarm(event.identity.machine, event.alarm),
            lambda sequence: alarm_payload(event, sequence).to_json(),
            retain=True,
        )
        self._under_way.add(committed)
        committed.add_done_callback(self._committed)

    def _committed(self, committed: asyncio.Future[int]) -> None:
        self._under_way.discard(committed)
        if not committed.cancelled() and (error := committed.exception()) is not None:
            logger.error("an alarm event never reached the disk: %s", error)
