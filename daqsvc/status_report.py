"""The state of everything that the service knows: what ``daqsvc status`` asks for.

The event loop gathers references and the newest sample of each stream, and lets others have their turn
meanwhile. The text is made on a thread, once for all who ask at about the same time.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from daqsvc import __version__
from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.codes import code_of_alarm, code_of_quality
from daqsvc.alarms.states import AlarmState
from daqsvc.diagnosis.snapshots import patience
from daqsvc.errors.buses import NOT_BELIEVED
from daqsvc.outbox.messages import OutboxError
from daqsvc.publish.faults import fault_counts
from daqsvc.publish.payloads import stamp_now
from daqsvc.publish.service_status import SCHEMA

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Mapping, Sequence

    from daqsvc.acquisition.clock import Clock
    from daqsvc.acquisition.link import Link
    from daqsvc.alarm_service import AlarmService
    from daqsvc.alarms.status import AlarmStatus
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.driver_reports import DriverReports
    from daqsvc.errors.code import Code
    from daqsvc.machine_watch import MachineWatch
    from daqsvc.publish.output import Output
    from daqsvc.publish.service_status import SensorState
    from daqsvc.settings.sensors import Sensor

    Document = dict[str, Any]
    Newest = tuple[list[float], int] | None

T = TypeVar("T")

FRESH_S = 0.2
"""Who asks within so long gets the same answer."""
OLDEST_S = 1.0
"""The journal is waited for at most so long: a disk that hangs leaves the rest as it is."""
MOST_AT_FAULT = 3
"""Streams of a bus of which it is shown why they get no samples."""
AT_ONCE = 64
"""Channels or alarms reported in one turn of the event loop."""


class _Seen(NamedTuple):
    """What the event loop has gathered.

    Attributes:
        now_ns: when, by the service's clock.
        figures: those of the status message.
        oldest_wall_ns: when the oldest event happened that waits for the broker; None if that is not known.
        alarms: the state of each.
        newest: by stream, its newest sample ``[channels]`` and when that was taken; None before the first.
        latest: the last statement of each detector.
        measured: the same, with figures.
        at_fault: by bus, why streams of it get no samples while it is up.
    """

    now_ns: int
    figures: Document
    oldest_wall_ns: int | None
    alarms: Mapping[str, AlarmStatus]
    newest: Mapping[str, Newest]
    latest: Mapping[str, Diagnosis]
    measured: Mapping[str, Diagnosis]
    at_fault: Mapping[str, str]


class StatusReport:
    """Keeps the last statements of the detectors, and reports the state of everything.

    Args:
        watch: of the machine.
        clock: the service's clock.
        drivers: what the driver of each bus tells.
        alarms: the alarms, their outbox and outputs.
        figures: the figures of the status message that are about the machine, by the names of its file.
        begun_ns: when the service has begun, by its clock.
    """

    def __init__(
        self,
        watch: MachineWatch,
        clock: Clock,
        drivers: Sequence[DriverReports],
        alarms: AlarmService,
        figures: Callable[[], dict[str, Any]],
        begun_ns: int,
    ) -> None:
        machine = self._machine = watch.machine
        self._clock = clock
        self._rings = watch.rings
        self._drivers = [driver for driver in drivers if driver.name in machine.buses]
        self._alarms = alarms
        self._figures = figures
        self._begun_ns = begun_ns
        self._patience_ns = {n: patience(machine, n, s.rate_hz).ns for n, s in machine.streams.items()}
        self._latest: dict[str, Diagnosis] = {}
        self._measured: dict[str, Diagnosis] = {}
        self._value_names = machine.value_names
        self._sensors: dict[tuple[str, str], list[Sensor]] = {}
        for sensor in machine.sensors:
            self._sensors.setdefault((sensor.stream, sensor.channel), []).append(sensor)
        self._one_at_a_time = asyncio.Lock()
        self._text = b""
        self._made_s = -math.inf

    @property
    def latest(self) -> list[Diagnosis]:
        """The last statement of each detector."""
        return [*self._latest.values()]

    def remember(self, diagnosis: Diagnosis) -> None:
        """Keep a statement of a detector until its next one."""
        self._latest[diagnosis.detector] = diagnosis
        if diagnosis.statistics:
            self._measured[diagnosis.detector] = diagnosis

    async def line(self) -> bytes:
        """The state of everything, at most `FRESH_S` old: a `ServiceStatusPayload` as a line of JSON."""
        loop = asyncio.get_running_loop()
        async with self._one_at_a_time:
            if loop.time() - self._made_s > FRESH_S:
                seen = await self._look()
                self._text = await asyncio.to_thread(lambda: _json_line(self._document(seen)))
                self._made_s = loop.time()
        return self._text

    async def _look(self) -> _Seen:
        now_ns, figures = self._clock.monotonic_ns(), self._figures()
        # Before the alarms: none that follows of a statement is missing beside it.
        latest, measured = dict(self._latest), dict(self._measured)
        # Before a block can come: the newest sample is then the last one that the figures count.
        newest = {name: sample async for name, sample in _by_turns(self._newest())}
        # What the service reports about itself concerns each of its machines.
        of_machine = self._alarms.managers[self._machine.machine.name]
        alarms = {**self._alarms.manager.alarms, **of_machine.alarms}
        return _Seen(
            now_ns,
            figures,
            await self._oldest_wall_ns(),
            {name: status async for name, status in _by_turns((n, alarms[n]) for n in list(alarms))},
            newest,
            latest,
            measured,
            {driver.name: _at_fault(driver.link) for driver in self._drivers},
        )

    def _document(self, seen: _Seen) -> Document:
        """A `ServiceStatusPayload` in what JSON knows; on a thread."""
        stamp = stamp_now(self._machine.site, self._machine.box, self._clock)
        outbox = seen.figures["outbox"]
        states = _sensor_states(seen.latest.values(), seen.alarms)
        return {
            "schema": SCHEMA,
            **stamp,
            "machine": self._machine.machine.name,
            "version": __version__,
            "uptime_s": _age_s(self._begun_ns, seen.now_ns),
            "buses": {
                driver.name: {
                    "driver": self._machine.buses[driver.name].driver,
                    "state": driver.link.state,
                    "reason": driver.link.reason or seen.at_fault[driver.name],
                    "code": _id(driver.link.code),
                }
                for driver in self._drivers
            },
            "streams": {name: self._stream(name, seen) for name in self._machine.streams},
            "channels": list(self._channels(seen, states)),
            "statements": [
                _statement(seen.latest[name], seen.measured.get(name), seen.now_ns)
                for name in sorted(seen.latest)
            ],
            "alarms": _standing(
                seen.alarms,
                seen.now_ns,
                stamp["wall_ns"] - stamp["monotonic_ns"],
                {f"detector-ok/{one.detector}": one.quality for one in seen.latest.values()}
                | {f"sensor-ok/{name}": state for name, (state, _) in states.items()},
            ),
            "outbox": {
                "depth": outbox["depth"],
                "waiting": outbox["waiting"],
                "oldest_age_s": None
                if seen.oldest_wall_ns is None
                else _age_s(seen.oldest_wall_ns, stamp["wall_ns"]),
                "journal": _journal(outbox),
            },
            "outputs": {
                path: _output(path, seen.figures, output) for path, output in self._alarms.outputs.items()
            },
            "faults": _faults(seen.figures),
            "figures": seen.figures,
        }

    async def _oldest_wall_ns(self) -> int | None:
        """See `Outbox.oldest_wall_ns`; None also if the disk hangs."""
        with contextlib.suppress(TimeoutError, OutboxError):
            async with asyncio.timeout(OLDEST_S):
                return await self._alarms.outbox.oldest_wall_ns()
        return None

    def _newest(self) -> Iterator[tuple[str, Newest]]:
        for name in self._machine.streams:
            ring = self._rings[name]
            last = ring.end_index - 1
            yield name, (ring.read(last, 1)[0].tolist(), ring.time_of(last)) if ring.started else None

    def _stream(self, name: str, seen: _Seen) -> Document:
        stream, counted, sample = (
            self._machine.streams[name],
            seen.figures["streams"].get(name, {}),
            seen.newest[name],
        )
        comes = sample is not None and seen.now_ns - sample[1] < self._patience_ns[name]
        known = comes and counted.get("time_settled") and not counted["doubt"]
        return {
            "bus": stream.bus,
            "rate_hz": counted["rate_hz"] if known else None,
            "configured_rate_hz": stream.rate_hz,
            "age_s": None if sample is None else _age_s(sample[1], seen.now_ns),
            "doubt": counted.get("doubt", ""),
            "code": _id(NOT_BELIEVED if counted.get("doubt") else None),
            "samples_received": counted.get("samples_received", 0),
            "samples_lost": counted.get("samples_lost", 0),
            # A layout with a count or time has no such key, also one of another package.
            "losses": "estimated" if getattr(stream.layout, "no_counter", False) else "counted",
        }

    def _channels(self, seen: _Seen, states: Mapping[str, tuple[SensorState, str]]) -> Iterator[Document]:
        for name, stream in self._machine.streams.items():
            sample = seen.newest[name]
            for column, channel in enumerate(stream.layout.channel_names):
                value = None if sample is None else sample[0][column]
                for sensor in self._sensors.get((name, channel), [None]):
                    state, reason = states.get(sensor.name, _UNKNOWN) if sensor else _UNKNOWN
                    yield {
                        "stream": name,
                        "channel": channel,
                        "sensor": sensor and sensor.name,
                        "value": value,
                        "value_name": self._name_of(sensor, value),
                        "unit": sensor.unit if sensor else "",
                        "age_s": None if sample is None else _age_s(sample[1], seen.now_ns),
                        "state": state,
                        "reason": reason,
                        "code": _id(code_of_quality(state)),
                    }

    def _name_of(self, sensor: Sensor | None, value: float | None) -> str | None:
        """What a value means, where its sensor is a state whose values have names."""
        if sensor is None or value is None:
            return None
        return self._value_names.get(sensor.name, {}).get(value)


_UNKNOWN: tuple[SensorState, str] = ("unknown", "")
_WORSE: tuple[SensorState, ...] = ("unknown", "ok", "missing", "not_ok")


def _at_fault(link: Link) -> str:
    """Why streams of a bus that is up get no samples, in a clause; empty if all get some."""
    faults = [f"stream {name!r}: {why}" for name, why in sorted(link.faults.items())]
    more = [f"and {len(faults) - MOST_AT_FAULT} more"] * (len(faults) > MOST_AT_FAULT)
    return "; ".join([*faults[:MOST_AT_FAULT], *more])


def _sensor_states(
    statements: Iterable[Diagnosis], alarms: Mapping[str, AlarmStatus]
) -> dict[str, tuple[SensorState, str]]:
    """By sensor, how it is, and why it is not OK: the worst of the statements on it alone, and of its alarm.

    Of one that is only judged together with others it is known when it is OK, but not which of them is not.
    """
    states: dict[str, tuple[SensorState, str]] = {}
    for statement in statements:
        alone = len(statement.sensors) == 1
        state: SensorState = (
            "ok" if statement.quality == "good" else statement.quality if alone else "unknown"
        )
        for sensor in statement.sensors:
            if _WORSE.index(state) >= _WORSE.index(states.get(sensor, _UNKNOWN)[0]):
                states[sensor] = (state, statement.reason)
    for sensor, (state, _) in states.items():
        alarm = alarms.get(f"sensor-ok/{sensor}")
        if state == "ok" and alarm is not None and alarm.own_state.is_active:
            states[sensor] = ("not_ok", alarm.summary)
    return states


def _statement(latest: Diagnosis, measured: Diagnosis | None, now_ns: int) -> Document:
    return {
        "detector": latest.detector,
        "sensors": list(latest.sensors),
        "where": latest.where,
        "decision": latest.decision,
        "severity": latest.severity,
        "quality": latest.quality,
        "reason": latest.reason,
        "code": _id(code_of_quality(latest.quality)),
        "age_s": _age_s(latest.t_ns, now_ns),
        "measures": {
            name: {"value": value, "unit": measured.units.get(name, "")}
            for name, value in measured.statistics.items()
        }
        if measured
        else {},
        "measures_age_s": _age_s(measured.t_ns, now_ns) if measured else None,
        "probabilities": dict(latest.probabilities),
    }


def _standing(
    alarms: Mapping[str, AlarmStatus], now_ns: int, wall_of_ns: int, qualities: Mapping[str, str]
) -> Document:
    """The alarms.

    Args:
        alarms: by name.
        now_ns: monotonic clock.
        wall_of_ns: makes a time of the wall clock of one of the monotonic clock.
        qualities: of samples, by the name of the alarm about them.
    """
    by_state = dict.fromkeys((state.value for state in AlarmState), 0)
    standing = []
    for name, status in alarms.items():
        by_state[status.state.value] += 1
        if status.state is not AlarmState.NORMAL:
            standing.append((name, status))
    standing.sort(key=lambda one: (-one[1].level, -(one[1].since.t_ns if one[1].since else 0), one[0]))
    return {
        "by_state": by_state,
        "standing": [
            {
                "alarm": name,
                "state": status.state.value,
                "level": status.level.label,
                "occurrence": status.occurrence,
                "age_s": _age_s(status.since.t_ns, now_ns) if status.since else None,
                "shelved_until_wall_ns": None
                if status.shelved_until_ns is None
                else status.shelved_until_ns + wall_of_ns,
                "first_out": status.first_out,
                "message": status.summary,
                "code": _id(code_of_alarm(name, qualities.get(name, "")) if status.level else None),
            }
            for name, status in standing
        ],
    }


def _id(code: Code | None) -> str | None:
    return None if code is None else code.id


def _journal(outbox: Mapping[str, Any]) -> str:
    return "not open" if outbox["shut"] else "not written" if outbox["unbacked"] else "written"


def _output(path: str, figures: Mapping[str, Any], output: Output) -> Document:
    connected = figures.get(path.rpartition(".")[2], {}).get("connected")
    away_s = output.away_s
    return {
        "connected": None if connected is None else bool(connected),
        "reason": output.reason,
        "code": _id(output.code),
        "away_s": None if away_s is None else round(away_s, 3),
    }


def _faults(figures: Mapping[str, Any]) -> Document:
    faults: Document = {}
    for fault in fault_counts(figures):
        if fault.times:
            faults.setdefault(fault.kind, {}).setdefault(fault.name, {})[fault.cause] = fault.times
    return faults


def _age_s(then_ns: int, now_ns: int) -> float:
    return round(max(now_ns - then_ns, 0) / NS_PER_S, 3)


async def _by_turns(things: Iterable[T]) -> AsyncIterator[T]:
    """The things, with a turn of the event loop for others now and then."""
    for number, thing in enumerate(things):
        if number % AT_ONCE == AT_ONCE - 1:
            await asyncio.sleep(0)
        yield thing


def _json_line(document: Document) -> bytes:
    """JSON in pieces, so that other threads run between; what JSON or UTF-8 do not know is null or ``?``."""
    parts = []
    for name, value in document.items():
        if isinstance(value, list):
            text = f"[{','.join(json.dumps(_plain(one), ensure_ascii=False) for one in value)}]"
        else:
            text = json.dumps(_plain(value), ensure_ascii=False)
        parts.append(f"{json.dumps(name)}:{text}")
    return f"{{{','.join(parts)}}}\n".encode("utf-8", "replace")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {f"{name}": _plain(below) for name, below in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    if isinstance(value, str | bool | int | None):
        return value
    if isinstance(value, Real):  # also those of NumPy
        return float(value) if math.isfinite(value) else None
    return f"{value}"
