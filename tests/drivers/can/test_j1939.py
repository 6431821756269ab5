"""A J1939 accelerometer on a virtual CAN bus: found by parameter group and source, whatever the priority."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from typing import TYPE_CHECKING

import can
import numpy as np
import pytest
from support.bus_tables import can_bus
from support.machine_files import MACHINES, changed, problems_of

from daqsvc.acquisition.clock import SystemClock
from daqsvc.acquisition.samples import Quality
from daqsvc.cli import main
from daqsvc.settings import load_machine_file
from drivers.base import BusPort, StreamSpec
from drivers.can.batches import EXTENDED, CanBatch, IdMatch
from drivers.can.dbc import layout_from_dbc
from drivers.can.driver import CanDriver
from drivers.can.other_source import other_sources
from drivers.can.plugin import frame_layout

if TYPE_CHECKING:
    import threading
    from pathlib import Path

    from daqsvc.acquisition.samples import SampleBlock

pytestmark = pytest.mark.integration
PUMP_SET = MACHINES / "j1939-accelerometer.toml"
GROUP_AND_SOURCE = 0xFF0380


async def test_frames_of_any_priority_are_one_stream() -> None:
    layout = frame_layout(load_machine_file(PUMP_SET), "housing")
    blocks: list[SampleBlock] = []
    bus_table = can_bus(interface="virtual", channel="j1939", options={"receive_own_messages": False})
    specs = [StreamSpec("housing", layout, 100.0, 0)]
    driver = CanDriver(bus_table, BusPort("can0", specs, SystemClock(), blocks.append))
    task = asyncio.create_task(driver.run())
    with can.Bus(interface="virtual", channel="j1939") as bus:
        while driver.link.state != "up":
            await asyncio.sleep(0.001)
        for k in range(32):
            payload = struct.pack("<3hBB", k, -k, 1000, 0xFF, k)
            bus.send(can.Message(arbitration_id=(k % 8) << 26 | GROUP_AND_SOURCE, data=payload))
        bus.send(can.Message(arbitration_id=0x18FF0381, data=bytes(8)))  # another source
        bus.send(can.Message(arbitration_id=0x18FF0480, data=bytes(8)))  # another parameter group
        async with asyncio.timeout(20):
            while driver.counters.frames_unknown < 2:
                await asyncio.sleep(0.001)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    samples = np.concatenate([block.samples for block in blocks])
    expected = np.array([[k, -k, 1000] for k in range(32)]) * 0.001
    np.testing.assert_allclose(samples, expected, rtol=1e-6)
    assert driver.streams["housing"][0].samples_lost == 0
    assert set(driver.counters.unknown_ids) == {"0x18ff0381 (29 bit)", "0x18ff0480 (29 bit)"}


class Played:
    """A bus that has heard a device for ten seconds, and hears nothing more."""

    error_classes = 0
    recovers = True

    def __init__(self, sent: np.ndarray, begin_ns: int) -> None:
        lateral = 32_000 + sent % 1000
        payloads = np.zeros((len(sent), 64), np.uint8)
        payloads[:, :8] = (
            np.column_stack([lateral, lateral, np.full_like(sent, 0xFFFF), sent * 0])
            .astype("<u2")
            .view(np.uint8)
        )
        ids = np.full(len(sent), 0x0CF02DE2 | EXTENDED, np.uint32)
        arrival_ns = begin_ns + sent * 10_000_000
        self._parts = [
            CanBatch(
                ids[k : k + 7], np.full(len(ids[k : k + 7]), 8), payloads[k : k + 7], arrival_ns[k : k + 7]
            )
            for k in range(0, len(sent), 7)
        ]
        self.left = len(self._parts)

    def read(self, timeout_s: float) -> CanBatch:
        if not self.left:
            time.sleep(timeout_s)
            return CanBatch(
                np.zeros(0, np.uint32), np.zeros(0, int), np.zeros((0, 64), np.uint8), np.zeros(0, int)
            )
        self.left -= 1
        return self._parts[-1 - self.left]

    def gather(self, stopping: threading.Event) -> None:
        pass

    def close(self) -> None:
        pass


async def test_the_standard_message_has_no_counter_and_its_loss_is_told_all_the_same() -> None:
    machine = load_machine_file(MACHINES / "j1939-pgn61485.toml")
    blocks: list[SampleBlock] = []
    sent = np.delete(np.arange(1000), [*range(200, 230), 500])
    clock = SystemClock()
    source = Played(sent, clock.monotonic_ns() - 20_000_000_000)
    specs = [StreamSpec("foot", frame_layout(machine, "foot"), 100.0)]
    port = BusPort("can0", specs, clock, blocks.append)
    driver = CanDriver(can_bus(interface="played", channel="x"), port, lambda _port, _sorter: source)
    task = asyncio.create_task(driver.run())
    async with asyncio.timeout(20):
        while driver.streams["foot"][0].frames_received < len(sent):
            await asyncio.sleep(0.001)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    counters = driver.streams["foot"][0]
    assert (counters.samples_received, counters.samples_lost, counters.gaps) == (969, 31, 2)
    assert counters.values_absent == 969  # the vertical sensor is not fitted
    for block in blocks:
        index = np.arange(block.first_index, block.end_index)
        np.testing.assert_allclose(block.samples[:, 0], (index % 1000) * 0.01, atol=1e-4)
        assert np.isnan(block.samples[:, 2]).all()
    lossy = [block for block in blocks if block.lost_before]
    assert all(block.quality & Quality.LOSS_ESTIMATED for block in lossy)


def test_a_message_of_a_j1939_data_base_has_any_priority(tmp_path: Path) -> None:
    path = tmp_path / "j1939.dbc"
    path.write_text(
        'VERSION ""\nBU_: N\n'
        f"BO_ {0x98FF0380} Accel: 8 N\n"
        ' SG_ X : 0|16@1- (0.001,0) [0|0] "g" N\n SG_ Count : 56|8@1+ (1,0) [0|0] "" N\n'
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\n'
    )
    layout = layout_from_dbc(path, "Accel", counter="Count", counts="frames", channels={"x": ["X"]})
    match = IdMatch.of(layout)
    assert all(priority << 26 | GROUP_AND_SOURCE | EXTENDED in match for priority in range(8))
    assert GROUP_AND_SOURCE not in match  # of 11 bits


ENGINE = (
    'VERSION ""\nBU_: N\n'
    f"BO_ {0x98FEF2FE} Engine: 8 N\n"
    ' SG_ Speed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" N\n'
    ' SG_ Oil : 16|8@1+ (1,-40) [-40|210] "degC" N\n'
    ' SG_ Level : 40|16@1+ (0.01,0) [0|655.35] "mm/s" N\n'
)
"""With the ranges of SAE J1939, but for the last; which format it has is not stated."""


def test_ranges_of_j1939_mark_values_that_are_none_where_the_file_states_no_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "engine.dbc"
    path.write_text(ENGINE)
    channels = {one.lower(): [one] for one in ("Speed", "Oil", "Level")}
    layout = layout_from_dbc(path, "Engine", counter=None, counts="frames", channels=channels)
    assert layout.valid_raw == {"speed": (0.0, 0xFAFF), "oil": (0.0, 0xFA)}
    path.write_text(ENGINE.replace(f"{0x98FEF2FE}", "801"))  # of 11 bits
    assert not layout_from_dbc(path, "Engine", counter=None, counts="frames", channels=channels).valid_raw

    path.write_text(ENGINE)
    file = tmp_path / "engine.toml"
    given = ["--yes", "--bus=can-dbc", f"--dbc={path}", "--rate=10"]
    assert main(["new", f"{file}", *given]) == 0
    capsys.readouterr()
    assert main(["check", f"{file}"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "channel signals no value (SAE J1939)" in shown
    assert "Oil Oil raw values above 0xFA Speed Speed raw values above 0xFAFF" in shown


def test_a_message_of_another_source_address_is_named_with_the_number_to_write() -> None:
    messages = {"Engine": 0x18FEF2FE, "Fan": 0x18FEF3FE}
    [words] = other_sources([0x0CFEF221, 0x18FF0021], messages)
    assert words == (
        "0x0CFEF221 is Engine from the source address 0x21; in the DBC file it has 0xFE (SAE J1939). Remedy: "
        f"in a copy of the DBC file write BO_ {0x8CFEF221} in place of BO_ {0x98FEF2FE}"
    )


def test_a_priority_needs_an_id_that_has_one() -> None:
    text, _ = changed(PUMP_SET, ("extended = true", "extended = false"), ("0x18ff0380", "0x380"))
    (problem,) = problems_of(text, PUMP_SET)
    assert problem.key == "streams.housing.layout.any_priority"


def test_streams_that_differ_only_in_priority_are_one() -> None:
    text = PUMP_SET.read_text(encoding="utf-8")
    begin, end = text.index("[streams.housing]"), text.index("[[sensors]]")
    second = text[begin:end].replace("housing", "second").replace("0x18ff", "0x0cff")
    for other in (second, second.replace("any_priority = true", "any_priority = false")):
        (problem,) = problems_of(text[:end] + other + text[end:], PUMP_SET)
        assert problem.key == "streams.second.layout.id"
        assert "belongs to stream" in problem.message
