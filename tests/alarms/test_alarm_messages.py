"""What messages of alarms say once something else has happened since."""

from __future__ import annotations

import pytest
from support.alarm_rig import RIG, SECOND_NS, AlarmRig, kinds

from daqsvc.alarms.manager import AlarmManager
from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint

BY_STEPS = Setpoint(alert=40.0, danger=60.0, deadband=2.0, off_delay_ns=3 * SECOND_NS)


def rule(setpoint):
    return LevelRule("vibration-x", "probe-x", "rms", setpoint)


def test_a_level_that_has_fallen_below_its_limit_says_when_the_alarm_ends():
    rig = AlarmRig(rule(BY_STEPS))
    rig.rms(70.0)
    for _ in range(3):
        rig.rms(50.0)
    (lowered,) = rig.rms(39.0)
    assert (
        lowered.message
        == "vibration-x alert: rms of probe-x is 39 um, alert limit 40 um, which ends below 38 um for 3 s"
    )


@pytest.mark.parametrize(
    ("setpoint", "values", "end"),
    [
        (Setpoint(alert=40.0, danger=60.0), (70.0, 50.0), "alert limit 40 um"),
        (
            Setpoint(alert_low=10.0, danger_low=5.0, off_delay_ns=SECOND_NS),
            (1.0, 7.0, 12.0),
            "which ends above 10 um for 1 s",
        ),
    ],
)
def test_a_limit_that_is_kept_or_not_on_either_side(setpoint, values, end):
    rig = AlarmRig(rule(setpoint))
    events = [event for value in values for event in rig.rms(value)]
    assert kinds(events)[-1] == ("vibration-x", "lowered")
    assert events[-1].message.endswith(end)


def test_other_limits_of_a_returned_alarm_say_that_it_has_returned():
    rig = AlarmRig(rule(BY_STEPS))
    rig.rms(70.0)
    for value in (50.0,) * 4 + (20.0,) * 4:
        rig.rms(value)
    assert rig.events[-1].kind.value == "returned"
    after = AlarmManager(RIG, [rule(Setpoint(alert=45.0))], rig.clock)
    last = {event.alarm: event for event in rig.events}
    after.resume(last.values(), {"levels/probe-x": ("probe-x",)})
    (changed,) = after.follow(rig.manager)
    assert changed.message == (
        "vibration-x returned to normal: rms of probe-x is 20 um, below its limit of 40 um; since then its "
        "limits are alert 45 um"
    )


def test_the_cause_is_told_beside_what_was_done_about_it():
    rig = AlarmRig(rule(BY_STEPS))
    rig.rms(50.0)
    raised = rig.status("vibration-x").summary
    rig.acknowledge("vibration-x", reason="seen")
    assert rig.status("vibration-x").summary == f"{raised}; vibration-x acknowledged by ann: seen"
    rig.shelve("vibration-x", 60.0)
    assert rig.status("vibration-x").summary == f"{raised}; vibration-x shelved by ann for 1 min"
