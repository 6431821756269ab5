"""``daqsvc sim`` as a process of its own, and what clients make of what it plays."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from brokers import Consumer, Mosquitto, eventually, free_port, running_mosquitto
from live_service import running

from daqsvc import assembly_drivers
from daqsvc.settings import load_machine_file, parse_machine_file
from sim_hw.bus_socket import UnixBus
from sim_hw.scenario import load_any_scenario

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[2]
VIRTUAL_RIG = ROOT / "config" / "machines" / "virtual-rig.toml"
DOCUMENTATION = ROOT / "docs" / "virtual-bus.md"
BAD_BUS = ROOT / "config" / "scenarios" / "bad-bus.toml"
PATIENCE_S = 60.0
PER_FRAME = 10

FAULTS = """
title = "A healthy rotor on a bad bus"
revolutions = 70.0
samples_per_rev = 64
[plant]
kind = "rotor"
[[fault]]
kind = "drift"
ppm = 60.0
[[fault]]
kind = "link"
from_s = 1.0
to_s = 5.0
drop = 0.08
duplicate = 0.08
corrupt = 0.08
[[fault]]
kind = "delay"
from_s = 2.0
to_s = 4.0
delay_ms = 2.0
jitter_ms = 3.0
[[fault]]
kind = "silence"
from_s = 5.2
to_s = 5.6
"""
BABBLE = """
[[fault]]
kind = "babble"
from_s = 3.0
to_s = 4.0
rate_hz = 400.0
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "faults.toml"
    path.write_text(FAULTS + BABBLE)
    return path


@contextlib.contextmanager
def process(verb: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A ``daqsvc`` that is ended with the test, however that ends."""
    running = subprocess.Popen(
        [sys.executable, "-m", "daqsvc", verb, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield running
    finally:
        if running.poll() is None:
            running.kill()
        running.communicate()


async def summary_of(sim: subprocess.Popen[str]) -> dict[str, Any]:
    """What a simulator says at its end."""
    output, errors = await asyncio.to_thread(sim.communicate, timeout=PATIENCE_S)
    assert sim.returncode == 0, errors
    return json.loads(output)


def documented(verb: str, places: dict[str, Path]) -> list[str]:
    """The first command of this verb in the documentation, with other files."""
    line = re.search(rf"^daqsvc ({verb} .*)$", DOCUMENTATION.read_text(), flags=re.MULTILINE)
    assert line is not None
    return [str(places.get(word, word)) for word in shlex.split(line[1])]


def rig_file(folder: Path, path: Path, port: int) -> Path:
    text = VIRTUAL_RIG.read_text().replace("/tmp/daqsvc-can0", str(path))  # noqa: S108
    file = folder / "rig.toml"
    file.write_text(text.replace("127.0.0.1:1883", f"127.0.0.1:{port}"))
    return file


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    with running_mosquitto(tmp_path) as broker:
        yield broker


def status_of(consumer: Consumer) -> dict[str, Any]:
    found = consumer.on("/status")
    return found[-1].payload["figures"] if found else {}


def figures(consumer: Consumer, group: str, name: str, figure: str) -> Any:
    return status_of(consumer).get(group, {}).get(name, {}).get(figure)


@pytest.mark.mosquitto
async def test_run_counts_to_the_sample_what_sim_has_sent_and_spoilt(
    tmp_path: Path, scenario: Path, broker: Mosquitto
) -> None:
    machine = rig_file(tmp_path, tmp_path / "can0", broker.port)
    async with Consumer(broker.port) as consumer:
        places = {
            "config/machines/virtual-rig.toml": machine,
            "/tmp/daqsvc-virtual": tmp_path / "store",  # noqa: S108
            "paper": scenario,
        }
        with process(*documented("run", places)) as service:
            await eventually(lambda: figures(consumer, "buses", "can0", "up") == 1, "the bus is up")
            with process(*documented("sim", places), "--seed", 5) as sim:
                summary = await summary_of(sim)
            sent = summary["streams"]["shaft"]
            injected = sent["injected"]
            await eventually(
                lambda: (
                    figures(consumer, "streams", "shaft", "frames_received") == sent["frames_sent"]
                    and figures(consumer, "buses", "can0", "frames_unknown") == injected["babbled"]
                ),
                "the service has had every frame",
            )
            service.send_signal(signal.SIGTERM)
            await asyncio.to_thread(service.communicate, timeout=PATIENCE_S)
            assert service.returncode == 0
        counted = status_of(consumer)["streams"]["shaft"]
    assert summary["complete"]
    assert summary["buses"] == {"can0": f"unixbus {tmp_path / 'can0'}"}
    assert sent["frames_unsent"] == 0
    assert injected["frames_in"] == 448  # 7 s at 640 Hz, 10 samples to a frame
    assert injected["babbled"] == 400
    for fault in ("dropped", "duplicated", "corrupted", "silenced", "delayed"):
        assert injected[fault] >= 10, fault
    lost = PER_FRAME * (injected["dropped"] + injected["corrupted"] + injected["silenced"])
    assert counted["samples_lost"] == lost
    assert counted["samples_received"] + counted["samples_lost"] == sent["samples_sent"] == 4480
    assert counted["frames_corrupt"] == injected["corrupted"]
    assert counted["frames_duplicate"] == injected["duplicated"]
    assert counted["frames_rejected"] == counted["frames_late"] == 0


@pytest.mark.mosquitto
async def test_a_bus_that_is_killed_comes_back_and_the_books_still_close(
    tmp_path: Path, broker: Mosquitto
) -> None:
    path = tmp_path / "can0"
    machine = rig_file(tmp_path, path, broker.port)
    async with Consumer(broker.port) as consumer:
        with (
            process("sim", "--bus", path) as hub,
            process("run", machine, "--store", tmp_path / "store"),
        ):
            await eventually(path.exists, "the bus is there")
            await eventually(lambda: figures(consumer, "buses", "can0", "up") == 1, "the bus is up")
            with process("sim", machine, "--scenario", "healthy", "--duration", 12) as sim:
                await eventually(
                    lambda: (figures(consumer, "streams", "shaft", "samples_received") or 0) > 0,
                    "samples arrive",
                )
                # Killed, not ended: nobody is told, the socket's file stays, and someone starts a new bus.
                hub.kill()
                summary = await summary_of(sim)
            sent = summary["streams"]["shaft"]

            def closed() -> bool:
                counted = status_of(consumer)["streams"]["shaft"]
                return counted["samples_received"] + counted["samples_lost"] == sent["samples_sent"]

            await eventually(closed, f"samples sent = stored + counted lost, {sent}")
            # Whoever came first had the new bus in its process; it may have ended with the simulator.
            assert figures(consumer, "buses", "can0", "losses") in {1, 2}
    assert sent["samples_sent"] == 7680
    assert summary["complete"]


def test_sim_alone_plays_for_any_client_of_the_bus(tmp_path: Path) -> None:
    path = tmp_path / "can0"
    with UnixBus(str(path), fd=True) as client, process("sim", "paper", "--bus", path, "--speed", 8) as sim:
        message = client.recv(PATIENCE_S)
        assert message is not None
        assert message.arbitration_id == 0x101
        assert message.is_fd
        begun_s = time.monotonic()
        sim.send_signal(signal.SIGTERM)
        output, errors = sim.communicate(timeout=PATIENCE_S)
        assert time.monotonic() - begun_s < PATIENCE_S
    assert (sim.returncode, errors) == (0, f"daqsvc sim: playing shaft on unixbus {path}\n")
    summary = json.loads(output)
    assert not summary["complete"]
    assert 0 < summary["streams"]["shaft"]["frames_sent"] < 3438


def test_the_same_seed_puts_the_same_bytes_on_the_bus(tmp_path: Path) -> None:
    seen = []
    for seed in (3, 3, 4):
        path = tmp_path / "can0"
        with (
            UnixBus(str(path), fd=True) as client,
            process("sim", VIRTUAL_RIG, "--bus", path, "--seed", seed, "--duration", 1, "--speed", 10) as sim,
        ):
            sim.communicate(timeout=PATIENCE_S)
            assert sim.returncode == 0
            data = []
            while (message := client.recv(0.2)) is not None:
                data.append(bytes(message.data))
            seen.append(data)
    assert len(seen[0]) == 64
    assert seen[0] == seen[1] != seen[2]


def test_a_recording_is_played_by_the_names_of_the_sensors(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    recorded = rng.uniform(-40, 40, (320, 3))
    recorded[:, 2] = -5.0
    np.savez(tmp_path / "run.npz", a=recorded[:, 0], b=recorded[:, 1], c=recorded[:, 2], fs=640.0)
    path = tmp_path / "can0"
    names = "probe-x=a,probe-y=b,keyphasor=c"
    with (
        UnixBus(str(path), fd=True) as client,
        process(
            "sim",
            VIRTUAL_RIG,
            *("--bus", path, "--recording", tmp_path / "run.npz", "--map", names),
            *("--duration", 1, "--speed", 10),
        ) as sim,
    ):
        output, errors = sim.communicate(timeout=PATIENCE_S)
        assert sim.returncode == 0, errors
        payloads = []
        while (message := client.recv(0.2)) is not None:
            payloads.append(np.frombuffer(bytes(message.data), np.uint8))
    machine = parse_machine_file(VIRTUAL_RIG.read_text(), VIRTUAL_RIG)
    decoded = assembly_drivers.frame_layout(machine, "shaft").decode(np.stack(payloads))
    # Half a second of recording fills a second of playing twice.
    assert np.abs(decoded.samples.reshape(-1, 3) - np.tile(recorded, (2, 1))).max() < 0.13
    assert json.loads(output)["streams"]["shaft"]["samples_sent"] == 640


SERIAL = """
[buses.probes]
driver = "serial"
port = "{port}"
baud = 921600
framing = "cobs"
[streams.shaft]
bus = "probes"
rate_hz = 640.0
[streams.shaft.layout]
payload_length = 64
counter = {{ byte = 0, bits = 32, counts = "samples" }}
first_byte = 4
samples_per_frame = 10
channels = [
  {{ name = "x", type = "int16", scale = 0.001 }},
  {{ name = "y", type = "int16", scale = 0.001 }},
  {{ name = "kph", type = "int16", scale = 0.001 }},
]
"""


def machine_text(buses: str) -> str:
    """The virtual rig on other buses."""
    text = VIRTUAL_RIG.read_text()
    before, rest = text.split("[buses.can0]", 1)
    _, after = rest.split("[[sensors]]", 1)
    return re.sub(r"\[mqtt\].*", "", before + buses + "[[sensors]]" + after, flags=re.DOTALL)


@pytest.fixture
def serial_file(tmp_path: Path) -> Path:
    file = tmp_path / "serial.toml"
    file.write_text(machine_text(SERIAL.format(port=tmp_path / "ttyProbes")))
    return file


async def test_a_serial_device_behind_a_pseudo_terminal(
    tmp_path: Path, scenario: Path, serial_file: Path
) -> None:
    file, machine = serial_file, load_machine_file(serial_file)
    async with running(machine, tmp_path / "store") as service:
        with process("sim", file, "--scenario", scenario) as sim:
            summary = await summary_of(sim)
        sent = summary["streams"]["shaft"]
        counted = service.figures()["streams"]["shaft"]
    assert summary["buses"] == {"probes": str(tmp_path / "ttyProbes")}
    assert sent["injected"]["silenced"] > 10
    assert sent["frames_unsent"] == 0
    assert counted["samples_received"] + counted["samples_lost"] == sent["samples_sent"] == 4480
    injected = sent["injected"]
    lost = injected["dropped"] + injected["silenced"] + injected["corrupted"]
    assert counted["samples_lost"] == PER_FRAME * lost
    assert counted["frames_duplicate"] == injected["duplicated"]
    assert not (tmp_path / "ttyProbes").is_symlink()


MODBUS = """
[buses.line]
driver = "modbus"
transport = "{transport}"
{place}
timeout_ms = 300.0
[streams.shaft]
bus = "line"
rate_hz = 640.0
[streams.shaft.layout]
way = "ring"
unit = 1
count = {{ address = 0, bits = 32 }}
address = 16
depth = 16384
poll_ms = 20.0
channels = [
  {{ name = "x", place = 0, type = "int16", scale = 0.001 }},
  {{ name = "y", place = 1, type = "int16", scale = 0.001 }},
  {{ name = "kph", place = 2, type = "int16", scale = 0.001 }},
]
"""
BAD_REPLIES = """
title = "A healthy rotor behind a bad line"
revolutions = 70.0
[plant]
kind = "rotor"
[[fault]]
kind = "link"
from_s = 1.0
to_s = 6.0
drop = 0.03
corrupt = 0.03
[[fault]]
kind = "delay"
from_s = 2.0
to_s = 4.0
delay_ms = 5.0
"""


@pytest.fixture(params=["tcp", "rtu"])
def modbus_file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    (tmp_path / "replies.toml").write_text(BAD_REPLIES)
    place = {
        "tcp": f'host = "127.0.0.1"\ntcp_port = {free_port()}',
        "rtu": f'serial_port = "{tmp_path / "ttyLine"}"\nbaud = 115200\nparity = "none"',
    }[request.param]
    file = tmp_path / "modbus.toml"
    file.write_text(machine_text(MODBUS.format(transport=request.param, place=place)))
    return file


async def test_a_modbus_unit_hands_out_every_sample_however_bad_its_replies(
    tmp_path: Path, modbus_file: Path
) -> None:
    machine = load_machine_file(modbus_file)
    async with running(machine, tmp_path / "store") as service:
        with process("sim", modbus_file, "--scenario", tmp_path / "replies.toml") as sim:
            summary = await summary_of(sim)
        sent = summary["streams"]["shaft"]
        counted = service.figures()["streams"]["shaft"]
    injected = sent["injected"]
    assert injected.keys() >= {"dropped", "corrupted", "delayed"}
    # The ring holds 25 s: what is not read by one request is read by the next.
    assert counted["samples_lost"] == 0
    assert counted["samples_received"] == sent["samples_sent"] == 4480


def test_every_scenario_that_comes_along_can_be_read_and_says_what_goes_wrong() -> None:
    every = {path.stem: load_any_scenario(path) for path in BAD_BUS.parent.glob("*.toml")}
    assert set(every) == {"bad-bus", "bearing-damage"}
    faults = every["bad-bus"].node_faults()
    assert faults is not None
    counts = faults.plan(19_200, 640.0, samples_per_frame=PER_FRAME, length=64).injected()
    nothing = [name for name, count in asdict(counts).items() if not count]
    assert not nothing
    # The documentation has each of them.
    table = DOCUMENTATION.read_text().split("| `kind` |")[1]
    named = re.findall(r"^\| `([a-z-]+)` \|", table, flags=re.MULTILINE)
    assert sorted(named) == sorted({fault.kind for fault in every["bad-bus"].fault})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "name a machine file or a scenario to play, or a bus to run"),
        (("paper", "--fs", "100"), "--fs goes with a recording"),
        (("paper", "--port", "70000"), "70000 is not a TCP port"),
        (
            ("nothing",),
            "there is no scenario 'nothing': neither a file nor one of healthy",
        ),
        ((VIRTUAL_RIG, "--stream", "wave"), "has no stream 'wave'; there are shaft"),
        ((ROOT / "config" / "scenarios" / "bearing-damage.toml",), "a bearing needs sensors"),
        (
            (VIRTUAL_RIG, "--scenario", ROOT / "config" / "scenarios" / "bearing-damage.toml"),
            "sensor 'probe-x' is of type 'proximity', and a bearing scenario gives accelerometers",
        ),
        (
            (ROOT / "config" / "machines" / "motor-accelerometer.toml",),
            "sensor 'accel-de' is of type 'accelerometer', and a rotor scenario gives proximity probes",
        ),
        ((VIRTUAL_RIG, "--bus", "/nowhere/can0", "--duration", "1"), "no bus can be made at /nowhere/can0"),
    ],
)
def test_what_cannot_be_played_says_why(arguments: tuple[object, ...], message: str) -> None:
    with process("sim", *arguments) as sim:
        output, errors = sim.communicate(timeout=PATIENCE_S)
    assert sim.returncode in {1, 2}
    assert message in errors
    assert "Traceback" not in errors
    assert output == ""
