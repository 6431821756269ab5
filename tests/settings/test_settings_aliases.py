"""A key that is called as other tools call it is recognised; one in the wrong place is shown its own."""

from __future__ import annotations

import pytest
from support.machine_files import LAVAL, MACHINES, MOTOR, TRIAXIAL, changed, problems_of

from daqsvc.settings.aliases import _WORDS, meant_key
from daqsvc.settings.models import machine_file_model
from daqsvc.settings.schema import _homes

PUMP = MACHINES / "modbus-vibration-temperature.toml"
SERIAL = MACHINES / "serial-probes.toml"


@pytest.mark.parametrize(
    ("path", "old", "new", "meant"),
    [
        (PUMP, "baud = 19_200", "baudrate = 19_200", "baud"),
        (PUMP, "baud = 19_200", "baud_rate = 19_200", "baud"),
        (PUMP, "serial_port =", "port =", "serial_port"),
        (PUMP, "serial_port =", "device =", "serial_port"),
        (PUMP, "unit = 1", "slave_id = 1", "unit"),
        (PUMP, "address = 17", "register = 17", "address"),
        (PUMP, "timeout_ms = 500.0", "timeout = 500.0", "timeout_ms"),
        (PUMP, "timeout_ms = 500.0", "timeout_s = 0.5", "timeout_ms"),
        (PUMP, "alert_low = 2.0", "low = 2.0", "alert_low"),
        (SERIAL, "baud = ", "baudrate = ", "baud"),
        (SERIAL, "rate_hz", "fs", "rate_hz"),
        (LAVAL, "rate_hz = 640.0", "sample_rate = 640.0", "rate_hz"),
        (LAVAL, "rate_hz = 640.0", "sampling-rate = 640.0", "rate_hz"),
        (LAVAL, "rate_hz = 640.0", "samplin_rate = 640.0", "rate_hz"),
        (LAVAL, "id = 0x101", "can_id = 0x101", "id"),
        (LAVAL, "length = 64", "dlc = 64", "length"),
        (LAVAL, "byte_order =", "endianness =", "byte_order"),
        (LAVAL, "alert = 40.0", "warning = 40.0", "alert"),
        (LAVAL, "danger = 60.0", "trip = 60.0", "danger"),
        (LAVAL, "deadband = 2.0", "hysteresis = 2.0", "deadband"),
        (LAVAL, "speed_rpm = 600.0", "rpm = 600.0", "speed_rpm"),
        (LAVAL, "damping_ratio = 0.18  ", "zeta = 0.18  ", "damping_ratio"),
        (LAVAL, "ca_file =", "ca =", "ca_file"),
        (LAVAL, "username =", "user =", "username"),
        (LAVAL, "url =", "broker =", "url"),
        (LAVAL, "directory =", "path =", "directory"),
        (LAVAL, "window_s = 0.5", "averaging_time = 0.5", "window_s"),
        (LAVAL, "sensitivity_mv_per_unit = 7.87 ", "mv_per_um = 7.87 ", "sensitivity_mv_per_unit"),
        (TRIAXIAL, '"x", signals = ', '"x", signal = ', "signals"),
        (MOTOR, "bitrate = 500_000", "baudrate = 500_000", "bitrate"),
    ],
)
def test_a_word_of_the_trade_is_understood(path, old, new, meant):
    text, line = changed(path, (old, new))
    # The one problem: the value under the wrong name is taken for what was meant.
    (problem,) = problems_of(text, path)
    assert (problem.line, problem.message) == (line, "unknown key")
    assert problem.remedy == f"did you mean {meant}?"


def test_a_port_of_the_metrics_is_where_they_listen():
    text, _ = changed(SERIAL, ("[pipeline]\n", '[metrics]\nport = "127.0.0.1:9555"\n\n[pipeline]\n'))
    (problem,) = problems_of(text, SERIAL)
    assert problem.remedy == "did you mean listen?"


@pytest.mark.parametrize(
    ("path", "old", "new", "home"),
    [
        (SERIAL, "[streams.casing]", '[streams.casing]\nseparator = ","', "[streams.NAME.layout]"),
        (LAVAL, 'bus = "can0"', 'bus = "can0"\nring_s = 30.0', "[pipeline]"),
        (LAVAL, "[pipeline]", "[pipeline]\nlatching = true", "[[alarms]]"),
        (LAVAL, "[pipeline]", "[pipeline]\ntopic_root = 'x'", "[mqtt]"),
    ],
)
def test_a_key_in_the_wrong_table_is_shown_its_place(path, old, new, home):
    text, _ = changed(path, (old, new))
    (problem,) = problems_of(text, path)
    assert problem.message == "unknown key"
    assert problem.remedy == f"move it to {home}, where it belongs"


@pytest.mark.parametrize(
    ("old", "new", "remedy"),
    [
        ("[[alarms]]", "[[alarm]]", "write [[alarms]]"),
        ("[[sensors]]", "[[sensor]]", "write [[sensors]]"),
        ("[buses.can0]", "[bus.can0]", "write [buses.NAME]"),
        ("[streams.shaft]", "[stream.other]\n[streams.shaft]", "write [streams.NAME]"),
    ],
)
def test_a_table_without_its_s_is_told_the_header_that_was_meant(old, new, remedy):
    text = LAVAL.read_text(encoding="utf-8").replace(old, new, 1)
    problem = next(one for one in problems_of(text, LAVAL) if one.message == "unknown key")
    assert problem.remedy == remedy
    assert not [one for one in problems_of(text, LAVAL) if "alarm_handling" in one.remedy]


@pytest.mark.parametrize(
    ("old", "new", "count", "key"),
    [
        ("[[sensors]]", "[[sensor]]", 1, "sensor"),
        ("[[sensors]]", "[[Sensors]]", 1, "Sensors"),
        ("[[sensors]]", "[[snesors]]", 2, "snesors"),
        ("[[sensors]]", "[[sensor]]", -1, "sensor"),
        ("[streams.", "[stream.", 1, "stream"),
        ("[pipeline.rotor_bank]", "[pipelin.rotor_bank]", 1, "pipelin"),
    ],
)
def test_a_misspelt_table_beside_a_right_one_is_all_that_is_told(old, new, count, key):
    text = LAVAL.read_text(encoding="utf-8")
    (problem,) = problems_of(text.replace(old, new, count), LAVAL)
    assert (problem.key, problem.message) == (key, "unknown key")


def test_a_fault_in_a_misspelt_table_is_told_where_it_is():
    text = LAVAL.read_text(encoding="utf-8")
    text = text.replace("[[sensors]]", "[[sensor]]", 1).replace('type = "proximity"', 'type = "proximty"', 1)
    unknown, other = problems_of(text, LAVAL)
    assert (unknown.key, other.key) == ("sensor", "sensor[0].type")
    assert "proximty" in text.splitlines()[other.line - 1]


def test_an_unknown_key_in_a_misspelt_table_is_told_too():
    text = LAVAL.read_text(encoding="utf-8")
    text = text.replace("[[sensors]]", "[[sensor]]\ncolour = 3", 1)
    assert [problem.key for problem in problems_of(text, LAVAL)] == ["sensor", "sensor[0].colour"]


def test_a_key_is_not_sent_to_the_table_where_it_is():
    text = (MACHINES / "dbc-triaxial.toml").read_text(encoding="utf-8")
    text = text.replace("dbc = ", "dbcx = ").replace("message = ", "mssage = ")
    problem = next(one for one in problems_of(text, LAVAL) if one.key.endswith("counter.signal"))
    assert problem.remedy.startswith("remove it; possible here: ")


def test_a_table_within_a_table_is_told_its_whole_header():
    text = (MACHINES / "bearing.toml").read_text(encoding="utf-8")
    text = text.replace("[[pipeline.bearing.bearings]]", "[[pipeline.bearing.bearing]]", 1)
    problem = next(one for one in problems_of(text, LAVAL) if one.message == "unknown key")
    assert problem.remedy == "write [[pipeline.bearing.bearings]]"
    (problem,) = problems_of(
        text.replace("[[pipeline.bearing.bearing]]", "[[pipeline.bearing.bearings]]").replace(
            "[pipeline.levels]", "[pipeline.level]"
        ),
        LAVAL,
    )
    assert problem.remedy == "did you mean levels?"


def test_a_key_is_not_sent_to_a_table_that_the_file_does_not_have():
    text = LAVAL.read_text(encoding="utf-8") + '\n[recorder]\nfolder = "/data"\n'
    (problem,) = problems_of(text, LAVAL)
    assert problem.key == "recorder.folder"
    assert problem.remedy.startswith("remove it; possible here: ")


def test_every_word_leads_to_a_key_that_there_is():
    keys = set(_homes(machine_file_model()))
    assert {key for meant in _WORDS for key in meant} <= keys
    for meant, words in _WORDS.items():
        for word in words.split():
            assert meant_key(word, meant) in meant, word


def test_what_is_called_by_no_word_is_not_guessed():
    assert meant_key("flux_capacitor", ["rate_hz", "baud"]) is None
    assert meant_key("baudrate", ["rate_hz"]) is None


def test_a_number_where_an_address_belongs_gets_an_address_as_its_remedy():
    text, _ = changed(SERIAL, ("[pipeline]\n", "[metrics]\nlisten = 9555\n\n[pipeline]\n"))
    (problem,) = problems_of(text)
    assert problem.message == "must be text in quotes"
    assert problem.remedy.startswith('write listen = "127.0.0.1:9464"')
