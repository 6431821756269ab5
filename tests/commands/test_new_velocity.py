"""What ``daqsvc new`` proposes where samples are too slow for the velocity of ISO 20816-3."""

from __future__ import annotations

from pathlib import Path

import pytest

from daqsvc.cli import main
from daqsvc.commands.new.interview import Given, conduct
from daqsvc.settings import load_machine_file

LINES = ["--bus=serial", "--port=/dev/ttyS0", "--columns=n,x", "--counter=n", "--baud=921600"]
TOO_SLOW = "There is no velocity RMS of accel-x."


def new(file: Path, *options: str) -> int:
    return main(["new", f"{file}", "--yes", *LINES, "--sensor=x.type=accelerometer", *options])


@pytest.mark.parametrize(
    ("rate", "rpm", "least"),
    [("100", "2820", "121"), ("50", "1480", "63.2"), ("25", "1480", "63.2"), ("12", "300", "12.8")],
)
def test_zones_are_not_offered_where_the_velocity_would_not_hold_1x(tmp_path, capsys, rate, rpm, least):
    file = tmp_path / "m.toml"
    speed = [f"--rate={rate}", f"--speed={rpm}"]
    assert new(file, *speed, "--limits=iso") == 2
    refused = capsys.readouterr().err
    assert "--limits iso: No zones of ISO 20816-3" in refused
    assert f"Have the device send {least} samples a second or more, best 2560" in refused
    assert not file.exists()
    assert new(file, *speed) == 0  # by itself it takes none
    text = file.read_text()
    assert "\nvelocity_band_hz" not in text
    for shown in (capsys.readouterr().out, " ".join(text.replace("\n# ", " ").split())):
        assert TOO_SLOW in shown
        assert f"Have the device send {least} samples a second or more, best 2560" in shown
    # Below twice 1X an RMS of the samples does not show the machine either.
    too_slow = float(rate) < 2 * float(rpm) / 60
    assert [f"{one.code}" for one in load_machine_file(file).warnings] == ["F34"] * too_slow


def test_own_limits_of_slow_samples_are_of_what_is_measured(tmp_path):
    file = tmp_path / "m.toml"
    assert new(file, "--rate=100", "--speed=2820", "--limits=own", "--alert=0.5") == 0
    machine = load_machine_file(file)
    assert [(one.measure, one.alert) for one in machine.alarms] == [("rms", 0.5)]
    assert machine.warnings == ()


def test_a_person_is_told_why_there_are_no_zones():
    asked = []

    def ask(question):
        asked.append(question)
        return "own" if question.key == "limits" else "0.5" if question.key == "alert" else question.default

    given = {"bus": "serial", "port": "/dev/ttyS0", "columns": "n,x", "counter": "n", "rate": "50"}
    answers = conduct(
        Path("m.toml"), Given(given | {"sensor.x.type": "accelerometer"}, defaults=False), ask, print
    )
    (limits,) = (one for one in asked if one.key == "limits")
    assert list(limits.choices) == ["own", "none"]
    assert limits.topic.text.startswith("No zones of ISO 20816-3: 50 samples a second show")
    (alert,) = (one for one in asked if one.key == "alert")
    assert "(rms of accel-x in g)" in alert.topic.text
    assert alert.default is None
    assert any(note.startswith(TOO_SLOW) for note in answers["notes"])


def test_a_band_narrower_than_that_of_the_standard_is_stated(tmp_path, capsys):
    file = tmp_path / "m.toml"
    assert new(file, "--rate=200", "--speed=1480") == 0
    narrow = "The velocity RMS is of 10 Hz to 80 Hz, as samples come at 200 Hz."
    assert narrow in capsys.readouterr().out
    assert narrow in " ".join(file.read_text().replace("\n# ", " ").split())
    machine = load_machine_file(file)
    assert machine.alarms[0].zones is not None
    assert machine.warnings == ()
    assert new(file, "--overwrite", "--rate=2600", "--speed=1480") == 0
    assert "The velocity RMS is of" not in capsys.readouterr().out + file.read_text()


@pytest.mark.parametrize("kind", ["trend", "accelerometer"])
def test_slow_frames_of_can_are_not_refused_for_a_band(tmp_path, kind):
    file = tmp_path / "m.toml"
    options = ["--bus=can", "--channels=a,b", "--rate=11", f"--sensor=a.type={kind}"]
    assert main(["new", f"{file}", "--yes", *options]) == 0
    warnings = load_machine_file(file).warnings
    assert [f"{one.code}" for one in warnings] == (["F34"] if kind == "accelerometer" else [])


@pytest.mark.parametrize(("bus", "measure"), [("can", "peak_to_peak"), ("virtual", "rms")])
def test_limits_of_a_shaft_are_from_peak_to_peak_but_of_a_simulated_one(tmp_path, bus, measure):
    file = tmp_path / "m.toml"
    options = [f"--bus={bus}", "--channels=x,y", "--rate=1000", "--speed=1480", "--limits=own", "--alert=100"]
    assert main(["new", f"{file}", "--yes", *options, *(f"--sensor={c}.type=proximity" for c in "xy")]) == 0
    assert [(one.measure, one.alert) for one in load_machine_file(file).alarms] == [(measure, 100.0)] * 2


def test_a_machine_slower_than_any_band_gets_no_limit_that_cannot_see_it(tmp_path):
    file = tmp_path / "m.toml"
    assert new(file, "--rate=2600", "--speed=60", "--limits=own", "--alert=0.5") == 0
    machine = load_machine_file(file)
    assert [one.measure for one in machine.alarms] == ["rms"]
    assert machine.warnings == ()
