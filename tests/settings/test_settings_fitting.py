"""Parts of a machine file that are good each for itself and do not fit each other are named."""

from __future__ import annotations

import pytest
from support.machine_files import LAVAL, MOTOR, TRIAXIAL, only_problem, parsed, problems_of

from drivers.can.checks import check_counter

MOTOR_PEAK_ALARM = """[[alarms]]
name = "drive-end-peak"
sensor = "accel-de"
measure = "peak"
alert = 0.42
danger = 1.1
deadband = 0.04
on_delay_s = 1.0
off_delay_s = 5.0
"""

# path of the file, replacements, key, words of the message, words of the remedy
FITTING = [
    (
        LAVAL,
        [("fd = true", "fd = false")],
        "streams.shaft.layout.length",
        "only CAN FD",
        "fd = true in [buses.can0]",
    ),
    (LAVAL, [("id = 0x101", "id = 0x801")], "streams.shaft.layout.id", "11 bits", "extended = true"),
    (
        LAVAL,
        [("samples_per_frame = 10", "samples_per_frame = 11")],
        "streams.shaft.layout.first_byte",
        "bytes 2 to 67",
        "samples_per_frame = 10",
    ),
    (
        LAVAL,
        [("crc_byte = 62", "crc_byte = 60")],
        "streams.shaft.layout.crc_byte",
        "overlap the samples",
        "move the CRC to byte 62",
    ),
    (
        MOTOR,
        [("samples_per_frame = 30", "samples_per_frame = 31")],
        "streams.drive-end.layout.crc_byte",
        "overlap the samples",
        "write samples_per_frame = 30",
    ),
    (
        LAVAL,
        [("byte = 0, bits", "byte = 1, bits")],
        "streams.shaft.layout.first_byte",
        "overlap the counter",
        "byte 3",
    ),
    (
        MOTOR,
        [
            ("length = 64", "length = 8"),
            ("crc_byte = 62", ""),
            ("samples_per_frame = 30", "samples_per_frame = 4"),
        ],
        "streams.drive-end.layout.first_byte",
        "bytes 2 to 9 of a frame of 8",
        "samples_per_frame = 3",
    ),
    (
        LAVAL,
        [
            ("channels = [", 'channels = [\n  { name = "kph", type = "int16", scale = 1.0 },'),
            ("samples_per_frame = 10", "samples_per_frame = 7"),
        ],
        "streams.shaft.layout.channels[3].name",
        "earlier channel",
        "its own name",
    ),
    (
        LAVAL,
        [('interface = "socketcan"', 'interface = "nosuch"')],
        "buses.can0.interface",
        "knows no such interface",
        "virtual; or install the python-can plugin that brings it",
    ),
    (
        LAVAL,
        [('interface = "socketcan"', 'interface = "socketcn"')],
        "buses.can0.interface",
        "knows no such interface",
        'did you mean "socketcan"',
    ),
    *(
        (
            LAVAL,
            [('channel = "can0"', f'channel = "{channel}"')],
            "buses.can0.channel",
            "is no name of a CAN interface of Linux",
            'write interface = "unixbus"',
        )
        for channel in ("run/bus", "an-interface-of-the-box")
    ),
    (LAVAL, [('bus = "can0"', 'bus = "can1"')], "streams.shaft.bus", "no such bus", 'did you mean "can0"'),
    (LAVAL, [('stream = "shaft"', 'stream = "shft"')], "sensors[0].stream", "no such stream", '"shaft"'),
    (
        LAVAL,
        [('channel = "x"', 'channel = "X1"')],
        "sensors[0].channel",
        'stream "shaft" has no such',
        "kph, x, y",
    ),
    (
        LAVAL,
        [('channel = "y"', 'channel = "x"')],
        "sensors[1].channel",
        'to sensor "probe-x"',
        "its own channel",
    ),
    (
        LAVAL,
        [('name = "shaft-vibration-y"', 'name = "rotor-fault"')],
        "alarms[2].name",
        "earlier alarm",
        "its own name",
    ),
    (LAVAL, [("sensitivity_mv_per_unit = 7.87", "")], "sensors[0].zero_v", "no effect", "add sensitivity"),
    (
        LAVAL,
        [('keyphasor = "keyphasor"', 'keyphasor = "probe-x"')],
        "pipeline.rotor_bank.keyphasor",
        'type "keyphasor"',
        "take one of: keyphasor",
    ),
    (
        LAVAL,
        [('probes = ["probe-x"', 'probes = ["keyphasor"')],
        "pipeline.rotor_bank.probes[0]",
        'type "proximity"',
        "probe-x, probe-y",
    ),
    (
        LAVAL,
        [('probes = ["probe-x"', 'probes = ["probe-y"')],
        "pipeline.rotor_bank.probes[1]",
        "twice",
        "two different",
    ),
    (
        LAVAL,
        [('probes = ["probe-x"', 'probes = ["probe-z"')],
        "pipeline.rotor_bank.probes[0]",
        "no such sensor",
        "probe-x",
    ),
    (
        LAVAL,
        [("angle_deg = 90.0", "angle_deg = 185.0")],
        "pipeline.rotor_bank.probes",
        "one line",
        "angle_deg",
    ),
    (LAVAL, [("angle_deg = 90.0", "")], "pipeline.rotor_bank.probes[1]", "does not state", "angle_deg"),
    (
        LAVAL,
        [('damping_ratio = 0.18, severity = "normal"', 'damping_ratio = 0.18, severity = "alert"')],
        "pipeline.rotor_bank.modes[0].severity",
        "healthy one",
        'severity = "normal"',
    ),
    (
        LAVAL,
        [('name = "F1"', 'name = "N"')],
        "pipeline.rotor_bank.modes[1].name",
        "earlier mode",
        "its own name",
    ),
    (LAVAL, [("window_s = 0.5", "window_s = 20")], "pipeline.levels.window_s", "ring of 30 s", "ring_s = 40"),
    (LAVAL, [("window_s = 0.5", "window_s = 0.01")], "pipeline.levels.window_s", "fewer than 16", "0.025"),
    (
        TRIAXIAL,
        [("[10.0, 400.0]", "[10.0, 500.0]")],
        "pipeline.levels.velocity_band_hz",
        "below 500 Hz",
        "400.0]",
    ),
    (LAVAL, [("alert = 40.0", "alert = 70.0")], "alarms[0].alert", "below danger = 60", "swap"),
    (LAVAL, [("alert = 40.0\ndanger = 60.0", "")], "alarms[0]", "neither alert nor danger", "add alert"),
    (LAVAL, [("deadband = 2.0", "deadband = 40.0")], "alarms[0].deadband", "never returns", "deadband = 2"),
    (LAVAL, [('sensor = "probe-x"', 'sensor = "probe-z"')], "alarms[0].sensor", "no such sensor", "probe-x"),
    (LAVAL, [('sensor = "probe-x"', 'sensor = "keyphasor"')], "alarms[0].sensor", "no vibration", "probe-x"),
    (
        MOTOR,
        [
            ("[pipeline.levels]\nwindow_s = 0.5\nvelocity_band_hz = [10.0, 1000.0]", ""),
            (MOTOR_PEAK_ALARM, ""),
            ('sensor = "accel-de"', 'sensor = "q"'),
        ],
        "alarms[0].sensor",
        "no such sensor",
        "accel-de",
    ),
    (
        LAVAL,
        [('measure = "rms"', 'measure = "velocity_rms"')],
        "alarms[0].measure",
        "proximity probe",
        "from peak to peak",
    ),
    (
        MOTOR,
        [
            ("[pipeline.levels]\nwindow_s = 0.5\nvelocity_band_hz = [10.0, 1000.0]", ""),
            (MOTOR_PEAK_ALARM, ""),
        ],
        "alarms[0].sensor",
        "nothing measures",
        "[pipeline.levels]",
    ),
    (
        LAVAL,
        [('detector = "rotor-bank"', 'detector = "bank"')],
        "alarms[2].detector",
        "no such detector",
        "rotor-bank",
    ),
    (LAVAL, [('rule = "cusum"', 'rule = "paper"')], "alarms[2].detector", "never raise", 'rule = "cusum"'),
    (
        LAVAL,
        [("mqtts://", "mqtt://"), ("ca_file", "# ca_file")],
        "mqtt.url",
        "unencrypted",
        "insecure = true",
    ),
    (
        LAVAL,
        [('username = "daq"', 'insecure = true\nusername = "daq"')],
        "mqtt.insecure",
        "contradicts",
        "remove it",
    ),
    (
        LAVAL,
        [("mqtts://", "mqtts://daq:secret@"), ('username = "daq"', "")],
        "mqtt.url",
        "must not hold a user name",
        "write username and password_file",
    ),
    (LAVAL, [('username = "daq"', "")], "mqtt.password_file", "without a user", "add username"),
]


@pytest.mark.parametrize(("path", "replacements", "key", "message", "remedy"), FITTING)
def test_parts_that_do_not_fit_are_named(path, replacements, key, message, remedy):
    problem, _ = only_problem(path, *replacements)
    assert problem.key == key
    assert message in problem.message
    assert remedy in problem.remedy


def test_two_streams_with_one_id_on_one_bus():
    text = LAVAL.read_text(encoding="utf-8")
    start, end = text.index("[streams.shaft]"), text.index("[[sensors]]")
    copy = text[start:end].replace("streams.shaft", "streams.other")
    (problem,) = problems_of(text[:end] + copy + text[end:])
    assert problem.key == "streams.other.layout.id"
    assert '0x101 on bus "can0" belongs to stream "shaft"' in problem.message


def test_probes_and_keyphasor_of_two_streams():
    text = LAVAL.read_text(encoding="utf-8")
    start, end = text.index("[streams.shaft]"), text.index("[[sensors]]")
    copy = text[start:end].replace("streams.shaft", "streams.other").replace("0x101", "0x102")
    text = text[:end] + copy + text[end:]
    text = text.replace('stream = "shaft"\nchannel = "kph"', 'stream = "other"\nchannel = "kph"')
    problems = problems_of(text)
    assert [problem.key for problem in problems] == [f"pipeline.rotor_bank.probes[{i}]" for i in (0, 1)]
    assert "same instants" in problems[0].remedy


def test_the_model_bank_needs_the_rotor():
    text = LAVAL.read_text(encoding="utf-8")
    start, end = text.index("[machine.rotor]"), text.index("[buses.can0]")
    (problem,) = problems_of(text[:start] + text[end:])
    assert problem.key == "pipeline.rotor_bank"
    assert "[machine.rotor]" in problem.remedy


# file, replacements, key, words of the warning
WARNINGS = [
    (
        LAVAL,
        [("bits = 16", "bits = 8"), ("rate_hz = 640.0", "rate_hz = 12800.0")],
        "streams.shaft.layout.counter",
        "wraps every 20 ms",
    ),
    (
        LAVAL,
        [("sensitivity_mv_per_unit = 7.87", ""), ("zero_v = -10.0", "")],
        "sensors[0].gap_ok_v",
        "gap voltage is not known",
    ),
    (
        LAVAL,
        [("[streams.shaft]", '[buses.spare]\ndriver = "replay"\nfile = "a.log"\n[streams.shaft]')],
        "buses.spare",
        "no stream",
    ),
    (
        LAVAL,
        [
            ("mqtts://", "mqtt://"),
            ("ca_file", "insecure = true\n# ca_file"),
            ("enabled = true", "enabled = false"),
        ],
        "mqtt.password_file",
        "would go to broker.example unencrypted",
    ),
    (
        LAVAL,
        [("mqtts://broker.example", "mqtt://127.0.0.1"), ("ca_file", "insecure = true\nca_file")],
        "mqtt.ca_file",
        "no certificates",
    ),
]


@pytest.mark.parametrize(("path", "replacements", "key", "words"), WARNINGS)
def test_what_is_doubtful_is_a_warning(path, replacements, key, words):
    (warning,) = parsed(path, *replacements).warnings
    assert warning.key == key
    assert words in warning.message
    assert warning.remedy
    assert warning.line


def test_a_bus_without_time_for_its_frames_is_refused():
    text = MOTOR.read_text().replace("rate_hz = 12_000.0", "rate_hz = 1_200_000.0")
    found = [problem for problem in problems_of(text, MOTOR) if problem.key == "buses.can0.bitrate"]
    assert len(found) == 1
    assert "would take it 1," in found[0].message
    assert "faster bus" in found[0].remedy


@pytest.mark.parametrize(
    ("counts", "samples", "remedy"),
    [
        ("samples", 10, 'have the device send a wider counter, or count "frames"'),
        ("frames", 10, "have the device send a wider counter"),
        ("samples", 1, "have the device send a wider counter"),
    ],
)
def test_frames_are_counted_only_where_that_makes_a_counter_last(counts, samples, remedy):
    machine = parsed(
        LAVAL,
        ('bits = 16, counts = "samples"', f'bits = 8, counts = "{counts}"'),
        ("samples_per_frame = 10", f"samples_per_frame = {samples}"),
    )
    fast = machine.streams["shaft"].model_copy(update={"rate_hz": 1e5})
    [finding] = check_counter(fast, None, ())
    assert "wraps every" in finding.message
    assert finding.remedy == remedy
