"""The example that replays a fan: what is recorded of the machine is what the example plays, in g."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.bus_tables import can_bus
from support.can_standin import StandInBus, frame_bytes
from support.paths import ROOT
from support.running_drivers import running
from support.waiting import eventually

from daqsvc.acquisition.clock import DrivenClock, SystemClock
from daqsvc.settings import load_machine_file
from drivers.base import BusPort, StreamSpec
from drivers.can.driver import CanDriver
from drivers.can.plugin import frame_layout
from drivers.can.record_files import OneLog
from drivers.make import bus_drivers

if TYPE_CHECKING:
    from pathlib import Path

    from daqsvc.acquisition.samples import SampleBlock

pytestmark = pytest.mark.integration
MACHINES = ROOT / "config" / "machines"
FRAMES = 2000


async def test_a_recording_of_the_fan_plays_through_its_dbc_file(tmp_path: Path) -> None:
    layout = frame_layout(load_machine_file(MACHINES / "dbc-triaxial.toml"), "housing")
    rng = np.random.default_rng(11)
    felt = (rng.integers(-4000, 4000, (FRAMES, 1, 3)) * 0.0005).astype(np.float32)
    payloads = layout.encode(np.arange(FRAMES), felt)
    bus = StandInBus()
    bus_table, logs = can_bus(interface="socketcan", channel="can0"), OneLog(tmp_path / "fan.blf")
    spec = StreamSpec("housing", layout, 1000.0)
    recorded = CanDriver(
        bus_table,
        BusPort("can0", [spec], SystemClock(), lambda _: None),
        open_source=bus.open,
        logs=logs,
    )
    async with running(recorded):
        for at in range(0, FRAMES, 100):
            bus.send([frame_bytes(layout.frame_id, row.tobytes()) for row in payloads[at : at + 100]])
            await eventually(lambda: recorded.streams["housing"][0].frames_received == at + 100)  # noqa: B023
    bus.close()

    text = (MACHINES / "replay-fan.toml").read_text(encoding="utf-8")
    for old, new in (("../devices", str(MACHINES.parent / "devices")), ('"recorded"', '"unpaced"')):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "m.toml").write_text(text, encoding="utf-8")
    blocks: list[SampleBlock] = []
    [driver] = bus_drivers(load_machine_file(tmp_path / "m.toml"), DrivenClock(), blocks.append)
    await driver.run()

    assert driver.link.reason == "end of file"
    played = np.concatenate([block.samples for block in blocks])
    np.testing.assert_allclose(played, felt[:, 0, 1:], atol=1e-6)
