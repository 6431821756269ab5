"""Payloads: what is said, in JSON that any consumer can read, by the published schema."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.events import AlarmEvent, Doubt, EventKind, Identity
from daqsvc.alarms.states import AlarmState, Level
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.payloads import (
    AlarmPayload,
    AvailabilityPayload,
    DiagnosisPayload,
    StatusPayload,
    alarm_json,
    alarm_payload,
    availability_payload,
    diagnosis_payload,
    status_payload,
)
from daqsvc.publish.schemas import json_schemas
from daqsvc.publish.topics import Topics

RIG = Identity("lab", "edge-1", "rig")
CLOCK = DrivenClock(start_ns=5_000_000_000, wall_start_ns=1_700_000_000_000_000_000)
CAUSE = Diagnosis(
    machine="rig",
    detector="rotor-bank",
    t_ns=4_000_000_000,
    stream="shaft",
    first_index=128,
    end_index=192,
    decision="F1",
    severity="alert",
    probabilities={"N": 0.02, "F1": 0.98},
    group=("F1", "F1L2"),
    statistics={"rms": math.nan, "peak": math.inf, "mean": np.float64(1.5)},
    units={"rms": "um"},
    evidence={"F1/N": 17.5},
    revolutions=31.25,
    sensors=("probe-x", "probe-y"),
)
EVENT = AlarmEvent(
    identity=RIG,
    alarm="rotor-fault",
    occurrence="o-1",
    kind=EventKind.RAISED,
    from_state=AlarmState.NORMAL,
    to_state=AlarmState.ACTIVE_UNACKNOWLEDGED,
    from_level=Level.NORMAL,
    to_level=Level.ALERT,
    t_ns=4_000_000_000,
    wall_ns=1_699_999_999_000_001_000,
    cause=CAUSE,
    message="rotor-fault alert: rotor-bank finds F1",
)


def test_an_alarm_says_everything_that_the_event_knows():
    said = json.loads(alarm_payload(EVENT, 42, "series").to_json())
    cause = said.pop("cause")
    assert said == {
        "schema": "daqsvc.alarm/1",
        "id": "series-42",
        "sequence": 42,
        "site": "lab",
        "box": "edge-1",
        "machine": "rig",
        "alarm": "rotor-fault",
        "occurrence": "o-1",
        "kind": "raised",
        "state": "active_unacknowledged",
        "level": "alert",
        "previous": {"state": "normal", "level": "normal"},
        "time": "2023-11-14T22:13:19.000001Z",
        "wall_ns": 1_699_999_999_000_001_000,
        "monotonic_ns": 4_000_000_000,
        "message": "rotor-fault alert: rotor-bank finds F1",
        "by": "",
        "reason": "",
        "code": None,
        "holds": [],
        "covered": None,
        "shelved_until_wall_ns": None,
        "first_out": False,
        "chattering": False,
        "found": "",
        "found_message": "",
        "doubts": [],
    }
    assert cause["probabilities"] == {"N": 0.02, "F1": 0.98}
    assert cause["group"] == ["F1", "F1L2"]
    assert cause["window"] == {"stream": "shaft", "first_index": 128, "end_index": 192}
    assert cause["evidence"] == {"F1/N": 17.5}
    assert cause["units"] == {"rms": "um"}
    assert (cause["decision"], cause["revolutions"], cause["monotonic_ns"]) == ("F1", 31.25, 4_000_000_000)


def test_what_goes_to_the_disk_is_the_payload_though_nothing_validates_it():
    doubts = (Doubt("levels", "not_ok", not_ok=True, reason="dead \N{MICRO SIGN}", sensors=("probe-x",)),)
    held = replace(
        EVENT,
        holds=(AlarmState.SHELVED, AlarmState.SUPPRESSED),
        to_state=AlarmState.SHELVED,
        covered=AlarmState.ACTIVE_UNACKNOWLEDGED,
        shelved_until_wall_ns=1_800_000_000_000_000_000,
        by='A. "B"',
        found="rotor-fault alert: rotor-bank finds F1",
        doubts=doubts,
        cause=replace(
            CAUSE,
            first_index=np.int64(3),
            revolutions=np.float32(1.5),
            missing_share=np.float64(0.25),
            bounds={"rms": (np.float64(1.0), math.inf)},
            thresholds={"rms.alert": 4},
            changed=np.True_,
        ),
    )
    bare = replace(EVENT, occurrence=None, cause=replace(CAUSE, statistics={}, revolutions=None))
    for event in (EVENT, held, bare):
        assert alarm_json(event, 42, "series") == alarm_payload(event, 42, "series").to_json()


def test_what_json_cannot_say_is_null():
    text = alarm_payload(EVENT, 1, "series").to_json()
    assert b"NaN" not in text
    assert b"Infinity" not in text
    assert json.loads(text)["cause"]["statistics"] == {"rms": None, "peak": None, "mean": 1.5}


def test_a_diagnosis_is_stamped_with_the_time_of_its_data():
    said = json.loads(diagnosis_payload(RIG, CAUSE, CLOCK).to_json())
    assert (said["monotonic_ns"], said["wall_ns"]) == (4_000_000_000, 1_699_999_999_000_000_000)
    assert (said["schema"], said["machine"], said["detector"]) == ("daqsvc.diagnosis/1", "rig", "rotor-bank")


def test_status_takes_nested_numbers_and_words_and_nothing_else():
    figures = {
        "loop_lag_ms": {"p99": 1.5, "max": math.nan},
        "streams": {"shaft": {"lost": 3, "state": "7"}},
        "depth": 0,
    }
    said = json.loads(status_payload("lab", "edge-1", figures, CLOCK).to_json())
    assert said["figures"] == {
        "loop_lag_ms": {"p99": 1.5, "max": None},
        "streams": {"shaft": {"lost": 3, "state": "7"}},
        "depth": 0,
    }
    with pytest.raises(ValidationError, match="streams"):
        status_payload("lab", "edge-1", {"streams": ["three"]}, CLOCK)


@pytest.mark.parametrize(
    ("model", "payload"),
    [
        (AlarmPayload, alarm_payload(EVENT, 42, "series")),
        (DiagnosisPayload, diagnosis_payload(RIG, CAUSE, CLOCK)),
        (StatusPayload, status_payload("lab", "edge-1", {"a": {"b": 1, "c": 0.5}}, CLOCK)),
        (AvailabilityPayload, availability_payload("lab", "edge-1", "offline", "stopped", CLOCK)),
    ],
)
def test_payloads_come_back_as_they_were(model, payload):
    assert model.model_validate_json(payload.to_json()) == payload


def test_the_published_schema_requires_every_key_that_is_sent():
    schemas = json_schemas()
    sent = json.loads(alarm_payload(EVENT, 42, "series").to_json())
    schema = schemas["daqsvc.alarm/1"]
    assert set(schema["required"]) == set(schema["properties"]) == set(sent)
    assert schema["properties"]["schema"]["const"] == sent["schema"]
    assert "returned_unacknowledged" in json.dumps(schema)
    for one in schemas.values():
        json.dumps(one, allow_nan=False)


def test_topics():
    topics = Topics("daqsvc", "lab", "edge-1")
    assert topics.availability == "daqsvc/lab/edge-1/availability"
    assert topics.status == "daqsvc/lab/edge-1/status"
    assert topics.alarm("rig", "sensor-ok/probe-x") == "daqsvc/lab/edge-1/rig/alarms/sensor-ok/probe-x"
    assert topics.diagnosis("rig", "rotor-bank") == "daqsvc/lab/edge-1/rig/diagnosis/rotor-bank"


@pytest.mark.parametrize("name", ["", "a+b", "#", "a//b", "/a", "a b", "$SYS", "a\0", "ä"])
def test_unsafe_names_are_refused(name):
    with pytest.raises(ValueError, match="cannot be in an MQTT topic"):
        Topics("daqsvc", "lab", "edge-1").alarm("rig", name)
    with pytest.raises(ValueError, match="cannot be in an MQTT topic"):
        Topics(name, "lab", "edge-1")
