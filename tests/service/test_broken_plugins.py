"""Plugins of others that fail while the service runs: one sentence for each cause, and all others go on."""

from __future__ import annotations

import json
import logging
import math
from typing import TYPE_CHECKING, Any, Never

import pytest
from support.example_packages import installed
from support.live_service import running, watch_of
from support.waiting import eventually

from daqsvc.acquisition.assembler import StreamCounters
from daqsvc.acquisition.timebase import TimeBaseState
from daqsvc.commands import service_manager
from daqsvc.detectors.levels.detector import LevelDetector
from daqsvc.detectors.levels.trends import TrendDetector
from daqsvc.publish.make import watched
from daqsvc.settings import parse_machine_file
from drivers.base import BusCounters

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

pytestmark = pytest.mark.integration

PROJECT = """
[project]
name = "daqsvc-mishap"
version = "2.1"

[project.entry-points."daqsvc.drivers"]
mishap = "mishap:MishapDriverPlugin"

[project.entry-points."daqsvc.detectors"]
mishap = "mishap:MishapPlugin"
"""
SOURCE = """
import asyncio
import itertools
import time

import numpy as np

from daqsvc.api import BusCounters, Link
from daqsvc.api import Bus, DetectorPlugin, DriverPlugin, PackedLayout, Section, StreamDriver, WindowDetector


class MishapBus(Bus):
    kind = "a bus of mishaps"
    how: str


class MishapDriver(StreamDriver):
    def __init__(self, how, port):
        super().__init__(port, f"mishap {port.name!r}")
        self.how, self.count = how, itertools.count()

    async def read(self):
        self.link.up()
        begun_s, number = time.monotonic(), 0
        while True:
            frame = np.zeros((1, 8), np.uint8)
            frame[0, :4] = np.frombuffer(next(self.count).to_bytes(4, "little"), np.uint8)
            self.take(self.port.streams[0], frame if self.how != "takes" else None)
            number += 1
            await asyncio.sleep(max(0.0, begun_s + 0.005 * number - time.monotonic()))
            if self.how == "raises":
                raise KeyError("it was here")
            if self.how == "exits":
                raise SystemExit(0)
            if self.how == "returns":
                return None


class OwnDriver:
    def __init__(self, how, port):
        self.name, self.link, self.counters, self.streams = port.name, Link(port.name), BusCounters(), {}
        self.how = how

    async def run(self):
        if self.how == "own raises":
            raise KeyError("it was here")
        if self.how == "own exits":
            raise SystemExit(0)


class MishapDriverPlugin(DriverPlugin[MishapBus]):
    buses, layouts = (MishapBus,), (PackedLayout,)

    def build(self, bus, port):
        return (OwnDriver if bus.how.startswith("own") else MishapDriver)(bus.how, port)


class Mishap(Section):
    sensor: str
    how: str


class MishapDetector(WindowDetector):
    def __init__(self, machine, settings):
        super().__init__(machine, "mishap", [settings.sensor], window_s=0.05)
        self.how = settings.how
        if self.how == "process":
            self.process = lambda window: [1]

    def judge(self, samples):
        if self.how == "raises":
            raise ZeroDivisionError(f"mean {np.random.rand()}")
        return None


class MishapPlugin(DetectorPlugin[Mishap]):
    settings, about, detector = Mishap, "mishaps", "mishap"

    def build(self, machine, settings, store):
        return [MishapDetector(machine, settings)]
"""
STREAM = """
[buses.{name}]
driver = "mishap"
how = "{how}"

[streams.{name}]
bus = "{name}"
rate_hz = 200.0
[streams.{name}.layout]
frame_bytes = 8
counter = {{ byte = 0, bits = 32, counts = "samples" }}
first_byte = 4
samples_per_frame = 1
channels = [{{ name = "x", type = "int16", scale = 1.0 }}]

[[sensors]]
name = "{name}"
type = "accelerometer"
stream = "{name}"
channel = "x"
unit = "g"
"""
MACHINE = """
schema_version = 1
site = "lab"
box = "edge-1"
[machine]
name = "fan-1"
speed_rpm = 1480.0
[pipeline.mishap]
sensor = "good"
how = "{how}"
[[alarms]]
name = "mishaps"
detector = "mishap"
"""


@pytest.fixture(autouse=True)
def _installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    package = tmp_path / "package"
    package.mkdir()
    (package / "pyproject.toml").write_text(PROJECT)
    (package / "mishap.py").write_text(SOURCE)
    yield from installed(package, tmp_path / "site", monkeypatch)


def line_of(words: str) -> int:
    return SOURCE.splitlines().index(words) + 1


EXITED = line_of("                raise SystemExit(0)")
READ = line_of("    async def read(self):")
RAISED = line_of('                raise KeyError("it was here")')
TAKEN = line_of('            self.take(self.port.streams[0], frame if self.how != "takes" else None)')
JUDGE = line_of("    def judge(self, samples):")
JUDGED = line_of('            raise ZeroDivisionError(f"mean {np.random.rand()}")')
PROCESS = line_of("            self.process = lambda window: [1]")


def errors_of_plugins(log: pytest.LogCaptureFixture) -> list[str]:
    """What was said as an error, but of a busy computer, where the end takes longer than it may."""
    errors = [record for record in log.records if record.levelno >= logging.ERROR]
    said = [record.getMessage() for record in errors if not record.name.startswith("daqsvc.outbox")]
    return [line for line in said if not line.endswith("is left behind")]


@pytest.mark.gives("B31", "S09")
@pytest.mark.parametrize(
    ("driver", "detector", "by_driver", "by_detector"),
    [
        (
            "raises",
            "raises",
            f"read of mishap.MishapDriver has failed: KeyError: 'it was here' (mishap.py, line {RAISED})",
            f"(mishap.py, line {JUDGED})",
        ),
        (
            "exits",
            "raises",
            f"read of mishap.MishapDriver has failed: SystemExit: 0 (mishap.py, line {EXITED})",
            f"(mishap.py, line {JUDGED})",
        ),
        (
            "returns",
            "returns",
            f"Driver has failed: it returns None, not why the link was lost (mishap.py, line {READ})",
            f"Detector has failed: it returns None, not Judgement (mishap.py, line {JUDGE})",
        ),
        (
            "takes",
            "process",
            f"take() is given None; give it an array of uint8 [n, 8] of bad (mishap.py, line {TAKEN})",
            f"it returns [1], not Sequence[Diagnosis] (mishap.py, line {PROCESS})",
        ),
    ],
)
async def test_a_driver_and_a_detector_that_fail_are_named_once_and_the_rest_goes_on(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    driver: str,
    detector: str,
    by_driver: str,
    by_detector: str,
) -> None:
    text = MACHINE.format(how=detector) + "".join(
        STREAM.format(name=name, how=how) for name, how in {"good": "", "bad": driver}.items()
    )
    async with running(parse_machine_file(text, tmp_path / "machine.toml"), tmp_path / "store") as service:
        bad = next(one for one in service.drivers if one.name == "bad")
        counters = watch_of(service).pipeline.counters["mishap"]
        await eventually(lambda: bad.link.losses >= 3, "the driver has been tried again and again")
        await eventually(lambda: counters.failures >= 3, "windows have failed")
        heard = watch_of(service).rings["good"].end_index
        await eventually(
            lambda: watch_of(service).rings["good"].end_index > heard + 20, "the other bus goes on"
        )
        assert service.supervisor.failures["detector mishap"] >= 3
    said = errors_of_plugins(caplog)
    for begins, words, then in (
        ("mishap 'bad': ", by_driver, "it is being tried again"),
        ("detector mishap: ", by_detector, "it goes on with the next window"),
    ):
        [line] = [line for line in said if words in line]
        assert line.startswith(begins)
        assert line.endswith(f"; have the authors of daqsvc-mishap 2.1 fix it; {then}")
    assert len(said) == 2
    assert not any(record.exc_info for record in caplog.records if record.levelno > logging.INFO)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("own raises", "KeyError: 'it was here'"),
        ("own exits", "SystemExit: 0"),
        ("own ends", "it has ended by itself"),
    ],
)
async def test_a_driver_with_a_run_of_its_own_is_named_once_and_started_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, how: str, said: str
) -> None:
    text = MACHINE.partition("[pipeline.mishap]")[0] + STREAM.format(name="bad", how=how)
    async with running(parse_machine_file(text, tmp_path / "machine.toml"), tmp_path / "store") as service:
        await eventually(lambda: service.supervisor.failures["driver bad"] >= 3, "it was started again")
    [line] = errors_of_plugins(caplog)
    assert line.startswith(f"driver bad: run of mishap.OwnDriver has failed: {said} (mishap.py, line ")
    assert line.endswith("have the authors of daqsvc-mishap 2.1 fix it; it is started again")


@pytest.mark.parametrize("levels", [LevelDetector, TrendDetector])
async def test_levels_and_trends_that_fail_blame_no_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, levels: Any
) -> None:
    def failing(*_: object) -> Never:
        raise ZeroDivisionError

    text = MACHINE.partition("[pipeline.mishap]")[0] + STREAM.format(name="good", how="")
    text += "[pipeline.levels]\nwindow_s = 0.1\nvelocity_band_hz = [10.0, 80.0]\n"
    text += '[[alarms]]\nname = "vibration"\nsensor = "good"\nmeasure = "rms"\nalert = 5.0\n'
    if levels is TrendDetector:
        text = text.replace('type = "accelerometer"', 'type = "trend"').replace('"rms"', '"value"')
    monkeypatch.setattr(levels, "process", failing)
    machine = parse_machine_file(text, tmp_path / "machine.toml")
    async with running(machine, tmp_path / "store") as service:
        alarms = service.alarms.manager.alarms
        await eventually(lambda: "detector-ok/levels/good" in alarms, "it is raised")
        assert alarms["detector-ok/levels/good"].state.is_active
        assert "sensor-ok/good" not in alarms
    assert watched(machine).rests_on["vibration"] == ("sensor-ok/good", "detector-ok/levels/good")


def _failing(_: object) -> Never:
    raise KeyError("no figures")


SPOILT: dict[str, tuple[Callable[[Any], object], str]] = {
    "counters-none": (
        lambda bad: setattr(bad, "counters", None),
        "counters of mishap.MishapDriver is None, not a count; ",
    ),
    "counters-text": (
        lambda bad: setattr(bad.counters, "frames_unknown", "many"),
        "frames_unknown of mishap.MishapDriver is 'many', not a count; ",
    ),
    "unknown_ids": (
        lambda bad: setattr(bad.counters, "unknown_ids", {(1, 2): 3}),
        "unknown_ids of mishap.MishapDriver is {(1, 2): 3}, not counts by name; ",
    ),
    "unknown_ids-none": (
        lambda bad: setattr(bad.counters, "unknown_ids", None),
        "unknown_ids of mishap.MishapDriver is None, not counts by name; ",
    ),
    "link-none": (lambda bad: setattr(bad, "link", None), "link of mishap.MishapDriver is None, not Link; "),
    "link-reason": (
        lambda bad: setattr(bad.link, "reason", 7),
        "reason of the link of mishap.MishapDriver is 7, not a text; ",
    ),
    "streams-none": (
        lambda bad: setattr(type(bad), "streams", None),
        "streams of mishap.MishapDriver is None, not counters and clock by stream; ",
    ),
    "streams-raises": (
        lambda bad: setattr(type(bad), "streams", property(_failing)),
        "streams of mishap.MishapDriver has failed: KeyError: 'no figures'; ",
    ),
    "streams-other": (
        lambda bad: setattr(type(bad), "streams", {"else": (StreamCounters(), CLOCK)}),
        "streams of mishap.MishapDriver is 'else', not one of bad; ",
    ),
    "streams-one": (
        lambda bad: setattr(type(bad), "streams", {"bad": StreamCounters()}),
        "stream bad of mishap.MishapDriver is StreamCounters(frames_received=0, ",
    ),
    "streams-count": (
        lambda bad: setattr(type(bad), "streams", {"bad": (StreamCounters(gaps=None), CLOCK)}),
        "gaps of stream bad of mishap.MishapDriver is None, not a count; ",
    ),
    "streams-clock": (
        lambda bad: setattr(
            type(bad), "streams", {"bad": (StreamCounters(), CLOCK._replace(period_ns=math.nan))}
        ),
        "period_ns of stream bad of mishap.MishapDriver is nan, not a finite number; ",
    ),
}
CLOCK = TimeBaseState(1e6, 0.0, 0.0, settled=True, restarts=0)


@pytest.mark.parametrize("spoilt", SPOILT)
async def test_what_a_driver_tells_wrong_is_named_once_and_spares_the_other_buses(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, spoilt: str
) -> None:
    spoil, said = SPOILT[spoilt]
    text = MACHINE.partition("[pipeline.mishap]")[0]
    text += "".join(STREAM.format(name=name, how="") for name in ("good", "bad"))
    async with running(parse_machine_file(text, tmp_path / "machine.toml"), tmp_path / "store") as service:
        bad: Any = next(one for one in service.drivers if one.name == "bad")
        # One of its own, so that the other driver has what it had.
        bad.__class__ = type("MishapDriver", (type(bad),), {"__module__": "mishap"})
        link = bad.link
        await eventually(lambda: link.state == "up", "it delivers")
        spoil(bad)
        for _ in range(3):
            service.alarms.tick()
            figures = service.figures()
            assert figures["buses"].keys() == {"good", "bad"}
            assert figures["buses"]["good"]["up"] == 1
            assert "good" in figures["streams"]
            assert json.dumps(figures["buses"])
            assert {"driver good", "driver bad"} <= service.progress().keys()
            assert service.awaited(patient=False) == {}
            assert watch_of(service)._why_over("bad") == ""
            assert "buses up" in service_manager._in_short(service)[0]
        bad.link, bad.counters, type(bad).streams = link, BusCounters(), {}
    [line] = errors_of_plugins(caplog)
    assert line.startswith(f"driver bad: {said}")
    assert "; have the authors of daqsvc-mishap 2.1 fix it; " in line
