"""What ``daqsvc analyze`` is given: bad recordings, every format, wrong usage."""

from __future__ import annotations

import re
import wave
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.orbit_files import OPTIONS, RATE_HZ, SPEED_RPM, UNBALANCE, Orbit

from daqsvc.cli import main

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.integration


def _all_missing(orbit: Orbit) -> None:
    orbit.x[:] = np.nan


def _mostly_missing(orbit: Orbit) -> None:
    orbit.y[20 * 64 :] = np.nan


def _dead(orbit: Orbit) -> None:
    orbit.y[:] = -4.25


def _dies(orbit: Orbit) -> None:
    orbit.y[70 * 64 :] = -4.25


def _sees_noise_only(orbit: Orbit) -> None:
    orbit.y[:] = np.random.default_rng(5).standard_normal(len(orbit.y))


def _clipped(orbit: Orbit) -> None:
    orbit.x[:] = np.clip(orbit.x, -1e9, 25.0)


def _swapped(orbit: Orbit) -> None:
    orbit.x, orbit.y = orbit.y, orbit.x


def _reversed(orbit: Orbit) -> None:
    orbit.x, orbit.y = orbit.x[::-1].copy(), orbit.y[::-1].copy()


def _in_metres(orbit: Orbit) -> None:
    orbit.x, orbit.y = orbit.x * 1e-6, orbit.y * 1e-6


def _in_nanometres(orbit: Orbit) -> None:
    orbit.x, orbit.y = orbit.x * 1e3, orbit.y * 1e3


def _standing(orbit: Orbit) -> None:
    rng = np.random.default_rng(3)
    orbit.x, orbit.y = rng.standard_normal((2, len(orbit.x)))


def _not_steady(orbit: Orbit) -> None:
    orbit.x[: 25 * 64] *= 1.3
    orbit.y[: 25 * 64] *= 1.3


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_all_missing, r"^x: 7680 of 7680 samples are missing"),
        (_mostly_missing, r"^y: 6400 of 7680 samples are missing"),
        (_dead, r"^y is dead: all samples are -4.25"),
        (_dies, r"^y is dead in 50 of 120 revolutions, the first is revolution 71"),
        (_sees_noise_only, r"^y.*(dead|sees no 1X|moved by)"),
        (_clipped, r"^x is clipped at 25 um"),
        (_swapped, r"turns against|swapped"),
        (_reversed, r"turns against|swapped"),
        (_in_metres, r"unit 'um' looks wrong"),
        (_in_nanometres, r"unit 'um' looks wrong"),
        (_standing, r"no 1X"),
        (_not_steady, r"not steady|not locked"),
    ],
    ids=lambda value: value.__name__.strip("_") if callable(value) else "",
)
@pytest.mark.parametrize("change", [0.0, UNBALANCE])
def test_a_recording_that_cannot_be_judged_is_refused_by_name(
    damage: Callable[[Orbit], None], words: str, change: float, analyze: Callable[..., Any], tmp_path: Path
) -> None:
    orbit = Orbit(change=change)
    damage(orbit)
    code, (found,), err = analyze(orbit.save(tmp_path / "bad.npz"), *OPTIONS)
    assert (code, err) == (3, "")
    assert (found["verdict"], found["group"]) == (None, [])
    assert re.search(words, found["refused"]), found["refused"]
    assert found["onset"] is found["departure"] is found["declaration"] is None


@pytest.mark.parametrize("off_percent", [-2.0, -0.5, 0.5, 2.0])
def test_a_wrong_speed_is_refused_with_the_right_one(
    off_percent: float, analyze: Callable[..., Any], tmp_path: Path
) -> None:
    options = [*OPTIONS[:2], *OPTIONS[4:], "--speed-rpm", SPEED_RPM * (1.0 + off_percent / 100.0)]
    code, (found,), _ = analyze(Orbit(change=UNBALANCE).save(tmp_path / "a.npz"), *options)
    assert code == 3
    assert found["verdict"] is None
    told = re.search(r"turns at ([\d.]+) rpm", found["refused"])
    assert told is not None
    assert float(told[1]) == pytest.approx(SPEED_RPM, rel=1e-4)


def test_a_speed_that_is_rounded_is_made_exact(analyze: Callable[..., Any], tmp_path: Path) -> None:
    options = [*OPTIONS[:2], *OPTIONS[4:], "--speed-rpm", SPEED_RPM * 1.0003]
    code, (found,), _ = analyze(Orbit().save(tmp_path / "a.npz"), *options)
    assert (code, found["verdict"]) == (0, "normal")
    assert found["speed_rpm"] == pytest.approx(SPEED_RPM, rel=1e-5)
    assert "by the orbit" in found["data_quality"]["problems"][0]


@pytest.mark.parametrize("revolutions", [1, 20, 52])
def test_a_recording_that_is_too_short_is_refused(
    revolutions: int, analyze: Callable[..., Any], tmp_path: Path
) -> None:
    code, (found,), _ = analyze(Orbit(revolutions).save(tmp_path / "short.npz"), *OPTIONS)
    assert code == 3
    assert f"too short: {revolutions}.0 revolutions, at least 53 are needed" in found["refused"]


def test_missing_and_infinite_samples_are_counted_and_left_out(
    analyze: Callable[..., Any], tmp_path: Path
) -> None:
    orbit = Orbit(change=UNBALANCE)
    orbit.x[30 * 64 : 30 * 64 + 40] = np.nan
    orbit.y[60 * 64 + 5] = -np.inf
    orbit.y[100 * 64 : 103 * 64] = np.nan
    code, (found,), _ = analyze(orbit.save(tmp_path / "gaps.npz"), *OPTIONS)
    assert code == 0
    assert found["verdict"] == "unbalance"
    assert found["onset"]["revolution"] == 80
    quality = found["data_quality"]
    assert quality["missing"] == {"x": 40, "y": 192}
    assert quality["infinite"] == {"x": 0, "y": 1}
    assert quality["unusable_revolutions"] == 4
    assert any("infinite" in problem for problem in quality["problems"])


@pytest.mark.parametrize("change", [0.0, UNBALANCE])
def test_probes_without_a_mean_position_are_recognised(
    change: float, analyze: Callable[..., Any], tmp_path: Path
) -> None:
    orbit = Orbit(change=change)
    orbit.x -= orbit.x.mean()
    orbit.y -= orbit.y.mean()
    code, (found,), _ = analyze(orbit.save(tmp_path / "ac.npz"), *OPTIONS)
    assert code == 0
    assert found["verdict"] == ("unbalance" if change else "normal")
    assert any("AC-coupled" in problem for problem in found["data_quality"]["problems"])
    assert "static_load" not in found["group"]


def _write_csv(orbit: Orbit, path: Path) -> list[object]:
    time_s = np.arange(len(orbit.x)) / RATE_HZ
    np.savetxt(path, np.column_stack([time_s, orbit.x, orbit.y]), delimiter=",", header="t,x,y", comments="")
    return []


def _write_mat(orbit: Orbit, path: Path) -> list[object]:
    from scipy.io import savemat

    savemat(path, {"probe_x": orbit.x / 25.4, "probe_y": orbit.y / 25.4})
    return ["--map", "x=probe_x", "--map", "y=probe_y", "--fs", RATE_HZ, "--unit", "mil"]


def _write_wav(orbit: Orbit, path: Path) -> list[object]:
    # Full scale 1 stands for 1 mm.
    pcm = np.round(np.column_stack([orbit.x, orbit.y]) / 1000.0 * 32768.0).astype("<i2")
    with wave.open(str(path), "wb") as file:
        file.setnchannels(2)
        file.setsampwidth(2)
        file.setframerate(round(RATE_HZ))
        file.writeframes(pcm.tobytes())
    return ["--map", "x=0,y=1", "--unit", "mm"]


def _write_parquet(orbit: Orbit, path: Path) -> list[object]:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    parquet.write_table(pyarrow.table({"x": orbit.x / 1e6, "y": orbit.y / 1e6}), path)
    return ["--fs", RATE_HZ, "--unit", "m"]


@pytest.mark.parametrize(
    ("name", "write"),
    [("a.csv", _write_csv), ("a.mat", _write_mat), ("a.wav", _write_wav), ("a.parquet", _write_parquet)],
)
def test_every_format_gives_the_same_verdict(
    name: str, write: Callable[[Orbit, Path], list[object]], analyze: Callable[..., Any], tmp_path: Path
) -> None:
    orbit = Orbit(change=UNBALANCE)
    code, (found,), _ = analyze(tmp_path / name, *OPTIONS, *write(orbit, tmp_path / name))
    assert code == 0
    assert found["verdict"] == "unbalance"
    assert found["onset"]["revolution"] == 80
    assert found["calibration"]["amplitude_um"] == pytest.approx(40.0, rel=0.01)


@pytest.mark.parametrize("verb", ["analyze", "calibrate"])
def test_options_are_asked_for_only_if_the_file_is_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], verb: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("gearbox.dbc").touch()
    Path("a.npz").touch()
    for recording, words in (
        ("gearbox.dbc", "gearbox.dbc is not a kind of file that can be read"),
        ("b.npz", "b.npz cannot be read: there is no such file"),
        ("a.npz", "without a machine file, --probes"),
    ):
        with pytest.raises(SystemExit) as stopped:
            main([verb, recording, "--json"])
        assert stopped.value.code == 2
        assert f"daqsvc {verb}: {words}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["a.npz", *OPTIONS, "--probes", "x"], "does not name two probes"),
        (["a.npz", *OPTIONS, "--speed-rpm", "0"], "is not a speed"),
        (["a.npz", *OPTIONS, "--speed-rpm", "nan"], "is not a speed"),
        (["a.npz", *OPTIONS, "--damping-ratio", "1.5"], "less than 1"),
        (["a.npz", *OPTIONS, "--calibrate-revs", "5"], "do not make a baseline"),
        (["a.npz", *OPTIONS, "--unit", "ft"], "invalid choice: 'ft'"),
        (["a.npz", *OPTIONS, "--jobs", "0"], "is not a whole number from 1 on"),
        (["a.npz", *OPTIONS, "--map", "x=a", "--map", "x=b"], "twice"),
        (["a.npz", *OPTIONS, "--keyphasor-threshold", "3"], "without --keyphasor"),
        (["a.npz", *OPTIONS, "--keyphasor", "x"], "must be different channels"),
        (["a.npz", *OPTIONS, "--keyphasor", "k", "--follow-orbit"], "either from the keyphasor or from the"),
        (["a.npz", *OPTIONS, "--false-alarms-per-1000-rev", "50"], "give a rate from 1e-9 to 10"),
        (["m.toml"], "no recording after it"),
        (["a.npz", "m.toml", *OPTIONS], "a machine file comes first"),
        (["m.toml", "a.npz", "--speed-rpm", "9", "--ac-coupled"], "--speed-rpm, --ac-coupled: the machine"),
        ([], "required: FILE"),
    ],
)
def test_wrong_usage_is_told_in_one_line(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["analyze", *arguments])
    assert stopped.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err.splitlines()[-1]


def test_a_directory_of_figures_that_cannot_be_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = Orbit().save(tmp_path / "a.npz")
    assert main(["analyze", str(file), *OPTIONS, "--plot", str(file)]) == 1
    assert "--plot" in capsys.readouterr().err


def test_missing_matplotlib_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    assert main(["analyze", "a.npz", *OPTIONS, "--plot", str(tmp_path)]) == 1
    assert "pip install 'daqsvc[plot]'" in capsys.readouterr().err
