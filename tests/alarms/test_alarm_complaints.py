"""What users of other alarm systems complain about does not happen here; one test a complaint."""

from __future__ import annotations

import pytest
from support.alarm_rig import SECOND_NS, AlarmRig, alarm_handling, kinds

from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState

PLAIN = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0))
DELAYED = LevelRule(
    "vibration-x",
    "probe-x",
    "rms",
    Setpoint(alert=40.0, deadband=2.0, on_delay_ns=3 * SECOND_NS, off_delay_ns=5 * SECOND_NS),
)
SPEAKERS = {"levels/probe-x": ("probe-x",)}


def test_flap_a_value_at_its_limit_is_one_alarm():
    """alertmanager 204, 3048, 1546: alerts that flap around their threshold notify every time."""
    handling = alarm_handling(chatter=(5, 60, 60))
    rig = AlarmRig(PLAIN, handling=handling)
    for second in range(600):
        rig.rms(39.9 if second % 2 else 40.1)
    raised = [event for event in rig.events if event.kind.value == "raised"]
    assert len(raised) == 6
    assert kinds(rig.events[-1:]) == [("vibration-x", "chattering")]


def test_flap_a_spike_or_a_dip_shorter_than_its_delay_is_nothing():
    """VictoriaMetrics 5828: keep firing for a while, or a dip of one sample is a new alert."""
    rig = AlarmRig(DELAYED)
    for value in [50.0, 0.0, 50.0, 50.0, 0.0]:
        assert rig.rms(value) == []
    for _ in range(4):
        rig.rms(50.0)
    assert [event.kind.value for event in rig.events] == ["raised"]
    for value in [0.0, 0.0, 50.0, 0.0, 39.0, 50.0]:
        assert rig.rms(value) == []


def test_flood_is_seen_and_counted_and_every_alarm_of_it_is_told():
    """alerta 344: nobody sees that there are more alarms than he can read, or some are swallowed."""
    rules = [LevelRule(f"v{i}", f"p{i}", "rms", Setpoint(alert=40.0)) for i in range(40)]
    rig = AlarmRig(*rules, handling=alarm_handling(flood=(10, 600)))
    for i in range(40):
        rig.rms(50.0, sensor=f"p{i}", seconds=0.1)
    raised = {event.alarm for event in rig.events if event.kind.value == "raised"}
    assert raised == {f"v{i}" for i in range(40)} | {"alarm-flood"}
    assert (rig.manager.counters.annunciations, rig.manager.counters.floods) == (40, 1)


def test_gaps_neither_resolve_an_alarm_nor_raise_it_afresh():
    """prometheus 14085: a gap resolves the alert, and its end notifies as if it were new."""
    rig = AlarmRig(DELAYED)
    for _ in range(4):
        rig.rms(50.0)
    occurrence = rig.status("vibration-x").occurrence
    assert kinds(rig.rms(0.0, "missing", seconds=300.0)) == [("sensor-ok/probe-x", "raised")]
    assert rig.tick(3600.0) == []
    assert kinds(rig.rms(50.0)) == [("sensor-ok/probe-x", "returned")]
    status = rig.status("vibration-x")
    assert (status.state, status.occurrence) == (AlarmState.ACTIVE_UNACKNOWLEDGED, occurrence)


@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_clock_jumps_raise_clear_and_reorder_nothing(step_s):
    """netdata 1313, chronos 85, device-sdk-go 314: a step of the wall clock fires or clears alarms."""
    steady, stepped = AlarmRig(DELAYED, PLAIN_Y), AlarmRig(DELAYED, PLAIN_Y)
    for rig in (steady, stepped):
        rig.rms(50.0, sensor="probe-y")
        rig.shelve("vibration-y", 30.0)
        rig.rms(50.0)
        rig.rms(50.0)
        if rig is stepped:
            rig.clock.set_wall(step_s)
        assert rig.tick() == []
        for _ in range(3):
            rig.rms(50.0)
        for _ in range(40):
            rig.rms(0.0)
            rig.tick(0.0)

    def story(rig):
        return [(event.alarm, event.kind, event.t_ns, event.to_state) for event in rig.events]

    assert story(stepped) == story(steady)
    labels = [event.wall_ns - event.t_ns for event in stepped.events]
    assert labels == sorted(labels, reverse=step_s < 0)
    assert {event.wall_ns - event.t_ns for event in steady.events} < set(labels)


def test_a_suspended_process_raises_clears_and_reorders_nothing():
    """After 30 s of standing still the first window says what is missing; delays have not run on."""
    rig = AlarmRig(DELAYED, PLAIN_Y)
    rig.rms(50.0)
    rig.rms(50.0)
    rig.rms(50.0, sensor="probe-y")
    rig.clock.advance(30.0)
    assert rig.tick(0.0) == []
    assert kinds(rig.rms(50.0, "missing")) == [("sensor-ok/probe-x", "raised")]
    assert kinds(rig.rms(50.0)) == [("sensor-ok/probe-x", "returned")]
    assert rig.rms(50.0) == []
    assert kinds(rig.rms(50.0)) == [("vibration-x", "raised")]


def test_a_restart_neither_notifies_afresh_nor_forgets_that_somebody_has_seen_it():
    """kubeedge 4995, telegraf 16500: after a restart everything is sent as if it were new."""
    rig = AlarmRig(PLAIN)
    rig.rms(50.0)
    rig.acknowledge("vibration-x")
    after = rig.restarted(SPEAKERS)
    for _ in range(5):
        assert after.rms(50.0) == []
    assert after.status("vibration-x").state is AlarmState.ACTIVE_ACKNOWLEDGED


PLAIN_Y = LevelRule("vibration-y", "probe-y", "rms", Setpoint(alert=40.0))
