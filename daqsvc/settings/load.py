"""Reading a machine file: either it is good, or everything wrong with it is reported at once."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from itertools import islice
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from daqsvc.errors.machine_file import PLUGIN_FAILED, UNKNOWN_KEY
from daqsvc.settings.checks import check, failure
from daqsvc.settings.error_messages import ErrorFormatter, dotted, is_secret, suggested_key, table_beside
from daqsvc.settings.failures import one_line
from daqsvc.settings.files import UnreadableFileError, read_bounded, shortened
from daqsvc.settings.hooks import collecting
from daqsvc.settings.locate import Spot
from daqsvc.settings.models import MachineFile, Origin, machine_file_model
from daqsvc.settings.problems import Finding, MachineFileError, Problem
from daqsvc.settings.registry import (
    broken_detectors,
    broken_drivers,
    broken_outputs,
    bus_tables,
    detector_tables,
    driver_of_layout,
)
from daqsvc.settings.schema import (
    declared_at,
    is_table,
    only_follows,
    section_of,
    valid_part,
    value_at,
    without_guesses,
)
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.toml_text import MOST_BYTES, TomlTextError, decoded, parse
from daqsvc.settings.units import factor_between
from daqsvc.settings.zone_checks import with_zones

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from pydantic_core import ErrorDetails

    from daqsvc.settings.hooks import PluginFailedError
    from daqsvc.settings.problems import KeyPath

_MASK = '"***"'
_LONGEST_VALUE = 60
_MOST_PROBLEMS = 100
"""Of each kind: whoever has so many has given the wrong file."""


def load_machine_file(path: Path) -> MachineFile:
    """Read a machine file and everything that it names.

    Args:
        path: the TOML file.

    Returns:
        The machine file, all of whose parts fit each other.

    Raises:
        MachineFileError: it cannot be read or used; holds every problem found.
    """
    try:
        text = decoded(read_bounded(path, MOST_BYTES), path)
    except (UnreadableFileError, TomlTextError) as error:
        remedy = error.remedy
        if isinstance(error.__cause__, FileNotFoundError):
            remedy = "correct the path, or begin with an example: daqsvc example"
        line = error.line if isinstance(error, TomlTextError) else None
        raise MachineFileError([Problem(path, line, "", "", str(error), remedy, error.code)]) from None
    return parse_machine_file(text, path)


def parse_machine_file(text: str, path: Path) -> MachineFile:
    """Read a machine file from its text, as if it were at ``path``.

    Args:
        text: TOML.
        path: the file that messages name and relative paths start from; it need not exist.

    Raises:
        MachineFileError: the text cannot be used; holds every problem found.
    """
    try:
        document, spots = parse(text)
    except TomlTextError as error:
        problem = Problem(path, error.line, "", "", str(error), error.remedy, error.code)
        raise MachineFileError([problem]) from None
    return _machine_file(document, spots, path, text)


def machine_file_of(values: dict[str, Any], path: Path) -> MachineFile:
    """A machine file from its values, as if it were at ``path``.

    Args:
        values: what TOML would give.
        path: see `parse_machine_file`.

    Raises:
        MachineFileError: they cannot be used; holds every problem found.
    """
    return _machine_file(values, {(): Spot(1)}, path, "")


def _machine_file(
    document: dict[str, Any], spots: Mapping[KeyPath, Spot], path: Path, text: str
) -> MachineFile:
    reading = _Reading(document, spots, path)
    reading.leave_out_broken()
    with collecting() as failures:
        draft = with_zones(reading.validate().found_at(Origin(path)))
        facts = _read_files(draft, path, reading.findings)
        reading.findings += check(draft, facts)
    reading.note_failures(draft, failures)
    problems, warnings = reading.problems()
    if problems:
        raise MachineFileError(problems)
    return draft.found_at(Origin(path, tuple(warnings), MappingProxyType(facts), text))


def _in_its_unit(value: Any, key: str, better: str) -> Any:
    """The value of a misspelt key in the unit that the right one ends with: timeout_s = 0.5 is 500 ms."""
    factor = factor_between(key.rpartition("_")[2], better.rpartition("_")[2])
    if factor is None or isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e15:
        return value
    converted = float(value) * factor
    return int(converted) if converted.is_integer() else converted


class _Reading:
    """A parsed file on its way to a `MachineFile`, and what was found wrong with it so far."""

    def __init__(self, document: dict[str, Any], spots: Mapping[KeyPath, Spot], path: Path) -> None:
        self._document = document
        self._spots = spots
        self._path = path
        self._written_as: dict[KeyPath, str] = {}
        self._moved: dict[KeyPath, KeyPath] = {}
        self._lacks_detector = False
        self._undecided: set[str] = set()
        self.findings: list[Finding] = []

    def leave_out_broken(self) -> None:
        """Take out the tables of plugins that are installed and cannot be loaded; each is a finding."""
        broken = {f"pipeline.{key}": why for key, why in broken_detectors().items()}
        for name, why in (broken | dict(broken_outputs())).items():
            path = tuple(name.split("."))
            with suppress(LookupError):
                table = value_at(self._document, path[:-1])
                if isinstance(table, dict):
                    del table[path[-1]]
                    self.findings.append(Finding(path, why.message, why.or_remove(name), code=PLUGIN_FAILED))
                    self._lacks_detector |= path[0] == "pipeline"

    def note_failures(self, draft: MachineFile, failures: Iterable[PluginFailedError]) -> None:
        """Take in what plugins have failed at, of the file or what is valid of it."""
        for failed in failures:
            self.findings.append(failure(draft, failed))
            if failed.hook == "layout_of":
                self._undecided |= {name for name, plugin in bus_tables().items() if plugin is failed.by}

    def validate(self) -> MachineFile:
        """Check every value for itself; returns the file, or what is valid of it."""
        draft, errors = _validated(self._document)
        if draft is not None:
            return draft
        unknown = [error for error in errors if error["type"] == "extra_forbidden"]
        more = len(unknown) - _MOST_PROBLEMS
        if more > 0:
            self.findings.append(
                Finding(
                    (), f"{more:,} more unknown keys are not listed", "correct these first", code=UNKNOWN_KEY
                )
            )
        self._say(unknown, self._document)
        meant = self._without_unknown_keys([error["loc"] for error in unknown]) if unknown else self._document
        if unknown:
            _, errors = _validated(meant)
        # Unknown keys that are left are those of misspelt tables.
        self._say(errors, meant)
        part = valid_part(machine_file_model(), meant)
        assert isinstance(part, MachineFile)  # noqa: S101 - for the type checker
        return part

    def _without_unknown_keys(self, unknown: Iterable[KeyPath]) -> dict[str, Any]:
        """The document as it was probably meant: misspelt keys put right, other unknown keys left out."""
        meant: dict[str, Any] = _copy(self._document)
        # Deepest first, so that the paths of the rest still lead somewhere.
        for number, path in enumerate(sorted(unknown, key=len, reverse=True)):
            table = value_at(meant, path[:-1])
            key = str(path[-1])
            section = section_of(declared_at(machine_file_model(), meant, path[:-1]), table)
            # A secret in the file is refused, never taken for the value of some other key.
            usable = None if is_secret(path) or number >= _MOST_PROBLEMS else section
            better = None if usable is None else suggested_key(usable, table, key)
            value = table.pop(key)
            if better is not None:
                table[better] = _in_its_unit(value, key, better)
                self._written_as[*path[:-1], better] = key
            elif usable is not None and (there := table_beside(usable, table, key, value)) is not None:
                self._merge(table[there], value, (*path[:-1], there), path)
        return meant

    def _merge(self, there: Any, value: Any, path: KeyPath, written: KeyPath) -> None:
        """Add the entries of a misspelt table to those of the table that was meant.

        Else messages about names that are in it would follow.

        Args:
            there: the table that was meant, or the array of several; is changed.
            value: the misspelt one.
            path: of the one that was meant.
            written: of the misspelt one.
        """
        if isinstance(there, list):
            several = isinstance(value, list)
            for number, item in enumerate(value if several else [value]):
                self._moved[*path, len(there)] = (*written, number) if several else written
                there.append(item)
        elif isinstance(value, dict):
            for key, item in value.items():
                if key not in there:
                    self._moved[*path, key] = (*written, key)
                    there[key] = item
                elif is_table(there[key]) and is_table(item):
                    self._merge(there[key], item, (*path, key), (*written, key))

    def _say(self, errors: Iterable[ErrorDetails], document: dict[str, Any]) -> None:
        words = ErrorFormatter(machine_file_model(), document)
        for error in islice(errors, _MOST_PROBLEMS):
            path = tuple(step for step in error["loc"] if step != "[key]")
            message, remedy, code = words.say(error, path)
            self.findings.append(Finding(path, message, remedy, code=code))

    def problems(self) -> tuple[list[Problem], list[Problem]]:
        """What makes the file unusable, and what is worth a warning; both in the order of the file."""
        findings = [one for one in dict.fromkeys(self.findings) if not self._only_follows(one.path)]
        fatal = [self._problem(finding) for finding in findings if finding.fatal]
        warnings = [self._problem(finding) for finding in findings if not finding.fatal]
        return sorted(fatal, key=_place), sorted(warnings, key=_place)

    def _only_follows(self, path: KeyPath) -> bool:
        """Whether what is wrong there is unknown until a plugin can be loaded, which is reported itself."""
        with suppress(LookupError, TypeError):
            match path:
                case ("streams", stream, "layout", *_):
                    bus = value_at(self._document, ("streams", stream, "bus"))
                    driver = value_at(self._document, ("buses", bus, "driver"))
                    if driver not in broken_drivers():
                        return driver in self._undecided
                    layout = value_at(self._document, path[:3])
                    kinds = {kind for plugin in bus_tables().values() for kind in plugin.layouts}
                    return not any(kind.mark and kind.mark in layout for kind in kinds)
                case ("alarms" | "alarm_handling", *_, "detector") if self._lacks_detector:
                    known = {plugin.detector for plugin in detector_tables().values()}
                    return value_at(self._document, self._as_written(path)) not in known
        return False

    def _problem(self, finding: Finding) -> Problem:
        path = self._as_written(finding.path)
        name = ""
        try:
            value = value_at(self._document, path)
        except LookupError:
            source = ""
        else:
            source = _shown(path, self._spots.get(path, Spot(1)).source)
            if isinstance(value, dict) and isinstance(value.get("name"), str) and isinstance(path[-1], int):
                name = shortened(one_line(value["name"]), _LONGEST_VALUE)
        # A key that is missing has no line: its table has.
        line = next(
            self._spots[path[:end]].line for end in range(len(path), -1, -1) if path[:end] in self._spots
        )
        message, remedy = one_line(finding.message), one_line(finding.remedy)
        return Problem(self._path, line, dotted(path), source, message, remedy, finding.code, name)

    def _as_written(self, path: KeyPath) -> KeyPath:
        """A path of the document as it was meant, in the keys that the file really has."""
        for end in range(len(path), 0, -1):
            if path[:end] in self._moved:
                return (*self._moved[path[:end]], *path[end:])
        return tuple(self._written_as.get(path[: depth + 1], step) for depth, step in enumerate(path))


def _validated(document: dict[str, Any]) -> tuple[MachineFile | None, list[ErrorDetails]]:
    """The file if every value is valid for itself, else what is wrong."""
    try:
        return machine_file_model().model_validate(document), []
    except ValidationError as error:
        items = [item for item in error.errors(include_url=False) if not only_follows(item, document)]
        return None, [*without_guesses(items, machine_file_model(), document)]


def _copy(value: Any) -> Any:
    """A copy of the tables and arrays of a document; the values in them do not change."""
    if isinstance(value, dict):
        return {key: _copy(item) for key, item in value.items()}
    return [_copy(item) for item in value] if isinstance(value, list) else value


def _read_files(draft: MachineFile, path: Path, findings: list[Finding]) -> dict[str, Any]:
    """By stream, what the files that its layout names state."""
    known: dict[str, Any] = {}
    with suppress(UnusableValueError):
        for name, stream in draft.streams.items():
            with suppress(UnusableValueError):
                plugin = driver_of_layout(stream.layout)
                if plugin is None:
                    continue
                facts, problems = plugin.read_files(stream.layout, path.parent, ("streams", name, "layout"))
                findings += problems
                if facts is not None:
                    known[name] = facts
    return known


def _shown(path: KeyPath, source: str) -> str:
    """A value as the file has it, on one short line and without secrets."""
    if source and is_secret(path):
        return _MASK
    if "@" in source and (path[-1:] == ("url",) or "://" in source):
        return json.dumps(re.sub(r"^(\w+://)?.*@", r"\1***@", source.strip("\"'")))
    line = " ".join(source.split())
    return line if len(line) <= _LONGEST_VALUE else f"{line[: _LONGEST_VALUE - 4]} ..."


def _place(problem: Problem) -> tuple[int, str]:
    return problem.line or 0, problem.key
