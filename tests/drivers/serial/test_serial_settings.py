"""Serial ports in machine files: what is read, what is refused, and with which words."""

from __future__ import annotations

import numpy as np
import pytest
from support.machine_files import MACHINES, changed, parsed, problems_of

from daqsvc.settings import MachineFileError, load_machine_file, parse_machine_file
from drivers.make import bus_drivers, stream_layout
from drivers.serial.driver import SerialDriver
from drivers.serial.settings import CobsBus, LineLayout, LinesBus, SerialLayout

SERIAL = MACHINES / "serial-probes.toml"
COBS = 'framing = "cobs"                 # "cobs", "sync" (with sync_word = "a55a") or "lines"'
LAYOUT = "payload_length = 64\n"
LINE = 'line = ["seq", "v", "h"]\n'
COUNTER = (
    'counter = { column = "seq", bits = 16 }    # or, without one: time = { column = "t", unit = "ms" }\n'
)
PORT = '"/dev/serial/by-id/usb-Raspberry_Pi_Pico_E66118604B826C2A-if00"'


def test_the_example_as_it_is_read():
    machine = load_machine_file(SERIAL)
    probes, casing = machine.buses["probes"], machine.buses["casing"]
    assert isinstance(probes, CobsBus)
    assert isinstance(casing, LinesBus)
    assert (probes.bits_per_character, probes.crc_bytes, casing.delimiter) == (10, 2, "\n")
    assert isinstance(machine.streams["shaft"].layout, SerialLayout)
    assert isinstance(machine.streams["casing"].layout, LineLayout)
    packed = stream_layout(machine, "shaft")
    samples = packed.decode(np.zeros((1, 64), np.uint8)).samples
    np.testing.assert_allclose(samples[0, 0], [10 / 7.87e-3, 10 / 7.87e-3, 0.0], rtol=1e-6)
    lines = stream_layout(machine, "casing")
    assert isinstance(lines, LineLayout)
    assert lines.counter is not None
    assert (lines.prefix, lines.counter.column, lines.counter.bits) == ("$ACC", "seq", 16)


def test_the_driver_is_found_by_its_name():
    from daqsvc.acquisition.clock import SystemClock

    drivers = bus_drivers(load_machine_file(SERIAL), SystemClock(), lambda _: None)
    assert [type(driver) for driver in drivers] == [SerialDriver, SerialDriver]


@pytest.mark.parametrize(
    ("old", "new", "key", "message", "remedy"),
    [
        (COBS, "", "buses.probes.framing", "is missing", 'framing = "cobs"'),
        (COBS, 'framing = "slip"', "buses.probes.framing", "must be", 'framing = "cobs"'),
        (COBS, 'framing = "sync"', "buses.probes.sync_word", "is missing", 'sync_word = "a55a"'),
        (
            COBS,
            COBS + '\nsync_word = "a5"',
            "buses.probes.sync_word",
            "belongs to a serial port",
            "remove it",
        ),
        (
            COBS,
            'framing = "sync"\nsync_word = "a5z"',
            "buses.probes.sync_word",
            "is not 1 to 8 bytes in hexadecimal",
            'e.g. "a55a"',
        ),
        (PORT, '"ttyUSB0"', "buses.casing.port", "is not the whole path", "/dev/ttyUSB0"),
        ("baud = 3_000_000", "baud = 115_200", "buses.probes.baud", "is too slow", "a faster rate"),
        (
            LAYOUT,
            "payload_length = 60\n",
            "streams.shaft.layout.first_byte",
            "bytes 4 to 63",
            "payload_length = 64",
        ),
        ("first_byte = 4", "first_byte = 2", "streams.shaft.layout.first_byte", "would overlap", "byte 4"),
        (
            LAYOUT,
            LAYOUT + "stream_id = 1\n",
            "streams.shaft.layout.stream_id",
            "has no effect",
            "stream_ids = true",
        ),
        (
            COBS,
            COBS + "\nstream_ids = true",
            "streams.shaft.layout.stream_id",
            "is missing: frames on bus",
            "stream_id = 1",
        ),
        (
            LAYOUT,
            "id = 0x101\nlength = 64\n",
            "streams.shaft.layout",
            "is no layout of a binary serial frame",
            "payload_length",
        ),
        (
            'bus = "casing"',
            'bus = "probes"',
            "streams.casing.layout",
            "is no layout of a binary",
            "payload_length",
        ),
        ('bus = "probes"', 'bus = "casing"', "streams.shaft.layout", "carries lines", "line ="),
        (COUNTER, "", "streams.casing.layout", "has neither counter nor time", "counter = {"),
        (COUNTER, "", "streams.casing.layout", "has neither counter nor time", "no_counter = true"),
        (
            COUNTER,
            COUNTER + "no_counter = true\n",
            "streams.casing.layout.no_counter",
            "contradicts counter",
            "leave it out",
        ),
        ('column = "seq"', 'column = "sek"', "streams.casing.layout.counter.column", "no such column", "seq"),
        (
            LINE,
            'line = ["seq", "v", "hh"]\n',
            "streams.casing.layout.channels[1].name",
            "no such column",
            "hh",
        ),
        (
            LINE,
            'line = ["seq", "v", "h", "seq"]\n',
            "streams.casing.layout.line[3]",
            "earlier",
            "own name",
        ),
        (LINE, LINE + 'decimal = ","\n', "streams.casing.layout.decimal", "is the separator too", '";"'),
        *(
            (
                '{ name = "v" }',
                f'{{ name = "v", suffix = "{suffix}" }}',
                "streams.casing.layout.channels[0].suffix",
                message,
                remedy,
            )
            for suffix, message, remedy in (
                ("mm,s", 'has the separator "," in it', "a separate column in line"),
                (" mm/s", "cannot be the text behind a number", 'e.g. "mm/s"'),
                ("12", "cannot be the text behind a number", 'e.g. "mm/s"'),
                ("m\\u0007", "cannot be the text behind a number", 'e.g. "mm/s"'),
            )
        ),
        (
            '{ name = "v" }',
            '{ name = "v", prefix = "12" }',
            "streams.casing.layout.channels[0].prefix",
            "cannot be the text in front of a number",
            'e.g. "V="',
        ),
        (
            '{ name = "v" }',
            f'{{ name = "v", prefix = "{"V" * 33}" }}',
            "streams.casing.layout.channels[0].prefix",
            "must have 32 characters at most",
            'write prefix = "V="',
        ),
        (
            'column = "seq", bits = 16 }',
            'column = "seq", bits = 16, prefix = "n," }',
            "streams.casing.layout.counter.prefix",
            'has the separator "," in it',
            "a separate column in line",
        ),
        (
            'prefix = "$ACC"',
            'prefix = "$A,C"',
            "streams.casing.layout.prefix",
            'has the separator "," in it',
            "a separate column in line",
        ),
        (
            'prefix = "$ACC"',
            'prefix = "$A*C"',
            "streams.casing.layout.prefix",
            "cannot be the first field of a line",
            "up to the first separator",
        ),
        (LINE, LINE + 'separator = "."\n', "streams.casing.layout.separator", "cannot stand between", '";"'),
        (
            LINE,
            LINE + 'time = { column = "seq", unit = "ms" }\n',
            "streams.casing.layout.time",
            "has no effect beside counter",
            "remove time",
        ),
    ],
)
def test_each_mistake_is_named_once_with_its_remedy(old, new, key, message, remedy):
    text, _ = changed(SERIAL, (old, new))
    found = [p for p in problems_of(text, SERIAL) if key in str(p)]
    assert len(found) == 1, problems_of(text, SERIAL)
    assert message in str(found[0])
    assert remedy in str(found[0])


def test_a_port_with_a_number_is_a_warning():
    (warning,) = parsed(SERIAL, (PORT, '"/dev/ttyUSB0"')).warnings
    assert "may be another device once a port has been re-plugged" in str(warning)
    assert "/dev/serial/by-id" in str(warning)


TIMED = 'line = ["t", "v", "h"]\n', 'time = {{ column = "t", unit = "{}" }}\n'


@pytest.mark.parametrize(
    ("unit", "rate_hz", "period", "finer"),
    [
        ("ms", 1000.5, "0.9995", "us"),
        ("ms", 2000.0, "0.5", "us"),
        ("s", 200.0, "0.005", "ms"),
        ("s", 400.0, "0.0025", "us"),
    ],
)
def test_a_time_that_several_lines_may_share_is_a_warning(unit, rate_hz, period, finer):
    line, time = TIMED
    edits = ((LINE, line), (COUNTER, time.format(unit)), ("rate_hz = 200.0", f"rate_hz = {rate_hz}"))
    (warning,) = parsed(SERIAL, *edits, ("baud = 115_200", "baud = 921_600")).warnings
    assert f'streams.casing.layout.time.unit = "{unit}": is longer than the {period} {unit} from' in str(
        warning
    )
    assert f"if the device sends whole {unit}, several lines have the same time" in str(warning)
    assert f'{finer} with unit = "{finer}"' in str(warning)


def test_a_time_that_is_hardly_finer_than_the_lines_is_a_warning():
    line, time = TIMED
    edits = ((LINE, line), (COUNTER, time.format("ms")), ("rate_hz = 200.0", "rate_hz = 970.0"))
    (warning,) = parsed(SERIAL, *edits, ("baud = 115_200", "baud = 921_600")).warnings
    assert "hardly shorter than the 1.031 ms from line to line" in str(warning)
    assert 'us with unit = "us"' in str(warning)


@pytest.mark.parametrize(("unit", "rate_hz"), [("ms", 1000.0), ("ms", 900.0), ("us", 2000.0)])
def test_a_time_that_tells_each_line_from_the_next_is_no_warning(unit, rate_hz):
    line, time = TIMED
    edits = ((LINE, line), (COUNTER, time.format(unit)), ("rate_hz = 200.0", f"rate_hz = {rate_hz}"))
    assert not parsed(SERIAL, *edits, ("baud = 115_200", "baud = 921_600")).warnings


def test_lines_with_neither_counter_nor_time_are_a_warning():
    machine = parsed(SERIAL, (COUNTER, "no_counter = true\n"))
    (warning,) = machine.warnings
    assert "streams.casing.layout.no_counter = true: lets lost lines be estimated" in str(warning)
    assert "if it can send neither, leave it" in str(warning)
    assert machine.streams["casing"].layout.summary == "$ACC, 2 of 3 columns, no count"


def test_a_port_belongs_to_one_bus():
    text, _ = changed(
        SERIAL, (PORT, '"/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_FT1AB2C3-if00-port0"')
    )
    (problem,) = problems_of(text, SERIAL)
    assert 'belongs to bus "probes" already' in str(problem)


def test_two_streams_of_a_port_have_marks_of_their_own():
    second = '[streams.more]\nbus = "probes"\nrate_hz = 1000.0\n[streams.more.layout]\npayload_length = 64\n'
    text = SERIAL.read_text()
    body = text[text.index("counter = { byte") : text.index("[buses.casing]")]
    text = text.replace("[buses.casing]", second + body + "[buses.casing]")
    (problem,) = problems_of(text, SERIAL)
    assert 'does not tell this stream from "shaft"' in str(problem)
    ids = text.replace(COBS, COBS + "\nstream_ids = true").replace(
        "payload_length = 64", "stream_id = 1\npayload_length = 64"
    )
    (problem,) = problems_of(ids, SERIAL)
    assert 'does not tell this stream from "shaft"' in str(problem)
    good = ids.replace(
        "1000.0\n[streams.more.layout]\nstream_id = 1", "1000.0\n[streams.more.layout]\nstream_id = 2"
    )
    assert parse_machine_file(good, SERIAL).streams["more"].layout.stream_id == 2


RTU_BUS = """[buses.{name}]
driver = "modbus"
transport = "rtu"
serial_port = "{port}"
baud = 9600
"""
RTU_STREAM = """
[streams.{name}]
bus = "{name}"
rate_hz = 1.0
[streams.{name}.layout]
way = "registers"
unit = 1
channels = [{{ name = "v", address = 0, type = "uint16" }}]
"""


def test_a_port_belongs_to_one_bus_whatever_it_carries_and_whatever_it_is_called(tmp_path):
    (tmp_path / "ttyUSB0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    text = SERIAL.read_text(encoding="utf-8").replace(PORT, f'"{tmp_path / "ttyUSB0"}"')
    for name, port in (("one", tmp_path / "by-id"), ("other", "/dev/ttyS7"), ("third", "/dev/ttyS7")):
        text += RTU_BUS.format(name=name, port=port) + RTU_STREAM.format(name=name)
    found = "\n".join(map(str, problems_of(text, SERIAL)))
    for name, owner in (("one", "casing"), ("third", "other")):
        assert f'buses.{name}.serial_port = "' in found
        assert f'belongs to bus "{owner}" already' in found


def suffixed(suffix: str, unit: str, *, more: str = "", kind: str = "trend", sensor: str = "") -> list[str]:
    """What check finds in a file whose device writes that unit behind the number of that sensor."""
    text, _ = changed(
        SERIAL,
        ('channels = [{ name = "v" }', f'channels = [{{ name = "v", suffix = "{suffix}"{more} }}'),
        (
            'type = "accelerometer"\nstream = "casing"\nchannel = "v"\nunit = "g"',
            f'type = "{kind}"\nstream = "casing"\nchannel = "v"\nunit = "{unit}"\n{sensor}',
        ),
    )
    try:
        warnings = parse_machine_file(text, SERIAL).warnings
    except MachineFileError as error:
        return [f"{problem}" for problem in error.problems if "behind the number" in f"{problem}"]
    return [f"warning: {one}" for one in warnings if "behind the number" in f"{one}"]


@pytest.mark.parametrize(
    ("suffix", "unit", "more", "words"),
    [
        ("mm/s", "in/s", "", ['"mm/s" behind the number', 'as "in/s"', "25.4", 'unit = "mm/s"', "0.0393701"]),
        ("mm/s", "in/s", ", scale = 0.03937", []),
        ("mm/s", "in/s", ", scale = 0.5", ["warning", "factor of 12.7"]),
        ("mm/s", "in/s", ", scale = -0.03937", []),  # turned round
        ("mm/s", "in/s", ", scale = -0.5", ["warning", "factor of 12.7"]),
        ("mm/s RMS", "mm/s", "", []),
        ("°C", "degF", "", ['unit = "degC"', "scale and offset"]),
        ("°C", "degF", ", scale = 1.8, offset = 32.0", []),
        ("C", "degC", "", []),
        ("°", "degC", "", []),
        ("Hz", "rpm", "", ["factor of 60"]),
        ("mA", "bar", "", ["warning", "correct suffix"]),
        ("mA", "bar", ", scale = 0.625, offset = -2.5", []),
        ("Grad", "degC", "", []),
    ],
)
def test_a_unit_behind_the_number_is_compared_with_that_of_the_sensor(suffix, unit, more, words):
    found = suffixed(suffix, unit, more=more)
    assert len(found) == bool(words), found
    for word in words:
        assert word in found[0]
    if words:
        assert "F40" in found[0]
        assert ("warning" in found[0]) == ("warning" in words)


def test_of_a_sensor_in_volts_the_unit_behind_the_number_is_a_voltage():
    volts = {"kind": "accelerometer", "sensor": "sensitivity_mv_per_unit = 100.0\n"}
    assert not suffixed("V", "g", **volts)
    [found] = suffixed("mV", "g", **volts)
    assert 'takes it as "V": wrong by a factor of 1000' in found
    assert 'write scale = 0.001 in the channel "v"' in found
    [found] = suffixed("mm/s2", "g", kind="accelerometer")
    assert "factor of 9807" in found
