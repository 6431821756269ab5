"""What ``daqsvc status --json`` prints: how everything stands that the service knows, at one moment."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from daqsvc.alarms.states import AlarmState  # noqa: TC001 - as below
from daqsvc.diagnosis.record import Severity  # noqa: TC001 - pydantic reads the annotations
from daqsvc.dsp.quality import Quality  # noqa: TC001 - as above
from daqsvc.publish.payloads import Figures, JsonPayload, Number, Stamped

SCHEMA: Literal["daqsvc.service-status/1"] = "daqsvc.service-status/1"

SensorState = Literal["ok", "not_ok", "missing", "unknown"]


class BusPayload(JsonPayload):
    """How a bus stands."""

    driver: str
    state: Literal["up", "down"]
    reason: str = Field(description="why it is down")


class StreamPayload(JsonPayload):
    """How a stream stands."""

    bus: str
    rate_hz: Number = Field(description="measured rate; null before it is known, and while nothing comes")
    configured_rate_hz: float
    age_s: Number = Field(description="age of the newest sample; null before the first one")
    doubt: str = Field(description="why nothing can be judged by its samples; empty if it can")
    samples_received: int
    samples_lost: int


class ChannelPayload(JsonPayload):
    """The newest sample of a channel, and whether its sensor is OK."""

    stream: str
    channel: str
    sensor: str | None = Field(description="null if no sensor of the machine file is on it")
    value: Number = Field(description="null if the newest sample is missing, or none has come")
    unit: str
    age_s: Number
    state: SensorState = Field(description="what the detectors say of the sensor")
    reason: str = Field(description="why it is not ok")


class MeasurePayload(JsonPayload):
    """One figure of a detector."""

    value: Number
    unit: str


class StatementPayload(JsonPayload):
    """What a detector has said last."""

    detector: str
    sensors: tuple[str, ...]
    where: str
    decision: str
    severity: Severity
    quality: Quality
    reason: str = Field(description="why the quality is not good")
    age_s: Number = Field(description="age of the last sample that it rests on")
    measures: dict[str, MeasurePayload] = Field(description="of the last statement that had any")
    measures_age_s: Number = Field(description="age of these; null if there are none")
    probabilities: dict[str, Number]


class StandingAlarmPayload(JsonPayload):
    """An alarm that is not normal."""

    alarm: str
    state: AlarmState
    level: Severity
    occurrence: str | None
    age_s: Number = Field(description="since it changed last")
    shelved_until_wall_ns: int | None = Field(None, description="when shelving ends; null if not shelved")
    first_out: bool = Field(False, description="it was the first of its group to stand")
    message: str


class AlarmsPayload(JsonPayload):
    """How the alarms stand."""

    by_state: dict[str, int] = Field(description="how many are in each state, normal included")
    standing: tuple[StandingAlarmPayload, ...] = Field(description="those not normal, the worst first")


class OutboxPayload(JsonPayload):
    """What waits for the broker and for the disk."""

    depth: int = Field(description="alarm events on disk that the broker has not acknowledged")
    waiting: int = Field(description="alarm events in memory that are not on disk yet")
    oldest_age_s: Number = Field(description="age of the oldest event for the broker; null if none waits")
    journal: Literal["written", "not open", "not written"]


class OutputPayload(JsonPayload):
    """How an output stands."""

    connected: bool | None = Field(description="null for one that has no connection")
    reason: str = Field("", description="why it reaches nobody at present; empty if it does")
    away_s: Number = Field(
        None, description="for how long it has reached nobody; null if it reaches somebody"
    )


class ServiceStatusPayload(Stamped):
    """How everything stands that the service knows."""

    schema_: Literal["daqsvc.service-status/1"] = Field(SCHEMA, alias="schema")
    machine: str
    version: str
    uptime_s: float
    buses: dict[str, BusPayload]
    streams: dict[str, StreamPayload]
    channels: tuple[ChannelPayload, ...]
    statements: tuple[StatementPayload, ...]
    alarms: AlarmsPayload
    outbox: OutboxPayload
    outputs: dict[str, OutputPayload] = Field(description="by table; empty if the machine file has none")
    faults: dict[str, dict[str, dict[str, int]]] = Field(
        description="what was lost or went wrong since the start: by kind, name and cause; none that is 0"
    )
    figures: Figures = Field(description="every figure of the service, as in daqsvc.status/1")
