"""What docs/can.md, serial.md and replay.md show can be used as it is."""

from __future__ import annotations

import re

import pytest
from support.machine_files import MACHINES
from support.paths import ROOT

from daqsvc.settings import parse_machine_file

HEAD = (MACHINES / "laval-rig.toml").read_text("utf-8").split("[machine.rotor]")[0]
SENSOR = '[[sensors]]\nname = "s"\ntype = "accelerometer"\nunit = "g"\n'
SENSOR += 'stream = "{stream}"\nchannel = "{channel}"\n'
STREAM = '[streams.{stream}]\nbus = "{bus}"\nrate_hz = 100.0\n'


def blocks(page: str) -> list[str]:
    return re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / page).read_text("utf-8"), re.DOTALL)


def machine(text: str, stream: str, channel: str):
    return parse_machine_file(
        HEAD + text + SENSOR.format(stream=stream, channel=channel), MACHINES / "machine.toml"
    )


@pytest.mark.parametrize(("place", "stream", "channel"), [(1, "shaft", "kph"), (2, "housing", "y")])
def test_a_layout_of_the_can_page_fits_its_bus(place, stream, channel):
    bus, *_ = parts = blocks("can.md")
    text = f"{bus}\n{STREAM.format(stream=stream, bus='can0')}\n{parts[place]}\n{parts[-1]}\n"
    assert machine(text, stream, channel).buses["can0"].record.keep_mb == 2048


def test_the_pages_of_a_multiplexed_message_are_streams(tmp_path):
    dbc = tmp_path / "transmitter.dbc"
    signals = 'SG_ Page M : 0|8@1+ (1,0) [0|0] "" A\n SG_ Temperature m0 : 8|16@1- (0.1,0) [0|0] "degC" A\n'
    signals += ' SG_ Supply m1 : 8|16@1+ (0.01,0) [0|0] "" A\n'
    dbc.write_text(f'VERSION ""\nBU_: A\nBO_ 801 Slow: 8 A\n {signals}')
    bus, _, _, _, pages, _ = blocks("can.md")
    text = f"{bus}\n{pages}\n".replace("../devices/transmitter.dbc", f"{dbc}")
    assert list(machine(text, "supply", "supply").streams) == ["temperature", "supply"]


def test_another_message_is_another_stream(tmp_path):
    dbc = tmp_path / "drive.dbc"
    signals = 'SG_ Speed : 0|16@1+ (1,0) [0|0] "" A\n SG_ WindingTemperature : 16|16@1- (0.1,0) [0|0] "" A\n'
    dbc.write_text(f'VERSION ""\nBU_: A\nBO_ 802 MotorState: 8 A\n {signals}')
    bus, _, _, several, _, _ = blocks("can.md")
    text = f"{bus}\n{several}\n".replace("../devices/drive.dbc", f"{dbc}")
    assert machine(text, "motor", "winding").streams["motor"].layout.channel_names == ("speed", "winding")


def test_the_keys_of_a_serial_port_are_all_shown_with_their_defaults():
    bus, lines, *_ = blocks("serial.md")
    shown = machine(bus + lines[lines.index("[streams") :], "casing", "v").buses["casing"]
    least = machine(lines.replace('checksum = "xor"', ""), "casing", "v").buses["casing"]
    assert shown == least


@pytest.mark.parametrize(("place", "stream", "channel"), [(1, "casing", "h"), (5, "shaft", "kph")])
def test_a_serial_port_of_the_page_has_a_stream(place, stream, channel):
    assert machine(blocks("serial.md")[place], stream, channel).streams[stream].rate_hz > 100


def test_the_channels_with_a_unit_behind_the_number_fit_a_line():
    _, lines, changed, *_ = blocks("serial.md")
    text = lines[: lines.index("[streams.casing.layout]")] + changed
    layout = machine(text, "casing", "v").streams["casing"].layout
    assert [channel.suffix for channel in layout.channels] == ["mm/s", "mm/s"]


def test_the_channels_with_a_name_in_front_of_the_number_fit_a_line():
    _, lines, _, changed, *_ = blocks("serial.md")
    text = lines[: lines.index("[streams.casing.layout]")] + changed
    layout = machine(text, "casing", "v").streams["casing"].layout
    assert layout.beside == {"t": ("t=", "ms"), "v": ("v=", "mm/s"), "h": ("h=", "")}


def test_lines_without_a_counter_fit_a_port():
    made = machine(blocks("serial.md")[4], "oil", "oil")
    assert made.streams["oil"].layout.no_counter


def test_a_table_is_replayed_as_the_page_shows():
    bus, layout = blocks("replay.md")
    text = bus.replace("run-up.blf", "run-up.csv").replace('channel = "1"', "")
    made = machine(f"{text}\n{STREAM.format(stream='x', bus='can0')}{layout}\n", "x", "x")
    assert made.buses["can0"].at_end == "stop"
