"""Shelving and out of service: what people lay over an alarm, and what goes on behind it."""

from __future__ import annotations

import math

import pytest
from support.alarm_rig import AlarmRig, alarm_handling, kinds

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.states import AlarmState, CommandNotAllowedError, Level

LEVEL = LevelRule("vibration-x", "probe-x", "rms", Setpoint(alert=40.0, danger=60.0, deadband=2.0))
SPEAKERS = {"levels/probe-x": ("probe-x",)}
S = AlarmState


def test_a_shelved_alarm_goes_on_behind_its_cover_and_reappears_when_its_time_is_over():
    rig = AlarmRig(LEVEL)
    rig.rms(50.0)
    shelved = rig.shelve("vibration-x", 60.0, reason="bearing is ordered")
    assert (shelved.from_state, shelved.to_state) == (S.ACTIVE_UNACKNOWLEDGED, S.SHELVED)
    assert shelved.message == "vibration-x shelved by ann for 1 min: bearing is ordered"
    assert (shelved.by, shelved.reason) == ("ann", "bearing is ordered")
    assert shelved.shelved_until_wall_ns == shelved.wall_ns + 60_000_000_000
    (escalated,) = rig.rms(70.0)
    assert (escalated.kind.value, escalated.to_state, escalated.to_level) == (
        "escalated",
        S.SHELVED,
        Level.DANGER,
    )
    assert rig.tick(58.5) == []
    (back,) = rig.tick(0.5)
    assert (back.kind.value, back.to_state, back.to_level) == (
        "unshelved",
        S.ACTIVE_UNACKNOWLEDGED,
        Level.DANGER,
    )
    assert (back.by, back.message) == ("", "vibration-x unshelved: its time is over")
    assert back.occurrence == shelved.occurrence


def test_a_shelved_alarm_that_returned_meanwhile_says_so_at_once():
    rig = AlarmRig(LEVEL)
    rig.rms(50.0)
    rig.acknowledge("vibration-x")
    rig.shelve("vibration-x", 60.0)
    (returned,) = rig.rms(0.0)
    assert (returned.kind.value, returned.to_state, returned.covered) == ("returned", S.SHELVED, S.NORMAL)
    assert rig.tick(60.0)[0].to_state is S.NORMAL


def test_shelving_again_sets_the_time_anew():
    rig = AlarmRig(LEVEL)
    rig.shelve("vibration-x", 10.0)
    rig.clock.advance(5.0)
    rig.shelve("vibration-x", 10.0)
    assert rig.tick(9.0) == []
    assert kinds(rig.tick(1.0)) == [("vibration-x", "unshelved")]


@pytest.mark.parametrize("seconds", [None, 0.0, -1.0, math.nan, math.inf, 100.5])
def test_shelving_needs_a_time_that_is_allowed(seconds):
    rig = AlarmRig(LEVEL, handling=alarm_handling(shelve_at_most_s=100.0))
    with pytest.raises(CommandNotAllowedError, match="state a time above 0 and up to 1m40s"):
        rig.shelve("vibration-x", seconds)
    assert rig.status("vibration-x").state is S.NORMAL
    assert (rig.manager.counters.refused, rig.manager.counters.commands) == (1, 0)


@pytest.mark.parametrize(
    ("asked_s", "longest_s", "words"),
    [
        (43_200.0, 28_800.0, "for 12h; state a time above 0 and up to 8h"),
        (28_800.5, 28_800.0, "for 8h0.5s; state a time above 0 and up to 8h"),
        (5400.0, 90.0, "for 1h30m; state a time above 0 and up to 1m30s"),
        (2 * 86_400.0, 0.5, "for 2d; state a time above 0 and up to 0.5s"),
        (-1.0, 45.0, "for -1 s; state a time above 0 and up to 45s"),
        (math.inf, 86_460.0, "for inf s; state a time above 0 and up to 1d1m"),
        (None, 60.0, "for no time; state a time above 0 and up to 1m"),
    ],
)
def test_a_refusal_says_times_as_people_write_them(asked_s, longest_s, words):
    rig = AlarmRig(LEVEL, handling=alarm_handling(shelve_at_most_s=longest_s))
    with pytest.raises(CommandNotAllowedError) as refused:
        rig.shelve("vibration-x", asked_s)
    assert f"{refused.value}" == f"cannot shelve vibration-x {words}"


def test_out_of_service_lasts_until_somebody_puts_it_back():
    rig = AlarmRig(LEVEL)
    bypassed = rig.ask(Verb.BYPASS, "vibration-x", reason="probe is being replaced")
    assert (bypassed.kind.value, bypassed.to_state) == ("bypassed", S.OUT_OF_SERVICE)
    assert rig.rms(50.0)[0].to_state is S.OUT_OF_SERVICE
    assert rig.tick(1e6) == []
    assert rig.status("vibration-x").state is S.OUT_OF_SERVICE
    back = rig.ask(Verb.UNBYPASS, "vibration-x")
    assert (back.kind.value, back.to_state) == ("unbypassed", S.ACTIVE_UNACKNOWLEDGED)


def test_the_strongest_cover_is_seen_and_the_others_stay():
    rig = AlarmRig(LEVEL)
    rig.rms(50.0)
    rig.shelve("vibration-x", 60.0)
    rig.ask(Verb.BYPASS, "vibration-x")
    assert rig.rms(50.0, "not_ok")[-1].to_state is S.OUT_OF_SERVICE
    assert rig.status("vibration-x").holds == (S.OUT_OF_SERVICE, S.SUPPRESSED, S.SHELVED)
    assert rig.ask(Verb.UNBYPASS, "vibration-x").to_state is S.SUPPRESSED
    assert rig.ask(Verb.UNSHELVE, "vibration-x").to_state is S.SUPPRESSED
    assert rig.rms(50.0)[-1].to_state is S.ACTIVE_UNACKNOWLEDGED


@pytest.mark.parametrize(
    ("verb", "reason"),
    [
        (Verb.UNSHELVE, "it is not shelved"),
        (Verb.UNBYPASS, "it is not out of service"),
        (Verb.ACKNOWLEDGE, "there is nothing to acknowledge"),
        (Verb.RESET, "there is nothing to reset"),
    ],
)
def test_what_does_not_apply_is_refused(verb, reason):
    rig = AlarmRig(LEVEL)
    rig.rms(50.0)
    rig.acknowledge("vibration-x")
    rig.rms(0.0)
    with pytest.raises(CommandNotAllowedError, match=f"cannot {verb.value} vibration-x: {reason}"):
        rig.ask(verb, "vibration-x")


@pytest.mark.parametrize("verb", [Verb.ACKNOWLEDGE, Verb.RESET])
def test_what_is_covered_is_neither_acknowledged_nor_reset(verb):
    rig = AlarmRig(LEVEL)
    rig.rms(50.0)
    rig.ask(Verb.BYPASS, "vibration-x")
    with pytest.raises(CommandNotAllowedError, match="it is out of service"):
        rig.ask(verb, "vibration-x")
    with pytest.raises(CommandNotAllowedError, match="it is out of service already"):
        rig.ask(Verb.BYPASS, "vibration-x")


def test_a_command_about_an_occurrence_that_is_over_changes_nothing():
    rig = AlarmRig(LEVEL)
    first = rig.rms(50.0)[0].occurrence
    rig.acknowledge("vibration-x", occurrence=first)
    rig.rms(0.0)
    with pytest.raises(CommandNotAllowedError, match=f"occurrence {first} is over, it is normal"):
        rig.shelve("vibration-x", 60.0, occurrence=first)
    second = rig.rms(50.0)[0].occurrence
    with pytest.raises(CommandNotAllowedError, match=f"occurrence {first} is over, now {second} stands"):
        rig.acknowledge("vibration-x", occurrence=first)
    assert rig.status("vibration-x").state is S.ACTIVE_UNACKNOWLEDGED


def test_an_acknowledged_a_shelved_and_a_bypassed_alarm_are_so_after_a_restart():
    for verb, state in [
        (Verb.ACKNOWLEDGE, S.ACTIVE_ACKNOWLEDGED),
        (Verb.SHELVE, S.SHELVED),
        (Verb.BYPASS, S.OUT_OF_SERVICE),
    ]:
        rig = AlarmRig(LEVEL)
        rig.rms(50.0)
        rig.ask(verb, "vibration-x", duration_s=60.0)
        after = rig.restarted(SPEAKERS)
        assert after.status("vibration-x").state is state
        assert after.rms(50.0) == []


@pytest.mark.parametrize(
    ("down_s", "wall_step_s", "left_s"),
    [
        (20.0, 0.0, 40.0),
        (90.0, 0.0, 0.0),
        (20.0, 3600.0, 0.0),
        (20.0, -3600.0, 60.0),  # nobody knows how long it was down: never longer than what was left
    ],
)
def test_shelving_goes_on_over_a_restart_by_the_wall_clock(down_s, wall_step_s, left_s):
    rig = AlarmRig(LEVEL)
    rig.rms(50.0)
    rig.shelve("vibration-x", 60.0)
    rig.clock.advance(down_s)
    rig.clock.set_wall(wall_step_s)
    rig.clock.t_ns = 0  # a reboot begins the monotonic count anew
    after = rig.restarted(SPEAKERS)
    assert after.status("vibration-x").state is S.SHELVED
    assert after.status("vibration-x").shelved_until_ns == left_s * 1e9
    if left_s > 0:
        assert after.tick(left_s - 1e-6) == []
    assert kinds(after.tick(1e-6)) == [("vibration-x", "unshelved")]


def test_conditions_of_the_service_are_alarms_like_others():
    rig = AlarmRig(LEVEL)
    assert rig.condition("certificate/client", Level.NORMAL, "fine") == []
    (raised,) = rig.condition("certificate/client", Level.ALERT, "client.pem ends in 9 days")
    assert raised.message == "certificate/client alert: client.pem ends in 9 days"
    assert (raised.cause.detector, raised.cause.severity) == ("service", "alert")
    assert rig.condition("certificate/client", Level.ALERT, "client.pem ends in 8 days") == []
    rig.acknowledge("certificate/client")
    after = rig.restarted(SPEAKERS)
    assert after.manager.conditions == {"certificate/client"}
    assert after.status("certificate/client").state is S.ACTIVE_ACKNOWLEDGED
    (escalated,) = after.condition("certificate/client", Level.DANGER, "client.pem ends today")
    assert escalated.occurrence == raised.occurrence
    assert kinds(after.condition("certificate/client", Level.NORMAL, "it was renewed")) == [
        ("certificate/client", "returned")
    ]
    with pytest.raises(ValueError, match="has the name of an alarm"):
        rig.condition("vibration-x", Level.ALERT, "no")
