"""Bearings in a machine file: what they are told, and what they refuse to be told."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.bearing_signals import healthy
from support.machine_files import MACHINES, changed, only_problem, parsed, problems_of

from daqsvc.bearing.baseline import learn_baseline, save_bearing_baseline
from daqsvc.bearing.geometry import BearingOrders, bearing_orders
from daqsvc.cli import main
from daqsvc.detectors.bearing.build import pair_models
from daqsvc.detectors.bearing.detector import BearingDetector
from daqsvc.detectors.make import detectors
from daqsvc.dsp.speed.keyphasor import KeyphasorProbe
from daqsvc.settings import describe, parse_machine_file
from daqsvc.settings.problems import AssemblyError

EXAMPLE = MACHINES / "bearing.toml"
ROTOR = MACHINES / "rotor-synchronous.toml"
DRIVE_END = 'sensor = "accel-de"'
TYPE = 'type = "6205-2RS"'
ORDERS = "orders = { bpfi = 4.9469, bpfo = 3.0530, bsf = 1.9940, ftf = 0.3817 }"
GEOMETRY = "geometry = { balls = 9, ball_diameter_mm = 7.94, pitch_diameter_mm = 39.04 }"
MODEL = (
    "model = { masses_kg = [4.0, 0.0185, 2.0], stiffness_n_per_m = [2e7, 1e8, 5e7], "
    "damping_n_s_per_m = [200.0, 300.0, 2000.0] }"
)


machine = partial(parsed, EXAMPLE)


def detector(given, store=None):
    (made,) = (d for d in detectors(given, store) if isinstance(d, BearingDetector))
    return made


def test_the_detector_is_what_the_machine_file_says() -> None:
    given = machine(("false_alarm_probability = 1e-4", "false_alarm_probability = 1e-6"))
    assert given.detectors == ("bearing",)
    made = detector(given)
    assert (made.name, made.stream, made.block) == ("bearing", "housing", 12_800)
    first, second = made.bearings
    assert (first.name, first.sensor, first.column) == ("drive-end", "accel-de", 0)
    assert (second.name, second.sensor, second.column) == ("fan-end", "accel-fe", 1)
    assert first.orders == bearing_orders("6205-2RS")
    assert (second.orders.inner, second.orders.outer) == (4.9469, 3.0530)
    assert (second.orders.ball, second.orders.cage) == (1.9940, 0.3817)
    assert made.rules.false_alarm_probability == 1e-6
    assert made.baseline is None


def test_dimensions_make_the_orders_of_the_catalogue() -> None:
    first, _ = detector(machine((TYPE, GEOMETRY))).bearings
    assert first.orders.same_as(bearing_orders("6205-2RS"))
    tilted = GEOMETRY.replace(" }", ", contact_deg = 15.0 }")
    first, _ = detector(machine((TYPE, tilted))).bearings
    assert first.orders.outer == pytest.approx(4.5 * (1.0 - 7.94 / 39.04 * np.cos(np.radians(15.0))))
    text = " ".join(describe(machine((TYPE, GEOMETRY))).split())
    assert "drive-end (9 of 7.94 mm on 39.04 mm: BPFI 5.415, BPFO 3.585, BSF 2.357, FTF 0.3983)" in text


def test_what_was_understood_is_told() -> None:
    text = " ".join(describe(machine()).split())
    assert "drive-end (6205-2RS) by accel-de" in text
    assert "fan-end (BPFI 4.9469, BPFO 3.053, BSF 1.994, FTF 0.3817) by accel-fe" in text
    assert "the first 30 s are the healthy state, kept over restarts" in text
    kept = " ".join(describe(machine(("calibrate_s = 30.0", 'calibration = "motor.toml"'))).split())
    assert "healthy state in motor.toml" in kept


@pytest.mark.parametrize(
    ("replacements", "key", "message", "remedy"),
    [
        (((DRIVE_END, 'sensor = "accel-d"'),), "bearings[0].sensor", "no such sensor", 'mean "accel-de"'),
        (((TYPE, ""),), "bearings[0]", "neither type nor orders", "6205-2RS"),
        (((TYPE, f"{TYPE}\n{ORDERS}"),), "bearings[0]", "both type and orders", "bpfo"),
        (((TYPE, f"{TYPE}\n{GEOMETRY}"),), "bearings[0]", "both type and geometry", "balls"),
        (((TYPE, GEOMETRY.replace("9", "30", 1)),), "bearings[0].geometry", "30 balls", "measure"),
        (((TYPE, GEOMETRY.replace("balls = 9, ", "")),), "geometry.balls", "is missing", "balls = 9"),
        (
            (("bpfi = 4.9469", "bpfi = 148.4"), ("ftf = 0.3817", "ftf = 11.5")),
            "bearings[1].orders",
            "outer",
            "not in Hz",
        ),
        (
            (("bpfi = 4.9469", "bpfi = 3.0"),),
            "bearings[1].orders",
            "ftf < 0.5 < bpfo < bpfi",
            "per revolution",
        ),
        (
            (('name = "fan-end"', 'name = "drive-end"'),),
            "bearings[1].name",
            "earlier bearing",
            "its own name",
        ),
        (
            ((TYPE, f'{TYPE}\nrotor_sensor = "accel-fe"'),),
            "bearings[0].rotor_sensor",
            "without model",
            "remove it",
        ),
        (((TYPE, f"{TYPE}\n{MODEL}"),), "bearings[0].model", "without rotor_sensor", "remove it"),
        (
            ((TYPE, f'{TYPE}\nrotor_sensor = "accel-de"\n{MODEL}'),),
            "bearings[0].rotor_sensor",
            "on the housing",
            "rotor",
        ),
        ((("ring_s = 30.0", "ring_s = 4.0"),), "pipeline.bearing", "2 windows of 2.5 s", "ring_s = 5"),
        (
            (("speed_rpm = 1772.0", "speed_rpm = 300.0"),),
            "pipeline.bearing",
            "12.5 revolutions at 300 rpm",
            "too slow",
        ),
        ((("calibrate_s = 30.0", "calibrate_s = 3.0"),), "calibrate_s", "10", ""),
        ((("bsf = 1.9940, ", ""),), "orders.bsf", "is missing: how often a ball turns", "bsf = 2.357"),
    ],
)
def test_mistakes_are_told_with_key_and_remedy(replacements, key, message, remedy) -> None:
    problem, _ = only_problem(EXAMPLE, *replacements)
    assert key in problem.key
    assert message in problem.message
    assert remedy in problem.remedy


def test_sensors_that_measure_no_acceleration_or_too_slowly_are_refused() -> None:
    slow = problems_of(changed(EXAMPLE, ("rate_hz = 25_600.0", "rate_hz = 2_000.0"))[0], EXAMPLE)
    assert [p.message for p in slow if "bearings[0].sensor" in p.key] == [
        "is sampled at 2000 Hz: a bearing rings above 400 Hz"
    ]
    text = ROTOR.read_text().replace(
        "[[alarms]]",
        '[[pipeline.bearing.bearings]]\nname = "b"\nsensor = "probe-x"\ntype = "6205"\n[[alarms]]',
        1,
    )
    problems = problems_of(text, ROTOR)
    assert any('must be a sensor of type "accelerometer"' in p.message for p in problems)


def test_two_sensors_of_a_slow_stream_get_a_warning() -> None:
    pair = f'{TYPE}\nrotor_sensor = "accel-fe"\n{MODEL}'
    assert machine((TYPE, pair)).warnings == ()
    slow = machine((TYPE, pair), ("rate_hz = 25_600.0", "rate_hz = 12_800.0"))
    assert ["look alike" in str(warning) for warning in slow.warnings] == [True]


def test_two_sensors_of_a_bearing_tell_its_races_by_direction() -> None:
    pair = f'{TYPE}\nrotor_sensor = "accel-fe"\n{MODEL}'
    given = machine((TYPE, pair), ('unit = "g"', 'unit = "m/s2"'))
    assert "races also by direction with accel-fe" in " ".join(describe(given).split())
    first, second = detector(given).bearings
    assert (first.sensors, first.columns) == (("accel-fe", "accel-de"), (1, 0))
    assert first.two.model.m_s2_per_unit == (9.80665, 1.0)
    assert (
        first.two.model.parameters.m_b,
        first.two.model.parameters.k_c,
        first.two.model.parameters.c_h,
    ) == (
        0.0185,
        1e8,
        2000.0,
    )
    assert (second.two, second.sensors) == (None, ("accel-fe",))


def test_a_rate_too_low_for_the_rolling_elements_stops_it() -> None:
    pair = f'{TYPE}\nrotor_sensor = "accel-fe"\n{MODEL}'
    with pytest.raises(AssemblyError, match=r"bearings\[0\].model: at 7000 samples .* at 7717 Hz"):
        detector(machine((TYPE, pair), ("rate_hz = 25_600.0", "rate_hz = 7_000.0")))


def test_a_calibration_of_other_masses_or_without_the_pair_stops_it(right, tmp_path) -> None:
    pair, path = f'{TYPE}\nrotor_sensor = "accel-fe"\n{MODEL}', tmp_path / "motor.toml"
    given = machine((TYPE, pair))
    names = ("accel-fe", "accel-de")
    samples = dict(zip(names, (healthy(8.0, seed, rate_hz=25_600.0) for seed in (1, 2)), strict=True))
    together = [names, ("accel-fe",)]
    models = pair_models(given, given.pipeline.bearing)
    learnt = learn_baseline(samples, 25_600.0, 1772.0, ORDERS, together, pairs=models)
    named = ("calibrate_s = 30.0", f'calibration = "{path}"')
    save_bearing_baseline(learnt, path)
    kept = detector(machine((TYPE, pair), named)).baseline.pairs[names]
    assert kept.parameters == models[names].parameters
    np.testing.assert_array_equal(kept.detection.covariance, learnt.pairs[names].detection.covariance)
    with pytest.raises(AssemblyError, match="learnt with other masses, springs or dampers"):
        detector(machine((TYPE, pair.replace("1e8", "1.1e8")), named))
    save_bearing_baseline(replace(learnt, pairs={}), path)
    with pytest.raises(AssemblyError, match="holds nothing of accel-fe and accel-de together"):
        detector(machine((TYPE, pair), named))


KEYPHASOR = """
[[sensors]]
name = "key"
type = "keyphasor"
stream = "housing"
channel = "fe"
unit = "V"
threshold_v = -6.0
edge = "falling"
"""
FAN_END = (
    '[[sensors]]\nname = "accel-fe"\ntype = "accelerometer"\nstream = "housing"\nchannel = "fe"\nunit = "g"\n'
)


def with_keyphasor(*replacements):
    """One bearing, and a keyphasor on the other channel."""
    text = changed(EXAMPLE, (FAN_END, KEYPHASOR), ("calibrate_s", 'keyphasor = "key"\ncalibrate_s'))[0]
    second = text.index("[[pipeline.bearing.bearings]]", text.index("[[pipeline.bearing.bearings]]") + 1)
    text = text[:second] + text[text.index("[[alarms]]") :]
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    return text


def test_a_keyphasor_is_taken_up() -> None:
    given = parse_machine_file(with_keyphasor(), EXAMPLE)
    assert "by accel-de; speed by key;" in " ".join(describe(given).split())
    made = detector(given)
    assert made.keyphasor == KeyphasorProbe("key", 1, -6.0, 0.5, "falling")


@pytest.mark.parametrize(
    ("name", "message"),
    [("kay", "there is no such sensor"), ("accel-de", 'must be a sensor of type "keyphasor"')],
)
def test_a_speed_sensor_that_is_none_is_refused(name, message) -> None:
    problems = problems_of(with_keyphasor(('keyphasor = "key"', f'keyphasor = "{name}"')), EXAMPLE)
    assert [p.message for p in problems if p.key == "pipeline.bearing.keyphasor"] == [message]


def test_check_refuses_a_bearing_that_nobody_knows_with_near_names(tmp_path, capsys) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(changed(EXAMPLE, (TYPE, 'type = "6206-XX"'))[0])
    assert main(["check", str(path)]) != 0
    said = capsys.readouterr().err
    assert (
        "pipeline.bearing.bearings[0].type: bearing '6206-XX' is not in the catalogue; did you mean 6206? "
        "Give its dimensions" in said
    )


def test_an_alarm_follows_it_only_if_it_is_there() -> None:
    problem, _ = only_problem(ROTOR, ('detector = "rotor-synchronous"', 'detector = "bearing"'))
    assert "not configured" in problem.message
    assert "[pipeline.bearing]" in problem.remedy


def test_a_bearing_that_nobody_knows_stops_the_assembly() -> None:
    with pytest.raises(AssemblyError, match=r"bearings\[0\].type: bearing '6205-XX' is not in the"):
        detector(machine((TYPE, 'type = "6205-XX"')))
    with pytest.raises(AssemblyError, match=r"bearings\[1\].orders: BPFI 7 does not fit BPFO 3.053"):
        detector(machine(("bpfi = 4.9469", "bpfi = 7.0")))


ORDERS = {
    "accel-de": bearing_orders("6205"),
    "accel-fe": BearingOrders(inner=4.9469, outer=3.0530, ball=1.9940, cage=0.3817),
}


def baseline(rate_hz, speed_rpm, *sensors):
    samples = dict(zip(sensors, (healthy(8.0, seed, rate_hz=rate_hz) for seed in (1, 2)), strict=False))
    orders = {name: ORDERS[name] for name in sensors}
    units = dict.fromkeys(sensors, "g")
    return learn_baseline(samples, rate_hz, speed_rpm, orders, [(name,) for name in sensors], units=units)


@pytest.fixture(scope="module")
def right():
    return baseline(25_600.0, 1772.0, "accel-de", "accel-fe")


def test_a_calibration_that_fits_is_taken(right, tmp_path) -> None:
    path = tmp_path / "motor.toml"
    save_bearing_baseline(right, path)
    made = detector(machine(("calibrate_s = 30.0", f'calibration = "{path}"')))
    assert made.baseline.races == right.races


@pytest.mark.parametrize(
    ("rate_hz", "speed_rpm", "sensors", "said"),
    [
        (25_600.0, 1772.0, ("accel-de",), "holds nothing of accel-fe, but of accel-de"),
        (
            12_800.0,
            1772.0,
            ("accel-de", "accel-fe"),
            "at 12800 Hz, and the samples to be judged come at 25600 Hz",
        ),
        (
            25_600.0,
            3000.0,
            ("accel-de", "accel-fe"),
            "at 3000 rpm, and the machine turns at 1772 rpm; calibrate",
        ),
    ],
)
def test_a_calibration_that_does_not_fit_stops_it(tmp_path, rate_hz, speed_rpm, sensors, said) -> None:
    path = tmp_path / "motor.toml"
    save_bearing_baseline(baseline(rate_hz, speed_rpm, *sensors), path)
    key = rf"pipeline\.bearing\.calibration = '.*motor\.toml': .*{said}"
    with pytest.raises(AssemblyError, match=key):
        detector(machine(("calibrate_s = 30.0", f'calibration = "{path}"')))


def test_a_calibration_of_another_bearing_stops_it_and_one_that_names_none_is_taken(
    right, tmp_path, caplog
) -> None:
    path = tmp_path / "motor.toml"
    save_bearing_baseline(right, path)
    named = ("calibrate_s = 30.0", f'calibration = "{path}"')
    other = r"motor.toml: was learnt at accel-de of another bearing \(6205\) than is watched there \(6206\)"
    with pytest.raises(AssemblyError, match=other):
        detector(machine((TYPE, 'type = "6206-2RS"'), named))
    with pytest.raises(AssemblyError, match=r"\(6203 or .* is watched there \(BPFI 5.2, BPFO 3.2, BSF "):
        detector(machine(("bpfi = 4.9469, bpfo = 3.0530", "bpfi = 5.2, bpfo = 3.2"), named))
    assert detector(machine(("bpfi = 4.9469", "bpfi = 4.95"), named)).baseline.races == right.races
    assert not caplog.text, "it is another bearing by no more than how its orders are rounded"
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line for line in lines if not line.startswith("orders = ")))
    assert detector(machine((TYPE, 'type = "6206-2RS"'), named)).baseline.races["accel-fe"].orders is None
    assert "motor.toml: does not state of which bearing it was learnt at accel-de" in caplog.text


def test_a_calibration_in_another_unit_stops_it_and_one_that_names_none_is_taken(
    right, tmp_path, caplog
) -> None:
    path = tmp_path / "motor.toml"
    save_bearing_baseline(right, path)
    named = ("calibrate_s = 30.0", f'calibration = "{path}"')
    other = ('channel = "fe"\nunit = "g"', 'channel = "fe"\nunit = "m/s2"')
    with pytest.raises(
        AssemblyError,
        match=r"learnt at accel-fe in g, and the samples to be judged are in m/s2; cal",
    ):
        detector(machine(other, named))
    assert not caplog.text
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line for line in lines if not line.startswith("units = ")))
    assert detector(machine(other, named)).baseline.races == right.races
    assert "does not state in which unit it was learnt at accel-de, accel-fe" in caplog.text


def test_a_kept_state_is_taken_up_or_learnt_anew(right, tmp_path, caplog) -> None:
    save_bearing_baseline(right, tmp_path / "bearing.toml")
    assert detector(machine(), tmp_path).baseline.races == right.races
    (tmp_path / "bearing.toml").write_text("broken = ")
    with caplog.at_level(logging.WARNING):
        assert detector(machine(), tmp_path).baseline is None
    assert "learnt again" in caplog.text
