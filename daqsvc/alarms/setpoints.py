"""From a measured value to a level: alert and danger limits with deadband and delays."""

from __future__ import annotations

import math
from dataclasses import dataclass

from daqsvc.alarms.states import Level


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Limits of one measure, in the unit of the measure.

    Attributes:
        alert: at or above this the level is alert; None for no such limit.
        danger: at or above this the level is danger; None for no such limit.
        deadband: a limit that has been reached is left only below ``limit - deadband``.
        on_delay_ns: how long the value must stay at or above a limit before the limit counts as reached.
        off_delay_ns: how long it must stay below the deadband before the limit counts as left.

    Raises:
        ValueError: no limit, limits out of order or not finite, a negative deadband or delay.
    """

    alert: float | None = None
    danger: float | None = None
    deadband: float = 0.0
    on_delay_ns: int = 0
    off_delay_ns: int = 0

    def __post_init__(self) -> None:
        limits = [limit for limit in (self.alert, self.danger) if limit is not None]
        if not limits:
            raise ValueError("a setpoint needs an alert or a danger limit; it has neither")
        if not all(math.isfinite(limit) for limit in limits):
            raise ValueError(f"limits must be finite, not alert {self.alert} and danger {self.danger}")
        if self.alert is not None and self.danger is not None and self.alert >= self.danger:
            raise ValueError(f"alert {self.alert} must lie below danger {self.danger}")
        if not (math.isfinite(self.deadband) and self.deadband >= 0):
            raise ValueError(f"deadband is {self.deadband}; it must be zero or more")
        if self.on_delay_ns < 0 or self.off_delay_ns < 0:
            raise ValueError(
                f"delays are {self.on_delay_ns} ns on and {self.off_delay_ns} ns off; they cannot be negative"
            )

    @property
    def lowest(self) -> float:
        """The limit that is reached first."""
        return min(limit for limit in (self.alert, self.danger) if limit is not None)

    def limit(self, level: Level) -> float | None:
        """The limit at which ``level`` begins; None if it has none."""
        return {Level.NORMAL: None, Level.ALERT: self.alert, Level.DANGER: self.danger}[level]


class SetpointMonitor:
    """Holds values against a `Setpoint`, by the time of the data.

    Both delays count only time between two consecutive values that are known: a gap neither confirms
    that a limit is exceeded nor that it is kept, so the count stands still over it.
    """

    def __init__(self, setpoint: Setpoint) -> None:
        self._comparators = [
            (level, _Comparator(limit, setpoint))
            for level in (Level.DANGER, Level.ALERT)
            if (limit := setpoint.limit(level)) is not None
        ]
        self._known_at_ns: int | None = None

    @property
    def level(self) -> Level:
        """The level by all values so far."""
        return next((level for level, comparator in self._comparators if comparator.reached), Level.NORMAL)

    def update(self, value: float, t_ns: int, factor: float = 1.0) -> Level:
        """Take in the value at ``t_ns`` (monotonic time of the data) and return the level.

        ``factor`` multiplies the limits at which a level begins, never those at which it ends: it may keep
        an alarm from being raised, but makes none return.

        NaN and minus infinity hold the level; plus infinity (an overflow) counts as exceeding.
        Time that runs backwards, as it can by a corrected time base, counts as none.
        """
        if math.isnan(value) or value == -math.inf:
            self.hold()
            return self.level
        elapsed_ns = 0 if self._known_at_ns is None else max(t_ns - self._known_at_ns, 0)
        self._known_at_ns = t_ns
        for _, comparator in self._comparators:
            comparator.update(value, elapsed_ns, factor)
        return self.level

    def resume(self, level: Level) -> None:
        """Go on from a level that was reached before a restart; the delays begin anew."""
        for begins, comparator in self._comparators:
            comparator.reached = level >= begins

    def hold(self) -> None:
        """A value is missing: the level stays and the delays stand still until the next one."""
        self._known_at_ns = None


class _Comparator:
    """One limit: whether it has been reached, and for how long the value has said otherwise."""

    def __init__(self, limit: float, setpoint: Setpoint) -> None:
        self.reached = False
        self._enter_at = limit
        self._leave_below = limit - setpoint.deadband
        self._on_delay_ns = setpoint.on_delay_ns
        self._off_delay_ns = setpoint.off_delay_ns
        self._contrary_ns: int | None = None

    def update(self, value: float, elapsed_ns: int, factor: float) -> None:
        contrary = value < self._leave_below if self.reached else value >= factor * self._enter_at
        if not contrary:
            self._contrary_ns = None
            return
        self._contrary_ns = 0 if self._contrary_ns is None else self._contrary_ns + elapsed_ns
        if self._contrary_ns >= (self._off_delay_ns if self.reached else self._on_delay_ns):
            self.reached = not self.reached
            self._contrary_ns = None
