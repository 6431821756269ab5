"""The worked examples as wheels of their own, installed outside the tree as others install theirs."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from support.example_packages import DETECTOR, DRIVER, OUTPUT
from support.paths import ROOT

pytestmark = [pytest.mark.integration, pytest.mark.long, pytest.mark.sources]

DETECTED = """
[pipeline.crest]
sensor = "casing-x"
alert = 5.0

[[alarms]]
name = "knocks"
detector = "crest"

[event_file]
path = "events.jsonl"
"""
# Frames of 30 samples with a knock among them, sent to the driver; its samples given to the detector; what
# that says, to the alarms, which the output tells.
RUN = """
import asyncio, json, sys, numpy as np, tcp_frames, crest, event_file
from pathlib import Path
from daqsvc import api
from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarm_service import AlarmService
from daqsvc.alarms.manager import AlarmManager
from daqsvc.alarms.events import Identity
from daqsvc.alarms.make import alarm_rule
from daqsvc.detectors.make import detectors
from daqsvc.publish.make import output_set
from daqsvc.settings import load_machine_file, parse_machine_file
from drivers.make import bus_drivers, stream_layout

async def main():
    path = Path(sys.argv[1])
    layout = stream_layout(load_machine_file(path), "casing")
    signal = np.tile([100.0, -100.0], 600)
    signal[500] = 5000.0
    rows = np.stack([signal, signal], axis=1).reshape(-1, 30, 2)
    frames = layout.encode(30 * np.arange(len(rows)), rows).tobytes()
    async def serve(reader, writer):
        for at in range(0, len(frames), 1280):
            writer.write(frames[at : at + 1280])
            await asyncio.sleep(0.3)
        await reader.read()
        writer.close()
    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    machine = parse_machine_file(path.read_text().replace("4001", str(port)), path)
    blocks = []
    [driver] = bus_drivers(machine, SystemClock(), blocks.append)
    assert isinstance(driver, tcp_frames.LoggerDriver), driver
    running = asyncio.create_task(driver.run())
    while sum(len(block.samples) for block in blocks) < 1000:
        await asyncio.sleep(0.02)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    server.close()
    [detector] = [one for one in detectors(machine) if one.name == "crest"]
    assert isinstance(detector, crest.CrestDetector), detector
    samples = np.concatenate([block.samples for block in blocks])[:1000]
    [said] = detector.process(api.Window(0, samples, 10**9, 1e6))
    identity = Identity(machine.site, machine.box, machine.machine.name)
    rules = [alarm_rule(alarm) for alarm in machine.alarms]
    manager = AlarmManager(identity, rules, SystemClock())
    alarms = AlarmService(manager, path.parent / "store", SystemClock(), output_set(machine))
    output = alarms.outputs["event_file"]
    assert isinstance(output, event_file.EventFileOutput), output
    await alarms.open()
    await alarms.resume({identity.machine: {"crest": ("casing-x",)}})
    telling = asyncio.create_task(output.run())
    alarms.take(said)
    events = path.parent / "events.jsonl"
    while not events.exists() or not events.read_text():
        await asyncio.sleep(0.02)
    telling.cancel()
    await asyncio.gather(telling, return_exceptions=True)
    await alarms.settle(2.0)
    await alarms.close(2.0)
    assert json.loads(events.read_text().splitlines()[0])["alarm"] == "knocks"
    print(said.decision, round(said.statistics["crest_factor"], 1), len(samples))

asyncio.run(main())
"""


def test_all_are_built_installed_and_run(tmp_path: Path) -> None:
    def run(*command: object) -> str:
        done = subprocess.run(  # noqa: PLW1510 - looked at below
            [str(part) for part in command],
            cwd=tmp_path, env={"PATH": "/usr/bin:/bin"}, capture_output=True, text=True, timeout=110,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    # Copies: building leaves files beside the sources.
    trees = {"daqsvc": ROOT, "driver": DRIVER, "detector": DETECTOR, "output": OUTPUT}
    spare = shutil.ignore_patterns(".*", "tests", "__pycache__", "build", "*.egg-info", "docs")
    for name, tree in trees.items():
        shutil.copytree(tree, tmp_path / name, ignore=spare)
    venv = tmp_path / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", venv)
    python = venv / "bin" / "python"
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    # Of the development environment the dependencies only: what is installed in this one comes first.
    (site / "zz_dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    run(
        *pip,
        "wheel",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        "wheels",
        *(tmp_path / name for name in trees),
    )
    wheels = sorted((tmp_path / "wheels").glob("*.whl"))
    assert len(wheels) == len(trees)
    run(*pip, "--python", python, "install", "--no-deps", "--no-index", *wheels)

    machine = tmp_path / "machine.toml"
    machine.write_text((DRIVER / "machine.toml").read_text() + DETECTED)
    told = " ".join(run(venv / "bin" / "daqsvc", "check", machine).split())
    assert "driver tcp-frames, host 127.0.0.1, tcp_port 4001" in told
    assert "crest sensor casing-x, alert 5" in told
    assert "event_file path events.jsonl" in told
    assert run(python, "-c", RUN, machine).split()[::2] == ["alert", "1000"]
    where = run(
        python,
        "-c",
        "import crest, daqsvc, event_file as e; print(crest.__file__, daqsvc.__file__, e.__file__)",
    ).split()
    assert all(Path(file).is_relative_to(site) for file in where), where
