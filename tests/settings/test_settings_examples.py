"""The example files: all good, described in full, and the devices they name are there."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from support.machine_files import LAVAL, MACHINES, MOTOR, TRIAXIAL, changed, parsed, problems_of

from daqsvc.publish.mqtt.settings import Mqtt
from daqsvc.settings import describe, load_machine_file, parse_machine_file
from daqsvc.settings.models import LevelAlarm
from drivers.can.checks import frame_time
from drivers.can.settings import DbcLayout, PlainLayout

CONFIG = MACHINES.parent
EXAMPLES = sorted(MACHINES.glob("*.toml"))


def variant(old, new):
    return changed(TRIAXIAL, (old, new))[0]


def test_there_are_examples_to_check():
    assert {path.stem for path in EXAMPLES} >= {"laval-rig", "motor-accelerometer", "dbc-triaxial"}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_is_good_and_described(path):
    machine = load_machine_file(path)
    assert machine.path == path
    assert machine.warnings == ()
    for stream in machine.streams.values():
        if isinstance(stream.layout, DbcLayout):
            assert machine.resolve(stream.layout.dbc).is_file()
    text = describe(machine)
    assert max(map(len, text.split("\n"))) <= 100
    assert text.replace("\n", "").isprintable()
    for name in [machine.machine.name, *machine.buses, *machine.streams]:
        assert name in text
    for sensor in machine.sensors:
        assert f"{sensor.stream}.{sensor.channel}" in text
    for alarm in machine.alarms:
        assert alarm.name in text
        if isinstance(alarm, LevelAlarm):
            assert f"{alarm.measure} of {alarm.sensor}" in text


def test_the_device_files_are_all_used():
    named = set()
    for path in EXAMPLES:
        machine = load_machine_file(path)
        layouts = [stream.layout for stream in machine.streams.values()]
        named |= {machine.resolve(item.dbc).resolve() for item in layouts if isinstance(item, DbcLayout)}
    assert named == {path.resolve() for path in (CONFIG / "devices").iterdir()}


def test_the_laval_rig_as_it_is_read():
    machine = load_machine_file(LAVAL)
    layout = machine.streams["shaft"].layout
    assert isinstance(layout, PlainLayout)
    assert layout.channel_names == ("x", "y", "kph")
    assert (layout.sample_bytes, layout.samples_end_byte) == (6, 62)
    probe = machine.sensor("probe-x")
    assert probe.gain * -10.0 + probe.shift == pytest.approx(0.0)  # the gap voltage of a centred shaft
    assert probe.gain * -9.213 + probe.shift == pytest.approx(100.0)
    assert machine.detectors == ("rotor-bank",)
    assert machine.output(Mqtt).client_id_of(machine) == "daqsvc-lab:edge-1"
    assert (machine.mqtt.tls, machine.mqtt.host, machine.mqtt.port) == (True, "broker.example", 8883)
    with pytest.raises(KeyError, match="no sensor 'probe-z'; there are probe-x, probe-y, keyphasor"):
        machine.sensor("probe-z")


def test_defaults_of_what_may_be_left_out():
    text = """
schema_version = 1
site = "s"
box = "b"
[machine]
name = "m"
speed_rpm = 60
[buses.can0]
driver = "can"
interface = "virtual"
channel = "c"
[streams.s]
bus = "can0"
rate_hz = 100
[streams.s.layout]
id = 1
length = 4
counter = { byte = 0, bits = 16, counts = "frames" }
first_byte = 2
samples_per_frame = 1
channels = [{ name = "a", type = "int16", scale = 1 }]
[[sensors]]
name = "a"
type = "velocity"
stream = "s"
channel = "a"
unit = "mm/s"
"""
    machine = parse_machine_file(text, Path("m.toml"))
    assert machine.streams["s"].reorder_window_ms == 10.0
    assert machine.buses["can0"].start == "retry"
    assert machine.pipeline.ring_s == 30.0
    assert (machine.alarms, machine.mqtt, machine.store, machine.detectors) == ((), None, None, ())
    text = describe(machine)
    assert "no broker configured" in text
    assert "Alarms\n  none" in text


def test_relative_paths_start_at_the_machine_file(tmp_path):
    (tmp_path / "machines").mkdir()
    (tmp_path / "devices").mkdir()
    device = "triaxial-accelerometer.dbc"
    (tmp_path / "devices" / device).write_bytes((CONFIG / "devices" / device).read_bytes())
    path = tmp_path / "machines" / "m.toml"
    path.write_bytes(TRIAXIAL.read_bytes())
    assert load_machine_file(path).layout_facts["housing"].frame_id == 513


def test_what_the_dbc_file_says():
    message = load_machine_file(TRIAXIAL).layout_facts["housing"]
    assert (message.frame_id, message.extended, message.length) == (0x201, False, 8)
    assert message.signal_bits["Sequence"] == 8
    assert {message.signal_bits[f"Accel{axis}"] for axis in "XYZ"} == {16}
    assert message.signal_units["AccelX"] == "g"


@pytest.mark.parametrize(
    ("old", "new", "key", "message", "remedy"),
    [
        ("accelerometer.dbc", "sensor.dbc", "layout.dbc", "there is no file", "relative"),
        (
            '"../devices/triaxial-accelerometer.dbc"',
            '"dbc-triaxial.toml"',
            "layout.dbc",
            "is no DBC file",
            "give the DBC file",
        ),
        ('"Acceleration"', '"Aceleration"', "layout.message", "no such message", '"Acceleration"'),
        ('["AccelX"]', '["AccelQ"]', "layout.channels[0].signals[0]", "no such signal", "AccelX"),
        ('"Sequence"', '"Counter"', "layout.counter.signal", "no such signal", "Sequence"),
        ('"Sequence"', '"AccelX"', "layout.channels[0].signals[0]", "taken by the counter", "once"),
        ('["AccelX"]', '["AccelX", "Status"]', "layout.channels[1].signals", "has 1 sample in", "as many"),
    ],
)
def test_a_layout_that_the_dbc_file_does_not_bear_out(old, new, key, message, remedy):
    found = {problem.key: problem for problem in problems_of(variant(old, new), TRIAXIAL)}
    problem = found[f"streams.housing.{key}"]
    assert message in problem.message
    assert remedy in problem.remedy


def test_a_sensor_of_no_type_beside_a_dbc_file():
    (problem,) = problems_of(variant('type = "accelerometer"', ""), TRIAXIAL)
    assert problem.key == "sensors[0].type"


def test_a_signed_counter_and_samples_on_different_pages(tmp_path):
    dbc = (CONFIG / "devices" / "triaxial-accelerometer.dbc").read_text(encoding="utf-8")
    dbc = dbc.replace("Sequence : 0|8@1+", "Sequence : 0|8@1-").replace("AccelY : 24", "AccelY m2 : 24")
    dbc = dbc.replace("Status : 56", "Status M : 56").replace("AccelZ : 40", "AccelZ m1 : 40")
    (tmp_path / "x.dbc").write_text(dbc, encoding="utf-8")
    text = variant("../devices/triaxial-accelerometer.dbc", "x.dbc")
    found = {item.key: item.message for item in problems_of(text, tmp_path / "m.toml")}
    assert set(found) == {
        "streams.housing.layout.counter.signal",
        "streams.housing.layout.channels",
    }
    assert "signed" in found["streams.housing.layout.counter.signal"]
    assert "different pages" in found["streams.housing.layout.channels"]


@pytest.mark.parametrize("page", ["m1", "m2"])
def test_two_streams_share_an_id_only_on_different_pages(tmp_path, page):
    dbc = (CONFIG / "devices" / "triaxial-accelerometer.dbc").read_text(encoding="utf-8")
    dbc = dbc.replace("Status : 56", "Status M : 56").replace("AccelY : 24", "AccelY m1 : 24")
    dbc = dbc.replace("AccelX : 8", "AccelX m1 : 8").replace("AccelZ : 40", f"AccelZ {page} : 40")
    (tmp_path / "x.dbc").write_text(dbc, encoding="utf-8")
    text = variant("../devices/triaxial-accelerometer.dbc", "x.dbc")
    z = '  { name = "z", signals = ["AccelZ"] },\n'
    begin, end = text.index("[streams.housing]"), text.index("[[sensors]]")
    one = text[begin:end].replace(z, "")
    x_and_y = [f'  {{ name = "{axis}", signals = ["Accel{axis.upper()}"] }},\n' for axis in "xy"]
    other = text[begin:end].replace("housing", "vertical").replace(x_and_y[0], "").replace(x_and_y[1], "")
    sensors = text[end:].replace('stream = "housing"\nchannel = "z"', 'stream = "vertical"\nchannel = "z"')
    text = text[:begin] + one + other + sensors
    if page == "m2":
        assert set(parse_machine_file(text, tmp_path / "m.toml").streams) == {"housing", "vertical"}
        return
    (problem,) = problems_of(text, tmp_path / "m.toml")
    assert problem.key == "streams.vertical.layout.message"


def test_a_dbc_message_too_long_for_classic_can(tmp_path):
    dbc = (CONFIG / "devices" / "triaxial-accelerometer.dbc").read_text(encoding="utf-8")
    (tmp_path / "x.dbc").write_text(dbc.replace("Acceleration: 8", "Acceleration: 12"), encoding="utf-8")
    text = variant("../devices/triaxial-accelerometer.dbc", "x.dbc")
    (problem,) = problems_of(text, tmp_path / "m.toml")
    assert problem.key == "streams.housing.layout.message"
    assert "has 12 bytes" in problem.message


def test_cantools_is_only_needed_for_dbc_files(monkeypatch):
    for name in ("cantools", "cantools.database", "cantools.database.errors"):
        monkeypatch.setitem(sys.modules, name, None)
    for path in EXAMPLES:
        if "\ndbc = " not in path.read_text(encoding="utf-8"):
            load_machine_file(path)
    (problem,) = problems_of(TRIAXIAL.read_text(encoding="utf-8"), TRIAXIAL)
    assert problem.key == "streams.housing.layout.dbc"
    assert problem.remedy == "pip install 'daqsvc[dbc]'"


def test_secrets_and_options_are_not_described():
    text, _ = changed(
        TRIAXIAL,
        ('interface = "socketcan"', 'interface = "slcan"'),
        ("bitrate = 500_000                #", 'bitrate = 500_000\noptions = { token = "hunter2" } #'),
    )
    described = describe(parse_machine_file(text, TRIAXIAL))
    assert "hunter2" not in described
    assert "options token" in described


def test_warnings_come_last_in_the_description():
    described = describe(parsed(LAVAL, ("zero_v = -10.0 ", "")))
    assert described.split("\n\n")[-1].startswith("Warnings: 1\n")
    assert "add the gap voltage with the shaft centred" in described.replace("\n    ", " ")


@pytest.mark.parametrize(
    ("length", "bitrate", "data_bitrate", "fewest_per_s", "most_per_s"),
    [
        (8, 250_000, None, 1_852, 2_252),
        (8, 500_000, None, 3_704, 4_505),
        (8, 1_000_000, None, 7_407, 9_009),
        (64, 500_000, 2_000_000, 2_466, 3_003),
        (64, 1_000_000, 2_000_000, 2_685, 3_289),
        (64, 1_000_000, 5_000_000, 5_924, 7_194),
        (64, 1_000_000, 8_000_000, 8_484, 10_230),
    ],
)
def test_frames_per_second_on_a_full_bus(length, bitrate, data_bitrate, fewest_per_s, most_per_s):
    time = frame_time(length, extended=False, bitrate=bitrate, data_bitrate=data_bitrate)
    assert 1 / time.most_s == pytest.approx(fewest_per_s, abs=0.6)
    assert 1 / time.least_s == pytest.approx(most_per_s, abs=0.6)


def test_bus_shares_add_up():
    described = describe(load_machine_file(MOTOR))
    assert "load about 13 to 16 % of the bus" in described  # 400 frames/s of 2466 to 3003
