"""Lines of gears and motors are named as such, and no part of a bearing is named by them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import scipy.fft
from support.drive_trains import geared, motor_driven
from support.race_records import all_records, cwru
from support.race_signals import BEARING, RATE_HZ, SPEED_RPM, strikes

from daqsvc.bearing.race import judge, race_test
from daqsvc.dsp.drive_lines import SHARP, TOP_ORDER, LineLevels, drive_lines

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from daqsvc.dsp.drive_lines import DriveLines

SHAFT_HZ = SPEED_RPM / 60.0


def found(samples: NDArray[np.float64], shaft_hz: float = SHAFT_HZ) -> tuple[DriveLines, ...]:
    spectrum = scipy.fft.rfft(samples - samples.mean())
    levels = LineLevels(spectrum, RATE_HZ / len(samples), TOP_ORDER * shaft_hz)
    return drive_lines(levels, shaft_hz, known=SHARP)


@pytest.mark.parametrize(
    ("teeth", "mate"), [(23, 60), (43, 24), (61, 17), (33, 14), (19, 77), (37, 10), (57, 10)]
)
def test_a_gear_and_its_mate_are_counted(teeth: int, mate: int) -> None:
    (gear,) = found(geared(teeth, mate))
    assert (gear.kind, gear.teeth, gear.mate_teeth) == ("gear", teeth, mate)
    assert gear.frequency_hz == pytest.approx(teeth * SHAFT_HZ)
    assert gear.spacing == pytest.approx(teeth / mate)
    turns_rpm = SPEED_RPM * teeth / mate
    assert f"a gear of {teeth} teeth" in gear.describe()
    assert f"its mate of {mate} teeth turns at {turns_rpm:.0f} rpm" in gear.describe()


@pytest.mark.parametrize(("mains_hz", "poles", "slip"), [(50.0, 2, 0.01), (50.0, 4, 0.03), (60.0, 6, 0.02)])
def test_a_motor_its_poles_and_its_pole_pass_frequency_are_told(
    mains_hz: float, poles: int, slip: float
) -> None:
    rpm = 120.0 * mains_hz / poles * (1.0 - slip)
    pass_hz = poles * slip * 2.0 * mains_hz / poles
    (motor,) = found(motor_driven(rpm, mains_hz, pole_pass_hz=pass_hz), rpm / 60.0)
    assert (motor.kind, motor.poles) == ("motor", poles)
    assert motor.frequency_hz == pytest.approx(2.0 * mains_hz, abs=0.02)
    assert motor.spacing == pytest.approx(pass_hz / (rpm / 60.0), rel=0.01)
    assert f"{poles} poles, sidebands at the pole-pass frequency of {pass_hz:.2f} Hz" in motor.describe()
    (plain,) = found(motor_driven(rpm, mains_hz), rpm / 60.0)
    assert plain.spacing is None


def test_noise_bearings_and_harmonics_of_the_shaft_are_neither() -> None:
    for seed in range(5):
        assert found(strikes(None, 10.0, seed=seed)) == ()
        assert found(strikes("outer", 10.0, strength=4.0, seed=seed)) == ()
    t = np.arange(120_000) / RATE_HZ
    comb = sum(np.cos(2 * np.pi * k * SHAFT_HZ * t + k * k) for k in range(1, 60))
    assert found(comb + np.random.default_rng(0).standard_normal(len(t))) == ()
    # Twice the mains, and 4X of a shaft that turns with it.
    assert found(motor_driven(1500.0), 25.0) == ()


@pytest.mark.parametrize(("part", "mate"), [("outer", 24), ("ball", 49)])
def test_a_tooth_that_knocks_is_no_damaged_bearing(
    part: str, mate: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The mate turns half as often as balls pass the outer race, or a third as often as a ball strikes.
    teeth = {"outer": 43, "ball": 77}[part]
    samples = geared(teeth, mate, knock=14.0)
    verdict = race_test(samples, RATE_HZ, SPEED_RPM, BEARING)
    monkeypatch.setattr(judge, "drive_lines", lambda *_, **__: ())
    evidence = race_test(samples, RATE_HZ, SPEED_RPM, BEARING).evidence[part]
    assert evidence.z > evidence.z_limit, "a bearing's, if no gear were known"
    assert verdict.verdict == "normal"
    assert verdict.evidence[part].z < 3.0
    assert [drive.kind for drive in verdict.drives] == ["gear"]
    assert "is where the gear has one" in verdict.evidence[part].reason


def test_a_mate_that_knocks_is_no_faster_gear_and_no_other_machine() -> None:
    # Its knocks make lines at all multiples of its speed, so that every second pair is one of a faster mate.
    verdict = race_test(geared(43, 24, knock=6.0), RATE_HZ, SPEED_RPM, BEARING)
    assert [(drive.teeth, drive.mate_teeth) for drive in verdict.drives] == [(43, 24)]
    # The harmonics of the mate's speed are far more than those of the shaft.
    assert verdict.speed_seen
    assert verdict.notes == (verdict.notes[0],)
    assert "outer not testable" in verdict.notes[0]


def test_a_mate_that_turns_as_balls_pass_is_told_and_the_bearing_goes_first() -> None:
    verdict = race_test(geared(61, 17), RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.drives == ()
    assert verdict.evidence["outer"].testable
    (note,) = (note for note in verdict.notes if "mate" in note)
    assert "lines 3.588 orders apart about 61X" in note
    assert note.endswith("taken for the bearing's")


def test_a_part_is_less_sure_whose_order_a_gear_has_too() -> None:
    alone = race_test(strikes("outer", 10.0, strength=2.0, seed=5), RATE_HZ, SPEED_RPM, BEARING)
    beside = race_test(
        geared(61, 17) + strikes("outer", 10.0, strength=2.0, seed=5), RATE_HZ, SPEED_RPM, BEARING
    )
    assert alone.verdict == beside.verdict == "outer"
    assert any("taken for the bearing's" in note for note in beside.notes)
    assert alone.probability["outer"] > 0.9
    assert 0.6 < beside.probability["outer"] <= 0.7
    assert sum(beside.probability.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("part", ["inner", "outer"])
def test_a_motor_is_no_damaged_bearing(part: str) -> None:
    # The part's line is at twice the mains.
    rpm = 60.0 * 100.0 / getattr(BEARING, part)
    verdict = race_test(motor_driven(rpm), RATE_HZ, rpm, BEARING)
    assert verdict.verdict == "normal"
    assert [drive.kind for drive in verdict.drives] == ["motor"]
    evidence = verdict.evidence[part]
    assert not evidence.testable
    assert "is where the motor has one; test it at another speed" in evidence.reason
    assert any("not testable here" in note for note in verdict.notes)
    assert verdict.probability["normal"] <= 0.5, "damage would not be seen"


@pytest.mark.parametrize(("rpm", "mains_hz"), [(2960.0, 50.0), (3560.0, 60.0), (2985.0, 50.0)])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_motor_of_two_poles_turns_evenly_though_its_line_is_beside_2x(
    rpm: float, mains_hz: float, seed: int
) -> None:
    pass_hz = 2.0 * (mains_hz - rpm / 60.0)
    samples = motor_driven(rpm, mains_hz, pole_pass_hz=pass_hz, seed=seed)
    t = np.arange(len(samples)) / RATE_HZ
    beat = 1.0 + 0.3 * np.cos(2 * np.pi * pass_hz * t)
    samples += beat * (2.0 * np.cos(4 * np.pi * mains_hz * t) + np.sin(2 * np.pi * rpm / 60.0 * t))
    verdict = race_test(samples, RATE_HZ, rpm, BEARING)
    assert not any("wanders" in note for note in verdict.notes)
    assert [(drive.kind, drive.poles) for drive in verdict.drives] == [("motor", 2)]
    assert verdict.verdict == "normal"
    assert verdict.speed_rpm == pytest.approx(rpm, rel=3e-4)


@pytest.mark.parametrize("part", ["inner", "outer", "ball"])
def test_a_damaged_bearing_beside_a_gear_is_found(part: str) -> None:
    samples = geared(43, 24, knock=2.0) + strikes(part, 10.0, strength=2.0, seed=5)
    verdict = race_test(samples, RATE_HZ, SPEED_RPM, BEARING)
    assert verdict.verdict == part


@pytest.mark.data
def test_the_motor_of_a_measured_rig_is_recognised_and_no_gear(data: Path) -> None:
    # Case Western: a motor of 2 hp at 60 Hz, four poles (1797 rpm without load); no gears.
    told = [race_test(r.samples, r.rate_hz, r.speed_rpm, r.bearing).drives for r in cwru(data)]
    motors = [drive for drives in told for drive in drives if drive.kind == "motor"]
    assert len(motors) >= 0.6 * len(told)
    assert {motor.poles for motor in motors} == {4}
    assert all(abs(motor.frequency_hz - 120.0) < 0.25 for motor in motors)
    assert not [drive for drives in told for drive in drives if drive.kind == "gear"]


@pytest.mark.data
@pytest.mark.statistical
def test_no_measured_record_has_a_gear(data: Path) -> None:
    for record in all_records(data):
        verdict = race_test(record.samples, record.rate_hz, record.speed_rpm, record.bearing)
        assert all(drive.kind == "motor" for drive in verdict.drives), record.name
    # At the far end the cage of another, damaged bearing turns at exactly 0.4, as a mate of 90 teeth would.
    far = [race_test(r.samples, r.rate_hz, r.speed_rpm, r.bearing).drives for r in cwru(data, "FE")]
    assert sum(drive.kind == "gear" for drives in far for drive in drives) <= 1
