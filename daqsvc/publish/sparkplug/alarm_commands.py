"""What hosts may write to alarms: metrics that ask for something when they are set to true.

A written metric becomes a command as over the box's own topics. It is checked in the same way: by what the
machine file allows, by its age, by the audit log, and by the alarm itself.
"""

from __future__ import annotations

import hashlib
import json
import logging
from datetime import UTC, datetime
from typing import TYPE_CHECKING, NamedTuple

from daqsvc.alarms.commands import Verb
from daqsvc.errors.code import coded
from daqsvc.errors.outputs import COMMAND_NOT_OBEYED
from daqsvc.publish.mqtt.commands import CommandIntake
from daqsvc.publish.mqtt.connection import Incoming
from daqsvc.publish.sparkplug.codec import DataType, Metric

if TYPE_CHECKING:
    from collections.abc import Iterable

    from daqsvc.alarms.commands import AlarmCommand, CommandHandler, CommandOutcome
    from daqsvc.publish.mqtt.settings import MqttCommands
    from daqsvc.publish.output import OutputPort

log = logging.getLogger(__name__)

WRITABLE = {Verb.ACKNOWLEDGE: "Acknowledge", Verb.RESET: "Reset"}
"""The verbs that need nothing but the alarm, and their metrics."""

BY = "Sparkplug host"
"""Who asks: Sparkplug does not state which host it was."""

MOST_AT_A_TIME = 64
"""Metrics in one message, and commands that wait, at most."""


class HostCommand(NamedTuple):
    """What a host has written.

    Attributes:
        topic: the Sparkplug topic it came on.
        verb: what is asked.
        alarm: of which alarm.
        sent_ms: when, UTC, ms since 1970; None if the host does not state it.
    """

    topic: str
    verb: Verb
    alarm: str
    sent_ms: int | None


class AlarmCommands:
    """Turns written metrics into commands.

    The metrics are ``Alarms/<machine>/<alarm>/Acknowledge`` of the node, beside its report of the alarm,
    and ``Alarms/<alarm>/Acknowledge`` of the device; the same for ``Reset``.

    Args:
        settings: what the machine file allows.
        machine: whose alarms.
        port: the box, and the ids of the commands that have come.
        handler: carries commands out.
    """

    def __init__(
        self, settings: MqttCommands, machine: str, port: OutputPort, handler: CommandHandler
    ) -> None:
        self._machine = machine
        self._topics = port.topics
        self._handler = handler
        self._parts = {part: verb for verb, part in WRITABLE.items() if verb in settings.allow}
        self._intake = CommandIntake(
            settings, (machine,), port.topics, self._execute, port.clock, port.outbox.command_ids
        )
        self._topic = ""

    def of_node(self, alarm: str) -> list[Metric]:
        """The metrics of ``alarm`` that hosts may write, as the node has them."""
        return self._metrics(f"Alarms/{self._machine}/{alarm}")

    def of_device(self, alarms: Iterable[str]) -> list[Metric]:
        """The metrics of ``alarms`` that hosts may write, as the device has them."""
        return [metric for alarm in alarms for metric in self._metrics(f"Alarms/{alarm}")]

    def meant(self, topic: str, metric: Metric, sent_ms: int | None, *, of_node: bool) -> HostCommand | None:
        """What a written metric asks for; None if hosts may not write it, or not that value."""
        begin = f"Alarms/{self._machine}/" if of_node else "Alarms/"
        name, _, part = (metric.name or "").rpartition("/")
        alarm, verb = name.removeprefix(begin), self._parts.get(part)
        if verb is None or not name.startswith(begin) or metric.value is not True or metric.historical:
            return None
        return HostCommand(
            topic, verb, alarm, metric.timestamp_ms if metric.timestamp_ms is not None else sent_ms
        )

    async def carry_out(self, wish: HostCommand) -> bool:
        """Have a wish carried out, one at a time; whether it was."""
        if wish.sent_ms is None:
            log.warning(
                "%s is refused: it does not state when it was sent",
                wish.topic,
                extra=coded(COMMAND_NOT_OBEYED),
            )
            return False
        try:
            issued_at = datetime.fromtimestamp(wish.sent_ms / 1000.0, UTC).isoformat()
        except (ValueError, OverflowError, OSError):
            log.warning(
                "%s is refused: it was sent at %d ms, which is no time",
                wish.topic,
                wish.sent_ms,
                extra=coded(COMMAND_NOT_OBEYED),
            )
            return False
        written = f"{wish.topic} {wish.verb} {wish.alarm} {wish.sent_ms}".encode(errors="replace")
        asked = {
            "schema": "daqsvc.command/1",
            # The same value of the same instant twice is one wish.
            "id": f"sparkplug-{hashlib.sha256(written).hexdigest()[:32]}",
            "alarm": wish.alarm,
            "by": BY,
            "issued_at": issued_at,
        }
        self._topic = wish.topic
        command = Incoming(self._topics.command(self._machine, wish.verb), json.dumps(asked).encode())
        answer = await self._intake.take(command)
        if answer is None:
            return False
        answered = json.loads(answer.payload)
        if not answered["accepted"]:
            log.info("%s of %s by Sparkplug is refused: %s", wish.verb, wish.alarm[:200], answered["reason"])
        return bool(answered["accepted"])

    async def _execute(self, command: AlarmCommand, source: str) -> CommandOutcome:  # noqa: ARG002  it came another way
        return await self._handler(command, f"sparkplug {self._topic}")

    def _metrics(self, base: str) -> list[Metric]:
        return [Metric(name=f"{base}/{part}", datatype=DataType.BOOLEAN, value=False) for part in self._parts]
