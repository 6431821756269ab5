"""The document of alarms says what the code does: its picture is drawn from the moves, its example read."""

from __future__ import annotations

import re
import tomllib
from typing import get_args

import pytest
from support.alarm_rig import AlarmRig
from support.paths import ROOT

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.conditions import RESERVED
from daqsvc.alarms.make import alarm_rule
from daqsvc.alarms.states import AlarmState, moves
from daqsvc.detectors.levels.settings import Levels
from daqsvc.settings.alarms import AlarmHandling, DiagnosisAlarm, LevelAlarm, StartUp, VotingAlarm
from daqsvc.settings.measures import Measure
from daqsvc.settings.sensors import TrendValue
from daqsvc.settings.zones import Zones

TEXT = (ROOT / "docs" / "alarms.md").read_text(encoding="utf-8")


def fenced(language):
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_the_picture_has_every_move_and_no_other():
    """If this fails, run: make pictures ARGS=alarm-states."""
    assert "(pictures/alarm-states.svg)" in TEXT
    picture = (ROOT / "docs" / "pictures" / "alarm-states.svg").read_text(encoding="utf-8")
    drawn = {
        (state, stimulus, after, latching)
        for state, stimulus, after, kind in re.findall(r'<g id="(\w+)\.(\w+)\.(\w+)\.(\w+)">', picture)
        for latching in (False, True)
        if kind == "both" or (kind == "latching") == latching
    }
    made = {
        (state.value, stimulus.value, after.value, latching)
        for latching in (False, True)
        for (state, stimulus), after in moves(latching=latching).items()
    }
    assert drawn == made


@pytest.mark.parametrize("word", [*AlarmState, *Verb, *sorted(RESERVED)])
def test_every_state_verb_and_own_alarm_is_explained(word):
    assert f"`{word}`" in TEXT


def test_the_example_is_valid_has_every_key_and_the_defaults():
    example, *_ = map(tomllib.loads, fenced("toml"))
    level, vote, both_sides, region, phase, zones, detector = example["alarms"]
    assert LevelAlarm.model_validate(level).trip_multiply == 2.0
    assert VotingAlarm.model_validate(vote).vote == 2
    assert DiagnosisAlarm.model_validate(detector).evidence_nats == 18.0
    handling = dict(example["alarm_handling"])
    start_up = handling.pop("start_up")
    assert handling == AlarmHandling().model_dump(exclude={"start_up"})
    assert set(start_up) == set(StartUp.model_fields)
    assert StartUp.model_validate(start_up).at_most_s == StartUp.model_fields["at_most_s"].default
    assert LevelAlarm.model_validate(both_sides).setpoints == {
        "danger_low": 5.0,
        "alert_low": 10.0,
        "alert": 65.0,
        "danger": 75.0,
    }
    (*_, acceptance) = alarm_rule(LevelAlarm.model_validate(region)).limits({}).partition(", 1x_phase_lag ")
    assert acceptance == "alert 30 and danger 60 from 135"
    assert LevelAlarm.model_validate(phase).reference_deg == 350.0
    assert LevelAlarm.model_validate(zones).zones == Zones(standard="iso-20816-3", group=2, support="rigid")
    named = {*level, *both_sides, *region, *phase, *zones, "sensors", "vote"}
    assert named == set(LevelAlarm.model_fields) | set(VotingAlarm.model_fields)


def test_every_measure_is_in_the_table_and_the_trend_value_has_every_key():
    table = "".join(re.findall(r"^\| `.*`.*\|$", TEXT.split("| `measure` |")[1], re.MULTILINE))
    assert all(f"`{measure}`" in table for measure in get_args(Measure))
    _, example, _ = map(tomllib.loads, fenced("toml"))
    (sensor,) = example["sensors"]
    assert TrendValue.model_validate(sensor).ok_between == (-40.0, 125.0)
    assert set(sensor) == set(TrendValue.model_fields) - {"sensitivity_mv_per_unit", "zero_v"}
    assert Levels.model_validate(example["pipeline"]["levels"]) == Levels()


@pytest.mark.parametrize(("state", "level"), [(0.0, "normal"), (1.0, "alert"), (2.0, "danger")])
def test_an_enum_signal_raises_the_alarm_of_its_state(state, level):
    _, _, example = map(tomllib.loads, fenced("toml"))
    (sensor,), (alarm,) = example["sensors"], example["alarms"]
    assert TrendValue.model_validate(sensor).unit == "1"
    rig = AlarmRig(alarm_rule(LevelAlarm.model_validate(alarm)))
    rig.take_state("drive-state", state, times=5)
    assert rig.status("drive-state").level.label == level
