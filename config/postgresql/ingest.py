"""Write what daqsvc says over MQTT into PostgreSQL: each alarm event once, however often it comes.

    DATABASE=postgresql://daqsvc_ingest@db/plant python ingest.py --broker broker --id ingest-1

Several of these with different ids share the telemetry of a fleet; each of them writes every alarm event, of
which the table keeps one. See docs/postgresql.md.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import queue
import signal
import threading
import time
from typing import TYPE_CHECKING, Any, NamedTuple

import paho.mqtt.client as paho
import psycopg
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

if TYPE_CHECKING:
    from collections.abc import Callable

log = logging.getLogger("ingest")

UNDER_WAY = 500
"""Messages that the broker sends before the first of them is acknowledged: as many as are held in memory."""
SESSION_S = 7 * 86_400
"""How long the broker keeps messages for this ingester while it is away."""
GATHER_S = 0.2
RETRY_S = 1.0

ALARM = """INSERT INTO daqsvc.alarm_events
    (id, site, box, machine, alarm, sequence, occurrence, at, kind, state, level, message, event)
    VALUES (%s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s) ON CONFLICT DO NOTHING"""
DIAGNOSIS = """INSERT INTO daqsvc.diagnoses
    (at, site, box, machine, detector, monotonic_ns, decision, severity, quality, statistics, diagnosis)
    VALUES (%s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s) ON CONFLICT DO NOTHING"""
REJECTED = "INSERT INTO daqsvc.rejected (topic, payload, reason) VALUES (%s, %s, %s)"


class Arrived(NamedTuple):
    """A message, and the connection that it came over."""

    connection: int
    message: paho.MQTTMessage


def row_of(payload: bytes | bytearray) -> tuple[str, tuple[Any, ...]]:
    """The statement and the values of a message.

    Raises:
        KeyError, TypeError, ValueError: it is none that is known here.
    """
    document, text = json.loads(payload), payload.decode()
    machine = tuple(document[name] for name in ("site", "box", "machine"))
    if document["schema"] == "daqsvc.alarm/1":
        names = ("alarm", "sequence", "occurrence", "time", "kind", "state", "level", "message")
        return ALARM, (document["id"], *machine, *(document[name] for name in names), text)
    if document["schema"] == "daqsvc.diagnosis/1":
        said = (document[name] for name in ("detector", "monotonic_ns", "decision", "severity", "quality"))
        return DIAGNOSIS, (document["time"], *machine, *said, json.dumps(document["statistics"]), text)
    raise ValueError(f"schema {document['schema']!r:.60} is not known here")


class Ingester:
    """Takes messages from a broker, and acknowledges each when PostgreSQL has it on disk.

    Args:
        options: of the command line.
        database: how PostgreSQL is reached.
    """

    def __init__(self, options: argparse.Namespace, database: str) -> None:
        self._options, self._database = options, database
        self._arrived: queue.Queue[Arrived] = queue.Queue()
        self._connection = 0
        self._database_link: psycopg.Connection[Any] | None = None
        self._lock = threading.Lock()
        self._client = paho.Client(
            CallbackAPIVersion.VERSION2,
            client_id=f"daqsvc-{options.id}",
            protocol=paho.MQTTv5,
            manual_ack=True,
        )
        if options.user:
            self._client.username_pw_set(options.user, os.environ["MQTT_PASSWORD"])
        if options.ca:
            self._client.tls_set(options.ca)
        self._client.reconnect_delay_set(1, 30)
        self._client.on_connect = self._on_connect
        self._client.on_pre_connect = lambda _client, _data: self._another_connection()
        self._client.on_disconnect = lambda *_: self._another_connection()
        self._client.on_message = self._on_message

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Go on until told to stop; what is not committed by then comes again."""
        kept = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]  # paho has no type for it
        kept.SessionExpiryInterval, kept.ReceiveMaximum = SESSION_S, UNDER_WAY
        self._client.connect_async(
            self._options.broker, self._options.port, clean_start=False, properties=kept
        )
        self._client.loop_start()
        try:
            while not should_stop():
                if batch := self._gathered():
                    self._write(batch, should_stop)
        finally:
            self._client.disconnect()
            self._client.loop_stop()

    def _on_connect(
        self, client: paho.Client, _data: Any, _flags: Any, reason: Any, _properties: Any
    ) -> None:
        if reason.is_failure:
            log.error("the broker refuses the connection: %s", reason)
            return
        # Alarm events are few: each of them writes every one, and the table keeps one. Telemetry is shared.
        every = f"{self._options.root}/+/+/+"
        shared = f"$share/{self._options.group}/{every}"
        options = SubscribeOptions(1)
        client.subscribe([(f"{every}/alarms/#", options), (f"{shared}/diagnosis/#", options)])

    def _another_connection(self) -> None:
        with self._lock:
            self._connection += 1

    def _on_message(self, _client: paho.Client, _data: Any, message: paho.MQTTMessage) -> None:
        self._arrived.put(Arrived(self._connection, message))

    def _gathered(self) -> list[Arrived]:
        try:
            batch = [self._arrived.get(timeout=GATHER_S)]
        except queue.Empty:
            return []
        while len(batch) < UNDER_WAY and not self._arrived.empty():
            batch.append(self._arrived.get())
        return batch

    def _write(self, batch: list[Arrived], should_stop: Callable[[], bool]) -> None:
        """Commit, however long PostgreSQL is away; then acknowledge."""
        while not should_stop():
            try:
                self._insert(self._connected(), batch)
                self._acknowledge(batch)
            except psycopg.OperationalError as error:
                log.warning("PostgreSQL is away, and nothing is acknowledged: %s", f"{error}".strip())
                self._database_link = None
                time.sleep(RETRY_S)
            else:
                return

    def _connected(self) -> psycopg.Connection[Any]:
        if self._database_link is None or self._database_link.closed:
            self._database_link = psycopg.connect(self._database, connect_timeout=10, autocommit=True)
        return self._database_link

    def _insert(self, connection: psycopg.Connection[Any], batch: list[Arrived]) -> None:
        rows: dict[str, list[tuple[Any, ...]]] = {ALARM: [], DIAGNOSIS: [], REJECTED: []}
        for one in batch:
            statement, values = self._row(one.message)
            rows[statement].append(values)
        try:
            with connection.transaction(), connection.cursor() as cursor:
                for statement, several in rows.items():
                    if several:
                        cursor.executemany(statement, several)
        except (psycopg.DataError, psycopg.IntegrityError):
            for one in batch:
                self._insert_one(connection, one.message)

    def _insert_one(self, connection: psycopg.Connection[Any], message: paho.MQTTMessage) -> None:
        statement, values = self._row(message)
        try:
            with connection.transaction():
                connection.execute(statement, values)
        except (psycopg.DataError, psycopg.IntegrityError) as error:
            with connection.transaction():
                connection.execute(REJECTED, (message.topic, message.payload, f"{error}"))

    def _row(self, message: paho.MQTTMessage) -> tuple[str, tuple[Any, ...]]:
        try:
            return row_of(message.payload)
        except (KeyError, TypeError, ValueError) as error:
            return REJECTED, (message.topic, message.payload, f"{type(error).__name__}: {error}")

    def _acknowledge(self, batch: list[Arrived]) -> None:
        """Over the connection that a message came by: over the next its number may be another message's."""
        for one in batch:
            with self._lock:
                if one.connection == self._connection:
                    self._client.ack(one.message.mid, one.message.qos)


def main() -> None:
    """Run until SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--broker", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=1883)
    parser.add_argument(
        "--id", required=True, help="of this ingester, another for each; keep it over restarts"
    )
    parser.add_argument("--group", default="postgresql", help="ingesters of one group share the messages")
    parser.add_argument("--root", default="daqsvc", help="topic_root of the machine files")
    parser.add_argument("--user", help="at the broker; the password is in $MQTT_PASSWORD")
    parser.add_argument("--ca", help="certificates that the broker's is signed by; it then speaks TLS")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    Ingester(options, os.environ["DATABASE"]).run(stop.is_set)


if __name__ == "__main__":
    main()
