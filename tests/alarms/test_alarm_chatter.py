"""Chatter and floods: seen, counted, and nothing lost."""

from __future__ import annotations

import pytest
from support.alarm_rig import AlarmRig, alarm_handling, kinds

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, Level

LEVEL = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0, danger=60.0))
LATCHING = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0, danger=60.0), latching=True)
CHATTER = alarm_handling(chatter=(3, 60, 10))
SPEAKERS = {"levels/probe-x": ("probe-x",)}


def chattering(rule=LEVEL, handling=CHATTER):
    rig = AlarmRig(rule, handling=handling)
    for _ in range(3):
        assert not any(event.kind.value == "chattering" for event in rig.rms(50.0) + rig.rms(0.0))
    assert kinds(rig.rms(50.0))[-1] == ("vibration-x", "chattering")
    return rig


def test_one_raise_too_many_is_chatter_and_the_alarm_stays_until_it_is_quiet():
    rig = chattering()
    occurrence = rig.status("vibration-x").occurrence
    for _ in range(20):
        assert rig.rms(0.0) == rig.rms(50.0) == []
    status = rig.status("vibration-x")
    assert (status.state, status.chattering, status.occurrence) == (
        AlarmState.ACTIVE_UNACKNOWLEDGED,
        True,
        occurrence,
    )
    assert rig.manager.counters.chattering == 1
    for _ in range(10):
        assert rig.rms(0.0) == []
    assert kinds(rig.rms(0.0)) == [("vibration-x", "quiet"), ("vibration-x", "returned")]


def test_a_chattering_alarm_keeps_its_worst_level_and_tells_of_a_worse_one():
    rig = chattering()
    assert kinds(rig.rms(70.0)) == [("vibration-x", "escalated")]
    for _ in range(10):
        assert rig.rms(50.0) == []
    assert kinds(rig.rms(50.0)) == [("vibration-x", "quiet"), ("vibration-x", "lowered")]


def test_gaps_do_not_count_as_quiet():
    rig = chattering()
    for _ in range(8):
        rig.rms(0.0)
    rig.rms(0.0, "missing", seconds=100.0)
    rig.rms(0.0, seconds=100.0)
    assert rig.status("vibration-x").chattering
    rig.rms(0.0)
    assert rig.status("vibration-x").chattering
    assert ("vibration-x", "quiet") in kinds(rig.rms(0.0) + rig.rms(0.0))


def test_quiet_is_a_time_and_no_number_of_statements():
    rig = chattering()
    for _ in range(99):
        assert rig.rms(0.0, seconds=0.1) == []
    assert rig.status("vibration-x").chattering
    assert ("vibration-x", "quiet") in kinds(rig.rms(0.0, seconds=0.1) + rig.rms(0.0, seconds=0.1))


def test_slow_raises_are_no_chatter():
    rig = AlarmRig(LEVEL, handling=CHATTER)
    for _ in range(10):
        rig.rms(50.0, seconds=15.0)
        assert not rig.status("vibration-x").chattering
        assert kinds(rig.rms(0.0, seconds=15.0)) == [("vibration-x", "returned")]


def test_a_latching_alarm_chatters_by_its_recurrences():
    rig = chattering(LATCHING)
    assert rig.rms(0.0) == []
    assert rig.status("vibration-x").state is AlarmState.ACTIVE_UNACKNOWLEDGED
    for _ in range(10):
        rig.rms(0.0)
    assert rig.status("vibration-x").state is AlarmState.LATCHED_UNACKNOWLEDGED


def test_a_chattering_alarm_chatters_after_a_restart():
    after = chattering().restarted(SPEAKERS)
    assert after.status("vibration-x").chattering
    for _ in range(10):
        assert after.rms(0.0) == []
    assert kinds(after.rms(0.0)) == [("vibration-x", "quiet"), ("vibration-x", "returned")]


def flooded():
    rules = [LevelRule(f"v{i}", f"p{i}", "rms", Setpoint(alert=40.0)) for i in range(6)]
    rig = AlarmRig(*rules, handling=alarm_handling(flood=(5, 600)))
    for i in range(5):
        assert kinds(rig.rms(50.0, sensor=f"p{i}")) == [(f"v{i}", "raised")]
    return rig


def test_a_flood_is_an_alarm_of_its_own_counted_and_nothing_is_dropped():
    rig = flooded()
    events = rig.rms(50.0, sensor="p5")
    assert kinds(events) == [("v5", "raised"), ("alarm-flood", "raised")]
    assert "6 alarms within 10 min are more than a person can attend to (limit 5)" in events[1].message
    assert rig.manager.counters.floods == 1
    assert kinds(rig.rms(0.0, sensor="p5")) == [("v5", "returned")]
    assert rig.tick(597.0) == []
    (over,) = rig.tick(0.5)
    assert (over.alarm, over.kind.value) == ("alarm-flood", "returned")
    assert "only 2 alarms in the last 10 min" in over.message


def test_a_covered_alarm_calls_for_nobody_and_is_no_part_of_a_flood():
    rules = [LevelRule(f"v{i}", f"p{i}", "rms", Setpoint(alert=40.0)) for i in range(8)]
    rig = AlarmRig(*rules, handling=alarm_handling(flood=(5, 600)))
    rig.shelve("v0", 300.0)
    rig.ask(Verb.BYPASS, "v1")
    for i in range(7):
        (event,) = rig.rms(50.0, sensor=f"p{i}")
        assert (event.alarm, event.kind.value) == (f"v{i}", "raised")
    assert rig.manager.counters.annunciations == 5
    assert kinds(rig.tick(300.0)) == [("v0", "unshelved"), ("alarm-flood", "raised")], "it is seen now"
    assert rig.manager.counters.annunciations == 6


@pytest.mark.parametrize("acknowledged", [False, True])
def test_an_alarm_that_comes_out_of_its_cover_calls_if_nobody_has_acknowledged_it(*, acknowledged):
    rig = AlarmRig(LEVEL, handling=alarm_handling(flood=(5, 600)))
    rig.rms(50.0)
    if acknowledged:
        rig.acknowledge("vibration-x")
    rig.shelve("vibration-x", 60.0)
    rig.ask(Verb.UNSHELVE, "vibration-x")
    assert rig.manager.counters.annunciations == (1 if acknowledged else 2)


def test_each_sensor_calls_once_whatever_else_is_said_against_it():
    rig = AlarmRig(LEVEL, handling=alarm_handling(flood=(5, 600)))
    for n in range(40):
        rig.rms(0.0, "missing" if n % 3 else "not_ok", reason=f"reason {n % 5}", seconds=20.0)
    assert {event.kind.value for event in rig.events if event.alarm == "sensor-ok/probe-x"} == {
        "raised",
        "changed",
    }
    assert (rig.manager.counters.annunciations, rig.manager.counters.floods) == (1, 0)


def test_a_flood_points_to_the_alarm_that_is_first_out():
    rig = flooded()
    flood = rig.rms(50.0, sensor="p5")[-1]
    assert flood.message.endswith("(limit 5); look at v0 first (first out), shelve what is known")
    assert rig.status("v0").first_out


def test_a_flood_of_sensor_alarms_points_to_no_first_out_for_there_is_none():
    rig = AlarmRig(LEVEL, handling=alarm_handling(flood=(5, 600)))
    flood = [rig.rms(0.0, "missing", sensor=f"p{i}")[-1] for i in range(6)][-1]
    assert (flood.alarm, flood.kind.value) == ("alarm-flood", "raised")
    assert flood.message.endswith("(limit 5); shelve what is known")
    assert not any(status.first_out for status in rig.manager.alarms.values())


def test_a_flood_outlives_a_restart_until_a_whole_window_shows_that_it_is_over():
    rig = flooded()
    rig.rms(50.0, sensor="p5")
    after = rig.restarted({f"levels/p{i}": (f"p{i}",) for i in range(6)})
    assert after.tick(599.0) == []
    assert after.status("alarm-flood").state is AlarmState.ACTIVE_UNACKNOWLEDGED
    assert kinds(after.tick(2.0)) == [("alarm-flood", "returned")]


def test_a_flood_that_nobody_counts_any_more_is_returned_by_the_restart():
    rig = flooded()
    rig.rms(50.0, sensor="p5")
    rig.handling = alarm_handling()
    after = rig.restarted({f"levels/p{i}": (f"p{i}",) for i in range(6)})
    assert kinds(after.events[-1:]) == [("alarm-flood", "returned")]
    assert "alarm-flood" not in after.manager.alarms


def test_without_limits_nothing_chatters_and_nothing_is_a_flood():
    rig = AlarmRig(LEVEL)
    for _ in range(50):
        assert kinds(rig.rms(50.0) + rig.rms(0.0)) == [("vibration-x", "raised"), ("vibration-x", "returned")]
    assert rig.status("vibration-x").level is Level.NORMAL
