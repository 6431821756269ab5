"""Every example machine file becomes a service, and its frames come back as they were sent."""

from __future__ import annotations

import dataclasses
import importlib.metadata
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.given_codes import had
from support.paths import ROOT

from daqsvc import cli
from daqsvc.acquisition.clock import SystemClock
from daqsvc.alarms.make import alarm_rule
from daqsvc.detectors.levels.detector import LevelDetector
from daqsvc.detectors.levels.trends import TrendDetector
from daqsvc.detectors.make import detectors
from daqsvc.settings import load_machine_file
from drivers.can.plugin import frame_layout
from drivers.frames import FrameLayout
from drivers.make import bus_drivers, stream_layout

if TYPE_CHECKING:
    from pathlib import Path

FILES = sorted((ROOT / "config" / "machines").glob("*.toml"))


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_frames_of_every_example_decode_to_the_sensors_units(file: Path) -> None:
    machine = load_machine_file(file)
    for name in machine.streams:
        layout = stream_layout(machine, name)
        if not isinstance(layout, FrameLayout):
            continue
        middle = np.tile(layout.offset, (3, 1, 1)) + 5 * layout.scale
        index = layout.samples_per_frame * np.arange(3, dtype=np.int64)
        back = layout.decode(layout.encode(index, middle))
        np.testing.assert_array_equal(back.samples, middle.astype(np.float32))
        assert back.intact.all()


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_every_example_becomes_drivers_detectors_and_rules(file: Path) -> None:
    machine = load_machine_file(file)
    made = bus_drivers(machine, SystemClock(), lambda _: None)
    assert [driver.name for driver in made] == list(machine.buses)
    assert sorted(name for driver in made for name in driver.streams) == sorted(machine.streams)
    watching = detectors(machine)
    watched = any(isinstance(detector, LevelDetector | TrendDetector) for detector in watching)
    assert watched == (machine.pipeline.levels is not None)
    assert [rule.alarm for rule in map(alarm_rule, machine.alarms)] == [
        alarm.name for alarm in machine.alarms
    ]
    for detector in watching:
        detector.warm()


def test_a_probe_reads_micrometres_from_its_gap_voltage() -> None:
    machine = load_machine_file(next(file for file in FILES if file.stem == "laval-rig"))
    layout = frame_layout(machine, "shaft")
    raw = dataclasses.replace(layout, scale=np.ones_like(layout.scale), offset=np.zeros_like(layout.offset))
    volts_per_count = machine.streams["shaft"].layout.channels[0].scale
    counts = np.full((1, layout.samples_per_frame, 3), -9.5 / volts_per_count)
    got = layout.decode(raw.encode(np.array([0]), counts)).samples
    assert got[0, 0] == pytest.approx([500 / 7.87, 500 / 7.87, -9.5], rel=1e-6)


def test_a_verb_that_cannot_be_loaded_is_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = importlib.metadata.EntryPoint("orbit", "no_such_module:Verb", cli.COMMANDS)
    monkeypatch.setattr(cli, "entry_points", lambda group: [broken])
    known = cli.commands()
    assert "orbit" not in known
    assert {"analyze", "calibrate", "check", "detectability", "run"} <= set(known)
    err = capsys.readouterr().err
    assert "verb 'orbit' is left out: No module named 'no_such_module' [C26]" in err
    had("C26", err)
