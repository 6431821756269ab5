"""What ``daqsvc status --json`` prints: the state of everything that the service knows, at one moment."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from daqsvc.alarms.states import AlarmState  # noqa: TC001 - as below
from daqsvc.diagnosis.record import Severity  # noqa: TC001 - pydantic reads the annotations
from daqsvc.dsp.quality import Quality  # noqa: TC001 - as above
from daqsvc.publish.payloads import SCHEMA_ABOUT, Figures, JsonPayload, Number, Stamped

SCHEMA: Literal["daqsvc.service-status/1"] = "daqsvc.service-status/1"

SensorState = Literal["ok", "not_ok", "missing", "unknown"]


class BusPayload(JsonPayload):
    """How a bus stands."""

    driver: str = Field(description="name of the driver")
    state: Literal["up", "down"] = Field(description="whether the bus is up")
    reason: str = Field(
        description="why it is down, or, while it is up, why some of its streams get no samples"
    )
    code: str | None = Field(None, description="code of that reason; null if there is none")


class StreamPayload(JsonPayload):
    """How a stream stands."""

    bus: str = Field(description="name of the bus")
    rate_hz: Number = Field(description="measured rate; null before it is known, and while nothing comes")
    configured_rate_hz: float = Field(description="rate in the machine file")
    age_s: Number = Field(description="age of the newest sample; null before the first one")
    doubt: str = Field(description="why nothing can be judged by its samples; empty if it can")
    code: str | None = Field(None, description="code of that doubt; null if there is none")
    samples_received: int = Field(description="samples that came")
    samples_lost: int = Field(description="samples that never came")
    losses: Literal["counted", "estimated"] = Field(
        description="how their number is known: estimated from the times of arrival if the device sends "
        "neither a count nor a time"
    )


class ChannelPayload(JsonPayload):
    """The newest sample of a channel, and whether its sensor is OK."""

    stream: str = Field(description="name of the stream")
    channel: str = Field(description="name of the channel")
    sensor: str | None = Field(description="null if no sensor of the machine file is on it")
    value: Number = Field(description="null if the newest sample is missing, or none has come")
    value_name: str | None = Field(
        None, description="what the value means, if it is a state with names in a DBC file"
    )
    unit: str = Field(description="unit of the value")
    age_s: Number = Field(description="age of the newest sample; null before the first one")
    state: SensorState = Field(description="what the detectors state about the sensor")
    reason: str = Field(description="why it is not ok")
    code: str | None = Field(None, description="code of that reason; null if there is none")


class MeasurePayload(JsonPayload):
    """One figure of a detector."""

    value: Number = Field(description="the figure; null if it is not known")
    unit: str = Field(description="its unit; empty for a pure number")


class StatementPayload(JsonPayload):
    """The last statement of a detector."""

    detector: str = Field(description="name of the detector")
    sensors: tuple[str, ...] = Field(description="names of the sensors that the statement rests on")
    where: str = Field(description="the part of the machine that it is about; or empty")
    decision: str = Field(description="what the detector has decided")
    severity: Severity = Field(description="how bad that is")
    quality: Quality = Field(description="whether the samples and sensors are good")
    reason: str = Field(description="why the quality is not good; if it is, what to know of the decision")
    code: str | None = Field(None, description="code of that reason; null if there is none")
    age_s: Number = Field(description="age of the last sample that it rests on")
    measures: dict[str, MeasurePayload] = Field(description="of the last statement that had any")
    measures_age_s: Number = Field(description="age of these; null if there are none")
    probabilities: dict[str, Number] = Field(description="by mode; empty if the detector has none")


class StandingAlarmPayload(JsonPayload):
    """An alarm that is not normal."""

    alarm: str = Field(description="name of the alarm")
    state: AlarmState = Field(description="its state")
    level: Severity = Field(description="how bad it is")
    occurrence: str | None = Field(description="id of the activation; null if there is none")
    age_s: Number = Field(description="since it changed last")
    shelved_until_wall_ns: int | None = Field(None, description="when shelving ends; null if not shelved")
    first_out: bool = Field(False, description="it was the first of its group to stand")
    message: str = Field(description="what was found last, and what has been done about it since")
    code: str | None = Field(
        None, description="code of what is wrong with data or service; null for other alarms"
    )


class AlarmsPayload(JsonPayload):
    """The states of the alarms."""

    by_state: dict[str, int] = Field(description="how many are in each state, normal included")
    standing: tuple[StandingAlarmPayload, ...] = Field(description="those not normal, the worst first")


class OutboxPayload(JsonPayload):
    """What waits for the broker and for the disk."""

    depth: int = Field(description="alarm events on disk that the broker has not acknowledged")
    waiting: int = Field(description="alarm events in memory that are not on disk yet")
    oldest_age_s: Number = Field(description="age of the oldest event for the broker; null if none waits")
    journal: Literal["written", "not open", "not written"] = Field(
        description="whether alarm events are written to the disk"
    )


class OutputPayload(JsonPayload):
    """The state of an output."""

    connected: bool | None = Field(description="null for one that has no connection")
    reason: str = Field("", description="why it reaches nobody at present; empty if it does")
    code: str | None = Field(None, description="code of that reason; null if there is none")
    away_s: Number = Field(
        None, description="for how long it has reached nobody; null if it reaches somebody"
    )


class ServiceStatusPayload(Stamped):
    """The state of everything that the service knows."""

    schema_: Literal["daqsvc.service-status/1"] = Field(SCHEMA, alias="schema", description=SCHEMA_ABOUT)
    machine: str = Field(description="name of the machine")
    version: str = Field(description="version of daqsvc")
    uptime_s: float = Field(description="how long the service has been running, in s")
    buses: dict[str, BusPayload] = Field(description="the buses, by name")
    streams: dict[str, StreamPayload] = Field(description="the streams, by name")
    channels: tuple[ChannelPayload, ...] = Field(description="the channels with their newest samples")
    statements: tuple[StatementPayload, ...] = Field(description="the last statement of each detector")
    alarms: AlarmsPayload = Field(description="the state of the alarms")
    outbox: OutboxPayload = Field(description="what waits for the broker and for the disk")
    outputs: dict[str, OutputPayload] = Field(description="by table; empty if the machine file has none")
    faults: dict[str, dict[str, dict[str, int]]] = Field(
        description="what was lost or went wrong since the start: by kind, name and cause; none that is 0"
    )
    figures: Figures = Field(description="every figure of the service, as in daqsvc.status/1")
