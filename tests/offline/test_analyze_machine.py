"""``daqsvc analyze`` where something is known of the machine: a calibration, a machine file."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from support.orbit_files import RATE_HZ, SAMPLES_PER_REV, SPEED_RPM, UNBALANCE, VERDICTS, Orbit
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.detectors.rotor_synchronous.recorded import analyse
from daqsvc.detectors.rotor_synchronous.recorded_speed import KeyphasorChannel, RotorSetup
from daqsvc.recording import RecordingError
from daqsvc.recording.recording import Recording, load_recording
from daqsvc.rotor.calibration.file import save_calibration
from daqsvc.rotor.laval import LavalRotor
from daqsvc.settings import load as settings_load

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.integration
CONFIG = ROOT / "config" / "machines"


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
    setup = RotorSetup(probes=("x", "y"), rotor=rotor, speed_rpm=SPEED_RPM, keyphasor=KeyphasorChannel("k"))
    healthy = analyse(recording, setup).calibration
    assert healthy is not None
    save_calibration(healthy, tmp_path / "healthy.toml")
    return tmp_path / "healthy.toml"


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """The example machine with a calibrated rotor, turning as the orbits of this file do."""
    text = (CONFIG / "rotor-synchronous.toml").read_text()
    for key, value in {"speed_rpm": SPEED_RPM, "natural_frequency_hz": 60.0, "clearance_um": 200.0}.items():
        text = re.sub(rf"^{key} = [\d.]+", f"{key} = {value}", text, flags=re.MULTILINE)
    file = tmp_path / "machine.toml"
    file.write_text(text)
    return file


def test_every_key_is_documented(analyze: Callable[..., Any], machine: Path, tmp_path: Path) -> None:
    told = (CONFIG.parents[1] / "docs" / "analyze.md").read_text()
    _, (found,), _ = analyze(machine, Orbit(change=UNBALANCE).save(tmp_path / "a.npz"))
    parts = (found["calibration"], found["data_quality"], found["history"][0], found["onset"])
    for keys in (found, found["alarms"][0], *parts):
        assert [key for key in keys if f"`{key}`" not in told] == []
    assert [name for name in VERDICTS if f"`{name}`" not in told] == []


def test_the_machine_file_is_read_once(
    analyze: Callable[..., Any], machine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However many recordings: reading it compiles what it names, and checks it against this computer."""
    read: list[Path] = []
    model = settings_load.machine_file_model()
    parsed = model.model_validate

    def counting(document: Any) -> Any:
        read.append(machine)
        return parsed(document)

    monkeypatch.setattr(model, "model_validate", counting)
    recordings = [Orbit(30, seed=seed).save(tmp_path / f"{seed}.npz") for seed in range(3)]
    _, found, _ = analyze(machine, *recordings)
    assert (len(found), len(read)) == (3, 1)


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
    smallest = [one["calibration"].pop("smallest_change_um") for one in found]
    said = [one["calibration"].pop("verdict") for one in found]
    assert grown[0] > grown[1]
    assert smallest[0] < smallest[1]
    assert said[0] != said[1]
    assert found[0]["calibration"] == found[1]["calibration"]
    assert found[1]["departure"]["revolution"] <= 2
    code, found, err = analyze(tmp_path / "f.npz", *options, "--damping-ratio", "0.1")
    assert (code, found) == (2, [])
    assert "the calibration states this" in err
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


@pytest.mark.parametrize(
    ("pulses", "what"),
    [
        (np.array([None, {}], object), "not numeric"),
        (np.array([]), "empty, not a channel"),
        (3.0, "a single number, not a channel"),
        (np.ones(1), "a single number, not a channel"),
    ],
)
def test_a_variable_that_is_no_channel_is_refused_as_the_reader_of_files_does(
    analyze: Callable[..., Any], machine: Path, tmp_path: Path, pulses: object, what: str
) -> None:
    orbit = Orbit(30)
    file = tmp_path / "a.npz"
    np.savez(file, x=orbit.x, y=orbit.y, keyphasor=pulses, fs=RATE_HZ)  # type: ignore[arg-type]
    code, (found,), _ = analyze(machine, file)
    with pytest.raises(RecordingError, match=what) as refused:
        load_recording(file, {"keyphasor": "keyphasor"}, RATE_HZ)
    assert (code, found["refused"]) == (3, str(refused.value))


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


@pytest.mark.parametrize("speed", [f"{SPEED_RPM}", f"orbit:{SPEED_RPM}"])
def test_without_a_keyphasor_a_calibration_asks_for_no_shaft_angle(
    analyze: Callable[..., Any], calibration: Path, tmp_path: Path, speed: str
) -> None:
    """A recording begins where it begins: the phase of 1X is no fault, its size is."""
    files = []
    for seed, change in enumerate((None, None, UNBALANCE)):
        orbit = Orbit(seed=seed) if change is None else Orbit(change=change)
        begin = (13 + 20 * seed) if change is None else 85 * 64 + 17
        orbit.x, orbit.y = orbit.x[begin:], orbit.y[begin:]
        files.append(orbit.save(tmp_path / f"{seed}.npz"))
    options = ["--probes", "x,y", "--speed-rpm", speed, "--calibration", calibration]
    code, found, err = analyze(*files, *options)
    assert (code, err) == (0, "")
    assert [one["verdict"] == "normal" for one in found] == [True, True, False]
    assert "unbalance" in found[2]["group"]
    assert all("phase" in " ".join(one["data_quality"]["problems"]) for one in found)
