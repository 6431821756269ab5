"""A machine file that contradicts itself, its DBC file or physics is refused, with what to do."""

from __future__ import annotations

import pytest
from support.given_codes import had
from support.machine_files import LAVAL, MACHINES, MOTOR, TRIAXIAL, changed, problems_of

from daqsvc.settings import MachineFileError, load_machine_file, parse_machine_file
from daqsvc.settings.describe import describe

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


# Figures of a rotor, and of a bearing, that cannot be true together.
BEARING = MACHINES / "bearing.toml"
START_UP = '[alarm_handling.start_up]\ndetector = "rotor-bank"\nbetween = [{}, {}]\n[alarm_handling]'
ORDERS = "orders = { bpfi = 5.415, bpfo = 3.585, bsf = 2.357, ftf = 0.398 }"
ERRORS += [
    (
        LAVAL,
        [("eccentricity_um = 10.0", "eccentricity_um = 120.0")],
        "machine.rotor.eccentricity_um",
        "at 600 rpm it would whirl by 333.3 um about a rest at 10 um, in a clearance of 100 um",
        "correct eccentricity_um",
    ),
    (
        LAVAL,
        [("static_sag_um = 10.0", "static_sag_um = 130.0")],
        "machine.rotor.static_sag_um",
        "lays the shaft on the stator: it would rest 130 um from the middle of a clearance of 100 um",
        "correct the sag",
    ),
    (
        LAVAL,
        [("natural_frequency_hz = 10.0", "natural_frequency_hz = 330.0")],
        "machine.rotor.natural_frequency_hz",
        "is not seen at 640 Hz, the rate of the bank's probes",
        "sample faster than 660 Hz",
    ),
    (
        LAVAL,
        [("noise_um = 2.0", "noise_um = 200.0")],
        "pipeline.rotor_bank.noise_um",
        "hides every motion within clearance_um = 100",
        "correct one of the two",
    ),
    (
        LAVAL,
        [("[alarm_handling]", START_UP.format(60.0, 660.0))],
        "alarm_handling.start_up.between",
        "holds machine.speed_rpm, 600 rpm: the machine would always be starting up",
        "between = [60, 540]",
    ),
    (
        BEARING,
        [('type = "6205-2RS"', ORDERS), ("speed_rpm = 1772.0", "speed_rpm = 150_000.0")],
        "pipeline.bearing.bearings[0].sensor",
        "and the inner race's line lies at 13538 Hz: samples show nothing above 12800 Hz",
        "sample at 33844 Hz or faster",
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

WARNINGS += [
    (
        LAVAL,
        [
            ("speed_rpm = 600.0", "speed_rpm = 200.0"),
            ("eccentricity_um = 10.0", "eccentricity_um = 120.0"),
        ],
        "machine.rotor.eccentricity_um",
        "is not less than clearance_um = 100: near its natural frequency, and at any speed above",
        "correct eccentricity_um",
    ),
    (
        LAVAL,
        [("eccentricity_um = 10.0", "eccentricity_um = 19.0")],
        "pipeline.rotor_bank.modes[1]",
        'mode "F1" would touch the stator: a whirl of 95 um about a rest at 10 um',
        "rub = true",
    ),
    (
        LAVAL,
        [("speed_rpm = 600.0", "speed_rpm = 6.0")],
        "machine.rotor.natural_frequency_hz",
        "is 100 times the speed of 0.1 Hz",
        "in Hz",
    ),
    (
        LAVAL,
        [("danger = 60.0", "danger = 160.0")],
        "alarms[0].danger",
        "is more than the stator lets the shaft move: in a clearance of 100 um rms is 100 um at most",
        "clearance_um",
    ),
    (
        MOTOR,
        [("window_s = 0.5", "window_s = 0.1")],
        "pipeline.levels.window_s",
        "0.1 s hold 1 periods of 10 Hz",
        "write window_s = 0.2 or more, or begin the band at 20 Hz",
    ),
    (
        BEARING,
        [('type = "6205-2RS"', ORDERS.replace("5.415", "5.95"))],
        "pipeline.bearing.bearings[0].orders",
        "make 9.535 balls, the number in bpfo + bpfi",
        "data sheet",
    ),
    (
        BEARING,
        [('type = "6205-2RS"', ORDERS.replace("0.398", "0.45"))],
        "pipeline.bearing.bearings[0].orders.ftf",
        "with 9 balls the cage turns 0.3983 times a revolution",
        "ftf = 0.3983",
    ),
    (
        BEARING,
        [('type = "6205-2RS"', ORDERS.replace("2.357", "4.714"))],
        "pipeline.bearing.bearings[0].orders.bsf",
        "is more than 2.357, how often a ball",
        "write half of it",
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
    assert f"{problem}".endswith("[B06]" if key == "counter.signal" and "scale" in message else "[B14]")
    if key != "counter.signal":
        had("B14", problem)
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


@pytest.mark.parametrize(("address", "meant"), [(40001, 0), (40018, 17), (49999, 9998), (30002, 1)])
def test_the_number_of_a_manual_in_place_of_an_address_is_a_warning(address, meant):
    channels = f'{{ name = "a", address = {address}, type = "int16" }}'
    problems, warnings = outcome(registers(channels))
    assert not problems
    ((key, warning),) = warnings.items()
    assert key == "streams.s.layout.channels[0].address"
    other = ' and table = "input"' if address < 40_000 else ""
    assert f"write address = {meant}{other}, as registers begin at 0" in warning.remedy
    assert f"{warning}".endswith("[B26]")


@pytest.mark.parametrize(("address", "meant"), [(400_001, 0), (400_101, 100), (300_002, 1)])
def test_a_number_of_six_digits_of_a_manual_is_no_address(address, meant):
    channels = f'{{ name = "a", address = {address}, type = "int16" }}'
    ((key, problem),) = outcome(registers(channels))[0].items()
    assert key == "streams.s.layout.channels[0].address"
    assert f"write {meant}, as registers begin at 0" in problem.remedy
    assert f"{problem}".endswith("[B26]")


@pytest.mark.parametrize(
    ("word", "meant"), [("float", "float32"), ("int", "int32"), ("uint", "uint32"), ("INT16", "int16")]
)
def test_a_type_without_its_width_is_the_commonest_one(word, meant):
    ((_, problem),) = outcome(registers(f'{{ name = "a", address = 0, type = "{word}" }}'))[0].items()
    assert problem.remedy == f'did you mean "{meant}"?'


def test_a_byte_order_in_lower_case_is_recognised():
    channels = '{ name = "a", address = 0, type = "float32", order = "cdab" }'
    ((_, problem),) = outcome(registers(channels))[0].items()
    assert problem.remedy == 'did you mean "CDAB"?'


@pytest.mark.parametrize("samples", [15, 16])
def test_a_block_that_is_shorter_than_the_velocity_needs_is_a_warning(samples):
    text = waveform(samples=samples).replace('type = "trend"', 'type = "velocity"')
    _, warnings = outcome(f"{text}[pipeline.levels]\nvelocity_band_hz = [12.5, 40.0]\n")
    found = warnings.get("streams.s.layout")
    assert (found is not None) == (samples == 15)
    if found is not None:
        assert "blocks of 15 samples are 0.15 s long. That is 1.88 periods of 12.5 Hz" in found.message
        assert "have the device take 16 samples or more" in found.remedy


@pytest.mark.parametrize("address", [17, 30000, 40000, 50000])
def test_other_addresses_are_taken_as_they_are(address):
    assert outcome(registers(f'{{ name = "a", address = {address}, type = "int16" }}')) == ({}, {})


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
    monkeypatch.setattr("daqsvc.settings.checks.memory_bytes", lambda: 500_000)
    assert outcome(LAVAL.read_text())[0] == {}
    monkeypatch.setattr("daqsvc.settings.checks.memory_bytes", lambda: 400_000)
    assert "0.00023 GB" in outcome(LAVAL.read_text())[0]["pipeline.ring_s"].message


def test_a_peak_to_peak_limit_of_a_probe_is_no_contradiction():
    text, _ = changed(LAVAL, ('measure = "rms" ', 'measure = "peak_to_peak" '))
    assert outcome(text) == ({}, {})


def test_the_orders_of_a_real_bearing_go_together():
    text, _ = changed(BEARING, ('type = "6205-2RS"', ORDERS))
    problems, warnings = outcome(text, BEARING)
    assert not problems
    assert not any("orders" in key for key in warnings)


RTU = 'transport = "rtu", serial_port = "/dev/ttyS0", baud = {baud}'


def polled(baud, rate_hz, channels=8, step=1, **more):
    """A line with a stream of that many registers."""
    listed = ", ".join(
        f'{{ name = "{"abcdefgh"[n]}", address = {n * step}, type = "uint16" }}' for n in range(channels)
    )
    text = registers(listed, **more).replace("rate_hz = 1.0", f"rate_hz = {rate_hz}")
    return text.replace('transport = "tcp", host = "192.0.2.1"', RTU.format(baud=baud))


@pytest.mark.parametrize(
    ("baud", "rate_hz", "figures", "refused"),
    [
        # 8 and 5 + 16 characters of 11 bits, and twice 3.5 characters of silence: 41.25 ms.
        (9600, 30.0, "30 requests a second take 124 % of its time at least", True),
        (9600, 24.0, "24 requests a second take 99 % of its time, and 113 % if units answer", False),
        (9600, 20.0, "20 requests a second take 82.5 % of its time, and 94.5 % if units answer", False),
        (9600, 16.0, None, False),
        # From 19,200 bit/s on the silences are 1.75 ms long.
        (115_200, 100.0, "100 requests a second take 62.7 % of its time, and 145 % if", False),
        (115_200, 50.0, None, False),
    ],
)
def test_a_serial_line_that_is_too_slow_for_its_polling(baud, rate_hz, figures, refused):
    problems, warnings = outcome(polled(baud, rate_hz))
    found = (problems if refused else warnings).get("buses.io.baud")
    assert ("buses.io.baud" in problems) is refused
    assert (found is None) if figures is None else (figures in found.message)


def test_what_shares_a_request_takes_less_of_a_line():
    apart = outcome(polled(9600, 6.0, step=4, max_gap=0))[0]["buses.io.baud"]
    assert "48 requests a second take 121 %" in apart.message
    assert outcome(polled(9600, 6.0, step=4)) == ({}, {})


def test_streams_of_one_unit_share_requests_and_a_line_counts_all_of_its_streams():
    def two(unit):
        one = polled(9600, 20.0, channels=2)
        begin, end = one.index("[streams.s]"), one.index("[[sensors]]")
        other = one[begin:end].replace("streams.s", "streams.t").replace("unit = 1", f"unit = {unit}")
        other = other.replace("address = 0", "address = 2").replace("address = 1,", "address = 3,")
        return outcome(one[:end] + other + one[end:])

    assert "40 requests a second take 110 % of its time at least" in two(2)[0]["buses.io.baud"].message
    assert two(1) == ({}, {})


@pytest.mark.parametrize(
    ("rate_hz", "figures", "refused"),
    [
        (5.0e3, "111 % of the time at least", True),
        (4.0e3, "take 89 % of the bus's time", False),
        (3.5e3, None, False),
    ],
)
def test_a_can_bus_that_is_nearly_or_more_than_full(rate_hz, figures, refused):
    text, _ = changed(TRIAXIAL, ("rate_hz = 1000.0", f"rate_hz = {rate_hz}"))
    problems, warnings = outcome(text, TRIAXIAL)
    found = (problems if refused else warnings).get("buses.can0.bitrate")
    assert (found is None) if figures is None else (figures in found.message)


def test_what_polling_takes_of_a_line_is_described():
    text = (MACHINES / "modbus-vibration-temperature.toml").read_text(encoding="utf-8")
    machine = parse_machine_file(text, MACHINES / "modbus-vibration-temperature.toml")
    # One request of 21 registers a second reads both streams: 55 characters and two silences at 19,200 bit/s.
    described = " ".join(describe(machine).split())
    assert "time-out 500 ms, load about 3.2 to 4 % of the line" in described
