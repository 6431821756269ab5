"""JSON payloads, each with its schema and version: what consumers may rely on.

A change that an old consumer would not survive gets a new version number; a new optional key does not.
"""

from __future__ import annotations

import json
import logging
import math
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, RootModel
from pydantic_core import to_json

from daqsvc.acquisition.clock import iso_utc
from daqsvc.alarms.codes import code_of_alarm
from daqsvc.alarms.events import AlarmEvent, Doubt, EventKind, Identity
from daqsvc.alarms.states import HOLDS, AlarmState, Level
from daqsvc.diagnosis.record import Diagnosis, Severity
from daqsvc.documentation import documented_in
from daqsvc.dsp.quality import Quality  # noqa: TC001 - pydantic reads it
from daqsvc.errors.code import coded
from daqsvc.errors.service import NOT_REMEMBERED
from daqsvc.outbox.messages import event_id

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from daqsvc.acquisition.clock import Clock
    from daqsvc.outbox.messages import OutboxMessage
    from daqsvc.publish.topics import Topics

log = logging.getLogger(__name__)


SCHEMA_ABOUT = "name and version of the payload"


def _finite_or_none(value: Any) -> Any:
    """JSON knows neither NaN nor infinity: what is not a finite number becomes null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


Number = Annotated[float | None, BeforeValidator(_finite_or_none)]
WholeOrNumber = Annotated[int | float | None, BeforeValidator(_finite_or_none)]


class JsonPayload(BaseModel):
    """What all payloads have in common."""

    model_config = ConfigDict(
        frozen=True,
        populate_by_name=True,
        use_enum_values=True,
        json_schema_serialization_defaults_required=True,
    )

    def to_json(self) -> bytes:
        """The payload as UTF-8 JSON."""
        return self.model_dump_json(by_alias=True).encode()


class Stamped(JsonPayload):
    """A payload with its origin and its time."""

    site: str = Field(description="the site, as the machine file names it")
    box: str = Field(description="the box, as the machine file names it")
    time: str = Field(description="ISO 8601, UTC, microseconds; a label, the wall clock may step")
    wall_ns: int = Field(description="the same instant in nanoseconds since 1970-01-01T00:00Z")
    monotonic_ns: int = Field(description="the same instant on the box's monotonic clock; orders events")


class WindowPayload(JsonPayload):
    """Which samples a statement rests on: absolute sample indices of the stream."""

    stream: str = Field(description="the stream whose samples are counted")
    first_index: int = Field(description="the first sample")
    end_index: int = Field(description="one past the last sample")


class _Statement(JsonPayload):
    detector: str = Field(description="name of the detector")
    decision: str = Field(description="what the detector has decided, e.g. normal or a mode")
    severity: Severity = Field(description="how bad that is")
    changed: bool = Field(description="whether the decision has changed")
    probabilities: dict[str, Number] = Field(description="by mode; empty if the detector has none")
    group: tuple[str, ...] = Field(description="modes that the evidence cannot tell apart")
    statistics: dict[str, Number] = Field(description="what was measured, by name")
    units: dict[str, str] = Field(description="units of the statistics that have one")
    thresholds: dict[str, Number] = Field(
        description="what the statistics and the evidence are compared with, by name"
    )
    evidence: dict[str, Number] = Field(description="log-likelihood ratios in nats")
    revolutions: Number = Field(description="shaft revolutions since the detector started")
    window: WindowPayload = Field(description="the samples that the statement rests on")
    quality: Quality = Field(
        description="whether the samples and sensors are good, samples are missing, or a sensor is not OK"
    )
    reason: str = Field(description="why the quality is not good; if it is, what to know of the decision")
    sensors: tuple[str, ...] = Field(description="names of the sensors that the statement rests on")
    model: str = Field(description="name and version of the model that it rests on")
    where: str = Field("", description="the part of the machine that it is about, e.g. a bearing; or empty")
    missing_share: Number = Field(
        None,
        description="share of the window's samples that are missing; null if the detector does not state it",
    )
    bounds: dict[str, tuple[Number, Number]] = Field(
        {},
        description="of statistics that missing samples make uncertain: lowest, highest; null: no end",
    )


class CausePayload(_Statement):
    """The diagnosis behind an alarm event."""

    monotonic_ns: int = Field(description="when the last sample of the window was taken")


class PreviousPayload(JsonPayload):
    """The state of the alarm before the event."""

    state: AlarmState = Field(description="state before the event")
    level: Severity = Field(description="level before the event")


class DoubtPayload(JsonPayload):
    """What a detector has against a sensor."""

    detector: str = Field(description="name of the detector")
    quality: Quality = Field(description="its last quality")
    not_ok: bool = Field(description="whether it stated not_ok since it was last good")
    reason: str = Field(description="why, in a sentence")
    sensors: tuple[str, ...] = Field(description="names of the sensors that it is about")


class AlarmPayload(Stamped):
    """One event of one alarm; the latest one is the alarm's state."""

    schema_: Literal["daqsvc.alarm/1"] = Field("daqsvc.alarm/1", alias="schema", description=SCHEMA_ABOUT)
    id: str = Field(description="unique; a message that comes twice has the same id")
    sequence: int = Field(description="rises from event to event of the box, never used twice")
    machine: str = Field(description="name of the machine")
    alarm: str = Field(description="name of the alarm")
    occurrence: str | None = Field(description="id of the activation; null if normal before and after")
    kind: EventKind = Field(description="why the event was sent")
    state: AlarmState = Field(description="state of the alarm after the event")
    level: Severity = Field(description="how bad it is; of a latching alarm the worst since it was raised")
    previous: PreviousPayload = Field(description="state and level before the event")
    message: str = Field(description="the event in a sentence")
    by: str = Field(description="the person who asked for it; empty if the data or time did it")
    reason: str = Field("", description="why, in that person's words")
    code: str | None = Field(
        None,
        description="code of what is wrong with data or service; null for other alarms, and when over",
    )
    holds: tuple[AlarmState, ...] = Field((), description="what covers the alarm, strongest first")
    covered: AlarmState | None = Field(None, description="the state below; null if nothing covers it")
    shelved_until_wall_ns: int | None = Field(None, description="when shelving ends; null if not shelved")
    first_out: bool = Field(default=False, description="whether it was the first active alarm of its group")
    chattering: bool = Field(
        default=False, description="whether it is raised and returns so often that returns are held back"
    )
    found: str = Field("", description="what is found, joined with what it is not told apart from by |")
    found_message: str = Field(
        "",
        description="message of the last event that stated what is found; empty if this one's message does, "
        "or if that is not known",
    )
    doubts: tuple[DoubtPayload, ...] = Field(
        (), description="of a quality alarm: what is wrong with the sensor"
    )
    cause: CausePayload = Field(description="the statement of a detector behind the event")


class DiagnosisPayload(Stamped, _Statement):
    """One statement of one detector."""

    schema_: Literal["daqsvc.diagnosis/1"] = Field(
        "daqsvc.diagnosis/1", alias="schema", description=SCHEMA_ABOUT
    )
    machine: str = Field(description="name of the machine")


class Figures(RootModel[dict[str, "WholeOrNumber | str | Figures"]]):
    """Numbers by name, words for states, or groups of them."""


class StatusPayload(Stamped):
    """Figures of the service itself, nested by what they belong to."""

    schema_: Literal["daqsvc.status/1"] = Field("daqsvc.status/1", alias="schema", description=SCHEMA_ABOUT)
    machines: tuple[str, ...] = Field((), description="those that the box watches, by their names in topics")
    figures: Figures = Field(
        description="figures of the service, by what they belong to: see "
        f"{documented_in('reference/counters')}"
    )


class AvailabilityPayload(Stamped):
    """Whether the box is there; in a last will, the time is that of the connection that it belongs to."""

    schema_: Literal["daqsvc.availability/1"] = Field(
        "daqsvc.availability/1", alias="schema", description=SCHEMA_ABOUT
    )
    state: Literal["online", "offline"] = Field(description="whether the box is online")
    reason: str = Field(description="why: connected, stopped, or connection lost")


def alarm_payload(event: AlarmEvent, sequence: int, series: str) -> AlarmPayload:
    """The payload of an alarm event that the outbox has given ``sequence`` in ``series``."""
    return AlarmPayload.model_validate(_alarm(event, sequence, series))


def alarm_json(event: AlarmEvent, sequence: int, series: str) -> bytes:
    """`alarm_payload` as UTF-8 JSON, in half the time: what this program made needs no validation."""
    return to_json(_alarm(event, sequence, series), inf_nan_mode="null")


def _alarm(event: AlarmEvent, sequence: int, series: str) -> dict[str, Any]:
    """An `AlarmPayload` as a dictionary: every key, in order, and of types that JSON knows."""
    identity = event.identity
    return {
        **_stamp(identity.site, identity.box, event.t_ns, event.wall_ns),
        "schema": "daqsvc.alarm/1",
        "id": event_id(series, sequence),
        "sequence": sequence,
        "machine": identity.machine,
        "alarm": event.alarm,
        "occurrence": event.occurrence,
        "kind": event.kind.value,
        "state": event.to_state.value,
        "level": event.to_level.label,
        "previous": {"state": event.from_state.value, "level": event.from_level.label},
        "message": event.message,
        "by": event.by,
        "reason": event.reason,
        "code": _code(event),
        "holds": [hold.value for hold in event.holds],
        "covered": event.covered and event.covered.value,
        "shelved_until_wall_ns": event.shelved_until_wall_ns,
        "first_out": event.first_out,
        "chattering": event.chattering,
        "found": event.finding,
        "found_message": event.found,
        "doubts": [doubt._asdict() for doubt in event.doubts],
        "cause": _statement(event.cause) | {"monotonic_ns": event.cause.t_ns},
    }


def _code(event: AlarmEvent) -> str | None:
    code = code_of_alarm(event.alarm, event.cause.quality) if event.to_level else None
    return None if code is None else code.id


def alarm_event(payload: bytes) -> AlarmEvent:
    """The event that an alarm payload reports; what JSON could not express is NaN.

    Raises:
        ValueError: it is no alarm payload of this version, or one that no event of this program has.
    """
    message = AlarmPayload.model_validate_json(payload)
    state, previous = AlarmState(message.state), AlarmState(message.previous.state)
    kind = EventKind(message.kind)
    holds, covered = tuple(map(AlarmState, message.holds)), message.covered and AlarmState(message.covered)
    if kind is EventKind.SUPPRESSED and not holds:
        # Before holds were reported one by one there was this one only, laid over the state before.
        holds, covered = (AlarmState.SUPPRESSED,), previous
    shown = holds[0] if holds else state
    if (
        not HOLDS.issuperset(holds)
        or shown is not state
        or (state in HOLDS) != (covered is not None)
        or covered in HOLDS
        or (AlarmState.SHELVED in holds) != (message.shelved_until_wall_ns is not None)
    ):
        raise ValueError(f"an event {kind} from {previous} to {state} is none of this program's")
    return AlarmEvent(
        identity=Identity(message.site, message.box, message.machine),
        alarm=message.alarm,
        occurrence=message.occurrence,
        kind=kind,
        from_state=previous,
        to_state=state,
        from_level=Level.of(message.previous.level),
        to_level=Level.of(message.level),
        t_ns=message.monotonic_ns,
        wall_ns=message.wall_ns,
        cause=_diagnosis(message.machine, message.cause),
        message=message.message,
        by=message.by,
        reason=message.reason,
        holds=holds,
        covered=covered,
        shelved_until_wall_ns=message.shelved_until_wall_ns,
        first_out=message.first_out,
        chattering=message.chattering,
        finding=message.found,
        doubts=tuple(Doubt(**dict(doubt)) for doubt in message.doubts),
        found=message.found_message,
    )


def alarm_document(event: AlarmEvent) -> dict[str, Any]:
    """An alarm event as a dictionary of what JSON knows, without a number; `alarm_event` reads its JSON."""
    return _alarm(event, 0, "")


def statement_document(diagnosis: Diagnosis) -> dict[str, Any]:
    """A diagnosis as a dictionary of what JSON knows, without a stamp."""
    return {"machine": diagnosis.machine, "monotonic_ns": diagnosis.t_ns, **_statement(diagnosis)}


def recorded_statement(document: Mapping[str, Any]) -> Diagnosis:
    """The diagnosis that `statement_document` has written; what JSON could not express is NaN.

    Raises:
        ValueError: it has none.
    """
    statement = {key: one for key, one in document.items() if key != "machine"}
    return _diagnosis(str(document.get("machine")), CausePayload.model_validate_json(json.dumps(statement)))


def diagnosis_payload(identity: Identity, diagnosis: Diagnosis, clock: Clock) -> DiagnosisPayload:
    """The payload of a diagnosis, stamped with the time of its last sample."""
    wall_ns = clock.wall_ns() - clock.monotonic_ns() + diagnosis.t_ns
    return DiagnosisPayload(
        **_stamp(identity.site, identity.box, diagnosis.t_ns, wall_ns),
        **_statement(diagnosis),
        machine=identity.machine,
    )


def status_payload(
    site: str, box: str, figures: Mapping[str, Any], clock: Clock, machines: Iterable[str] = ()
) -> StatusPayload:
    """The payload of the service's figures as they are now.

    Args:
        site: name of the site.
        box: name of the box.
        figures: numbers, or mappings of numbers, by name.
        clock: for the stamp.
        machines: names of those that the service watches.

    Raises:
        pydantic.ValidationError: a figure is neither a number nor a mapping of numbers.
    """
    return StatusPayload(
        **stamp_now(site, box, clock), machines=tuple(machines), figures=Figures.model_validate(figures)
    )


def availability_payload(
    site: str, box: str, state: Literal["online", "offline"], reason: str, clock: Clock
) -> AvailabilityPayload:
    """The payload that states whether the box is there, and why."""
    return AvailabilityPayload(**stamp_now(site, box, clock), state=state, reason=reason)


def _stamp(site: str, box: str, t_ns: int, wall_ns: int) -> dict[str, Any]:
    return {
        "site": site,
        "box": box,
        "time": iso_utc(wall_ns),
        "wall_ns": wall_ns,
        "monotonic_ns": t_ns,
    }


def stamp_now(site: str, box: str, clock: Clock) -> dict[str, Any]:
    """The keys of `Stamped` as of now."""
    return _stamp(site, box, clock.monotonic_ns(), clock.wall_ns())


def _statement(diagnosis: Diagnosis) -> dict[str, Any]:
    """A `_Statement` as a dictionary: every key, in order; numbers of NumPy become Python's."""
    return {
        "detector": diagnosis.detector,
        "decision": diagnosis.decision,
        "severity": diagnosis.severity,
        "changed": bool(diagnosis.changed),
        "probabilities": _floats(diagnosis.probabilities),
        "group": tuple(diagnosis.group),
        "statistics": _floats(diagnosis.statistics),
        "units": dict(diagnosis.units),
        "thresholds": _floats(diagnosis.thresholds),
        "evidence": _floats(diagnosis.evidence),
        "revolutions": _float(diagnosis.revolutions),
        "window": {
            "stream": diagnosis.stream,
            "first_index": int(diagnosis.first_index),
            "end_index": int(diagnosis.end_index),
        },
        "quality": diagnosis.quality,
        "reason": diagnosis.reason,
        "sensors": tuple(diagnosis.sensors),
        "model": diagnosis.model,
        "where": diagnosis.where,
        "missing_share": _float(diagnosis.missing_share),
        "bounds": {name: (_float(low), _float(high)) for name, (low, high) in diagnosis.bounds.items()},
    }


def _float(value: float | None) -> float | None:
    return None if value is None else float(value)


def _floats(values: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items()}


def _diagnosis(machine: str, cause: CausePayload) -> Diagnosis:
    return Diagnosis(
        machine=machine,
        detector=cause.detector,
        t_ns=cause.monotonic_ns,
        stream=cause.window.stream,
        first_index=cause.window.first_index,
        end_index=cause.window.end_index,
        decision=cause.decision,
        changed=cause.changed,
        severity=cause.severity,
        probabilities=_or_nan(cause.probabilities),
        group=cause.group,
        statistics=_or_nan(cause.statistics),
        units=cause.units,
        thresholds=_or_nan(cause.thresholds),
        evidence=_or_nan(cause.evidence),
        revolutions=cause.revolutions,
        quality=cause.quality,
        reason=cause.reason,
        sensors=cause.sensors,
        model=cause.model,
        where=cause.where,
        missing_share=cause.missing_share,
        bounds={name: _ends(*ends) for name, ends in cause.bounds.items()},
    )


def _ends(low: float | None, high: float | None) -> tuple[float, float]:
    return -math.inf if low is None else low, math.inf if high is None else high


def _or_nan(figures: Mapping[str, float | None]) -> dict[str, float]:
    return {name: math.nan if value is None else value for name, value in figures.items()}


def restore_alarms(messages: Iterable[OutboxMessage], topics: Topics) -> list[AlarmEvent]:
    """The events that the alarm messages of a box report, in their order.

    Messages below other topics are left alone. What cannot be read is left out and logged, once for all.

    Args:
        messages: from `Outbox.latest`.
        topics: the box.
    """
    events: list[AlarmEvent] = []
    unread: list[str] = []
    for message in messages:
        if not (message.topic.startswith(f"{topics.base}/") and "/alarms/" in message.topic):
            continue
        try:
            events.append(_event(message, topics))
        except ValueError as error:
            unread.append(f"{message.sequence} of {message.topic} ({_in_short(error)})")
    if unread:
        log.warning(
            "%d alarm states of the journal cannot be read; these alarms start from normal: %s",
            len(unread),
            "; ".join(unread),
            extra=coded(NOT_REMEMBERED),
        )
    return events


def _event(message: OutboxMessage, topics: Topics) -> AlarmEvent:
    event = alarm_event(message.payload)
    if message.topic != topics.alarm(event.identity.machine, event.alarm):
        raise ValueError(f"it is about {event.alarm!r} of {event.identity.machine!r}")
    return event


def _in_short(error: ValueError) -> str:
    """The first of the problems that are found in a payload, in one line."""
    return " ".join(line.strip() for line in str(error).splitlines()[:3])
