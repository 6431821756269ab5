"""Write what daqsvc sends over MQTT into PostgreSQL: each alarm event once, however often it comes.

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
import re
import signal
import ssl
import sys
import threading
import time
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import paho.mqtt.client as paho
import psycopg
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

log = logging.getLogger("ingest")

UNDER_WAY = 500
"""Messages that the broker sends before the first of them is acknowledged: as many as are held in memory."""
SESSION_S = 7 * 86_400
"""How long the broker keeps messages for this ingester while it is away."""
GATHER_S = 0.2
RETRY_S = 1.0
# Messages end with the codes of daqsvc: docs/reference/errors.md, or `daqsvc explain O24`.
MOST_KEY_BYTES = 2000
"""Of what makes up a key: an entry of an index of PostgreSQL has room for 2704."""
LONGEST_REASON = 2000
TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d{1,9})?(Z|[+-]\d\d:\d\d)", re.ASCII)
"""Times as daqsvc writes them. PostgreSQL takes others too: infinity, or tomorrow, whenever that is."""
EXIT_USAGE = 2
AWAY = {"08", "25", "28", "3D", "3F", "40", "53", "55", "57", "58"}
"""Classes of SQLSTATE that are about the server, not about a message: connection, read-only standby, login,
missing database or schema, serialization, resources, object in use, shutdown, system."""
NOT_SET_UP = {"42501", "42P01", "42703"}
"""A right, a table or a column that is not there: schema.sql has not been run, or not with this version."""

ALARM = """INSERT INTO daqsvc.alarm_events
    (id, site, box, machine, alarm, sequence, occurrence, at, kind, state, level, message, event)
    VALUES (%s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s) ON CONFLICT DO NOTHING"""
DIAGNOSIS = """INSERT INTO daqsvc.diagnoses
    (at, site, box, machine, detector, monotonic_ns, decision, severity, quality, statistics, diagnosis)
    VALUES (%s, %s, %s, %s, %s, %s, %s, %s, %s, %s, %s) ON CONFLICT DO NOTHING"""
REJECTED = """INSERT INTO daqsvc.rejected (topic, payload, reason) VALUES (%s, %s, %s)
    ON CONFLICT DO NOTHING"""


class Arrived(NamedTuple):
    """A message, and the connection that it came over."""

    connection: int
    message: paho.MQTTMessage


def row_of(payload: bytes | bytearray) -> tuple[str, tuple[Any, ...]]:
    """The statement and the values of a message.

    Raises:
        KeyError, TypeError, ValueError, RecursionError: it is none that is known here, or holds what
            PostgreSQL cannot.
    """
    text = payload.decode()
    document = json.loads(text)
    if document["schema"] == "daqsvc.alarm/1":
        names = ("kind", "state", "level", "message")
        machine, alarm = _texts(document, "site", "box", "machine"), _text(document, "alarm")
        event = _text(document, "id")
        _check_key(event)
        _check_key(*machine, alarm)
        occurrence = None if document["occurrence"] is None else _text(document, "occurrence")
        place = (event, *machine, alarm, _whole(document, "sequence"), occurrence)
        return ALARM, (*place, _time(document), *_texts(document, *names), text)
    if document["schema"] == "daqsvc.diagnosis/1":
        machine, detector = _texts(document, "site", "box", "machine"), _text(document, "detector")
        _check_key(*machine, detector)
        place = (_time(document), *machine, detector, _whole(document, "monotonic_ns"))
        judgement = _texts(document, "decision", "severity", "quality")
        return DIAGNOSIS, (*place, *judgement, json.dumps(document["statistics"]), text)
    raise ValueError(f"schema {document['schema']!r:.60} is not known here")


def _text(document: Any, name: str) -> str:
    """A text of a message.

    Raises:
        KeyError, TypeError: it is not there, or no text.
        ValueError: PostgreSQL has no such characters.
    """
    value = document[name]
    if not isinstance(value, str):
        raise TypeError(f"{name} is no text")
    value.encode()  # half of a surrogate pair is not Unicode
    if "\0" in value:
        raise ValueError(f"{name} holds a NUL")
    return value


def _texts(document: Any, *names: str) -> tuple[str, ...]:
    return tuple(_text(document, name) for name in names)


def _time(document: Any) -> str:
    """When it was.

    Raises:
        KeyError, TypeError, ValueError: it does not state it as daqsvc does.
    """
    text = _text(document, "time")
    if not TIME.fullmatch(text):
        raise ValueError(f"time is none of ISO 8601: {text!r:.60}")
    return text


def _whole(document: Any, name: str) -> int:
    """A whole number that a bigint holds.

    Raises:
        KeyError, TypeError, ValueError: it is none.
    """
    value = document[name]
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError(f"{name} is no whole number")
    if not -(2**63) <= value < 2**63:
        raise ValueError(f"{name} is too large")
    return value


def _check_key(*parts: str) -> None:
    """See that an index has room for a key.

    Raises:
        ValueError: it has not.
    """
    if sum(len(part.encode()) for part in parts) > MOST_KEY_BYTES:
        raise ValueError(f"what names it is longer than {MOST_KEY_BYTES} bytes: {parts[-1]!r:.60}")


def is_of_message(error: psycopg.Error) -> bool:
    """Whether a message is to blame; else PostgreSQL is away, and the message comes in when it is back.

    What the server, or psycopg before it is sent, reports about a value is about the message. This holds for
    any class of errors: ProgramLimitExceeded is an OperationalError as a lost connection is.
    """
    if error.sqlstate is None:
        return not isinstance(error, psycopg.OperationalError | psycopg.InterfaceError)
    return error.sqlstate[:2] not in AWAY and error.sqlstate not in NOT_SET_UP


def _reason(error: Exception) -> str:
    """Why a message is rejected, in characters that PostgreSQL has."""
    text = f"{type(error).__name__}: {error}".replace("\0", "\\0")
    return text.encode(errors="backslashreplace").decode()[:LONGEST_REASON]


class Ingester:
    """Takes messages from a broker, and acknowledges each when PostgreSQL has it on disk.

    Args:
        options: of the command line.
        database: how PostgreSQL is reached.
        password: of the user at the broker, if there is one.

    Raises:
        OSError: there is no such file of certificates.
        ValueError: there are none in it.
    """

    def __init__(self, options: argparse.Namespace, database: str, password: str = "") -> None:
        self._options, self._database = options, database
        self._why_away: set[str] = set()
        """Nothing while the broker is there, or has not been tried."""
        self._is_ending = False
        self._arrived: queue.Queue[Arrived] = queue.Queue()
        self._connection = 0
        self._topics: tuple[str, ...] = ()
        self._database_link: psycopg.Connection[Any] | None = None
        self._lock = threading.Lock()
        self._client = paho.Client(
            CallbackAPIVersion.VERSION2,
            client_id=f"daqsvc-{options.id}",
            protocol=paho.MQTTv5,
            manual_ack=True,
        )
        if options.user:
            self._client.username_pw_set(options.user, password)
        if options.ca:
            self._client.tls_set(options.ca)
        self._client.reconnect_delay_set(1, 30)
        self._client.on_connect = self._on_connect
        self._client.on_connect_fail = lambda *_: self._is_away(_in_words(sys.exc_info()[1]))
        self._client.on_subscribe = self._on_subscribe
        self._client.on_pre_connect = lambda _client, _data: self._another_connection()
        self._client.on_disconnect = self._on_disconnect
        self._client.on_message = self._on_message

    def run(self, should_stop: Callable[[], bool]) -> None:
        """Go on until stopped; what is not committed by then comes again."""
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
            self._is_ending = True
            self._client.disconnect()
            self._client.loop_stop()

    def _on_connect(
        self, client: paho.Client, _data: Any, _flags: Any, reason: Any, _properties: Any
    ) -> None:
        if reason.is_failure:
            why = f"it refuses the connection ({reason}): see to --user, $MQTT_PASSWORD and --id"
            self._is_away(why, "O11", is_news=True)
            return
        log.info("connected to the broker %s", self._broker)
        self._why_away.clear()
        # Alarm events are few: each of them writes every one, and the table keeps one. Telemetry is shared.
        every = f"{self._options.root}/+/+/+"
        shared = f"$share/{self._options.group}/{every}"
        options = SubscribeOptions(1)
        self._topics = f"{every}/alarms/#", f"{shared}/diagnosis/#"
        client.subscribe([(topic, options) for topic in self._topics])

    def _on_subscribe(
        self, _client: paho.Client, _data: Any, _mid: int, reasons: Sequence[Any], _properties: Any
    ) -> None:
        for topic, reason in zip(self._topics, reasons, strict=False):
            if reason.is_failure:
                log.error(
                    "the broker %s refuses to send %s (%s), and nothing of it is written: let this user read "
                    "it there, and start the ingester again [O12]",
                    *(self._broker, topic, reason),
                )

    def _on_disconnect(
        self, _client: paho.Client, _data: Any, _flags: Any, reason: Any, _properties: Any
    ) -> None:
        self._another_connection()
        if not self._is_ending:
            self._is_away(f"the connection has ended ({reason})")

    @property
    def _broker(self) -> str:
        return f"{self._options.broker}:{self._options.port}"

    def _is_away(self, why: str, code: str = "O09", *, is_news: bool = False) -> None:
        """Log it once, however often it is tried; and once more if the reason is news."""
        if not self._why_away or (is_news and why not in self._why_away):
            log.warning("the broker %s is away, and is tried again: %s [%s]", self._broker, why, code)
        self._why_away.add(why)

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
            except psycopg.Error as error:
                # Of a message it is not: such are taken one by one and rejected.
                log.warning("PostgreSQL is away, and nothing is acknowledged: %s [O24]", f"{error}".strip())
                self._disconnect()
                time.sleep(RETRY_S)
            else:
                return

    def _connected(self) -> psycopg.Connection[Any]:
        if self._database_link is None or self._database_link.closed:
            self._database_link = psycopg.connect(self._database, connect_timeout=10, autocommit=True)
        return self._database_link

    def _disconnect(self) -> None:
        if self._database_link is not None:
            self._database_link.close()
            self._database_link = None

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
        except psycopg.Error as error:
            if not is_of_message(error):
                raise
            for one in batch:
                self._insert_one(connection, one.message)

    def _insert_one(self, connection: psycopg.Connection[Any], message: paho.MQTTMessage) -> None:
        statement, values = self._row(message)
        try:
            with connection.transaction():
                connection.execute(statement, values)
        except psycopg.Error as error:
            if not is_of_message(error):
                raise
            with connection.transaction():
                connection.execute(REJECTED, (message.topic, message.payload, _reason(error)))

    def _row(self, message: paho.MQTTMessage) -> tuple[str, tuple[Any, ...]]:
        try:
            return row_of(message.payload)
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            return REJECTED, (message.topic, message.payload, _reason(error))

    def _acknowledge(self, batch: list[Arrived]) -> None:
        """Over the connection that a message came by: over the next its number may be another message's."""
        for one in batch:
            with self._lock:
                if one.connection == self._connection:
                    self._client.ack(one.message.mid, one.message.qos)


def _in_words(error: BaseException | None) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return f"{error or 'it gives no reason'}"


def _topic_part(text: str) -> str:
    """A part of a topic that is subscribed to."""
    if not text or set(text) & set("+#\0") or text.startswith("/") or text.endswith("/"):
        raise argparse.ArgumentTypeError(f"{text!r} is no part of a topic; write it without + and #")
    return text


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit() and 0 < int(text) < 65536):
        raise argparse.ArgumentTypeError(f"{text!r} is no port; write 1 to 65535")
    return int(text)


def _name(text: str) -> str:
    if not text or "\0" in text:
        raise argparse.ArgumentTypeError(f"{text!r} is no name; write one")
    return text


def _misused(words: str, code: str = "C01") -> NoReturn:
    print(f"ingest.py: {words} [{code}]", file=sys.stderr)  # noqa: T201 - errors of the command line go to stderr
    raise SystemExit(EXIT_USAGE)


class _Parser(argparse.ArgumentParser):
    """One sentence for each mistake, without the usage in front of it."""

    def error(self, message: str) -> NoReturn:
        _misused(f"{message}; see --help")


def _options() -> argparse.Namespace:
    parser = _Parser(description=__doc__.splitlines()[0])
    parser.add_argument("--broker", type=_name, default="127.0.0.1")
    parser.add_argument("--port", type=_port, default=1883)
    parser.add_argument(
        "--id", type=_name, required=True, help="of this ingester, another for each; keep it over restarts"
    )
    parser.add_argument(
        "--group", type=_topic_part, default="postgresql", help="ingesters of one group share the messages"
    )
    parser.add_argument("--root", type=_topic_part, default="daqsvc", help="topic_root of the machine files")
    parser.add_argument("--user", help="at the broker; the password is in $MQTT_PASSWORD")
    parser.add_argument("--ca", help="certificates that the broker's is signed by; it then speaks TLS")
    return parser.parse_args()


def _database() -> str:
    """How PostgreSQL is reached."""
    if not (database := os.environ.get("DATABASE", "")):
        _misused("$DATABASE is not set; write where PostgreSQL is, as DATABASE=postgresql://user@host/plant")
    try:
        psycopg.conninfo.conninfo_to_dict(database)
    except psycopg.Error as error:
        reason = " ".join(f"{error}".split())
        _misused(
            f"$DATABASE does not state where PostgreSQL is ({reason}); write postgresql://user@host/plant",
            "C02",
        )
    return database


def _ingester() -> Ingester:
    """As the command line and the environment have it."""
    options, database = _options(), _database()
    password = os.environ.get("MQTT_PASSWORD")
    if options.user and password is None:
        _misused("--user needs the password of that user in $MQTT_PASSWORD; set it, or leave --user out")
    try:
        return Ingester(options, database, password or "")
    except (OSError, ValueError) as error:
        # A file without certificates is an SSLError, which is an OSError.
        reason = "it holds no certificates" if isinstance(error, ssl.SSLError) else _in_words(error)
        _misused(
            f"--ca {options.ca} cannot be used: {reason}; name the PEM file of the broker's certificates",
            "C10",
        )


def main() -> None:
    """Run until SIGTERM or SIGINT."""
    ingester = _ingester()
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(message)s")
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    ingester.run(stop.is_set)


if __name__ == "__main__":
    main()
