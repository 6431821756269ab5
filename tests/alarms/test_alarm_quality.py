"""Quality alarms: who has what against which sensor, until he takes it back."""

from __future__ import annotations

import json
from itertools import pairwise

import numpy as np
import pytest
from support.alarm_rig import RIG, SECOND_NS, AlarmRig, alarm_handling, kinds
from support.clocks import SettableClock

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.manager import AlarmManager
from daqsvc.alarms.quality import UNHEARD_NS, Lacking, SensorHealth
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


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize(
    ("first", "then", "name"),
    [
        ((), ("accel-de",), "detector-ok/bearing"),
        (("accel-de",), (), "sensor-ok/accel-de"),
        ((), (), "detector-ok/bearing"),
    ],
)
def test_a_failure_and_missing_samples_take_back_nothing_of_each_other(first, then, name, restarted):
    rig = AlarmRig(BEARING)
    rig.mode("F1", "alert", "good", ("accel-de",), detector="bearing")
    assert kinds(bearing(rig, "missing", first, "it has failed")) == [(name, "raised")]
    if restarted:
        rig = rig.restarted({"bearing": ("accel-de",)})
    assert "returned" not in str(kinds(bearing(rig, "missing", then, "no samples")))
    assert rig.status(name).state.is_active
    assert rig.status("bearing-damage").state.is_active
    assert (name, "returned") in kinds(bearing(rig, "good", ("accel-de",)))
    assert not rig.status(name).state.is_active


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
    assert bearing(after, "good", ("probe-x",)) == [], "it was not OK by the other one, and is"
    assert after.status("vibration-x").state.value == "suppressed"
    assert kinds(after.rms(0.0)) == [("sensor-ok/probe-x", "returned"), ("vibration-x", "unsuppressed")]


@pytest.mark.parametrize("acknowledged", [False, True])
@pytest.mark.parametrize("restarted", [False, True])
def test_who_joins_in_with_nothing_new_to_say_is_no_event(acknowledged, restarted):
    """Two detectors miss the samples of one sensor: one line, and one return when neither does."""
    rig = AlarmRig(LEVEL)
    assert kinds(rig.rms(0.0, "missing", reason="no samples")) == [("sensor-ok/probe-x", "raised")]
    if acknowledged:
        rig.acknowledge("sensor-ok/probe-x")
    if restarted:
        rig = rig.restarted(SPEAKERS)
    assert bearing(rig, "missing", ("probe-x",), "no samples") == []
    assert rig.rms(0.0, "missing", reason="no samples") == []
    shelved = rig.shelve("sensor-ok/probe-x", 60.0)
    assert [doubt.detector for doubt in shelved.doubts] == ["bearing", "levels/probe-x"], "told with the next"
    rig.ask(Verb.UNSHELVE, "sensor-ok/probe-x")
    for _ in range(4):
        assert rig.rms(0.0) == [], "the other one still misses them"
    changed = bearing(rig, "not_ok", ("probe-x",), "clipped")[0]
    assert changed.message == "sensor-ok/probe-x alert: probe-x not OK: clipped"
    assert kinds(bearing(rig, "good", ("probe-x",)))[0] == ("sensor-ok/probe-x", "returned")


@pytest.mark.parametrize("other", ["missing", "good", "silent"])
def test_after_a_restart_a_quality_alarm_waits_for_who_may_have_joined_in(other):
    """The journal knows only of the first who missed the samples; who never speaks is not waited for long."""
    rig = AlarmRig(LEVEL)
    rig.rms(0.0, "not_ok", reason="no samples")
    bearing(rig, "not_ok", ("probe-x",), "no samples")
    assert kinds(rig.events) == [("sensor-ok/probe-x", "raised"), ("vibration-x", "suppressed")]
    after, restarted_ns = rig.restarted(SPEAKERS), rig.clock.t_ns
    assert ("sensor-ok/probe-x", "returned") not in kinds(after.rms(0.0))
    if other == "silent":
        while not (events := after.tick()):
            pass
        assert UNHEARD_NS <= after.clock.t_ns - restarted_ns <= UNHEARD_NS + SECOND_NS
    elif other == "missing":
        bearing(after, "missing", ("probe-x",), "no samples")
        assert after.tick(100.0) == [], "it has spoken, and stands by it"
        events = bearing(after, "good", ("probe-x",))
        for _ in range(5):
            events = events or bearing(after, "good", ("probe-x",))
    else:
        events = bearing(after, "good", ("probe-x",))
    assert kinds(events) == [("sensor-ok/probe-x", "returned")]


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
    chatter = (1, 60, 10)
    rig = AlarmRig(LEVEL, handling=alarm_handling(chatter=chatter))
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


def revolution(rig, frames_there, quality="good"):
    """A statement of the rotor bank, ten a second, about a revolution of some frames."""
    share = 1.0 - frames_there.mean()
    quality = "missing" if share > 0.5 else quality
    statement = {"decision": "normal", "severity": "normal", "sensors": ("probe-x", "probe-y")}
    return rig.take(0.1, detector="bank", quality=quality, missing_share=share, reason="lost", **statement)


@pytest.mark.parametrize("lost", [0.15, 0.3, 0.45])
def test_frames_lost_at_random_are_one_quality_alarm_while_they_last(lost):
    rng = np.random.default_rng(3)
    rig = AlarmRig(BEARING, handling=alarm_handling(chatter=(5, 60, 60)))
    lacking = [rng.random(6) >= lost for _ in range(600)]
    assert sum((there.mean() < 0.5) != (then.mean() < 0.5) for there, then in pairwise(lacking)) > 4
    for there in lacking:
        revolution(rig, there)
    assert kinds(rig.events) == [("detector-ok/bank", "raised")]
    end_ns = rig.clock.t_ns
    for _ in range(80):
        revolution(rig, np.ones(6))
    assert kinds(rig.events[1:]) == [("detector-ok/bank", "returned")]
    # At 45 % it takes longest until no more than a tenth of the last 5 s is missing.
    assert 0.5 < (rig.events[1].t_ns - end_ns) / SECOND_NS < 5.0


def test_a_revolution_that_could_not_be_judged_is_over_when_some_seconds_were_good():
    rig = AlarmRig(BEARING)
    assert kinds(revolution(rig, np.zeros(6))) == [("detector-ok/bank", "raised")]
    raised_ns = rig.clock.t_ns
    while not (events := revolution(rig, np.ones(6))):
        pass
    assert kinds(events) == [("detector-ok/bank", "returned")]
    assert 3.0 <= (rig.clock.t_ns - raised_ns) / SECOND_NS < 3.2


@pytest.mark.parametrize("says_share", [True, False])
def test_a_restart_does_not_cut_short_how_long_samples_must_be_good(says_share):
    rig = AlarmRig(BEARING)
    if says_share:
        revolution(rig, np.zeros(6))
        rig = rig.restarted({"bank": ("probe-x", "probe-y")})
        restarted_ns = rig.clock.t_ns
        while not (events := revolution(rig, np.ones(6))):
            pass
        assert 3.0 <= (rig.clock.t_ns - restarted_ns) / SECOND_NS < 3.2
    else:
        bearing(rig, "missing", ("accel-de", "accel-fe"))
        rig = rig.restarted({"bearing": ("accel-de", "accel-fe")})
        events = bearing(rig, "good", ("accel-de", "accel-fe"))
    assert [kind for _, kind in kinds(events)] == ["returned"]


@pytest.mark.parametrize("cut", range(1, 75, 3))
def test_a_replay_from_amid_a_shortage_returns_the_alarm_when_it_returned(cut):
    """The service is never asked: what the statements until then come to is all that the replay gets."""
    rng = np.random.default_rng(cut)
    rig, until_then = AlarmRig(BEARING), SensorHealth()
    there = [rng.random(6) >= 0.45 for _ in range(30)] + [np.ones(6)] * 60
    taken = []
    for number, one in enumerate(there):
        revolution(rig, one)
        taken.append(rig.last)
        if number < cut:
            until_then.update(rig.last, rig.last.t_ns)
    before = [event for event in rig.events if event.t_ns <= taken[cut - 1].t_ns]
    replayed = AlarmManager(RIG, (BEARING,), SettableClock())
    replayed.resume(before[-1:], {"bank": ("probe-x", "probe-y")}, restarted=False)
    lacking = json.loads(json.dumps({name: one._asdict() for name, one in until_then.lacking().items()}))
    replayed.remember({name: Lacking.of(one) for name, one in lacking.items()})
    events = [event for one in taken[cut:] for event in replayed.take(one)]
    assert [(e.alarm, e.kind, e.t_ns) for e in events] == [
        (e.alarm, e.kind, e.t_ns) for e in rig.events[len(before) :]
    ]
    assert len(rig.events) == 2


def test_lost_frames_do_not_keep_a_sensor_not_ok_that_samples_show_to_be_ok():
    rig = AlarmRig(LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0)))
    say = lambda quality, share: rig.take(  # noqa: E731
        detector="levels/probe-x",
        decision="normal",
        statistics={"rms": 0.0},
        quality=quality,
        missing_share=share,
        sensors=("probe-x",),
    )
    say("not_ok", 0.0)
    say("missing", 1.0)
    assert rig.status("vibration-x").state.value == "suppressed"
    assert kinds(say("good", 0.0)) == [("sensor-ok/probe-x", "changed"), ("vibration-x", "unsuppressed")]


def test_a_chattering_quality_alarm_is_no_event_each_time_samples_are_missing():
    rig = AlarmRig(BEARING, handling=alarm_handling(chatter=(1, 60, 10)))
    for quality in ["missing", "good"] * 20:
        bearing(rig, quality, ("accel-de", "accel-fe"))
    assert [kind for _, kind in kinds(rig.events)] == ["raised", "returned", "raised", "chattering"]
    for _ in range(12):
        bearing(rig, "good", ("accel-de", "accel-fe"))
    assert [kind for _, kind in kinds(rig.events[4:])] == ["quiet", "returned"]


def test_a_sensor_that_flickers_is_an_event_every_few_seconds_at_most():
    rig = AlarmRig(LEVEL, handling=alarm_handling(chatter=(1, 60, 10)))
    for quality in ["not_ok", "good"] * 60:
        rig.rms(0.0, quality, seconds=0.25)
    told = [event for event in rig.events if event.kind.value == "changed"]
    assert 2 <= len(told) <= 2 * 30 / 5
    assert rig.status("sensor-ok/probe-x").chattering
    for _ in range(24):
        rig.rms(0.0, seconds=0.25)
    assert rig.events[-1].doubts == ()


def silent(rig, reason, seconds=0.5):
    return rig.take(
        seconds,
        detector="levels/probe-x",
        decision="normal",
        quality="missing",
        reason=reason,
        sensors=("probe-x",),
        end_index=0,
    )


def test_reasons_that_alternate_are_an_event_every_few_seconds_and_the_last_one_is_told():
    rig = AlarmRig(LEVEL)
    assert kinds(silent(rig, "no samples of shaft for 2.0 s")) == [("sensor-ok/probe-x", "raised")]
    (changed,) = silent(rig, "the device sends 320 Hz, the file states 640")
    assert (changed.kind.value, changed.message[-44:]) == (
        "changed",
        "the device sends 320 Hz, the file states 640",
    )
    for _ in range(30):
        silent(rig, "the counter makes no sense")
        silent(rig, "the device sends 320 Hz, the file states 640")
    assert 4 <= len(rig.events) <= 2 + 30 / 5
    silent(rig, "the counter stands still at 7")
    for _ in range(6):
        rig.tick()
    assert rig.events[-1].message.endswith("the counter stands still at 7")
    assert rig.tick(10.0) == []


def test_a_reason_that_waits_is_dropped_when_the_sensor_is_good_again():
    rig = AlarmRig(LEVEL)
    for reason in ["no samples", "the rate is wrong", "the counter makes no sense"]:
        silent(rig, reason)
    assert kinds(rig.rms(0.0)) == [("sensor-ok/probe-x", "returned")]
    assert rig.tick(10.0) == []


def test_other_words_for_the_same_sensor_are_told_once_other_figures_are_not():
    rig = AlarmRig(LEVEL)

    def stuck(reason):
        return kinds(rig.rms(0.0, "not_ok", reason=reason))

    assert ("sensor-ok/probe-x", "raised") in stuck("stuck at 0.431 g for 38 of 200 samples")
    assert stuck("stuck at 0.432 g for 1e+02 of 200 samples") == []
    assert stuck("does not move at all (0.431 g)") == [("sensor-ok/probe-x", "changed")]
    assert rig.status("sensor-ok/probe-x").message.endswith("does not move at all (0.431 g)")
    for _ in range(20):
        assert stuck("does not move at all (0.432 g)") == []
    for reason in ["is clipped", "does not move at all (1 g)"] * 10:
        stuck(reason)
    assert len(rig.events) <= 3 + 20 / 5 + 1
    stuck("is outside its limits")
    rig.tick(5.0)
    assert rig.events[-1].message.endswith("is outside its limits")
    after = rig.restarted(SPEAKERS)
    assert kinds(after.rms(0.0, "not_ok", reason="is outside its limits")) == []


def test_a_flood_of_a_lost_device_names_its_stream_and_no_alarm_that_has_returned():
    level = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0))
    rig = AlarmRig(level, handling=alarm_handling(flood=(5, 600)))
    rig.rms(50.0)
    rig.rms(0.0)
    assert rig.status("vibration-x").first_out
    for i in range(5):
        rig.take(
            detector=f"levels/p{i}",
            stream="device",
            decision="normal",
            quality="missing",
            reason="no samples of stream 'device' for 2.0 s",
            sensors=(f"p{i}",),
            end_index=0,
        )
    flood = rig.status("alarm-flood")
    assert flood.message.endswith(
        "5 sensors rest on stream 'device': look at bus and device first, shelve what is known"
    )


def test_a_flood_of_a_lost_device_names_the_alarm_that_came_first_too():
    level = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0))
    rig = AlarmRig(level, handling=alarm_handling(flood=(5, 600)))
    rig.rms(50.0)
    for i in range(5):
        sensors = (f"p{i}",)
        rig.take(detector=f"levels/p{i}", decision="normal", quality="missing", sensors=sensors, end_index=0)
    assert (
        "at bus and device first, then at vibration-x (first out), shelve"
        in rig.status("alarm-flood").message
    )
