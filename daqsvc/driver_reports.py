"""What a driver reports about itself, if it keeps to its contract: no driver spoils the reports of others."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from daqsvc.acquisition.assembler import StreamCounters
from daqsvc.acquisition.link import Link
from daqsvc.acquisition.timebase import TimeBaseState
from daqsvc.settings.answers import short
from daqsvc.settings.failures import authors_of, error_text
from drivers.base import BusCounters

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from daqsvc.supervision import Supervisor
    from drivers.base import Driver

T = TypeVar("T")


class _Odd(NamedTuple):
    """Something that is not what it should be: its name, its value, and what it should be."""

    name: str
    value: object
    wanted: str


class DriverReports:
    """Counters, streams and link of a driver; what breaks its contract is left out, and logged once.

    Args:
        name: of its bus in the machine file.
        driver: the driver.
        streams: names of its streams in the machine file.
        supervisor: states what is not as it should be.
    """

    def __init__(self, name: str, driver: Driver, streams: Collection[str], supervisor: Supervisor) -> None:
        self.name = name
        self._driver = driver
        self.names = streams
        self._supervisor = supervisor

    @property
    def counters(self) -> BusCounters:
        """See `drivers.base.Driver.counters`."""
        return self._checked("counters", _odd_counters, BusCounters(), "the counts of its bus are missing")

    @property
    def streams(self) -> Mapping[str, tuple[StreamCounters, TimeBaseState]]:
        """See `drivers.base.Driver.streams`."""
        return self._checked("streams", self._odd_streams, {}, "the figures of its streams are missing")

    @property
    def link(self) -> Link:
        """See `drivers.base.Driver`."""
        return self._checked("link", _odd_link, Link(self.name), "its bus counts as down")

    @property
    def has_heard(self) -> bool:
        """Whether anything has come from the bus, if only an error."""
        counters = self.counters
        others = counters.frames_unknown + counters.frames_remote + counters.frames_error
        return others > 0 or any(stream.frames_received for stream, _ in self.streams.values())

    def _checked(self, what: str, odd: Callable[[T], _Odd | None], instead: T, then: str) -> T:
        kind = type(self._driver)
        owner = f"{kind.__module__}.{kind.__qualname__}"
        try:
            value: T = getattr(self._driver, what)
            fault = odd(value)
        except Exception as error:  # noqa: BLE001  logged and counted below
            problem = f"{what} of {owner} has failed: {error_text(error)}"
        else:
            if fault is None:
                return value
            problem = f"{fault.name} of {owner} is {short(fault.value)}, not {fault.wanted}"
        self._supervisor.failed(f"driver {self.name}", f"{problem}; {authors_of(kind.__module__)}", then)
        return instead

    def _odd_streams(self, streams: object) -> _Odd | None:
        if not isinstance(streams, Mapping):
            return _Odd("streams", streams, "counters and clock by stream")
        for name, report in dict(streams).items():
            if name not in self.names:
                return _Odd("streams", name, f"one of {', '.join(self.names)}")
            if (odd := _odd_stream(f"stream {name}", report)) is not None:
                return odd
        return None


_PAIR = 2
_STREAM_COUNTS = [field.name for field in fields(StreamCounters)]
_COUNTS = ["overruns", "frames_unrecorded", *(f.name for f in fields(BusCounters) if f.default == 0)]
"""What every driver counts, each a whole number."""


def _odd_counters(counters: object) -> _Odd | None:
    if not isinstance(counters, BusCounters) and not is_dataclass(counters):
        return _Odd("counters", counters, "a count")
    for name in _COUNTS:
        if not isinstance(value := getattr(counters, name), Integral):
            return _Odd(name, value, "a count")
    state = getattr(counters, "controller_state")  # noqa: B009 - of whichever class it is
    if state is not None and not isinstance(state, str):
        return _Odd("controller_state", state, "a text")
    for field in fields(counters):
        value = getattr(counters, field.name)
        figures = value.items() if isinstance(value, Mapping) else [(field.name, value)]
        if not all(isinstance(key, str) and isinstance(one, Real | str | None) for key, one in figures):
            return _Odd(field.name, value, "counts by name" if field.name == "unknown_ids" else "a figure")
        if field.name == "unknown_ids" and not all(isinstance(count, Integral) for _, count in figures):
            return _Odd(field.name, value, "counts by name")
    return None


def _odd_stream(name: str, report: Any) -> _Odd | None:
    counters, base = report if isinstance(report, tuple) and len(report) == _PAIR else (report, None)
    if not isinstance(counters, StreamCounters) or not isinstance(base, TimeBaseState):
        return _Odd(name, report, "StreamCounters and TimeBaseState")
    for count in _STREAM_COUNTS:
        if not isinstance(value := getattr(counters, count), Integral):
            return _Odd(f"{count} of {name}", value, "a count")
    for figure in ("period_ns", "drift_ppm", "jitter_ns", "restarts"):
        value = getattr(base, figure)
        if not isinstance(value, Real) or not math.isfinite(value):
            return _Odd(f"{figure} of {name}", value, "a finite number")
    if not base.period_ns > 0:
        return _Odd(f"period_ns of {name}", base.period_ns, "above 0")
    return None if isinstance(base.doubt, str) else _Odd(f"doubt of {name}", base.doubt, "a text")


def _odd_link(link: object) -> _Odd | None:
    if not isinstance(link, Link):
        return _Odd("link", link, "Link")
    if link.state not in {"up", "down"}:
        return _Odd("state of the link", link.state, "'up' or 'down'")
    for name, kind, wanted in (
        ("losses", Integral, "a count"),
        ("turns", Integral, "a count"),
        ("reason", str, "a text"),
        ("over", str, "a text"),
    ):
        if not isinstance(value := getattr(link, name), kind):
            return _Odd(f"{name} of the link", value, wanted)
    faults = link.faults
    if not isinstance(faults, Mapping) or not all(isinstance(text, str) for text in faults.values()):
        return _Odd("faults of the link", faults, "a text by stream")
    return None
