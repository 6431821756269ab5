"""A detector by somebody else: its table, checks, sentence and alarms, without a line of ours changed."""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Annotated

import pytest
from pydantic import Field
from support.machine_files import MACHINES, problems_of

from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.plugin import DetectorPlugin
from daqsvc.settings import describe, parse_machine_file, registry
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import Name, Section

EXAMPLE = MACHINES / "motor-accelerometer.toml"
TABLE = '[pipeline.kurtosis]\nsensor = "accel-de"\n'
ALARM = '[[alarms]]\nname = "impacts"\ndetector = "kurtosis"\n'


class Kurtosis(Section):
    """How peaked an acceleration is."""

    sensor: Annotated[Name, Field(description="the accelerometer", examples=["accel-de"])]
    most: Annotated[float, Field(ge=0, le=1000)] = Field(default=6.0, description="above it, it knocks")


class Knocks:
    """A detector, as far as this needs one."""

    def __init__(self, sensor):
        self.name = "kurtosis"
        self.sensor = sensor


class KurtosisPlugin(DetectorPlugin[Kurtosis]):
    settings = Kurtosis
    about = "knocks in an acceleration"
    detector = "kurtosis"

    def checks(self, draft, given):
        def known():
            if given.sensor not in {sensor.name for sensor in draft.sensors}:
                yield Finding(("pipeline", "kurtosis", "sensor"), "there is no such sensor", "name another")

        yield known()

    def describe(self, machine, given):
        return f"knocks of {given.sensor} above {given.most:g}"

    def build(self, machine, given, store):
        return (Knocks(given.sensor),)


@pytest.fixture
def installed(monkeypatch):
    """Have these entry points besides ours, by key and place."""

    def install(**places):
        theirs = [EntryPoint(key, place, registry.DETECTORS) for key, place in places.items()]

        def found(group):
            return [*entry_points(group=group), *(point for point in theirs if point.group == group)]

        monkeypatch.setattr(registry, "entry_points", found)
        registry.forget()

    yield install
    monkeypatch.undo()
    registry.forget()


def text(*more):
    return "\n".join([EXAMPLE.read_text(), *more])


def the_problem(faulty):
    (problem,) = problems_of(faulty, EXAMPLE)
    return problem


def test_its_table_is_read_and_its_detector_made(installed):
    installed(kurtosis=f"{__name__}:KurtosisPlugin")
    machine = parse_machine_file(text(TABLE, ALARM), EXAMPLE)
    assert machine.pipeline.table(Kurtosis) == Kurtosis(sensor="accel-de")
    assert machine.detectors == ("kurtosis",)
    assert "knocks of accel-de above 6" in " ".join(describe(machine).split())
    assert [d.sensor for d in detectors(machine) if d.name == "kurtosis"] == ["accel-de"]


def test_what_is_wrong_in_it_is_said_as_of_any_table(installed):
    installed(kurtosis=f"{__name__}:KurtosisPlugin")
    misspelt = the_problem(text('[pipeline.kurtosis]\nsensor = "accel-de"\nmots = 3.0'))
    assert "pipeline.kurtosis.mots = 3.0: unknown key. Remedy: did you mean most?" in str(misspelt)
    bounded = the_problem(text('[pipeline.kurtosis]\nsensor = "accel-de"\nmost = -1'))
    assert (bounded.key, bounded.message) == ("pipeline.kurtosis.most", "must be 0 or more")
    missing = the_problem(text("[pipeline.kurtosis]"))
    assert str(missing).endswith('the accelerometer. Remedy: add sensor = "accel-de" to [pipeline.kurtosis]')
    nobody = the_problem(text('[pipeline.kurtosis]\nsensor = "nowhere"'))
    assert (nobody.key, nobody.message) == ("pipeline.kurtosis.sensor", "there is no such sensor")


def test_without_it_its_table_is_no_table(installed):
    installed()
    assert {p.key for p in problems_of(text(TABLE, ALARM), EXAMPLE)} == {
        "pipeline.kurtosis",
        f"alarms[{text(ALARM).count('[[alarms]]') - 1}].detector",
    }


def test_one_that_cannot_be_loaded_is_said_where_it_is_asked_for(installed):
    installed(kurtosis="nobody_has_this:KurtosisPlugin")
    assert parse_machine_file(text(), EXAMPLE).detectors == ()
    problem = the_problem(text(TABLE))
    assert "the detector cannot be loaded from nobody_has_this:KurtosisPlugin: No module" in str(problem)
    assert "install the package that brings it again, or remove [pipeline.kurtosis]" in str(problem)
    assert problem.line == text(TABLE).splitlines().index("[pipeline.kurtosis]") + 1
