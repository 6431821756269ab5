"""What docs/modbus.md shows can be used as it is, and the counters that it names are there."""

from __future__ import annotations

import re
import struct
from dataclasses import fields

import numpy as np
import pytest
from support.machine_files import MACHINES
from support.paths import ROOT

from daqsvc.settings import describe, parse_machine_file
from drivers.base import BusCounters
from drivers.make import stream_layout
from drivers.modbus.registers import RegisterRecord
from drivers.modbus.replies import ModbusCounters
from drivers.modbus.settings import RegistersLayout

TEXT = (ROOT / "docs" / "modbus.md").read_text(encoding="utf-8")
TREND, *PARTS = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
EXAMPLE = MACHINES / "modbus-gap-voltages.toml"
HEAD = EXAMPLE.read_text(encoding="utf-8").split("[buses.io]")[0]
LINE = next(part for part in PARTS if "writes" in part and "rtu" in part)


def test_the_machine_with_trend_values_is_whole():
    machine = parse_machine_file(TREND, EXAMPLE)
    assert stream_layout(machine, "transmitter").unit == 1
    [shown] = re.findall(r"```\n(Channels of .*?)```", TEXT, re.DOTALL)
    assert f"\n{shown}\n" in describe(machine)


def test_the_bus_over_tcp_takes_the_place_of_the_serial_line():
    [tcp] = [part for part in PARTS if "tcp_port = 502" in part and "host" in part and "rtu" not in part]
    before, after = TREND[: TREND.index("[buses.")], TREND[TREND.index("[streams.") :]
    assert parse_machine_file(f"{before}{tcp}{after}", EXAMPLE).buses["rs485"].transport == "tcp"


def test_the_parts_with_waveforms_make_a_machine():
    [part] = [part for part in PARTS if "[buses.gateway]" in part]
    machine = parse_machine_file(HEAD + part, EXAMPLE)
    assert machine.streams["bearing"].layout.block.samples == 8192


@pytest.mark.parametrize("way", ["registers", "ring", "fifo"])
def test_a_layout_fits_the_line_with_all_keys(way):
    [block] = [part for part in PARTS if f'way = "{way}"' in part]
    name = re.search(r"\[streams\.(\w+)\.layout\]", block)[1]
    channel = re.search(r'name = "(\w+)"', block)[1]
    text = f'{HEAD}{LINE}\n[streams.{name}]\nbus = "rs485"\nrate_hz = 10.0\n{block}\n'
    text += f'[[sensors]]\nname = "{name}"\ntype = "velocity"\nunit = "mm/s"\n'
    text += f'stream = "{name}"\nchannel = "{channel}"\n'
    machine = parse_machine_file(text, EXAMPLE)
    assert stream_layout(machine, name).unit == 1


def test_the_table_of_word_orders_is_right():
    rows = re.findall(r"^\| 0x(\w{4}) \| 0x(\w{4}) \| `\"(\w{4})\"`", TEXT, re.MULTILINE)
    assert {order for _, _, order in rows} == {"ABCD", "CDAB", "BADC", "DCBA"}
    for first, second, order in rows:
        channel = {"name": "x", "address": 0, "type": "float32", "order": order}
        layout = RegistersLayout(way="registers", unit=1, channels=(channel,))
        registers = struct.pack(">HH", int(first, 16), int(second, 16))
        raw = np.frombuffer(registers, np.uint8).reshape(1, -1)
        [[value]] = RegisterRecord.of(layout).decode(raw)
        assert value == 12.5


def test_every_counter_of_a_fault_is_named():
    of_any_bus = {field.name for field in fields(BusCounters)}
    named = re.search(r"Every fault has a counter.*?\n\n(.*?)\n\n", TEXT, re.DOTALL)[1]
    for field in fields(ModbusCounters):
        if field.name not in of_any_bus | {"requests", "replies"}:
            assert f"`{field.name}`" in named, field.name
