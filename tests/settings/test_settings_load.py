"""Whatever stands in a machine file: it is read, or every problem is named; nothing else is raised."""

from __future__ import annotations

from itertools import combinations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.examples import examples
from support.paths import ROOT

from daqsvc.settings import MachineFileError, describe, parse_machine_file
from daqsvc.settings.locate import locate

pytestmark = pytest.mark.property
LAVAL = ROOT / "config" / "machines" / "laval-rig.toml"
TEXT = LAVAL.read_text(encoding="utf-8")
EXAMPLES = sorted(LAVAL.parent.glob("*.toml"))
JUNK = st.one_of(
    st.sampled_from(
        ["0", "-1", "nan", "1e400", '""', '"x y"', "true", "[]", "{}", "[{}]", "[[1]]", "07:32:00"]
    ),
    st.sampled_from(["0x7fffffffffffffff", "{ id = 1 }", '"keyphasor"', '"probe-y"', "[0, 0]", '["a", "b"]']),
    st.integers().map(str),
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
)
# Each is wrong by itself and leaves the others as they are: what it puts in place of what, and its key.
FAULTS = [
    ("fd = true", "fd = 1", "buses.can0.fd"),
    ('interface = "socketcan"', "interface = 3", "buses.can0.interface"),
    ("reorder_window_ms = 10.0", "reorder_window = 10.0", "streams.shaft.reorder_window"),
    ("id = 0x101", "id = 0x901", "streams.shaft.layout.id"),
    ("sensitivity_mv_per_unit = 7.87   #", "sensitivity = 7.87 #", "sensors[0].sensitivity"),
    ("threshold_v = -6.0", "", "sensors[2].threshold_v"),
    ("ring_s = 30.0", "ring_s = -30.0", "pipeline.ring_s"),
    ('name = "F1"', 'name = "N"', "pipeline.rotor_bank.modes[1].name"),
    ("angle_deg = 90.0", "angle_deg = 180.0", "pipeline.rotor_bank.probes"),
    ("alert = 40.0", "alert = 90.0", "alarms[0].alert"),
    ("latching = true", 'latching = "yes"', "alarms[2].latching"),
    ('sensor = "probe-y"', 'sensor = "probe-z"', "alarms[1].sensor"),
    ("mqtts://", "mqtt://", "mqtt.url"),
    ('username = "daq"', "", "mqtt.password_file"),
    ("[store]", "[store]\nsize = 3", "store.size"),
]


def outcome(text, path=LAVAL):
    """The machine file, or the problems that were found."""
    try:
        return parse_machine_file(text, path), ()
    except MachineFileError as error:
        return None, error.problems


def keys_of_problems(text):
    return {problem.key for problem in outcome(text)[1]}


def assert_well_put(problems, line_count):
    for problem in problems:
        assert problem.line is None or 1 <= problem.line <= line_count
        assert problem.message
        assert problem.remedy
        assert "\n" not in str(problem)


@pytest.mark.parametrize("pair", list(combinations(range(len(FAULTS)), 2)))
def test_no_fault_hides_another(pair):
    text = TEXT
    for old, new, _ in (FAULTS[index] for index in pair):
        assert old in text
        text = text.replace(old, new, 1)
    assert {FAULTS[index][2] for index in pair} <= keys_of_problems(text)


@settings(deadline=None)
@given(st.sets(st.sampled_from(range(len(FAULTS))), min_size=1))
def test_all_faults_of_a_file_are_named_at_once(indices):
    text = TEXT
    for old, new, _ in (FAULTS[index] for index in indices):
        text = text.replace(old, new, 1)
    assert {FAULTS[index][2] for index in indices} <= keys_of_problems(text)


def leaves_of(text):
    """Line and source of every value of a text that stands on one line."""
    spots = [spot for spot in locate(text).values() if spot.source and "\n" not in spot.source]
    return sorted({(spot.line, spot.source) for spot in spots})


@pytest.mark.long
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
@settings(deadline=None, max_examples=examples(100))
@given(data=st.data())
def test_any_value_in_any_place(path, data):
    text = path.read_text(encoding="utf-8")
    lines = text.split("\n")
    changes = st.lists(st.tuples(st.sampled_from(leaves_of(text)), JUNK), min_size=1, max_size=3)
    for (line, source), junk in data.draw(changes):
        lines[line - 1] = lines[line - 1].replace(source, junk, 1)
    machine, problems = outcome("\n".join(lines), path)
    assert bool(machine) != bool(problems)
    assert_well_put(problems, len(lines))
    assert machine is None or describe(machine)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
@settings(deadline=None, max_examples=examples(100))
@given(data=st.data())
def test_any_lines_left_out(path, data):
    lines = path.read_text(encoding="utf-8").split("\n")
    left_out = data.draw(st.sets(st.integers(0, len(lines) - 1), min_size=1, max_size=8))
    text = "\n".join(line for number, line in enumerate(lines) if number not in left_out)
    machine, problems = outcome(text, path)
    assert bool(machine) != bool(problems)
    assert_well_put(problems, len(lines))
    assert machine is None or describe(machine)


@settings(deadline=None)
@given(st.text())
def test_any_text(text):
    with pytest.raises(MachineFileError):
        parse_machine_file(text, LAVAL)


STRUCTURES = st.recursive(
    st.one_of(st.integers(), st.booleans(), st.text(st.characters(codec="ascii"), max_size=3)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.sampled_from("abc"), inner, max_size=2)
    ),
    max_leaves=5,
)


def toml(value):
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return str(value) if isinstance(value, int) else f"'{''.join(c for c in value if c.isalnum())}'"


TABLES = ["machine", "buses", "streams", "sensors", "pipeline", "alarms", "mqtt", "store"]


@settings(deadline=None, max_examples=examples(200))
@given(st.dictionaries(st.sampled_from(TABLES), STRUCTURES, min_size=1))
def test_any_structure_in_place_of_a_table(tables):
    text = "".join(f"{name} = {toml(value)}\n" for name, value in tables.items())
    machine, problems = outcome(text)
    assert machine is None
    assert_well_put(problems, text.count("\n") + 1)
