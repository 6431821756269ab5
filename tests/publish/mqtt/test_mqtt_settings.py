"""The table [mqtt]: certificates, credentials, commands and Home Assistant, and what does not fit."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import pytest
from support.given_codes import had
from support.machine_files import LAVAL, only_problem, parsed

from daqsvc.alarms.commands import Verb
from daqsvc.publish.home_assistant.settings import HomeAssistant
from daqsvc.publish.make import output_set
from daqsvc.publish.mqtt.settings import Mqtt
from daqsvc.publish.sparkplug.settings import Sparkplug
from daqsvc.self_check import conditions
from daqsvc.settings import parse_machine_file
from daqsvc.settings.describe import describe

URL = 'url = "mqtts://broker.example:8883"'
PASSWORD = 'password_file = "/etc/daqsvc/mqtt-password"'  # noqa: S105  a name
ROOT = 'topic_root = "daqsvc"'
ALLOWED = 'allow = ["acknowledge", "shelve", "unshelve"]'


machine = partial(parsed, LAVAL)


@pytest.mark.parametrize(
    ("addition", "key", "message", "remedy"),
    [
        ('key_file = "box.key"', "mqtt.key_file", "key without a certificate", "add cert_file"),
        ('key_credential = "box-key"', "mqtt.key_credential", "key without a certificate", "add cert_file"),
        ('password_credential = "pw"', "mqtt.password_credential", "besides password_file", "remove one"),
        (
            'cert_file = "box.crt"\nkey_file = "box.key"\nkey_credential = "box-key"',
            "mqtt.key_credential",
            "besides key_file",
            "remove one",
        ),
        ('[mqtt.home_assistant]\nprefix = "a/#"', "mqtt.home_assistant.prefix", "between", "write e.g."),
    ],
)
def test_what_does_not_fit_is_named(addition, key, message, remedy):
    problem, _ = only_problem(LAVAL, (ROOT, f"{ROOT}\n{addition}"))
    assert problem.key == key
    assert message in problem.message
    assert remedy in problem.remedy


@pytest.mark.parametrize(
    ("line", "key", "message"),
    [
        ('allow = ["reboot"]', "mqtt.commands.allow[0]", "acknowledge"),
        ("max_age_s = 0", "mqtt.commands.max_age_s", "0.1 or more"),
        ("max_bytes = 10", "mqtt.commands.max_bytes", "256 or more"),
    ],
)
def test_commands_that_cannot_be_are_named(line, key, message):
    problem, _ = only_problem(LAVAL, (ALLOWED, line))
    assert problem.key == key
    assert message in problem.message


@pytest.mark.parametrize("host", ["a..b", "x" * 64, ".a", f"{'a.' * 130}b", "broker:@x", "a b", "a_b!"])
def test_a_host_that_no_name_server_could_know_is_refused(host):
    problem, _ = only_problem(LAVAL, (URL, f'url = "mqtts://{host}"'))
    assert problem.key == "mqtt.url"


@pytest.mark.parametrize(
    "host", ["broker", "broker.example.", "10.0.0.1", "[::1]", "bröker.example", "x" * 63]
)
def test_a_host_that_may_be_one_is_taken(host):
    assert machine((URL, f'url = "mqtts://{host}"')).mqtt.url == f"mqtts://{host}"


def test_files_that_are_no_files_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pw")
    problem, _ = only_problem(LAVAL, (PASSWORD, f'password_file = "{tmp_path}/pw"'))
    assert problem.key == "mqtt.password_file"
    assert "no regular file" in problem.message


def test_a_password_that_mqtt_cannot_carry_is_refused(tmp_path):
    path = tmp_path / "pw"
    path.touch(0o600)
    for length, fits in ((65_535, True), (65_536, False)):
        path.write_bytes(b"x" * length + b"\nmore")
        if fits:
            machine((PASSWORD, f'password_file = "{path}"'))
        else:
            problem, _ = only_problem(LAVAL, (PASSWORD, f'password_file = "{path}"'))
            assert "first line of more than 65535 bytes" in problem.message


def test_a_password_that_everybody_can_read_is_warned_of(tmp_path):
    path = tmp_path / "pw"
    path.write_text("secret")
    path.chmod(0o644)
    (warning,) = machine((PASSWORD, f'password_file = "{path}"')).warnings
    assert "can be read by every user" in warning.message
    assert str(warning).endswith("[O02]")
    had("O02", warning)
    path.chmod(0o640)
    assert machine((PASSWORD, f'password_file = "{path}"')).warnings == ()


def test_plaintext_needs_to_be_meant():
    problem, _ = only_problem(LAVAL, (URL, 'url = "mqtt://localhost"'))
    assert problem.key == "mqtt.url"
    assert "insecure = true" in problem.remedy
    assert "network" not in problem.message, "it stays on this box"
    problem, _ = only_problem(LAVAL, (URL, 'url = "mqtt://broker.example"'))
    assert "over the network" in problem.message


def test_what_would_go_unencrypted_to_another_host_is_warned_of():
    plain = machine(
        (URL, 'url = "mqtt://broker.example"\ninsecure = true\ncert_file = "box.crt"'),
    )
    assert {warning.key for warning in plain.warnings} == {
        "mqtt.ca_file",
        "mqtt.cert_file",
        "mqtt.password_file",
        "mqtt.commands.enabled",
    }


def test_files_start_at_the_directory_of_the_machine_file():
    told = machine((ROOT, f'{ROOT}\ncert_file = "tls/box.crt"\nkey_file = "tls/box.key"'))
    settings = told.output(Mqtt).on(told)
    assert settings.cert_file == LAVAL.parent / "tls/box.crt"
    assert settings.key_file == LAVAL.parent / "tls/box.key"
    assert settings.ca_file == Path("/etc/daqsvc/ca.pem")


def test_without_being_asked_nothing_is_taken_and_nobody_else_is_told():
    text = LAVAL.read_text(encoding="utf-8")
    told = parse_machine_file(text[: text.index("[mqtt.commands]")], LAVAL)
    assert not told.output(Mqtt).commands.enabled
    assert told.output(HomeAssistant) is None
    assert told.output(Sparkplug) is None


def test_only_enabled_commands_are_taken():
    listed = 'allow = ["acknowledge", "reset"]'
    assert not machine((ALLOWED, listed), ("enabled = true", "")).output(Mqtt).commands.enabled
    enabled = machine((ALLOWED, listed))
    commands = enabled.output(Mqtt).commands
    assert commands.enabled
    assert commands.allow == (Verb.ACKNOWLEDGE, Verb.RESET)
    assert "takes commands: acknowledge, reset" in describe(enabled)


def watched(machine):
    return output_set(machine, conditions()).machines[machine.machine.name]


def test_home_assistant_is_told_of_every_alarm_and_of_the_sensors_behind_them():
    told = machine((ROOT, f"{ROOT}\n[mqtt.home_assistant]"))
    settings = watched(told)
    assert settings.alarms == tuple(alarm.name for alarm in told.alarms)
    assert {"sensor-ok/probe-x", "sensor-ok/probe-y", "detector-ok/rotor-bank"} <= set(settings.services)
    assert {"certificate/broker", "certificate/ca", "store/disk"} <= set(settings.services)
    assert {"store/journal", "store/damage", "store/telemetry", "store/audit-log"} <= set(settings.services)
    assert "alarm-flood" in settings.services
    assert not {"certificate/client", "trip-multiply"} & set(settings.services)
    off = machine((ROOT, f"{ROOT}\n[mqtt.home_assistant]\nenabled = false"))
    assert not off.output(HomeAssistant).enabled


START_UP = """[alarm_handling.start_up]
detector = "rotor-bank"
measure = "speed"
between = [60.0, 540.0]
"""


def test_home_assistant_and_sparkplug_are_told_of_what_the_machine_file_makes_possible():
    asked = f"{ROOT}\n[mqtt.home_assistant]\n[mqtt.sparkplug]\n{START_UP}"
    told = machine((ROOT, asked))
    assert {"alarm-flood", "trip-multiply"} <= set(watched(told).services)
    calm = machine((ROOT, asked.replace(START_UP, "")), ("flood_alarms = 10", "flood_alarms = 0"))
    assert not {"alarm-flood", "trip-multiply"} & set(watched(calm).services)


def test_no_two_boxes_get_the_same_client_id():
    named = ["a", "b", "a-b", "b-c", "c", "b-c-sparkplug", "c-sparkplug", "a.b", "a_b"]
    machines = [
        machine(('site = "lab"', f'site = "{site}"'), ('box = "edge-1"', f'box = "{box}"'))
        for site in named
        for box in named
    ]
    ids = [each.output(Mqtt).client_id_of(each) for each in machines]
    ids += [f"{each.output(Mqtt).client_id_of(each)}:sparkplug" for each in machines]
    assert len(set(ids)) == len(ids)
