"""Trip multiply: while a machine starts up, some upper limits are raised by a factor, for a limited time.

A shaft that runs through a critical speed vibrates more than it may at its working speed. The signal that it
does so is a measure of a detector, as a rule the speed by the keyphasor, in a range or on the move.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.states import Level

if TYPE_CHECKING:
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.settings.alarms import StartUp

_RATE_OVER_NS = 1_000_000_000
"""A rate is taken over at least so long: from edge to edge a keyphasor's speed jitters."""


class StartUpSignal:
    """Follows the signal, by the time of the data.

    Args:
        start_up: how a start-up is recognised: by a range or a rate of its signal; None: there is none.
    """

    def __init__(self, start_up: StartUp | None) -> None:
        self._start_up = start_up
        self._since_ns: int | None = None
        self._anchor: tuple[int, float] | None = None
        self._moving = False

    def multiplies(self, t_ns: int) -> bool:
        """Whether limits are multiplied at ``t_ns``, monotonic time."""
        start_up = self._start_up
        return (
            start_up is not None
            and self._since_ns is not None
            and t_ns - self._since_ns <= start_up.at_most_s * NS_PER_S
        )

    def note(self, diagnosis: Diagnosis) -> None:
        """Take in a diagnosis; one of another detector, or without the measure, is left out."""
        start_up = self._start_up
        if start_up is None or diagnosis.detector != start_up.detector or diagnosis.quality == "not_ok":
            return
        value = diagnosis.statistics.get(start_up.measure, math.nan)
        if not math.isfinite(value):
            return
        within = start_up.between is not None and start_up.between[0] <= value <= start_up.between[1]
        if within or self._moves(value, diagnosis.t_ns, start_up.change_per_s):
            if self._since_ns is None:
                self._since_ns = diagnosis.t_ns
        else:
            self._since_ns = None

    def overrun(self, now_ns: int) -> tuple[Level, str]:
        """Whether the start-up has lasted too long by ``now_ns``, as a condition of the service."""
        start_up = self._start_up
        if start_up is None or self._since_ns is None:
            return Level.NORMAL, "the start-up is over"
        if self.multiplies(now_ns):
            return Level.NORMAL, "the machine starts up"
        return Level.ALERT, (
            f"by {start_up.measure} of {start_up.detector} the machine has been starting up for more than "
            f"{start_up.at_most_s:g} s; limits are no longer multiplied"
        )

    def _moves(self, value: float, t_ns: int, change_per_s: float | None) -> bool:
        if change_per_s is None:
            return False
        if self._anchor is None or t_ns < self._anchor[0]:
            self._anchor = (t_ns, value)
        since_ns, before = self._anchor
        if t_ns - since_ns >= _RATE_OVER_NS:
            self._moving = abs(value - before) >= change_per_s * (t_ns - since_ns) / 1e9
            self._anchor = (t_ns, value)
        return self._moving
