"""Why a broker is away, in words, and each reason once."""

from __future__ import annotations

import errno
import logging
import socket
import ssl

import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from daqsvc.publish.mqtt.errors import MOST_REASONS, MqttCodeError, MqttError, Outage, has_expired, in_words


def unverified(code, message):
    error = ssl.SSLCertVerificationError(1, "certificate verify failed")
    error.verify_code, error.verify_message = code, message
    return error


def coded(number):
    return MqttCodeError(ReasonCode(PacketTypes.CONNACK, identifier=number))


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (unverified(10, "certificate has expired"), "has expired; renew it there"),
        (unverified(9, "certificate is not yet valid"), "not valid yet; look at the clock of the box"),
        (unverified(62, "Hostname mismatch."), "for another host: Hostname mismatch"),
        (
            unverified(20, "unable to get local issuer certificate"),
            "its certificate is not signed by an authority in ca_file",
        ),
        (unverified(23, "certificate revoked"), "its certificate is refused: certificate revoked"),
        (ssl.SSLError(1, "wrong"), "TLS failed: "),
        (ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused"), "nothing listens there"),
        (socket.gaierror(-2, "Name or service not known"), "its name is not known: Name or service"),
        (TimeoutError("timed out"), "it does not answer"),
        (OSError(errno.ENETUNREACH, "Network is unreachable"), "Network is unreachable"),
        (
            FileNotFoundError(errno.ENOENT, "No such file or directory", "/etc/daqsvc/mqtt-password"),
            "/etc/daqsvc/mqtt-password is missing; put it there, or correct its path in the machine file",
        ),
        (PermissionError(errno.EACCES, "Permission denied", "/etc/key"), "/etc/key: Permission denied"),
        (coded(135), "this client is not authorised"),
        (coded(134), "it refuses the user name or the password"),
        (coded(128), "the broker gave no reason"),
        (coded(136), "Server unavailable"),
        (MqttCodeError(4, "could not publish"), "The client is not currently connected"),
        (MqttError("no PUBACK within 10 s"), "no PUBACK within 10 s"),
        (None, "closed"),
    ],
)
def test_every_failure_is_said_in_words(error, words):
    told = in_words(error)
    assert words in told
    assert not {"[", "]"} & set(told), "no codes to people"


def test_only_an_expired_certificate_has_expired():
    assert has_expired(unverified(10, "certificate has expired"))
    assert not has_expired(unverified(62, "Hostname mismatch"))
    assert not has_expired(ConnectionRefusedError())


@pytest.mark.gives("O09")
def test_each_reason_is_said_once_in_an_outage_and_anew_in_the_next(caplog):
    outage = Outage(logging.getLogger("outage"))
    lost, refused = MqttError("connection lost: closed"), ConnectionRefusedError()
    for error in (lost, refused, lost, refused):
        outage.tell("MQTT broker a:1", error, "trying again")
    outage.end()
    outage.tell("MQTT broker a:1", refused, "trying again")
    assert [r.getMessage() for r in caplog.records] == [
        "MQTT broker a:1 is away: connection lost: closed; trying again",
        "MQTT broker a:1 is still away: nothing listens there; trying again",
        "MQTT broker a:1 is away: nothing listens there; trying again",
    ]


def test_of_a_broker_that_nobody_called_away_it_is_not_said_that_it_still_is(caplog):
    outage = Outage(logging.getLogger("outage"))
    for broker in ("a:1", "b:1", "a:1"):
        outage.tell(f"Sparkplug broker {broker}", MqttError(f"closed by {broker}"), "trying again")
    outage.tell("Sparkplug broker a:1", ConnectionRefusedError(), "trying again")
    assert [" still " in record.getMessage() for record in caplog.records] == [False, False, True]


def test_a_reason_that_is_another_every_time_does_not_fill_the_log(caplog):
    outage = Outage(logging.getLogger("outage"))
    for number in range(100):
        outage.tell("MQTT broker a:1", OSError(f"{number} bytes"), "trying again")
    assert len(caplog.records) == MOST_REASONS
