"""``daqsvc check`` reads the calibration that a machine file names, as the service would at its start."""

from __future__ import annotations

import re

import pytest
from support.orbit_files import RATE_HZ, SPEED_RPM, Orbit
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.detectors.rotor_synchronous.recorded import analyse
from daqsvc.detectors.rotor_synchronous.recorded_speed import RotorSetup
from daqsvc.recording.recording import load_recording
from daqsvc.rotor.calibration.file import save_calibration
from daqsvc.rotor.laval import LavalRotor

pytestmark = pytest.mark.integration
CONFIG = ROOT / "config" / "machines"


@pytest.fixture
def check(tmp_path, capsys):
    """Checks the example machine with a calibration and a speed: exit code and what was said."""

    def run(calibration, speed_rpm=SPEED_RPM):
        text = (CONFIG / "rotor-synchronous.toml").read_text()
        text = re.sub(r"^speed_rpm = [\d.]+", f"speed_rpm = {speed_rpm}", text, flags=re.MULTILINE)
        text = text.replace("calibrate_revolutions = 50", f'calibration = "{calibration}"')
        text = text.replace("rate_hz = 1600.0", f"rate_hz = {RATE_HZ}")
        file = tmp_path / "machine.toml"
        file.write_text(text)
        code = main(["check", str(file)])
        out, err = capsys.readouterr()
        return code, out, err.replace(str(tmp_path), "DIR").strip()

    return run


@pytest.fixture
def calibration(tmp_path):
    setup = RotorSetup(
        probes=("x", "y"), rotor=LavalRotor(natural_frequency_hz=60.0, damping_ratio=0.1), speed_rpm=SPEED_RPM
    )
    healthy = analyse(
        load_recording(Orbit().save(tmp_path / "h.npz"), {"x": "x", "y": "y"}), setup
    ).calibration
    save_calibration(healthy, tmp_path / "healthy.toml")
    return "healthy.toml"


def test_a_calibration_that_holds_passes(check, calibration):
    code, out, err = check(calibration)
    assert (code, err) == (0, "")
    assert "feed-pump" in out


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "No such file or directory; name a file that daqsvc calibrate wrote"),
        ('name = "something else"', "schema_version"),
        ("{ this is no TOML", "TOML"),
    ],
    ids=["missing", "something-else", "no-toml"],
)
def test_a_file_that_is_no_calibration_is_named_with_its_key(check, tmp_path, text, words):
    if text is not None:
        (tmp_path / "wrong.toml").write_text(text)
    code, out, err = check("wrong.toml")
    assert (code, out) == (2, "")
    assert err.startswith(
        "DIR/machine.toml: pipeline.rotor_synchronous.calibration = 'wrong.toml': DIR/wrong.toml: "
    )
    assert words in err


def test_a_calibration_of_another_speed_is_refused(check, calibration):
    code, _, err = check(calibration, speed_rpm=1500.0)
    assert code == 2
    assert "pipeline.rotor_synchronous.calibration = 'healthy.toml'" in err
    assert "no baseline within 5 % of 1500.0 rpm, but at 3000.0 rpm; calibrate at that speed" in err
