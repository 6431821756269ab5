"""The ingester of config/postgresql: every alarm event stands in the table once, whoever falls over."""

from __future__ import annotations

import argparse
import importlib.util
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
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode
from support.brokers import Mosquitto
from support.given_codes import had
from support.paths import ROOT
from support.ports import LOOPBACK, free_port
from support.postgres import Postgres, make_cluster
from support.waiting import PATIENCE_S

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]
FOLDER = ROOT / "config" / "postgresql"
EVENTS = 4000
TIMESCALE = """
CREATE TABLE hypertables (relation regclass PRIMARY KEY);
CREATE FUNCTION create_hypertable(
    relation regclass, time_column_name name,
    if_not_exists boolean DEFAULT false, migrate_data boolean DEFAULT false
) RETURNS void LANGUAGE plpgsql AS $$
DECLARE at_number smallint := (
    SELECT attnum FROM pg_attribute WHERE attrelid = relation AND attname = time_column_name
);
BEGIN
    IF at_number IS NULL OR EXISTS (
        SELECT FROM pg_index WHERE indrelid = relation AND indisunique AND at_number <> ALL (indkey::int2[])
    ) THEN
        RAISE EXCEPTION 'each unique index has to have the time';
    END IF;
    INSERT INTO hypertables VALUES (relation);
END $$;
CREATE FUNCTION add_retention_policy(
    relation regclass, drop_after interval, if_not_exists boolean DEFAULT false
) RETURNS void LANGUAGE plpgsql AS $$
BEGIN
    IF NOT EXISTS (SELECT FROM hypertables AS made WHERE made.relation = add_retention_policy.relation) THEN
        RAISE EXCEPTION 'no hypertable';
    END IF;
END $$;
"""
"""Functions called like those of TimescaleDB, which Debian does not have, and with arguments of theirs."""


@pytest.fixture(scope="module")
def guide():
    """The roles and grants that the documentation names."""
    text = (ROOT / "docs" / "postgresql.md").read_text(encoding="utf-8")
    return "\n".join(re.findall(r"```sql\n(.*?)```", text, flags=re.DOTALL)[:1])


@pytest.fixture(scope="module")
def base():
    # The folders of pytest are root's, and PostgreSQL is not.
    made = Path(tempfile.mkdtemp(prefix="daqsvc-pg-"))
    made.chmod(0o755)
    yield made
    shutil.rmtree(made)


@pytest.fixture(scope="module")
def cluster(base):
    make_cluster(base / "cluster")
    return base / "cluster"


@pytest.fixture
def postgres(guide, base, cluster):
    server = Postgres(base / "server", cluster)
    server.start()
    try:
        with psycopg.connect(server.url, autocommit=True) as owner:
            owner.execute((FOLDER / "schema.sql").read_text(encoding="utf-8"))
            owner.execute((FOLDER / "schema.sql").read_text(encoding="utf-8"))
            owner.execute(guide)
        yield server
    finally:
        if server.is_running:  # a test that fails may have left it crashed
            server.crash()
        shutil.rmtree(base / "server")


@pytest.fixture
def broker(tmp_path):
    """A broker that keeps sessions and messages over a restart, as the documentation asks for."""
    text = (ROOT / "docs" / "postgresql.md").read_text(encoding="utf-8")
    [lines] = re.findall(r"```\n(persistence true\n.*?)```", text, flags=re.DOTALL)
    mosquitto = Mosquitto(tmp_path, config=lines.replace("/var/lib/mosquitto/", f"{tmp_path}/"))
    conf = tmp_path / "mosquitto.conf"
    conf.write_text(conf.read_text().replace("persistence false\n", ""))
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


def test_what_the_page_shows_of_psql_and_timescale_runs(postgres):
    """The functions are ours: names, arguments and the rule about unique indexes are those of TimescaleDB."""
    text = (ROOT / "docs" / "postgresql.md").read_text("utf-8")
    [line] = re.findall(r"(?m)^(psql plant -f \S+)", text)
    _, statements = re.findall(r"```sql\n(.*?)```", text, flags=re.DOTALL)
    with psycopg.connect(postgres.url, autocommit=True) as owner:
        owner.execute("CREATE DATABASE plant")
    at = {"PGHOST": LOOPBACK, "PGPORT": f"{postgres.port}", "PGUSER": "owner"}
    subprocess.run(
        [*line.split(), "-v", "ON_ERROR_STOP=1"],
        cwd=ROOT, env={**os.environ, **at}, check=True, capture_output=True,
    )  # fmt: skip
    with psycopg.connect(postgres.url.replace("/postgres", "/plant")) as plant:
        plant.execute(TIMESCALE)
        plant.commit()
        for right, wrong in (
            ("add_retention_policy", "add_retention_polcy"),
            ("'at'", "'time'"),
            ("migrate_data", "migrate"),
            ("daqsvc.diagnoses", "daqsvc.diagnosis"),
            ("'daqsvc.diagnoses', 'at'", "'daqsvc.alarm_events', 'at'"),
            ("13 months", "13 moons"),
        ):
            assert right in statements
            with pytest.raises(psycopg.Error):
                plant.execute(statements.replace(right, wrong))
            plant.rollback()
        plant.execute(statements)


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


POISON = {
    "an object as id": (json.dumps({**alarm(1), "id": {"a": 1}}), "id is no text"),
    "a number as time": (json.dumps({**alarm(2), "time": 5}), "time is no text"),
    "no time": (json.dumps({**alarm(3), "time": "yesterday at noon"}), "none of ISO 8601"),
    "a time without an end": (json.dumps({**alarm(30), "time": "infinity"}), "none of ISO 8601"),
    "a time that is another each day": (json.dumps({**alarm(31), "time": "tomorrow"}), "none of ISO 8601"),
    "a time of no zone": (json.dumps({**alarm(32), "time": "2026-11-21T12:28:15"}), "none of ISO 8601"),
    "no such day": (json.dumps({**alarm(33), "time": "2026-02-30T12:28:15Z"}), "out of range"),
    "a statement of now": (json.dumps({**statement(34), "time": "now"}), "none of ISO 8601"),
    "half a surrogate pair": (json.dumps({**alarm(4), "message": "\ud800"}), "can't encode"),
    "half of one elsewhere": (json.dumps({**alarm(5), "more": "\ud800"}), "invalid input syntax"),
    "too deep": ("[" * 100_000, "recursion"),
    "deep, but JSON": (json.dumps({**alarm(6), "more": 0})[:-2] + "[" * 900 + "]" * 900 + "}", None),
    "an id of 18 kB": (json.dumps({**alarm(7), "id": "".join(map(str, range(4500)))}), "longer than"),
    "a sequence beyond bigint": (json.dumps({**alarm(8), "sequence": 2**63}), "sequence is too large"),
    "no object": ("5", "TypeError"),
}
"""Messages that must not stop an ingester, and a part of why they are rejected; None: they are taken."""


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


@pytest.mark.parametrize("names", [("ingest-1",), ("ingest-1", "ingest-2")], ids=["one", "two"])
def test_every_event_stands_once_whatever_falls_over(tmp_path, broker, postgres, ingesters, names):
    """By one ingester: by two, each of which gets every event, what one loses the other still writes."""
    first, *_ = [ingesters(name) for name in names]
    subscribed(tmp_path / "mosquitto.log", len(names))
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


@pytest.mark.long
def test_nothing_is_acknowledged_before_it_is_committed(tmp_path, broker, postgres, ingesters):
    """What an ingester holds while PostgreSQL is away comes again after it was killed."""
    log = tmp_path / "mosquitto.log"
    first = ingesters("ingest-1")
    subscribed(log, 1)
    postgres.crash()
    box = publisher(broker)
    try:
        for number in range(50):
            say(box, json.dumps(alarm(number)), f"edge-{number % 7}")
        for _ in range(2):  # between two attempts there is time for what it must not do
            while "PostgreSQL is away" not in first.stderr.readline():
                assert first.poll() is None
        assert "Received PUBACK from daqsvc-ingest-1" not in log.read_text(errors="replace")
        first.kill()
        first.communicate()
        postgres.start()
        ingesters("ingest-1")
        until(lambda: rows(postgres, "SELECT count(*) FROM daqsvc.alarm_events"), [(50,)])
        until(
            lambda: log.read_text(errors="replace").count("Received PUBACK from daqsvc-ingest-1") >= 50, True
        )
    finally:
        box.disconnect()
        box.loop_stop()


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


@pytest.mark.long
def test_each_unusable_message_stands_once_however_many_get_it(tmp_path, broker, postgres, ingesters):
    with psycopg.connect(postgres.url, autocommit=True) as owner:
        # Of a version in which each stood there more than once.
        owner.execute("DROP INDEX daqsvc.rejected_once")
        for payload in (b"old", b"old", b"older"):
            owner.execute(
                "INSERT INTO daqsvc.rejected (topic, payload, reason) VALUES ('t', %s, '')", [payload]
            )
        owner.execute((FOLDER / "schema.sql").read_text(encoding="utf-8"))
        assert rows(postgres, "SELECT count(*) FROM daqsvc.rejected") == [(2,)]
        owner.execute("TRUNCATE daqsvc.rejected")
    for name in ("ingest-1", "ingest-2"):
        ingesters(name)
    subscribed(tmp_path / "mosquitto.log", 2)
    box = publisher(broker)
    try:
        for payload in (b"no json", b"no json either", b"no json"):
            say(box, payload)
        say(box, b"no json", "edge-1")
        acknowledged = re.compile(r"Received PUBACK from daqsvc-ingest-\d")
        log = tmp_path / "mosquitto.log"
        until(lambda: len(acknowledged.findall(log.read_text(errors="replace"))), 8)
    finally:
        box.disconnect()
        box.loop_stop()
    assert rows(postgres, "SELECT payload, count(*) FROM daqsvc.rejected GROUP BY 1 ORDER BY 1") == [
        (b"no json", 2),  # of two topics
        (b"no json either", 1),
    ]


@pytest.mark.parametrize(
    ("arguments", "environment", "why"),
    [
        ((), {}, "$DATABASE is not set; write where"),
        ((), {"DATABASE": "plant of ours"}, "$DATABASE does not state where PostgreSQL is ("),
        (("--user", "x"), {"DATABASE": "dbname=plant"}, "--user needs the password of that user in $MQTT_P"),
        (("--ca", "nofile"), {"DATABASE": "dbname=plant"}, "--ca nofile cannot be used: No such file or dir"),
        (("--ca", __file__), {"DATABASE": "dbname=plant"}, "cannot be used: it holds no certificates; name"),
        (("--port", "99999"), {}, "argument --port: '99999' is no port; write 1 to 65535"),
        (("--broker", ""), {}, "argument --broker: '' is no name"),
        (("--root", "a/#"), {}, "argument --root: 'a/#' is no part of a topic"),
        (("--group", ""), {}, "argument --group: '' is no part of a topic"),
    ],
)
def test_a_mistake_of_its_command_line_is_one_sentence(tmp_path, arguments, environment, why):
    command = [sys.executable, FOLDER / "ingest.py", "--id", "one", *arguments]
    clean = {key: one for key, one in os.environ.items() if key not in {"DATABASE", "MQTT_PASSWORD"}}
    done = subprocess.run(
        command,
        env={**clean, **environment},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("ingest.py: ")
    assert why in done.stderr
    assert done.stderr.count("\n") == 1
    assert re.search(r" \[C(01|02|10)\]\n$", done.stderr)


@pytest.mark.long
def test_a_broker_that_goes_and_comes_is_one_line_each(broker):
    broker.shut_down()
    command = [sys.executable, FOLDER / "ingest.py", "--port", str(broker.port), "--id", "ingest-1"]
    environment = {**os.environ, "DATABASE": "dbname=plant"}
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as running:
        try:
            named = f"the broker 127.0.0.1:{broker.port}"
            gone = f"WARNING {named} is away, and is tried again: "
            assert running.stderr.readline() == f"{gone}Connection refused [O09]\n"
            for _ in range(2):
                time.sleep(1.5)  # it is tried again meanwhile, and nothing is said
                broker.start()
                assert running.stderr.readline() == f"INFO connected to {named}\n"
                broker.shut_down()
                assert running.stderr.readline().startswith(f"{gone}the connection has ended (")
        finally:
            running.terminate()
        assert running.stderr.read() == ""


@pytest.fixture(scope="module")
def ingest():
    """The program, as a module."""
    spec = importlib.util.spec_from_file_location("ingest", FOLDER / "ingest.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_no_message_stops_an_ingester(tmp_path, broker, postgres, ingesters):
    running = ingesters("ingest-1")
    subscribed(tmp_path / "mosquitto.log", 1)
    box = publisher(broker)
    taken = [payload for payload, why in POISON.values() if why is None]
    try:
        for payload, _ in POISON.values():
            say(box, payload)
        say(box, json.dumps(alarm(100)))
        until(lambda: rows(postgres, "SELECT count(*) FROM daqsvc.alarm_events"), [(1 + len(taken),)])
        until(lambda: rows(postgres, "SELECT count(*) FROM daqsvc.rejected"), [(len(POISON) - len(taken),)])
    finally:
        box.disconnect()
        box.loop_stop()
    assert running.poll() is None
    reasons = dict(rows(postgres, "SELECT payload, reason FROM daqsvc.rejected"))
    for what, (payload, why) in POISON.items():
        if why is not None:
            assert why in reasons[payload.encode()], what


def test_what_only_the_server_finds_wrong_is_rejected_too(ingest, postgres, monkeypatch):
    """A message that its checks let through, by each class of errors of psycopg."""
    sound = ingest.row_of(json.dumps(alarm(100)).encode())
    values = {
        "ProgrammingError": ({"a": 1}, *sound[1][1:]),  # psycopg knows no such type
        "UntranslatableCharacter": (*sound[1][:-1], '"\\u0000"'),
        "StatementTooComplex": (*sound[1][:-1], "[" * 100_000),
        "ProgramLimitExceeded": (os.urandom(9000).hex(), *sound[1][1:]),
    }
    rows_of = [*((ingest.ALARM, one) for one in values.values()), sound]
    monkeypatch.setattr(ingest, "row_of", lambda payload: rows_of[int(payload)])
    options = argparse.Namespace(id="x", user=None, ca=None)
    ingester = ingest.Ingester(options, postgres.url_of("daqsvc_ingest"))
    batch = []
    for number in range(len(rows_of)):
        message = paho.MQTTMessage(mid=number, topic=b"t")
        message.payload = b"%d" % number
        batch.append(ingest.Arrived(0, message))
    ingester._insert(ingester._connected(), batch)
    ingester._disconnect()
    assert rows(postgres, "SELECT sequence FROM daqsvc.alarm_events") == [(100,)]
    reasons = [reason for (reason,) in rows(postgres, "SELECT reason FROM daqsvc.rejected ORDER BY payload")]
    assert [reason.partition(":")[0] for reason in reasons] == list(values)


@pytest.mark.parametrize(
    ("code", "is_of_message"),
    [
        *(("22P02", True), ("23502", True), ("42804", True), ("54000", True), ("0A000", True)),
        *(("08006", False), ("53100", False), ("57P01", False), ("40001", False), ("25006", False)),
        *(("42501", False), ("42P01", False), ("28P01", False), ("58030", False)),
    ],
)
def test_what_is_of_the_message_and_what_of_the_server(ingest, code, is_of_message):
    assert ingest.is_of_message(psycopg.errors.lookup(code)("why")) is is_of_message


def test_what_a_right_is_missing_for_waits_for_it(tmp_path, broker, postgres, ingesters):
    with psycopg.connect(postgres.url, autocommit=True) as owner:
        owner.execute("REVOKE INSERT ON daqsvc.alarm_events FROM daqsvc_ingest")
        running = ingesters("ingest-1")
        subscribed(tmp_path / "mosquitto.log", 1)
        box = publisher(broker)
        try:
            say(box, json.dumps(alarm(1)))
            assert "INFO connected to" in running.stderr.readline()
            assert "permission denied" in running.stderr.readline()
            owner.execute("GRANT INSERT ON daqsvc.alarm_events TO daqsvc_ingest")
            until(lambda: rows(postgres, "SELECT count(*) FROM daqsvc.alarm_events"), [(1,)])
        finally:
            box.disconnect()
            box.loop_stop()
    assert rows(postgres, "SELECT count(*) FROM daqsvc.rejected") == [(0,)]


class _Refusing:
    """A client that only takes note."""

    def __init__(self):
        self.asked = []

    def subscribe(self, topics):
        self.asked = [topic for topic, _ in topics]


def test_what_the_broker_refuses_is_said(ingest, caplog):
    options = argparse.Namespace(
        id="x", user=None, ca=None, root="daqsvc", group="g", broker="broker.plant", port=1883
    )
    ingester, client = ingest.Ingester(options, "dbname=plant"), _Refusing()
    refused = ReasonCode(PacketTypes.CONNACK, "Not authorized")
    for _ in range(3):
        ingester._on_connect(client, None, None, refused, None)
    [line] = caplog.records
    assert "it refuses the connection (Not authorized): see to --user" in line.getMessage()
    assert line.getMessage().endswith(" [O11]")
    caplog.clear()
    ingester._on_connect(client, None, None, ReasonCode(PacketTypes.CONNACK, "Success"), None)
    reasons = [
        ReasonCode(PacketTypes.SUBACK, "Granted QoS 1"),
        ReasonCode(PacketTypes.SUBACK, "Not authorized"),
    ]
    ingester._on_subscribe(client, None, 1, reasons, None)
    [line] = [one.getMessage() for one in caplog.records if one.levelname == "ERROR"]
    assert f"refuses to send {client.asked[1]} (Not authorized), and nothing of it is written: let" in line
    assert line.endswith(" [O12]")


def test_a_database_that_is_away_is_said_with_its_code(ingest, caplog, monkeypatch):
    options = argparse.Namespace(id="x", user=None, ca=None, broker="broker.plant", port=1883)
    monkeypatch.setattr(ingest, "RETRY_S", 0.0)
    ingester = ingest.Ingester(options, f"host=127.0.0.1 port={free_port()} dbname=plant")
    turns = iter([False, True])
    ingester._write([], lambda: next(turns))
    [line] = caplog.messages
    assert line.startswith("PostgreSQL is away, and nothing is acknowledged: connection ")
    assert line.endswith(" [O24]")
    had("O24", " ".join(line.split()))
