"""Buses and counters in a machine file: what cannot be served is refused before the service runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from daqsvc.settings import parse_machine_file
from daqsvc.settings.describe import describe
from daqsvc.settings.problems import MachineFileError
from drivers.can.plugin import frame_layout

if TYPE_CHECKING:
    from pathlib import Path

DBC = """VERSION ""
BU_: X
BO_ 513 Acc: 8 X
 SG_ Seq : 0|{bits}@1+ (1,0) [0|{largest}] "" X
 SG_ AX : 48|16@1- (0.001,0) [0|0] "g" X
"""
TEXT = """
schema_version = 1
site = "lab"
box = "edge-1"
[machine]
name = "fan"
speed_rpm = 600.0
[buses.can0]
driver = "can"
interface = "virtual"
channel = "fan"
[streams.casing]
bus = "can0"
rate_hz = 100.0
[streams.casing.layout]
dbc = "a.dbc"
message = "Acc"
counter = { signal = "Seq", counts = "frames" }
channels = [{ name = "x", signals = ["AX"] }]
[[sensors]]
name = "casing-x"
type = "accelerometer"
stream = "casing"
channel = "x"
unit = "g"
"""
BUS = TEXT[TEXT.index("[buses") : TEXT.index("[streams")]
PLAIN = """layout = { id = 1, length = 64, counter = { byte = 0, bits = 8, counts = "samples" }, \
first_byte = 0, samples_per_frame = 64, channels = [{ name = "x", type = "int8", scale = 1.0 }] }"""


def machine_file(folder: Path, bits: int = 8, old: str = "", new: str = "", largest: int = 0) -> Path:
    (folder / "a.dbc").write_text(DBC.format(bits=bits, largest=largest))
    assert old in TEXT
    path = folder / "fan.toml"
    path.write_text(TEXT.replace(old, new) if old else TEXT)
    return path


def test_a_driver_that_is_not_installed_is_refused_with_its_line(tmp_path: Path) -> None:
    path = machine_file(tmp_path, old=BUS, new='[buses.can0]\ndriver = "profibus"\n')
    said = (
        r'fan.toml:9: buses.can0.driver = "profibus": no such driver is installed.*can, modbus, replay, '
        "serial; or install the package that brings it"
    )
    with pytest.raises(MachineFileError, match=said):
        parse_machine_file(path.read_text(), path)


@pytest.mark.parametrize("bits", [4, 5, 12, 24, 48])
def test_a_counter_of_a_dbc_file_may_have_any_width(tmp_path: Path, bits: int) -> None:
    path = machine_file(tmp_path, bits)
    machine = parse_machine_file(path.read_text(), path)
    assert f"{bits} bit frames" in describe(machine)
    assert frame_layout(machine, "casing").counter_bits == bits


@pytest.mark.parametrize(("bits", "said"), [(1, "has 1 bit: "), (3, "has 3 bits: ")])
def test_a_counter_that_wraps_within_a_few_frames_is_refused(tmp_path: Path, bits: int, said: str) -> None:
    path = machine_file(tmp_path, bits)
    with pytest.raises(MachineFileError, match=rf"fan.toml:18: .*{said}.*4 bits or more.*no_counter = true"):
        parse_machine_file(path.read_text(), path)


@pytest.mark.parametrize(("largest", "warnings"), [(0, 0), (14, 1), (15, 0)])
def test_a_counter_that_ends_before_all_ones_is_a_warning(
    tmp_path: Path, largest: int, warnings: int
) -> None:
    path = machine_file(tmp_path, 4, largest=largest)
    found = parse_machine_file(path.read_text(), path).warnings
    assert [warning.key for warning in found] == ["streams.casing.layout.counter.signal"] * warnings
    assert all("ends at 14 by the DBC file, not at 15" in str(warning) for warning in found)


def test_a_counter_that_a_frame_takes_a_quarter_of_is_refused(tmp_path: Path) -> None:
    layout = TEXT[TEXT.index("[streams.casing.layout]") : TEXT.index("[[sensors]]")]
    path = machine_file(tmp_path, old=layout, new=f"{PLAIN}\n")
    with pytest.raises(MachineFileError, match="8 bits cannot tell frames of 64 samples apart"):
        parse_machine_file(path.read_text(), path)


def test_the_share_of_a_bus_is_shown_where_a_bit_rate_is_known(tmp_path: Path) -> None:
    path = machine_file(tmp_path)
    assert "bus (est.)" not in describe(parse_machine_file(path.read_text(), path))
    path = machine_file(tmp_path, old='channel = "fan"', new='channel = "fan"\nbitrate = 500000')
    assert "bus (est.)" in describe(parse_machine_file(path.read_text(), path))
