"""From a measured value to a level: alert and danger limits with deadband and delays."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from daqsvc.alarms.states import Level
from daqsvc.dsp.phase import deviation_deg
from daqsvc.rounding import with_unit


class Limit(NamedTuple):
    """One limit.

    Attributes:
        level: the level that begins at it.
        at: where it lies, in the unit of the measure.
        lower: whether the level is reached at and below it, rather than at and above it.
    """

    level: Level
    at: float
    lower: bool


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Limits of one measure, in the unit of the measure.

    No copy of an alarm's table: delays are in ns of the samples' time, and limits are sure to be in order,
    which the table alone is not.

    Attributes:
        alert: at or above this the level is alert; None for no such limit.
        danger: at or above this the level is danger; None for no such limit.
        deadband: a limit that has been reached is left only below ``limit - deadband``, a lower one only
            above ``limit + deadband``.
        on_delay_ns: how long the value must stay at or beyond a limit before the limit counts as reached.
        off_delay_ns: how long it must stay clear of the deadband before the limit counts as left.
        alert_low: at or below this the level is alert; None for no such limit.
        danger_low: at or below this the level is danger; None for no such limit.
        reference_deg: of a phase: the limits are how far it may be from this one, either way.
        zones: where zones B, C and D of ISO 20816-3 begin, for who reads of it; None: no zones.

    Raises:
        ValueError: no limit, limits out of order or not finite, a negative deadband or delay.
    """

    alert: float | None = None
    danger: float | None = None
    deadband: float = 0.0
    on_delay_ns: int = 0
    off_delay_ns: int = 0
    alert_low: float | None = None
    danger_low: float | None = None
    reference_deg: float | None = None
    zones: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        upwards = (
            ("danger_low", self.danger_low),
            ("alert_low", self.alert_low),
            ("alert", self.alert),
            ("danger", self.danger),
        )
        limits = [(name, limit) for name, limit in upwards if limit is not None]
        if not limits:
            raise ValueError("a setpoint needs an alert or a danger limit; it has neither")
        for name, limit in limits:
            if not math.isfinite(limit):
                raise ValueError(f"limits must be finite, not {name} {limit}")
        for (name, limit), (above, higher) in pairwise(limits):
            if limit >= higher:
                raise ValueError(f"{name} {limit} must lie below {above} {higher}")
        if not (math.isfinite(self.deadband) and self.deadband >= 0):
            raise ValueError(f"deadband is {self.deadband}; it must be zero or more")
        if self.on_delay_ns < 0 or self.off_delay_ns < 0:
            raise ValueError(
                f"delays are {self.on_delay_ns} ns on and {self.off_delay_ns} ns off; they cannot be negative"
            )

    @property
    def limits(self) -> tuple[Limit, ...]:
        """All limits, the danger limits first."""
        described = (
            (Level.DANGER, self.danger, False),
            (Level.DANGER, self.danger_low, True),
            (Level.ALERT, self.alert, False),
            (Level.ALERT, self.alert_low, True),
        )
        return tuple(Limit(level, at, lower) for level, at, lower in described if at is not None)

    def judged(self, value: float) -> float:
        """What of a value is compared with the limits: itself, or how far it is from the reference."""
        return value if self.reference_deg is None else deviation_deg(value, self.reference_deg)

    def zone(self, value: float) -> str:
        """The zone of a value, ``"A"`` to ``"D"``; empty without zones."""
        return "" if self.zones is None else "ABCD"[bisect_right(self.zones, value)]

    def in_words(self, unit: str) -> str:
        """All limits for a person, e.g. ``"alert 15 um and danger 25 um"``."""
        upwards = sorted(self.limits, key=lambda limit: limit.at)
        words = [f"{'lower ' * one.lower}{one.level.label} {with_unit(one.at, unit)}" for one in upwards]
        limits = " and ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)
        return (
            limits if self.reference_deg is None else f"{limits} from {self.reference_deg:g} {unit}".rstrip()
        )

    @property
    def lowest(self) -> float | None:
        """The upper limit that is reached first; None if there is none."""
        return min((limit.at for limit in self.limits if not limit.lower), default=None)

    @property
    def highest_low(self) -> float | None:
        """The lower limit that is reached first; None if there is none."""
        return max((limit.at for limit in self.limits if limit.lower), default=None)


class SetpointMonitor:
    """Compares values with a `Setpoint`, by the time of the data.

    Both delays count only time between two consecutive values that are known: a gap neither confirms
    that a limit is exceeded nor that it is kept, so the count stands still over it.
    """

    def __init__(self, setpoint: Setpoint) -> None:
        self._comparators = [_Comparator(limit, setpoint) for limit in setpoint.limits]

    @property
    def level(self) -> Level:
        """The level by all values so far."""
        return max((one.limit.level for one in self._comparators if one.reached), default=Level.NORMAL)

    def reached(self, value: float) -> Limit | None:
        """The limit that makes the present level, of two the one nearer to ``value``; None at normal."""
        makes = [one.limit for one in self._comparators if one.reached and one.limit.level is self.level]
        return min(makes, key=lambda limit: abs(limit.at - value), default=None)

    def update(self, value: float, t_ns: int, factor: float = 1.0) -> Level:
        """Take in the value at ``t_ns`` (monotonic time of the data) and return the level.

        ``factor`` multiplies the upper limits at which a level begins, never those at which it ends: it may
        keep an alarm from being raised, but makes none return.

        NaN and minus infinity hold the level; plus infinity (an overflow) counts as exceeding.
        Time that runs backwards, as it can by a corrected time base, counts as none.
        """
        if math.isnan(value) or value == -math.inf:
            self.hold()
            return self.level
        for comparator in self._comparators:
            comparator.update(value, t_ns, factor)
        return self.level

    def rise(self, low: float, high: float, t_ns: int, factor: float = 1.0) -> Level:
        """Take in a value of which only bounds are known; it may reach limits, and leaves none.

        A limit is reached if the value is beyond it wherever it lies between ``low`` and ``high``. What
        cannot be judged is held, and no delay goes on.
        """
        for comparator in self._comparators:
            comparator.rise(low, high, t_ns, factor)
        return self.level

    def sure(self, low: float, high: float) -> Level:
        """The highest level that has been reached and that a value between these bounds is at for sure."""
        beyond = (one.limit.level for one in self._comparators if one.reached and one.beyond(low, high))
        return max(beyond, default=Level.NORMAL)

    def resume(self, level: Level, *, lower: bool | None = None) -> None:
        """Resume at a level that was reached before a restart; the delays start again.

        Args:
            level: the level.
            lower: whether at a lower limit; None if that is not known: then the value must be clear of both.
        """
        for comparator in self._comparators:
            side = lower is None or comparator.limit.lower is lower
            comparator.reached = side and level >= comparator.limit.level

    def hold(self) -> None:
        """A value is missing: the level stays and the delays stand still until the next one."""
        for comparator in self._comparators:
            comparator.hold()


class _Comparator:
    """One limit: whether it has been reached, and for how long the value has been otherwise."""

    def __init__(self, limit: Limit, setpoint: Setpoint) -> None:
        self.limit = limit
        self.reached = False
        # A lower limit is an upper one with the sign turned.
        self._sign = -1.0 if limit.lower else 1.0
        self._enter_at = self._sign * limit.at
        self._leave_below = self._enter_at - setpoint.deadband
        self._on_delay_ns = setpoint.on_delay_ns
        self._off_delay_ns = setpoint.off_delay_ns
        self._contrary_ns: int | None = None
        self._known_at_ns: int | None = None

    def update(self, value: float, t_ns: int, factor: float) -> None:
        elapsed_ns = 0 if self._known_at_ns is None else max(t_ns - self._known_at_ns, 0)
        self._known_at_ns = t_ns
        value, factor = self._sign * value, 1.0 if self.limit.lower else factor
        contrary = value < self._leave_below if self.reached else value >= factor * self._enter_at
        if not contrary:
            self._contrary_ns = None
            return
        self._contrary_ns = 0 if self._contrary_ns is None else self._contrary_ns + elapsed_ns
        if self._contrary_ns >= (self._off_delay_ns if self.reached else self._on_delay_ns):
            self.reached = not self.reached
            self._contrary_ns = None

    def beyond(self, low: float, high: float, factor: float = 1.0) -> bool:
        """Whether a value is at the limit or beyond wherever it lies between ``low`` and ``high``."""
        return -high >= self._enter_at if self.limit.lower else low >= factor * self._enter_at

    def rise(self, low: float, high: float, t_ns: int, factor: float) -> None:
        if self.beyond(low, high, factor):
            self.update(high if self.limit.lower else low, t_ns, factor)
        else:
            self.hold()

    def hold(self) -> None:
        self._known_at_ns = None
