"""A machine file that contradicts itself, its DBC file or physics is refused, with what to do."""

from __future__ import annotations

import pytest
from machine_files import LAVAL, MACHINES, MOTOR, TRIAXIAL, changed, problems_of

from daqsvc.settings import MachineFileError, load_machine_file, parse_machine_file

DEVICE = MACHINES.parent / "devices" / "triaxial-accelerometer.dbc"
MODBUS = """
schema_version = 1
site = "s"
box = "b"
machine = {{ name = "m", speed_rpm = 60.0 }}
buses.io = {{ driver = "modbus", transport = "tcp", host = "192.0.2.1", writes = [{writes}] }}
{streams}
[[sensors]]
name = "a"
type = "trend"
stream = "s"
channel = "a"
unit = "mm/s"
"""


def modbus(streams, writes="{ unit = 1, address = 0, count = 123 }"):
    return MODBUS.format(streams=streams, writes=writes)


def registers(channels, **more):
    rest = "".join(f"{key} = {value}\n" for key, value in more.items())
    return modbus(
        f'[streams.s]\nbus = "io"\nrate_hz = 1.0\n[streams.s.layout]\nway = "registers"\nunit = 1\n'
        f"{rest}channels = [{channels}]\n"
    )


def waveform(table="holding", block_id=0, address=100, trigger=98, select=99, samples=100):
    return modbus(
        f'[streams.s]\nbus = "io"\nrate_hz = 100.0\n[streams.s.layout]\nway = "waveform"\nunit = 1\n'
        f'table = "{table}"\nblock_id = {block_id}\naddress = {address}\nsamples = {samples}\n'
        f"trigger = {{ address = {trigger} }}\npage = {{ select = {select}, registers = 50 }}\n"
        'channels = [{ name = "a", place = 0, type = "int16" }]\n'
    )


def outcome(text, path=LAVAL):
    """Problems and warnings, by key."""
    try:
        machine = parse_machine_file(text, path)
    except MachineFileError as error:
        return {problem.key: problem for problem in error.problems}, {}
    return {}, {warning.key: warning for warning in machine.warnings}


# Machine file, replacements, key, words of the message, words of the remedy.
ERRORS = [
    (
        TRIAXIAL,
        [('unit = "g"', 'unit = "m/s2"')],
        "sensors[0].unit",
        'signal "AccelX" in "g", but this sensor takes it as "m/s2": wrong by a factor of 9.807',
        'write unit = "g"',
    ),
    (
        TRIAXIAL,
        [('unit = "g"', 'unit = "g"\nsensitivity_mv_per_unit = 100.0')],
        "sensors[0].unit",
        'in "g", but this sensor takes it as "V"',
        "remove sensitivity_mv_per_unit",
    ),
    (
        LAVAL,
        [("zero_v = -10.0 ", "zero_v = 10.0 ")],
        "sensors[0].zero_v",
        "lies outside gap_ok_v, -18 to -2 V",
        "zero_v = -10",
    ),
    (LAVAL, [("gap_ok_v = [-18.0, -2.0]", "")], "sensors[0].gap_ok_v", "is missing", "add gap_ok_v = [-18.0"),
    (
        LAVAL,
        [("unit = 7.87 ", "unit = 0.00787 ")],
        "sensors[0].sensitivity_mv_per_unit",
        "0.00787 mV/um is what no sensor has; usual is some 7.87",
        "0.00787 V/um are sensitivity_mv_per_unit = 7.87",
    ),
    (
        LAVAL,
        [("unit = 7.87 ", "unit = 7870.0 ")],
        "sensors[0].sensitivity_mv_per_unit",
        "what no sensor has",
        "7870 mV/mm are sensitivity_mv_per_unit = 7.87",
    ),
    (
        LAVAL,
        [("scale = 0.001 }", "scale = 1.0 }")],
        "sensors[0].channel",
        "one count of it would be 1 V",
        "write scale = 0.001 in the layout if the device counts mV",
    ),
    (
        LAVAL,
        [('"x", type = "int16", scale = 0.001', '"x", type = "int16", scale = 0.0001')],
        "sensors[0].zero_v",
        "is never measured: the channel carries -3.2768 to 3.2767 V",
        "scale of the channel",
    ),
    (
        LAVAL,
        [("threshold_v = -6.0", "threshold_v = -60.0")],
        "sensors[2].threshold_v",
        "is never crossed: the channel carries -32.768 to 32.767 V",
        "scale of the channel",
    ),
    (
        LAVAL,
        [("alert = 40.0\ndanger = 60.0", "alert = 40.0\ndanger = 60_000.0")],
        "alarms[0].danger",
        'is never reached: the channel of "probe-x" carries 8327 um at most',
        "scale and sensitivity",
    ),
    (
        LAVAL,
        [("data_bitrate = 2_000_000", "data_bitrate = 250_000")],
        "buses.can0.data_bitrate",
        "is less than bitrate = 500,000",
        "swap the two",
    ),
    (
        LAVAL,
        [
            (
                "[streams.shaft]",
                '[buses.can1]\ndriver = "can"\ninterface = "socketcan"\nchannel = "can0"\n[streams.shaft]',
            )
        ],
        "buses.can1.channel",
        'belongs to bus "can0" already',
        "put all streams of the interface on one bus",
    ),
]


@pytest.mark.parametrize(("path", "replacements", "key", "message", "remedy"), ERRORS)
def test_a_contradiction_is_refused(path, replacements, key, message, remedy):
    text, _ = changed(path, *replacements)
    problem = outcome(text, path)[0][key]
    assert message in problem.message
    assert remedy in problem.remedy
    assert problem.line


# What could be meant.
WARNINGS = [
    (
        LAVAL,
        [("unit = 7.87 ", "unit = 200.0 ")],
        "sensors[0].sensitivity_mv_per_unit",
        "hardly any sensor has",
        "200 mV/mil are sensitivity_mv_per_unit = 7.874",
    ),
    (
        LAVAL,
        [('measure = "rms" ', 'measure = "peak" ')],
        "alarms[0].measure",
        "the limits of shaft vibration in ISO 20816 and API 670 are peak to peak",
        'measure = "peak_to_peak"',
    ),
    (LAVAL, [("zero_v = -10.0 ", "")], "sensors[0]", "has no zero_v", "zero_v = -10"),
    (
        LAVAL,
        [("fd = true", "fd = true\nfilter = true"), ('"socketcan"', '"virtual"')],
        "buses.can0.filter",
        "SocketCAN",
        "remove",
    ),
    (
        TRIAXIAL,
        [("bitrate = 500_000", "bitrate = 500_000\ndata_bitrate = 2_000_000")],
        "buses.can0.data_bitrate",
        "no effect",
        "fd = true",
    ),
]


@pytest.mark.parametrize(("path", "replacements", "key", "message", "remedy"), WARNINGS)
def test_what_could_be_meant_is_a_warning(path, replacements, key, message, remedy):
    text, _ = changed(path, *replacements)
    problems, warnings = outcome(text, path)
    assert not problems
    assert message in warnings[key].message
    assert remedy in warnings[key].remedy


@pytest.mark.parametrize(
    ("angle", "same"), [("90.0", False), ("0.0", True), ("180.0", True), ("45.0", False)]
)
def test_two_probes_that_look_along_one_line_without_a_detector_of_the_rotor(angle, same):
    text, _ = changed(LAVAL, ("angle_deg = 90.0", f"angle_deg = {angle}"))
    begin, end = text.index("[pipeline.rotor_bank]"), text.index("[[alarms]]")
    text = text[:begin] + text[end:]
    begin, end = text.index("[[alarms]]                       # on what"), text.index("[alarm_handling]")
    problems, warnings = outcome(text[:begin] + text[end:])
    assert not problems
    assert ("sensors[1].angle_deg" in warnings) is same


def test_a_probe_without_a_gap_voltage_needs_no_limits_of_it():
    text, _ = changed(
        LAVAL,
        ("sensitivity_mv_per_unit = 7.87   #", "#"),
        ("zero_v = -10.0 ", "# "),
        ("gap_ok_v = [-18.0, -2.0] ", "# "),
        ("alert = 40.0\ndanger = 60.0\ndeadband = 2.0", "alert = 0.4\ndeadband = 0.1"),
    )
    assert outcome(text) == ({}, {})


@pytest.mark.parametrize(
    ("unit", "warned"),
    [("m/s^2", False), ("m/s/s", False), ("m/s²", False), ("m/s2", False), ("", False), ("counts", True)],
)
def test_units_of_a_dbc_file_however_they_are_spelt(tmp_path, unit, warned):
    dbc = DEVICE.read_text(encoding="utf-8").replace('"g"', f'"{unit}"')
    (tmp_path / "a.dbc").write_bytes(dbc.encode("cp1252"))
    text, _ = changed(TRIAXIAL, ("../devices/triaxial-accelerometer.dbc", "a.dbc"))
    text = text.replace('unit = "g"', 'unit = "m/s2"')
    problems, warnings = outcome(text, tmp_path / "m.toml")
    assert not problems
    assert set(warnings) == ({f"sensors[{n}].unit" for n in range(3)} if warned else set())


def test_a_dbc_file_in_millivolts_read_as_volts(tmp_path):
    (tmp_path / "a.dbc").write_text(DEVICE.read_text(encoding="utf-8").replace('"g"', '"mV"'))
    text, _ = changed(TRIAXIAL, ("../devices/triaxial-accelerometer.dbc", "a.dbc"))
    text = text.replace('unit = "g"', 'unit = "g"\nsensitivity_mv_per_unit = 100.0')
    problem = outcome(text, tmp_path / "m.toml")[0]["sensors[0].unit"]
    assert 'in "mV", but this sensor takes it as "V": wrong by a factor of 1000' in problem.message
    assert "multiply its scale and offset there by 0.001" in problem.remedy


@pytest.mark.parametrize(
    ("old", "new", "key", "message"),
    [
        ("8|16@1- (0.0005,0)", "8|16@1- (0,0)", "channels[0].signals[0]", "has the scale 0"),
        ("8|16@1- (0.0005,0)", "8|16@1- (1e-300,0)", "channels[0].signals[0]", "has the scale 1e-300"),
        ("0|8@1+ (1,0)", "-1|8@1+ (1,0)", "counter.signal", "does not lie within the 8 bytes"),
        ("0|8@1+ (1,0)", "0|8@1+ (10,0)", "counter.signal", "has the scale 10"),
        ("0|8@1+ (1,0)", "0|8@1+ (0,0)", "counter.signal", "has the scale 0"),
    ],
)
def test_scales_of_a_dbc_file_that_cannot_be_meant(tmp_path, old, new, key, message):
    (tmp_path / "a.dbc").write_text(DEVICE.read_text(encoding="utf-8").replace(old, new))
    text, _ = changed(TRIAXIAL, ("../devices/triaxial-accelerometer.dbc", "a.dbc"))
    problem = outcome(text, tmp_path / "m.toml")[0][f"streams.housing.layout.{key}"]
    assert message in problem.message
    assert "DBC file" in problem.remedy
    assert problem.line


@pytest.mark.parametrize(
    ("channels", "fatal", "words"),
    [
        (
            '{ name = "a", address = 0, type = "float32" }, { name = "b", address = 1, type = "float32" }',
            True,
            '"a"',
        ),
        (
            '{ name = "b", address = 3, type = "uint16" }, { name = "a", address = 0, type = "float64" }',
            True,
            '"a"',
        ),
        (
            '{ name = "a", address = 0, type = "int32" }, { name = "b", address = 1, type = "int32" }',
            True,
            "begins at 2",
        ),
        (
            '{ name = "a", address = 0, type = "uint32" }, { name = "b", address = 1, type = "uint16" }',
            False,
            '"a"',
        ),
        (
            '{ name = "a", address = 0, type = "uint16" }, { name = "b", address = 0, type = "uint16" }',
            False,
            '"a"',
        ),
    ],
)
def test_numbers_that_share_a_register(channels, fatal, words):
    found = outcome(registers(channels))[0 if fatal else 1]
    ((key, problem),) = found.items()
    assert key.startswith("streams.s.layout.channels[")
    assert words in problem.message + problem.remedy
    assert problem.line


@pytest.mark.parametrize(
    "channels",
    [
        '{ name = "a", address = 0, type = "float32" }, { name = "b", address = 2, type = "float32" }',
        (
            '{ name = "a", address = 0, type = "uint16", bits = [0, 4] }, '
            '{ name = "b", address = 0, type = "uint16", bits = [4, 12] }'
        ),
    ],
)
def test_numbers_beside_each_other_and_bits_of_one_register(channels):
    assert outcome(registers(channels)) == ({}, {})


@pytest.mark.parametrize(
    ("given", "key", "message"),
    [
        ({"block_id": 120}, "block_id", "register 120 is the id of the block, but lies among the samples"),
        ({"trigger": 100}, "trigger.address", "register 100 is the trigger, but lies among"),
        ({"select": 149}, "page.select", "register 149 is the choice of the page, but lies among"),
        ({"trigger": 99}, "trigger.address", "register 99 is the choice of the page already"),
        ({"trigger": 0}, "trigger.address", "register 0 is the id of the block already"),
    ],
)
def test_a_block_that_covers_what_steers_it(given, key, message):
    problems, _ = outcome(waveform(**given))
    problem = problems[f"streams.s.layout.{key}"]
    assert message in problem.message
    assert "register map" in problem.remedy
    assert problem.line


def test_a_block_beside_what_steers_it_is_no_contradiction():
    # Sensor "a" is a trend value of a waveform here: what is asked about are its registers alone.
    assert not any(key.startswith("streams") for key in outcome(waveform())[0])
    # Input registers are others than holding ones.
    assert not any(key.startswith("streams") for key in outcome(waveform(table="input", trigger=110))[0])


@pytest.mark.parametrize(
    ("host", "remedy"),
    [
        ("tcp://192.0.2.10", 'host = "192.0.2.10"'),
        ("modbus://plc.example:1502/x", 'host = "plc.example" and tcp_port = 1502'),
        ("192.0.2.10:502", 'host = "192.0.2.10" and tcp_port = 502'),
        ("[2001:db8::1]", 'host = "2001:db8::1"'),
        ("a..b", "host ="),
        ("192.168.1", "host ="),
        ("x" * 64, "host ="),
        ("two words", "host ="),
    ],
)
def test_a_host_that_is_none(host, remedy):
    text = registers('{ name = "a", address = 0, type = "uint16" }').replace("192.0.2.1", host)
    problem = outcome(text)[0]["buses.io.host"]
    assert remedy in problem.remedy
    assert problem.line


@pytest.mark.parametrize(
    "host", ["plc", "plc-1.example.", "192.0.2.10", "2001:db8::1", "fe80::1%eth0", "plc_2"]
)
def test_hosts_that_there_can_be(host):
    text = registers('{ name = "a", address = 0, type = "uint16" }').replace("192.0.2.1", host)
    assert outcome(text)[0] == {}


def test_a_home_is_put_in_and_a_variable_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    text, _ = changed(LAVAL, ('"/var/lib/daqsvc"', '"~/store"'), ('"/etc/daqsvc/ca.pem"', '"~/ca.pem"'))
    machine = parse_machine_file(text, LAVAL)
    assert machine.resolve(machine.store.directory) == tmp_path / "store"
    assert machine.mqtt.ca_file == tmp_path / "ca.pem"
    text, _ = changed(LAVAL, ('"/var/lib/daqsvc"', '"$HOME/store"'))
    (problem,) = problems_of(text)
    assert (problem.key, "variable" in problem.message) == ("store.directory", True)
    text, _ = changed(LAVAL, ('"/var/lib/daqsvc"', '"~nobody-of-this-name/store"'))
    (problem,) = problems_of(text)
    assert "home" in problem.message


def test_rings_that_this_computer_has_no_memory_for(monkeypatch):
    text, _ = changed(
        MOTOR,
        ("rate_hz = 12_000.0", "rate_hz = 10_000_000.0"),
        ("bitrate = 500_000", "# "),
        ("data_bitrate", "# data_bitrate"),
    )
    text = text.replace("ring_s = 30.0", "ring_s = 3600.0")
    problem = outcome(text, MOTOR)[0]["pipeline.ring_s"]
    assert "this computer has" in problem.message
    assert "ring_s = " in problem.remedy
    assert load_machine_file(MOTOR).warnings == ()


def test_the_rings_of_all_streams_are_added_up(monkeypatch):
    # 640 Hz for 30 s, 3 channels of 4 bytes: 230 kB.
    monkeypatch.setattr("daqsvc.settings.memory_checks.memory_bytes", lambda: 500_000)
    assert outcome(LAVAL.read_text())[0] == {}
    monkeypatch.setattr("daqsvc.settings.memory_checks.memory_bytes", lambda: 400_000)
    assert "0.00023 GB" in outcome(LAVAL.read_text())[0]["pipeline.ring_s"].message


def test_a_peak_to_peak_limit_of_a_probe_is_no_contradiction():
    text, _ = changed(LAVAL, ('measure = "rms" ', 'measure = "peak_to_peak" '))
    assert outcome(text) == ({}, {})
