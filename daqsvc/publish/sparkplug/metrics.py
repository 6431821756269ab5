"""Alarms and diagnoses as Sparkplug metrics, and the present value of each.

Alarms are metrics of the node, because the box speaks even when the machine is out of reach; figures of the
detectors are metrics of the device.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from daqsvc.alarms.states import AlarmState, Level
from daqsvc.publish.payloads import AlarmPayload
from daqsvc.publish.sparkplug.codec import DataType, Metric

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from daqsvc.diagnosis.reading import Reading
    from daqsvc.diagnosis.record import Diagnosis

NS_PER_MS = 1_000_000
UNIT = "engUnit"
"""Property for the engineering unit, as widely used hosts name it."""

_ACKNOWLEDGED = frozenset(
    {AlarmState.NORMAL, AlarmState.ACTIVE_ACKNOWLEDGED, AlarmState.LATCHED_ACKNOWLEDGED}
)


class Board:
    """The present value of every metric there has been, by owner: None for the node, else the device."""

    def __init__(self) -> None:
        self._values: dict[str | None, dict[str, Metric]] = {}

    def put(self, owner: str | None, metrics: Iterable[Metric]) -> list[Metric]:
        """Take in values; returns those that are new or have changed."""
        known = self._values.setdefault(owner, {})
        changed = []
        for metric in metrics:
            name = metric.name or ""
            before = known.get(name)
            if before is None or before.value != metric.value:
                known[name] = metric
                changed.append(metric)
        return changed

    def of(self, owner: str | None, now_ms: int) -> list[Metric]:
        """All present values of an owner, as a birth has them."""
        known = self._values.get(owner, {}).values()
        return [m if m.timestamp_ms is not None else replace(m, timestamp_ms=now_ms) for m in known]


def node_properties(version: str, site: str, box: str) -> list[Metric]:
    """What a host should know about the box."""
    properties = {"Software": f"daqsvc {version}", "Site": site, "Box": box}
    return [
        Metric(name=f"Properties/{name}", datatype=DataType.STRING, value=text)
        for name, text in properties.items()
    ]


def alarm_metrics(payload: bytes) -> list[Metric]:
    """The metrics of an alarm event, from its payload in the outbox.

    Raises:
        ValueError: it is no alarm payload.
    """
    alarm = AlarmPayload.model_validate_json(payload)
    state, level = AlarmState(alarm.state), Level.of(alarm.level)
    own = AlarmState(alarm.covered) if alarm.covered is not None else state
    words = (alarm.message, alarm.occurrence, alarm.id)
    return _alarm(f"{alarm.machine}/{alarm.alarm}", (state, own), level, words, alarm.wall_ns // NS_PER_MS)


def quiet_alarm(machine: str, alarm: str) -> list[Metric]:
    """The metrics of an alarm that has never been raised."""
    normal = (AlarmState.NORMAL, AlarmState.NORMAL)
    return _alarm(f"{machine}/{alarm}", normal, Level.NORMAL, ("", None, None), None)


def _alarm(
    name: str,
    states: tuple[AlarmState, AlarmState],
    level: Level,
    words: tuple[str, str | None, str | None],
    at_ms: int | None,
) -> list[Metric]:
    """The metrics; ``states`` are what is shown, and the alarm's own below what covers it."""
    shown, own = states
    message, occurrence, event = words
    values: list[tuple[str, DataType, bool | int | str | None]] = [
        ("State", DataType.STRING, shown.value),
        ("Level", DataType.INT32, int(level)),
        ("Active", DataType.BOOLEAN, own.is_active),
        ("Acknowledged", DataType.BOOLEAN, own in _ACKNOWLEDGED),
        ("Message", DataType.STRING, message),
        ("Occurrence", DataType.STRING, occurrence),
        ("Event", DataType.STRING, event),
    ]
    return [
        Metric(name=f"Alarms/{name}/{part}", timestamp_ms=at_ms, datatype=datatype, value=value)
        for part, datatype, value in values
    ]


def declared(readings: Sequence[Reading]) -> list[Metric]:
    """The metrics of a device before any value of them is known."""
    detectors = dict.fromkeys(reading.detector for reading in readings)
    words = [
        Metric(name=f"{detector}/{word}", datatype=DataType.STRING)
        for detector in detectors
        for word in ("Decision", "Severity", "Quality", "Group")
    ]
    return [*words, *(_figure(reading, None, None) for reading in readings)]


def diagnosis_metrics(diagnosis: Diagnosis, readings: Sequence[Reading], wall_ns: int) -> list[Metric]:
    """The metrics of a statement.

    Args:
        diagnosis: the statement.
        readings: the figures that are metrics; those of other detectors are left alone.
        wall_ns: wall-clock label of its last sample, ns since 1970.
    """
    at_ms = wall_ns // NS_PER_MS
    words = {
        "Decision": diagnosis.decision,
        "Severity": str(diagnosis.severity),
        "Quality": str(diagnosis.quality),
        "Group": ", ".join(diagnosis.group),
    }
    metrics = [
        Metric(name=f"{diagnosis.detector}/{word}", timestamp_ms=at_ms, datatype=DataType.STRING, value=text)
        for word, text in words.items()
    ]
    for reading in readings:
        if reading.detector == diagnosis.detector:
            value = getattr(diagnosis, reading.kind).get(reading.key)
            metrics.append(_figure(reading, value, at_ms))
    return metrics


def _figure(reading: Reading, value: float | None, at_ms: int | None) -> Metric:
    probability = "Probability/" if reading.kind == "probabilities" else ""
    return Metric(
        name=f"{reading.detector}/{probability}{reading.key}",
        timestamp_ms=at_ms,
        datatype=DataType.DOUBLE,
        value=None if value is None or not math.isfinite(value) else float(value),
        properties={UNIT: reading.unit} if reading.unit else {},
    )
