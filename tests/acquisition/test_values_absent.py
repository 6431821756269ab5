"""Raw values that are no measurements: SAE J1939's ranges, and those that a machine file names."""

from __future__ import annotations

import logging
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.alarm_rig import AlarmRig
from support.machine_files import MACHINES, TRIAXIAL, only_problem, parsed

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.alarms.make import alarm_rule
from daqsvc.detectors.levels.detector import LevelChannel, LevelDetector
from daqsvc.detectors.levels.statements import Limits
from daqsvc.diagnosis.detector import Window
from daqsvc.settings import load_machine_file
from drivers.can.dbc import layout_from_dbc
from drivers.can.plugin import frame_layout
from drivers.frames import FrameLayout, LayoutError

pytestmark = pytest.mark.property
LARGEST = {8: 0xFA, 16: 0xFAFF, 24: 0xFAFFFF, 32: 0xFAFFFFFF}
"""SAE J1939-71, table 1."""


def layout(bits: int = 16, kind: str = "unsigned", **changes: object) -> FrameLayout:
    given = {
        "frame_id": 0x18FF0380,
        "extended": True,
        "any_priority": True,
        "length": 8,
        "channels": [("a", bits, kind, 0.01, -320.0)],
        "samples_per_frame": 1,
        "counter_byte": 7,
        "counter_bits": 8,
        "counts": "frames",
        "first_byte": 0,
    }
    return FrameLayout.plain(**(given | changes))  # type: ignore[arg-type]


def payload(raw: int, bits: int) -> np.ndarray:
    return np.frombuffer((raw % 2**bits).to_bytes(7, "little") + b"\0", np.uint8)[None]


def decoded(layout: FrameLayout, raw: int, bits: int = 16) -> float:
    return float(layout.decode(payload(raw, bits)).samples[0, 0, 0])


@given(bits=st.sampled_from([8, 16, 24, 32]), data=st.data())
def test_j1939_keeps_its_highest_values_for_what_is_no_measurement(bits: int, data: st.DataObject) -> None:
    border = st.integers(LARGEST[bits] - 3, min(LARGEST[bits] + 3, 2**bits - 1))
    raw = data.draw(st.integers(0, 2**bits - 1) | border)
    value = decoded(layout(bits), raw, bits)
    if raw > LARGEST[bits]:
        assert math.isnan(value)
    else:
        assert value == np.float32(raw * 0.01 - 320.0)


@given(raw=st.integers(-(2**15), 2**15 - 1))
def test_a_signed_value_of_a_manufacturer_is_no_such_parameter(raw: int) -> None:
    assert decoded(layout(kind="signed"), raw) == np.float32(raw * 0.01 - 320.0)


@given(
    samples=st.lists(st.floats(-320.0, 322.5) | st.just(math.nan), min_size=2, max_size=2),
    bits=st.sampled_from([16, 24]),
)
def test_what_a_device_does_not_have_is_encoded_as_not_available(samples: list[float], bits: int) -> None:
    given_b = {"b": (-32767.0, 32767.0)}
    two = layout(
        channels=[("a", bits, "unsigned", 0.01, -320.0), ("b", 16, "signed", 0.01, 0.0)], valid_raw=given_b
    )
    sent = two.encode(np.array([0]), np.array([[samples]]))
    at = bits // 8
    if math.isnan(samples[0]):
        assert sent[0, :at].tobytes() == b"\xff" * at
    if math.isnan(samples[1]):
        assert sent[0, at : at + 2].tobytes() == b"\x00\x80"
    np.testing.assert_allclose(two.decode(sent).samples[0, 0], samples, atol=0.0051)


def test_a_value_beyond_the_range_saturates_and_does_not_turn_into_none() -> None:
    for value, raw in ((1e9, 0xFAFF), (-1e9, 0)):
        sent = layout().encode(np.array([0]), np.full((1, 1, 1), value), clip=True)
        assert int.from_bytes(sent[0, :2].tobytes(), "little") == raw
    with pytest.raises(LayoutError, match="323 does not fit a 16-bit unsigned field"):
        layout().encode(np.array([0]), np.full((1, 1, 1), 323.0))


def test_nothing_says_that_there_is_no_value_unless_some_raw_value_does() -> None:
    plain = layout(any_priority=False)
    assert decoded(plain, 0xFFFF) == np.float32(335.35)
    with pytest.raises(
        LayoutError, match=r"nan does not fit .*; state in valid_raw which raw value means none"
    ):
        plain.encode(np.array([0]), np.full((1, 1, 1), math.nan), clip=True)
    everything = layout(valid_raw={"a": (0.0, 65535.0)})
    assert decoded(everything, 0xFFFF) == np.float32(335.35)


def test_a_float_carries_nan_itself_and_infinity_stays_what_it_is() -> None:
    floats = layout(channels=[("a", 32, "float", 1.0, 0.0), ("b", 16, "unsigned", 1.0, 0.0)])
    sent = floats.encode(np.array([0]), np.array([[[math.nan, 7.0]]]))
    assert math.isnan(floats.decode(sent).samples[0, 0, 0])
    infinite = np.frombuffer(np.array([np.inf], "<f4").tobytes() + bytes(4), np.uint8)[None]
    assert floats.decode(infinite).samples[0, 0, 0] == np.inf


def test_a_data_base_of_j1939_has_the_ranges_by_itself(tmp_path) -> None:
    path = tmp_path / "j1939.dbc"
    path.write_text(
        'VERSION ""\nBU_: N\n'
        f"BO_ {0x98FF0380} Accel: 8 N\n"
        ' SG_ X : 0|16@1+ (0.01,-320) [0|0] "m/s2" N\n SG_ Count : 56|8@1+ (1,0) [0|0] "" N\n'
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\n'
    )
    read = layout_from_dbc(path, "Accel", counter="Count", counts="frames", channels={"x": ["X"]})
    assert math.isnan(decoded(read, 0xFE00))
    assert decoded(read, 0xFAFF) == np.float32(0xFAFF * 0.01 - 320.0)


def test_absent_values_are_counted_beside_the_samples_and_said_once(caplog: pytest.LogCaptureFixture) -> None:
    blocks = []
    stream = StreamAssembler(
        "s", 100.0, counter_bits=8, samples_per_frame=1, counts_per_frame=1, deliver=blocks.append
    )
    samples = np.ones((40, 1, 3), np.float32)
    samples[5:12, 0, 1] = np.nan
    samples[30, 0, :] = np.nan
    samples[35, 0, :2] = np.inf, -np.inf
    with caplog.at_level(logging.WARNING):
        for start in range(0, 40, 10):
            part = slice(start, start + 10)
            counter = np.arange(40)[part]
            stream.accept(counter, samples[part], np.ones(10, np.bool_), counter * 10_000_000)
        stream.flush()
    counters = stream.counters
    assert (counters.samples_received, counters.samples_lost, counters.values_absent) == (40, 0, 12)
    values = np.concatenate([block.samples for block in blocks])
    assert np.isnan(values).sum() == 12
    assert (values[np.isfinite(values)] == 1.0).all()
    assert [r.message for r in caplog.records if "no measurement in" in r.message] == [caplog.messages[0]]


def test_a_sensor_without_values_neither_raises_nor_clears_an_alarm() -> None:
    machine = load_machine_file(MACHINES / "j1939-accelerometer.toml")
    (rule,) = [rule for rule in map(alarm_rule, machine.alarms) if rule.alarm == "vibration-horizontal"]
    channel = LevelChannel("accel-y", 0, "g", [Limits("velocity_rms", 4.5, 7.1)])
    levels = LevelDetector("rig", "housing", 100.0, [channel], window_s=2.0, velocity_band_hz=(10.0, 45.0))
    rig = AlarmRig(rule)
    wire = layout(channels=[("y", 16, "unsigned", 0.001, -32.0)])
    t = np.arange(200) / 100.0
    strong, quiet = 1.0 * np.sin(2 * np.pi * 20 * t), 0.001 * np.sin(2 * np.pi * 20 * t)

    def play(samples: np.ndarray, times: int) -> None:
        for _ in range(times):
            sent = wire.encode(np.arange(200), samples[:, None, None])
            received = wire.decode(sent).samples.reshape(-1, 1)
            rig.clock.advance(2.0)
            for said in levels.process(Window(0, received, rig.clock.t_ns, 1e7)):
                rig.told(rig.manager.take(said))

    play(np.full(200, np.nan), 20)
    assert rig.status("vibration-horizontal").state.value == "normal"
    play(strong, 10)
    assert rig.status("vibration-horizontal").level.name == "DANGER"
    play(np.full(200, np.nan), 50)
    assert rig.status("vibration-horizontal").level.name == "DANGER"
    (said,) = [e for e in rig.events if e.alarm == "sensor-ok/accel-y"][-1:]
    assert "only 0 of 200 samples of accel-y are there" in said.message
    play(quiet, 10)
    assert rig.status("vibration-horizontal").level.name == "NORMAL"
    assert rig.status("sensor-ok/accel-y").level.name == "NORMAL"


def test_a_machine_file_names_the_raw_values_that_are_measurements() -> None:
    motor = MACHINES / "motor-accelerometer.toml"
    machine = parsed(motor, ('type = "int16"', 'type = "int16", valid_raw = [-32767, 32767]'))
    (stream,) = machine.streams
    read = frame_layout(machine, stream)
    frame = np.full((1, read.length), 0x55, np.uint8)
    frame[0, read.fields[0][0].start // 8 :][:2] = 0x00, 0x80
    samples = read.decode(frame).samples[0, :, 0]
    assert np.isnan(samples).tolist() == [True] + [False] * (read.samples_per_frame - 1)


def test_a_signal_of_a_data_base_has_them_too() -> None:
    machine = parsed(TRIAXIAL, ('name = "x"', 'valid_raw = [-2000, 2000], name = "x"'))
    (stream,) = machine.streams
    assert frame_layout(machine, stream).valid_raw == {"x": (-2000.0, 2000.0)}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("[32767, -32767]", "the least raw value that is a measurement must come first"),
        ("[-32768, 40000]", "does not lie within what int16 can carry, -32768 to 32767"),
        ("[0.5, 32767]", "has a fraction, which no int16 can carry"),
    ],
)
def test_a_range_that_cannot_be_is_refused(given: str, message: str) -> None:
    motor = MACHINES / "motor-accelerometer.toml"
    problem, _ = only_problem(motor, ('type = "int16"', f'type = "int16", valid_raw = {given}'))
    assert problem.key.endswith("channels[0].valid_raw")
    assert message in problem.message
