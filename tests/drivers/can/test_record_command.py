"""``daqsvc record`` on the virtual bus between processes, stopped and killed."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import subprocess
import sys
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import can
import pytest
from support.can_recordings import numbers
from support.examples import first_of
from support.formats import fits
from support.given_codes import had
from support.paths import ROOT
from support.ports import free_port
from support.waiting import PATIENCE_S, eventually, eventually_blocking

from daqsvc.acquisition.link import Link
from daqsvc.cli import main
from daqsvc.commands import record
from daqsvc.commands.arguments import signals_to_end
from daqsvc.commands.record import ENDINGS
from drivers.can.errors import CanCounters
from sim_hw.bus_socket import UnixBus
from sim_hw.bus_socket_hub import Hub

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.integration
RIG = ROOT / "config" / "machines" / "virtual-rig.toml"
FRAMES = 300


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    text = RIG.read_text(encoding="utf-8").replace("/tmp/daqsvc-can0", str(tmp_path / "bus"))  # noqa: S108
    path = tmp_path / "machine.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[UnixBus]:
    hub = Hub(str(tmp_path / "bus"))
    hub.start()
    try:
        with UnixBus(str(tmp_path / "bus"), fd=True, hub="join") as end:
            yield end
    finally:
        hub.stop()


@contextlib.contextmanager
def recording(*arguments: str | Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "daqsvc", "record", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def refused(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main(["record", *map(str, arguments)]) == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    return said


def send(bus: UnixBus, first: int, frames: int) -> None:
    for number in range(first, first + frames):
        bus.send(can.Message(arbitration_id=0x300, is_extended_id=False, data=number.to_bytes(8, "little")))


def send_until_it_is_recorded(bus: UnixBus, log: Path) -> int:
    """Send frames of number 0 until one is in the file: then the recorder listens. How many were sent."""
    sent = 0

    def arrived() -> bool:
        nonlocal sent
        send(bus, 0, 1)
        sent += 1
        return log.exists() and log.stat().st_size > 0

    eventually_blocking(arrived, "nothing is recorded")
    return sent


@pytest.mark.parametrize("ending", first_of(*ENDINGS))
def test_what_is_recorded_is_printed_when_it_is_stopped(
    bus: UnixBus, machine: Path, tmp_path: Path, ending: str
) -> None:
    log = tmp_path / f"run{ending}"
    with recording(machine, "--out", log) as process:
        sent = send_until_it_is_recorded(bus, log)
        send(bus, 1, FRAMES)
        eventually_blocking(lambda: _last(log) == FRAMES, "the frames do not come into the file")
        # All of them end it alike; SIGHUP comes when its terminal goes.
        process.send_signal(signals_to_end()[ENDINGS.index(ending) % len(signals_to_end())])
        output, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    assert said.startswith("recording CAN bus 'can0' ")
    assert f" in {log}; Ctrl-C ends it\n" in said
    summary = fits("daqsvc record", json.loads(output))
    found = numbers(log)
    assert [number for number in found if number] == list(range(1, FRAMES + 1))
    assert len(found) <= sent + FRAMES
    assert (summary["bus"], summary["files"]) == ("can0", [str(log)])
    assert (summary["frames_recorded"], summary["frames_unrecorded"]) == (len(found), 0)
    assert summary["bytes"] == log.stat().st_size
    assert summary["frames_unknown"] == len(found)
    assert summary["streams"]["shaft"] == {"samples_received": 0, "samples_lost": 0}


@pytest.mark.parametrize("ending", first_of(".blf", ".asc", ".log"))
def test_a_recorder_that_is_killed_leaves_what_it_has_written(
    bus: UnixBus, machine: Path, tmp_path: Path, ending: str
) -> None:
    log = tmp_path / f"run{ending}"
    with recording(machine, "--bus", "can0", "--out", log) as process:
        send_until_it_is_recorded(bus, log)
        send(bus, 1, FRAMES)
        eventually_blocking(lambda: _last(log) == FRAMES, "the frames do not come into the file")
        process.kill()
    with can.LogReader(log) as reader:
        times = [message.timestamp for message in reader]
    assert [number for number in numbers(log) if number] == list(range(1, FRAMES + 1))
    assert times == sorted(times)
    if ending != ".asc":
        assert abs(times[0] - log.stat().st_mtime) < PATIENCE_S, "the file does not say when it was recorded"


def _last(log: Path) -> int:
    """The last number in a file that is being written; its end may be half a line."""
    try:
        return numbers(log)[-1]
    except (IndexError, ValueError):
        return -1


@pytest.mark.parametrize("where", ["terminal", "pipe"])
async def test_how_a_recording_gets_on_is_said_meanwhile(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    is_terminal = where == "terminal"
    monkeypatch.setattr(record, "LIVE_S" if is_terminal else "LOGGED_S", 0.01)
    monkeypatch.setattr("sys.stderr.isatty", lambda: is_terminal)
    driver: Any = SimpleNamespace(link=Link("the bus"), counters=CanCounters(frames_recorded=12_345))
    telling = asyncio.create_task(record._Progress(driver, tmp_path / "run.blf").tell())
    said = ""

    def has_told() -> bool:
        nonlocal said
        said += capsys.readouterr().err
        return said.count("frames recorded") > 1

    await eventually(has_told, "it tells again")
    driver.link.down("it is gone")
    driver.counters.frames_unrecorded = 7
    await eventually(lambda: has_told() and "7 not; it is gone" in said, "what goes wrong is said")
    telling.cancel()
    await asyncio.gather(telling, return_exceptions=True)
    said += capsys.readouterr().err
    assert said.startswith(f"recording the bus in {tmp_path}/run.blf; Ctrl-C ends it\n12,345 frames recorded")
    assert ("\r" in said, said.endswith("\n")) == (is_terminal, True)


def test_it_ends_after_the_time_that_is_given(bus: UnixBus, machine: Path, tmp_path: Path) -> None:
    with recording(machine, "--out", tmp_path / "run.log", "--duration", "0.5") as process:
        output, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "has carried no frame" in said
    assert said.endswith("[C20]\n")
    had("C20", said)
    assert json.loads(output)["files"] == []
    assert not (tmp_path / "run.log").exists()
    assert bus.recv(0) is None


def test_what_cannot_be_recorded_is_said_in_one_line(
    machine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "taken.blf"
    taken.write_bytes(b"")
    assert "is there already" in refused(capsys, machine, "--out", taken)
    assert "ends in none of .blf, .asc, .log" in refused(capsys, machine, "--out", tmp_path / "run.mf4")
    assert "there is no folder" in refused(capsys, machine, "--out", tmp_path / "nowhere" / "run.log")
    assert "has no CAN bus of this name; CAN buses" in refused(
        capsys, machine, "--bus", "can1", "--out", tmp_path / "run.log"
    )
    modbus = RIG.parent / "modbus-gap-voltages.toml"
    assert "there is none" in refused(capsys, modbus, "--out", tmp_path / "run.log")


@pytest.mark.long
def test_the_service_records_while_it_watches(machine: Path, tmp_path: Path) -> None:
    folder = tmp_path / "can"
    folder.mkdir()
    text = machine.read_text(encoding="utf-8").replace(
        "fd = true\n", 'fd = true\nrecord = { folder = "can", format = "candump" }\n'
    )
    text = text.replace("127.0.0.1:1883", f"127.0.0.1:{free_port()}")
    machine.write_text(text, encoding="utf-8")
    daqsvc = [sys.executable, "-m", "daqsvc"]
    with subprocess.Popen([*daqsvc, "run", str(machine), "--store", str(tmp_path / "store")]) as service:
        try:
            eventually_blocking((tmp_path / "bus").exists, "the service does not open its bus")
            command = [*daqsvc, "sim", str(machine), "--scenario", "healthy", "--duration", "2"]
            done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
            sent = fits("daqsvc sim", json.loads(done.stdout))["streams"]["shaft"]["samples_sent"]
            eventually_blocking(lambda: _last_count(folder) == sent - 10, "the last frame is not recorded")
            service.send_signal(signal.SIGTERM)
            assert service.wait(PATIENCE_S) == 0
        finally:
            service.kill()
    assert _counts(folder) == list(range(0, sent, 10))


def _counts(folder: Path) -> list[int]:
    """The counters of the rig's frames in the only file of a folder."""
    [path] = folder.iterdir()
    lines = path.read_text(encoding="ascii").splitlines()
    return [int.from_bytes(bytes.fromhex(line.split("##")[1][1:5]), "little") for line in lines]


def _last_count(folder: Path) -> int:
    try:
        return _counts(folder)[-1]
    except (IndexError, ValueError):
        return -1
