"""TLS verifies by default and takes rotated certificates; passwords stay out of every log."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess

import pytest
from support.brokers import Consumer, TcpProxy, listens, running_mosquitto
from support.mqtt_publishing import mqtt, output_port, running_output
from support.ports import free_port
from support.tls_files import authority, self_signed, signed
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.publish.mqtt.credentials import CertificateError, read_credentials
from daqsvc.publish.mqtt.publisher import MqttPublisher
from daqsvc.publish.payloads import status_payload

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto]
CLOCK = SystemClock()
SECRET = "correct horse battery staple"  # noqa: S105  nobody's


def publishing(outbox, settings):
    return running_output(MqttPublisher(settings, output_port(outbox)))


def tls_config(pair, clients=None):
    """What Mosquitto shows; with ``clients`` it wants certificates of that authority from them."""
    wanted = (
        f"cafile {clients.cert}\nrequire_certificate true\nuse_identity_as_username true\n" if clients else ""
    )
    return f"{wanted}certfile {pair.cert}\nkeyfile {pair.key}"


def tls_settings(port, ca_file, own=None):
    return mqtt(
        port,
        "daqsvc-tls",
        tls=True,
        ca_file=ca_file,
        cert_file=own.cert if own else None,
        key_file=own.key if own else None,
    )


async def test_a_broker_with_a_trusted_certificate_is_served(tmp_path, outbox):
    broker = self_signed(tmp_path, "broker", "127.0.0.1")
    with running_mosquitto(tmp_path, config=tls_config(broker)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, broker.cert)) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected over TLS")
            sequence = await outbox.append("daqsvc/lab/edge-1/rig/alarms/a", lambda n: b"{}", retain=True)
            await eventually(lambda: outbox.counters.sent == 1, f"{sequence} is acknowledged")


@pytest.mark.parametrize(
    ("host", "trusted", "reason"),
    [
        ("another.example", True, "its certificate is for another host: IP address mismatch"),
        ("127.0.0.1", False, "its certificate is not signed by an authority in ca_file: self"),
    ],
)
async def test_a_broker_that_cannot_prove_itself_is_refused(tmp_path, outbox, caplog, host, trusted, reason):
    broker = self_signed(tmp_path, "broker", host)
    stranger = self_signed(tmp_path, "stranger", "127.0.0.1")
    with running_mosquitto(tmp_path, config=tls_config(broker)) as mosquitto:
        settings = tls_settings(mosquitto.port, (broker if trusted else stranger).cert)
        async with publishing(outbox, settings) as publisher:
            await eventually(lambda: "is away" in caplog.text, "it is refused")
            assert reason in caplog.text
            assert publisher.counters.connections == 0


@pytest.mark.long
async def test_the_reason_why_a_broker_does_not_come_back_is_told_when_it_changes(tmp_path, outbox, caplog):
    """It goes, comes back with the certificate of another host, then with one that has expired."""
    ca = authority(tmp_path, "ca")
    good = signed(tmp_path, "broker", ca, host="127.0.0.1")
    other = signed(tmp_path, "other", ca, host="another.example")
    expired = signed(tmp_path, "expired", ca, host="127.0.0.1", days=-1)
    again = signed(tmp_path, "again", ca, host="127.0.0.1")
    with running_mosquitto(tmp_path, config=tls_config(good)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, ca.cert)) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected")
            for pair, words in (
                (other, "is still away: its certificate is for another host"),
                (expired, "is still away: its certificate, or that of its authority, has expired"),
            ):
                mosquitto.stop()
                pair.replaces(good)
                mosquitto.start()
                await eventually(lambda words=words: words in caplog.text, "the new reason is told")
                assert publisher._has_expired is (pair is expired)
            mosquitto.stop()
            again.replaces(good)
            mosquitto.start()
            await eventually(lambda: publisher.counters.connections == 2, "connected again")
            assert not publisher._has_expired
    said = [r.getMessage() for r in caplog.records if "away" in r.getMessage()]
    assert len(said) == len(set(said)), "each reason is told once"
    assert "[code" not in caplog.text


async def test_a_rotated_certificate_takes_effect_at_the_next_connection(tmp_path, outbox):
    old, new = (self_signed(tmp_path, name, "127.0.0.1") for name in ("old", "new"))
    trusted = tmp_path / "trusted.crt"
    trusted.write_bytes(old.cert.read_bytes())
    with running_mosquitto(tmp_path, config=tls_config(old)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, trusted)) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected with the old certificate")
            mosquitto.stop()
            new.replaces(old)
            trusted.write_bytes(new.cert.read_bytes())
            mosquitto.start()
            await eventually(lambda: publisher.counters.connections == 2, "connected with the new one")


async def test_a_broker_that_wants_certificates_gets_the_one_of_the_box(tmp_path, outbox, caplog):
    ca = authority(tmp_path, "ca")
    broker, box = signed(tmp_path, "broker", ca, host="127.0.0.1"), signed(tmp_path, "box", ca)
    with running_mosquitto(tmp_path, config=tls_config(broker, ca)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, ca.cert)) as publisher:
            await eventually(lambda: "is away" in caplog.text, "nobody is served without a certificate")
            assert publisher.counters.connections == 0
        async with publishing(outbox, tls_settings(mosquitto.port, ca.cert, box)) as publisher:
            await eventually(lambda: publisher.counters.connected, "the box is served")
            assert "u'box'" in mosquitto.log_text


async def test_tls_rotation_of_both_sides_reaches_a_standing_connection(
    tmp_path, outbox, monkeypatch, caplog
):
    """The complaint: a renewed certificate takes effect only after a restart, if somebody thinks of it."""
    monkeypatch.setattr("daqsvc.publish.mqtt.session.LOOK_S", 0.05)
    old_ca, new_ca = authority(tmp_path, "old-ca"), authority(tmp_path, "new-ca", days=60)
    broker, box = signed(tmp_path, "broker", old_ca, host="127.0.0.1"), signed(tmp_path, "box", old_ca)
    new_broker = signed(tmp_path, "new-broker", new_ca, host="127.0.0.1", days=9)
    new_box = signed(tmp_path, "new-box", new_ca, days=9)
    with running_mosquitto(tmp_path, config=tls_config(broker, old_ca)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, old_ca.cert, box)) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected with the old certificates")
            before = dict(publisher._expiry)
            assert {name: ns / 1e9 for name, ns in before.items()} == {
                "client": box.not_after_s,
                "broker": broker.not_after_s,
                "ca": old_ca.not_after_s,
            }
            mosquitto.stop()
            for new, old in ((new_ca, old_ca), (new_broker, broker), (new_box, box)):
                new.replaces(old)
            mosquitto.start()
            await eventually(lambda: publisher.counters.connections == 2, "connected with the new ones")
            after = dict(publisher._expiry)
            assert all(after[name] > before[name] for name in ("client", "broker", "ca"))
            seconds = publisher.figures()["certificates"]["client"]["not_after_seconds"]
            assert seconds == new_box.not_after_s
            renewed = signed(tmp_path, "renewed", new_ca, days=20)
            renewed.replaces(box)
            await eventually(lambda: publisher.counters.connections == 3, "a renewal alone is enough")
            assert publisher._expiry["client"] / 1e9 == renewed.not_after_s
            assert mosquitto.log_text.count("u'renewed'") == 1
    assert "Traceback" not in caplog.text


async def test_a_renewal_is_no_outage_to_anybody(tmp_path, outbox, monkeypatch):
    monkeypatch.setattr("daqsvc.publish.mqtt.session.LOOK_S", 0.05)
    ca = authority(tmp_path, "ca")
    broker, box = signed(tmp_path, "broker", ca, host="127.0.0.1"), signed(tmp_path, "box", ca)
    renewed = signed(tmp_path, "renewed", ca)
    plain = free_port()
    config = f"{tls_config(broker, ca)}\nlistener {plain} 127.0.0.1\nallow_anonymous true"
    with running_mosquitto(tmp_path, config=config) as mosquitto:
        await eventually(lambda: listens(plain), "the second listener is there too")
        async with (
            Consumer(plain) as live,
            publishing(outbox, tls_settings(mosquitto.port, ca.cert, box)) as publisher,
        ):
            await eventually(lambda: live.on("/availability"), "the box is online")
            renewed.replaces(box)
            await eventually(lambda: publisher.counters.connections == 2, "connected anew")
            await eventually(lambda: len(live.on("/availability")) == 2, "it says so")
            assert [m.payload["state"] for m in live.on("/availability")] == ["online", "online"]


async def test_a_certificate_that_was_renewed_at_the_broker_is_seen_without_a_loss(
    tmp_path, outbox, monkeypatch
):
    """A broker that is told to reload keeps its connections: the old certificate would alarm for ever."""
    monkeypatch.setattr("daqsvc.publish.mqtt.session.LOOK_S", 0.05)
    monkeypatch.setattr("daqsvc.publish.mqtt.session.LOOK_AGAIN_S", 0.2)
    ca = authority(tmp_path, "ca")
    broker = signed(tmp_path, "broker", ca, host="127.0.0.1", days=5)
    renewed = signed(tmp_path, "renewed", ca, host="127.0.0.1", days=29)
    with running_mosquitto(tmp_path, config=tls_config(broker)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, ca.cert)) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected")
            assert publisher._expiry["broker"] / 1e9 == broker.not_after_s
            renewed.replaces(broker)
            mosquitto.reload()
            ends_s = renewed.not_after_s
            await eventually(lambda: publisher._expiry["broker"] / 1e9 == ends_s, "it is seen")
            await eventually(lambda: publisher.counters.connected, "connected again")
            connections = publisher.counters.connections
            await asyncio.sleep(0.5)
            assert publisher.counters.connections == connections, "what lasts is not looked at again"


async def test_a_half_written_renewal_does_not_cost_the_connection(tmp_path, outbox, monkeypatch, caplog):
    monkeypatch.setattr("daqsvc.publish.mqtt.session.LOOK_S", 0.02)
    ca = authority(tmp_path, "ca")
    broker, box = signed(tmp_path, "broker", ca, host="127.0.0.1"), signed(tmp_path, "box", ca)
    whole = box.cert.read_bytes()
    with running_mosquitto(tmp_path, config=tls_config(broker, ca)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, ca.cert, box)) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected")
            box.cert.write_bytes(whole[: len(whole) // 2])
            await eventually(lambda: "cannot be used together" in caplog.text, "it is looked at")
            assert str(box.cert) in caplog.text
            assert publisher.counters.connected
            await outbox.append("daqsvc/lab/edge-1/rig/alarms/a", lambda n: b"{}", retain=True)
            await eventually(lambda: outbox.counters.sent == 1, "alarms still pass")
            assert publisher.counters.connections == 1
            box.cert.write_bytes(whole)
            await eventually(lambda: publisher.counters.connections == 2, "the whole one is taken")


@pytest.mark.gives("O14")
async def test_a_certificate_that_only_openssl_can_read_is_used_all_the_same(
    tmp_path, outbox, monkeypatch, caplog
):
    def unreadable(_certificate):
        raise CertificateError("not an X.509 certificate: it is stranger than that")

    monkeypatch.setattr("daqsvc.publish.mqtt.credentials.certificates", unreadable)
    monkeypatch.setattr("daqsvc.publish.mqtt.publisher.certificate", unreadable)
    ca = authority(tmp_path, "ca")
    broker, box = signed(tmp_path, "broker", ca, host="127.0.0.1"), signed(tmp_path, "box", ca)
    with running_mosquitto(tmp_path, config=tls_config(broker, ca)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, ca.cert, box)) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected")
            assert dict(publisher._expiry) == {}
    assert f"before the certificates in {box.cert} end" in caplog.text


async def test_an_encrypted_key_is_refused_and_nobody_is_asked_at_the_terminal(tmp_path, outbox, caplog):
    ca = authority(tmp_path, "ca")
    broker, box = signed(tmp_path, "broker", ca, host="127.0.0.1"), signed(tmp_path, "box", ca)
    box.encrypt_key("sesame")
    with running_mosquitto(tmp_path, config=tls_config(broker, ca)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, ca.cert, box)):
            await eventually(lambda: "is encrypted" in caplog.text, "it is said")


def password_config(tmp_path):
    program = shutil.which("mosquitto_passwd")
    if program is None:
        pytest.skip("no mosquitto_passwd on this machine (apt-get install mosquitto)")
    file = tmp_path / "passwords"
    file.touch(mode=0o600)
    subprocess.run([program, "-b", str(file), "daq", SECRET], check=True, capture_output=True)
    return f"password_file {file}"


async def test_a_corrected_password_is_read_at_the_next_attempt_and_never_logged(tmp_path, outbox, caplog):
    caplog.set_level("DEBUG")
    mine = tmp_path / "mine"
    mine.write_text("wrong " + SECRET + "\n")
    with running_mosquitto(tmp_path, config=password_config(tmp_path), anonymous=False) as mosquitto:
        settings = mqtt(mosquitto.port, "c", username="daq", password_file=mine)
        async with publishing(outbox, settings) as publisher:
            await eventually(lambda: "is away" in caplog.text, "it is refused")
            assert "is away: this client is not authorised" in caplog.text
            mine.write_text(SECRET + "\n")
            await eventually(lambda: publisher.counters.connected, "the corrected password is taken")
    assert SECRET not in caplog.text
    assert SECRET not in repr(settings)


async def test_password_and_key_may_be_systemd_credentials(tmp_path, outbox, monkeypatch, caplog):
    ca = authority(tmp_path, "ca")
    broker, box = signed(tmp_path, "broker", ca, host="127.0.0.1"), signed(tmp_path, "box", ca)
    config = f"{tls_config(broker)}\n{password_config(tmp_path)}"
    with running_mosquitto(tmp_path, config=config, anonymous=False) as mosquitto:
        credentials = {"password_credential": "mqtt-password", "key_credential": "mqtt-key"}
        settings = tls_settings(mosquitto.port, ca.cert, box).model_copy(
            update={"username": "daq", "key_file": None} | credentials
        )
        monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
        async with publishing(outbox, settings) as publisher:
            await eventually(lambda: "LoadCredential=mqtt-password" in caplog.text, "the remedy is named")
            given = tmp_path / "credentials"
            given.mkdir()
            (given / "mqtt-password").write_text(SECRET + "\n")
            box.key.replace(given / "mqtt-key")
            monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(given))
            await eventually(lambda: publisher.counters.connected, "both are found")


async def test_secrets_are_in_no_log_and_in_nothing_that_is_published(tmp_path, outbox, caplog):
    """Every log record of every library, everything on the broker, and what the publisher says of itself."""
    caplog.set_level(1)
    caplog.set_level(1, "daqsvc.publish.mqtt.connection.library")
    mine = tmp_path / "mine"
    mine.write_bytes(b"\xff" + SECRET.encode())
    with running_mosquitto(tmp_path, config=password_config(tmp_path), anonymous=False) as mosquitto:
        settings = mqtt(mosquitto.port, "c", username="daq", password_file=mine)
        async with publishing(outbox, settings) as publisher:
            await eventually(lambda: "is not UTF-8 text" in caplog.text, "the file is named")
            mine.write_text(f"{SECRET}\nsecond {SECRET}\n")
            await eventually(lambda: publisher.counters.connected, "connected")
            figures = publisher.figures()
            publisher.telemetry("status", status_payload("lab", "edge-1", {"mqtt": figures}, CLOCK).to_json())
            await eventually(lambda: publisher.counters.telemetry_sent == 1, "the status is published")
            told = [repr(settings), repr(publisher), repr(figures), repr(read_credentials(settings))]
            told += [str(vars(record)) for record in caplog.records]
            for sequence in range(3):
                told += [repr(m) for m in await outbox.pending_telemetry(sequence, 10)]
        assert not [text for text in told if SECRET in text]


async def test_a_missing_password_file_is_named_and_awaited(tmp_path, outbox, caplog):
    mine = tmp_path / "mine"
    with running_mosquitto(tmp_path, config=password_config(tmp_path), anonymous=False) as mosquitto:
        settings = mqtt(mosquitto.port, "c", username="daq", password_file=mine)
        async with publishing(outbox, settings) as publisher:
            await eventually(lambda: str(mine) in caplog.text, "the file is named")
            mine.write_text(SECRET)
            await eventually(lambda: publisher.counters.connected, "the file is found")


async def test_what_is_no_password_is_said_and_awaited(tmp_path, outbox, caplog):
    """A pipe that nobody writes to, and a first line that MQTT cannot carry; a stop waits for neither."""
    mine = tmp_path / "mine"
    os.mkfifo(mine)
    with running_mosquitto(tmp_path, config=password_config(tmp_path), anonymous=False) as mosquitto:
        settings = mqtt(mosquitto.port, "c", username="daq", password_file=mine)
        async with publishing(outbox, settings):
            await eventually(lambda: f"{mine} is no regular file" in caplog.text, "the pipe is named")
        mine.unlink()
        mine.write_bytes(b"x" * 70_000)
        async with publishing(outbox, settings) as publisher:
            await eventually(
                lambda: f"first line of {mine} has more than 65535" in caplog.text, "it is named"
            )
            mine.write_text(SECRET + "\n")
            await eventually(lambda: publisher.counters.connected, "the file is in order")


@pytest.mark.parametrize("host", ["a..b", "x" * 64, ""])
async def test_a_host_that_cannot_be_one_is_an_outage_like_any_other(outbox, caplog, host):
    async with publishing(outbox, mqtt(1883, "c", host)) as publisher:
        await eventually(lambda: "is away" in caplog.text, "it is said")
        assert publisher.figures()["faults"] == 0
    assert "Traceback" not in caplog.text


async def test_a_secret_that_everybody_can_read_is_warned_of_once(tmp_path, outbox, caplog):
    mine = tmp_path / "mine"
    mine.write_text(SECRET + "\n")
    mine.chmod(0o644)
    with running_mosquitto(tmp_path, config=password_config(tmp_path), anonymous=False) as mosquitto:
        settings = mqtt(mosquitto.port, "c", username="daq", password_file=mine)
        async with (
            TcpProxy(mosquitto.port) as wire,
            publishing(
                outbox, settings.model_copy(update={"url": f"mqtt://127.0.0.1:{wire.port}"})
            ) as publisher,
        ):
            await eventually(lambda: publisher.counters.connected, "connected")
            wire.cut()
            await eventually(lambda: publisher.counters.connections == 2, "connected again")
    assert caplog.text.count("can be read by every user") == 1


async def test_a_certificate_whose_common_name_alone_is_the_host_is_refused(tmp_path, outbox, caplog):
    """RFC 9525: names count where certificates have them since 2000, in the subject alternative names."""
    ca = authority(tmp_path, "ca")
    broker = signed(tmp_path, "localhost", ca, host="a@example")  # CN=localhost
    with running_mosquitto(tmp_path, config=tls_config(broker)) as mosquitto:
        settings = tls_settings(mosquitto.port, ca.cert).model_copy(
            update={"url": f"mqtts://localhost:{mosquitto.port}"}
        )
        async with publishing(outbox, settings) as publisher:
            await eventually(lambda: "is away" in caplog.text, "it is refused")
            assert "for another host" in caplog.text
            assert not publisher.counters.connected
