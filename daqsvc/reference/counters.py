"""The page of all figures of the status: counters of losses and faults, states, rates."""

from __future__ import annotations

import inspect
import re
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.alignment_source import SourceCounters
from daqsvc.acquisition.assembler import StreamCounters
from daqsvc.alarm_commands import CommandCounters
from daqsvc.alarms.handling import AlarmCounters
from daqsvc.control import ControlCounters
from daqsvc.diagnosis.pipeline import DetectorCounters
from daqsvc.outbox.counters import OutboxCounters, TelemetryCounters
from daqsvc.publish.faults import fault_counts
from daqsvc.publish.mqtt.commands import IntakeCounters
from daqsvc.publish.mqtt.session import PublishCounters
from daqsvc.publish.sparkplug.session import SparkplugCounters
from daqsvc.recorder import RecorderCounters
from daqsvc.reference.markdown import code, page, table
from daqsvc.reference.samples import services

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

NAME = "NAME"
FIGURES = "figures"
_NAMED = {"streams": 1, "buses": 1, "grids": 2, "detectors": 1, "failures": 1, "recorders": 1}
"""How many levels below these are names that the machine file gives."""
_FREE = {"unknown_ids", "exceptions"}
"""Counts by what comes over the bus."""
_COUNTED: Mapping[str, type[Any]] = {
    "streams.NAME": StreamCounters,
    "grids.NAME.NAME": SourceCounters,
    "detectors.NAME": DetectorCounters,
    "alarms": AlarmCounters,
    "commands": CommandCounters,
    "control": ControlCounters,
    "outbox": OutboxCounters,
    "outbox.telemetry": TelemetryCounters,
    "mqtt": PublishCounters,
    "mqtt.commands": IntakeCounters,
    "sparkplug": SparkplugCounters,
    "recorders.NAME": RecorderCounters,
}
"""Classes of counters by where they stand: their docstrings state what each is."""
WORDS: Mapping[str, str] = {
    "streams.NAME.rate_hz": "samples per second by the device's clock; by the machine file until it is known",
    "streams.NAME.doubt": "why nothing can be judged by the samples; empty if it can",
    "streams.NAME.drift_ppm": "how far the device's clock runs off the rate of the machine file, in ppm",
    "streams.NAME.jitter_ms": "how irregularly blocks arrive, 95th percentile, in ms",
    "streams.NAME.time_settled": "1 once the rate is measured (two seconds of arrivals), else 0",
    "streams.NAME.counter_restarts": "how often the counter of the device began again, e.g. after a reset",
    "streams.NAME.end_index": "number of the next sample: how many there have been, lost ones included",
    "buses.NAME.up": "1 while the bus is up, else 0",
    "buses.NAME.losses": "how often the bus went down after it had been up",
    "grids.NAME.NAME.error_us": "how far samples may be off the reference's, 95th percentile, in us",
    "loop_lag_ms.p50": "lateness of the event loop within the last minute, median, in ms",
    "loop_lag_ms.p99": "lateness of the event loop within the last minute, 99th percentile, in ms",
    "loop_lag_ms.max": "lateness of the event loop within the last minute, maximum, in ms",
    "suspensions": "how often the process did not run for more than a second",
    "failures.NAME": "how often that part of the service has failed and was started again",
    "alarms.active": "alarms that are active by now",
    "alarms.unacknowledged": "alarms that nobody has acknowledged by now",
    "alarms.latched": "alarms that are latched by now: gone, and wait to be reset",
    "alarms.suppressed": "alarms that are suppressed by now, because a sensor is not OK",
    "alarms.shelved": "alarms that are shelved by now",
    "alarms.out_of_service": "alarms that are bypassed by now",
    "mqtt.dead_letters": "messages that the broker has refused and that are tried again",
    "mqtt.dead_letters_dropped": "the oldest of those, dropped because there were too many of a topic",
    "mqtt.certificates.NAME.not_after_seconds": "when the certificate ends, in s since 1970",
    "mqtt.certificates.NAME.days_left": "days until the certificate ends",
    "page.up": "1 while the page runs, else 0",
    "page.starts": "how often the process of the page was started",
    "history.seconds_written": "seconds of trends written",
    "history.seconds_waiting": "seconds of trends that wait for the disk",
    "history.seconds_lost": "seconds of trends that were lost because the disk took nothing for too long",
    "history.alarm_events": "alarm events written",
    "history.chunks_damaged": "pieces of the history that could not be read",
    "recorders.NAME.snapshots_deleted": "snapshots deleted because of `max_mb`, `keep_days` or `reserve_mb`",
    "recorders.NAME.recording": "1 while a snapshot is written, else 0",
    "recorders.NAME.waiting_bytes": "bytes of snapshots that wait for the disk",
}
"""Figures that no class of counters holds."""
_ONLY_WITH_TLS = ("mqtt.certificates.NAME.not_after_seconds", "mqtt.certificates.NAME.days_left")
_METRIC = {
    "streams": "daqsvc_stream_faults_total",
    "buses": "daqsvc_bus_faults_total",
    "detectors": "daqsvc_detector_faults_total",
    "outbox": "daqsvc_outbox_faults_total",
    "telemetry": "daqsvc_telemetry_faults_total",
}
_ATTRIBUTE = re.compile(r"^    (\w+): ")


def attributes(kind: type[Any]) -> dict[str, str]:
    """What the docstring of a class, or of one that it derives from, states of each attribute."""
    words: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        _, _, listed = inspect.cleandoc(base.__doc__ or "").partition("Attributes:\n")
        name = ""
        for line in listed.splitlines():
            if match := _ATTRIBUTE.match(line):
                name = match[1]
                words[name] = line[match.end() :]
            elif name and line.startswith("        "):
                words[name] += f" {line.strip()}"
            else:
                name = ""
    return {name: text.replace("``", "`").removesuffix(".") for name, text in words.items()}


def figures() -> tuple[str, ...]:
    """The path of every figure that the services of the examples have, and of what needs more than a file."""
    paths: dict[str, None] = {}

    def walk(below: Mapping[str, Any], path: tuple[str, ...], names: int) -> None:
        for key, value in below.items():
            here = (*path, NAME if names > 0 else key)
            if isinstance(value, dict) and key not in _FREE:
                walk(value, here, names - 1 if path else _NAMED.get(key, 0))
            else:
                paths[".".join(here)] = None

    for service in services():
        walk(service.figures(), (), 0)
    return (*paths, "failures.NAME", *_ONLY_WITH_TLS)


def words() -> dict[str, dict[str, list[str]]]:
    """By the path of each figure what it is, and the drivers on whose buses it is that."""
    known = {
        f"{where}.{name}": text for where, kind in _COUNTED.items() for name, text in attributes(kind).items()
    }
    by_path = {path: {text: list[str]()} for path, text in {**known, **WORDS}.items()}
    for service in services():
        for report in service.driver_reports:
            driver = service.box.own.buses[report.name].driver
            for name, text in attributes(type(report.counters)).items():
                drivers = by_path.setdefault(f"buses.{NAME}.{name}", {}).setdefault(text, [])
                drivers += [] if driver in drivers else [driver]
    return by_path


def gaps() -> Iterator[str]:
    """Figures of the status that nothing describes."""
    known = words()
    for path in figures():
        if not known.get(path):
            yield f"figure {path} of the status is described nowhere: its class, or daqsvc.reference.counters"


def causes() -> set[str]:
    """Paths of the figures that are a ``cause`` of a metric."""
    return {
        f"outbox.{fault.kind}.{fault.cause}"
        if fault.kind == "telemetry"
        else f"{fault.kind}.{'' if fault.kind == 'outbox' else f'{NAME}.'}{fault.cause}"
        for service in services()
        for fault in fault_counts(service.figures())
    }


def pages() -> dict[str, str]:
    """Text of each page, by file name."""
    known, faults = words(), causes()
    groups: dict[str, list[tuple[str, ...]]] = {}
    for path in figures():
        group = path.split(".")[0]
        kind = "telemetry" if path.startswith("outbox.telemetry.") else group
        metric = _METRIC[kind] if path in faults else ""
        mark = f'<a id="{path}"></a>'
        for text, drivers in known[path].items():
            only = ", ".join(drivers) if len(drivers) < _drivers() else ""
            groups.setdefault(group, []).append((f"{mark}{code(path)}", text, only, code(metric)))
            mark = ""
    header = ("figure", "what it is", "only with driver", "cause of the metric")
    parts = [part for group, rows in groups.items() for part in (f"## `{group}`", table(header, rows))]
    return {"counters.md": page("Counters and figures of the status", _ABOUT, *parts)}


def _drivers() -> int:
    return len({bus.driver for service in services() for bus in service.box.own.buses.values()})


_ABOUT = """Every figure below `figures` in the status message (topic `ROOT/SITE/BOX/status`,
[payloads.md](payloads.md)), and in `daqsvc status --json`. `NAME` is the name of a stream, a bus, a
detector, a machine or a part of the service. Counts are since the start of the service. Those with a metric
are a value of its label `cause` ([metrics.md](metrics.md)); `daqsvc status` lists those that are not 0.
[status.md](../status.md) explains the rest. Where several machines are watched, `machines.NAME.alarms` has
the figures of `alarms` for each of them."""
