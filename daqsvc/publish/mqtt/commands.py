"""Commands from the broker: examined, authorised, carried out by somebody else, answered.

Whoever may publish below ``<box>/<machine>/commands/<verb>`` may ask for that; which verbs are taken at all
is in the machine file. So the broker's access list decides who, and the box what.
"""

from __future__ import annotations

import asyncio
import errno
import json
import logging
import re
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias, get_args

from pydantic import AwareDatetime, Field, ValidationError

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.alarms.commands import (
    CommandMessage,
    CommandOutcome,
    DurationS,
    JsonCommand,
    Line,
    MachineVerb,
    Person,
    Reason,
    SnapshotRequest,
    Verb,
    faults_of,
)
from daqsvc.errors.code import coded
from daqsvc.errors.command_line import COMMAND_REFUSED, NO_SUCH_MACHINE, NOT_ASKED
from daqsvc.errors.outputs import COMMAND_NOT_OBEYED
from daqsvc.errors.service import DISK_REFUSES, NOT_REMEMBERED
from daqsvc.outbox.command_ids import REMEMBERED
from daqsvc.publish.payloads import SCHEMA_ABOUT, Stamped, stamp_now
from daqsvc.publish.topics import ANSWER

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from daqsvc.acquisition.clock import Clock
    from daqsvc.alarms.commands import AlarmCommand, CommandHandler, SnapshotHandler
    from daqsvc.errors.code import Code
    from daqsvc.outbox.command_ids import CommandIds
    from daqsvc.publish.mqtt.connection import Incoming
    from daqsvc.publish.mqtt.settings import MqttCommands
    from daqsvc.publish.topics import CommandTopic, Topics

log = logging.getLogger(__name__)

QUIET_NS = 10 * NS_PER_S
"""After one refusal has been logged, further ones are not for so long."""

_SHOWN_ID = 64
_SHOWN_TOPIC = 200
_LONGEST_ANSWER_TOPIC = 256
_RESERVED = ("$", "daqsvc/", "homeassistant/", "spBv1.0/", "STATE/")
"""Where no answer goes, whatever its sender wants: where boxes speak, discovery by others, Sparkplug,
brokers."""

_SHOWN_FAULTS = 500
_VERBS = (*Verb, *MachineVerb)


CommandId: TypeAlias = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z0-9_.:-]{1,64}$",
        description="chosen by the sender, new for every command, e.g. a UUID",
    ),
]
IssuedAt: TypeAlias = Annotated[AwareDatetime, Field(description="when, ISO 8601 with the offset from UTC")]
ExpiresS: TypeAlias = Annotated[float, Field(gt=0)]
_EXPIRES = "how old the command may become, if less than the machine file allows"


class CommandPayload(CommandMessage):
    """One command; the topic names what is asked, and the machine."""

    schema_: Literal["daqsvc.command/1"] = Field(alias="schema", description=SCHEMA_ABOUT)
    id: CommandId
    alarm: Annotated[str, Field(pattern=r"^[A-Za-z0-9_./-]{1,200}$")] = Field(description="name of the alarm")
    by: Person = Field(description="who asks")
    issued_at: IssuedAt
    expires_s: ExpiresS | None = Field(default=None, description=_EXPIRES)
    duration_s: DurationS | None = Field(default=None, description="how long to shelve; for shelve only")
    occurrence: Annotated[Line, Field(min_length=1, max_length=64)] | None = Field(
        default=None, description="refuse the command if another activation is present by now"
    )
    reason: Reason = Field(default="", description="why")
    denied: Reason = Field(
        default="",
        description="why the sender has found that this person may not: it is logged, and refused",
    )


class SnapshotCommandPayload(JsonCommand):
    """A request for a snapshot; the topic names the machine."""

    schema_: Literal["daqsvc.snapshot-command/1"] = Field(alias="schema", description=SCHEMA_ABOUT)
    id: CommandId
    by: Person = Field(description="who asks")
    issued_at: IssuedAt
    expires_s: ExpiresS | None = Field(default=None, description=_EXPIRES)
    reason: Reason = Field(default="", description="why; the snapshot contains it")


class ResponsePayload(Stamped):
    """What came of a command."""

    schema_: Literal["daqsvc.response/1"] = Field(
        "daqsvc.response/1", alias="schema", description=SCHEMA_ABOUT
    )
    id: str | None = Field(description="id of the command; null if it could not be read")
    machine: str = Field(description="name of the machine")
    verb: str = Field(description="what was asked")
    accepted: bool = Field(description="whether it was carried out")
    reason: str = Field(description="why it was refused, or why a restart may undo it; empty if neither")
    code: str | None = Field(None, description="code of that reason; null if there is none")
    events: tuple[str, ...] = Field(description="ids of the alarm events that followed")
    path: str = Field(default="", description="file of the snapshot on the box; empty if none was made")


class CommandRefusedError(Exception):
    """A command that is not even examined by the alarms; the text states why.

    Attributes:
        code: of that.
    """

    def __init__(self, why: str, code: Code = COMMAND_NOT_OBEYED) -> None:
        super().__init__(why)
        self.code = code


@dataclass(slots=True)
class IntakeCounters:
    """What became of the commands that came over the broker.

    Attributes:
        accepted: carried out.
        refused: refused by the alarms, e.g. a reset while the condition stands.
        malformed: too large, not JSON, not a command of a known version, or on a topic without a verb.
        unauthorised: for a machine or a verb that the machine file does not allow.
        stale: too old, from the future, retained at the broker, here for the second time, or so many that
            a second time could not be known. Or from before a start that found the ids of commands lost.
        unwritten: refused because their id could not be recorded.
        unanswered: answers that the broker did not take.
    """

    accepted: int = 0
    refused: int = 0
    malformed: int = 0
    unauthorised: int = 0
    stale: int = 0
    unwritten: int = 0
    unanswered: int = 0


@dataclass(frozen=True, slots=True)
class Answer:
    """Where the answer to a command goes, and what it is.

    Attributes:
        topic: the sender's response topic (MQTT 5), or the command's own with ``/response``.
        payload: a `ResponsePayload` in JSON.
        correlation: what the sender wants to see again (MQTT 5).
    """

    topic: str
    payload: bytes
    correlation: bytes | None


class CommandIntake:
    """Takes the commands that come over the broker.

    Args:
        settings: what is allowed.
        machines: names of the machines that commands may be for.
        topics: the box.
        handler: carries out what is allowed.
        clock: its wall clock tells how old a command is.
        ids: those of the commands that have come.
        reserved: topics below which no answer goes, besides the box's own, e.g. a discovery prefix.
        snapshots: has snapshots made; None if there are none.
    """

    def __init__(
        self,
        settings: MqttCommands,
        machines: Collection[str],
        topics: Topics,
        handler: CommandHandler,
        clock: Clock,
        ids: CommandIds,
        reserved: Iterable[str] = (),
        snapshots: SnapshotHandler | None = None,
    ) -> None:
        self.counters = IntakeCounters()
        self._settings = settings
        self._machines = machines
        self._topics = topics
        self._handler = handler
        self._snapshots = snapshots
        self._clock = clock
        self._ids = ids
        self._reserved = (*_RESERVED, f"{topics.root}/", *(f"{prefix}/" for prefix in reserved))
        self._quiet_until_ns = clock.monotonic_ns()

    def lasts(self, message: Incoming) -> bool:
        """Whether what a message asks for takes a while: others must not wait for that."""
        topic = self._topics.command_of(message.topic)
        return topic is not None and not topic.is_answer and topic.verb == MachineVerb.SNAPSHOT

    async def take(self, message: Incoming) -> Answer | None:
        """Carry out the command of a message, or refuse it; the answer states which.

        Returns:
            The answer; None if the message is no command to this box, or the answer to one.
        """
        machine = self._topics.command_of(message.topic)
        if machine is None or machine.is_answer:
            return None
        try:
            command = await self._command(machine, message)
        except CommandRefusedError as refusal:
            self._log(message.topic, refusal)
            outcome = CommandOutcome(accepted=False, reason=str(refusal), code=refusal.code.id)
        else:
            outcome = await self._carried_out(command, f"mqtt {message.topic}")
            if outcome.accepted:
                self.counters.accepted += 1
            else:
                self.counters.refused += 1
        response = ResponsePayload(
            **stamp_now(self._topics.site, self._topics.box, self._clock),
            id=_id_of(message.payload[: self._settings.max_bytes]),
            machine=machine.machine[:_SHOWN_TOPIC],
            verb=machine.verb[:_SHOWN_TOPIC],
            accepted=outcome.accepted,
            reason=outcome.reason,
            code=outcome.code,
            events=outcome.events,
            path=outcome.path,
        )
        return Answer(self._answer_topic(message), response.to_json(), message.correlation)

    async def _carried_out(self, command: AlarmCommand | SnapshotRequest, source: str) -> CommandOutcome:
        if not isinstance(command, SnapshotRequest):
            return await self._handler(command, source)
        if self._snapshots is None:
            return CommandOutcome(
                accepted=False, reason="this service makes no snapshots", code=COMMAND_REFUSED.id
            )
        return await self._snapshots(command, source)

    def _log(self, topic: str, refusal: CommandRefusedError) -> None:
        """Log it, but not for each of a flood: the others are in the counters and the answers."""
        now_ns = self._clock.monotonic_ns()
        loud = now_ns >= self._quiet_until_ns
        level = logging.WARNING if loud else logging.DEBUG
        log.log(level, "command on %r refused: %s", topic[:_SHOWN_TOPIC], refusal, extra=coded(refusal.code))
        if loud:
            self._quiet_until_ns = now_ns + QUIET_NS

    async def _command(self, topic: CommandTopic, message: Incoming) -> AlarmCommand | SnapshotRequest:
        """What is asked.

        Raises:
            CommandRefusedError: it is not to be carried out.
        """
        machine, verb = topic.machine, topic.verb
        allowed = ", ".join(sorted(self._settings.allow)) or "nothing"
        if machine not in self._machines:
            self.counters.unauthorised += 1
            raise CommandRefusedError(
                f"this box takes no commands for machine {machine[:_SHOWN_TOPIC]!r}; it watches "
                f"{', '.join(self._machines)}",
                NO_SUCH_MACHINE,
            )
        if verb not in _VERBS:
            self.counters.malformed += 1
            raise CommandRefusedError(
                f"there is no verb {verb[:_SHOWN_TOPIC]!r}; the last part of a command's topic is one of "
                f"{', '.join(_VERBS)}"
            )
        if verb not in self._settings.allow:
            self.counters.unauthorised += 1
            raise CommandRefusedError(
                f"{verb!r} is not allowed over MQTT; allowed: {allowed}. Add it to mqtt.commands.allow in "
                "the machine file, or do it at the box"
            )
        request = self._read(message.payload, verb)
        if message.retain:
            self.counters.stale += 1
            raise CommandRefusedError(
                "it is retained at the broker and would come again with every connection; send it without "
                "retain"
            )
        self._check_age(request)
        await self._check_new(machine, request)
        if isinstance(request, SnapshotCommandPayload):
            return SnapshotRequest(machine=machine, by=request.by, reason=request.reason)
        return replace(request.command(Verb(verb), machine), denied=request.denied)

    def _read(self, asked: bytes, verb: str) -> CommandPayload | SnapshotCommandPayload:
        wanted = SnapshotCommandPayload if verb == MachineVerb.SNAPSHOT else CommandPayload
        if len(asked) > self._settings.max_bytes:
            self.counters.malformed += 1
            raise CommandRefusedError(
                f"it has {len(asked)} bytes; a command has at most {self._settings.max_bytes}"
            )
        try:
            return wanted.read(asked)
        except ValidationError as error:
            self.counters.malformed += 1
            # The names of unknown keys are the sender's: nothing of them may write a line into a log.
            faults = "; ".join(faults_of(error, "payload")[:5])
            shown = re.sub(r"[^ -~]", "?", faults)[:_SHOWN_FAULTS]
            [schema] = get_args(wanted.model_fields["schema_"].annotation)
            raise CommandRefusedError(f"it is no command of schema {schema}: {shown}") from error
        except ValueError as error:
            self.counters.malformed += 1
            raise CommandRefusedError(f"{error}") from error

    def _check_age(self, message: CommandPayload | SnapshotCommandPayload) -> None:
        now_ns = self._clock.wall_ns()
        age_s = now_ns / NS_PER_S - message.issued_at.timestamp()
        limit_s = self._settings.max_age_s
        oldest_s = min(message.expires_s or limit_s, limit_s)
        if -limit_s <= age_s <= oldest_s:
            return
        self.counters.stale += 1
        now = datetime.fromtimestamp(now_ns / NS_PER_S, UTC).isoformat(timespec="seconds")
        raise CommandRefusedError(
            f"it was issued {abs(age_s):.0f} s {'ago' if age_s > 0 else 'in the future'}, with at most "
            f"{oldest_s if age_s > 0 else limit_s:g} s allowed; the clock of the box shows {now}: "
            "send it again, or set the clocks"
        )

    async def _check_new(self, machine: str, message: CommandPayload | SnapshotCommandPayload) -> None:
        """Write down that this command has come; before it is carried out, for afterwards may be too late."""
        if self._ids.is_from_before(round(message.issued_at.timestamp() * NS_PER_S)):
            self.counters.stale += 1
            raise CommandRefusedError(
                "it was issued before the service started, and the list of earlier commands is lost, so it "
                "might be carried out twice; look at the alarm, and ask again with a new id",
                NOT_REMEMBERED,
            )
        too_old_s = message.issued_at.timestamp() + self._settings.max_age_s
        try:
            known = await asyncio.to_thread(
                self._ids.remember,
                machine,
                message.id,
                until_ns=round(too_old_s * NS_PER_S),
                now_ns=self._clock.wall_ns(),
            )
        except OSError as error:
            self.counters.unwritten += 1
            raise CommandRefusedError(
                f"its id cannot be stored ({error.strerror or error}), so it might be carried out twice: "
                f"{_remedy(error)}, then ask again",
                DISK_REFUSES,
            ) from error
        if known == "known":
            self.counters.stale += 1
            raise CommandRefusedError(
                f"a command with id {message.id!r} has come before; give every command its own id"
            )
        if known == "full":
            self.counters.stale += 1
            raise CommandRefusedError(
                f"there were {REMEMBERED} commands in a short time; ask again later", NOT_ASKED
            )

    def _answer_topic(self, message: Incoming) -> str:
        """Where the sender wants the answer, unless that would speak in the name of this box or of others.

        The box may publish what the sender may not: an answer must not become an alarm, or an entity.
        """
        own = f"{message.topic}/{ANSWER}"
        wanted = message.response_topic
        if not wanted or len(wanted) > _LONGEST_ANSWER_TOPIC or set(wanted) & set("+#"):
            return own
        if not wanted.isprintable():
            return own
        if wanted == own or wanted.startswith(f"{own}/"):
            return wanted
        return own if f"{wanted}/".startswith(self._reserved) else wanted


def _remedy(error: OSError) -> str:
    if error.errno == errno.EROFS:
        return "mount the disk of the box writable again"
    return "make room on the disk of the box"


def _id_of(asked: bytes) -> str | None:
    """The id of a command that may be malformed, so that its sender knows which one was refused."""
    try:
        message = json.loads(asked)
    except (ValueError, RecursionError):
        return None
    identifier = message.get("id") if isinstance(message, dict) else None
    if not isinstance(identifier, str):
        return None
    # JSON can express what no UTF-8 can: halves of surrogate pairs.
    return re.sub(r"[\ud800-\udfff]", "?", identifier[:_SHOWN_ID])
