"""Every number, text and list that a machine file can hold has bounds, on both sides where it has two."""

from __future__ import annotations

import re
import typing
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import pytest
from annotated_types import Ge, Gt, Le, Lt, MaxLen
from pydantic.fields import FieldInfo
from support.machine_files import LAVAL, changed, only_problem
from support.paths import ROOT

from daqsvc.reference import keys
from daqsvc.settings.models import machine_file_model
from daqsvc.settings.schema import field_type
from daqsvc.settings.section import Kinds, Section

DOCS = ROOT / "docs"

# Handed to a driver as they are, which checks them itself.
FREE = {"CanBus.options"}


def flattened(metadata):
    for mark in metadata:
        yield from flattened(mark.metadata) if isinstance(mark, FieldInfo) else (mark,)


def leaves(declared, path, marks, seen):  # noqa: PLR0912
    """Every value that is no table: its type, where it stands, and what bounds it."""
    origin = get_origin(declared)
    if origin is Annotated:
        bare, *more = get_args(declared)
        more = list(flattened(more))
        kinds = next((mark for mark in more if isinstance(mark, Kinds)), None)
        if kinds is not None:
            for section in kinds.sections:
                yield from fields(section, seen)
            return
        yield from leaves(bare, path, [*marks, *more], seen)
    elif origin in {Union, UnionType}:
        for arm in get_args(declared):
            yield from leaves(arm, path, marks, seen)
    elif origin is tuple:
        arms = get_args(declared)
        if arms[-1] is Ellipsis:
            yield tuple, path, marks
        for arm in arms:
            if arm is not Ellipsis:
                yield from leaves(arm, f"{path}[]", [], seen)
    elif origin is dict:
        yield dict, path, marks
        for arm in get_args(declared):
            yield from leaves(arm, f"{path}{{}}", [], seen)
    elif isinstance(declared, type) and issubclass(declared, Section):
        yield from fields(declared, seen)
    elif origin is not Literal and declared not in {type(None), bool}:
        yield declared, path, marks


def fields(section, seen):
    if section in seen:
        return
    seen.add(section)
    for name, field in section.model_fields.items():
        path = f"{section.__name__}.{name}"
        if path not in FREE:
            yield from leaves(field_type(field), path, [], seen)


EVERYTHING = list(fields(machine_file_model(), set()))


def has(marks, *kinds):
    return any(isinstance(mark, kinds) for mark in marks)


def test_the_walk_goes_everywhere():
    paths = {path for _, path, _ in EVERYTHING}
    assert {
        "Stream.rate_hz",
        "Levels.window_s",
        "LevelAlarm.on_delay_s",
        "VotingAlarm.sensors[]",
        "ThreeMasses.masses_kg[]",
        "RegistersLayout.forbidden[][]",
        "Channel.valid_raw[]",
        "Sparkplug.servers[]",
        "CanRecord.folder",
        "MachineFile.streams{}",
    } <= paths
    assert len(paths) > 200


def test_every_number_has_bounds_on_both_sides():
    numbers = [(path, marks) for kind, path, marks in EVERYTHING if kind in {int, float}]
    assert len(numbers) > 100
    open_ended = [path for path, marks in numbers if not (has(marks, Ge, Gt) and has(marks, Le, Lt))]
    assert open_ended == []


def test_every_text_is_short_enough_for_a_line():
    texts = [(path, marks) for kind, path, marks in EVERYTHING if kind is str]
    assert len(texts) > 40
    endless = [path for path, marks in texts if not has(marks, MaxLen)]
    assert endless == []


def test_every_list_and_table_has_an_end():
    lists = [(path, marks) for kind, path, marks in EVERYTHING if kind in {tuple, dict}]
    assert len(lists) > 15
    endless = [path for path, marks in lists if not has(marks, MaxLen)]
    assert endless == []


def test_nothing_is_of_a_type_that_is_not_looked_at():
    kinds = {kind for kind, _, _ in EVERYTHING}
    assert {kind for kind in kinds if kind is not typing.Any} <= {int, float, str, tuple, dict, Any} | {
        kind for kind in kinds if getattr(kind, "__name__", "") == "Path"
    }


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("rate_hz = 640.0", "rate_hz = 5e-324"),
        ("window_s = 0.5", "window_s = 1e-300"),
        ("on_delay_s = 1.0", "on_delay_s = 1e308"),
        ("ring_s = 30.0", "ring_s = 1e-9"),
        ("clearance_um = 100.0", "clearance_um = 1e-300"),
        ("noise_um = 2.0", "noise_um = 1e300"),
        ("flood_alarms = 10", "flood_alarms = 1_000_000_000_000"),
        ("hysteresis_v = 0.5", "hysteresis_v = 1e9"),
        ("zero_v = -10.0", "zero_v = -1e9"),
        ("deadband = 2.0", "deadband = nan"),
        ("speed_rpm = 600.0", "speed_rpm = 1979-05-27"),
        ("speed_rpm = 600.0", "speed_rpm = 07:32:00"),
    ],
)
def test_what_no_machine_has_is_refused_with_its_line(old, new):
    problem, line = only_problem(LAVAL, (old, new))
    assert problem.line == line
    assert problem.value == new.split(" = ")[1]
    assert problem.remedy


@pytest.mark.parametrize("text", ["a\\u001b[31mb", "a\\nb", "a\\u0000b", "a\\u202eb"])
def test_a_text_that_would_not_stay_on_its_line_is_refused(text):
    old = 'description = "Laval rotor on a test rig, can rub its housing"'
    problem, _ = only_problem(LAVAL, (old, f'description = "{text}"'))
    assert "cannot be printed" in problem.message


@pytest.mark.parametrize("name", [".", "..", "..."])
def test_a_name_that_is_a_place_in_the_file_system_is_refused(name):
    problem, _ = only_problem(LAVAL, ('site = "lab" ', f'site = "{name}" '))
    assert problem.key == "site"
    assert changed(LAVAL, ('site = "lab" ', 'site = ".lab" '))


def limit(marks, *kinds):
    mark = next(mark for mark in marks if isinstance(mark, kinds))
    return float(getattr(mark, type(mark).__name__.lower()))


@pytest.mark.parametrize("page", ["can.md", "serial.md", "modbus.md", "replay.md", "machine-file.md"])
def test_the_limits_that_the_pages_state_are_those_of_the_models(page):
    """In the tables that people write; where several drivers have a key, those of the page's driver."""
    bounds = {path: marks for kind, path, marks in EVERYTHING if kind in {int, float}}
    tables = {table.header: table.keys for table in keys.tables().values()}
    text = (DOCS / page).read_text(encoding="utf-8")
    [limits] = re.findall(r"^\| key \| in the table \| from .*\n(?:\|.*\n)+", text, re.MULTILINE)
    rows = re.findall(r"^\| `(\w+)` \| `(\[.+\])` \| ([-\d._]+) \| ([-\d._]+) \|", limits, re.MULTILINE)
    assert len(rows) == limits.count("\n") - 2
    for key, table, lowest, highest in rows:
        kinds = tables[table][key]
        ours = [one for one in kinds if one.section.__module__.split(".")[:2] == ["drivers", page[:-3]]]
        stated = (float(lowest), float(highest))
        for one in ours or kinds:
            marks = bounds[f"{one.section.__name__}.{key}"]
            assert (limit(marks, Ge, Gt), limit(marks, Le, Lt)) == stated, (table, key, one.kind)
