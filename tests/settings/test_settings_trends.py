"""Machine files with trend values: what becomes of them, and the combinations that cannot be."""

from __future__ import annotations

import pytest
from support.machine_files import LAVAL, MACHINES, MOTOR, changed, only_problem, parsed, problems_of

from daqsvc.alarms.make import alarm_rule
from daqsvc.alarms.rules import LevelRule
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.voting import VotingRule
from daqsvc.detectors.levels.detector import LevelDetector
from daqsvc.detectors.levels.trends import TrendDetector
from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.reading import Reading
from daqsvc.publish.make import watched
from daqsvc.settings import load_machine_file, parse_machine_file
from daqsvc.settings.alarms import StartUp
from daqsvc.settings.describe import describe

PUMP = MACHINES / "modbus-vibration-temperature.toml"
GAPS = MACHINES / "modbus-gap-voltages.toml"
SPEED = """
[[sensors]]
name = "shaft-speed"
type = "trend"
stream = "drive-end"
channel = "speed"
unit = "rpm"

[alarm_handling.start_up]
detector = "levels/shaft-speed"
measure = "value"
between = [100.0, 2700.0]
"""
SPEED_REGISTER = '{ name = "speed", address = 23, type = "uint16" },\n'
FIRST_REGISTER = '{ name = "vz", address = 17'
MQTT = (
    '[mqtt]\nurl = "mqtt://127.0.0.1"\ninsecure = true\n\n[mqtt.home_assistant]\nenabled = true\n\n[pipeline]'
)
PROBE_Y = 'channel = "y"\nunit = "um"\nsensitivity_mv_per_unit = 7.87\nzero_v = -10.0\ngap_ok_v'
GAP_ALARM = """[[alarms]]
name = "position"
sensor = "probe-x"
measure = "gap_voltage"
alert_low = -12.0
alert = -8.0
deadband = 0.2

[mqtt]"""


def starting_up(*more):
    """The pump with a speed among its registers, by which its start-up is known."""
    return [
        (FIRST_REGISTER, SPEED_REGISTER + "  " + FIRST_REGISTER),
        ("[pipeline]", SPEED + "\n[pipeline]"),
        ("alert = 2.8", "alert = 2.8\ntrip_multiply = 2.0"),
        *more,
    ]


def test_a_pump_becomes_detectors_rules_and_readings():
    machine = parsed(PUMP, ("[pipeline]", MQTT))
    assert machine.warnings == ()
    made = detectors(machine)
    assert [(type(one), one.name, one.block) for one in made] == [
        (TrendDetector, "trends/drive-end", 1),
        (TrendDetector, "trends/other-end", 1),
    ]
    vibration, _, temperature, _ = map(alarm_rule, machine.alarms)
    assert isinstance(vibration, VotingRule)
    assert (vibration.sensors, vibration.vote, vibration.measure) == (("de-axial", "de-radial"), 1, "value")
    assert isinstance(temperature, LevelRule)
    assert temperature.setpoint == Setpoint(80.0, 95.0, 2.0, 10 * 10**9, 10 * 10**9, 2.0, None)
    told = watched(machine)
    assert Reading("levels/de-temperature", "statistics", "value", "degC") in told.readings
    assert not [reading for reading in told.readings if reading.key != "value"]
    assert "sensor-ok/nde-radial" in told.services


def test_a_value_a_minute_is_shown_until_it_is_missed():
    text, _ = changed(PUMP, ("[pipeline]", MQTT))
    machine = parse_machine_file(text.replace("rate_hz = 1.0", "rate_hz = 0.0166667"), PUMP)
    stale_s = {reading.stale_s for reading in watched(machine).readings}
    assert stale_s == {210}
    fast = watched(parse_machine_file(text, PUMP)).readings
    assert {reading.stale_s for reading in fast} == {120}


def test_a_stream_may_have_waveforms_and_trend_values():
    text, _ = changed(GAPS, ('channel = "y"\nunit = "V"\nok_between', PROBE_Y))
    text = text.replace('name = "probe-y"\ntype = "trend"', 'name = "probe-y"\ntype = "proximity"')
    text = text.replace('"probe-y"\nmeasure = "value"', '"probe-y"\nmeasure = "gap_voltage"')
    level, trend = detectors(parse_machine_file(text, GAPS))
    assert (type(level), level.name, level.block) == (LevelDetector, "levels/gap", 20)
    assert (type(trend), trend.name, trend.block) == (TrendDetector, "trends/gap", 20)
    speaking = [said.detector for one in (level, trend) for said in one.silent(2.0, 0)]
    assert speaking == ["levels/probe-y", "levels/probe-x"]


def test_the_levels_of_a_window_are_described_as_one():
    text = describe(load_machine_file(GAPS))
    assert "-11..-9 V" in text
    assert "OK -18 to -2 V" in text


def test_a_gap_voltage_of_a_proximity_probe_has_a_window_too():
    machine = parsed(LAVAL, ("[mqtt]", GAP_ALARM))
    rule = alarm_rule(machine.alarms[-1])
    assert rule.setpoint == Setpoint(alert=-8.0, deadband=0.2, alert_low=-12.0)
    assert "-12..-8 V" in describe(machine)


def test_a_speed_that_is_polled_tells_of_a_start_up():
    machine = parsed(PUMP, *starting_up())
    assert machine.warnings == ()
    assert machine.alarm_handling.start_up == StartUp(
        detector="levels/shaft-speed", measure="value", between=(100.0, 2700.0)
    )


@pytest.mark.parametrize(
    ("path", "replacements", "key", "message", "remedy"),
    [
        (
            PUMP,
            [('measure = "value"\nalert_low', 'measure = "rms"\nalert_low')],
            "alarms[2].measure",
            'needs a waveform, but "de-temperature" is a trend value',
            'write measure = "value", with setpoints in degC',
        ),
        (
            LAVAL,
            [('measure = "rms"', 'measure = "value"')],
            "alarms[0].measure",
            'needs a trend value, but "probe-x" is a proximity probe',
            'write measure = "peak_to_peak", with setpoints from peak to peak, or type = "trend"',
        ),
        (
            MOTOR,
            [('measure = "rms"', 'measure = "gap_voltage"')],
            "alarms[0].measure",
            "is an accelerometer",
            'measure = "rms"',
        ),
        (
            LAVAL,
            [("alert = 40.0", "alert_low = 1.0\nalert = 40.0")],
            "alarms[0].alert_low",
            "does not go with rms: only value, gap_voltage, 1x_amplitude and 2x_amplitude have lower ",
            "remove it",
        ),
        (
            LAVAL,
            [
                ('measure = "rms"   ', 'measure = "crest_factor"   '),
                ("alert = 40.0", "alert = 1.0"),
                ("deadband = 2.0", "deadband = 0.1"),
            ],
            "alarms[0].alert",
            "greater than 1: crest_factor is never less",
            "write a setpoint above 1",
        ),
        (
            LAVAL,
            [("alert = 40.0", "alert = -40.0")],
            "alarms[0].alert",
            "greater than 0: rms is never less",
            "positive",
        ),
        (
            PUMP,
            [("alert_low = 2.0", "alert_low = 80.0")],
            "alarms[2].alert_low",
            "must be below alert = 80",
            "correct one",
        ),
        (
            PUMP,
            [("alert_low = 2.0", "alert_low = 200.0")],
            "alarms[2].alert_low",
            "must be below alert = 80",
            "swap",
        ),
        (
            PUMP,
            [("danger = 95.0", "danger = 120.0")],
            "alarms[2].danger",
            'never reached: it lies outside the OK limits -40 to 105 of "de-temperature"',
            "ok_between",
        ),
        (
            PUMP,
            [("deadband = 2.0", "deadband = 78.0")],
            "alarms[2].deadband",
            "smaller than the 78 between alert_low and alert, or the alarm never returns",
            "deadband = 3.9",
        ),
        (
            PUMP,
            [("deadband = 0.2", "deadband = 2.8")],
            "alarms[0].deadband",
            'smaller than the 2.8 that the OK limits 0 to 65 of "de-axial" leave beside alert',
            "deadband = 0.14",
        ),
        (
            PUMP,
            [("ok_between = [0.0, 65.0]", "ok_between = [65.0, 0.0]")],
            "sensors[0].ok_between",
            "the lower limit must come first",
            "write [0.0, 65.0]",
        ),
        (PUMP, [('unit = "mm/s" ', 'unit = " mm/s" ')], "sensors[0].unit", "is no unit", 'unit = "degC"'),
        (
            PUMP,
            [('unit = "mm/s" ', 'unit = "degC" ')],
            "alarms[0].sensors",
            "one setpoint for sensors in degC and mm/s",
            "one unit",
        ),
        (
            PUMP,
            [("[pipeline.levels]", "")],
            "alarms[0].sensors",
            "nothing measures their levels",
            "[pipeline.levels]",
        ),
        (
            PUMP,
            starting_up(('measure = "value"\nbetween', "between")),
            "alarm_handling.start_up.measure",
            "is nothing that levels/shaft-speed states",
            "value",
        ),
        (
            PUMP,
            starting_up(
                ("alert = 80.0\n", "alert = -20.0\ntrip_multiply = 2.0\n"), ("alert_low = 2.0\n", "")
            ),
            "alarms[2].trip_multiply",
            "multiplies alert and danger, which must be greater than 0 for that",
            "remove it",
        ),
    ],
)
def test_what_cannot_be_is_named_with_a_remedy(path, replacements, key, message, remedy):
    text, _ = changed(path, *replacements)
    problem = problems_of(text, path)[0]
    assert problem.key == key
    assert message in problem.message
    assert remedy in problem.remedy


def test_a_waveform_that_is_polled_once_a_second_is_said_to_be_a_trend_value():
    text, _ = changed(
        PUMP,
        ('type = "trend"                   # a level', 'type = "velocity" # a level'),
        ("ok_between = [0.0, 65.0]", ""),
    )
    found = {problem.key: problem for problem in problems_of(text, PUMP)}
    assert "1 Hz are fewer than 16 samples" in found["pipeline.levels.window_s"].message
    assert 'or type = "trend" for sensors whose level' in found["pipeline.levels.window_s"].remedy
    assert 'or type = "trend" for sensors whose level' in found["pipeline.levels.velocity_band_hz"].remedy
    assert "is a velocity sensor" in found["alarms[0].measure"].message


def test_a_band_has_no_effect_on_trend_values():
    (warning,) = parsed(
        PUMP, ("[pipeline.levels]", "[pipeline.levels]\nvelocity_band_hz = [2.0, 1000.0]\n#")
    ).warnings
    assert warning.key == "pipeline.levels.velocity_band_hz"
    assert "a trend value has the band of its device" in warning.message


def test_a_gap_voltage_needs_a_sensitivity():
    problem, _ = only_problem(
        LAVAL,
        ("[mqtt]", GAP_ALARM),
        ("sensitivity_mv_per_unit = 7.87 ", "# "),
        ("zero_v = -10.0", ""),
    )
    assert problem.key == "alarms[3].measure"
    assert 'is not known: "probe-x" has no sensitivity_mv_per_unit' in problem.message


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            '"degC"\nok_between = [-40.0, 105.0]',
            '"degC"',
            "0x8000 in its int16, by which many devices mean that ",
        ),
        (
            '"mm/s"\nok_between = [0.0, 65.0]\n\n[[sensors]]\nname = "de-t',
            '"mm/s"\n\n[[sensors]]\nname = "de-t',
            "0xFFFF",
        ),
    ],
)
def test_a_mark_for_no_value_that_would_be_a_value_is_warned_of(old, new, words):
    (warning,) = parsed(PUMP, (old, new)).warnings
    assert words in warning.message
    assert warning.message.endswith(("would be -1638.4 degC", "would be 65.535 mm/s"))
    mark = "0xFFFF" if words == "0xFFFF" else "0x8000"
    assert warning.remedy.startswith(
        f"write no_value = {mark} into its channel if the device's manual has it, or ok_between"
    )


def test_a_channel_that_names_its_mark_for_no_value_needs_no_ok_between():
    bare = ('"degC"\nok_between = [-40.0, 105.0]', '"degC"')
    marked = ('type = "int16", scale = 0.05', 'type = "int16", scale = 0.05, no_value = 0x8000')
    machine = parsed(PUMP, bare, marked)
    assert machine.warnings == ()
    marks = [
        channel.marks
        for channel in machine.streams[machine.sensors[0].stream].layout.channels
        if channel.no_value
    ]
    assert marks == [(-32_768,)]


@pytest.mark.parametrize(
    ("mark", "words"),
    [
        ("0x18000", "int16 cannot hold 98304"),
        ("[0x7FFF, -32769]", "int16 cannot hold -32769"),
    ],
)
def test_a_mark_that_the_type_cannot_hold_is_refused(mark, words):
    text, _ = changed(
        PUMP, ('type = "int16", scale = 0.05', f'type = "int16", scale = 0.05, no_value = {mark}')
    )
    (problem,) = problems_of(text, PUMP)
    assert problem.key.endswith("].no_value")
    assert problem.message == words


def test_a_number_without_a_scale_has_such_a_mark_if_an_alarm_watches_it():
    bare = ('"degC"\nok_between = [-40.0, 105.0]', '"degC"')
    raw = ('address = 19, type = "int16", scale = 0.05', 'address = 19, type = "int16"')
    (warning,) = parsed(PUMP, bare, raw).warnings
    assert warning.message.endswith("would be -32768 degC")
    unwatched = ('sensor = "de-temperature"', 'sensor = "nde-temperature"')
    assert parsed(PUMP, bare, raw, unwatched).warnings == ()


def test_a_number_of_32_bits_has_such_a_mark_and_a_float_has_none():
    bare = ('"degC"\nok_between = [-40.0, 105.0]', '"degC"')
    wide = ('address = 19, type = "int16", scale = 0.05', 'address = 65, type = "uint32", scale = 0.05')
    (warning,) = [one for one in parsed(PUMP, bare, wide).warnings if "no ok_between" in one.message]
    assert "0xFFFFFFFF in its uint32" in warning.message
    real = ('address = 19, type = "int16", scale = 0.05', 'address = 65, type = "float32", scale = 0.05')
    assert "no ok_between" not in "".join(one.message for one in parsed(PUMP, bare, real).warnings)


OK = "ok_between = [0.0, 65.0]"
IN_ZONES = (
    "alert = 2.8\ndanger = 4.5",
    'zones = { standard = "iso-20816-3", group = 1, support = "flexible" }',
)


def too_near(*changes):
    """The warnings about OK limits that end just above a setpoint, and no others."""
    warnings = parsed(PUMP, *changes).warnings
    assert {f"{one.code}" for one in warnings} <= {"A19"}
    return warnings


@pytest.mark.parametrize(
    ("high", "changes", "said", "least"),
    [
        (5.0, [], "danger = 4.5 of alarm", "6.8"),
        (6.7, [], "danger = 4.5 of alarm", "6.8"),
        (6.8, [], "", ""),
        (16.0, [IN_ZONES], "danger = 11 of alarm", "17"),
        (16.5, [IN_ZONES], "", ""),
        (4.0, [("alert = 2.8\ndanger = 4.5", "alert = 2.8")], "alert = 2.8 of alarm", "4.2"),
    ],
)
def test_ok_limits_that_end_just_above_danger_are_warned_of(high, changes, said, least):
    warnings = too_near((OK, f"ok_between = [0.0, {high}]"), *changes)
    assert len(warnings) == bool(said)
    for one in warnings:
        assert one.key == "sensors[0].ok_between"
        assert f'ends just above {said} "de-vibration". If the machine vibrates more than' in one.message
        assert f"end it at {least} mm/s or more" in one.remedy


def test_a_start_up_may_not_take_a_limit_beyond_the_ok_limits():
    text, _ = changed(PUMP, *starting_up((OK, "ok_between = [0.0, 8.9]")))
    (problem,) = problems_of(text, PUMP)
    assert (f"{problem.code}", problem.key) == ("A06", "alarms[0].trip_multiply")
    assert "has danger = 4.5 wait for 9 at a start-up, which is never reached" in problem.message
    assert problem.remedy == "make it at most 1.9, or have ok_between of the sensor end beyond 9"
    text, _ = changed(PUMP, *starting_up((OK, "ok_between = [0.0, 4.6]")))
    (problem,) = problems_of(text, PUMP)
    assert problem.remedy == "remove it, or have ok_between of the sensor end beyond 9"
    assert not parsed(PUMP, *starting_up((OK, "ok_between = [0.0, 9.0]"))).warnings


def test_zones_are_held_against_the_ok_limits():
    text, _ = changed(PUMP, (OK, "ok_between = [0.0, 10.0]"), IN_ZONES)
    (problem,) = problems_of(text, PUMP)
    assert (f"{problem.code}", problem.key) == ("A06", "alarms[0].danger")
    assert 'it lies outside the OK limits 0 to 10 of "de-axial"' in problem.message


@pytest.mark.parametrize(
    ("unit", "low", "warned"),
    [
        ("g", 0.0, True),
        ("in/s pk", 0.0, True),
        ("um", 0.0, True),
        ("mm p-p", 0.0, True),
        ("um", -5.0, False),  # a position of the shaft
        ("mm", 0.0, False),  # a level of oil, an expansion
        ("m/s", 0.0, False),  # a belt
        ("bar", 0.0, False),
        ("rpm", 0.0, False),
        ("V", 0.0, False),
    ],
)
def test_only_a_vibration_is_expected_far_beyond_danger(unit, low, warned):
    alone = ('sensors = ["de-axial", "de-radial"]\nvote = 1', 'sensor = "de-axial"')
    changes = [('unit = "mm/s" ', f'unit = "{unit}" '), (OK, f"ok_between = [{low}, 5.0]"), alone]
    assert len(too_near(*changes)) == warned


def test_ok_limits_that_end_where_the_channel_does_are_not_warned_of():
    channel = 'name = "vz", address = 17, type = "uint16", scale = 0.001'
    narrow = (channel, channel.replace("0.001", "0.0001"))
    assert too_near(narrow, (OK, "ok_between = [0.0, 6.5]")) == ()
    assert len(too_near(narrow, (OK, "ok_between = [0.0, 6.0]"))) == 1
