"""What is known of a plant by what its boxes publish, whatever that is."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from hypothesis import given
from hypothesis import strategies as st

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.page.plant import known as known_module
from daqsvc.page.plant.known import KnownPlant
from daqsvc.page.plant.source import PlantSource
from daqsvc.page.text import tile
from daqsvc.publish.mqtt.connection import Incoming
from daqsvc.publish.mqtt.settings import Mqtt
from daqsvc.publish.payloads import availability_payload, status_payload
from daqsvc.publish.topics import box_topic

if TYPE_CHECKING:
    import pytest

CLOCK = DrivenClock()


def statement() -> dict[str, Any]:
    return {
        "detector": "rotor-bank",
        "decision": "F1",
        "severity": "alert",
        "changed": True,
        "probabilities": {"N": 0.1, "F1": 0.9},
        "group": [],
        "statistics": {},
        "units": {},
        "thresholds": {},
        "evidence": {},
        "revolutions": None,
        "window": {"stream": "shaft", "first_index": 0, "end_index": 1},
        "quality": "good",
        "reason": "",
        "sensors": [],
        "model": "x/1",
        "monotonic_ns": 5,
    }


def alarm(sequence: int, state: str = "active_unacknowledged", level: str = "alert") -> bytes:
    stamp = {"site": "lab", "box": "edge", "time": "2026-11-26T00:00:00Z", "wall_ns": 100, "monotonic_ns": 7}
    told = {
        "schema": "daqsvc.alarm/1",
        "id": f"x-{sequence}",
        "sequence": sequence,
        "machine": "rig",
        "alarm": "hot",
        "occurrence": "o",
        "kind": "raised",
        "state": state,
        "level": level,
        "previous": {"state": "normal", "level": "normal"},
        "message": "<b>it is hot</b>",
        "by": "",
        "cause": statement(),
        "first_out": True,
    }
    return json.dumps(stamp | told).encode()


def heard(plant: KnownPlant, topic: str, payload: bytes, *, retain: bool = True) -> None:
    plant.take(Incoming(f"daqsvc/lab/edge/{topic}", payload, retain=retain))


def availability(state: Any, why: str) -> bytes:
    return availability_payload("lab", "edge", state, why, CLOCK).to_json()


def test_the_latest_event_of_an_alarm_is_its_state_and_a_repeat_changes_nothing() -> None:
    plant = KnownPlant("daqsvc")
    for sequence, state in (
        (3, "active_unacknowledged"),
        (5, "active_acknowledged"),
        (3, "active_unacknowledged"),
    ):
        heard(plant, "rig/alarms/hot", alarm(sequence, state))
    found = plant.machine("lab:edge:rig")
    assert found is not None
    assert found[1].alarms["hot"]["state"] == "active_acknowledged"
    assert [json.loads(event)["sequence"] for event in found[1].events] == [3, 5]


def test_names_of_machines_come_with_the_status_and_lines_go_to_who_listens() -> None:
    plant = KnownPlant("daqsvc")
    heard(plant, "status", status_payload("lab", "edge", {}, CLOCK, ["rig", "pump"]).to_json(), retain=False)
    found = plant.machine("lab:edge:pump")
    assert found is not None
    lines: list[dict[str, Any]] = []
    found[1].hearing.append(lines.append)
    heard(plant, "pump/alarms/sensor-ok/probe-x", alarm(1))
    told = {**statement(), "site": "lab", "box": "edge", "time": "", "wall_ns": 9, "machine": "pump"}
    heard(plant, "pump/diagnosis/rotor-bank", json.dumps(told | {"schema": "daqsvc.diagnosis/1"}).encode())
    assert [next(iter(line)) for line in lines] == ["alarm", "statement"]
    about = found[1].about()
    assert about["machine"] == "pump"
    assert [one["decision"] for one in about["statements"]] == ["F1"]
    assert list(found[1].alarms) == ["sensor-ok/probe-x"]


async def test_a_box_that_is_offline_or_silent_is_not_normal(monkeypatch: pytest.MonkeyPatch) -> None:
    source = PlantSource(Mqtt.model_validate({"url": "mqtt://127.0.0.1:1", "insecure": True}))
    plant = source._known
    source._link.why_not = ""
    monkeypatch.setattr(source, "begin", lambda: None)
    heard(plant, "availability", availability("offline", "connection lost"))
    [empty] = [tile(one) for one in await source.statuses()]
    assert (empty["name"], empty["title"]) == ("", "lab, edge")
    heard(plant, "status", status_payload("lab", "edge", {}, CLOCK, ["rig"]).to_json())
    [away] = [tile(one) for one in await source.statuses()]
    assert (away["level"], away["title"], away["place"]) == ("unknown", "rig", "lab, edge")
    assert "offline" in away["away"]
    assert "connection lost" in away["away"]
    heard(plant, "availability", availability("online", "connected"), retain=False)
    assert tile((await source.statuses())[0])["level"] == "normal"
    now_s = known_module.time.monotonic()
    monkeypatch.setattr(known_module.time, "monotonic", lambda: now_s + 60.0)
    silent = tile((await source.statuses())[0])
    assert silent["level"] == "unknown"
    assert "has sent nothing since 20" in silent["away"]
    heard(plant, "rig/alarms/hot", alarm(1, level="danger"))
    assert tile((await source.statuses())[0])["level"] == "danger"


def test_a_retained_online_alone_is_not_there_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = KnownPlant("daqsvc")
    heard(plant, "availability", availability("online", "connected"))
    box = plant.boxes["lab", "edge"]
    assert box.away == ""
    now_s = known_module.time.monotonic()
    monkeypatch.setattr(known_module.time, "monotonic", lambda: now_s + 60.0)
    assert "since this page listens" in box.away


def test_a_box_that_counts_anew_is_believed_and_what_is_taken_away_goes() -> None:
    plant = KnownPlant("daqsvc")
    heard(plant, "rig/alarms/hot", alarm(2**60, "active_unacknowledged"))
    later = json.loads(alarm(1, "active_acknowledged")) | {"wall_ns": 200}
    heard(plant, "rig/alarms/hot", json.dumps(later).encode())
    alarms = plant.boxes["lab", "edge"].machines["rig"].alarms
    assert alarms["hot"]["state"] == "active_acknowledged"
    heard(plant, "rig/alarms/hot", b"")
    assert alarms == {}
    heard(plant, "status", b"[" * 100_000)
    heard(plant, "status", bytes(known_module.LARGEST + 1))


PARTS = st.sampled_from(
    ["daqsvc", "lab", "edge", "rig", "alarms", "diagnosis", "status", "availability", "", "+", "é"]
)
JSONS = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5), lambda inner: st.lists(inner, max_size=3)
)
PAYLOADS = st.one_of(
    st.binary(max_size=50),
    st.sampled_from([alarm(1), availability("online", "x"), b"[" * 5000, b'{"machines": [1, "a/b", null]}']),
    st.dictionaries(st.sampled_from(["machines", "sequence", "state", "schema"]), JSONS).map(
        lambda told: json.dumps(told).encode()
    ),
)


@given(st.lists(st.tuples(st.lists(PARTS, max_size=7).map("/".join), PAYLOADS, st.booleans()), max_size=20))
def test_whatever_comes_nothing_fails_and_what_is_known_stays_whole(
    messages: list[tuple[str, bytes, bool]],
) -> None:
    plant = KnownPlant("daqsvc")
    for topic, payload, retain in messages:
        plant.take(Incoming(topic, payload, retain=retain))
        plant.take(Incoming(f"daqsvc/lab/edge/{topic}", payload, retain=retain))
    for box in plant.boxes.values():
        assert isinstance(box.away, str)
        for machine in box.machines.values():
            assert {"machine", "values", "statements", "alarms"} <= {*machine.about()}


def test_a_flood_of_names_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_module, "MOST_BOXES", 3)
    monkeypatch.setattr(known_module, "MOST_MACHINES", 4)
    monkeypatch.setattr(known_module, "MOST_NAMES", 5)
    monkeypatch.setattr(known_module, "LARGEST", 5000)
    plant = KnownPlant("daqsvc")
    for number in range(20):
        plant.take(Incoming(f"daqsvc/lab/box{number}/status", b"{}"))
        heard(plant, f"rig{number}/alarms/a", alarm(number))
        heard(plant, f"rig0/alarms/a{number}", alarm(number))
        heard(plant, f"rig0/diagnosis/d{number}", b"x")
    assert len(plant.boxes) == 3
    assert all(len(box.machines) <= 4 for box in plant.boxes.values())
    machine = plant.boxes["lab", "edge"].machines["rig0"]
    assert (len(machine.alarms), len(machine.statements)) == (5, 5)
    heard(plant, "rig1/diagnosis/long", bytes(6000))
    monkeypatch.setattr(known_module, "MOST_BYTES", 0)
    heard(plant, "rig1/diagnosis/one-more", b"x")
    assert plant.boxes["lab", "edge"].machines["rig1"].statements == {}
    plant.take(Incoming("daqsvc/lab/edge/a rig/alarms/a", alarm(1)))
    plant.take(Incoming("daqsvc/lab/edge/status", b'{"machines": ["a rig", "a/b", "+"]}'))
    assert {*plant.boxes["lab", "edge"].machines} == {f"rig{number}" for number in range(4)}


@given(st.lists(st.text(max_size=4), max_size=8).map("/".join))
def test_a_topic_is_taken_apart_or_refused(topic: str) -> None:
    told = box_topic("daqsvc", f"daqsvc/{topic}")
    if told is not None:
        assert f"{topic}".startswith(f"{told.site}/{told.box}/")
        assert 1 <= len(told.rest) <= 3
