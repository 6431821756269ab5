"""What the service reports about itself: a full disk, dropped telemetry, buses that fail it.

Each is a condition of the alarm manager: active while it stands, returned when it is over, like any alarm.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal, NamedTuple

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.conditions import Condition
from daqsvc.alarms.states import Level
from daqsvc.outbox.files import remedy

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping
    from pathlib import Path

MIB = 1024 * 1024

JOURNAL = "store/journal"
STORE = ("store/disk", JOURNAL, "store/damage", "store/telemetry", "store/audit-log")
"""The conditions of the store."""

BUS_OVERRUN = "bus-overrun/"
BUS_CONTROLLER = "bus-controller/"
BUS_RECORDING = "bus-recording/"
"""How the names of the conditions of a bus begin."""

QUIET_NS = 60 * NS_PER_S
"""What happens now and then stands until it has not happened for so long."""


class BusHealth(NamedTuple):
    """The state of a bus, and its failures so far.

    Attributes:
        overruns: what was lost because a buffer between the bus and this process was full.
        bus_off: how often its controller took itself off the bus.
        state: state of the controller; None for a bus that has none.
        unrecorded: frames that are missing from its recording.
        heard: whether anything has come from it since the start: until then its state is not known.
    """

    overruns: int
    bus_off: int
    state: Literal["error-active", "error-warning", "error-passive", "bus-off"] | None
    unrecorded: int = 0
    heard: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Vitals:
    """What is examined.

    Attributes:
        now_ns: monotonic clock.
        conditions_reported: conditions of the service that were ever reported, also before a restart.
        free_bytes: free space on the store's disk; None if it was not read.
        waiting: alarm events in memory that the disk has not taken.
        write_errors: failed writes of alarms so far.
        lost: alarm events that could not even wait, so far.
        damaged: corrupt files set aside, and messages that a file no longer knew, so far.
        telemetry_dropped: telemetry messages dropped so far.
        unwritten: commands so far that were refused because the audit log could not be written.
        buses: how each bus stands, by name.
        unbacked: whether the disk takes no alarm events, so that they go out from memory.
        set_aside: whether the damage has left files that are named ``*.corrupt-*``.
    """

    now_ns: int
    conditions_reported: frozenset[str]
    free_bytes: int | None
    waiting: int
    write_errors: int
    lost: int
    damaged: int
    telemetry_dropped: int
    unwritten: int
    buses: Mapping[str, BusHealth] = field(default_factory=dict)
    unbacked: bool = False
    set_aside: bool = False


def conditions(buses: Mapping[str, Collection[str]] = MappingProxyType({})) -> list[str]:
    """The names of all that can be reported, so that people may prepare for it.

    Args:
        buses: by name, what can be watched of each bus; see `BusTable.self_checks`.
    """
    names = list(STORE)
    for kind, check in (
        (BUS_OVERRUN, "overrun"),
        (BUS_CONTROLLER, "controller"),
        (BUS_RECORDING, "recording"),
    ):
        names += [f"{kind}{bus}" for bus, watched in buses.items() if check in watched]
    return names


class SelfCheck:
    """Remembers what was seen before, and states the present state.

    What is not known yet is not reported as normal: an alarm that was active before a restart would return,
    and come again. What happens now and then is known once it was watched for `QUIET_NS`.

    Args:
        store: the store's directory.
        reserve_bytes: free space below which the disk is nearly full.
    """

    def __init__(self, store: Path, reserve_bytes: int) -> None:
        self._store = store
        self._reserve_bytes = reserve_bytes
        self._remedy = "make room on the disk"
        self._telemetry = _Happening()
        self._lost = _Happening()
        self._unwritten = _Happening()
        self._damaged = _Happening()
        self._overruns: defaultdict[str, _Happening] = defaultdict(_Happening)
        self._bus_off: defaultdict[str, _Happening] = defaultdict(_Happening)
        self._unrecorded: defaultdict[str, _Happening] = defaultdict(_Happening)
        self._write_errors = 0
        self._unwritable = False
        self._begun_ns: dict[str, int] = {}
        """By condition of what happens now and then, since when it is watched."""
        self._not_normal: set[str] = set()
        """Of these, those that were other than normal in this run."""

    def free_bytes(self) -> int:
        """Free space for the service on the store's disk; blocks.

        Raises:
            OSError: the store cannot be reached.
        """
        self._remedy = remedy(self._store)
        return shutil.disk_usage(self._store).free

    def look(self, vitals: Vitals) -> Iterator[Condition]:
        """The state of everything, as far as it is known, whether that is new or not."""
        if vitals.free_bytes is not None:
            yield self._disk(vitals.free_bytes)
        for now_and_then in (self._journal, self._damage, self._dropped, self._audit):
            yield from self._once_known(now_and_then(vitals), vitals)
        yield from self._buses(vitals)

    def _buses(self, vitals: Vitals) -> Iterator[Condition]:
        for bus, health in vitals.buses.items():
            states = [self._overrun(bus, health, vitals.now_ns)]
            if health.state is not None:
                states.append(self._controller(bus, health, vitals.now_ns))
                states.append(self._recording(bus, health, vitals.now_ns))
            for condition in states:
                yield from self._once_known(condition, vitals, watched=health.heard)
        of_a_bus = (BUS_OVERRUN, BUS_CONTROLLER, BUS_RECORDING)
        for name in sorted(vitals.conditions_reported):
            if name.startswith(of_a_bus) and name.partition("/")[2] not in vitals.buses:
                yield Condition(name, Level.NORMAL, "there is no such bus any more")

    def _once_known(
        self, condition: Condition, vitals: Vitals, *, watched: bool = True
    ) -> Iterator[Condition]:
        """A condition of what happens now and then, unless it is not known yet whether it still does."""
        name = condition.name
        if condition.level is not Level.NORMAL:
            self._not_normal.add(name)
        elif name not in self._not_normal and name in vitals.conditions_reported:
            # It was active before a restart.
            if not watched:
                return
            begun_ns = self._begun_ns.setdefault(name, vitals.now_ns)
            if vitals.now_ns - begun_ns < QUIET_NS:
                return
        yield condition

    def _disk(self, free_bytes: int) -> Condition:
        # No count of what is free: it represents hours, and would be another sentence with every MiB.
        limit = f"{self._reserve_bytes // MIB} MiB"
        if free_bytes < self._reserve_bytes:
            on = f"on the disk of {self._store}"
            sentence = f"less than {limit} are free {on}: make room, or alarms wait in memory"
            return Condition("store/disk", Level.ALERT, sentence)
        return Condition("store/disk", Level.NORMAL, f"{limit} or more are free on the disk of {self._store}")

    def _journal(self, vitals: Vitals) -> Condition:
        failed = vitals.write_errors > self._write_errors
        self._write_errors = vitals.write_errors
        self._unwritable = vitals.unbacked or (vitals.waiting > 0 and (failed or self._unwritable))
        if self._lost.goes_on(vitals.lost, vitals.now_ns):
            sentence = f"{vitals.lost} alarm events are lost: the journal in {self._store} cannot be written"
            return Condition(JOURNAL, Level.DANGER, sentence)
        if self._unwritable:
            sentence = (
                f"the journal in {self._store} cannot be written: delivery of alarms is not backed by "
                "the disk. They are sent from memory, and what the broker does not get before the process "
                f"ends is lost; {self._remedy}"
            )
            return Condition(JOURNAL, Level.ALERT, sentence)
        return Condition(JOURNAL, Level.NORMAL, f"the journal in {self._store} takes all events")

    def _damage(self, vitals: Vitals) -> Condition:
        if not self._damaged.goes_on(vitals.damaged, vitals.now_ns):
            return Condition("store/damage", Level.NORMAL, f"the files in {self._store} are sound")
        left = "the rest is set aside as *.corrupt-*" if vitals.set_aside else "the rest is gone"
        sentence = (
            f"files in {self._store} were damaged: what could be read was saved, {left}; look at the disk"
        )
        return Condition("store/damage", Level.ALERT, sentence)

    def _dropped(self, vitals: Vitals) -> Condition:
        stands = self._telemetry.goes_on(vitals.telemetry_dropped, vitals.now_ns)
        if not stands:
            return Condition("store/telemetry", Level.NORMAL, "no telemetry is being dropped")
        sentence = f"telemetry is dropped, {vitals.telemetry_dropped} messages so far: look at the broker"
        return Condition("store/telemetry", Level.ALERT, sentence)

    def _audit(self, vitals: Vitals) -> Condition:
        stands = self._unwritten.goes_on(vitals.unwritten, vitals.now_ns)
        if not stands:
            return Condition("store/audit-log", Level.NORMAL, "the audit log takes all commands")
        sentence = (
            f"the audit log in {self._store} cannot be written, and commands are refused: {self._remedy}"
        )
        return Condition("store/audit-log", Level.ALERT, sentence)

    def _overrun(self, bus: str, health: BusHealth, now_ns: int) -> Condition:
        name = f"{BUS_OVERRUN}{bus}"
        if not self._overruns[bus].goes_on(health.overruns, now_ns):
            return Condition(name, Level.NORMAL, f"no buffer of bus {bus} overflows")
        # No count: it would be another sentence each time.
        sentence = (
            f"what bus {bus} carries is lost, because a buffer of this machine or of its adapter overflows: "
            "relieve the machine, or enlarge the buffer (CAN: receive_buffer_bytes)"
        )
        return Condition(name, Level.ALERT, sentence)

    def _controller(self, bus: str, health: BusHealth, now_ns: int) -> Condition:
        name = f"{BUS_CONTROLLER}{bus}"
        went_off = self._bus_off[bus].goes_on(health.bus_off, now_ns)
        look = "look at wiring, termination and bit rate"
        if health.state == "bus-off":
            return Condition(name, Level.DANGER, f"the controller of bus {bus} is bus-off: {look}")
        if went_off:
            sentence = f"the controller of bus {bus} went bus-off within the last minute: {look}"
            return Condition(name, Level.DANGER, sentence)
        if health.state == "error-passive":
            return Condition(name, Level.ALERT, f"the controller of bus {bus} is error-passive: {look}")
        return Condition(name, Level.NORMAL, f"the controller of bus {bus} is sound")

    def _recording(self, bus: str, health: BusHealth, now_ns: int) -> Condition:
        name = f"{BUS_RECORDING}{bus}"
        if not self._unrecorded[bus].goes_on(health.unrecorded, now_ns):
            return Condition(name, Level.NORMAL, f"no frame is missing from the recording of bus {bus}")
        sentence = (
            f"frames of bus {bus} are missing from its recording: check that the folder is there, and its "
            "disk has room and is fast enough"
        )
        return Condition(name, Level.ALERT, sentence)


class _Happening:
    """A count that stands still, or does not."""

    def __init__(self) -> None:
        self._count = 0
        self._last_ns: int | None = None

    def goes_on(self, count: int, now_ns: int) -> bool:
        """Whether it has grown within `QUIET_NS`."""
        if count > self._count:
            self._count, self._last_ns = count, now_ns
        return self._last_ns is not None and now_ns - self._last_ns < QUIET_NS
