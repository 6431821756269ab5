"""Quality alarms: who has what against which sensor, until he takes it back."""

from __future__ import annotations

from alarm_rig import SECOND_NS, AlarmRig, kinds

from daqsvc.alarms.chatter import ChatterLimit
from daqsvc.alarms.commands import Verb
from daqsvc.alarms.handling import AlarmHandling
from daqsvc.alarms.rules import DiagnosisRule, LevelRule
from daqsvc.alarms.setpoints import Setpoint

LEVEL = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0))
BEARING = DiagnosisRule("bearing-damage", "bearing")
SPEAKERS = {"levels/probe-x": ("probe-x",), "bearing": ("probe-x",)}


def bearing(rig, quality, sensors, reason=""):
    return rig.mode("normal", "normal", quality, sensors, detector="bearing", reason=reason)


def test_a_detector_that_comes_to_rest_on_one_sensor_takes_back_what_it_had_against_all():
    rig = AlarmRig(BEARING)
    assert kinds(bearing(rig, "missing", ("accel-de", "accel-fe"))) == [("detector-ok/bearing", "raised")]
    assert kinds(bearing(rig, "good", ("accel-de",))) == [("detector-ok/bearing", "returned")]


def test_a_doubt_moves_with_its_detector():
    rig = AlarmRig(BEARING)
    bearing(rig, "not_ok", ("accel-de", "accel-fe"))
    assert kinds(bearing(rig, "not_ok", ("accel-fe",))) == [
        ("detector-ok/bearing", "returned"),
        ("sensor-ok/accel-fe", "raised"),
    ]


def test_every_doubter_is_told_and_the_worst_is_heard_first():
    rig = AlarmRig(LEVEL)
    (raised,) = bearing(rig, "missing", ("probe-x",), "no samples")
    assert [doubt.detector for doubt in raised.doubts] == ["bearing"]
    changed = rig.rms(0.0, "not_ok", reason="gap voltage is -0.1 V")[0]
    assert (changed.kind.value, changed.occurrence) == ("changed", raised.occurrence)
    assert "not OK: gap voltage is -0.1 V" in changed.message
    assert [(doubt.detector, doubt.not_ok) for doubt in changed.doubts] == [
        ("bearing", False),
        ("levels/probe-x", True),
    ]


def test_all_doubters_are_remembered_over_a_restart():
    rig = AlarmRig(LEVEL)
    rig.rms(0.0, "not_ok", reason="dead")
    bearing(rig, "missing", ("probe-x",))
    after = rig.restarted(SPEAKERS)
    assert kinds(bearing(after, "good", ("probe-x",))) == [("sensor-ok/probe-x", "changed")]
    assert after.status("vibration-x").state.value == "suppressed"
    assert kinds(after.rms(0.0)) == [("sensor-ok/probe-x", "returned"), ("vibration-x", "unsuppressed")]


def test_an_acknowledged_quality_alarm_still_knows_after_a_restart_that_the_sensor_was_not_ok():
    rig = AlarmRig(LEVEL)
    rig.rms(0.0, "not_ok")
    rig.rms(0.0, "missing")
    rig.acknowledge("sensor-ok/probe-x")
    rig = rig.restarted(SPEAKERS)
    rig.shelve("sensor-ok/probe-x", 60.0)
    rig.ask(Verb.UNSHELVE, "sensor-ok/probe-x")
    after = rig.restarted(SPEAKERS)  # the second time the journal knows only what the first one knew
    assert after.status("sensor-ok/probe-x").state.value == "active_acknowledged"
    assert after.rms(50.0, "missing") == []
    assert after.status("vibration-x").state.value == "suppressed"
    assert kinds(after.rms(50.0))[-1] == ("vibration-x", "raised")


def test_a_chattering_quality_alarm_tells_who_doubts_although_its_returns_are_held_back():
    chatter = ChatterLimit(1, 60 * SECOND_NS, 10 * SECOND_NS)
    rig = AlarmRig(LEVEL, handling=AlarmHandling(chatter=chatter))
    for quality in ["not_ok", "good", "not_ok"]:
        rig.rms(50.0, quality)
    assert rig.status("sensor-ok/probe-x").chattering
    changed = rig.rms(50.0)[0]
    assert (changed.kind.value, changed.doubts, changed.covered) == ("changed", (), None)
    assert "until it is quiet: probe-x is good again" in changed.message
    assert rig.rms(50.0) == []
    after = rig.restarted(SPEAKERS)
    assert kinds(bearing(after, "missing", ("accel-de",))) == [("sensor-ok/accel-de", "raised")]
    assert after.status("vibration-x").state.value == "active_unacknowledged"
    assert kinds(after.rms(50.0, "not_ok"))[0] == ("sensor-ok/probe-x", "changed")
    assert after.status("vibration-x").state.value == "suppressed"


def test_a_quality_alarm_is_bypassed_like_any_other_and_the_suppression_stays():
    rig = AlarmRig(LEVEL)
    rig.rms(0.0, "not_ok")
    rig.ask(Verb.BYPASS, "sensor-ok/probe-x")
    assert rig.status("vibration-x").state.value == "suppressed"
    assert rig.rms(50.0)[0].to_state.value == "out_of_service"
