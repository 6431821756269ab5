"""Calibration files: exact round trip, a text for people, and one message for every mistake."""

from __future__ import annotations

import re
import tomllib
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daqsvc.rotor.calibration.file import (
    CalibrationFileError,
    CalibrationRecord,
    load_calibration,
    load_healthy,
    load_record,
    parse_record,
    record_text,
    save_calibration,
    save_record,
)
from daqsvc.rotor.calibration.run_up import RunUpFit
from daqsvc.rotor.calibration.two_modes import TwoModeFit
from daqsvc.rotor.laval import LavalRotor
from daqsvc.rotor.model import TwoModes
from daqsvc.rotor.synchronous.baseline import Calibration
from daqsvc.rotor.synchronous.speed_law import SpeedLaw

HERE = Path("rotor.toml")
positive = st.floats(min_value=1e-12, max_value=1e9)
part = st.floats(min_value=0.0, max_value=0.999)
number = st.floats(min_value=-1e9, max_value=1e9)
complexes = st.builds(complex, number, number)

rotors = st.builds(
    LavalRotor,
    natural_frequency_hz=st.floats(min_value=1e-3, max_value=1e5),
    damping_ratio=st.floats(min_value=1e-4, max_value=0.99),
    natural_frequency_tolerance=part,
    damping_tolerance=part,
    clearance_um=st.none() | positive,
    static_sag_um=st.none() | number,
)


sizes = st.lists(positive, min_size=5, max_size=5).map(np.array)
thousandths = st.integers(0, 1000).map(lambda n: n / 1000)


def covariances(size: int) -> st.SearchStrategy[np.ndarray]:
    """No variance is below 0 in any direction, and those along the axes are of different size."""
    roots = st.lists(st.lists(thousandths, min_size=size, max_size=size), min_size=size, max_size=size)
    scales = st.lists(st.floats(1e-3, 1e3), min_size=size, max_size=size)
    return st.builds(
        lambda root, scale: np.outer(scale, scale) * (root @ root.T),
        roots.map(np.array),
        scales.map(np.array),
    )


laws = st.builds(
    SpeedLaw,
    follows_um=st.lists(st.lists(complexes, min_size=5, max_size=5), min_size=2, max_size=2).map(
        lambda s: np.array(s, np.complex128)
    ),
    covariance_um2=st.lists(covariances(3), min_size=5, max_size=5).map(np.array),
    off_um=sizes,
)


def calibrations(rotor: LavalRotor) -> st.SearchStrategy[Calibration]:
    return st.builds(
        Calibration,
        rotor=st.just(rotor),
        speed_rpm=st.floats(min_value=1.0, max_value=1e6),
        revolutions=st.integers(20, 10**6),
        baseline=st.lists(complexes, min_size=5, max_size=5).map(lambda b: np.array(b, np.complex128)),
        variance=st.lists(positive, min_size=5, max_size=5).map(np.array),
        noise=positive,
        noise_variance=positive,
        samples_per_rev=positive,
        fit_error=st.none() | part,
        law=st.none() | laws,
    )


fits = st.builds(
    RunUpFit,
    natural_frequency_hz=positive,
    damping_ratio=st.floats(min_value=1e-4, max_value=0.99),
    eccentricity_um=complexes,
    centre_um=complexes,
    covariance=covariances(4),
    centre_uncertainty_um=positive,
    ellipticity=part,
    noise_um=positive,
    fit_error=part,
    speed_range_rpm=st.tuples(st.floats(1.0, 1e3), st.floats(1.1e3, 1e5)),
    revolutions=st.integers(20, 10**6),
)


two_modes = st.builds(
    TwoModeFit,
    natural_frequency_hz=positive,
    damping_ratio=positive,
    eccentricity_um=complexes,
    modes=st.builds(
        TwoModes,
        support_share=st.floats(min_value=1e-6, max_value=1.0),
        support_lag=positive,
        cross_stiffness=number,
        anisotropy=complexes,
        damping_anisotropy=complexes,
        gyroscopic=number,
        higher_modes=complexes,
        runout_um=st.tuples(complexes, complexes),
    ),
    fit_error=part,
    speed_range_rpm=st.just((1.0, 2.0)),
)


@st.composite
def records(draw: st.DrawFn) -> CalibrationRecord:
    rotor = draw(rotors)
    steady = draw(st.lists(calibrations(rotor), max_size=3))
    texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
    run_up = draw(fits if not steady else st.none() | fits)
    modes = None if run_up is None else draw(st.none() | two_modes)
    return CalibrationRecord(
        rotor=rotor,
        steady=tuple(steady),
        steady_sources=tuple(draw(texts) for _ in steady),
        run_up=run_up,
        run_up_source="run.csv",
        two_modes=modes and replace(modes, speed_range_rpm=run_up.speed_range_rpm),
        written="2026-01-02T03:04:05Z",
    )


def same(one: object, other: object) -> bool:
    """Equal to the last bit, arrays included."""
    for place in fields(one):  # type: ignore[arg-type]
        a, b = getattr(one, place.name), getattr(other, place.name)
        if isinstance(a, SpeedLaw) and isinstance(b, SpeedLaw):
            equal = same(a, b)
        else:
            equal = np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b
        if not equal:
            return False
    return True


@given(records())
def test_comes_back_to_the_last_bit(record: CalibrationRecord) -> None:
    back = parse_record(record_text(record), HERE)
    assert back.rotor == record.rotor
    assert len(back.steady) == len(record.steady)
    assert all(map(same, back.steady, record.steady))
    assert (back.run_up is None) == (record.run_up is None)
    if record.run_up is not None:
        assert same(record.run_up, back.run_up)
        assert back.run_up_source == "run.csv"
    assert back.two_modes == record.two_modes
    assert back.steady_sources == record.steady_sources
    assert back.written == record.written


ROTOR = LavalRotor(natural_frequency_hz=85.0, damping_ratio=0.18, clearance_um=342.0)


def calibration(speed_rpm: float = 5110.0) -> Calibration:
    return Calibration(
        rotor=ROTOR,
        speed_rpm=speed_rpm,
        revolutions=50,
        baseline=np.array([1 - 39j, 0.4 - 95j, 0.1 + 0.2j, 0.01j, 0.02]),
        variance=np.array([0.4, 0.5, 0.4, 0.4, 0.4]),
        noise=20.0,
        noise_variance=0.02,
        samples_per_rev=64.0,
    )


def record(*speeds_rpm: float) -> CalibrationRecord:
    steady = tuple(map(calibration, speeds_rpm))
    return CalibrationRecord(rotor=ROTOR, steady=steady, steady_sources=("a.npz",) * len(steady))


def test_a_person_finds_amplitude_phase_uncertainty_noise_and_verdict() -> None:
    text = record_text(record(5110.0))
    assert "95 um at -89.8 degrees, +- 0.071 each" in text
    assert "3.16 um rms of a sample of one probe" in text
    table = tomllib.loads(text)["steady"][0]
    assert table["verdict"] == calibration().describe()
    assert table["source"] == "a.npz"
    assert max(map(len, text.splitlines())) < 400


def test_a_saved_calibration_can_be_loaded(tmp_path: Path) -> None:
    path = tmp_path / "rotor.toml"
    save_calibration(calibration(), path, source="a.npz")
    assert same(load_calibration(path), calibration())
    save_record(record(5110.0, 3600.0), path)
    assert [p.name for p in tmp_path.iterdir()] == ["rotor.toml"]
    assert load_calibration(path, speed_rpm=-3650.0).speed_rpm == 3600.0
    with pytest.raises(CalibrationFileError, match=r"baselines at 5110.0, 3600.0 rpm; give the speed"):
        load_calibration(path)
    with pytest.raises(CalibrationFileError, match=r"no baseline within 5 % of 4400.0 rpm, but at 5110.0"):
        load_calibration(path, 4400.0)
    assert len(load_record(path).steady) == 2


@pytest.mark.parametrize(
    ("row", "remedy"),
    [
        (
            [[1.0, -9.0, 0.0], [-9.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            "no variance can be below 0, in any direction",
        ),
        ([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], "give the same numbers in rows and columns"),
    ],
)
def test_a_covariance_that_is_none_is_refused(row: list[list[float]], remedy: str) -> None:
    law = SpeedLaw(np.ones((2, 5), np.complex128), np.tile(np.array(row), (5, 1, 1)), np.full(5, 0.5))
    text = record_text(replace(record(5110.0), steady=(replace(calibration(), law=law),)))
    with pytest.raises(CalibrationFileError, match=rf"speed_law.covariance_um2.*: {remedy}"):
        parse_record(text, HERE)


def test_a_file_of_an_earlier_version_knows_nothing_of_a_late_rotor() -> None:
    law = SpeedLaw(np.ones((2, 5), np.complex128), np.tile(np.eye(3), (5, 1, 1)), np.full(5, 0.5))
    kept = replace(record(5110.0), steady=(replace(calibration(), law=law),))
    text = record_text(kept)
    five = "[3.0, 3.0, 3.0, 3.0, 3.0]"
    earlier = re.sub(
        r"rate_re_um.*covariance_um2.*off_um = \[[^]]*\]",
        f"slope_uncertainty_um = {five}, bend_um = {five}",
        text,
    )
    bend_only, late = (
        parse_record(one, HERE).steady[0].law
        for one in (earlier, earlier.replace("bend_um", "late_um = [4.0, 4.0, 4.0, 4.0, 4.0], bend_um"))
    )
    assert bend_only.follows_um[0].tolist() == [1.0] * 5
    assert bend_only.follows_um[1].tolist() == [0.0] * 5
    assert bend_only.covariance_um2[1].tolist() == [[9.0, 0.0, 0.0], [0.0] * 3, [0.0] * 3]
    assert bend_only.off_um.tolist() == [3.0] * 5
    assert late.off_um.tolist() == [5.0] * 5


def test_a_variance_below_0_is_refused() -> None:
    law = SpeedLaw(np.ones((2, 5), np.complex128), np.tile(np.eye(3), (5, 1, 1)), np.full(5, 0.5))
    text = record_text(replace(record(5110.0), steady=(replace(calibration(), law=law),)))
    with pytest.raises(CalibrationFileError, match="no variance can be below 0"):
        parse_record(text.replace("[[1.0, 0.0, 0.0]", "[[-1.0, 0.0, 0.0]", 1), HERE)


RUN_UP = RunUpFit(
    natural_frequency_hz=85.0,
    damping_ratio=0.18,
    eccentricity_um=34 + 0j,
    centre_um=-39j,
    covariance=np.eye(4) * 1e-6,
    centre_uncertainty_um=0.1,
    ellipticity=0.0,
    noise_um=1.0,
    fit_error=0.01,
    speed_range_rpm=(1000.0, 8000.0),
    revolutions=230,
)


def test_a_run_up_alone_is_no_baseline() -> None:
    alone = CalibrationRecord(rotor=ROTOR, run_up=RUN_UP)
    with pytest.raises(ValueError, match="a run-up only and no steady baseline; calibrate again with a rec"):
        alone.at(5110.0)
    text = record_text(alone)
    assert "natural_frequency_hz = 85.0  # +- 0.085" in text
    assert "34 um at 0.0 degrees, +- 0.034 um, 0.057 degrees" in text


@pytest.mark.parametrize(
    ("speed_rpm", "fit_error", "known"),
    [(5110.0, 0.02, True), (-5110.0, 0.02, True), (None, 0.02, True), (5110.0, 0.2, False)],
)
def test_the_two_modes_of_a_run_up_are_known_where_they_hold(
    tmp_path: Path, speed_rpm: float | None, fit_error: float, *, known: bool
) -> None:
    modes = TwoModes(support_share=0.3, support_lag=0.2, anisotropy=0.1 + 0.05j)
    fit = TwoModeFit(
        natural_frequency_hz=83.0,
        damping_ratio=0.05,
        eccentricity_um=30.0 + 4.0j,
        modes=modes,
        fit_error=fit_error,
        speed_range_rpm=RUN_UP.speed_range_rpm,
    )
    path = tmp_path / "rotor.toml"
    save_record(replace(record(5110.0), run_up=RUN_UP, two_modes=fit), path)
    rotor, (baseline,) = load_healthy(path, speed_rpm, 250.0)
    assert baseline.rotor == rotor
    assert rotor.clearance_um == 250.0
    assert (rotor.two_modes is not None) == known
    assert ("without a run-up" in baseline.describe()) != known
    if rotor.two_modes is not None:
        assert rotor.two_modes.two_modes == modes
        assert (rotor.two_modes.natural_frequency_hz, rotor.two_modes.clearance_um) == (83.0, 1.0)
    beyond, _ = load_healthy(path, 9000.0, 250.0)
    assert beyond.two_modes is None


def test_a_record_has_one_rotor() -> None:
    other = replace(calibration(), rotor=replace(ROTOR, damping_ratio=0.1))
    with pytest.raises(ValueError, match="make all baselines of a record with one rotor"):
        record_text(CalibrationRecord(rotor=ROTOR, steady=(other,), steady_sources=("",)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema_version = 1", "schema_version = 7", "schema_version = 7: this program reads version 1; cal"),
        ("schema_version = 1", "", "schema_version is missing; restore the file, or calibrate again"),
        ("revolutions = 50", "revolutions = 50.5", "steady[0].revolutions = 50.5: it must be a whole number"),
        ("speed_rpm = 5110.0", "speed_rpm = -1.0", "steady[0].speed_rpm = -1.0: it must be above 0; restore"),
        ("speed_rpm = 5110.0", "speed_rpm = nan", "steady[0].speed_rpm = nan: it must be a finite number"),
        ("speed_rpm = 5110.0", f"speed_rpm = 1{400 * '0'}", "it must be a finite number"),
        (
            "speed_rpm = 5110.0",
            'speed_rpm = "fast"',
            "steady[0].speed_rpm = 'fast': it must be a finite numb",
        ),
        (
            "damping_ratio = 0.18",
            "damping_ratio = 1.8",
            "rotor.damping_ratio = 1.8: it must be above 0 and b",
        ),
        (
            "damping_ratio = 0.18",
            "damping_ratio = true",
            "rotor.damping_ratio = True: it must be a finite nu",
        ),
        ("re = 0.4, ", "", "steady[0].forward_1x_um.re is missing; restore the file"),
        ("re = 0.4, ", "re = 0.4, x = 1, ", "forward_1x_um.x = 1: there is no such key; remove it"),
        ("[rotor]", "[rotor]\nmass = 3", "rotor.mass = 3: there is no such key; remove it"),
        ("[rotor]", "[rotor", "this is not TOML: "),
        ("[[steady]]", "[steady]", "steady = {"),
        ("source = ", "source = 3 #", "steady[0].source = 3: it must be a text in quotes"),
    ],
)
def test_every_mistake_is_one_message(old: str, new: str, message: str) -> None:
    text = record_text(record(5110.0))
    assert old in text
    with pytest.raises(CalibrationFileError, match=r"^rotor\.toml: .*" + re.escape(message)):
        parse_record(text.replace(old, new, 1), HERE)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(CalibrationFileError, match=r"no\.toml: No such file or directory; name a file that"):
        load_calibration(tmp_path / "no.toml")
    (tmp_path / "zip").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CalibrationFileError, match=r"this is not UTF-8: .*; name a file that"):
        load_calibration(tmp_path / "zip")
    with pytest.raises(CalibrationFileError, match="cannot be written: No such file or directory; name a"):
        save_calibration(calibration(), tmp_path / "none" / "rotor.toml")
    empty = record_text(record(5110.0)).split("\n[[steady]]")[0]
    with pytest.raises(CalibrationFileError, match=r"neither \[run_up\] nor \[\[steady\]\] is there"):
        parse_record(empty, HERE)
