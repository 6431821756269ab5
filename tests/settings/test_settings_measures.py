"""Machine files with measures of the standards: what becomes of them, to the alarm, and what cannot be."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from support.clocks import SettableClock
from support.machine_files import LAVAL, MACHINES, TRIAXIAL, only_problem, parsed
from support.paths import ROOT

from daqsvc.alarms.events import Identity
from daqsvc.alarms.make import alarm_rule
from daqsvc.alarms.manager import AlarmManager
from daqsvc.detectors.make import detectors, plugins
from daqsvc.diagnosis.detector import Window
from daqsvc.diagnosis.reading import Reading
from daqsvc.diagnosis.recorded import RecordingOptions
from daqsvc.publish.make import watched
from daqsvc.settings import parse_machine_file
from daqsvc.settings.describe import describe
from daqsvc.settings.zones import Zones, boundaries
from sim_hw.plants.rotor import keyphasor_voltage

SPECIMEN = ROOT / "tests" / "guard" / "specimens" / "specimen-measures.toml"
PUMP = MACHINES / "modbus-vibration-temperature.toml"
RATE_HZ = 4000.0
ZONES = 'zones = { standard = "iso-20816-3", group = 2, support = "rigid" }'


@dataclass
class Product:
    """A machine from its file to its alarms: samples in, events out."""

    text: str = SPECIMEN.read_text(encoding="utf-8")
    told: list = field(default_factory=list)

    def __post_init__(self):
        self.machine = parse_machine_file(self.text, SPECIMEN)
        (self.levels,) = detectors(self.machine)
        self.clock = SettableClock()
        rules = [alarm_rule(alarm) for alarm in self.machine.alarms]
        self.alarms = AlarmManager(Identity("lab", "edge-1", "specimen-measures"), rules, self.clock)
        self._index = 0

    def run(self, seconds=3.0, *, first=20.0, lag_deg=135.0, second=5.0, lag_2_deg=350.0, g=0.0, pulses=True):
        """The shaft turns at 600 rpm; what the alarms say."""
        index = self._index + np.arange(round(seconds * RATE_HZ))
        turns = index * 10.0 / RATE_HZ
        angle = math.tau * turns
        x = first * np.cos(angle - math.radians(lag_deg)) + second * np.cos(
            2 * angle - math.radians(lag_2_deg)
        )
        x += np.random.default_rng(len(index)).normal(0.0, 0.05, len(index))
        housing = g * np.sin(math.tau * 5.0 * index / RATE_HZ) + np.random.default_rng(1).normal(
            0.0, 1e-6, len(index)
        )
        volts = keyphasor_voltage(turns) if pulses else np.full(len(index), -10.0)
        samples = np.column_stack((x, x, volts, housing)).astype(np.float32)
        self._index += len(index)
        t_ns = round(self._index * 1e9 / RATE_HZ)
        window = Window(int(index[0]), samples, t_ns, 1e9 / RATE_HZ)
        events = []
        for said in self.levels.process(window):
            self.clock.advance(max(said.t_ns - self.clock.t_ns, 0) / 1e9)
            events += self.alarms.take(said)
        self.told += [event.message for event in events]
        return [(event.alarm, event.kind.value, event.to_level.label) for event in events]


def test_from_the_file_to_the_alarm_on_a_vector():
    product = Product()
    assert product.run() == []
    assert product.run(lag_deg=170.0) == [("region", "raised", "alert")]
    assert "1x_phase_lag of probe-x is 170 deg, 35" in product.told[-1]
    assert product.run(lag_deg=135.0) == [("region", "returned", "normal")]
    assert product.run(first=2.0) == [("region", "raised", "alert")]
    assert "1x_amplitude of probe-x is 1.999 um, lower alert limit 5 um" in product.told[-1]


def test_from_the_file_to_what_holds_while_the_keyphasor_is_lost():
    product = Product()
    product.run()
    assert product.run(lag_deg=170.0) == [("region", "raised", "alert")]
    lost = product.run(10.0, pulses=False)
    assert lost == [("sensor-ok/probe-x", "raised", "alert"), ("sensor-ok/probe-y", "raised", "alert")]
    assert "keyphasor has no pulses that tell the angle of the shaft" in product.told[-1]
    # What needs no angle is judged as ever.
    assert ("shaft-zones", "raised", "alert") in product.run(first=190.0, second=0.1, pulses=False)
    assert ("shaft-zones", "returned", "normal") in product.run(pulses=False)
    back = product.run(15.0)
    assert sorted(back) == [
        ("region", "returned", "normal"),
        ("sensor-ok/probe-x", "returned", "normal"),
        ("sensor-ok/probe-y", "returned", "normal"),
    ]


def test_a_recording_without_the_keyphasor_has_all_but_the_phases():
    machine = parsed(SPECIMEN)
    ((plugin, settings),) = plugins(machine)
    recorded = plugin.recorded(machine, settings, RecordingOptions())
    assert recorded.as_recorded({"probe-x", "keyphasor"}) == settings
    without = recorded.as_recorded({"probe-x"})
    assert without == settings.model_copy(update={"keyphasor": None})


def test_from_the_file_to_the_alarm_on_2x_over_360():
    product = Product()
    assert product.run(lag_2_deg=10.0) == []
    assert product.run(lag_2_deg=25.0) == [("phase", "raised", "alert"), ("phase-vote", "raised", "alert")]


def test_from_the_file_to_the_zone_of_a_slow_machine():
    product = Product()
    product.run()
    # 5 Hz: 10 Hz to 1000 Hz would not see it. 3 mm/s are in zone C of group 2 on a rigid support.
    g = 3.0 * 2**0.5 * math.tau * 5.0 / 9806.65
    assert product.run(g=g) == [("zones", "raised", "alert")]
    assert "velocity_rms_2_1000 of accel is 3" in product.told[-1]
    assert "zone C of ISO 20816-3" in product.told[-1]
    assert product.run(g=2.0 * g) == [("zones", "escalated", "danger")]


def test_from_the_file_to_the_zone_of_a_shaft():
    product = Product()
    limits = product.machine.alarms[-1]
    assert limits.boundaries == pytest.approx([k / math.sqrt(600.0) for k in (4800, 9000, 13_200)], rel=1e-3)
    assert limits.setpoints == {"alert": limits.boundaries[1], "danger": limits.boundaries[2]}
    product.run()
    events = product.run(first=190.0, second=0.1)
    assert ("shaft-zones", "raised", "alert") in events
    assert any("zone C of ISO 20816-3" in message for message in product.told)


def test_what_is_listed_is_read_and_told_what_is_not_is_as_before():
    told = {(one.detector, one.key): one.unit for one in watched(parsed(SPECIMEN)).readings}
    assert told["levels/probe-x", "kurtosis"] == ""
    assert told["levels/probe-y", "2x_amplitude"] == "um"
    assert told["levels/accel", "not_1x_rms"] == "g"
    assert told["levels/accel", "velocity_rms_2_1000"] == "mm/s"
    assert ("levels/probe-x", "velocity_rms_2_1000") not in told
    plain = watched(parsed(LAVAL)).readings
    assert Reading("levels/probe-x", "statistics", "rms", "um") in plain
    assert not [one for one in plain if one.key in {"kurtosis", "1x_amplitude"}]


def test_what_an_alarm_watches_is_read_once_each_also_its_phase():
    """Its trend is what somebody wants to see who was called by it."""
    machine = parsed(LAVAL, ('measure = "rms"   ', 'measure = "peak_to_peak"   '))
    told = [(one.detector, one.key, one.unit) for one in watched(machine).readings]
    assert ("levels/probe-x", "peak_to_peak", "um") in told
    assert len(told) == len(set(told))
    plain = {(one.detector, one.key) for one in watched(parsed(LAVAL)).readings}
    assert ("levels/probe-x", "peak_to_peak") not in plain
    of_phase = {(one.detector, one.key): one.unit for one in watched(parsed(SPECIMEN)).readings}
    assert of_phase["levels/probe-x", "1x_phase_lag"] == "deg"


def test_what_an_alarm_is_judged_by_is_described():
    text = " ".join(describe(parsed(SPECIMEN)).split())
    assert "off 0 s; phase off 135 deg: alert 30 and danger 60 deg" in text
    assert "2x_phase_lag of probe-y 30 deg - 0 deg, on 0 s, off 0 s; off 350 deg" in text
    assert (
        "velocity_rms_2_1000 of accel 2.8 mm/s 4.5 mm/s 0 mm/s, on 0 s, off 0 s; zones of ISO 20816-3" in text
    )
    assert "shaft angle from keyphasor" in text


@pytest.mark.parametrize(
    ("group", "support", "boundaries"),
    [
        (1, "rigid", (2.3, 4.5, 7.1)),
        (1, "flexible", (3.5, 7.1, 11.0)),
        (2, "rigid", (1.4, 2.8, 4.5)),
        (2, "flexible", (2.3, 4.5, 7.1)),
    ],
)
def test_zones_are_those_of_the_class_of_machine(group, support, boundaries):
    machine = parsed(SPECIMEN, ('group = 2, support = "rigid"', f'group = {group}, support = "{support}"'))
    alarm = machine.alarms[2]
    assert alarm.boundaries == boundaries
    assert (alarm.alert, alarm.danger) == boundaries[1:]


@pytest.mark.parametrize(("unit", "um"), [("um", 1.0), ("mm", 1000.0), ("mil", 25.4)])
def test_zones_of_a_shaft_follow_from_its_speed_in_the_unit_of_its_probes(unit, um):
    found = boundaries(Zones(standard="iso-20816-3", shaft=True), -3600.0, unit)
    assert found == pytest.approx((80.0 / um, 150.0 / um, 220.0 / um), rel=1e-3)


def test_stated_limits_win_over_zones_and_a_trend_value_has_zones_too():
    stated = parsed(SPECIMEN, (ZONES, f"alert = 2.0\n{ZONES}"))
    assert stated.alarms[2].setpoints == {"alert": 2.0, "danger": 4.5}
    pump = parsed(PUMP, ("alert = 2.8\ndanger = 4.5\n", f"{ZONES}\n"))
    assert pump.alarms[0].setpoints == {"alert": 2.8, "danger": 4.5}
    assert pump.warnings == ()


@pytest.mark.parametrize(
    ("replacements", "key", "message", "remedy"),
    [
        (
            [(', support = "rigid"', "")],
            "alarms[2].zones",
            "lack support",
            "group = 2, support = ",
        ),
        (
            [('group = 2, support = "rigid"', "shaft = true")],
            "alarms[2].zones.shaft",
            'needs proximity probes, but "accel" is an accelerometer',
            "write group and support",
        ),
        (
            [("shaft = true", "shaft = true, group = 1")],
            "alarms[4].zones.group",
            "has no effect on the shaft",
            "remove it",
        ),
        (
            [("shaft = true", 'group = 1, support = "rigid"')],
            "alarms[4].zones",
            '"probe-x" is a proximity probe',
            "shaft = true",
        ),
        (
            [('measure = "peak_to_peak"\nzones', 'measure = "rms"\nzones')],
            "alarms[4].zones.shaft",
            "not of rms",
            'write measure = "peak_to_peak"',
        ),
        (
            [('"velocity_rms_2_1000"\nzones', '"kurtosis"\nzones')],
            "alarms[2].zones",
            "kurtosis is none",
            'write measure = "velocity_rms"',
        ),
        (
            [(ZONES, f"alert = 5.0\n{ZONES}")],
            "alarms[2].alert",
            "must be below danger = 4.5, where zone D begins",
            "write danger as well",
        ),
        (
            [(ZONES, f"danger = 2.0\n{ZONES}")],
            "alarms[2].danger",
            "must be above alert = 2.8, where zone C begins",
            "write alert as well",
        ),
        ([("reference_deg = 350.0", "")], "alarms[1]", "does not state from where", "add reference_deg"),
        (
            [("alert = 30.0\nreference", "alert = 190.0\nreference")],
            "alarms[1].alert",
            "no phase is farther than 180 deg",
            "e.g. 30.0",
        ),
        (
            [("alert_low = 5.0", "reference_deg = 5.0")],
            "alarms[0].reference_deg",
            "goes with a phase, not with 1x_amplitude",
            "phase = { reference_deg",
        ),
        (
            [('"1x_amplitude"\nalert_low = 5.0', '"peak"')],
            "alarms[0].phase",
            "goes with an amplitude, not with peak",
            'write measure = "1x_amplitude" or "2x_amplitude"',
        ),
        ([("alert = 30.0, danger = 60.0, ", "")], "alarms[0].phase", "has neither alert", "in degrees"),
        ([("danger = 60.0, ", "danger = 20.0, ")], "alarms[0].phase.alert", "below danger = 20", "swap"),
        (
            [("deadband = 3.0", "deadband = 30.0")],
            "alarms[0].phase.deadband",
            "must be smaller than the setpoint 30",
            "deadband = 1.5",
        ),
        (
            [("window_s = 1.0", "window_s = 0.15")],
            "pipeline.levels.window_s",
            "1.5 revolutions",
            "0.2 or more",
        ),
        (
            [('keyphasor = "keyphasor"', 'keyphasor = "accel"')],
            "pipeline.levels.keyphasor",
            'must be a sensor of type "keyphasor"',
            "keyphasor",
        ),
        (
            [('keyphasor = "keyphasor"', 'keyphasor = "keyfasor"')],
            "pipeline.levels.keyphasor",
            "there is no such sensor",
            '"keyphasor"',
        ),
    ],
)
def test_what_cannot_be_is_named_once_with_a_remedy(replacements, key, message, remedy):
    problem, _ = only_problem(SPECIMEN, *replacements)
    assert problem.key == key
    assert message in problem.message
    assert remedy in problem.remedy


def test_a_phase_without_a_keyphasor_is_refused_and_an_amplitude_is_not():
    alarm = '[[alarms]]\nname = "p"\nsensor = "probe-x"\nmeasure = "{}"\nalert = 30.0\n{}\n[alarm_handling]'
    of_phase = alarm.format("1x_phase_lag", "reference_deg = 10.0")
    problem, _ = only_problem(LAVAL, ("[alarm_handling]", of_phase))
    assert problem.key == "alarms[3].measure"
    assert problem.remedy == 'write keyphasor = "keyphasor" in [pipeline.levels]'
    assert parsed(LAVAL, ("[alarm_handling]", alarm.format("1x_amplitude", ""))).warnings == ()


def test_a_phase_of_another_stream_than_the_keyphasor_is_refused():
    other = "[streams.other]" + LAVAL.read_text().partition("[streams.shaft]")[2].partition("[[sensors]]")[0]
    other = other.replace("streams.shaft.", "streams.other.").replace("0x101", "0x102")
    replacements = [
        ("[[sensors]]", f"{other}[[sensors]]"),
        (
            'name = "probe-y"\ntype = "proximity"\nstream = "shaft"',
            'name = "probe-y"\ntype = "proximity"\nstream = "other"',
        ),
        ("window_s = 0.5", 'window_s = 0.5\nkeyphasor = "keyphasor"'),
        (
            'sensor = "probe-y"\nmeasure = "rms"',
            'sensor = "probe-y"\nmeasure = "1x_phase_lag"\nreference_deg = 1.0',
        ),
        ("[pipeline.rotor_bank]", "[pipeline.alignment]\nmax_error_us = 300.0\n\n[pipeline.rotor_bank]"),
    ]
    problem, _ = only_problem(LAVAL, *replacements)
    assert problem.key == "alarms[1].measure"
    assert '"probe-y" is in stream "other", but keyphasor "keyphasor" is in stream "shaft"' in problem.message


@pytest.mark.parametrize(
    ("path", "replacements", "key", "message"),
    [
        (
            SPECIMEN,
            [("speed_rpm = 600.0", "speed_rpm = 900.0")],
            "alarms[2].zones",
            "from 10 Hz on at 900 rpm",
        ),
        (
            SPECIMEN,
            [('"velocity_rms_2_1000"\nzones', '"velocity_rms"\nzones')],
            "alarms[2].zones",
            "from 2 Hz on at 600 rpm, and this one begins at 10 Hz",
        ),
        (
            TRIAXIAL,
            [("[10.0, 400.0]", "[20.0, 400.0]"), ("alert = 2.8\ndanger = 4.5\n", f"{ZONES}\n")],
            "alarms[0].zones",
            "begins at 20 Hz",
        ),
        (
            LAVAL,
            [("window_s = 0.5", 'window_s = 0.5\nkeyphasor = "keyphasor"')],
            "pipeline.levels.keyphasor",
            "has no effect",
        ),
        (
            LAVAL,
            [("window_s = 0.5", 'window_s = 0.5\nmeasures = ["velocity_rms_2_1000"]')],
            "pipeline.levels.measures[0]",
            "has no effect",
        ),
        (
            LAVAL,
            [("window_s = 0.5", 'window_s = 0.5\nmeasures = ["kurtosis", "kurtosis"]')],
            "pipeline.levels.measures[1]",
            "is listed twice",
        ),
    ],
)
def test_what_should_be_looked_at_is_a_warning(path, replacements, key, message):
    warnings = parsed(path, *replacements).warnings
    assert [(one.key, message in one.message) for one in warnings] == [(key, True)]


def test_velocity_from_2_hz_needs_its_rate_and_wants_its_window():
    fast = parsed(SPECIMEN, ("window_s = 1.0", "window_s = 0.5"))
    assert {one.key for one in fast.warnings} == {"pipeline.levels.measures[1]", "alarms[2].measure"}
    problem, _ = only_problem(
        TRIAXIAL, ("window_s = 1.0", 'window_s = 1.0\nmeasures = ["velocity_rms_2_1000"]')
    )
    assert problem.key == "pipeline.levels.measures[0]"
    assert "must be below 500 Hz, half the rate" in problem.message
    assert "velocity_band_hz = [2.0, 400.0]" in problem.remedy


def test_a_measure_without_brackets_is_refused_with_how_to_write_it():
    listed = 'measures = ["kurtosis", "velocity_rms_2_1000", "2x_amplitude", "not_1x_rms"]'
    problem, _ = only_problem(SPECIMEN, (listed, 'measures = "kurtosis"'))
    assert problem.message == "must be an array in brackets"
    assert problem.remedy.startswith('write measures = ["kurtosis"] (')


@pytest.mark.parametrize("measure", ["peak_to_peak", "rms", "gap_voltage"])
def test_a_measure_that_is_always_computed_needs_no_entry(measure: str) -> None:
    listed = ('["kurtosis", "velocity_rms_2_1000", ', f'["kurtosis", "{measure}", ')
    problem, _ = only_problem(SPECIMEN, listed)
    assert problem.key == "pipeline.levels.measures[1]"
    assert problem.message == "needs no entry: it is always computed where the sensor gives it"
    assert problem.remedy == "take it out of the array"


MOTOR = MACHINES / "motor-accelerometer.toml"
BAND = "velocity_band_hz = [10.0, 1000.0]"
ON_VELOCITY = ('measure = "rms"', 'measure = "velocity_rms"')
IN_ZONES = ('measure = "rms"\nalert = 0.11\ndanger = 0.30', f'measure = "velocity_rms"\n{ZONES}')


@pytest.mark.parametrize("watching", [ON_VELOCITY, IN_ZONES], ids=["own limits", "zones"])
@pytest.mark.parametrize(
    ("rate_hz", "rpm", "band", "remedy"),
    [
        (100, 2820, "10.0, 40.0", "have the device send 121 samples a second or more, and end"),
        (50, 1480, "10.0, 20.0", "have the device send 63.2 samples a second or more, and end"),
        (12_000, 1480, "10.0, 20.0", "write velocity_band_hz = [10.0, 1000.0] in [pipeline.levels]"),
        (100, 2820, "10.0, 47.0", None),
        (120, 2820, "10.0, 48.0", None),
        (12_000, 2820, "10.0, 1000.0", None),
    ],
)
def test_an_alarm_on_a_velocity_without_1x_is_warned_of(watching, rate_hz, rpm, band, remedy):
    changes = [("12_000.0", f"{rate_hz:.1f}"), ("1796.0", f"{rpm:.1f}"), ("[10.0, 1000.0]", f"[{band}]")]
    warnings = [one for one in parsed(MOTOR, *changes, watching).warnings if f"{one.code}" == "A18"]
    assert len(warnings) == (remedy is not None)
    for one in warnings:
        assert one.key == "alarms[0].measure"
        assert f"turns at {rpm / 60:.4g} Hz" in one.message
        assert f'"drive-end-rms" watches {band.replace(", ", " Hz to ").replace(".0", "")} Hz' in one.message
        assert f"rate_hz = {rate_hz}" in one.message
        assert remedy in one.remedy


def test_a_velocity_that_begins_above_a_slow_machine_is_warned_of():
    (warning,) = parsed(MOTOR, ("1796.0", "300.0"), ON_VELOCITY).warnings
    assert (f"{warning.code}", warning.key) == ("A18", "alarms[0].measure")
    assert "write velocity_band_hz = [2.0, 1000.0]" in warning.remedy
    (zones,) = parsed(MOTOR, ("1796.0", "300.0"), IN_ZONES).warnings
    assert f"{zones.code}" == "A14"  # once


def test_a_stream_too_slow_for_1x_has_no_velocity_unless_a_band_is_stated():
    slow = [("12_000.0", "60.0"), (BAND, "")]
    machine = parsed(MOTOR, *slow)
    assert machine.warnings == ()
    assert "no velocity RMS of accel-de: sampled too slowly" in " ".join(describe(machine).split())
    assert "velocity_rms" not in [one.key for one in watched(machine).readings]
    (levels,) = detectors(machine)
    samples = np.random.default_rng(1).normal(size=(100, 1)).astype(np.float32)
    first, *_ = levels.process(Window(0, samples, 2_000_000_000, 2e7))
    assert "rms" in first.statistics
    assert "velocity_rms" not in first.statistics
    lost, *_ = levels.process(Window(200, samples, 6_000_000_000, 2e7, skipped=100))
    assert "velocity_rms" not in lost.bounds
    # What an alarm watches is needed.
    problem, _ = only_problem(MOTOR, *slow, ON_VELOCITY)
    assert problem.key == "pipeline.levels.velocity_band_hz"
    # A band could be stated: 1X is 29.93 Hz, and 640 samples a second show 256 Hz.
    problem, _ = only_problem(MOTOR, ("12_000.0", "640.0"), (BAND, ""))
    assert "write velocity_band_hz = [10.0, 256.0]" in problem.remedy


RMS_ONLY = [(BAND, ""), ("window_s = 0.5", "window_s = 2.0")]
SLOW = 'write type = "trend" for the sensor'


@pytest.mark.parametrize(("rate_hz", "warned"), [(10, True), (59, True), (60, False), (12_000, False)])
def test_samples_too_slow_for_1x_are_warned_of(rate_hz, warned):
    warnings = parsed(MOTOR, ("12_000.0", f"{rate_hz:.1f}"), *RMS_ONLY).warnings
    assert len(warnings) == warned
    for one in warnings:
        assert (f"{one.code}", one.key) == ("F34", "streams.drive-end.rate_hz")
        assert f"nothing above {rate_hz / 2:g} Hz, and the machine turns at 29.93 Hz" in one.message
        assert "RMS and peak of accel-de do not show" in one.message
        assert "send 76.7 samples a second or more; or, if the device sends a level" in one.remedy
        assert SLOW in one.remedy


def test_samples_too_slow_for_1x_are_warned_of_once():
    slow = [("12_000.0", "10.0"), ("[10.0, 1000.0]", "[1.0, 4.0]"), ("window_s = 0.5", "window_s = 2.0")]
    (warning,) = parsed(MOTOR, *slow, ON_VELOCITY).warnings
    assert f"{warning.code}" == "A18"
    assert SLOW in warning.remedy
    assert 'measure = "rms"' not in warning.remedy  # of which the next warning would be


def test_too_short_a_window_of_slow_samples_may_be_one_of_levels():
    problem, _ = only_problem(MOTOR, ("12_000.0", "10.0"), (BAND, ""))
    assert problem.key == "pipeline.levels.window_s"
    assert problem.remedy.startswith("have the device send 76.7 samples a second or more; or, if the device ")
    assert 'write type = "trend" for the sensor' in problem.remedy


@pytest.mark.parametrize(
    ("limits", "warned"),
    [
        ('measure = "rms"\nalert = 40.0\ndanger = 60.0', True),
        ('measure = "gap_voltage"\nalert = -5.0\ndanger = -3.0', False),
    ],
)
def test_slow_samples_of_a_probe_show_the_position_of_the_shaft_only(limits, warned):
    text = LAVAL.read_text(encoding="utf-8")
    bank, alarm, fault, handling = map(
        text.index, ("[pipeline.rotor_bank]", "[[alarms]]", "# on what the model", "[alarm_handling]")
    )
    text = text[:bank] + text[alarm:fault].rpartition("[[alarms]]")[0] + text[handling:]
    for old, new in (
        ("rate_hz = 640.0", "rate_hz = 10.0"),
        ("window_s = 0.5", "window_s = 2.0"),
        ('  # "rms", "peak" or "crest_factor"', ""),
        ('measure = "rms"\nalert = 40.0\ndanger = 60.0', limits),
    ):
        assert old in text
        text = "\n".join(line.rstrip() for line in text.replace(old, new).split("\n"))
    found = [one for one in parse_machine_file(text, LAVAL).warnings if f"{one.code}" == "F34"]
    assert len(found) == warned
    for one in found:
        assert one.key == "streams.shaft.rate_hz"
        assert "RMS and peak of probe-x, probe-y do not show" in one.message
