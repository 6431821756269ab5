"""What is known of the boxes of a plant by what they have published: availability, alarms, diagnoses."""

from __future__ import annotations

import json
import logging
import time
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from daqsvc.acquisition.clock import iso_utc
from daqsvc.errors.code import coded
from daqsvc.errors.outputs import NOT_SHOWN
from daqsvc.live_feed import SCHEMA
from daqsvc.page.text import BETWEEN
from daqsvc.publish.payloads import AlarmPayload, AvailabilityPayload, DiagnosisPayload
from daqsvc.publish.topics import box_topic, is_one_part

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from daqsvc.publish.mqtt.connection import Incoming

    Document = dict[str, Any]

log = logging.getLogger(__name__)

SAYS_NOTHING_S = 15.0
"""A box that is there tells its status each second."""
MOST_BOXES = 2000
MOST_MACHINES = 200
"""Of a box."""
MOST_NAMES = 10_000
"""Alarms, and detectors, of a machine."""
MOST_EVENTS = 200
LARGEST = 256 * 1024
"""Bytes of a message that is kept."""
MOST_BYTES = 300_000_000
"""Of the messages that are kept, of all boxes."""


@dataclass(slots=True)
class KnownMachine:
    """What a machine's box has published of it.

    Attributes:
        site: of the box.
        box: its name.
        machine: its own.
        alarms: the last event of each alarm.
        events: those heard, as they came, oldest first.
        statements: the last one of each detector, as it came.
        hearing: who receives each line as it comes, by `daqsvc.live_feed`.
    """

    site: str
    box: str
    machine: str
    alarms: dict[str, Document] = field(default_factory=dict)
    events: deque[bytes] = field(default_factory=lambda: deque(maxlen=MOST_EVENTS))
    statements: dict[str, bytes] = field(default_factory=dict)
    hearing: list[Callable[[Document], None]] = field(default_factory=list)

    @property
    def name(self) -> str:
        """What it is called here."""
        return BETWEEN.join((self.site, self.box, self.machine))

    def about(self) -> Document:
        """The first line of a `daqsvc.live_feed` of it: no samples, for want of the machine file."""
        statements = [one for one in map(_statement, [*self.statements.values()]) if one is not None]
        nothing = {"wall_ns": 0, "monotonic_ns": 0}
        # The newest: an older one may be of before the box was booted.
        stamped = max(
            [*self.alarms.values(), *statements], key=lambda one: int(one["wall_ns"]), default=nothing
        )
        return {
            "schema": SCHEMA,
            "machine": self.machine,
            "begun_ns": 0,
            "wall_ns_at_0": stamped["wall_ns"] - stamped["monotonic_ns"],
            "streams": {},
            "values": {"machine": {"name": self.machine}},
            "statements": statements,
            "alarms": [*self.alarms.values()],
            "standings": {},
        }


@dataclass(slots=True)
class KnownBox:
    """A box that has published something.

    Attributes:
        site: its site.
        box: its name.
        state: ``"online"``, ``"offline"``, or ``""`` while that is not known.
        why: the reason that it gives.
        since: when that was so, ISO 8601.
        known_s: when something of it was heard first, which may be old, by `time.monotonic`.
        heard_s: when it sent something that was not kept at the broker, by `time.monotonic`.
        heard_utc: the same, ISO 8601.
        machines: by their names.
    """

    site: str
    box: str
    state: str = ""
    why: str = ""
    since: str = ""
    known_s: float = field(default_factory=time.monotonic)
    heard_s: float | None = None
    heard_utc: str = ""
    machines: dict[str, KnownMachine] = field(default_factory=dict)

    @property
    def away(self) -> str:
        """Why nothing comes of it at present; empty if something does."""
        if self.state == "offline":
            return f"the box is offline since {self.since[:19]}Z ({self.why})"
        last_s = self.known_s if self.heard_s is None else self.heard_s
        if time.monotonic() - last_s > SAYS_NOTHING_S:
            return f"the box has sent nothing since {self.heard_utc or 'this page listens'}"
        return ""


class KnownPlant:
    """The boxes below one root of topics.

    Args:
        root: first part of their topics.
    """

    def __init__(self, root: str) -> None:
        self.boxes: dict[tuple[str, str], KnownBox] = {}
        self._root = root
        self._has_warned = False
        self._bytes = 0

    def machine(self, name: str) -> tuple[KnownBox, KnownMachine] | None:
        """A machine by what it is called here; None if nothing was heard of it."""
        site, _, rest = name.partition(BETWEEN)
        box, _, machine = rest.partition(BETWEEN)
        known = self.boxes.get((site, box))
        known_machine = None if known is None else known.machines.get(machine)
        return None if known is None or known_machine is None else (known, known_machine)

    def take(self, message: Incoming) -> None:
        """Take in a message; what is none of a box, or not as it should be, is left out."""
        topic = box_topic(self._root, message.topic)
        if topic is None or len(message.payload) > LARGEST:
            return
        box = self.boxes.get((topic.site, topic.box))
        if box is None:
            if len(self.boxes) >= MOST_BOXES:
                return
            box = self.boxes[topic.site, topic.box] = KnownBox(topic.site, topic.box)
        if not message.retain:
            box.heard_s = time.monotonic()
            box.heard_utc = f"{iso_utc(time.time_ns())[:19]}Z"
        try:
            if topic.rest == ("availability",):
                _note_availability(box, message.payload)
            elif topic.rest == ("status",):
                _note_machines(box, message.payload)
            elif len(topic.rest) == 3:
                self._note_of_machine(box, topic.rest, message.payload)
        except (ValueError, TypeError, LookupError, RecursionError) as error:
            level = logging.DEBUG if self._has_warned else logging.WARNING
            self._has_warned = True
            log.log(
                level,
                "what came on %.200r cannot be read and is left out: %.200s",
                message.topic,
                error,
                extra=coded(NOT_SHOWN),
            )

    def _note_of_machine(self, box: KnownBox, rest: tuple[str, ...], payload: bytes) -> None:
        name, kind, what = rest
        if kind not in {"alarms", "diagnosis"}:
            return
        machine = _machine_of(box, name)
        if machine is None:
            return
        if kind == "diagnosis":
            if self._has_room(machine.statements, what, payload):
                machine.statements[what] = payload
            if machine.hearing and (statement := _statement(payload)) is not None:
                _tell(machine, {"statement": statement})
            return
        if not payload:
            machine.alarms.pop(what, None)  # taken away at the broker
            return
        known = AlarmPayload.model_validate_json(payload)
        numbers = {"sequence": known.sequence, "wall_ns": known.wall_ns, "monotonic_ns": known.monotonic_ns}
        event = json.loads(payload) | numbers
        before = machine.alarms.get(what)
        if before is not None and (
            event["sequence"] <= before["sequence"] and event["wall_ns"] <= before["wall_ns"]
        ):
            return  # it has come again
        if self._has_room(machine.alarms, what, payload):
            machine.alarms[what] = event
            machine.events.append(payload)
            _tell(machine, {"alarm": event})

    def _has_room(self, known: Mapping[str, object], what: str, payload: bytes) -> bool:
        """Whether a message may be kept: of one that is known there is the last one only."""
        if what in known:
            return True
        if len(known) >= MOST_NAMES or self._bytes + len(payload) > MOST_BYTES:
            return False
        self._bytes += len(payload)
        return True


def _note_availability(box: KnownBox, payload: bytes) -> None:
    availability = AvailabilityPayload.model_validate_json(payload)
    box.state, box.why, box.since = availability.state, availability.reason, availability.time


def _note_machines(box: KnownBox, payload: bytes) -> None:
    document = json.loads(payload)
    names = document.get("machines", ()) if isinstance(document, dict) else ()
    for name in names if isinstance(names, list) else ():
        if isinstance(name, str) and is_one_part(name):
            _machine_of(box, name)


def _machine_of(box: KnownBox, name: str) -> KnownMachine | None:
    """A machine of a box; None if there is no room for it."""
    if name not in box.machines and len(box.machines) < MOST_MACHINES:
        box.machines[name] = KnownMachine(box.site, box.box, name)
    return box.machines.get(name)


def _tell(machine: KnownMachine, line: Document) -> None:
    for hear in machine.hearing:
        hear(line)


def _statement(payload: bytes) -> Document | None:
    """A diagnosis; None if it is none."""
    try:
        DiagnosisPayload.model_validate_json(payload)
    except ValueError:
        return None
    statement: Document = json.loads(payload)
    return statement
