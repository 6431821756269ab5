"""TLS verifies by default and takes rotated certificates; passwords stay out of every log."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import subprocess

import pytest
from brokers import eventually, running_mosquitto

from daqsvc.acquisition.clock import SystemClock
from daqsvc.outbox.store import Outbox
from daqsvc.publish.mqtt import MqttPublisher, MqttSettings

pytestmark = pytest.mark.mosquitto
CLOCK = SystemClock()
SECRET = "correct horse battery staple"  # noqa: S105  nobody's


@pytest.fixture
async def outbox(tmp_path):
    outbox = Outbox(tmp_path / "outbox.sqlite", CLOCK)
    await outbox.open()
    yield outbox
    await outbox.close()


@contextlib.asynccontextmanager
async def publishing(outbox, settings):
    publisher = MqttPublisher(settings, "lab", "edge-1", outbox, CLOCK)
    running = asyncio.create_task(publisher.run())
    try:
        yield publisher
    finally:
        await publisher.stop()
        await running


def openssl(*arguments):
    program = shutil.which("openssl")
    if program is None:
        pytest.skip("no openssl on this machine (apt-get install openssl)")
    subprocess.run([program, *arguments], check=True, capture_output=True)


def certificate(directory, name, host):
    """A certificate for ``host`` that vouches for itself."""
    key, cert = directory / f"{name}.key", directory / f"{name}.crt"
    openssl(
        *("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", f"/CN={name}"),
        *("-addext", f"subjectAltName={host}", "-keyout", str(key), "-out", str(cert)),
    )
    return key, cert


def tls_config(key, cert):
    return f"certfile {cert}\nkeyfile {key}"


def tls_settings(port, ca_file):
    return MqttSettings("127.0.0.1", port, "daqsvc-tls", tls=True, ca_file=ca_file)


async def test_a_broker_with_a_trusted_certificate_is_served(tmp_path, outbox):
    key, cert = certificate(tmp_path, "broker", "IP:127.0.0.1")
    with running_mosquitto(tmp_path, config=tls_config(key, cert)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, cert)) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected over TLS")
            sequence = await outbox.append("daqsvc/lab/edge-1/rig/alarms/a", lambda n: b"{}", retain=True)
            await eventually(lambda: outbox.counters.sent == 1, f"{sequence} is acknowledged")


@pytest.mark.parametrize(
    ("host", "trusted", "reason"),
    [
        ("DNS:another.example", True, "mismatch"),
        ("IP:127.0.0.1", False, "self-signed certificate|self signed"),
    ],
)
async def test_a_broker_that_cannot_prove_itself_is_refused(tmp_path, outbox, caplog, host, trusted, reason):
    key, cert = certificate(tmp_path, "broker", host)
    _, stranger = certificate(tmp_path, "stranger", "IP:127.0.0.1")
    with running_mosquitto(tmp_path, config=tls_config(key, cert)) as mosquitto:
        settings = tls_settings(mosquitto.port, cert if trusted else stranger)
        async with publishing(outbox, settings) as publisher:
            await eventually(lambda: "is away" in caplog.text, "it is refused")
            assert any(part in caplog.text for part in reason.split("|"))
            assert publisher.counters.connections == 0


async def test_a_rotated_certificate_takes_effect_at_the_next_connection(tmp_path, outbox):
    old_key, old = certificate(tmp_path, "old", "IP:127.0.0.1")
    new_key, new = certificate(tmp_path, "new", "IP:127.0.0.1")
    trusted = tmp_path / "trusted.crt"
    trusted.write_bytes(old.read_bytes())
    with running_mosquitto(tmp_path, config=tls_config(old_key, old)) as mosquitto:
        async with publishing(outbox, tls_settings(mosquitto.port, trusted)) as publisher:
            await eventually(lambda: publisher.counters.connected, "connected with the old certificate")
            mosquitto.stop()
            old_key.write_bytes(new_key.read_bytes())
            old.write_bytes(new.read_bytes())
            trusted.write_bytes(new.read_bytes())
            mosquitto.start()
            await eventually(lambda: publisher.counters.connections == 2, "connected with the new one")


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
        settings = MqttSettings("127.0.0.1", mosquitto.port, "c", username="daq", password_file=mine)
        async with publishing(outbox, settings) as publisher:
            await eventually(lambda: "is away" in caplog.text, "it is refused")
            assert "Not authorized" in caplog.text
            mine.write_text(SECRET + "\n")
            await eventually(lambda: publisher.counters.connected, "the corrected password is taken")
    assert SECRET not in caplog.text
    assert SECRET not in repr(settings)


async def test_a_missing_password_file_is_named_and_awaited(tmp_path, outbox, caplog):
    mine = tmp_path / "mine"
    with running_mosquitto(tmp_path, config=password_config(tmp_path), anonymous=False) as mosquitto:
        settings = MqttSettings("127.0.0.1", mosquitto.port, "c", username="daq", password_file=mine)
        async with publishing(outbox, settings) as publisher:
            await eventually(lambda: str(mine) in caplog.text, "the file is named")
            mine.write_text(SECRET)
            await eventually(lambda: publisher.counters.connected, "the file is found")
