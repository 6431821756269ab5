"""The publisher: keeps a connection to one broker, through outages, rotations and rivals."""

from __future__ import annotations

import asyncio
import logging
import ssl
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Literal

from daqsvc.acquisition.clock import NS_PER_S
from daqsvc.acquisition.link import Backoff
from daqsvc.alarms.events import Identity
from daqsvc.errors.code import coded
from daqsvc.errors.outputs import (
    BROKER_AWAY,
    CERTIFICATE_UNKNOWN,
    CLIENT_ID_TAKEN,
    CREDENTIAL_OPEN,
    TOPIC_REFUSED,
)
from daqsvc.notice import notice
from daqsvc.outbox.messages import OutboxError
from daqsvc.publish.mqtt.commands import CommandIntake
from daqsvc.publish.mqtt.conditions import NS_PER_DAY, BrokerCheck, BrokerVitals
from daqsvc.publish.mqtt.connection import PUBACK_S, Connection, Will
from daqsvc.publish.mqtt.credentials import CertificateError, certificate, issuer_of, read_credentials
from daqsvc.publish.mqtt.delivery import IN_FLIGHT
from daqsvc.publish.mqtt.errors import (
    Faults,
    MqttError,
    Outage,
    PublishRefusedError,
    SilentBrokerError,
    TakenOverError,
    has_expired,
    in_words,
    kind_of,
    unless,
)
from daqsvc.publish.mqtt.session import CredentialsReplacedError, PublishCounters, Session
from daqsvc.publish.mqtt.spoken import Spoken
from daqsvc.publish.mqtt.suspects import FIRST_BAR_S, Suspects
from daqsvc.publish.output import Output
from daqsvc.publish.payloads import availability_payload, diagnosis_payload, status_payload

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from daqsvc.alarms.conditions import Condition
    from daqsvc.diagnosis.record import Diagnosis
    from daqsvc.publish.mqtt.credentials import Credentials
    from daqsvc.publish.mqtt.link import MqttLink
    from daqsvc.publish.mqtt.settings import Mqtt
    from daqsvc.publish.output import OutputPort

log = logging.getLogger(__name__)

STABLE_S = 10.0
"""A connection that was of use for this long has earned a quick first retry."""

FIRST_RETRY_NS = 800_000_000
"""Ceiling of the first wait after a loss."""

SUSPICIOUS_LOSSES = 3
"""Connections in a row that broke soon after they were made, from which on a rival is likely."""

TAKEN_OVER_S = 60.0
"""Least wait after another client has come with the same client id: two that alternate are of no use."""

GOODBYE_S = 0.3
"""What saying goodbye may take of the time to stop."""

SOON_DAYS = 15
"""A day before anybody is alarmed by a certificate that ends, the broker is asked for the one it has now."""


class MqttPublisher(Output):
    """Publishes the outbox to one broker, through its outages, and takes commands from there.

    `run` is the one task of it. Connecting, waiting and keep-alive go by real time, whatever clock the
    data has: the broker is real.

    Args:
        settings: how to reach the broker, with the client id and absolute paths; see `Mqtt.on`.
        port: what must reach the broker, and who carries out the commands that the settings allow.
        links: who else speaks over the connection.
    """

    def __init__(self, settings: Mqtt, port: OutputPort, links: Sequence[MqttLink] = ()) -> None:
        self.counters = PublishCounters()
        self.topics = port.topics
        self._settings = settings
        self._port = port
        self._outbox = port.outbox
        self._clock = port.clock
        names = [*port.machines]
        # Of several the last one represents the service alone.
        self._machines = names[:-1] if len(names) > 1 else names
        self._links = links
        self._check = BrokerCheck()
        self._intake: CommandIntake | None = None
        if settings.commands.enabled and port.commands is not None:
            reserved = [prefix for link in links for prefix in link.reserved]
            self._intake = CommandIntake(
                settings.commands,
                port.machines,
                port.topics,
                port.commands,
                port.clock,
                port.outbox.command_ids,
                reserved,
                port.snapshots,
            )
        self._expiry: dict[str, int] = {}
        """When certificates end, wall clock in ns since 1970, as far as they were seen: ``client`` is the
        box's own, ``broker`` what that has shown, ``ca`` the authority of `ca_file` that signs it."""
        self._backoff = Backoff(FIRST_RETRY_NS)
        self._quick_losses = 0
        self._outage = Outage(log)
        self._has_expired = False
        """Whether the broker was last refused because what it shows has expired, rather than verified."""
        self._spoken = Spoken(
            port.outbox.directory, settings.host, settings.port, settings.protocol, port.clock.wall_ns
        )
        self._suspects = Suspects()
        self._faults = Faults()
        self._not_available = ""
        self._not_loaded = ""
        self._has_ever_lasted = False
        self._exposed: set[Path] = set()
        self._stopping = asyncio.Event()
        self._stop_at_s = 0.0
        self._running: asyncio.Future[None] | None = None

    def figures(self) -> dict[str, Any]:
        """What the publisher has done, in numbers, for the status; without TLS or commands none of these."""
        figures: dict[str, Any] = {
            name: int(value) if isinstance(value, bool) else value
            for name, value in asdict(self.counters).items()
        }
        figures["faults"] = self._faults.count
        figures["dead_letters"] = self._outbox.dead_letters.waiting
        figures["dead_letters_dropped"] = self._outbox.dead_letters.dropped
        if self._intake is not None:
            figures["commands"] = asdict(self._intake.counters)
        if self._expiry:
            now_ns = self._clock.wall_ns()
            figures["certificates"] = {
                name: {
                    "not_after_seconds": not_after_ns // NS_PER_S,
                    "days_left": round((not_after_ns - now_ns) / NS_PER_DAY, 2),
                }
                for name, not_after_ns in self._expiry.items()
            }
        return figures

    def telemetry(self, topic: str, payload: bytes) -> None:
        """Publish by the outbox's lower class; never waits.

        Args:
            topic: below the box, e.g. ``"status"`` or ``"laval-rig/diagnosis/rotor-bank"``.
            payload: the bytes.

        Raises:
            OutboxError: the outbox is not open.
        """
        self._outbox.telemetry(
            f"{self.topics.base}/{topic}", payload, expiry_s=self._settings.telemetry_expiry_s
        )

    def report(self, diagnosis: Diagnosis) -> None:
        """Publish what a detector reports, and pass it on to those who look at figures now and then."""
        identity = Identity(self.topics.site, self.topics.box, diagnosis.machine)
        payload = diagnosis_payload(identity, diagnosis, self._clock).to_json()
        self.telemetry(f"{diagnosis.machine}/diagnosis/{diagnosis.detector}", payload)
        for link in self._links:
            link.report(diagnosis)

    def status(self, figures: Mapping[str, Any]) -> None:
        """Publish the figures of the service."""
        payload = status_payload(self.topics.site, self.topics.box, figures, self._clock, self._machines)
        self.telemetry("status", payload.to_json())

    def conditions(self, raised: frozenset[str]) -> Iterator[Condition]:
        """See `Output.conditions`."""
        return self._check.look(
            BrokerVitals(
                wall_ns=self._clock.wall_ns(),
                certificates_end_ns=self._expiry,
                has_expired=self._has_expired,
                connected=self.counters.connected,
                refused=self.refused,
                is_refused_known=self.is_refused_known,
                reported=raised,
            )
        )

    @property
    def refused(self) -> Mapping[str, str]:
        """By topic, why the broker will not take messages that must not be lost, or any at all."""
        reasons = dict(self._outbox.dead_letters.reasons)
        if self._not_available:
            reasons[self.topics.availability] = self._not_available
        return self._suspects.barred(time.monotonic()) | reasons

    @property
    def is_refused_known(self) -> bool:
        """Whether `refused` is all there is: what an earlier run has left was read, and the broker was asked.

        A message for which a broker ends the connection, or the box's availability, shows itself only when it
        is sent: so a connection must have lasted.
        """
        return self._has_ever_lasted and self._outbox.dead_letters.is_known

    async def run(self) -> None:
        """Publish until `stop`: connect, serve, and connect again after each loss.

        Nothing leaves it but its cancellation: watching the machine does not depend on telling of it.
        """
        self._running = asyncio.get_running_loop().create_future()
        try:
            while not self._stopping.is_set():
                try:
                    await self._once()
                except Exception as error:  # noqa: BLE001  any, for watching the machine must go on
                    self._away(error)
                    self._faults.note(
                        "publishing was interrupted and begins again with a new connection", error
                    )
                    await self._wait(self._backoff.next_ns() / NS_PER_S)
        finally:
            self._running.set_result(None)

    async def _once(self) -> None:
        """Connect and serve, once."""
        made = await unless(self._stopping, self._connect())
        if made is None:
            await self._wait(self._backoff.next_ns() / NS_PER_S)
            return
        connection, credentials = made
        try:
            await self._serve(connection, credentials)
        finally:
            self.counters.connected = False
            connection.abandon()

    async def stop(self, deadline_s: float = 1.0) -> None:
        """Hand over what is left, report that the box goes offline, and end `run`.

        Without a connection this takes no time; otherwise at most ``deadline_s``. What the broker has
        not acknowledged by then stays in the outbox.
        """
        self._stop_at_s = asyncio.get_running_loop().time() + deadline_s
        self._stopping.set()
        if self._running is not None:
            await asyncio.wait({self._running})

    async def _connect(self) -> tuple[Connection, Credentials] | None:
        """A connection at which the box is known as online; None after a failure."""
        connection: Connection | None = None
        try:
            await self._prepare()
            credentials = await asyncio.to_thread(read_credentials, self._settings)
            if credentials.own is not None:
                self._expiry["client"] = credentials.own.not_after_ns
            self._warn_of(credentials.exposed)
            connection = self._connection(credentials)
            await connection.open(self._spoken.consent_s)
            self._see(connection, credentials)
            await asyncio.to_thread(self._spoken.agreed)
            await self._say_online(connection)
            self._connected()
        except (MqttError, OSError) as error:
            self._away(error)
            if isinstance(error, ssl.SSLCertVerificationError):
                self._has_expired = has_expired(error)
            if connection is not None and connection.unacknowledged:
                self._outage.tell_lost(f"MQTT broker {self._name}", error)
                self._suspect(connection)
            elif not self._spoken.falls_back(error):
                self._suspects.away()
                self._report_outage(error)
            return None
        finally:
            if connection is not None and not self.counters.connected:
                connection.abandon()
        return connection, credentials

    def _connected(self) -> None:
        self._has_expired = False
        self.counters.connections += 1
        self.counters.connected = True
        self.reason = ""
        if self._quick_losses >= SUSPICIOUS_LOSSES or self._suspects.careful:
            log.info(
                "connected to MQTT broker %s once more", self._name
            )  # it has been logged that this goes on
        elif self._outage.is_reported:
            self._outage.end()
            notice(log, "MQTT broker %s is back", self._name)
        else:
            log.info("connected to MQTT broker %s", self._name)

    def _away(self, error: Exception) -> None:
        """Note why there is no connection."""
        self.counters.connected = False
        self.reason, self.code = f"{self._name}: {in_words(error)}", kind_of(error)

    def _warn_of(self, exposed: tuple[Path, ...]) -> None:
        for path in sorted(set(exposed) - self._exposed):
            log.warning(
                "%s can be read by every user of this machine: chmod o-rwx it, and replace it",
                path,
                extra=coded(CREDENTIAL_OPEN),
            )
        self._exposed = set(exposed)

    async def _prepare(self) -> None:
        """Look what earlier runs have left."""
        await asyncio.to_thread(self._spoken.recall)
        try:
            await self._outbox.dead_letters.load()
        except OutboxError as error:
            # Of the store, not of the broker: it makes no outage.
            if f"{error}" != self._not_loaded:
                log.warning(
                    "%s; what was refused before waits until it can", error, extra=coded(TOPIC_REFUSED)
                )
            self._not_loaded = f"{error}"
        else:
            self._not_loaded = ""

    async def _say_online(self, connection: Connection) -> None:
        try:
            await connection.deliver(
                self.topics.availability, self._availability("online", "connected"), retain=True
            )
        except PublishRefusedError as error:
            if not self._not_available:
                log.error(  # noqa: TRY400  the message is enough
                    "MQTT broker %s refuses the box's availability on %s: %s; everything else goes on",
                    self._name,
                    self.topics.availability,
                    error,
                    extra=coded(TOPIC_REFUSED),
                )
            self._not_available = str(error)
        else:
            self._not_available = ""

    def _connection(self, credentials: Credentials) -> Connection:
        settings = self._settings
        return Connection(
            settings.host,
            settings.port,
            in_flight=1 if self._suspects.careful else IN_FLIGHT,
            mqtt5=self._spoken.mqtt5,
            reason_against=lambda topic: self._suspects.reason(topic, time.monotonic()),
            on_taken=self._suspects.acknowledged,
            on_overlooked=self.counters.count_overlooked,
            on_ignored=self.counters.count_ignored,
            identifier=settings.client_id or "",
            username=settings.username,
            password=credentials.password,
            tls_context=credentials.context,
            keepalive=settings.keepalive_s,
            will=Will(
                self.topics.availability, self._availability("offline", "connection lost"), qos=1, retain=True
            ),
        )

    def _see(self, connection: Connection, credentials: Credentials) -> None:
        """Note how long the broker's certificate and that of its issuer last."""
        der = connection.shown_certificate
        if der is None:
            return
        try:
            shown = certificate(der)
        except CertificateError as error:
            log.warning(
                "no alarm will warn before the certificate of %s ends: %s",
                self._name,
                error,
                extra=coded(CERTIFICATE_UNKNOWN),
            )
            return
        self._expiry["broker"] = shown.not_after_ns
        authority = issuer_of(shown, credentials.trusted)
        if authority is not None:
            self._expiry["ca"] = authority.not_after_ns

    def _ends_soon(self) -> bool:
        """Whether what the broker has shown, or the authority behind it, ends soon."""
        limit_ns = self._clock.wall_ns() + SOON_DAYS * NS_PER_DAY
        return any(self._expiry.get(name, limit_ns) < limit_ns for name in ("broker", "ca"))

    async def _serve(self, connection: Connection, credentials: Credentials) -> None:
        """Publish over one connection until it is lost or the publisher stops."""
        session = Session(
            connection,
            credentials,
            settings=self._settings,
            topics=self.topics,
            outbox=self._outbox,
            clock=self._clock,
            counters=self.counters,
            faults=self._faults,
            intake=self._intake,
            links=self._links,
            ends_soon=self._ends_soon,
            stopping=self._stopping,
            earlier=self._port.earlier,
        )
        loop = asyncio.get_running_loop()
        since_s = loop.time()
        lasting = loop.call_later(STABLE_S, self._has_lasted, connection)
        try:
            await session.run(lambda: self._left_s() - GOODBYE_S)
        except CredentialsReplacedError:
            log.info("connecting to MQTT broker %s again, to use and see the certificates of now", self._name)
            await connection.close(GOODBYE_S)
        except TakenOverError as error:
            self._away(error)
            self._report_rival("this connection was ended by another client", error)
            await self._wait(TAKEN_OVER_S + self._backoff.next_ns() / NS_PER_S)
        except (MqttError, OSError) as error:
            self._away(error)
            of_use_s = loop.time() - since_s
            if isinstance(error, SilentBrokerError):
                # Connected but deaf: the time that it took to notice was no use to anybody.
                of_use_s -= PUBACK_S
            if connection.unacknowledged and not isinstance(error, SilentBrokerError):
                self._calm_down(of_use_s)
                self._outage.tell_lost(f"MQTT broker {self._name}", error)
                self._suspect(connection)
            else:
                self._judge(of_use_s, error)
            await self._wait(self._backoff.next_ns() / NS_PER_S)
        else:
            await self._say_goodbye(connection)
        finally:
            lasting.cancel()

    def _has_lasted(self, connection: Connection) -> None:
        """A connection has been of use for a while."""
        self._suspects.settled()
        self._has_ever_lasted = True
        if self._outage.is_reported:  # `_connected` did not believe that it would last
            self._outage.end()
            notice(log, "MQTT broker %s is back", self._name)
        connection.widen(IN_FLIGHT)

    def _suspect(self, connection: Connection) -> None:
        """A connection has ended with messages under way: perhaps because of one of them."""
        topic = self._suspects.lost(connection.unacknowledged, time.monotonic())
        if topic is None:
            return
        self._backoff.reset()  # there may be more of them, each of which is to be found
        log.error(
            "MQTT broker %s ends the connection whenever a message on %s is sent: it is not allowed to this "
            "client, or too large; it is left alone for %g min or more, and all others go on",
            self._name,
            topic,
            FIRST_BAR_S / 60,
            extra=coded(TOPIC_REFUSED),
        )

    def _judge(self, of_use_s: float, error: Exception) -> None:
        """Report a loss, and how soon to come back after it."""
        self._calm_down(of_use_s)
        refused = isinstance(error, PublishRefusedError | SilentBrokerError)
        self._quick_losses = self._quick_losses + 1 if of_use_s < STABLE_S and not refused else 0
        if of_use_s > STABLE_S:
            self._outage.end()
        if self._quick_losses == SUSPICIOUS_LOSSES:
            how = f"{SUSPICIOUS_LOSSES} connections have broken at once, perhaps because of another client"
            self._report_rival(how, error)
        if self._quick_losses >= SUSPICIOUS_LOSSES:
            self.reason = (
                f"{self.reason}; perhaps another client has client_id {self._settings.client_id!r}, too"
            )
            self.code = CLIENT_ID_TAKEN
        self._report_outage(error)

    def _calm_down(self, of_use_s: float) -> None:
        """Be quick again after a connection that has lasted longer than the waits by now, and only then.

        Otherwise two clients with one id, who end each other's connections, would never calm down.
        """
        if of_use_s > max(STABLE_S, 2 * self._backoff.ceiling_ns / NS_PER_S):
            self._backoff.reset()

    async def _say_goodbye(self, connection: Connection) -> None:
        """Publish that the box goes offline; if that fails, the last will states it."""
        offline = self._availability("offline", "stopped")
        try:
            async with asyncio.timeout(max(self._left_s(), GOODBYE_S / 2)):
                await connection.deliver(self.topics.availability, offline, retain=True)
        except TimeoutError:
            log.warning(
                "MQTT broker %s did not answer to the goodbye; the last will reports",
                self._name,
                extra=coded(BROKER_AWAY),
            )
        except MqttError as error:
            log.warning(
                "MQTT broker %s did not accept the goodbye: %s; the last will reports",
                self._name,
                error,
                extra=coded(BROKER_AWAY),
            )
        else:
            await connection.close(max(self._left_s(), GOODBYE_S / 2))

    async def _wait(self, wait_s: float) -> None:
        await unless(self._stopping, asyncio.sleep(wait_s))

    def _left_s(self) -> float:
        return max(self._stop_at_s - asyncio.get_running_loop().time(), 0.0)

    def _availability(self, state: Literal["online", "offline"], reason: str) -> bytes:
        return availability_payload(self.topics.site, self.topics.box, state, reason, self._clock).to_json()

    @property
    def _name(self) -> str:
        return f"{self._settings.host}:{self._settings.port}"

    def _report_outage(self, error: Exception) -> None:
        self._outage.tell(f"MQTT broker {self._name}", error, "trying again until it is back")

    def _report_rival(self, how: str, error: Exception) -> None:
        self._outage.note(f"MQTT broker {self._name}", in_words(error))
        log.error(
            "MQTT broker %s: %s with client_id %r; give each box its own box name or mqtt.client_id, and "
            "watch several machines of one box with one service: daqsvc run a.toml b.toml",
            self._name,
            how,
            self._settings.client_id,
            extra=coded(CLIENT_ID_TAKEN),
        )
