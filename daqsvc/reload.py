"""What is different between the machine files that a service runs on and those that it is to go on with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from daqsvc.control import ReloadRefusedError
from daqsvc.errors.service import NEEDS_RESTART
from daqsvc.outbox.limits import OutboxLimits
from daqsvc.publish.make import topic_root, watched
from daqsvc.settings.error_messages import dotted
from daqsvc.settings.locate import line_of
from daqsvc.settings.models import MachineFile
from daqsvc.settings.problems import Problem
from daqsvc.settings.sensors import TrendValue
from daqsvc.settings.store import Store

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence

    from daqsvc.box import Box
    from daqsvc.settings.problems import KeyPath

RESTART = "restart the service for that, or take it back"
MOST_PLACES, LONGEST_VALUE = 6, 60
"""Most places below a key that are named one by one; and the longest value."""

_OF_ALARMS = frozenset({"alarms", "alarm_handling"})
_OF_BOX = frozenset({"schema_version", "site", "box", "buses", "store"})


@dataclass(frozen=True, slots=True)
class Changes:
    """What a reload does.

    Attributes:
        machines_gone: no longer watched.
        machines_new: watched from now on.
        machines_anew: watched on, by new detectors, and why: the keys that have changed.
        alarms_anew: machines whose alarms have other rules, but whose detectors go on, and what differs.
        buses_gone: closed.
        buses_new: opened.
        buses_anew: closed and opened again, and why.
        outputs: the tables of outputs that have changed, or that what they show has; empty if none has.
    """

    machines_gone: tuple[str, ...] = ()
    machines_new: tuple[str, ...] = ()
    machines_anew: Mapping[str, str] = field(default_factory=dict)
    alarms_anew: Mapping[str, str] = field(default_factory=dict)
    buses_gone: tuple[str, ...] = ()
    buses_new: tuple[str, ...] = ()
    buses_anew: Mapping[str, str] = field(default_factory=dict)
    outputs: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return any(self.lines())

    def lines(self) -> list[str]:
        """The same for a person, a line each."""
        return [
            *(f"machine {name} is no longer watched" for name in self.machines_gone),
            *(f"machine {name} is watched from now on" for name in self.machines_new),
            *(f"machine {name}: detectors begin again ({why})" for name, why in self.machines_anew.items()),
            *(f"machine {name}: other alarms or setpoints ({why})" for name, why in self.alarms_anew.items()),
            *(f"bus {name} is closed" for name in self.buses_gone),
            *(f"bus {name} is opened" for name in self.buses_new),
            *(f"bus {name} is opened again ({why})" for name, why in self.buses_anew.items()),
            *([f"outputs begin again ({', '.join(self.outputs)})"] if self.outputs else []),
        ]


def changes(before: Box, after: Box) -> Changes:
    """What has to be done to go on with ``after`` in place of ``before``.

    Raises:
        ReloadRefusedError: that cannot be done while the service runs.
    """
    if problems := list(_needs_restart(before, after)):
        raise ReloadRefusedError([f"{problem}" for problem in problems])
    old, new = before.machines, after.machines
    common = [name for name in new if name in old]
    old_buses, new_buses = (dict(_buses(box)) for box in (before, after))
    kept = [name for name in new_buses if name in old_buses]
    buses_anew = {name: why for name in kept if (why := _otherwise(old_buses[name], new_buses[name]))}
    # The driver of a bus that is opened again counts samples from 0, which no ring takes that has some.
    anew = {
        name: why
        for name in common
        if (why := ", ".join([*_watched_otherwise(old[name], new[name]), *_read_by(new[name], buses_anew)]))
    }
    alarms = {
        name: ", ".join(places)
        for name in common
        if name not in anew and (places := _differ(old[name], new[name], _OF_ALARMS))
    }
    return Changes(
        machines_gone=tuple(name for name in old if name not in new),
        machines_new=tuple(name for name in new if name not in old),
        machines_anew=anew,
        alarms_anew=alarms,
        buses_gone=tuple(name for name in old_buses if name not in new_buses),
        buses_new=tuple(name for name in new_buses if name not in old_buses),
        buses_anew=buses_anew,
        outputs=tuple(_outputs(before, after)),
    )


def _needs_restart(before: Box, after: Box) -> Iterator[Problem]:
    """What no service can change while it runs, at its place in the files."""
    files = [*after.machines.values()]
    for key in ("site", "box"):
        was, wanted = getattr(before.own, key), getattr(after.own, key)
        if was != wanted:
            yield _restart(files, (key,), wanted, was)
    if before.is_single and [*before.machines] != [*after.machines]:
        yield _restart(files, ("machine", "name"), after.own.machine.name, before.own.machine.name)
    root, wanted_root = topic_root(before.own), topic_root(after.own)
    if root != wanted_root:
        yield _restart(files, ("mqtt", "topic_root"), wanted_root, root)
    old, new = _directory(before), _directory(after)
    if old != new:
        yield _restart(files, ("store", "directory"), new, old)
    elif OutboxLimits.of(before.own.store) != OutboxLimits.of(after.own.store):
        # Without the table all keys have their defaults.
        was, wanted = ((one.own.store or Store(directory=Path())).model_dump() for one in (before, after))
        for key in was:
            if key != "directory" and was[key] != wanted[key]:
                yield _restart(files, ("store", key), wanted[key], was[key])


def _directory(box: Box) -> str | None:
    """Of the store, if the files name one."""
    return None if box.own.store is None else f"{box.own.resolve(box.own.store.directory)}"


def _restart(files: Sequence[MachineFile], path: KeyPath, wanted: object, was: object) -> Problem:
    """That the value at a place would have to become another one."""
    file = next((one for one in files if getattr(one, f"{path[0]}", None) is not None), files[0])
    message = f"the service runs with {_json(was)}, and changes that only when it starts"
    return Problem(
        file.path,
        line_of(file.text, path),
        dotted(path),
        "" if wanted is None else _json(wanted),
        message,
        RESTART,
        NEEDS_RESTART,
    )


def _json(value: object) -> str:
    return "none" if value is None else json.dumps(value, ensure_ascii=False)


def _differ(old: MachineFile, new: MachineFile, keys: frozenset[str]) -> list[str]:
    """What is different below these keys: each place with both values, or the key alone if that is much."""
    differences: list[str] = []
    for key in sorted(keys):
        places = [*_places(getattr(old, key), getattr(new, key), key)]
        differences += places if len(places) <= MOST_PLACES else [key]
    return differences


def _places(old: Any, new: Any, path: str) -> Iterator[str]:
    """Where two values differ, e.g. ``"alarms.vibration.alert 15.0 -> 16.0"``."""
    if old == new:
        return
    before, after = _parts(old), _parts(new)
    if before is None or after is None:
        yield f"{path} {_words(old)} -> {_words(new)}"
        return
    for name in {**before, **after}:
        below = f"{path}.{name}"
        if name not in after:
            yield f"{below} is gone"
        elif name not in before:
            yield f"{below} is new"
        else:
            yield from _places(before[name], after[name], below)


def _parts(value: Any) -> dict[Any, Any] | None:
    """A table by its keys, or a list of tables by their names; None of anything else."""
    if isinstance(value, BaseModel):
        return {name: getattr(value, name) for name in type(value).model_fields}
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, list | tuple) and value:
        named = {getattr(one, "name", None): one for one in value}
        if None not in named and len(named) == len(value):
            return named
    return None


def _words(value: Any) -> str:
    words = "none" if value is None else repr(value) if isinstance(value, str) else f"{value}"
    return words if len(words) <= LONGEST_VALUE else f"{words[:LONGEST_VALUE]}..."


def _read_by(machine: MachineFile, buses: Collection[str]) -> Iterator[str]:
    """Which of these buses a machine has."""
    yield from (f"bus {name}" for name in machine.buses if name in buses)


def _watched_otherwise(old: MachineFile, new: MachineFile) -> list[str]:
    """The keys by which a machine is watched in another way."""
    keys = {*type(old).model_fields} - _OF_BOX - set(_output_tables(old))
    if not any(isinstance(sensor, TrendValue) for sensor in new.sensors):
        keys -= _OF_ALARMS  # the detector of trend values predicts when a limit will be reached
    # What a machine is called by people changes nothing of how it is watched.
    described = new.machine.model_copy(update={"description": old.machine.description})
    differ = _differ(old, new.model_copy(update={"machine": described}), frozenset(keys))
    if old.layout_facts != new.layout_facts and old.streams == new.streams:
        differ.append("files that its streams name")
    return differ


def _output_tables(file: MachineFile) -> Iterator[str]:
    yield from (key for key in type(file).model_fields if key not in MachineFile.model_fields)


def _buses(box: Box) -> Iterator[tuple[str, dict[str, Any]]]:
    """By bus, all that its driver is made of."""
    own = box.own
    for name, table in own.buses.items():
        streams = {key: stream for key, stream in own.streams.items() if stream.bus == name}
        sensors = [
            (sensor.stream, sensor.channel, sensor.gain, sensor.shift)
            for sensor in own.sensors
            if sensor.stream in streams
        ]
        facts = {key: fact for key in streams if (fact := own.layout_facts.get(key)) is not None}
        yield name, {"its table": table, "its streams": streams, "units": sensors, "its files": facts}


def _otherwise(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    return ", ".join(key for key in new if old[key] != new[key])


def _outputs(before: Box, after: Box) -> Iterator[str]:
    """The tables of outputs that differ, and whether there is something else to tell."""
    for key in _output_tables(after.own):
        if getattr(before.own, key) != getattr(after.own, key):
            yield f"[{key}]"
    speaks = any(getattr(after.own, key) is not None for key in _output_tables(after.own))
    if speaks and _shown(before) != _shown(after):
        yield "names and figures that they show"


def _shown(box: Box) -> Any:
    return {name: watched(machine) for name, machine in box.machines.items()}, sorted(box.own.buses)
