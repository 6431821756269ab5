"""The checks themselves: a run without fault passes, and each thing that can go wrong is seen."""

from __future__ import annotations

import dataclasses
import json

import pytest
from nothing_lost.checker import Evidence, Verdict
from nothing_lost.consumer import Arrival
from nothing_lost.script import RULES, Script
from nothing_lost.teller import Witness

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.manager import AlarmManager
from daqsvc.publish.payloads import alarm_payload

SCRIPT = Script.of_seed(7)
FIRST = 1000
SERIES = "series"


@pytest.fixture
def evidence():
    """Of a run in which all went well."""
    clock = DrivenClock()
    manager = AlarmManager(SCRIPT.identity, RULES, clock)
    payloads = []
    for step in SCRIPT.steps:
        clock.advance_to(clock.monotonic_ns() + 1_000_000)
        for event in manager.take(step.diagnosis(SCRIPT.identity.machine, clock.monotonic_ns())):
            payloads.append(alarm_payload(event, FIRST + len(payloads), SERIES).to_json())
    return Evidence(
        script=SCRIPT,
        witness=Witness(
            {FIRST + n: 0 for n in range(len(payloads))},
            {f"{SERIES}-{FIRST + n}" for n in range(len(payloads))},
            settled=len(SCRIPT.steps) - 1,
            done=True,
        ),
        journal={json.loads(payload)["id"]: payload for payload in payloads},
        arrivals=[Arrival(n, "t/alarms/a", payload) for n, payload in enumerate(payloads)],
    )


def violations(evidence):
    return " / ".join(Verdict.on(evidence).violations)


def changed(payload, **changes):
    return json.dumps(json.loads(payload) | changes).encode()


def test_a_run_without_fault_passes(evidence):
    verdict = Verdict.on(evidence)
    assert verdict.violations == []
    assert verdict.alarms == len(SCRIPT.expected()) > 50
    assert verdict.repeats == 0


def test_repeats_are_counted_and_change_nothing(evidence):
    again = evidence.arrivals[3:9]
    evidence.arrivals = [*evidence.arrivals[:9], *again, *evidence.arrivals[9:], evidence.arrivals[0]]
    verdict = Verdict.on(evidence)
    assert verdict.violations == []
    assert verdict.repeats == 7


def test_one_that_did_not_arrive_is_lost_unless_the_broker_forgot_it(evidence):
    lost = evidence.arrivals.pop(20)
    missing = lost.alarm
    assert f"{missing['id']} was committed and never reached the consumer" in violations(evidence)
    evidence.forgotten = {missing["id"]: lost.payload}
    verdict = Verdict.on(evidence)
    assert verdict.violations == []
    assert verdict.forgotten == 1


def test_a_last_state_must_arrive_whatever_the_broker_forgot(evidence):
    lost = evidence.arrivals.pop()
    missing = lost.alarm
    evidence.forgotten = {missing["id"]: lost.payload}
    assert f"the consumer's last state of {missing['alarm']}" in violations(evidence)


def test_one_that_left_the_disk_again_is_seen(evidence):
    name = list(evidence.journal)[5]
    del evidence.journal[name]
    assert "was said to be on disk and is not in the journal" in violations(evidence)
    assert f"{name} reached the consumer and is not in the journal" in violations(evidence)


def test_another_order_is_seen(evidence):
    evidence.arrivals[10], evidence.arrivals[11] = evidence.arrivals[11], evidence.arrivals[10]
    assert f"{evidence.arrivals[11].alarm['id']} came after" in violations(evidence)


def test_an_id_that_stands_for_two_events_is_seen(evidence):
    twin = changed(evidence.arrivals[4].payload, message="something else")
    evidence.arrivals.insert(5, Arrival(5, "t/alarms/a", twin))
    assert "stands for 2 different events" in violations(evidence)


def test_a_number_that_is_given_twice_is_seen(evidence):
    evidence.witness.committed_twice = [FIRST]
    assert f"number {FIRST} was given twice" in violations(evidence)


def test_an_event_that_the_script_does_not_know_is_seen(evidence):
    last = evidence.arrivals[-1]
    number = last.alarm["sequence"] + 1
    extra = changed(last.payload, id="extra", sequence=number, level="danger")
    evidence.journal["extra"] = extra
    evidence.arrivals.append(Arrival(0, "t/alarms/a", extra))
    assert "and is Expected(" in violations(evidence)


def test_a_script_that_was_not_told_to_the_end_is_seen(evidence):
    last = evidence.arrivals.pop().alarm
    del evidence.journal[last["id"]], evidence.witness.committed_ns[last["sequence"]]
    evidence.witness.committed_ids.remove(last["id"])
    evidence.witness.done = False
    found = violations(evidence)
    assert "never came to an end" in found
    assert "and is None" in found
    assert "occurrence" in found


def test_a_break_between_two_events_of_an_alarm_is_seen(evidence):
    name = list(evidence.journal)[30]
    broken = changed(evidence.journal[name], previous={"state": "suppressed", "level": "normal"})
    evidence.journal[name] = broken
    evidence.arrivals = [
        dataclasses.replace(a, payload=broken) if a.alarm["id"] == name else a for a in evidence.arrivals
    ]
    assert "but it was" in violations(evidence)


def test_a_full_disk_may_cost_the_journal_what_the_broker_has(evidence):
    names = list(evidence.journal)[:40]
    for name in names:
        del evidence.journal[name]
    assert violations(evidence)
    evidence.made_room = set(names)
    assert Verdict.on(evidence).violations == []
