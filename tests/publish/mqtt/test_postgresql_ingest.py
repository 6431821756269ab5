"""The ingester of config/postgresql: every alarm event stands in the table once, whoever falls over."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import paho.mqtt.client as paho
import psycopg
import pytest
from paho.mqtt.enums import CallbackAPIVersion
from support.brokers import Mosquitto
from support.paths import ROOT
from support.ports import LOOPBACK
from support.postgres import Postgres
from support.waiting import PATIENCE_S

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]
FOLDER = ROOT / "config" / "postgresql"
EVENTS = 4000


@pytest.fixture(scope="module")
def guide():
    """The roles and grants that the documentation names."""
    text = (ROOT / "docs" / "postgresql.md").read_text(encoding="utf-8")
    return "\n".join(re.findall(r"```sql\n(.*?)```", text, flags=re.DOTALL)[:1])


@pytest.fixture
def postgres(guide):
    # The folders of pytest are root's, and PostgreSQL is not.
    base = Path(tempfile.mkdtemp(prefix="daqsvc-pg-"))
    base.chmod(0o755)
    server = Postgres(base / "server")
    server.start()
    try:
        with psycopg.connect(server.url, autocommit=True) as owner:
            owner.execute((FOLDER / "schema.sql").read_text(encoding="utf-8"))
            owner.execute((FOLDER / "schema.sql").read_text(encoding="utf-8"))
            owner.execute(guide)
        yield server
    finally:
        server.crash()
        shutil.rmtree(base)


@pytest.fixture
def broker(tmp_path):
    """A broker that keeps sessions and messages over a restart, as the documentation asks for."""
    lines = f"persistence_location {tmp_path}/\nmax_queued_messages 0\n"
    mosquitto = Mosquitto(tmp_path, config=lines)
    conf = tmp_path / "mosquitto.conf"
    conf.write_text(conf.read_text().replace("persistence false", "persistence true"))
    mosquitto.start()
    try:
        yield mosquitto
    finally:
        mosquitto.stop()


@pytest.fixture
def ingesters(broker, postgres):
    running = {}

    def start(name):
        command = [sys.executable, FOLDER / "ingest.py", "--port", str(broker.port), "--id", name]
        environment = {**os.environ, "DATABASE": postgres.url_of("daqsvc_ingest")}
        running[name] = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        return running[name]

    yield start
    for process in running.values():
        process.terminate()
        process.communicate(timeout=PATIENCE_S)


def alarm(number):
    return {
        "schema": "daqsvc.alarm/1",
        "id": f"5d1f0c2a9be47763a1c8-{number}",
        "sequence": number,
        "site": "lab",
        "box": f"edge-{number % 7}",
        "machine": "rig",
        "alarm": "rotor-fault",
        "occurrence": None,
        "time": "2026-11-21T12:28:15.376165Z",
        "kind": "raised",
        "state": "active_unacknowledged",
        "level": "alert",
        "message": f"event {number}",
    }


def publisher(broker):
    client = paho.Client(CallbackAPIVersion.VERSION2, client_id="box", protocol=paho.MQTTv5)
    client.reconnect_delay_set(1, 1)
    client.max_inflight_messages_set(100)
    client.connect(LOOPBACK, broker.port, clean_start=paho.MQTT_CLEAN_START_FIRST_ONLY)
    client.loop_start()
    return client


def say(client, payload, box="edge-0", kind="alarms/rotor-fault"):
    return client.publish(f"daqsvc/lab/{box}/rig/{kind}", payload, qos=1)


def rows(postgres, query, *values):
    with psycopg.connect(postgres.url) as reader:
        return reader.execute(query, values).fetchall()


def until(question, expected):
    end = time.monotonic() + PATIENCE_S
    while (seen := question()) != expected and time.monotonic() < end:
        time.sleep(0.1)
    assert seen == expected


def subscribed(broker_log, count):
    until(
        lambda: broker_log.read_text(errors="replace").count("Sending SUBACK to daqsvc-ingest") >= count, True
    )


def test_every_event_stands_once_whatever_falls_over(tmp_path, broker, postgres, ingesters):
    first = ingesters("ingest-1")
    ingesters("ingest-2")
    subscribed(tmp_path / "mosquitto.log", 2)
    box = publisher(broker)
    try:

        def say_some(numbers):
            for number in numbers:
                say(box, json.dumps(alarm(number)), f"edge-{number % 7}")
                if number % 10 == 0:  # sent again, as after a lost PUBACK
                    say(box, json.dumps(alarm(number)), f"edge-{number % 7}")

        def written():
            return rows(postgres, "SELECT count(*) FROM daqsvc.alarm_events")[0][0]

        quarter = EVENTS // 4
        say_some(range(quarter))
        until(lambda: written() > 0, True)
        first.kill()
        first.communicate()
        say_some(range(quarter, 2 * quarter))
        ingesters("ingest-1")
        postgres.crash()
        say_some(range(2 * quarter, 3 * quarter))
        postgres.start()
        broker.shut_down()
        broker.start()
        say_some(range(3 * quarter, EVENTS))
        until(written, EVENTS)
        until(lambda: box.want_write() or len(box._out_messages), 0)
    finally:
        box.disconnect()
        box.loop_stop()
    numbers = rows(postgres, "SELECT sequence, count(*) FROM daqsvc.alarm_events GROUP BY 1 ORDER BY 1")
    assert numbers == [(number, 1) for number in range(EVENTS)]
    assert rows(postgres, "SELECT count(*) FROM daqsvc.rejected") == [(0,)]


def statement(number):
    return {
        "schema": "daqsvc.diagnosis/1",
        "site": "lab",
        "box": "edge-0",
        "machine": "rig",
        "time": "2026-11-21T12:28:15.5Z",
        "monotonic_ns": number,
        "detector": "levels/x",
        "decision": "alert",
        "severity": "alert",
        "quality": "good",
        "statistics": {"rms": 41.3},
    }


def test_ingesters_share_the_telemetry_of_a_fleet(tmp_path, broker, postgres, ingesters):
    ingesters("ingest-1")
    ingesters("ingest-2")
    log = tmp_path / "mosquitto.log"
    subscribed(log, 2)
    box = publisher(broker)
    try:
        for number in range(200):
            say(box, json.dumps(statement(number)), kind="diagnosis/levels/x")
        until(lambda: rows(postgres, "SELECT count(*) FROM daqsvc.diagnoses"), [(200,)])
    finally:
        box.disconnect()
        box.loop_stop()
    sent = re.findall(r"Sending PUBLISH to daqsvc-(ingest-\d).*/diagnosis/", log.read_text(errors="replace"))
    assert len(sent) == 200, "each goes to one of them"
    assert set(sent) == {"ingest-1", "ingest-2"}


def test_telemetry_the_present_state_and_what_is_rejected(tmp_path, broker, postgres, ingesters):
    ingesters("ingest-1")
    subscribed(tmp_path / "mosquitto.log", 1)
    diagnosis = statement(5)
    box = publisher(broker)
    try:
        say(box, json.dumps(diagnosis), kind="diagnosis/levels/x")
        say(box, json.dumps(diagnosis), kind="diagnosis/levels/x")
        say(box, json.dumps({**alarm(7), "message": "a \0 that PostgreSQL does not take"}))
        say(box, b"no json")
        say(box, json.dumps({**alarm(14), "schema": "daqsvc.alarm/2"}))
        say(box, json.dumps(alarm(21)))
        say(box, json.dumps({**alarm(28), "state": "normal"}))
        until(lambda: rows(postgres, "SELECT count(*) FROM daqsvc.alarm_events"), [(2,)])
        until(lambda: rows(postgres, "SELECT count(*) FROM daqsvc.rejected"), [(3,)])
    finally:
        box.disconnect()
        box.loop_stop()
    assert rows(postgres, "SELECT detector, statistics ->> 'rms' FROM daqsvc.diagnoses") == [
        ("levels/x", "41.3")
    ]
    assert rows(postgres, "SELECT sequence, state FROM daqsvc.alarms_now") == [(28, "normal")]
    with psycopg.connect(postgres.url_of("daqsvc_read")) as reader:
        assert reader.execute("SELECT count(*) FROM daqsvc.alarms_now").fetchone() == (1,)
        with pytest.raises(psycopg.errors.InsufficientPrivilege):
            reader.execute("DELETE FROM daqsvc.alarm_events")
