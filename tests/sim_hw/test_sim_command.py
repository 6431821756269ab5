"""``daqsvc sim`` on the virtual CAN bus, and what clients make of what it plays."""

from __future__ import annotations

import asyncio
import json
import re
import shlex
import signal
import struct
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.brokers import Consumer
from support.formats import fits
from support.live_service import running, watch_of
from support.machine_files import MACHINES, MOTOR
from support.sim_processes import DOCUMENTATION, PER_FRAME, SCENARIOS, VIRTUAL_RIG, process, summary_of
from support.waiting import PATIENCE_S, eventually

from daqsvc.alarms.states import Level
from daqsvc.settings import parse_machine_file
from drivers.can.plugin import frame_layout
from sim_hw.bus_socket import UnixBus
from sim_hw.scenario import load_any_scenario
from sim_hw.sim_signals import BearingSignals

if TYPE_CHECKING:
    from pathlib import Path

    from support.brokers import Mosquitto

pytestmark = pytest.mark.integration
MOTOR_ALARMS = ("drive-end-rms", "drive-end-peak")


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


def status_of(consumer: Consumer) -> dict[str, Any]:
    status = consumer.on("/status")
    return status[-1].payload["figures"] if status else {}


def figures(consumer: Consumer, group: str, name: str, figure: str) -> Any:
    return status_of(consumer).get(group, {}).get(name, {}).get(figure)


@pytest.mark.long
@pytest.mark.mosquitto
async def test_run_counts_to_the_sample_what_sim_has_sent_and_spoilt(
    tmp_path: Path, bad_link: Path, mosquitto: Mosquitto
) -> None:
    machine = rig_file(tmp_path, tmp_path / "can0", mosquitto.port)
    async with Consumer(mosquitto.port) as consumer:
        places = {
            "config/machines/virtual-rig.toml": machine,
            "~/daqsvc-virtual": tmp_path / "store",
            "paper": bad_link,
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


@pytest.mark.long
@pytest.mark.mosquitto
async def test_a_bus_that_is_killed_comes_back_and_the_books_still_close(
    tmp_path: Path, mosquitto: Mosquitto
) -> None:
    path = tmp_path / "can0"
    machine = rig_file(tmp_path, path, mosquitto.port)
    async with Consumer(mosquitto.port) as consumer:
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
    summary = fits("daqsvc sim", json.loads(output))
    assert not summary["complete"]
    assert 0 < summary["streams"]["shaft"]["frames_sent"] < 3438


@pytest.mark.long
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
    decoded = frame_layout(machine, "shaft").decode(np.stack(payloads))
    # Half a second of recording fills a second of playing twice.
    assert np.abs(decoded.samples.reshape(-1, 3) - np.tile(recorded, (2, 1))).max() < 0.13
    assert json.loads(output)["streams"]["shaft"]["samples_sent"] == 640


@pytest.mark.long
async def test_a_bearing_that_is_damaged_arrives_value_by_value(tmp_path: Path) -> None:
    path, damage = tmp_path / "can0", tmp_path / "damage.toml"
    damage.write_text((SCENARIOS / "bearing-damage.toml").read_text().replace("at_s = 10.0", "at_s = 2.5"))
    text = MOTOR.read_text().partition("[mqtt]")[0]
    text = text.replace('"socketcan"', '"unixbus"').replace('channel = "can0"', f'channel = "{path}"')
    file = tmp_path / "motor.toml"
    file.write_text(text)
    machine = parse_machine_file(text, file)
    async with running(machine, tmp_path / "store") as service:
        await eventually(lambda: service.drivers[0].link.state == "up", "the bus is up")
        alarms, ring = service.alarms.manager.alarms, watch_of(service).rings["drive-end"]
        with process("sim", file, "--scenario", damage, "--seed", 7, "--duration", 6) as sim:
            await eventually(lambda: ring.end_index > 28_000, "2.3 s of a healthy bearing have come")
            before = {name: alarms[name].level for name in MOTOR_ALARMS if name in alarms}
            summary = await summary_of(sim)
        sent = summary["streams"]["drive-end"]["samples_sent"]
        await eventually(lambda: ring.end_index == sent, "every sample has come")
        await eventually(
            lambda: all(alarms[name].level is Level.ALERT for name in MOTOR_ALARMS), "both alarms stand"
        )
        counted = service.figures()["streams"]["drive-end"]
        received = ring.read(0, sent)[:, 0]
    assert set(before.values()) <= {Level.NORMAL}
    assert sent == 72_000
    assert (counted["samples_received"], counted["samples_lost"]) == (sent, 0)
    played = BearingSignals(load_any_scenario(damage), 6.0, 7).of(machine.sensor("accel-de"), 12_000.0)
    largest_g = 2**15 * 0.0005
    np.testing.assert_allclose(received, np.clip(played, -largest_g, largest_g), atol=0.00051)


@pytest.mark.long
def test_a_gap_in_a_recording_is_sent_as_not_available(tmp_path: Path) -> None:
    lateral, vertical = np.linspace(-5.0, 5.0, 100), np.full(100, 9.8)
    lateral[40:60] = np.nan
    np.savez(tmp_path / "run.npz", l=lateral, v=vertical, fs=100.0)
    path = tmp_path / "can0"
    names = "accel-lateral=l,accel-vertical=v"
    recording = ("--recording", tmp_path / "run.npz", "--map", names)
    with (
        UnixBus(str(path)) as client,
        process("sim", MACHINES / "j1939-pgn61485.toml", "--bus", path, *recording, "--speed", 10) as sim,
    ):
        _, errors = sim.communicate(timeout=PATIENCE_S)
        assert sim.returncode == 0, errors
        raw = []
        while (message := client.recv(0.2)) is not None:
            raw.append(struct.unpack("<3H", message.data[:6]))
    sent_lateral, _, sent_vertical = np.array(raw).T
    assert (sent_lateral == 0xFFFF).tolist() == np.isnan(lateral).tolist()
    assert sent_lateral[0] == 31_500  # (-5 m/s2 + 320 m/s2) / 0.01 m/s2
    assert set(sent_vertical) == {32_980}
    np.savez(tmp_path / "probes.npz", p=lateral, fs=640.0)
    probes = ("--recording", tmp_path / "probes.npz", "--map", "probe-x=p,probe-y=p,keyphasor=p")
    with process("sim", VIRTUAL_RIG, "--bus", path, *probes) as sim:
        output, errors = sim.communicate(timeout=PATIENCE_S)
    assert (sim.returncode, output) == (1, "")
    assert "channel 'x': nan does not fit a 16-bit signed field" in errors
    assert "Traceback" not in errors
