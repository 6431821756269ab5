"""``daqsvc analyze`` as a person or a script calls it."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
import wave
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from orbit_files import OPTIONS, RATE_HZ, SAMPLES_PER_REV, SPEED_RPM, Orbit

from daqsvc.analysis.rotor import analyse
from daqsvc.analysis.setup import Keyphasor, RotorSetup
from daqsvc.cli import main
from daqsvc.recording.recording import Recording
from daqsvc.rotor.calibration.file import save_calibration
from daqsvc.rotor.laval import LavalRotor

if TYPE_CHECKING:
    from collections.abc import Callable

CONFIG = Path(__file__).parents[2] / "config" / "machines"
VERDICTS = {
    "normal",
    "unbalance",
    "damping_loss",
    "static_load",
    "stiffness_loss",
    "rub",
    "unmodelled",
    "small_change",
}
UNBALANCE = 0.8
ROSS = (
    *("--probes", "x_disc,y_disc", "--unit", "m", "--natural-frequency-hz", "85", "--damping-ratio", "0.17"),
    *("--clearance-um", "342"),
)


@pytest.fixture
def analyze(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, list[dict[str, Any]], str]]:
    """Runs the verb in this process with ``--json``: exit code, objects, what went to stderr."""

    def run(*arguments: object) -> tuple[int, list[dict[str, Any]], str]:
        try:
            code = main(["analyze", *map(str, arguments), "--json"])
        except SystemExit as stopped:
            code = int(stopped.code or 0)
        out, err = capsys.readouterr()
        return code, [json.loads(line, parse_constant=pytest.fail) for line in out.splitlines()], err

    return run


def test_a_growing_unbalance_is_found_and_placed(analyze: Callable[..., Any], tmp_path: Path) -> None:
    file = Orbit(change=UNBALANCE).save(tmp_path / "grown.npz")
    code, (found,), err = analyze(file, *OPTIONS)
    assert (code, err) == (0, "")
    assert found["recording"] == str(file)
    assert found["verdict"] == "unbalance"
    assert set(found["group"]) <= {"unbalance", "damping_loss"}
    assert found["named"] is True
    # Which sample a mark falls on is up to the rounding of the stated speed.
    onset, departure = found["onset"], found["departure"]
    assert onset["sample"] in {80 * 64, 80 * 64 + 1}
    assert onset == {"sample": onset["sample"], "seconds": onset["sample"] / RATE_HZ, "revolution": 80}
    assert departure["revolution"] == 81
    assert departure["sample"] in {81 * 64, 81 * 64 + 1}
    assert 81 < found["declaration"]["revolution"] <= 100
    assert set(found["probabilities"]) == VERDICTS
    assert math.isclose(sum(found["probabilities"].values()), 1.0, abs_tol=1e-9)
    assert found["probabilities"]["normal"] < 1e-6
    assert found["evidence"]["unbalance"] > 100.0
    assert found["severity"] == pytest.approx(UNBALANCE, rel=0.05)
    real, imaginary = found["change_um"]["1"]
    assert math.hypot(real, imaginary) == pytest.approx(UNBALANCE * 40.0, rel=0.05)
    assert found["level"]["unbalance"]["ratio"] == pytest.approx(1.0 + UNBALANCE, rel=0.02)
    assert math.degrees(math.atan2(imaginary, real)) == pytest.approx(math.degrees(-0.7), abs=3.0)
    assert found["calibration"]["amplitude_um"] == pytest.approx(40.0, rel=0.01)
    assert found["calibration"]["noise_um"] == pytest.approx(1.0, rel=0.1)
    assert found["calibration"]["revolutions"] == 50
    assert found["speed_rpm"] == pytest.approx(SPEED_RPM)
    assert found["revolutions"] in {119, 120}
    assert found["history"][0] == {"revolution": 81, "verdict": None, "group": [], "named": False}
    assert found["history"][-1]["named"] is True
    assert found["refused"] is None
    assert found["data_quality"]["problems"] == []


def test_every_key_is_documented(analyze: Callable[..., Any], machine: Path, tmp_path: Path) -> None:
    told = (CONFIG.parents[1] / "docs" / "analyze.md").read_text()
    _, (found,), _ = analyze(machine, Orbit(change=UNBALANCE).save(tmp_path / "a.npz"))
    parts = (found["calibration"], found["data_quality"], found["history"][0], found["onset"])
    for keys in (found, found["alarms"][0], *parts):
        assert [key for key in keys if f"`{key}`" not in told] == []
    assert [name for name in VERDICTS if f"`{name}`" not in told] == []


def test_a_healthy_machine_is_normal(analyze: Callable[..., Any], tmp_path: Path) -> None:
    code, (found,), _ = analyze(Orbit().save(tmp_path / "healthy.npz"), *OPTIONS)
    assert code == 0
    assert (found["verdict"], found["group"], found["named"]) == ("normal", ["normal"], True)
    assert found["onset"] is found["departure"] is found["declaration"] is None
    assert found["probabilities"]["normal"] > 0.99
    assert found["history"] == []
    assert found["threshold_nats"] == pytest.approx(20.3, abs=0.1)


def test_a_recording_that_ends_before_the_name_says_what_it_may_be(
    analyze: Callable[..., Any], tmp_path: Path
) -> None:
    code, (found,), _ = analyze(Orbit(84, change=UNBALANCE).save(tmp_path / "short.npz"), *OPTIONS)
    assert code == 0
    assert found["departure"]["revolution"] == 81
    assert found["named"] is False
    assert found["declaration"] is None
    assert "unbalance" in found["group"]
    assert found["verdict"] == found["group"][0]


def test_a_fault_below_the_least_severity_gets_no_name(analyze: Callable[..., Any], tmp_path: Path) -> None:
    code, (found,), _ = analyze(Orbit(220, change=0.03).save(tmp_path / "small.npz"), *OPTIONS)
    assert code == 0
    assert (found["verdict"], found["group"]) == ("small_change", ["small_change"])


def test_a_keyphasor_decides_the_speed(analyze: Callable[..., Any], tmp_path: Path) -> None:
    file = Orbit(change=UNBALANCE).save(tmp_path / "key.npz")
    options = [*OPTIONS[:2], *OPTIONS[4:], "--keyphasor", "keyphasor"]
    code, (found,), _ = analyze(file, *options)
    assert code == 0
    assert found["verdict"] == "unbalance"
    assert found["speed_rpm"] == pytest.approx(SPEED_RPM, rel=1e-4)
    assert found["data_quality"]["keyphasor"] == {"accepted": 120, "missing": 0, "rejected": 0} | {
        "accepted": found["data_quality"]["keyphasor"]["accepted"]
    }
    assert 116 <= found["data_quality"]["keyphasor"]["accepted"] <= 120
    code, (found,), _ = analyze(file, *options, "--keyphasor-threshold", "3")
    assert code == 3
    assert "0 pulses cross 3; the channel lies between -10 and -2" in found["refused"]
    code, (found,), _ = analyze(file, *options, "--speed-rpm", 1500)
    assert code == 0
    assert "the keyphasor decides" in " ".join(found["data_quality"]["problems"])


def test_a_shaft_that_turns_clockwise_has_a_negative_speed(
    analyze: Callable[..., Any], tmp_path: Path
) -> None:
    orbit = Orbit(change=UNBALANCE)
    orbit.x = -orbit.x
    options = [*OPTIONS[:2], *OPTIONS[4:]]
    code, (found,), _ = analyze(orbit.save(tmp_path / "cw.npz"), *options, "--speed-rpm", -SPEED_RPM)
    assert code == 0
    assert found["verdict"] == "unbalance"
    assert found["speed_rpm"] == pytest.approx(-SPEED_RPM)


def test_the_orbit_itself_can_tell_the_speed(analyze: Callable[..., Any], tmp_path: Path) -> None:
    options = [*OPTIONS[:2], *OPTIONS[4:]]
    code, (found,), _ = analyze(
        Orbit().save(tmp_path / "h.npz"), *options, "--speed-rpm", f"orbit:{1.01 * SPEED_RPM}"
    )
    assert code == 0
    assert found["verdict"] == "normal"
    assert found["speed_rpm"] == pytest.approx(SPEED_RPM, rel=1e-3)


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


def test_many_recordings_come_out_in_order_whatever_becomes_of_each(
    analyze: Callable[..., Any], tmp_path: Path
) -> None:
    long = Orbit(400, change=UNBALANCE).save(tmp_path / "long.npz")
    absent = tmp_path / "absent.npz"
    torn = tmp_path / "torn.npz"
    torn.write_bytes(long.read_bytes()[:5000])
    healthy = Orbit().save(tmp_path / "healthy.npz")
    files = [long, absent, healthy, torn, healthy]
    code, found, err = analyze(*files, *OPTIONS, "--jobs", 2)
    assert (code, err) == (3, "")
    assert [one["recording"] for one in found] == [str(file) for file in files]
    assert [one["verdict"] for one in found] == ["unbalance", None, "normal", None, "normal"]
    assert "there is no such file" in found[1]["refused"]
    assert str(torn) in found[3]["refused"]
    assert found[2] == found[4]
    alone = analyze(*files, *OPTIONS, "--jobs", 1)
    assert alone == (code, found, err)


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


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["a.npz"], "--probes, --natural-frequency-hz, --damping-ratio, --speed-rpm must be given"),
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


def test_a_person_reads_what_and_since_when(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = Orbit(change=UNBALANCE).save(tmp_path / "grown.npz")
    assert main(["analyze", str(file), *OPTIONS]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    lines = out.splitlines()
    assert lines[0].startswith(f"{file}: unbalance")
    assert re.search(
        r"changed at revolution 80 \(sample 512[01], 1\.600 s\); alarm at revolution 81 \(sample", lines[1]
    )
    assert any(line.startswith("  unbalance: ratio 1.8, change 32 um") for line in lines)
    assert len(lines) <= 8


def test_figures_are_drawn_for_each_recording(analyze: Callable[..., Any], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    other = tmp_path / "other"
    other.mkdir()
    files = [
        Orbit(change=UNBALANCE).save(tmp_path / "a.npz"),
        Orbit(60).save(other / "a.npz"),
        Orbit(10).save(tmp_path / "short.npz"),
    ]
    code, _, _ = analyze(*files, *OPTIONS, "--plot", tmp_path / "new" / "figures")
    assert code == 3
    drawn = sorted(path.name for path in (tmp_path / "new" / "figures").iterdir())
    kinds = ("innovations", "orbit", "phase-plane", "poincare", "polar", "probabilities")
    assert drawn == sorted(f"{stem}-{kind}.png" for stem in ("a", "a-2") for kind in kinds)
    for name in drawn:
        assert (tmp_path / "new" / "figures" / name).read_bytes().startswith(b"\x89PNG")


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


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    """The healthy machine by the first revolutions of a healthy recording, on disk."""
    orbit = Orbit(seed=9)
    recording = Recording(
        ("x", "y", "k"),
        np.column_stack([orbit.x, orbit.y, orbit.keyphasor]),
        RATE_HZ,
        tmp_path / "healthy",
        0,
    )
    rotor = LavalRotor(natural_frequency_hz=60.0, damping_ratio=0.1)
    setup = RotorSetup(probes=("x", "y"), rotor=rotor, speed_rpm=SPEED_RPM, keyphasor=Keyphasor("k"))
    healthy = analyse(recording, setup).calibration
    assert healthy is not None
    save_calibration(healthy, tmp_path / "healthy.toml")
    return tmp_path / "healthy.toml"


def test_a_calibration_stands_in_for_the_first_revolutions(
    analyze: Callable[..., Any], calibration: Path, tmp_path: Path
) -> None:
    options = ["--probes", "x,y", "--keyphasor", "keyphasor", "--calibration", calibration]
    faulty = Orbit(change=UNBALANCE)
    for name in ("x", "y", "keyphasor"):
        setattr(faulty, name, getattr(faulty, name)[85 * 64 :])
    code, found, err = analyze(
        Orbit(30).save(tmp_path / "h.npz"), faulty.save(tmp_path / "f.npz"), *options, "--jobs", 2
    )
    assert (code, err) == (0, "")
    assert [one["verdict"] for one in found] == ["normal", "unbalance"]
    # The baseline grows with the healthy recording; what it grows from is the file's in both.
    grown = [one["calibration"].pop("reference_revolutions") for one in found]
    said = [one["calibration"].pop("verdict") for one in found]
    assert grown[0] > grown[1]
    assert said[0] != said[1]
    assert found[0]["calibration"] == found[1]["calibration"]
    assert found[1]["departure"]["revolution"] <= 2
    code, found, err = analyze(tmp_path / "f.npz", *options, "--damping-ratio", "0.1")
    assert (code, found) == (2, [])
    assert "the calibration says this" in err
    code, found, err = analyze(tmp_path / "f.npz", *options, "--speed-rpm", 1000)
    assert (code, found) == (2, [])
    assert "no baseline within 5 % of 1000.0 rpm" in err


def test_a_calibration_replaces_that_of_the_machine_file(
    analyze: Callable[..., Any], calibration: Path, machine: Path, tmp_path: Path
) -> None:
    file = Orbit(30).save(tmp_path / "h.npz")
    code, (found,), _ = analyze(machine, file, "--calibration", calibration)
    assert (code, found["verdict"]) == (0, "normal")
    assert found["calibration"]["amplitude_um"] == pytest.approx(40.0, rel=0.01)
    code, (found,), _ = analyze(machine, file)
    assert "too short" in found["refused"]


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """The example machine with a calibrated rotor, turning as the orbits of this file do."""
    text = (CONFIG / "rotor-synchronous.toml").read_text()
    for key, value in {"speed_rpm": SPEED_RPM, "natural_frequency_hz": 60.0, "clearance_um": 200.0}.items():
        text = re.sub(rf"^{key} = [\d.]+", f"{key} = {value}", text, flags=re.MULTILINE)
    file = tmp_path / "machine.toml"
    file.write_text(text)
    return file


def test_a_machine_file_says_what_is_known(
    analyze: Callable[..., Any], machine: Path, tmp_path: Path
) -> None:
    orbit = Orbit(change=UNBALANCE)
    file = tmp_path / "a.npz"
    np.savez(file, x=orbit.x, y=orbit.y, pulses=orbit.keyphasor, fs=RATE_HZ)
    code, (found,), err = analyze(machine, file, "--map", "kph=pulses")
    assert (code, err) == (0, "")
    assert found["verdict"] == "unbalance"
    assert found["data_quality"]["keyphasor"]["accepted"] > 110
    assert found["departure"]["sample"] == 81 * SAMPLES_PER_REV
    code, (found,), _ = analyze(machine, file)
    assert code == 3
    assert "has no channel for keyphasor" in found["refused"]
    assert "--map keyphasor=VARIABLE" in found["refused"]


def test_a_rotor_bank_judges_recordings_too(analyze: Callable[..., Any], tmp_path: Path) -> None:
    file = Orbit().save(tmp_path / "a.npz")
    text = (CONFIG / "laval-rig.toml").read_text()
    for key, value in {"speed_rpm": SPEED_RPM, "natural_frequency_hz": 50.0}.items():
        text = re.sub(rf"^{key} = [\d.]+", f"{key} = {value}", text, flags=re.MULTILINE)
    machine = tmp_path / "bank.toml"
    machine.write_text(text)
    code, (found,), _ = analyze(machine, file, "--map", "kph=keyphasor")
    assert code in {0, 3}
    assert found["detectors"]["rotor-bank"]["history"]
    assert found["detectors"]["rotor-bank"]["thresholds"]["cusum"] == 16.0


@pytest.mark.parametrize("argument", ["--map=nonsense=x", "--fs=0"])
def test_what_does_not_fit_the_machine_is_wrong_usage(
    argument: str, machine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["analyze", str(machine), str(tmp_path / "a.npz"), argument])
    assert stopped.value.code == 2
    assert capsys.readouterr().out == ""


def test_a_machine_file_with_errors_is_told_like_check_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text("schema_version = 1\n")
    assert main(["analyze", str(bad), "a.npz"]) == 2
    assert "Remedy" in capsys.readouterr().err


def test_the_start_is_quick(tmp_path: Path) -> None:
    """Neither the kernels' compiler nor the figures are loaded where nobody asks for them."""
    file = Orbit(60).save(tmp_path / "a.npz")
    script = (
        "import sys; from daqsvc.cli import main; code = main(sys.argv[1:]); "
        "print(code, [name for name in ('numba', 'matplotlib', 'pydantic', 'scipy.signal', 'rich', 'can') "
        "if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, "analyze", str(file), *OPTIONS, "--json"],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "0 []"


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rpm", "group"),
    [
        ("A07_healthy_G2p5", 3577.6767767857373, {"normal"}),
        ("A07_unb_x2_G2p5", 3577.6767767857373, {"unbalance"}),
        ("A1_damp_L2", 5110.966823972328, {"damping_loss"}),
        ("A1_healthy_G2p5", 5110.966823972328, {"normal"}),
        ("A1_healthy_e0p1", 5110.966823972328, {"normal"}),
        ("A1_misalign", 5110.966823972328, {"unmodelled"}),
        ("A1_rub_1", 5110.966823979626, {"rub"}),
        ("A1_static_l0p1", 5110.966823972328, {"static_load"}),
        ("A1_stiff_k0p75", 5110.966823972328, {"stiffness_loss"}),
        ("A1_unb_x2_G2p5", 5110.966823972328, {"unbalance"}),
    ],
)
def test_finite_element_rotors_at_20_db(
    name: str, rpm: float, group: set[str], analyze: Callable[..., Any], data: Path, tmp_path: Path
) -> None:
    files = []
    with np.load(data / "ross" / f"{name}.npz") as clean:
        onset = int(clean["onset"][0]) if len(clean["onset"]) else len(clean["x_disc"])
        for seed in (1, 2):
            rng = np.random.default_rng(seed)
            noisy = {
                probe: clean[probe]
                + 0.1 * clean[probe][:onset].std() * rng.standard_normal(len(clean[probe]))
                for probe in ("x_disc", "y_disc")
            }
            files.append(tmp_path / f"{seed}.npz")
            np.savez(files[-1], fs=clean["fs"], **noisy)
    code, found, _ = analyze(*files, *ROSS, "--speed-rpm", repr(rpm))
    assert code == 0
    for one in found:
        assert group <= set(one["group"])
        assert set(one["group"]) <= group | {"unbalance", "damping_loss"}
        if group != {"normal"}:
            assert one["onset"]["revolution"] == pytest.approx(70, abs=1)
            assert one["departure"]["revolution"] <= 73
