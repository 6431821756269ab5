"""Alarm events in the log of the service: each, until they come faster than anybody reads.

A line for each event of a flood would fill the log of the system, and a log that is written to slowly would
hold up the event loop. All events are in the journal, whatever the log states.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.codes import EASES, code_of_alarm
from daqsvc.alarms.states import Level
from daqsvc.errors.alarms import ALARM_STANDS
from daqsvc.errors.code import coded
from daqsvc.errors.service import TOO_SLOW
from daqsvc.notice import NOTICE

if TYPE_CHECKING:
    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.events import AlarmEvent

logger = logging.getLogger(__name__)

LINES = 100
LINE_EVERY_NS = NS_PER_S // 5
"""Events that are logged one by one; one more is allowed each time this period passes."""


class AlarmLog:
    """Logs alarm events.

    Args:
        clock: for how fast they come.
        of_several: whether there are several machines, and each line has to name its machine.
    """

    def __init__(self, clock: Clock, *, of_several: bool = False) -> None:
        self._clock = clock
        self._of_several = of_several
        self._left = LINES
        self._earned_ns = clock.monotonic_ns()
        self._left_out = 0

    def say(self, event: AlarmEvent) -> None:
        """Log an event, or count it."""
        if not self._may_say():
            self._left_out += 1
            return
        self._left -= 1
        name = f"{event.alarm} of {event.identity.machine}" if self._of_several else event.alarm
        code = None if event.to_level is Level.NORMAL else code_of_alarm(event.alarm, event.cause.quality)
        level = _level(event)
        if level == logging.WARNING:
            code = code or ALARM_STANDS
        logger.log(level, "alarm %s %s: %s", name, event.kind, event.message, extra=coded(code))

    def sum_up(self) -> None:
        """Say how many events were only counted since the last time; about once a second."""
        if self._left_out:
            logger.warning(
                "%d alarm events came too fast for this log; daqsvc alarms --history shows them all",
                self._left_out,
                extra=coded(TOO_SLOW),
            )
            self._left_out = 0

    def _may_say(self) -> bool:
        now_ns = self._clock.monotonic_ns()
        earned, rest_ns = divmod(now_ns - self._earned_ns, LINE_EVERY_NS)
        self._left = min(self._left + earned, LINES)
        self._earned_ns = now_ns - rest_ns
        return self._left > 0


def _level(event: AlarmEvent) -> int:
    """Of its line: who has read that an alarm stands also reads, by default, that it is over."""
    if event.from_level is event.to_level is Level.NORMAL:
        return logging.INFO
    return NOTICE if event.to_level is Level.NORMAL or event.kind in EASES else logging.WARNING
