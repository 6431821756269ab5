"""The Modbus examples: checked, described, and run as a service against a device on a virtual line."""

from __future__ import annotations

import asyncio
import struct
import tomllib

import numpy as np
import pytest
from support.live_service import running, watch_of
from support.machine_files import MACHINES, problems_of
from support.waiting import eventually

from daqsvc.acquisition.clock import SystemClock
from daqsvc.commands.status_text import status_text
from daqsvc.control import ask_status
from daqsvc.settings import describe, load_machine_file, parse_machine_file
from drivers.make import bus_drivers, stream_layout
from drivers.modbus.channel_table import channel_table, manual_number
from drivers.modbus.driver import ModbusDriver
from drivers.modbus.line import WriteRefusedError
from drivers.modbus.registers import RegisterRecord
from drivers.modbus.settings import FifoLayout, RegistersLayout
from sim_hw.nodes.modbus_node import ModbusNode, ModbusRtuServer, ModbusTcpServer
from sim_hw.nodes.modbus_unit import ModbusUnit
from sim_hw.nodes.pacing import RealTimePacer

pytestmark = pytest.mark.integration
PUMP = MACHINES / "modbus-vibration-temperature.toml"
GAPS = MACHINES / "modbus-gap-voltages.toml"


def edited(path, *changes):
    text = path.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    return text


async def test_probes_on_an_analogue_module_are_read_by_the_service(tmp_path):
    unit = ModbusUnit()
    server = ModbusTcpServer({1: unit})
    await server.start()
    where = f'host = "127.0.0.1"\ntcp_port = {server.port}'
    text = edited(GAPS, ('host = "192.0.2.20"', where), ("rate_hz = 10.0", "rate_hz = 50.0"))
    machine = parse_machine_file(text, GAPS)
    layout = stream_layout(machine, "gap")
    record = RegisterRecord.of(layout)
    (run,) = record.runs
    assert (run.address, run.count) == (0, 2)
    gap_v = np.stack([np.linspace(-12.0, -8.0, 60), np.linspace(-8.5, -11.5, 60)], axis=1)
    # From the beginning, however long the service takes before the ramp is played.
    unit.put(layout.table, run.address, record.encode(gap_v[:1], clip=True)[0])
    async with running(machine, tmp_path) as service:
        node = ModbusNode(unit, layout, gap_v, 50.0)
        await node.play(RealTimePacer(SystemClock()))
        counters = service.drivers[0].streams["gap"][0]
        await eventually(lambda: counters.samples_received > 60, "the ramp has been polled")
        ring = watch_of(service).rings["gap"]
        seen = ring.read(ring.oldest_index, ring.end_index - ring.oldest_index)
        assert service.figures()["buses"]["io"]["up"] == 1
        assert service.figures()["buses"]["io"]["timeouts"] == 0
    server.stop()
    # 0.61 mV a count: the ends of the ramps are there to half of that.
    assert seen[~np.isnan(seen[:, 0])][-1] == pytest.approx([-8.0, -11.5], abs=0.00031)
    polled = seen[~np.isnan(seen[:, 0]), 0]  # a poll that a busy machine came too late for is a row of NaN
    assert (np.diff(polled) >= 0.0).all()


async def test_alarm_and_status_say_why_a_stream_has_not_begun(tmp_path):
    unit = ModbusUnit()
    unit.map("holding", 100, 2)  # not where the machine file looks
    server = ModbusTcpServer({1: unit})
    await server.start()
    where = f'host = "127.0.0.1"\ntcp_port = {server.port}'
    machine = parse_machine_file(edited(GAPS, ('host = "192.0.2.20"', where)), GAPS)
    async with running(machine, tmp_path) as service:
        alarms = service.alarms.manager.alarms
        await eventually(lambda: "sensor-ok/probe-x" in alarms, "nothing comes of the stream")
        message = alarms["sensor-ok/probe-x"].message
        [status] = await asyncio.to_thread(ask_status, tmp_path, None)
    server.stop()
    why = (
        "no samples of stream 'gap': unit 1 refuses function 3: illegal data address (registers 0 to 1); "
        "compare address and table with the register map of the device; what a map that begins at 1 calls "
        "101 is address 100 here"
    )
    assert why in message
    assert "of gap for" not in message
    text = " ".join(status_text(status, 200).split())
    assert "gap io - of 10 - no samples yet" in text
    assert why in text
    assert status["buses"]["io"]["reason"].startswith(why.removeprefix("no samples of "))
    assert status["buses"]["io"]["state"] == "up"


async def test_a_fault_is_told_of_the_streams_that_have_it_and_until_it_is_over(tmp_path):
    unit = ModbusUnit()
    unit.map("holding", 0, 1)
    server = ModbusTcpServer({1: unit})
    await server.start()
    other = 'channels = [{ name = "y", address = 40, type = "uint16" }]'
    streams = f"""[streams.gap]
bus = "io"
rate_hz = 20.0
layout = {{ way = "registers", unit = 1, channels = [{{ name = "x", address = 0, type = "uint16" }}] }}
[streams.other]
bus = "io"
rate_hz = 20.0
layout = {{ way = "registers", unit = 1, {other} }}
"""
    text = f"""schema_version = 1
site = "s"
box = "b"
[machine]
name = "m"
speed_rpm = 600.0
[buses.io]
driver = "modbus"
transport = "tcp"
host = "127.0.0.1"
tcp_port = {server.port}
{streams}
[[sensors]]
name = "x"
type = "trend"
stream = "gap"
channel = "x"
unit = "V"
"""
    (driver,) = bus_drivers(parse_machine_file(text, tmp_path / "m.toml"), SystemClock(), lambda _block: None)
    task = asyncio.create_task(driver.run())
    await eventually(lambda: driver.link.why_silent("other"), "the unit refuses")
    assert driver.link.state == "up"
    assert "register 40" in driver.link.why_silent("other")
    assert not driver.link.why_silent("gap")
    unit.map("holding", 40, 1)
    await eventually(lambda: not driver.link.why_silent("other"), "the unit answers")
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    server.stop()
    assert driver.link.why_silent("gap") == "it was stopped"


async def test_a_reply_of_the_vibration_sensor_means_what_its_maker_says(tmp_path):
    # Registers 16 to 21 of a QM42VT1 in a published example: 0.0046 in/s, 0.108 mm/s, 78.65 F, 25.9 C,
    # 0.0071 in/s, 0.182 mm/s.
    unit = ModbusUnit()
    unit.map("holding", 0, 64)
    unit.put("holding", 16, bytes.fromhex("002E006C06250206004700B6"))
    unit.put("holding", 32, struct.pack(">6H", 0, 1500, 0, 600, 0, 2500))
    link = tmp_path / "ttyUSB0"
    server = ModbusRtuServer({1: unit}, link)
    server.start()
    text = edited(PUMP, ("/dev/ttyUSB0", str(link)), ("rate_hz = 1.0", "rate_hz = 20.0"))
    machine = parse_machine_file(text, PUMP)
    async with running(machine, tmp_path) as service:
        received = lambda name: service.drivers[0].streams[name][0].samples_received  # noqa: E731
        await eventually(lambda: min(received("drive-end"), received("other-end")) > 5, "both are polled")
        first = (
            watch_of(service).rings["drive-end"].read(watch_of(service).rings["drive-end"].oldest_index, 1)[0]
        )
        other = (
            watch_of(service).rings["other-end"].read(watch_of(service).rings["other-end"].oldest_index, 1)[0]
        )
        polls = service.drivers[0].counters.requests
        assert polls < received("drive-end") + received("other-end"), "one request reads both sensors"
    server.stop()
    assert first == pytest.approx([0.108, 0.182, 25.9])
    assert other == pytest.approx([1.5, 2.5, 30.0])


async def test_nothing_is_written_but_what_the_machine_file_allows():
    unit = ModbusUnit()
    unit.map("holding", 490, 20)
    server = ModbusTcpServer({1: unit})
    await server.start()
    allowed = "timeout_ms = 200.0\nwrites = [{ unit = 1, address = 500, count = 2 }]"
    where = f'host = "127.0.0.1"\ntcp_port = {server.port}'
    text = edited(GAPS, ('host = "192.0.2.20"', where), ("timeout_ms = 200.0", allowed))
    machine = parse_machine_file(text, GAPS)
    (driver,) = bus_drivers(machine, SystemClock(), lambda _block: None)
    assert isinstance(driver, ModbusDriver)
    task = asyncio.create_task(driver.run())
    await eventually(lambda: driver.link.state == "up", "the line is up")
    await driver.write(1, 500, [7, 8])
    assert unit.get("holding", 500, 2) == b"\0\7\0\10"
    for number, address, values in [(1, 501, [1, 2]), (1, 499, [1]), (2, 500, [1])]:
        with pytest.raises(WriteRefusedError, match=rf"registers {address} to .* of unit {number} must not"):
            await driver.write(number, address, values)
    assert unit.get("holding", 499, 4) == b"\0\0\0\7\0\10\0\0"
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    server.stop()


@pytest.mark.parametrize("path", [PUMP, GAPS], ids=lambda path: path.stem)
def test_the_examples_say_what_line_they_are_on(path):
    machine = load_machine_file(path)
    assert "Modbus" in describe(machine)
    assert "values polled in holding registers" in describe(machine)


CHANNELS = """[
  { name = "velocity", address = 16, type = "float32", order = "CDAB" },
  { name = "level", address = 9999, type = "int16", scale = 0.1, offset = -40, no_value = [0x7FFF, -32768] },
  { name = "trip", address = 3, type = "uint16", order = "BADC", bits = [3, 1] },
]"""


def test_check_shows_each_channel_as_a_manual_has_it():
    layout = tomllib.loads(f'way = "registers"\nunit = 7\nchannels = {CHANNELS}')
    head, *rows = channel_table(RegistersLayout.model_validate(layout))
    velocity, level, trip = ({key: cell for key, cell in zip(head, row, strict=True) if cell} for row in rows)
    assert list(velocity.values()) == ["velocity", "7", "holding", "16", "40017", "float32", "CDAB", "1"]
    assert (level["manual"], level["scale"], level["offset"]) == ("410000", "0.1", "-40")
    assert level["no_value"] == "0x7FFF, 0x8000"
    assert (trip["order"], trip["bits"]) == ("BADC", "3")
    assert [manual_number("input", one) for one in (0, 9998, 65_535)] == ["30001", "39999", "365536"]
    shown = describe(load_machine_file(PUMP))
    assert "\nChannels of drive-end\n  name         unit  table    address  manual  type    scale\n" in shown
    assert "\n  temperature  1     holding  19       40020   int16   0.05\n" in shown


def test_check_shows_no_more_channels_than_a_person_reads():
    many = ", ".join(f'{{ name = "c{k}", address = {k}, type = "int16" }}' for k in range(70))
    text = f"""
schema_version = 1
site = "lab"
box = "edge-1"
machine = {{ name = "fan", speed_rpm = 1480.0 }}
buses.a = {{ driver = "modbus", transport = "tcp", host = "127.0.0.1" }}

[streams.b]
bus = "a"
rate_hz = 1.0
layout = {{ way = "registers", unit = 1, channels = [{many}] }}

[[sensors]]
name = "s"
type = "trend"
stream = "b"
channel = "c0"
unit = "mm/s"

[pipeline]
ring_s = 600.0
"""
    shown = describe(parse_machine_file(text, GAPS))
    assert "\n  c63   1     holding  63       40064   int16  1\n  ... and 6 more\n" in shown


def test_one_channel_is_no_channels():
    one = FIFO.replace(', { name = "y", place = 1, type = "int16" }', "")
    assert FifoLayout.model_validate(tomllib.loads(one)).summary.startswith("1 channel from a FIFO")
    assert FifoLayout.model_validate(tomllib.loads(FIFO)).summary.startswith("2 channels from a FIFO")


RING = """
way = "ring"
unit = 1
count = { address = 0 }
address = 16
depth = 64
channels = [{ name = "x", place = 0, type = "int16" }, { name = "y", place = 1, type = "int16" }]
"""
REGISTERS = GAPS.read_text(encoding="utf-8").split("[streams.gap.layout]")[1].split("[[sensors]]")[0]


FIFO = RING.replace('"ring"', '"fifo"').replace("depth = 64\n", "").replace("count = { address = 0 }\n", "")
WAVEFORM = FIFO.replace('"fifo"', '"waveform"') + "block_id = 0\nsamples = 1024\n"


@pytest.mark.parametrize(
    ("layout", "key", "message"),
    [
        (RING.replace("64", "65"), "depth", "is not a power of two"),
        (RING.replace("64", "65537"), "depth", "must be 32768 or less. Remedy: write depth = 256"),
        (
            RING.replace('place = 1, type = "int16"', 'place = 124, type = "int32"'),
            "channels",
            "room for 125",
        ),
        (RING.replace("address = 16", "address = 65_500"), "address", "leaves no room"),
        (RING.replace("depth = 64", "depth = 32_768"), "address", "leaves no room"),
        (RING.replace('"ring"', '"rings"'), "way", "registers"),
        (REGISTERS.replace("unit = 1", "unit = 1\nforbidden = [[1, 4]]"), "channels[1].address", "forbidden"),
        (
            REGISTERS.replace("offset = -20.0 },    # V", "bits = [10, 7] },"),
            "channels[0].bits",
            "no part of",
        ),
        (FIFO + "acknowledge = 9", "acknowledge", "does not allow it"),
        (WAVEFORM + "trigger = { address = 9 }", "trigger.address", "does not allow it"),
        (WAVEFORM + "page = { select = 9, registers = 100 }", "page.select", "does not allow it"),
    ],
)
def test_what_does_not_fit_is_told(layout, key, message):
    text = GAPS.read_text(encoding="utf-8").replace(REGISTERS, layout + "\n")
    problems = problems_of(text, GAPS)
    found = [problem for problem in problems if problem.key == f"streams.gap.layout.{key}"]
    assert found, [str(problem) for problem in problems]
    assert message in str(found[0])


def test_a_layout_of_registers_needs_a_modbus_line_and_the_other_way_round():
    text = edited(GAPS, ('driver = "modbus"\ntransport = "tcp"\nhost = "192.0.2.20"\ntimeout_ms = 200.0',
                         'driver = "can"\ninterface = "socketcan"\nchannel = "can0"'))  # fmt: skip
    assert any("is no Modbus line" in problem.message for problem in problems_of(text, GAPS))
    can = '[streams.gap.layout]\nid = 1\nlength = 8\ncounter = { byte = 0, bits = 8, counts = "frames" }\n'
    can += 'first_byte = 1\nsamples_per_frame = 1\nchannels = [{ name = "x", type = "int16", scale = 1.0 }, '
    can += '{ name = "y", type = "int16", scale = 1.0 }]\n'
    text = GAPS.read_text(encoding="utf-8").replace("[streams.gap.layout]" + REGISTERS, can)
    assert any("its bus is a Modbus line" in problem.message for problem in problems_of(text, GAPS))
