"""Several machines in one process: they share buses, journal and broker, and no fault."""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import sys
import threading
import urllib.request
import uuid
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

import can
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families
from support.brokers import Consumer, running_mosquitto
from support.can_gateway import daqsvc_run
from support.given_codes import had
from support.live_service import running_box
from support.machine_files import LAVAL, MACHINES
from support.ports import LOOPBACK, free_port
from support.prometheus_programs import program
from support.sparkplug_host import Host
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.commands import AlarmCommand, Verb
from daqsvc.alarms.states import AlarmState, Level
from daqsvc.box import BOX, Box
from daqsvc.cli import main
from daqsvc.commands.service_manager import _in_short
from daqsvc.control import ControlError, ask_status
from daqsvc.diagnosis.pipeline import THREADS
from daqsvc.settings import MachineFileError, parse_machine_file
from drivers.can.plugin import frame_layout
from drivers.make import stream_layout
from drivers.modbus.registers import RegisterRecord
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.modbus_node import ModbusTcpServer
from sim_hw.nodes.modbus_unit import ModbusUnit
from sim_hw.nodes.pacing import RealTimePacer

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.service import Service
    from daqsvc.settings import MachineFile

pytestmark = pytest.mark.integration
RATE_HZ = 640.0
MQTT = '\n[mqtt]\nurl = "mqtt://127.0.0.1:{port}"\ninsecure = true\n'
RIG = LAVAL.read_text().replace('interface = "socketcan"', 'interface = "virtual"').partition("[mqtt]")[0]


def machine(
    name: str, number: int, more: str = "", *changes: tuple[str, str], folder: Path = LAVAL.parent
) -> MachineFile:
    """A rotor on the bus of the others, under an id of its own."""
    text = RIG
    for old, new in (('name = "laval-rig"', f'name = "{name}"'), ("0x101", f"{0x100 + number:#x}"), *changes):
        assert old in text, old
        text = text.replace(old, new)
    return parse_machine_file(text + more, folder / f"{name}.toml")


async def turn(service: Service, seconds: float, *names: str) -> None:
    """Have the rotors of these machines turn on the bus, once the service listens."""
    await eventually(lambda: service.drivers[0].link.state == "up", "the bus is up")
    machines = [service.box.machines[name] for name in names]
    turns = np.arange(round(RATE_HZ * seconds)) / RATE_HZ * 10.0
    x, y = 20.0 * np.cos(2 * np.pi * turns), 20.0 * np.sin(2 * np.pi * turns)
    samples = np.stack([x, y, np.where(turns % 1 < 0.1, -2.0, -10.0)], axis=1)
    with can.Bus(interface="virtual", channel="can0", protocol=can.CanProtocol.CAN_FD) as bus:
        nodes = [CanNode(bus, frame_layout(one, "shaft"), samples, RATE_HZ) for one in machines]
        await asyncio.gather(*(node.play(RealTimePacer(SystemClock())) for node in nodes))


def refused(*files: MachineFile) -> str:
    with pytest.raises(MachineFileError) as error:
        Box.several(files)
    return str(error.value)


def test_files_that_do_not_make_one_box_are_refused_with_what_is_wrong() -> None:
    store = '\n[store]\ndirectory = "{}"\n'
    long = ("ring_s = 30.0", "ring_s = 3600.0")
    changes = {
        'site = "plant": but': ('site = "lab"', 'site = "plant"'),
        'box = "edge-2": but': ('box = "edge-1"', 'box = "edge-2"'),
        'machine.name = "one": is the name': ('name = "two"', 'name = "one"'),
        f'machine.name = "{BOX}": is the name of the service': ('name = "two"', f'name = "{BOX}"'),
        'id 0x101 on bus "can0" belongs to stream "one/shaft" already': ("0x102", "0x101"),
        'buses.can0.channel = "can1": the bus of that name': ('channel = "can0"', 'channel = "can1"'),
    }
    for words, change in changes.items():
        said = refused(machine("one", 1), machine("two", 2, "", change))
        assert words in said, said
        assert "Remedy: " in said
        _, line, *_ = said.split(":")
        key = words.partition(" ")[0].rpartition(".")[2]
        assert key in machine("two", 2, "", change).text.splitlines()[int(line) - 1], said
    other_name = machine("two", 2, "", ("buses.can0", "buses.b"), ('bus = "can0"', 'bus = "b"'))
    assert 'channel: belongs to bus "can0" already' in refused(machine("one", 1), other_name)
    one = machine("one", 1, store.format("a"))
    assert "[store]: differs from that of" in refused(one, machine("two", 2, store.format("b")))
    assert Box.several([one, machine("two", 2, store.format("a"))]).own.store == one.store
    away = machine("two", 2, store.format("a"), folder=LAVAL.parent / "away")
    assert "write these in files of one directory" in refused(one, away)
    sparkplug = f'{MQTT.format(port=1883)}[mqtt.sparkplug]\ndevice = "fan"\n'
    said = refused(machine("one", 1), machine("two", 2, sparkplug))
    assert 'mqtt.sparkplug.device: "fan" names one device' in said, said
    assert said.endswith("[O06]")
    had("O06", said)
    with pytest.MonkeyPatch.context() as small:
        small.setattr("daqsvc.box.memory_bytes", lambda: 20_000_000)
        said = refused(machine("one", 1, "", long), machine("two", 2))
        assert "pipeline.ring_s = 3600.0: the rings of all 2 machines would take" in said, said


def test_a_single_file_is_a_box_in_its_own_names() -> None:
    one = machine("one", 1)
    box = Box.single(one)
    assert box.own is one
    assert box.is_single
    assert box.stream_key("one", "shaft") == "shaft"
    alone = Box.several([one])
    assert not alone.is_single
    assert list(alone.own.streams) == ["one/shaft"]


async def ask(consumer: Consumer, machine: str, alarm: str) -> dict[str, Any]:
    """Take an alarm out of service over the broker; the answer."""
    topic, identifier = f"daqsvc/lab/edge-1/{machine}/commands/bypass", str(uuid.uuid4())
    asked = {
        "schema": "daqsvc.command/1",
        "id": identifier,
        "alarm": alarm,
        "by": "the test",
        "issued_at": datetime.now(UTC).isoformat(),
    }
    consumer.publish(topic, json.dumps(asked))
    answers = lambda: [m.payload for m in consumer.on(f"{topic}/response") if m.payload["id"] == identifier]  # noqa: E731
    await eventually(answers, f"{machine} answers")
    [answer] = answers()
    return answer


async def test_machines_share_a_bus_a_journal_and_the_broker(tmp_path: Path) -> None:
    with running_mosquitto(tmp_path) as broker:
        tables = MQTT.format(port=broker.port) + "[mqtt.commands]\nenabled = true\nallow = ['bypass']\n"
        box = Box.several([machine("one", 1, tables), machine("two", 2)])
        async with Consumer(broker.port) as consumer, running_box(box, tmp_path / "store") as service:
            await turn(service, 3.0, "one")
            await eventually(lambda: consumer.on("/one/alarms/"), "the alarm of one machine goes out")
            assert len(service.drivers) == 1
            received = lambda name: service.figures()["streams"][name]["samples_received"]  # noqa: E731
            await eventually(lambda: received("one/shaft") == round(RATE_HZ * 3.0), "all has come")
            assert received("two/shaft") == 0
            raised = next(m.payload for m in consumer.on("/one/alarms/") if m.payload["state"] != "normal")
            assert (await ask(consumer, "one", raised["alarm"]))["accepted"]
            assert "it watches one, two, box" in (await ask(consumer, "three", "x"))["reason"]
            shown = service.alarms.managers["one"].alarms[raised["alarm"]].state
            assert shown is AlarmState.OUT_OF_SERVICE
            assert {m.topic for m in consumer.on("availability")} == {"daqsvc/lab/edge-1/availability"}
        # A restart takes over how the alarms stood; those of a machine that is gone return to normal.
        async with Consumer(broker.port) as consumer:
            box = Box.several([machine("two", 2, tables)])
            async with running_box(box, tmp_path / "store") as service:
                assert sorted(service.alarms.managers) == [BOX, "two"]
                gone = lambda: [m for m in consumer.on(f"/one/alarms/{raised['alarm']}") if not m.retained]  # noqa: E731
                await eventually(gone, "the alarm of the machine that is gone is withdrawn")
                assert gone()[-1].payload["state"] == "normal"
                assert not service.alarms.managers["two"].counters.events


async def test_the_service_speaks_of_itself_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = Box.several([machine("one", 1), machine("two", 2)])
    async with running_box(box, tmp_path / "store") as service:
        service.alarms.manager.condition("store/disk", Level.ALERT, "the disk is full")
        for name in ("one", "two"):
            [status] = await asyncio.to_thread(ask_status, tmp_path / "store", name)
            assert status["machine"] == name
            assert list(status["streams"]) == ["shaft"]
            assert [one["alarm"] for one in status["alarms"]["standing"]] == ["store/disk"]
        both = await asyncio.to_thread(ask_status, tmp_path / "store")
        assert [status["machine"] for status in both] == ["one", "two"]
        known = service.figures()
        with monkeypatch.context() as patch:
            patch.setattr(
                service.watches["two"].alignment, "figures", lambda: pytest.fail("nobody has asked")
            )
            assert service.figures_of("one").keys() == known.keys() - {"machines"}
        with pytest.raises(ControlError, match="watches one, two, not three"):
            await asyncio.to_thread(ask_status, tmp_path / "store", "three")
        wish = partial(AlarmCommand, verb=Verb.BYPASS, by="the test")
        outcome = await service.alarms.execute(wish(alarm="rotor-fault"), "test")
        assert (
            outcome.reason
            == "one, two each have an alarm 'rotor-fault': name the machine as well (--machine)"
        )
        outcome = await service.alarms.execute(wish(alarm="rotor-fault", machine="two"), "test")
        assert outcome.accepted
        states = {
            name: one.alarms["rotor-fault"].state
            for name, one in service.alarms.managers.items()
            if name != BOX
        }
        assert states == {"one": AlarmState.NORMAL, "two": AlarmState.OUT_OF_SERVICE}
        assert (await service.alarms.execute(wish(alarm="store/disk"), "test")).accepted
        assert "; alarms: 2 out of service" in _in_short(service)[0], "systemd hears of all machines"
        outcome = await service.alarms.execute(wish(alarm="store/disk", machine="four"), "test")
        assert outcome.reason == "no machine is named 'four'; there are: box, one, two"


async def test_what_fails_of_one_machine_touches_no_other(tmp_path: Path) -> None:
    box = Box.several([machine("one", 1), machine("two", 2)])
    async with running_box(box, tmp_path / "store") as service:
        one, two = service.watches["one"], service.watches["two"]
        for detector in one.pipeline.detectors:
            detector.process = lambda _: 1 / 0  # type: ignore[method-assign]
        one.rings["shaft"].write = lambda _: 1 / 0  # type: ignore[method-assign]
        await turn(service, 1.0, "one", "two")
        await eventually(lambda: service.supervisor.failures["one: stream shaft"], "one has failed")
        await eventually(lambda: two.rings["shaft"].end_index == round(RATE_HZ), "the other gets all")
        await eventually(lambda: two.pipeline.counters["rotor-bank"].windows > 10, "the other is judged")
        assert not [name for name in service.supervisor.failures if name.startswith("two: ")]
        del one.rings["shaft"].write
        await turn(service, 1.0, "one", "two")
        await eventually(
            lambda: service.supervisor.failures["one: detector rotor-bank"], "its detector fails"
        )
        assert not [name for name in service.supervisor.failures if name.startswith("two: ")]
        parts = service.progress()
        assert {"one: detector rotor-bank", "two: detector rotor-bank", "driver can0", "outbox"} <= set(parts)


@pytest.mark.long
async def test_detectors_that_hang_hold_up_no_other_machine(tmp_path: Path) -> None:
    box = Box.several([machine("one", 1), machine("two", 2)])
    may_end = threading.Event()
    async with running_box(box, tmp_path / "store") as service:
        one, two = (service.watches[name].pipeline for name in ("one", "two"))
        await turn(service, 1.0, "one", "two")
        await eventually(lambda: two.counters["rotor-bank"].windows, "both are judged")
        try:
            for detector in one.detectors:
                detector.process = lambda _: may_end.wait(60) and []  # type: ignore[method-assign]
            before = {name: counted.samples for name, counted in two.counters.items()}
            await turn(service, 2.0, "one", "two")
            await eventually(lambda: all(p.thread for p in one.progress().values()), "both detectors hang")
            await eventually(
                lambda: all(two.counters[n].samples - before[n] > RATE_HZ / 2 for n in before),
                "the other is judged",
            )
        finally:
            may_end.set()
        kernels = lambda: [t for t in threading.enumerate() if t.name.startswith("kernel_")]  # noqa: E731
        await eventually(lambda: len(kernels()) <= THREADS, "those threads end with what has taken long")


async def test_two_machines_are_read_through_one_gateway(tmp_path: Path) -> None:
    gap = (MACHINES / "modbus-gap-voltages.toml").read_text()
    units = {1: ModbusUnit(), 2: ModbusUnit()}
    gap_v = {1: -9.0, 2: -11.0}
    server = ModbusTcpServer(units)
    await server.start()
    try:
        files = []
        for unit, name in enumerate(("one", "two"), start=1):
            text = gap.replace('host = "192.0.2.20"', f'host = "127.0.0.1"\ntcp_port = {server.port}')
            text = re.sub(r'(?m)^name = "[^"]*"', f'name = "{name}"', text, count=1)
            text = text.replace("\nunit = 1\n", f"\nunit = {unit}\n")
            files.append(parse_machine_file(text, MACHINES / f"{name}.toml"))
            record = RegisterRecord.of(layout := stream_layout(files[-1], "gap"))
            said = record.encode(np.full((1, 2), gap_v[unit]), clip=True)[0]
            units[unit].put(layout.table, record.runs[0].address, said)
        async with running_box(Box.several(files), tmp_path / "store") as service:
            assert len(service.drivers) == 1
            streams = service.drivers[0].streams
            await eventually(
                lambda: all(counters.samples_received > 5 for counters, _ in streams.values()),
                "both are read",
            )
            assert sorted(streams) == ["one/gap", "two/gap"]
            for unit, watch in zip(gap_v, service.watches.values(), strict=True):
                newest = watch.rings["gap"].read(watch.rings["gap"].end_index - 1, 1)[0]
                assert newest == pytest.approx(gap_v[unit], abs=0.01), "each machine has its own unit"
    finally:
        server.stop()


@pytest.mark.long
async def test_every_output_tells_of_every_machine(tmp_path: Path) -> None:
    port = free_port()
    with running_mosquitto(tmp_path) as broker:
        tables = (
            f"{MQTT.format(port=broker.port)}[mqtt.home_assistant]\n[mqtt.sparkplug]\n"
            f'[metrics]\nlisten = "{LOOPBACK}:{port}"\n'
        )
        box = Box.several([machine("one", 1, tables), machine("two", 2)])
        async with (
            Consumer(broker.port, "homeassistant/#") as consumer,
            Host(broker.port) as host,
            running_box(box, tmp_path / "store") as service,
        ):
            await turn(service, 2.0, "one", "two")
            await eventually(lambda: {s.device for s in host.of("DBIRTH")} == {"one", "two"}, "two devices")
            names = {metric.name for metric in host.of("NBIRTH")[-1].metrics}
            assert {"Alarms/one/rotor-fault/State", "Alarms/two/rotor-fault/State"} <= names
            assert "Alarms/box/store/journal/State" in names
            told = lambda: {m.payload["device"]["name"].partition(" ")[0] for m in consumer.messages}  # noqa: E731
            await eventually(lambda: told() == {"one", "two", BOX}, "Home Assistant knows all")
            whole = f'stream_samples_received_total{{machine="two",stream="shaft"}} {2 * RATE_HZ}'
            async with asyncio.timeout(60.0):
                while whole not in (text := await asyncio.to_thread(metrics, port)):
                    await asyncio.sleep(0.2)  # the figures are a second old
            done = await asyncio.to_thread(
                subprocess.run,
                [program("promtool"), "check", "metrics"],
                input=text,
                text=True,
                check=False,
            )
            assert done.returncode == 0
    samples = [s for family in text_string_to_metric_families(text) for s in family.samples]
    received = {
        s.labels["machine"]: s.value for s in samples if s.name == "daqsvc_stream_samples_received_total"
    }
    assert received == {"one": 2 * RATE_HZ, "two": 2 * RATE_HZ}
    assert {s.labels["machine"] for s in samples if s.name == "daqsvc_alarms"} == {"one", "two", BOX}
    assert [s.labels["machine"] for s in samples if s.name == "daqsvc_healthy"] == [BOX]
    keys = [(s.name, tuple(sorted(s.labels.items()))) for s in samples]
    assert len(keys) == len(set(keys)), "each series once"


def metrics(port: int) -> str:
    with urllib.request.urlopen(f"http://{LOOPBACK}:{port}/metrics", timeout=10.0) as answer:
        text: str = answer.read().decode()
    return text


def written(folder: Path, **numbers: int) -> Path:
    """A directory of machine files with one store."""
    folder.mkdir()
    for name, number in numbers.items():
        text = RIG.replace('name = "laval-rig"', f'name = "{name}"').replace("0x101", f"{0x100 + number:#x}")
        (folder / f"{name}.toml").write_text(f'{text}\n[store]\ndirectory = "store"\n')
    return folder


def test_a_directory_is_checked_as_one_box(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    plant = written(tmp_path / "plant", one=1, two=2)
    (plant / ".two.toml").write_text((plant / "two.toml").read_text())
    (plant / ".#two.toml").symlink_to("ann@desk.4711:1")
    assert main(["check", f"{plant}"]) == 0
    out, _ = capfd.readouterr()
    assert [line for line in out.splitlines() if line.startswith("Machine")] == [
        f"Machine  {name} - Laval rotor on a test rig, can rub its housing" for name in ("one", "two")
    ]
    assert main(["check", f"{plant}.toml"]) == 0, "as the unit of systemd names it"
    assert capfd.readouterr().out == out
    lonely = (plant / "two.toml").read_text().partition("[store]")[0]
    (plant / "two.toml").write_text(lonely)
    (plant / "one.toml").write_text(f"{(plant / 'one.toml').read_text()}{MQTT.format(port=1883)}")
    assert main(["check", f"{plant}"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert len({line for line in lines if line.startswith("Store")}) == 1
    brokers = [line.partition(",")[0] for line in lines if line.startswith("MQTT")]
    assert brokers == ["MQTT     127.0.0.1 port 1883"] * 2
    same = written(tmp_path / "same", one=1, two=1)
    assert main(["check", f"{same / 'one.toml'}", f"{same / 'two.toml'}"]) == 2
    assert 'id 0x101 on bus "can0"' in caplog.text
    empty = tmp_path / "empty"
    empty.mkdir()
    assert main(["check", f"{empty}"]) == 2
    assert f"{empty}: no machine file (*.toml) is in this directory. Remedy: " in caplog.text
    assert "daqsvc example [F26]" in caplog.text
    had("F26", "\n".join(caplog.messages))


@pytest.mark.long
async def test_a_process_watches_a_directory_and_tells_of_each_machine(tmp_path: Path) -> None:
    plant = written(tmp_path / "plant", one=1, two=2)
    verb = partial(subprocess.run, capture_output=True, text=True, check=False, timeout=60)
    daqsvc = [sys.executable, "-m", "daqsvc"]
    async with daqsvc_run(plant, plant / "store"):
        store = plant / "store"
        await eventually((store / "control.sock").exists, "it runs")
        shown = await asyncio.to_thread(verb, [*daqsvc, "status", f"{plant}"])
        assert [line for line in shown.stdout.splitlines() if "daqsvc 0" in line][1].startswith("two (lab/")
        one = await asyncio.to_thread(verb, [*daqsvc, "status", "--machine", "two", "--json", f"{plant}"])
        assert json.loads(one.stdout)["machine"] == "two"
        asked = [*daqsvc, "bypass", "rotor-fault", f"{plant}"]
        refusal = await asyncio.to_thread(verb, asked)
        assert refusal.returncode == 1
        assert "name the machine as well" in refusal.stderr
        done = await asyncio.to_thread(verb, [*asked, "--machine", "two"])
        assert done.returncode == 0, done.stderr
        table = await asyncio.to_thread(verb, [*daqsvc, "alarms", f"{plant}"])
        assert "out of service" in table.stdout
        assert "--machine NAME" in (await asyncio.to_thread(verb, [*daqsvc, "ack", "--help"])).stdout
