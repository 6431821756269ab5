"""The machine files that one process watches together, and what they share: buses, journal and outputs."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, cast

from daqsvc.errors.machine_file import NOT_OF_ONE_BOX, TOO_MUCH_MEMORY
from daqsvc.settings.alarms import AlarmHandling
from daqsvc.settings.checks import bus_checks, failure, memory_bytes, memory_share, needed_bytes
from daqsvc.settings.error_messages import dotted
from daqsvc.settings.hooks import PluginFailedError
from daqsvc.settings.locate import line_of
from daqsvc.settings.models import Machine, MachineFile, Origin
from daqsvc.settings.plugins import bus_tables, configured_outputs
from daqsvc.settings.problems import MachineFileError, Problem
from daqsvc.settings.registry import no_detectors

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from daqsvc.errors.code import Code
    from daqsvc.settings.buses import Bus
    from daqsvc.settings.problems import Finding, KeyPath
    from drivers.plugin import DriverPlugin

BOX = "box"
"""Whose alarms are those of the service itself, where it watches several machines."""


class Box:
    """One or several machine files that are watched by one process.

    A single machine file is its own box: every name is as in the file. Of several ones each bus, by its
    name, and each table of an output or of the store is one thing of the box. Streams and sensors have the
    name of their machine in front. So what is made once for all of them is made of one file, `own`.

    Args:
        machines: the machine files, by the names of their machines.
        own: the box as a machine file; see `several`.

    Attributes:
        machines: as given.
        own: all buses, streams and sensors, the store, and the outputs.
    """

    def __init__(self, machines: Mapping[str, MachineFile], own: MachineFile) -> None:
        self.machines = machines
        self.own = own

    @classmethod
    def single(cls, machine: MachineFile) -> Box:
        """The box of one machine file."""
        return cls({machine.machine.name: machine}, machine)

    @classmethod
    def several(cls, files: Sequence[MachineFile]) -> Box:
        """The box of several machine files, or of one that others will join.

        Args:
            files: at least one.

        Raises:
            MachineFileError: they do not fit each other; holds every problem found.
        """
        problems = [*_of_the_box(files), *_buses(files)]
        if not problems:
            own = _own(files)
            problems = [*_together(own, files), *_outputs_of_several(own, files), *_memory(files)]
        if problems:
            raise MachineFileError(problems)
        return cls({one.machine.name: one for one in files}, own)

    @property
    def names(self) -> str:
        """The names of its machines, for a person."""
        return ", ".join(self.machines)

    @property
    def others(self) -> list[MachineFile]:
        """The machines beside what represents the service itself, if that is none of them."""
        return [] if self.is_single else [*self.machines.values()]

    @property
    def is_single(self) -> bool:
        """Whether it is the box of one machine file, in whose names it speaks."""
        return self.own in self.machines.values()

    def stream_key(self, machine: str, stream: str) -> str:
        """What a stream of a machine is called on the box: by drivers, in figures."""
        return stream if self.is_single else f"{machine}/{stream}"


def _problem(
    file: MachineFile, path: KeyPath, value: object, message: str, remedy: str, code: Code = NOT_OF_ONE_BOX
) -> Problem:
    """Of one file; ``path`` is that of a key, or of a table of the box, and empty for the whole file."""
    key = f"[{path[0]}]" if len(path) == 1 and path[0] in [*_tables(file)] else dotted(path)
    line = line_of(file.text, path) if path else None
    return Problem(file.path, line, key, f"{value}", message, remedy, code)


def _of_the_box(files: Sequence[MachineFile]) -> Iterator[Problem]:
    """What there is once on a box is the same in all files."""
    first = files[0]
    names: dict[str, MachineFile] = {}
    for file in files:
        for key in ("site", "box"):
            mine, theirs = getattr(file, key), getattr(first, key)
            if mine != theirs:
                words = f'but {first.path} has "{theirs}", and one process is one box'
                yield _problem(
                    file, (key,), f'"{mine}"', words, f'write {key} = "{theirs}", or run it by itself'
                )
        name = file.machine.name
        if name == BOX:
            words = "is the name of the service itself if it watches several machines"
            yield _problem(file, ("machine", "name"), f'"{name}"', words, "choose another name")
        if name in names:
            words = f"is the name of the machine of {names[name].path} already"
            yield _problem(file, ("machine", "name"), f'"{name}"', words, "give each machine its own name")
        names.setdefault(name, file)
    yield from _tables_once(files)


def _tables_once(files: Sequence[MachineFile]) -> Iterator[Problem]:
    """The box has one table of a kind, and all paths of these tables start at the same directory."""
    keys, holders = list(_tables(files[0])), [file for file in files if _holds(file)]
    for key in keys:
        having = [file for file in files if getattr(file, key) is not None]
        for file in having[1:]:
            if getattr(file, key) != getattr(having[0], key):
                words = f"differs from that of {having[0].path}"
                remedy = (
                    f"one box has one [{key}]: write it in one of the files only, or in all of them alike"
                )
                yield _problem(file, (key,), "", words, remedy)
    for file in holders[1:]:
        if file.path.parent.absolute() != holders[0].path.parent.absolute():
            words = f"has tables of the box ({', '.join(_holds(file))}), and so has {holders[0].path}"
            yield _problem(file, (), "", words, "write these in files of one directory")


def _holds(file: MachineFile) -> list[str]:
    """Which tables of the box a file has."""
    return [f"[{key}]" for key in _tables(file) if getattr(file, key) is not None]


def _buses(files: Sequence[MachineFile]) -> Iterator[Problem]:
    """A bus that several files name is the same in all of them."""
    owners: dict[str, MachineFile] = {}
    for file in files:
        for name in file.buses:
            owner = owners.setdefault(name, file)
            mine, theirs = _absolute(file, name), _absolute(owner, name)
            if mine != theirs:
                differ = [key for key, value in mine if value != getattr(theirs, key, None)] or ["driver"]
                here, there = (getattr(table, differ[0], None) for table in (mine, theirs))
                has = f"no {differ[0]}" if there is None else f"{differ[0]} = {_as_written(there)}"
                words = f"the bus of that name in {owner.path} has {has}"
                remedy = (
                    f"in all files of a box, one name is one bus: make both tables [buses.{name}] equal, or "
                    "give this bus another name"
                )
                written = "" if here is None else _as_written(here)
                yield _problem(file, ("buses", name, differ[0]), written, words, remedy)


def _as_written(value: object) -> str:
    """A value as a machine file has it, or nearly."""
    return json.dumps(value, ensure_ascii=False, default=str)


def _absolute(file: MachineFile, name: str) -> Bus:
    """The table of a bus, whichever file it is in."""
    bus = file.buses[name]
    plugin = cast("DriverPlugin[Any]", bus_tables()[bus.driver])
    absolute: Bus = plugin.absolute(file, bus)
    return absolute


def _own(files: Sequence[MachineFile]) -> MachineFile:
    """The box as a machine file: without detectors and alarms, as those belong to its machines."""
    first = files[0]
    streams: dict[str, Any] = {}
    sensors: list[Any] = []
    facts: dict[str, Any] = {}
    for file in files:
        name = file.machine.name
        streams |= {f"{name}/{key}": stream for key, stream in file.streams.items()}
        facts |= {f"{name}/{key}": fact for key, fact in file.layout_facts.items()}
        sensors += [
            one.model_copy(update={"name": f"{name}/{one.name}", "stream": f"{name}/{one.stream}"})
            for one in file.sensors
        ]
    tables: dict[str, Any] = dict.fromkeys(_tables(first))
    for file in files:
        tables |= {key: table for key in tables if (table := getattr(file, key)) is not None}
    holder = next(filter(_holds, files), first)
    own = first.model_copy(
        update={
            "machine": Machine(name=BOX, description=first.box, speed_rpm=first.machine.speed_rpm),
            "buses": {name: _absolute(file, name) for file in files for name in file.buses},
            "streams": streams,
            "sensors": tuple(sensors),
            "pipeline": no_detectors(),
            "alarms": (),
            "alarm_handling": AlarmHandling(),
            "recorder": None,
            **tables,
        }
    )
    return own.found_at(Origin(holder.path, (), facts))


def _tables(file: MachineFile) -> Iterator[str]:
    """Keys of the tables that the box has once: the store, and all that plugins have added to the file."""
    yield "store"
    yield from (key for key in type(file).model_fields if key not in MachineFile.model_fields)


def _together(own: MachineFile, files: Sequence[MachineFile]) -> Iterator[Problem]:
    """What the streams of all machines are to each other on their buses; each file by itself is sound."""
    findings: Iterable[Finding] = bus_checks(own, own.layout_facts)
    by_name = {file.machine.name: file for file in files}
    for finding in findings:
        if finding.fatal:
            named = f"{finding.path[1]}".partition("/")[0] if len(finding.path) > 1 else ""
            file = by_name.get(named) or next((f for f in files if named in f.buses), own)
            path = tuple(step.removeprefix(f"{named}/") for step in map(str, finding.path))
            line = line_of(file.text, path) if file is not own else None
            yield Problem(
                file.path, line, dotted(finding.path), "", finding.message, finding.remedy, finding.code
            )


def _outputs_of_several(own: MachineFile, files: Sequence[MachineFile]) -> Iterator[Problem]:
    text = next(file.text for file in files if file.path == own.path)
    for _, plugin, settings in configured_outputs(own):
        try:
            findings = [*plugin.several_checks(settings)]
        except PluginFailedError as failed:
            findings = [failure(own, failed)]
        for finding in findings:
            line = line_of(text, finding.path)
            yield Problem(
                own.path, line, dotted(finding.path), "", finding.message, finding.remedy, finding.code
            )


def _memory(files: Sequence[MachineFile]) -> Iterator[Problem]:
    """The rings of all machines fit the memory together."""
    needed = {file.machine.name: sum(needed_bytes(file).values()) for file in files}
    together, there = sum(needed.values()), memory_bytes()
    if together > memory_share() * there:
        most = max(files, key=lambda file: needed[file.machine.name])
        yield _problem(
            most,
            ("pipeline", "ring_s"),
            most.pipeline.ring_s,
            f"the rings of all {len(files)} machines would take {together / 1e9:.3g} GB, and this computer "
            f"has {there / 1e9:.3g} GB",
            "write a shorter ring_s in [pipeline] of each file",
            TOO_MUCH_MEMORY,
        )
