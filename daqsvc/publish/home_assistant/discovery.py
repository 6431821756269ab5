"""What Home Assistant gets, so that a machine shows up there by itself.

One retained message per machine describes the device with all its entities (MQTT integration of Home
Assistant, "device discovery payload", 2024.11 and later). States come from the topics that every other
consumer reads too; the templates only pick keys.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import daqsvc
from daqsvc.alarms.commands import Verb
from daqsvc.alarms.states import AlarmState, Level
from daqsvc.diagnosis.reading import STALE_S
from daqsvc.publish.home_assistant.readings import digits_of
from daqsvc.rounding import unit_behind

if TYPE_CHECKING:
    from collections.abc import Mapping

    from daqsvc.diagnosis.reading import Reading
    from daqsvc.publish.home_assistant.settings import HomeAssistant
    from daqsvc.publish.mqtt.settings import MqttCommands
    from daqsvc.publish.output import Watched
    from daqsvc.publish.topics import Topics

_UNITS = {"um": "µm", "m/s2": "m/s²", "mm/s2": "mm/s²", "deg": "°", "degC": "°C", "degF": "°F"}
"""Units as Home Assistant writes them, where that differs."""

_CLASSES = {"mm/s": "speed", "V": "voltage", "degC": "temperature", "degF": "temperature"}
"""Device classes of Home Assistant that know the unit; it has none for micrometres or g."""

_ABOUT = {"sensor-ok/": "sensor fault", "detector-ok/": "detector fault"}
"""Alarms that are called after what is well while they are not raised, and what a person reads instead."""

_MISSED = 2.5
"""Number of missed reports after which a figure is no longer true."""

_BUTTONS = {Verb.ACKNOWLEDGE: "mdi:check", Verb.RESET: "mdi:restore"}
"""What can be done with an alarm by one press, and how that is drawn."""

_COMMAND_ID = "ha-{{ utcnow().timestamp() }}-{{ '%05d' % (range(100000) | random) }}"
"""A template for an id that no other press has."""

MOST_REMOVED = 1000
"""Entities of an earlier message that are removed at a time."""

_ENTITY = re.compile(r"[!-~]{1,300}")
_PLATFORM = re.compile(r"[a-z_]{1,40}")


@dataclass(frozen=True, slots=True)
class Discovery:
    """The discovery message of a machine.

    Args:
        settings: where, and how often figures are sent.
        commands: what may be asked over the broker: these have buttons.
        watched: what there is to tell.
        topics: the box.
    """

    settings: HomeAssistant
    commands: MqttCommands
    watched: Watched
    topics: Topics

    @property
    def topic(self) -> str:
        """Where Home Assistant looks for it."""
        return f"{self.settings.prefix}/device/{self._object_id}/config"

    @property
    def birth_topic(self) -> str:
        """Where Home Assistant states that it has started."""
        return f"{self.settings.prefix}/status"

    def payload(self) -> dict[str, Any]:
        """The device with all its entities."""
        watched = self.watched
        return {
            "device": {
                "identifiers": [self._id],
                # Entities are called after it, and two boxes may both watch a "pump".
                "name": f"{watched.machine} ({self.topics.site}/{self.topics.box})",
                "manufacturer": "daqsvc",
                "model": watched.description or "rotating machine",
                "sw_version": daqsvc.__version__,
            },
            "origin": {"name": "daqsvc", "sw_version": daqsvc.__version__},
            "availability": [
                {
                    "topic": self.topics.availability,
                    "value_template": "{{ value_json.state }}",
                    "payload_available": "online",
                    "payload_not_available": "offline",
                }
            ],
            "qos": 1,
            "components": self._components(),
        }

    def removals(self, earlier: bytes) -> dict[str, dict[str, str]]:
        """What an earlier message had and this one has not: each with its platform alone, which removes it.

        Args:
            earlier: payload of the message that is retained at the broker; anything but a discovery
                message counts as none.
        """
        try:
            payload = json.loads(earlier)
        except (ValueError, RecursionError):
            return {}
        entities = payload.get("components") if isinstance(payload, dict) else None
        if not isinstance(entities, dict):
            return {}
        now = self._components()
        removals: dict[str, dict[str, str]] = {}
        for name, entity in entities.items():
            platform = entity.get("platform") if isinstance(entity, dict) else None
            # Whoever may write there may have retained anything: only what a box can have sent is repeated.
            if name in now or not (isinstance(platform, str) and _PLATFORM.fullmatch(platform)):
                continue
            if _ENTITY.fullmatch(name) and len(removals) < MOST_REMOVED:
                removals[name] = {"platform": platform}
        return removals

    @property
    def _id(self) -> str:
        return f"{self.topics.base}/{self.watched.machine}"

    @property
    def _object_id(self) -> str:
        return _safe_id(self._id)

    @property
    def _buttons(self) -> tuple[Verb, ...]:
        """What a person may do with an alarm from there: of what needs one press, what the box obeys."""
        allowed = self.commands.allow if self.commands.enabled else ()
        return tuple(verb for verb in _BUTTONS if verb in allowed)

    def _components(self) -> dict[str, dict[str, Any]]:
        made: dict[str, dict[str, Any]] = {}
        for alarm in self.watched.alarms:
            made[f"alarm/{alarm}"] = self._problem(alarm)
            made[f"level/{alarm}"] = self._level(alarm)
            made[f"state/{alarm}"] = self._state(alarm)
            made |= {f"{verb}/{alarm}": self._button(verb, alarm) for verb in self._buttons}
        for alarm in self.watched.services:
            made[f"alarm/{alarm}"] = {**self._problem(alarm), "entity_category": "diagnostic"}
        for detector in self.watched.findings:
            made[f"finding/{detector}"] = self._finding(detector)
        for reading in self.watched.readings:
            made[f"{reading.kind}/{reading.detector}/{reading.key}"] = self._sensor(reading)
        return {
            _safe_id(name): {**entity, "unique_id": f"{self._id}/{name}"}
            for name, entity in sorted(made.items())
        }

    def _problem(self, alarm: str) -> dict[str, Any]:
        summary = self.topics.summary(self.watched.machine)
        return {
            "platform": "binary_sensor",
            "name": _in_words(alarm),
            "device_class": "problem",
            "state_topic": summary,
            "value_template": _pick("alarms", alarm, "problem"),
            "json_attributes_topic": summary,
            "json_attributes_template": _pick("alarms", alarm, as_json=True),
        }

    def _level(self, alarm: str) -> dict[str, Any]:
        return {
            "platform": "sensor",
            "name": f"{alarm} level",
            "device_class": "enum",
            "options": [level.label for level in Level],
            "state_topic": self.topics.summary(self.watched.machine),
            # The level of an alarm that is covered, or that cannot be judged, is not "normal" but unknown.
            "value_template": _pick("alarms", alarm, "level", default="problem"),
        }

    def _state(self, alarm: str) -> dict[str, Any]:
        return {
            "platform": "sensor",
            "name": f"{alarm} alarm state",
            "device_class": "enum",
            "options": [state.value for state in AlarmState],
            "state_topic": self.topics.summary(self.watched.machine),
            "value_template": _pick("alarms", alarm, "state"),
        }

    def _button(self, verb: Verb, alarm: str) -> dict[str, Any]:
        command = {
            "schema": "daqsvc.command/1",
            "id": _COMMAND_ID,
            "alarm": alarm,
            "by": "Home Assistant",
            "issued_at": "{{ utcnow().isoformat() }}",
        }
        return {
            "platform": "button",
            "name": f"{verb} {alarm}",
            "icon": _BUTTONS[verb],
            "command_topic": self.topics.command(self.watched.machine, verb),
            "command_template": json.dumps(command),
        }

    def _finding(self, detector: str) -> dict[str, Any]:
        return {
            "platform": "sensor",
            "name": f"{detector} finding",
            "icon": "mdi:stethoscope",
            "state_topic": self.topics.readings(self.watched.machine, detector),
            "value_template": _pick("finding"),
            "expire_after": self._stale_s(STALE_S),
        }

    def _stale_s(self, stale_s: int) -> int:
        return max(stale_s, math.ceil(_MISSED * self.settings.every_s))

    def _sensor(self, reading: Reading) -> dict[str, Any]:
        made: dict[str, Any] = {
            "platform": "sensor",
            "name": f"{reading.detector} {reading.key.replace('_', ' ')}",
            "state_class": "measurement",
            "state_topic": self.topics.readings(self.watched.machine, reading.detector),
            "value_template": _pick(reading.kind, reading.key),
            "expire_after": self._stale_s(reading.stale_s),
            "suggested_display_precision": digits_of(reading.unit),
        }
        made |= _in_home_assistant(reading.unit)
        return made


def _safe_id(name: str) -> str:
    """The name in the letters, digits, "_" and "-" that Home Assistant allows in ids; no two become one."""
    return re.sub(r"[^A-Za-z0-9-]", lambda match: f"_{ord(match[0]):02x}", name)


def _in_home_assistant(unit: str) -> Mapping[str, str]:
    """Unit and device class as Home Assistant knows them; a plain number has none."""
    if not unit_behind(unit):
        return {}
    named = {"unit_of_measurement": _UNITS.get(unit, unit)}
    return {**named, "device_class": _CLASSES[unit]} if unit in _CLASSES else named


def _pick(*keys: str, as_json: bool = False, default: str = "") -> str:
    """A template for one key below others; ``None`` where there is none, which is shown as unknown.

    Args:
        keys: the way to it.
        as_json: pick what is a group of keys itself.
        default: a key beside it without which there is nothing to show.
    """
    *above, last = keys
    group = "value_json" + "".join(f"[{_quoted(key)}]" for key in above)
    condition = f" if {group}.get({_quoted(default)}) else None" if default else ""
    return f"{{{{ {group}.get({_quoted(last)}){' | tojson' if as_json else ''}{condition} }}}}"


def _in_words(alarm: str) -> str:
    """What an alarm is called where *problem* is beside it."""
    for prefix, what in _ABOUT.items():
        if alarm.startswith(prefix):
            return f"{alarm.removeprefix(prefix)} {what}"
    return alarm


def _quoted(key: str) -> str:
    """A name as a string of Jinja; names hold neither quotes nor backslashes (`daqsvc.publish.topics`)."""
    return f"'{key}'"
