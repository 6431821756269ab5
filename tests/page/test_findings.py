"""What the page says is wrong: fault, group, probability, evidence, since when, severity and next step."""

from __future__ import annotations

from typing import Any

import pytest
from support.alarm_rig import AlarmRig
from support.machine_files import LAVAL, parsed
from test_views import about

from daqsvc.alarms.commands import Verb
from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.machine_facts import fault_names
from daqsvc.page.findings import FAULTS, SOUND, finding_rows, sentence
from daqsvc.page.machine_live import MachineLive
from daqsvc.page.text import alarm_list, alarm_rows
from daqsvc.publish.payloads import alarm_document

NAMES = {"rotor-bank": {"N": "normal", "F1": "damping_loss", "F1L2": "damping_loss", "F1L3": "rub"}}


def said(decision: str, t_ns: int = 0, **others: Any) -> dict[str, Any]:
    plain = {
        "detector": "rotor-bank",
        "monotonic_ns": t_ns,
        "decision": decision,
        "severity": "alert",
        "probabilities": {"N": 0.0, "F1": 0.02, "F1L2": 0.1, "F1L3": 0.88},
        "group": [decision],
        "statistics": {"speed": 600.0},
        "units": {"speed": "rpm"},
        "thresholds": {},
        "evidence": {"lead.N": 24.0, "lead.F1": 13.4, "lead.F1L2": 2.0, "cusum.N": 1.0},
        "quality": "good",
        "reason": "",
        "where": "",
    }
    return plain | others


def looking(*statements: dict[str, Any], at_first: list[dict[str, Any]] | None = None) -> MachineLive:
    live = MachineLive(about() | {"faults": NAMES, "statements": at_first or []})
    for one in statements:
        live.hear({"statement": one})
    return live


def test_a_fault_is_named_with_its_group_probability_and_evidence() -> None:
    live = looking(said("F1L3", group=["F1L3", "F1L2"], severity="danger"))
    assert sentence(live, live.latest["rotor-bank"]) == (
        "rotor-bank finds rub (F1L3), not told apart from loss of damping (F1L2), p 0.880 (all of these "
        "0.980); evidence 13.4 nats over the next, F1."
    )
    rows = finding_rows(live)
    assert FAULTS["rub"].next_step in rows
    assert 'class="level danger"' in rows


def test_a_value_beyond_its_limit_is_named_with_both() -> None:
    levels = said(
        "alert",
        detector="levels/probe-x",
        probabilities={},
        group=[],
        evidence={},
        statistics={"rms": 44.2, "peak": 60.0},
        units={"rms": "um", "peak": "um"},
        thresholds={"rms.alert": 40.0, "rms.danger": 60.0, "peak.alert": 90.0},
    )
    live = looking(levels)
    assert sentence(live, live.latest["levels/probe-x"]) == (
        "levels/probe-x finds a value beyond its alert limit; rms is 44.2 um, alert limit 40 um."
    )


def test_the_next_step_names_only_what_there_is_to_look_at() -> None:
    levels = said("danger", detector="levels/probe-x", severity="danger", sensors=["left"])
    whole = "Decide now whether the machine may go on; look at its trend, its spectrum and the orbit for what"
    assert whole in finding_rows(looking(levels))
    temperature = said("alert", detector="levels/oil", sensors=["oil"])
    assert "<td>Look at its trend for what it is.</td>" in finding_rows(looking(temperature))
    alone = about() | {"faults": NAMES}
    alone["values"]["sensors"] = [{"name": "left", "type": "accelerometer", "unit": "g"}]
    live = MachineLive(alone)
    live.hear({"statement": levels})
    live.hear({"statement": said("unmodelled", detector="bearing/left", sensors=["left"])})
    rows = finding_rows(live)
    assert "look at its trend and its spectrum for what it is." in rows
    assert "Look at its trend and its spectrum, and at what was changed on the machine recently." in rows
    assert "orbit" not in rows


def test_a_phase_is_beyond_its_limit_by_how_far_it_is_off_its_reference() -> None:
    levels = said(
        "alert",
        detector="levels/probe-x",
        probabilities={},
        group=[],
        evidence={},
        statistics={"1x_phase_lag": 20.0, "2x_phase_lag": 340.0},
        units={"1x_phase_lag": "deg", "2x_phase_lag": "deg"},
        thresholds={
            "1x_phase_lag.alert": 25.0,
            "1x_phase_lag.reference": 350.0,
            "2x_phase_lag.alert": 25.0,
            "2x_phase_lag.reference": 350.0,
        },
    )
    live = looking(levels)
    assert sentence(live, live.latest["levels/probe-x"]) == (
        "levels/probe-x finds a value beyond its alert limit; 1x_phase_lag is 30 deg off its reference, "
        "alert limit 25 deg."
    )


def test_what_is_held_without_data_says_so() -> None:
    live = looking(said("F1", quality="missing", reason="half of the samples are missing"))
    assert "That is held from before: half of the samples are missing." in sentence(
        live, live.latest["rotor-bank"]
    )


def test_since_is_when_it_was_said_first_and_before_it_was_looked_at_that_is_said() -> None:
    live = looking(said("F1", 5_000_000_000), said("F1", 9_000_000_000), at_first=[said("N", 1_000_000_000)])
    assert live.decided["rotor-bank"].since_ns == 5_000_000_000
    assert "before <time" not in finding_rows(live)
    again = MachineLive(live.about | {"statements": [said("F1", 12_000_000_000)]})
    again.go_on_from(live)
    assert again.decided["rotor-bank"] == live.decided["rotor-bank"]
    older = looking(at_first=[said("F1", 7_000_000_000)])
    assert "before <time" in finding_rows(older)


def test_a_healthy_machine_has_no_finding() -> None:
    healthy = said("N", severity="normal", probabilities={"N": 1.0})
    assert "No detector finds a fault." in finding_rows(looking(healthy))
    assert "No detector has stated anything yet." in finding_rows(looking())


def test_what_nobody_knows_is_shown_as_it_is_and_is_no_markup() -> None:
    live = looking(said("<b>odd", detector="own"))
    assert "own finds &lt;b&gt;odd" in finding_rows(live)
    assert "Look at its figures below." in finding_rows(live)


def test_every_mode_of_the_bank_means_a_fault_that_the_page_knows() -> None:
    named = fault_names(parsed(LAVAL))["rotor-bank"]
    assert named == {"N": "normal", "F1": "damping_loss", "F1L2": "damping_loss", "F1L3": "rub"}
    assert {*named.values()} <= FAULTS.keys() | SOUND


def test_a_plugin_that_fails_costs_its_names_and_nothing_else(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def failing(*_: Any) -> Any:
        raise KeyError("no such thing")

    monkeypatch.setattr("daqsvc.detectors.rotor_bank.build.faults", failing)
    assert fault_names(parsed(LAVAL)) == {}
    assert "its decisions are shown as they are" in caplog.text


def test_no_fault_is_not_the_whole_story_while_a_sensor_is_not_ok() -> None:
    good = said("N", severity="normal")
    assert "But" not in finding_rows(looking(good))
    bad = good | {"detector": "levels/a", "sensors": ["a"], "quality": "not_ok", "reason": "it is dead"}
    assert "No detector finds a fault. But a is not OK or missing" in finding_rows(looking(good, bad))


def test_the_cause_of_an_alarm_is_shown_after_it_was_acknowledged() -> None:
    live = looking()
    raised = {
        "alarm": "v",
        "kind": "raised",
        "state": "active_unacknowledged",
        "level": "alert",
        "monotonic_ns": 1,
        "wall_ns": 1,
        "first_out": False,
        "message": "v alert: 3 mm/s",
    }
    live.hear({"alarm": raised})
    done = {"kind": "acknowledged", "state": "active_acknowledged", "message": "v acknowledged by ann"}
    live.hear({"alarm": raised | done})
    assert "v alert: 3 mm/s; v acknowledged by ann" in alarm_rows(live)


@pytest.mark.parametrize("verb", [Verb.ACKNOWLEDGE, Verb.SHELVE, Verb.BYPASS])
def test_after_a_restart_of_the_service_it_still_says_what_was_found(verb: Verb) -> None:
    rig = AlarmRig(LevelRule("v", "probe-x", "rms", Setpoint(alert=40.0)))
    rig.rms(50.0)
    rig.ask(verb, "v", duration_s=60.0 if verb is Verb.SHELVE else None)
    found = "v alert: rms of probe-x is 50 um, alert limit 40 um"
    before = rig.status("v").summary
    assert before.startswith(f"{found}; v ")
    after = rig.restarted({"levels/probe-x": ("probe-x",)})
    assert after.status("v").summary == before
    latest = alarm_document(after.events[-1])
    live = MachineLive(about() | {"alarms": [latest]})
    assert before in alarm_rows(live)
    assert before in alarm_list(live.all_alarms(), "rig")
    (returned,) = after.rms(0.0)
    assert alarm_document(returned)["found_message"] == "", "its message says it"
