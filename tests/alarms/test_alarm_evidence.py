"""A detector's decision: judged by its evidence, and one alarm from the departure to the fault's name."""

from __future__ import annotations

import math

import pytest
from support.alarm_rig import AlarmRig, kinds

from daqsvc.alarms.rules import DiagnosisRule, decision_evidence
from daqsvc.diagnosis.record import Diagnosis

ROTOR = DiagnosisRule("rotor-fault", "rotor-bank")
STRICT = DiagnosisRule("rotor-fault", "rotor-bank", evidence_nats=18.0)
BEARING = DiagnosisRule("bearing-damage", "bearing")
SPEAKERS = {"rotor-bank": ("probe-x", "probe-y", "keyphasor"), "bearing": ("accel-de", "accel-fe")}


def leads(**nats):
    return {f"lead.{mode}": lead for mode, lead in nats.items()}


def said(decision, evidence, group=()):
    return Diagnosis("rig", "any", 0, "shaft", 0, 1, decision, evidence=evidence, group=group)


@pytest.mark.parametrize(
    ("diagnosis", "nats"),
    [
        (said("F1", leads(N=18.6, F1L2=19.1, F1L3=13.8)), 13.8),
        (said("F1", leads(N=18.6, F1L2=0.3), group=("F1", "F1L2")), 18.6),
        (said("F1", leads(F1L2=0.3), group=("F1", "F1L2")), None),
        (
            said("departure", leads(F1=24.0) | {"cusum.F1": 15.0, "cusum.F2": 17.5}, group=("F1", "F2")),
            17.5,
        ),
        (said("rub", {"rub": 41.0, "unbalance": 12.0}, group=("rub",)), 41.0),
        (said("inner_or_outer", {"inner": 11.0, "outer": 14.0}, group=("inner", "outer")), 14.0),
        (said("departure", {}), None),
        (said("rub", {"rub": math.nan}), None),
        (said("rub", {"rub": math.inf}), None),
    ],
)
def test_the_evidence_of_a_decision_is_what_the_detector_states(diagnosis, nats):
    assert decision_evidence(diagnosis) == nats


def test_a_probability_of_nine_tenths_raises_nothing_without_the_evidence_asked_for():
    rig = AlarmRig(STRICT)
    assert rig.mode("F1", "alert", probabilities={"F1": 0.999}, evidence=leads(N=17.9)) == []
    (raised,) = rig.mode("F1", "alert", probabilities={"F1": 0.999}, evidence=leads(N=18.0))
    assert raised.message == "rotor-fault alert: rotor-bank finds F1, p = 0.999, evidence 18 nats (10^8 to 1)"


def test_evidence_is_told_as_odds_too():
    rig = AlarmRig(DiagnosisRule("rotor-fault", "rotor-bank"))
    (raised,) = rig.mode("F1", "alert", evidence=leads(N=2.0))
    assert raised.message.endswith("evidence 2 nats (7.4 to 1)")


def test_weak_evidence_neither_worsens_nor_renames_an_alarm_and_a_return_needs_none():
    rig = AlarmRig(STRICT)
    rig.mode("F1", "alert", evidence=leads(N=30.0))
    assert rig.mode("F1L3", "danger", evidence=leads(F1=3.0)) == []
    assert rig.status("rotor-fault").level.label == "alert"
    assert kinds(rig.mode("N", "normal", evidence=leads(F1=3.0))) == [("rotor-fault", "returned")]


def test_a_detector_that_states_no_evidence_is_believed():
    assert kinds(AlarmRig(STRICT).mode("departure", "alert")) == [("rotor-fault", "raised")]


@pytest.mark.parametrize(
    ("rule", "detector", "steps"),
    [
        (
            ROTOR,
            "rotor-bank",
            [
                (
                    "departure",
                    "alert",
                    ("F1", "F1L2"),
                    "cause not yet known, possibly F1, F1L2",
                ),
                ("F1", "alert", ("F1", "F1L2"), "F1, not told apart from F1L2"),
                ("F1", "alert", ("F1",), "F1"),
            ],
        ),
        (
            DiagnosisRule("rotor-fault", "rotor-synchronous"),
            "rotor-synchronous",
            [
                ("departure", "alert", ("rub", "unbalance"), "possibly rub, unbalance"),
                ("rub", "danger", ("rub",), "rub"),
            ],
        ),
        (
            BEARING,
            "bearing",
            [
                ("changed", "alert", (), "a change, its cause not yet known"),
                ("inner", "alert", (), "the inner race"),
            ],
        ),
    ],
)
def test_departure_and_identity_are_one_alarm_that_is_refined(rule, detector, steps):
    rig = AlarmRig(rule)
    told = []
    for decision, severity, group, words in steps:
        (event,) = rig.mode(decision, severity, detector=detector, group=group, changed=True)
        assert words in event.message
        # The same statement again is nothing new, however the group flickers.
        assert rig.mode(decision, severity, detector=detector, group=("x", *group)) == []
        told.append(event)
    assert told[0].kind.value == "raised"
    assert {event.kind.value for event in told[1:]} <= {"changed", "escalated"}
    assert len({event.occurrence for event in told}) == 1


def test_what_was_found_is_known_after_a_restart_whoever_spoke_last():
    rig = AlarmRig(ROTOR)
    rig.mode("F1", "alert", group=("F1", "F1L2"), changed=True)
    rig.rms(0.0, "not_ok")
    assert rig.status("rotor-fault").state.value == "suppressed"
    after = rig.restarted(SPEAKERS | {"levels/probe-x": ("probe-x",)})
    assert kinds(after.rms(0.0)) == [("sensor-ok/probe-x", "returned"), ("rotor-fault", "unsuppressed")]
    assert after.mode("F1", "alert", group=("F1",)) == []  # a group that flickers is no change
    assert kinds(after.mode("F1L2", "alert", changed=True)) == [("rotor-fault", "changed")]
