"""What is refused before an alarm ever hears of it: each with a reason, counted, and without any effect."""

from __future__ import annotations

import json
import logging
import tempfile
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.mqtt_publishing import commands

from daqsvc.acquisition.clock import DrivenClock
from daqsvc.alarms.commands import AlarmCommand, CommandOutcome, Verb
from daqsvc.outbox.command_ids import CommandIds
from daqsvc.publish.mqtt.commands import CommandIntake, CommandPayload, ResponsePayload
from daqsvc.publish.mqtt.connection import Incoming
from daqsvc.publish.topics import Topics

NOW = datetime(2026, 11, 21, 12, 0, 0, tzinfo=UTC)
SETTINGS = commands(Verb.ACKNOWLEDGE, Verb.SHELVE, max_age_s=60.0)
TOPICS = Topics("daqsvc", "lab", "edge-1")
ACKNOWLEDGE = "daqsvc/lab/edge-1/rig/commands/acknowledge"
COMMAND = {
    "schema": "daqsvc.command/1",
    "id": "c1",
    "alarm": "rotor-fault",
    "by": "Ada",
    "issued_at": NOW.isoformat(),
}


class Desk:
    """Remembers what it is asked, and does it."""

    def __init__(self):
        self.asked = []

    async def __call__(self, command, source):
        self.asked.append((command, source))
        return CommandOutcome(accepted=True, events=("edge-1-7",))


@pytest.fixture
def desk():
    return Desk()


@pytest.fixture
def intake(desk, tmp_path):
    return make(desk, tmp_path)


def make(desk, store, settings=SETTINGS, reserved=()):
    clock = DrivenClock(wall_start_ns=round(NOW.timestamp()) * 10**9)
    ids = CommandIds(store / "command-ids")
    return CommandIntake(settings, ("rig",), TOPICS, desk, clock, ids, reserved)


def message(payload=None, topic=ACKNOWLEDGE, *, retain=False, properties=None, **changes):
    if payload is None:
        payload = json.dumps(COMMAND | changes).encode()
    return Incoming(topic, payload, retain=retain, **(properties or {}))


async def answer(intake, *arguments, **options):
    """The answer, and where it goes."""
    told = await intake.take(message(*arguments, **options))
    return ResponsePayload.model_validate_json(told.payload), told


async def test_a_command_reaches_the_desk_with_all_that_it_says(intake, desk):
    response, told = await answer(
        intake,
        topic="daqsvc/lab/edge-1/rig/commands/shelve",
        duration_s=600.0,
        occurrence="o-1",
        reason="probe is being replaced",
    )
    ((command, source),) = desk.asked
    assert command == AlarmCommand(
        verb=Verb.SHELVE,
        alarm="rotor-fault",
        by="Ada",
        duration_s=600.0,
        occurrence="o-1",
        reason="probe is being replaced",
        machine="rig",
    )
    assert source == "mqtt daqsvc/lab/edge-1/rig/commands/shelve"
    assert (response.accepted, response.id, response.events) == (True, "c1", ("edge-1-7",))
    assert (response.machine, response.verb, response.reason) == ("rig", "shelve", "")
    assert told.topic == "daqsvc/lab/edge-1/rig/commands/shelve/response"
    assert asdict(intake.counters) == asdict(intake.counters) | {"accepted": 1, "refused": 0}


async def test_a_refusal_of_the_alarms_is_passed_on_and_counted(intake):
    async def strict(_command, _source):
        return CommandOutcome(accepted=False, reason="the condition stands", code="C08")

    intake._handler = strict
    response, _ = await answer(intake)
    assert (response.accepted, response.reason, response.code) == (False, "the condition stands", "C08")
    assert (intake.counters.accepted, intake.counters.refused) == (0, 1)


LATE = (NOW - timedelta(seconds=61)).isoformat()
AHEAD = (NOW + timedelta(hours=1)).isoformat()
REFUSED = {
    "no JSON": ({"payload": b"acknowledge!"}, "malformed", "JSON"),
    "nothing": ({"payload": b""}, "malformed", "JSON"),
    "not UTF-8": ({"payload": b'{"id": "\xff"}'}, "malformed", "schema daqsvc.command/1"),
    "a list": ({"payload": b"[1]"}, "malformed", "object"),
    "deeply nested": ({"payload": b"[" * 4000}, "malformed", "JSON"),
    "oversized": ({"reason": "x" * 5000}, "malformed", "at most 4096"),
    "another version": ({"schema": "daqsvc.command/2"}, "malformed", "daqsvc.command/1"),
    "another schema": ({"schema": "daqsvc.alarm/1"}, "malformed", "daqsvc.command/1"),
    "unknown key": ({"force": True}, "malformed", "force: there is no such key"),
    "wrong type": ({"by": 7}, "malformed", "by: must be a text"),
    "nobody": ({"by": ""}, "malformed", "by: must not be empty"),
    "line break": ({"by": "Ada\nalarm reset by root"}, "malformed", "by: "),
    "a C1 control character": ({"by": "\u009b31mAda"}, "malformed", "1: by: must be printable"),
    "a turned direction": ({"reason": "\u202eabc"}, "malformed", "1: reason: must be printable"),
    "a line separator": ({"reason": "a\u2028b"}, "malformed", "reason: "),
    "a paragraph separator": ({"occurrence": "a\u2029b"}, "malformed", "occurrence: "),
    "a next line": ({"by": "Ada\u0085"}, "malformed", "by: "),
    "a key twice": (
        {"payload": json.dumps(COMMAND).encode()[:-1] + b', "by": "Eve"}'},
        "malformed",
        "key 'by' is there twice; write it once",
    ),
    "no offset": (
        {"issued_at": "2026-11-21T12:00:00"},
        "malformed",
        "issued_at: must have an offset from UTC, e",
    ),
    "a time as number": ({"issued_at": 1}, "malformed", "issued_at: must be a time, e.g. 2026"),
    "no time": ({"issued_at": "noon"}, "malformed", "issued_at: must be a time, e.g. 2026"),
    "a long name": ({"by": "x" * 101}, "malformed", "by: must have 100 characters at most"),
    "no such id": ({"id": "?"}, "malformed", "id: must match ^[A-Z"),
    "no number": ({"duration_s": "1"}, "malformed", "duration_s: must be a number"),
    "negative time": ({"duration_s": -1}, "malformed", "duration_s: must be above 0"),
    "another machine": (
        {"topic": "daqsvc/lab/edge-1/pump/commands/acknowledge"},
        "unauthorised",
        "no commands for machine 'pump'",
    ),
    "a verb not allowed": (
        {"topic": "daqsvc/lab/edge-1/rig/commands/reset"},
        "unauthorised",
        "allowed: acknowledge, shelve",
    ),
    "no verb": (
        {"topic": "daqsvc/lab/edge-1/rig/commands/reboot"},
        "malformed",
        "no verb 'reboot'; the last part of a command's topic is one of acknowledge, reset",
    ),
    "a level below the verb": (
        {"topic": "daqsvc/lab/edge-1/rig/commands/acknowledge/rotor-fault"},
        "malformed",
        "no verb 'acknowledge/rotor-fault'",
    ),
    "too old": ({"issued_at": LATE}, "stale", "61 s ago, with at most 60 s allowed"),
    "older than its sender wants": (
        {"issued_at": (NOW - timedelta(seconds=10)).isoformat(), "expires_s": 5},
        "stale",
        "at most 5 s",
    ),
    "from the future": ({"issued_at": AHEAD}, "stale", "3600 s in the future"),
    "retained": ({"retain": True}, "stale", "retained"),
}


@pytest.mark.parametrize(("options", "counted", "reason"), REFUSED.values(), ids=REFUSED)
async def test_what_is_not_a_command_is_refused_counted_and_changes_nothing(
    intake, desk, options, counted, reason, caplog
):
    response, _ = await answer(intake, **options)
    assert not response.accepted
    assert reason in response.reason
    assert response.code == ("C04" if "for machine" in reason else "O21")
    assert [f"{line.code}" for line in caplog.records] == [response.code]
    assert response.events == ()
    assert desk.asked == []
    counters = asdict(intake.counters)
    assert counters.pop(counted) == 1
    assert not any(counters.values())


def test_the_words_of_a_name_may_have_any_letters():
    told = CommandPayload.model_validate_json(
        json.dumps(COMMAND | {"by": "Łukasz 李 Müller", "reason": "é µm"})
    )
    assert (told.by, told.reason) == ("Łukasz 李 Müller", "é µm")


@pytest.mark.parametrize(
    ("below", "answers"),
    [
        ("acknowledge", False),
        ("acknowledge/response", True),
        ("acknowledge/response/ada", True),
        ("acknowledge/foo", False),
        ("acknowledge/foo/response", True),
        ("response", False),
    ],
)
def test_an_answer_is_no_command(below, answers):
    assert TOPICS.command_of(f"daqsvc/lab/edge-1/rig/commands/{below}").is_answer is answers


@pytest.mark.parametrize(
    "topic",
    [
        "",
        "/",
        "notice",
        "company/notice",
        "company/site/notice",
        "company/site/box/notice",
        "daqsvc",
        "daqsvc/lab",
        "daqsvc/lab/edge-1",
        "daqsvc/lab/edge-1/",
        "daqsvc/lab/edge-1/rig",
        "daqsvc/lab/edge-1/rig/commands",
        "daqsvc/lab/edge-1/rig/alarms/rotor-fault",
        "daqsvc/lab/edge-2/rig/commands/acknowledge",
        "daqsvc/lab/edge-11/rig/commands/acknowledge",
        "x/daqsvc/lab/edge-1/rig/commands/acknowledge",
        "daqsvc/lab/edge-1/rig/commands/acknowledge/response",
        "daqsvc/lab/edge-1/rig/commands/acknowledge/response/ada",
    ],
)
async def test_what_no_filter_of_the_box_matches_has_no_answer(intake, desk, topic):
    assert await intake.take(message(topic=topic)) is None
    assert desk.asked == []
    assert not any(asdict(intake.counters).values())


async def test_halves_of_characters_are_a_refusal_like_any_other(intake, desk):
    """JSON can say \\ud800, which no text in UTF-8 can hold."""
    for key in ("id", "alarm", "by", "reason", "occurrence", "schema", "issued_at", "\ud800"):
        told = await intake.take(message(payload=json.dumps(COMMAND | {key: "x\ud800"}).encode()))
        response = ResponsePayload.model_validate_json(told.payload)
        assert not response.accepted
        assert response.id in {"c1", "x?"}
    assert desk.asked == []
    assert intake.counters.malformed == 8


async def test_a_command_that_comes_again_after_a_restart_is_not_obeyed_again(desk, tmp_path):
    await answer(make(desk, tmp_path))
    repeated, _ = await answer(make(desk, tmp_path))
    assert "'c1' has come before" in repeated.reason
    assert len(desk.asked) == 1


async def test_a_command_whose_id_cannot_be_written_is_not_obeyed(desk, tmp_path):
    (tmp_path / "command-ids").mkdir()
    intake = make(desk, tmp_path)
    response, _ = await answer(intake)
    assert "its id cannot be stored" in response.reason
    assert response.code == "S08"
    assert desk.asked == []
    assert intake.counters.unwritten == 1


async def test_a_topic_of_any_length_is_neither_logged_nor_answered_whole(intake, caplog):
    topic = f"daqsvc/lab/edge-1/{'x' * 60_000}/commands/{'y' * 5000}"
    response, _ = await answer(intake, topic=topic)
    assert max(len(response.machine), len(response.verb), len(response.reason)) < 500
    assert all(len(record.getMessage()) < 1000 for record in caplog.records)


async def test_a_sender_may_not_allow_itself_more_time(intake, desk):
    response, _ = await answer(intake, issued_at=LATE, expires_s=3600)
    assert not response.accepted
    assert desk.asked == []


async def test_a_command_that_comes_twice_is_carried_out_once(intake, desk):
    first, _ = await answer(intake)
    second, _ = await answer(intake)
    other, _ = await answer(intake, id="c2")
    assert (first.accepted, second.accepted, other.accepted) == (True, False, True)
    assert (first.code, second.code, other.code) == (None, "O21", None)
    assert "'c1' has come before" in second.reason
    assert len(desk.asked) == 2


async def test_a_flood_of_commands_cannot_make_the_box_forget_an_id(intake, desk, monkeypatch):
    monkeypatch.setattr("daqsvc.outbox.command_ids.REMEMBERED", 10)
    answers = [(await answer(intake, id=f"n{number}"))[0] for number in range(30)]
    assert [one.code for one in answers] == [None] * 10 + ["C07"] * 20
    repeated, _ = await answer(intake, id="n0")
    assert "has come before" in repeated.reason
    assert len(desk.asked) == 10
    assert intake.counters.stale == 21


async def test_ids_are_forgotten_when_a_repeat_would_be_too_old_anyway(desk, tmp_path, monkeypatch):
    monkeypatch.setattr("daqsvc.outbox.command_ids.REMEMBERED", 1)
    clock = DrivenClock(wall_start_ns=round(NOW.timestamp()) * 10**9)
    intake = CommandIntake(SETTINGS, ("rig",), TOPICS, desk, clock, CommandIds(tmp_path / "ids"))
    await answer(intake)
    clock.advance_to(clock.monotonic_ns() + 121 * 10**9)
    repeated, _ = await answer(intake)
    later, _ = await answer(intake, id="c2", issued_at=(NOW + timedelta(seconds=121)).isoformat())
    assert "121 s ago" in repeated.reason
    assert later.accepted


async def test_a_refused_command_may_come_again_when_the_clocks_are_set(intake):
    late, _ = await answer(intake, issued_at=LATE)
    again, _ = await answer(intake)
    assert (late.accepted, again.accepted) == (False, True)


async def test_the_sender_learns_which_of_its_commands_was_refused(intake):
    response, _ = await answer(intake, schema="daqsvc.command/9", id="mine")
    assert response.id == "mine"
    nameless, _ = await answer(intake, payload=b"{")
    assert nameless.id is None


async def test_mqtt5_senders_are_answered_where_they_want_and_recognise_it(intake):
    wanted = {"response_topic": "operators/ada/answers", "correlation": b"\x01\x02"}
    _, told = await answer(intake, properties=wanted)
    assert (told.topic, told.correlation) == ("operators/ada/answers", b"\x01\x02")


@pytest.mark.parametrize(
    "topic",
    [
        "daqsvc/lab/edge-1/rig/alarms/rotor-fault",
        "daqsvc/lab/edge-2/rig/commands/acknowledge",
        "daqsvc/lab/edge-1/rig/commands/acknowledge",
        "homeassistant/device/x/config",
        "ha/discovery/device/x/config",
        "ha/discovery",
        "daqsvc",
        "STATE/host",
        "line\nbreak",
        "spBv1.0/g/NCMD/e",
        "$SYS/broker",
        "x" * 300,
    ],
)
async def test_an_answer_never_speaks_in_the_name_of_somebody_else(desk, tmp_path, topic):
    """The box may write where the sender may not: the sender must not borrow that."""
    intake = make(desk, tmp_path, reserved=("ha/discovery",))
    response, told = await answer(intake, properties={"response_topic": topic})
    assert told.topic == f"{ACKNOWLEDGE}/response"
    assert response.accepted


async def test_a_flood_of_refusals_does_not_fill_the_log(intake, caplog):
    caplog.set_level(logging.INFO)
    for _ in range(100):
        await answer(intake, payload=b"nonsense")
    assert len(caplog.records) == 1
    assert intake.counters.malformed == 100


async def test_a_sender_writes_no_lines_into_the_log(intake, caplog):
    await answer(intake, **{"x\nroot: alarm reset": 1})
    assert "\n" not in caplog.records[0].getMessage()


async def test_the_limit_of_the_size_is_the_machine_files(desk, tmp_path):
    intake = make(desk, tmp_path, commands(*SETTINGS.allow, max_bytes=300))
    response, _ = await answer(intake, reason="x" * 250)
    assert "at most 300" in response.reason


@given(
    st.binary(max_size=300)
    | st.dictionaries(st.text(max_size=8), st.integers()).map(json.dumps).map(str.encode)
    | st.dictionaries(
        st.sampled_from([*COMMAND, "reason", "occurrence", "duration_s", "expires_s", "x"]),
        st.text(st.characters(codec=None, categories=None), max_size=8)
        | st.floats()
        | st.integers()
        | st.none(),
    ).map(lambda told: json.dumps(COMMAND | told).encode())
)
async def test_whatever_comes_there_is_an_answer(payload):
    desk = Desk()
    with tempfile.TemporaryDirectory() as store:
        response, _ = await answer(make(desk, Path(store)), payload=payload)
    assert len(desk.asked) == response.accepted
    assert response.accepted or response.reason


@pytest.mark.gives("S13")
@pytest.mark.parametrize("damage", ["", None, "spoilt"])
async def test_with_its_ids_lost_a_restart_obeys_nothing_from_before(desk, tmp_path, damage):
    clock = DrivenClock(wall_start_ns=round(NOW.timestamp()) * 10**9)
    ids = CommandIds(tmp_path / "command-ids")
    assert not ids.open(clock.wall_ns(), is_new=True)
    response, _ = await answer(CommandIntake(SETTINGS, ("rig",), TOPICS, desk, clock, ids))
    assert response.accepted
    if damage is None:
        (tmp_path / "command-ids").unlink()
    else:
        (tmp_path / "command-ids").write_text(damage)
    clock = DrivenClock(wall_start_ns=round(NOW.timestamp() + 10) * 10**9)
    ids = CommandIds(tmp_path / "command-ids")
    assert ids.open(clock.wall_ns(), is_new=False)
    again = CommandIntake(SETTINGS, ("rig",), TOPICS, desk, clock, ids)
    response, _ = await answer(again)
    assert not response.accepted
    assert "before the service started" in response.reason
    assert response.code == "S13"
    assert len(desk.asked) == 1
    response, _ = await answer(again, id="c2", issued_at=(NOW + timedelta(seconds=11)).isoformat())
    assert response.accepted
