"""From the journal back to events: how the alarms stood when the service ended."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from daqsvc.publish.payloads import alarm_event

if TYPE_CHECKING:
    from collections.abc import Iterable

    from daqsvc.alarms.events import AlarmEvent
    from daqsvc.outbox.store import OutboxMessage
    from daqsvc.publish.topics import Topics

log = logging.getLogger(__name__)


def restore_alarms(messages: Iterable[OutboxMessage], topics: Topics) -> list[AlarmEvent]:
    """The events that the alarm messages of a box tell of, in their order.

    Messages below other topics are left alone. What cannot be read is left out and logged, once for all.

    Args:
        messages: from `Outbox.latest`.
        topics: the box.
    """
    events: list[AlarmEvent] = []
    unread: list[str] = []
    for message in messages:
        if not (message.topic.startswith(f"{topics.base}/") and "/alarms/" in message.topic):
            continue
        try:
            events.append(_event(message, topics))
        except ValueError as error:
            unread.append(f"{message.sequence} of {message.topic} ({_in_short(error)})")
    if unread:
        log.warning(
            "%d alarm states of the journal cannot be read; these alarms start from normal: %s",
            len(unread),
            "; ".join(unread),
        )
    return events


def _event(message: OutboxMessage, topics: Topics) -> AlarmEvent:
    event = alarm_event(message.payload)
    if message.topic != topics.alarm(event.identity.machine, event.alarm):
        raise ValueError(f"it is about {event.alarm!r} of {event.identity.machine!r}")
    return event


def _in_short(error: ValueError) -> str:
    """The first of the problems that are found in a payload, in one line."""
    return " ".join(line.strip() for line in str(error).splitlines()[:3])
