"""Every mistake in a machine file is named with its line, its key, its value and what to do about it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from support.machine_files import LAVAL, MACHINES, changed, only_problem, problems_of
from support.paths import ROOT

from daqsvc.settings import MachineFileError, load_machine_file, parse_machine_file

# old, new, key, what the value is shown as, words of the message, words of the remedy
ONE_VALUE = [
    ("fd = true", 'fd = "yes"', "buses.can0.fd", '"yes"', "must be true or false", "write fd = true"),
    ("fd = true", "fd = 0", "buses.can0.fd", "0", "must be true or false", "write fd = false"),
    (
        "rate_hz = 640.0",
        'rate_hz = "640"',
        "streams.shaft.rate_hz",
        '"640"',
        "must be a number",
        "rate_hz = 640",
    ),
    ("rate_hz = 640.0", "rate_hz = -1", "streams.shaft.rate_hz", "-1", "0.0001 or more", "rate_hz = 640.0"),
    ("rate_hz = 640.0", "rate_hz = 1e99", "streams.shaft.rate_hz", "1e99", "10,000,000 or less", "rate_hz ="),
    ("rate_hz = 640.0", "rate_hz = inf", "streams.shaft.rate_hz", "inf", "finite", "write rate_hz"),
    ("rate_hz = 640.0", "rate_hz = [1]", "streams.shaft.rate_hz", "[1]", "must be a number", "640.0"),
    ("length = 64", 'length = "64"', "streams.shaft.layout.length", '"64"', "whole number", "length = 64"),
    ("length = 64", "length = 64.0", "streams.shaft.layout.length", "64.0", "whole number", "length = 64"),
    ("length = 64", "length = 63", "streams.shaft.layout.length", "63", "not a length", "12, 16, 20"),
    ("length = 64", "length = true", "streams.shaft.layout.length", "true", "whole number", "length = 64"),
    (
        "id = 0x101",
        "id = 0x2000_0000",
        "streams.shaft.layout.id",
        "0x2000_0000",
        "0x1fffffff",
        "candump shows",
    ),
    ("bits = 16", "bits = 12", "streams.shaft.layout.counter.bits", "12", "8, 16 or 32", "bits = 16"),
    ("id = 0x101", "id = -1", "streams.shaft.layout.id", "-1", "must be 0 or more", "candump shows"),
    ("bits = 16", 'bits = "16"', "streams.shaft.layout.counter.bits", '"16"', "8, 16 or 32", "bits = 16"),
    (
        'type = "int16", scale = 0.001 }',
        'type = "int61", scale = 0.001 }',
        "streams.shaft.layout.channels[0].type",
        '"int61"',
        '"uint32" or "float32"',
        'did you mean "int16"',
    ),
    ("scale = 0.001", "scale = 0", "streams.shaft.layout.channels[0].scale", "0", "same", "0.0005"),
    ('driver = "can"', "driver = 3", "buses.can0.driver", "3", 'must be "can", "modbus",', "of these"),
    ('channel = "can0"', "channel = 0", "buses.can0.channel", "0", "text in quotes", 'channel = "0"'),
    ('channel = "can0"', 'channel = ""', "buses.can0.channel", '""', "must not be empty", 'channel = "can0"'),
    ('site = "lab"', 'site = "lab 2"', "site", '"lab 2"', "letters, digits", '"lab-2"'),
    ('site = "lab"', f'site = "{"x" * 65}"', "site", f'"{"x" * 55} ...', "longer than 64", "shorten"),
    ("schema_version = 1", "schema_version = 2", "schema_version", "2", "must be 1", "schema_version = 1"),
    (
        'type = "proximity"',
        'type = "proximty"',
        "sensors[0].type",
        '"proximty"',
        '"keyphasor" or "trend"',
        'did you mean "proximity"',
    ),
    ('unit = "um"', 'unit = "g"', "sensors[0].unit", '"g"', '"um", "mm" or "mil"', 'unit = "um"'),
    (
        "gap_ok_v = [-18.0, -2.0]",
        "gap_ok_v = [-2.0, -18.0]",
        "sensors[0].gap_ok_v",
        "[-2.0, -18.0]",
        "lower limit",
        "[-18.0, -2.0]",
    ),
    (
        "gap_ok_v = [-18.0, -2.0]",
        "gap_ok_v = [-2, -2]",
        "sensors[0].gap_ok_v",
        "[-2, -2]",
        "lower limit",
        "two different",
    ),
    (
        "gap_ok_v = [-18.0, -2.0]",
        "gap_ok_v = [-18.0]",
        "sensors[0].gap_ok_v[1]",
        "",
        "one more value",
        "gap_ok_v = [-18.0, -2.0]",
    ),
    (
        "gap_ok_v = [-18.0, -2.0]",
        "gap_ok_v = [-18.0, -2.0, 0]",
        "sensors[0].gap_ok_v",
        "[-18.0, -2.0, 0]",
        "2 values",
        "gap_ok_v = [-18.0, -2.0]",
    ),
    ("gap_ok_v = [-18.0, -2.0]", "gap_ok_v = 3", "sensors[0].gap_ok_v", "3", "array", "[-18.0, -2.0]"),
    (
        "sensitivity_mv_per_unit = 7.87",
        "sensitivity_mv_per_unit = 0",
        "sensors[0].sensitivity_mv_per_unit",
        "0",
        "cannot be zero",
        "calibration sheet",
    ),
    ("angle_deg = 0.0", "angle_deg = 361", "sensors[0].angle_deg", "361", "360 or less", "angle_deg"),
    ("angle_deg = 0.0", "angle_deg = -361", "sensors[0].angle_deg", "-361", "-360 or more", "angle_deg"),
    (
        "damping_ratio = 0.18",
        "damping_ratio = 2.5",
        "machine.rotor.damping_ratio",
        "2.5",
        "2 or less",
        "0.18",
    ),
    ("deadband = 2.0", "deadband = -2.0", "alarms[0].deadband", "-2.0", "0 or more", "deadband = 0.0"),
    ('edge = "rising"', 'edge = "up"', "sensors[2].edge", '"up"', '"rising" or "falling"', 'edge = "rising"'),
    (
        'url = "mqtts://broker.example:8883"',
        'url = "broker.example"',
        "mqtt.url",
        '"broker.example"',
        "not the address",
        "mqtts://",
    ),
    (
        'url = "mqtts://broker.example:8883"',
        'url = "mqtts://broker:99999"',
        "mqtt.url",
        '"mqtts://broker:99999"',
        "not the address",
        "mqtts://",
    ),
    (
        'url = "mqtts://broker.example:8883"',
        'url = "mqtts://broker/topic"',
        "mqtt.url",
        '"mqtts://broker/topic"',
        "after host and port",
        "end the url",
    ),
    ('topic_root = "daqsvc"', 'topic_root = "a/#"', "mqtt.topic_root", '"a/#"', "'/' between", '"a"'),
    (
        'directory = "/var/lib/daqsvc"',
        "directory = 5",
        "store.directory",
        "5",
        "path in quotes",
        'directory = "/var/lib/daqsvc"',
    ),
    ("ring_s = 30.0", "ring_s = 1979-05-27", "pipeline.ring_s", "1979-05-27", "must be a number", "30.0"),
]
UNKNOWN_KEYS = [
    ("rate_hz = 640.0", "rate = 640.0", "streams.shaft.rate", "unknown key", "rate_hz?"),
    (
        "sensitivity_mv_per_unit = 7.87",
        "sensitivity = 7.87",
        "sensors[0].sensitivity",
        "unknown key",
        "did you mean sensitivity_mv_per_unit?",
    ),
    (
        "reorder_window_ms",
        "reorder_window",
        "streams.shaft.reorder_window",
        "unknown key",
        "reorder_window_ms?",
    ),
    ("zero_v = -10.0", "colour = 1", "sensors[0].colour", "unknown key", "remove it"),
    (
        'unit = "V"',
        'unit = "V"\ngap_ok_v = [1, 2]',
        "sensors[2].gap_ok_v",
        "a proximity probe, but this is a keyph",
        "remove it",
    ),
    (
        'detector = "rotor-bank"',
        'detector = "rotor-bank"\nalert = 1',
        "alarms[2].alert",
        "belongs to a level alarm or a voting alarm, but this is an alarm on a detector",
        "remove it",
    ),
    ("[store]", "[shop]\n[store]", "shop", "unknown key", "remove it"),
]
MISSING = [
    ("rate_hz = 640.0", "streams.shaft.rate_hz", "[streams.shaft]", "samples per second", "rate_hz = 640.0"),
    (
        'unit = "um"',
        "sensors[0].unit",
        "[[sensors]]",
        "unit of the position",
        'to the entry "probe-x" of sensors',
    ),
    ('type = "proximity"', "sensors[0].type", "[[sensors]]", "kind of sensor", 'add type = "proximity"'),
    (
        "samples_per_frame = 10",
        "streams.shaft.layout.samples_per_frame",
        "[streams.shaft.layout]",
        "samples per channel",
        "samples_per_frame = 10",
    ),
    ('driver = "can"', "buses.can0.driver", "[buses.can0]", "driver", 'driver = "can"'),
    ('site = "lab"', "site", "", "where the box is", 'site = "lab"'),
    ('directory = "/var/lib/daqsvc"', "store.directory", "[store]", "journal", "/var/lib/daqsvc"),
]


@pytest.mark.parametrize(("old", "new", "key", "value", "message", "remedy"), ONE_VALUE)
def test_a_wrong_value_is_named(old, new, key, value, message, remedy):
    problem, line = only_problem(LAVAL, (old, new))
    assert (problem.key, problem.value, problem.line) == (key, value, line)
    assert message in problem.message
    assert remedy in problem.remedy


@pytest.mark.parametrize(
    ("specimen", "old", "new", "message", "remedy"),
    [
        ("serial", 'framing = "lines"', 'framing = "line"', '"cobs", "sync" or "lines"', '"lines"?'),
        ("serial", 'framing = "lines"', "", "is missing", "add framing"),
        ("modbus", 'transport = "rtu"', 'transport = "rut"', '"tcp" or "rtu"', '"rtu"?'),
        ("modbus", 'way = "ring"', 'way = "rings"', '"registers", "fifo", "ring" or "waveform"', '"ring"?'),
    ],
)
def test_a_wrong_word_that_decides_on_the_kind_of_a_table_is_the_only_mistake(
    specimen: str, old: str, new: str, message: str, remedy: str
) -> None:
    path = ROOT / "tests" / "guard" / "specimens" / f"specimen-{specimen}.toml"
    (problem,) = problems_of(path.read_text("utf-8").replace(old, new, 1), path)
    assert message in problem.message
    assert remedy in problem.remedy


def test_what_no_kind_of_a_table_may_hold_is_wrong_whatever_the_kind() -> None:
    path = ROOT / "tests" / "guard" / "specimens" / "specimen-serial.toml"
    text = path.read_text("utf-8").replace('framing = "lines"', 'framing = "line"\ncolour = 1\nbaud = "x"', 1)
    text = text.replace("baud = 115_200\n", "", 1)
    assert {one.key for one in problems_of(text, path)} == {
        "buses.lines.framing",
        "buses.lines.colour",
        "buses.lines.baud",
    }


@pytest.mark.parametrize(("old", "new", "key", "message", "remedy"), UNKNOWN_KEYS)
def test_an_unknown_key_is_named(old, new, key, message, remedy):
    problem, line = only_problem(LAVAL, (old, new))
    assert problem.key == key
    assert problem.line in {line, line + 1}
    assert message in problem.message
    assert remedy in problem.remedy


@pytest.mark.parametrize(("old", "key", "table", "message", "remedy"), MISSING)
def test_a_missing_key_is_placed_at_its_table(old, key, table, message, remedy):
    text, _ = changed(LAVAL, (old, ""))
    (problem,) = problems_of(text)
    assert (problem.key, problem.value) == (key, "")
    assert text.split("\n")[problem.line - 1].startswith(table)
    assert message in problem.message
    assert remedy in problem.remedy


def test_a_problem_reads_as_one_line():
    text, line = changed(LAVAL, ("fd = true", 'fd = "yes"'))
    (problem,) = problems_of(text, Path("config/x.toml"))
    assert str(problem) == (
        f'config/x.toml:{line}: buses.can0.fd = "yes": must be true or false. Remedy: write fd = true [F07]'
    )


def test_mistakes_of_every_sort_do_not_hide_one_another():
    text, _ = changed(
        LAVAL,
        ("rate_hz = 640.0", 'rat_hz = "640"'),  # unknown key with a wrong value: meant is rate_hz
        ("id = 0x101", "id = 0x801"),  # does not fit, beside ...
        ('byte_order = "little"', 'byte_order = "middle"'),  # ... a wrong value in the same table
        ('channel = "x"', 'channel = "z"'),  # a reference, beside ...
        ('unit = "um"', 'unit = "inch"'),  # ... a wrong value in the same table
        ("noise_um = 2.0", ""),  # missing
        ("angle_deg = 90.0", "angle_deg = 180.0"),  # geometry, although the bank lacks its noise
        ("alert = 40.0", "alert = 80.0"),  # setpoints, beside ...
        ("on_delay_s = 1.0", "on_dlay_s = 1.0"),  # ... an unknown key in the same table
        ("mqtts://", "mqtt://"),
    )
    problems = problems_of(text)
    assert [problem.key for problem in problems] == [
        "streams.shaft.rat_hz",
        "streams.shaft.rat_hz",
        "streams.shaft.layout.id",
        "streams.shaft.layout.byte_order",
        "sensors[0].channel",
        "sensors[0].unit",
        "pipeline.rotor_bank.noise_um",
        "pipeline.rotor_bank.probes",
        "alarms[0].alert",
        "alarms[0].on_dlay_s",
        "mqtt.url",
    ]
    lines = [problem.line for problem in problems]
    assert lines == sorted(lines)


def test_whole_tables_missing_or_of_the_wrong_kind():
    problems = problems_of(
        "schema_version = 1\nmachine = 3\n[buses]\ncan0 = true\n[[streams]]\n", Path("x.toml")
    )
    found = {problem.key: (problem.line, problem.remedy) for problem in problems}
    assert found == {
        "site": (1, 'add site = "lab" to the top of the file'),
        "box": (1, 'add box = "edge-1" to the top of the file'),
        "machine": (2, "write a table [machine]"),
        "buses.can0": (4, "write a table [buses.can0]"),
        "streams": (5, "write a table [streams.NAME] for each of the streams"),
        "sensors": (1, "write a table [[sensors]] for each of the sensors"),
    }


def test_arrays_without_entries():
    text, _ = changed(LAVAL, ('{ name = "N", damping_ratio = 0.18, severity = "normal" },\n', "\n"))
    start, end = text.index('  { name = "F1"'), text.index("]\n\n[[alarms]]")
    (problem,) = problems_of(text[:start] + text[end:])
    assert problem.key == "pipeline.rotor_bank.modes"
    assert problem.message == "must have at least 2 entries"
    start, end = text.index('  { name = "x"'), text.index("]\n\n[[sensors]]")
    assert "streams.shaft.layout.channels" in {item.key for item in problems_of(text[:start] + text[end:])}


def test_an_empty_file_names_all_that_is_missing():
    assert {problem.key for problem in problems_of("")} == {
        "schema_version",
        "site",
        "box",
        "machine",
        "buses",
        "streams",
        "sensors",
    }


def test_secrets_are_not_repeated():
    text, _ = changed(
        LAVAL,
        ('username = "daq"', 'username = "daq"\npassword = "hunter2"'),
        ("mqtts://broker", "mqtts://daq:hunter3@broker"),
    )
    with pytest.raises(MachineFileError) as caught:
        parse_machine_file(text, LAVAL)
    assert "hunter" not in str(caught.value)
    assert [problem.key for problem in caught.value.problems] == ["mqtt.url", "mqtt.password"]
    assert caught.value.problems[1].value == '"***"'
    assert "password_file" in caught.value.problems[1].remedy
    assert caught.value.__cause__ is None


def test_a_password_in_an_address_that_is_none():
    text, _ = changed(LAVAL, ("mqtts://broker", "daq:hunter2@broker"))
    problem = next(item for item in problems_of(text) if item.key == "mqtt.url")
    assert problem.value == '"***@broker.example:8883"'


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("a = 1\nb 2\n", 2, "column 3"),
        ("a = 1\na = 2\n", 2, "a is written twice: in line 1"),
        ("a = 1\na = 2", 2, "a is written twice: in line 1"),
        ("a = 1\nb = [1,\n", 2, "end of the file"),
        ("a = " + "[" * 100_000, 1, "nested too deeply"),
        ("a = 1\nb = " + "9" * 5000, 2, "hundreds of digits"),
        ("a = 1\nb = " + "9" * 40, 2, "b is too large for a whole number"),
    ],
)
def test_broken_toml(text, line, words):
    (problem,) = problems_of(text)
    assert problem.line == line
    assert words in problem.message


@pytest.mark.parametrize(
    ("text", "line", "remedy"),
    [
        ('[x]\n"a" = 1\nb = 2\na = 3\n', 4, "remove one of the two lines"),
        ("[x]\na = 1\n[y]\n[x]\nb = 2\n", 4, "move what it holds to the first one, or give it another name"),
        ("[[alarms]]\na = 1\n[alarms]\n", 3, "write [[alarms]] in line 3, too"),
        ("[alarms]\na = 1\n[[alarms]]\n", 3, "write [[alarms]] in line 1, too"),
        ("[[machine]]\na = 1\n[machine]\n", 3, "write [machine], and only once"),
        ("x = [{ a = 1, a = 2 }]\n", 1, "remove one of the two"),
        ("[a.b]\n[a]\nb = 1\n", 3, "remove one of the two"),
        ('x = [\n{ name = "1,5", scale = 0,0001 },\n]\n', 2, "write scale = 0.0001, with a decimal point"),
        (
            "rate_hz = 12,800 # Hz\n",
            1,
            "write rate_hz = 12800, or rate_hz = 12.800 if the comma is a decimal comma",
        ),
        ("x = { a = 1,500, b = 2 }\n", 1, "write a = 1500, or a = 1.500 if the comma is a decimal comma"),
        ("scale = 0,001\n", 1, "write scale = 0.001, with a decimal point"),
        ("bits = 1,000,000\n", 1, "write bits = 1000000, without marks between thousands"),
        ("rate_hz = 640,\n", 1, "write rate_hz = 640, without the comma behind it"),
        (
            "host = 10.0.0.1,\n",
            1,
            "correct the TOML there: text is in quotes, tables are [name], values are key = value",
        ),
        ('site = "lab", # in Ulm\n', 1, 'write site = "lab", without the comma behind it'),
        ("x = { a = 1, }\n", 1, "remove this comma: [ ] may end with one, { } may not"),
        (
            'x = [\n{ a = ", }", b = { c = 1 ,} },\n]\n',
            2,
            "remove this comma: [ ] may end with one, { } may not",
        ),
        (
            "x = {\n a = 1,\n}\n",
            1,
            "write all that is between { and } in one line, or a separate table: [name]",
        ),
        (
            "x = { a = 1, # one\n b = 2 }\n",
            1,
            "write all that is between { and } in one line, or a separate table: [name]",
        ),
        ("rate_hz = 1.000,0\n", 1, "write rate_hz = 1000.0, without marks between thousands"),
        ("rate_hz = 1,000.5 # Hz\n", 1, "write rate_hz = 1000.5, without marks between thousands"),
        ("rate_hz = 12 000\n", 1, "write rate_hz = 12000, without marks between thousands"),
        ("site = \u201clab\u201d\n", 1, 'write site = "lab", with straight quotes'),
        ("site = \u201elab\u201c # in Ulm\n", 1, 'write site = "lab", with straight quotes'),
        ('site = "lab\u201d\n', 1, 'write site = "lab", with straight quotes'),
        ("x = { a = \u00abb\u00bb }\n", 1, 'write straight quotes (") in place of \u00ab'),
        (
            'file = "C:\\temp\\x.dbc"\n',
            1,
            "write file = 'C:\\temp\\x.dbc', in single quotes: there a backslash is only itself",
        ),
        ("bitrate = 250k\n", 1, "write bitrate = 250000, without a unit"),
        ("rate_hz = 5O\n", 1, "write rate_hz = 50, if the letter O is a zero"),
        ("rate_hz = 1O.5  # Hz\n", 1, "write rate_hz = 10.5, if the letter O is a zero"),
        (
            "streams.s.rate_hz = l2o\n",
            1,
            "write streams.s.rate_hz = 120, if the letter l is a one and the letter o is a zero",
        ),
        ("bitrate = 1 Mbit/s\n", 1, "write bitrate = 1000000, without a unit"),
        ("baud = 115200 8N1\n", 1, "write baud = 115200, without a unit"),
        ("on_delay_s = 300 ms\n", 1, "write on_delay_s = 0.3, without a unit"),
        ("latching = ja\n", 1, 'write latching = true, or "ja" if it is a text'),
        ("latching = No\n", 1, 'write latching = false, or "No" if it is a text'),
    ],
)
def test_a_slip_in_the_toml_is_told_what_to_write(text, line, remedy):
    (problem,) = problems_of(text)
    assert (problem.line, problem.remedy) == (line, remedy)


@pytest.mark.parametrize(
    ("old", "new", "remedy"),
    [
        ("speed_rpm = 600.0", 'speed_rpm = "990 rpm"', "write speed_rpm = 990.0, a number alone"),
        ("speed_rpm = 600.0", 'speed_rpm = "16.5 Hz"', "write speed_rpm = 990.0, a number alone"),
        ("on_delay_s = 1.0", 'on_delay_s = "3 s"', "write on_delay_s = 3.0, a number alone"),
        ("on_delay_s = 1.0", 'on_delay_s = "250 ms"', "write on_delay_s = 0.25, a number alone"),
        ("speed_rpm = 600.0", 'speed_rpm = "99O"', "write speed_rpm = 990.0, if the letter O is a zero"),
        ("bitrate = 500_000", 'bitrate = "25O000"', "write bitrate = 250000, if the letter O is a zero"),
        ("bitrate = 500_000", 'bitrate = "250k"', "write bitrate = 250000, a number alone"),
        ("bitrate = 500_000", 'bitrate = "1 MBit/s"', "write bitrate = 1000000, a number alone"),
        ("bitrate = 500_000", 'bitrate = "250000 8N1"', "write bitrate = 250000, a number alone"),
        ("bitrate = 500_000", 'bitrate = "250 of these"', "write bitrate = 500000 (bit rate of the bus)"),
        ("length = 64", 'length = "12.5 bytes"', "write length = 64"),
        ("fd = true", 'fd = "nein"', "write fd = false"),
    ],
)
def test_a_remedy_keeps_the_number_of_the_user_where_it_can_be(old, new, remedy):
    problem, _ = only_problem(LAVAL, (old, new))
    assert problem.remedy.startswith(remedy)


def test_files_that_cannot_be_read(tmp_path):
    def problem_of(path):
        with pytest.raises(MachineFileError) as caught:
            load_machine_file(path)
        (problem,) = caught.value.problems
        assert str(path) in str(problem)
        return problem

    assert "no such file" in problem_of(tmp_path / "none.toml").message
    assert "is a directory" in problem_of(tmp_path).message
    latin = tmp_path / "latin.toml"
    latin.write_bytes('# fine\nsite = "Köln"\n'.encode("latin-1"))
    assert problem_of(latin).line == 2
    assert "not UTF-8: byte 0xf6 at column 10" in problem_of(latin).message
    latin.write_bytes(LAVAL.read_text(encoding="utf-8").encode("utf-16"))
    assert "looks like UTF-16" in problem_of(latin).message


def test_a_file_of_another_user(tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refused)
    with pytest.raises(MachineFileError, match="may not be read by this user"):
        load_machine_file(tmp_path / "x.toml")


def test_a_byte_order_mark_is_no_mistake(tmp_path):
    marked = tmp_path / "marked.toml"
    marked.write_bytes(b"\xef\xbb\xbf" + LAVAL.read_bytes())
    assert load_machine_file(marked).machine.name == "laval-rig"


@pytest.mark.parametrize("name", [".", ".."])
def test_dots_alone_are_no_name_and_are_not_proposed(name):
    problem, _ = only_problem(LAVAL, ('name = "laval-rig"', f'name = "{name}"'))
    assert problem.key == "machine.name"
    assert problem.message.endswith("dots alone are no name")
    assert problem.remedy == "give it a name"


@pytest.mark.parametrize(
    ("rate", "verb"), [("rate_hz = 0", "write"), ("rate_hz = -1.0", "write"), ("", "add")]
)
def test_the_rate_of_values_that_are_polled_is_that_of_no_waveform(rate, verb):
    file = MACHINES / "modbus-vibration-temperature.toml"
    text = file.read_text("utf-8")
    assert "rate_hz = 1.0\n" in text
    with pytest.raises(MachineFileError) as refused:
        parse_machine_file(text.replace("rate_hz = 1.0\n", f"{rate}\n", 1), file)
    assert f"Remedy: {verb} rate_hz = 1.0 " in str(refused.value)


def test_a_remedy_shows_what_is_usual_of_what_is_allowed():
    file = MACHINES / "serial-probes.toml"
    text = file.read_text("utf-8")
    with pytest.raises(MachineFileError) as refused:
        parse_machine_file(text.replace('driver = "serial"\n', 'driver = "serial"\ndata_bits = 9\n', 1), file)
    assert "e.g. data_bits = 8" in str(refused.value)
