"""The service as a Sparkplug edge node: it is born, its alarms and levels arrive, it leaves in order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.brokers import running_mosquitto
from support.live_service import play, running
from support.machine_files import LAVAL, changed, only_problem
from support.mqtt_publishing import CLOCK, output_port
from support.sparkplug_host import Host
from support.waiting import eventually

from daqsvc.outbox.store import Outbox
from daqsvc.publish.make import output_set
from daqsvc.publish.mqtt.settings import Mqtt
from daqsvc.publish.sparkplug.edge import SparkplugEdge
from daqsvc.publish.sparkplug.settings import Sparkplug
from daqsvc.recording.recording import Recording
from daqsvc.settings import parse_machine_file
from daqsvc.settings.describe import describe
from sim_hw.demo.machines import for_recording

pytestmark = pytest.mark.integration
RATE_HZ = 2000.0
ROOT = 'topic_root = "daqsvc"'


@pytest.mark.mosquitto
async def test_the_service_is_an_edge_node(tmp_path: Path) -> None:
    samples = np.random.default_rng(0).normal(size=(round(2 * RATE_HZ), 1))
    recording = Recording(("accel",), samples, RATE_HZ, Path(__file__), 0)
    with running_mosquitto(tmp_path) as broker:
        plain = for_recording(recording, "g", {"accel": (0.5, 5.0)}, f"mqtt://127.0.0.1:{broker.port}")
        machine = plain.model_copy(
            update={"mqtt": plain.output(Mqtt).model_copy(update={"sparkplug": Sparkplug()})}
        )
        name = machine.machine.name
        async with Host(broker.port) as host:
            async with running(machine, tmp_path) as service:
                await play(service, samples, RATE_HZ)
                alarm = f"Alarms/{name}/vibration-accel"
                await eventually(lambda: host.told(f"{alarm}/Active", historical=False), "the alarm is told")
                await eventually(lambda: host.told("levels/accel/rms", historical=False), "the level is told")
                assert host.told(f"{alarm}/State", historical=False) == ["active_unacknowledged"]
                rms = host.told("levels/accel/rms", historical=False)[-1]
                assert rms == pytest.approx(1.0, rel=0.2)
                assert host.of("NBIRTH")[0].value(f"{alarm}/State") == "normal", "known before it was raised"
                assert service.figures()["sparkplug"]["alarms"] >= 1
            await eventually(lambda: host.of("NDEATH"), "it leaves")
        assert host.messages[0].topic == f"spBv1.0/{machine.site}/NBIRTH/{machine.box}"
        assert {message.device for message in host.of("DBIRTH")} == {name}


def test_what_is_not_said_follows_from_the_box(tmp_path: Path) -> None:
    text, _ = changed(LAVAL, (ROOT, f"{ROOT}\n[mqtt.sparkplug]"))
    machine = parse_machine_file(text, LAVAL)
    outbox = Outbox(tmp_path / "outbox.sqlite", CLOCK)
    asked = output_set(machine)
    edge = asked.make(output_port(outbox, *asked.machines.values()))["mqtt.sparkplug"]
    assert isinstance(edge, SparkplugEdge)
    assert edge.node.commands == "spBv1.0/lab/NCMD/edge-1"
    assert edge._devices == {"laval-rig": "laval-rig"}
    assert [broker.url for broker in edge._brokers] == ["mqtts://broker.example:8883"]
    assert edge._client_id == "daqsvc-lab:edge-1:sparkplug"
    assert "Alarms/laval-rig/rotor-fault/State" in [metric.name for metric in edge._board.of(None, 0)]
    assert "Sparkplug B edge node lab/edge-1" in " ".join(describe(machine).split())


def test_without_the_table_there_is_no_edge_node() -> None:
    text, _ = changed(LAVAL, (ROOT, ROOT + " "))
    assert parse_machine_file(text, LAVAL).output(Sparkplug) is None


@pytest.mark.parametrize(
    ("addition", "key", "message"),
    [
        ('servers = ["mqtt://other.example"]', "mqtt.sparkplug.servers[0]", "other encryption"),
        ('servers = ["other"]', "mqtt.sparkplug.servers[0]", "not the address"),
        ('client_id = "daqsvc-lab:edge-1"', "mqtt.sparkplug.client_id", "ends one connection"),
        ('group = "a/b"', "mqtt.sparkplug.group", "a/b"),
    ],
)
def test_what_does_not_fit_is_named(addition: str, key: str, message: str) -> None:
    problem, _ = only_problem(LAVAL, (ROOT, f"{ROOT}\n[mqtt.sparkplug]\n{addition}"))
    assert problem.key == key
    assert message in problem.message or message in str(problem)


def test_a_password_in_an_address_is_not_shown() -> None:
    addition = 'servers = ["mqtts://daq:hunter2@other.example"]'
    problem, _ = only_problem(LAVAL, (ROOT, f"{ROOT}\n[mqtt.sparkplug]\n{addition}"))
    assert problem.value == '"mqtts://***@other.example"'
    assert "hunter2" not in str(problem)
