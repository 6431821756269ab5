"""What ``daqsvc new`` makes of a DBC file."""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING, Any

import pytest

from daqsvc.cli import main
from daqsvc.commands.new.interview import Given, conduct, take
from daqsvc.commands.new.machine_text import questions

if TYPE_CHECKING:
    from pathlib import Path

    from drivers.questions import Answers, Question

pytestmark = pytest.mark.integration
GEARBOX = """VERSION ""
BU_: A
BO_ 801 Slow: 8 A
 SG_ Page M : 0|4@1+ (1,0) [0|0] "" A
 SG_ SlowCount : 4|4@1+ (1,0) [0|0] "" A
 SG_ OilTemp m0 : 8|16@1- (0.1,0) [0|0] "degC" A
 SG_ OilPress m0 : 24|16@1+ (0.01,0) [0|0] "bar" A
 SG_ ShaftSpeed m1 : 8|16@1+ (0.25,0) [0|0] "rpm" A
 SG_ MotorCurrent m1 : 24|12@1- (0.1,0) [0|0] "A" A
 SG_ Hours m2 : 16|32@1+ (0.1,0) [0|0] "h" A
BO_ 800 Vibration: 8 A
 SG_ Count : 0|4@1+ (1,0) [0|0] "" A
 SG_ AX_0 : 8|12@1- (0.002,0) [0|0] "g" A
 SG_ AY_0 : 20|12@1- (0.002,0) [0|0] "g" A
 SG_ AX_1 : 32|12@1- (0.002,0) [0|0] "g" A
 SG_ AY_1 : 44|12@1- (0.002,0) [0|0] "g" A
 SG_ Supply : 56|8@1+ (0.2,0) [0|0] "V" A
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_ "GenMsgCycleTime" BO_ 800 2;
"""
"""Two axes with two samples each in a frame, beside a supply voltage; a slow message that is multiplexed."""


def new(folder: Path, dbc: str, *more: str) -> dict[str, Any]:
    """The tables of the file that is written for a DBC file."""
    (folder / "device.dbc").write_text(dbc)
    file = folder / "new.toml"
    given = ["--yes", "--overwrite", "--bus=can-dbc", f"--dbc={folder / 'device.dbc'}", *more]
    assert main(["new", f"{file}", *given]) == 0
    assert main(["check", f"{file}"]) == 0
    return tomllib.loads(file.read_text("utf-8"))


def layout_of(tables: dict[str, Any]) -> dict[str, Any]:
    [stream] = tables["streams"].values()
    return stream["layout"] | {"rate_hz": stream["rate_hz"]}


def test_names_that_state_samples_are_no_guess(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of other names only a counter of samples shows it."""
    for named, is_guess in ((GEARBOX, True), (re.sub("(A[XY])_", r"\1Sample_", GEARBOX), False)):
        layout = layout_of(new(tmp_path, named))
        said = capsys.readouterr().out
        assert [len(one["signals"]) for one in layout["channels"]] == [2, 2]
        assert (", channels" in said.partition("Assumed, ")[2].partition(". ")[0]) == is_guess
        text = (tmp_path / "new.toml").read_text("utf-8")
        assert text.count('_1"] },  # assumed') == 2 * is_guess
        assert ('# If these are separate sensors: { name = "A' in text) == is_guess


@pytest.mark.parametrize("signals", ["AX_0, AY_0", "AX_0, Supply"])
def test_a_supply_voltage_makes_no_volts_of_the_other_signals(tmp_path: Path, signals: str) -> None:
    tables = new(tmp_path, GEARBOX, f"--signals={signals}")
    kinds = [(one["type"], one["unit"]) for one in tables["sensors"]]
    assert kinds == [("accelerometer", "g"), *{"Supply": [("trend", "V")]}.get(signals[6:], kinds[:1])]
    assert not any("sensitivity_mv_per_unit" in one for one in tables["sensors"])


def test_the_message_of_vibration_is_proposed_and_its_samples_are_of_one_channel(tmp_path: Path) -> None:
    layout = layout_of(new(tmp_path, GEARBOX))
    assert layout["message"] == "Vibration"
    assert layout["channels"] == [
        {"name": "AX", "signals": ["AX_0", "AX_1"]},
        {"name": "AY", "signals": ["AY_0", "AY_1"]},
    ]
    assert layout["rate_hz"] == 1000.0  # 500 frames a second


@pytest.mark.parametrize(
    ("dbc", "likely"),
    [
        (GEARBOX, "yes"),
        (GEARBOX.replace("_1", "_2").replace("_0", "_1"), "no"),  # two bearings have such names, too
        (GEARBOX.replace('"g"', '"degC"'), "no"),
    ],
)
def test_whether_samples_are_of_one_channel_is_asked(tmp_path: Path, dbc: str, likely: str) -> None:
    (tmp_path / "device.dbc").write_text(dbc)
    shown: dict[str, Question] = {}

    def ask(question: Question) -> str:
        shown[question.key] = question
        return question.default or ""

    signals = ", ".join(name for name in dbc.split() if name.startswith(("AX_", "AY_")))
    given = {
        "bus": "can-dbc",
        "dbc": "device.dbc",
        "message": "Vibration",
        "signals": signals,
        "limits": "none",
    }
    answers = conduct(tmp_path / "new.toml", Given(given, defaults=False), ask, print)
    assert shown["consecutive"].default == likely
    assert answers["consecutive"] == (likely == "yes")
    assert len([key for key in answers if key.endswith(".type")]) == (2 if likely == "yes" else 4)


@pytest.mark.parametrize(
    ("stated", "unit"),
    [
        *((one, one) for one in ("l/min", "m3/h", "kW", "Hz", "Nm", "m³/h", "kWh", "1/h")),
        ("°C", "degC"),
        ("1/min", "rpm"),
        ("µm", "um"),
        ("litres per minute!", "1"),  # no unit of a machine file is as long
    ],
)
def test_the_unit_of_the_dbc_file_is_taken_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], stated: str, unit: str
) -> None:
    tables = new(tmp_path, GEARBOX.replace('"degC"', f'"{stated}"'), "--message=Slow", "--rate=10")
    assert {one["channel"]: one["unit"] for one in tables["sensors"]}["OilTemp"] == unit
    assert ("[F40]" in capsys.readouterr().out) == (unit == "1")


@pytest.mark.parametrize(
    ("name", "stated", "unit"),
    [
        *(
            ("OilTemp", f"mm/s {word}", f"mm/s {word}")
            for word in ("pk", "0-p", "p-p", "pp", "peak", "(peak)")
        ),
        *((name, "mm/s", "mm/s") for name in ("VPeak", "Vmax", "AlarmSetpoint", "BeltSpeed", "Vib_pk")),
        *(
            (name, "mm/s", "mm/s")
            for name in (
                *("Schwing_Spitze", "Spitzenwert_DE", "Scheitelwert", "v_Maximalwert"),
                *("Hoechstwert", "Hochstwert", "GrenzwertVib", "Vib_Grenze", "SollwertAlarm", "v_Soll"),
                *("Schwellwert", "Schwellenwert", "Alarmwert", "Warnwert_2", "Vorgabe_v"),
                *("Bandgeschwindigkeit", "FoerderGeschw", "Fordergeschw", "Vorschub"),
            )
        ),
    ],
)
def test_what_is_no_rms_gets_no_zones_of_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, stated: str, unit: str
) -> None:
    dbc = GEARBOX.replace("OilTemp", name).replace('"degC"', f'"{stated}"')
    tables = new(tmp_path, dbc, "--message=Slow", f"--signals={name}", "--rate=10")
    assert [one["unit"] for one in tables["sensors"]] == [unit]
    assert "alarms" not in tables
    said = f"by unit or name {name} ({unit}) is another value. Write [[alarms]]"
    assert said in " ".join(capsys.readouterr().out.split())
    assert said in " ".join((tmp_path / "new.toml").read_text("utf-8").replace("\n# ", " ").split())


@pytest.mark.parametrize(
    ("name", "stated"),
    [
        *((name, "mm/s") for name in ("VelRms", "Vib", "MaxVelRms", "ClimaxMill_Vel", "BeltFan_Vel")),
        *((name, "mm/s") for name in ("Schwinggeschwindigkeit_DE", "Effektivwert", "SpitzeEff", "Band_Vib")),
        *((name, "mm/s") for name in ("Grenzschwingeffektivwert", "Konsole_Schwing", "Vorschubmotor_Vib")),
        *(("OilTemp", stated) for stated in ("mm/s RMS", "mm/s eff", "mm/s eff.")),
    ],
)
def test_an_rms_has_the_zones(tmp_path: Path, name: str, stated: str) -> None:
    dbc = GEARBOX.replace("OilTemp", name).replace('"degC"', f'"{stated}"')
    tables = new(tmp_path, dbc, "--message=Slow", f"--signals={name}", "--rate=10")
    assert [one["zones"]["standard"] for one in tables["alarms"]] == ["iso-20816-3"]


def test_a_name_with_rms_gets_the_zones(tmp_path: Path) -> None:
    dbc = GEARBOX.replace("OilTemp", "Vmax").replace('"degC"', '"mm/s"')
    named = ("--message=Slow", "--signals=Vmax", "--rate=10", "--sensor=Vmax.name=Vmax-RMS")
    assert [one["zones"]["standard"] for one in new(tmp_path, dbc, *named)["alarms"]] == ["iso-20816-3"]


@pytest.mark.parametrize("text", ["Slow", "0x321", "id 0x321", "801"])
def test_a_message_may_be_named_by_the_id_that_the_list_shows(tmp_path: Path, text: str) -> None:
    assert layout_of(new(tmp_path, GEARBOX, f"--message={text}", "--rate=10 Hz"))["message"] == "Slow"


def test_limits_in_another_unit_than_the_samples_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dbc = GEARBOX.replace("OilTemp", "AccX").replace('"degC"', '"mg"')
    own = ("--limits=own", "--alert=100", "--danger=150")
    new(
        tmp_path,
        dbc,
        "--message=Slow",
        "--signals=AccX",
        "--rate=2000",
        "--sensor=AccX.type=accelerometer",
        *own,
    )
    said = " ".join(capsys.readouterr().out.split())
    assert "Alert and danger of accel-AccX are of the velocity rms in mm/s, and not in mg." in said


@pytest.mark.parametrize(("stated", "unit"), [("mg", "mg"), ("mm/s²", "mm/s2"), ("m/s^2", "m/s2")])
def test_samples_in_any_unit_of_acceleration_make_an_accelerometer(
    tmp_path: Path, stated: str, unit: str
) -> None:
    tables = new(tmp_path, GEARBOX.replace('"g"', f'"{stated}"'))
    assert {(one["type"], one["unit"]) for one in tables["sensors"]} == {("accelerometer", unit)}
    assert {one["measure"] for one in tables["alarms"]} == {"velocity_rms"}


def test_no_remedy_names_a_unit_that_the_type_of_the_sensor_does_not_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "device.dbc").write_text(GEARBOX.replace('"g"', '"ft/s2"'))
    given = ["--yes", "--bus=can-dbc", f"--dbc={tmp_path / 'device.dbc'}", "--sensor=AX_0.type=accelerometer"]
    assert main(["new", f"{tmp_path / 'new.toml'}", *given]) == 2
    refused = capsys.readouterr().err
    assert "an accelerometer has its samples in g, m/s2, mg or mm/s2: multiply scale and offset of" in refused
    assert 'by 0.031081 and write "g" as its unit there' in refused
    assert 'unit = "ft/s2"' not in refused


@pytest.mark.parametrize(
    ("stated", "written"),
    [
        ("[-40|215]", [-40.0, 215.0]),
        ("[0|0]", None),
        ("[-3276.8|3276.7]", None),  # what 16 bits can carry
        ("[-3200|3200]", None),  # most of it, as SAE J1939 has it
    ],
)
def test_what_a_sensor_can_measure_is_as_the_dbc_file_states(
    tmp_path: Path, stated: str, written: list[float] | None
) -> None:
    dbc = GEARBOX.replace('(0.1,0) [0|0] "degC"', f'(0.1,0) {stated} "degC"')
    more = ["--message=Slow", "--signals=OilTemp", "--rate=10", "--limits=own", "--alert=110"]
    [sensor] = new(tmp_path, dbc, *more, "--danger=130")["sensors"]
    assert sensor.get("ok_between") == written
    if stated == "[-40|215]":  # an alarm that lies beyond would never come
        assert "ok_between" not in new(tmp_path, dbc, *more, "--danger=230")["sensors"][0]


def test_samples_beside_another_signal_are_read_together_by_request(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layout = layout_of(new(tmp_path, GEARBOX, "--signals=AX_0, AX_1, Supply"))
    assert [one["name"] for one in layout["channels"]] == ["AX_0", "AX_1", "Supply"]
    assert layout["rate_hz"] == 500.0
    capsys.readouterr()
    given = ("--signals=AX_0, AX_1, Supply", "--consecutive=yes", "--counter=Count")
    layout = layout_of(new(tmp_path, GEARBOX, *given))
    assert layout["channels"] == [{"name": "AX", "signals": ["AX_0", "AX_1"]}]
    assert layout["rate_hz"] == 1000.0
    assert layout["counter"] == {"signal": "Count", "counts": "frames"}
    left_out = "comes once a frame, the channels have 2 samples in it; another stream reads it"
    assert f"Not read: Supply. Each {left_out}.\n" in capsys.readouterr().out
    assert f"# Supply is left out: it {left_out}\n" in (tmp_path / "new.toml").read_text("utf-8")


def test_an_answer_is_not_refused_for_a_sensor_that_was_not_asked_about(tmp_path: Path) -> None:
    """The default type of this one does not fit its unit: there another can be taken, here nothing."""
    file, dbc = tmp_path / "new.toml", GEARBOX.replace("AX_0", "Accel").replace('"g"', '"mA"')
    (tmp_path / "device.dbc").write_text(dbc)
    answers: Answers = {}
    texts = {"bus": "can-dbc", "dbc": "device.dbc", "message": "Vibration", "signals": "Accel"}
    for question in questions(answers, tmp_path):
        refused = take(question, texts.get(question.key, question.default or ""), answers, file)
        if question.key == "sensor.Accel.type":
            assert refused is not None
            assert "sensors[0].unit" in refused
            assert take(question, "trend", answers, file) is None
        else:
            assert refused is None, question.key
    assert answers["sensor.Accel.unit"] == "mA"


def test_a_name_that_is_too_long_is_refused_at_its_own_question(tmp_path: Path) -> None:
    answers: Answers = {}
    for question in questions(answers, tmp_path):
        if question.key == "name":
            refused = take(question, "x" * 257, answers, tmp_path / "new.toml")
            assert refused == "it has 257 characters; 256 are allowed: shorten it"
            break
        assert take(question, "can-dbc", answers, tmp_path / "new.toml") is None
    tables = new(tmp_path, GEARBOX, f"--name={'x' * 256}")
    assert len(tables["machine"]["description"]) == 256


LEVELS = """VERSION ""
BU_: A
BO_ 700 Fast: 8 A
 SG_ VelRms_DE : 0|16@1- (0.01,0) [0|0] "mm/s" A
 SG_ Vel_NDE : 16|16@1+ (0.01,0) [0|100] "mm/s" A
 SG_ AccRms_DE : 32|16@1+ (0.001,0) [0|30] "g" A
 SG_ Raw : 48|12@1- (0.01,0) [0|0] "mm/s" A
 SG_ Cnt : 60|4@1+ (1,0) [0|0] "" A
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10000;
BA_ "GenMsgCycleTime" BO_ 700 10;
"""
"""Values that a device has computed from a waveform, as often as a waveform."""


def test_an_rms_that_comes_as_often_as_a_waveform_has_its_alarm_on_its_value(tmp_path: Path) -> None:
    tables = new(tmp_path, LEVELS)
    kinds = {one["channel"]: one["type"] for one in tables["sensors"]}
    assert kinds == {"VelRms_DE": "trend", "Vel_NDE": "trend", "AccRms_DE": "trend", "Raw": "velocity"}
    measures = {one["sensor"]: one["measure"] for one in tables["alarms"]}
    assert measures == {"VelRms_DE": "value", "Vel_NDE": "value", "velocity-Raw": "velocity_rms"}


@pytest.mark.parametrize(
    ("most", "limits", "written"),
    [
        (10, ["--limits=iso"], False),  # 14 mm/s would have no alarm
        (4, ["--limits=iso"], False),  # the danger limit lies beyond it
        (50, ["--limits=iso"], True),
        (10, ["--limits=none"], True),
        (10, ["--limits=own", "--alert=3", "--danger=6"], False),
        (20, ["--limits=own", "--alert=3", "--danger=6"], True),
        (9, ["--limits=own", "--alert=6", "--danger=6.5"], False),  # of which `daqsvc check` would warn
    ],
)
def test_a_range_that_ends_near_the_danger_limit_suppresses_no_alarm(
    tmp_path: Path, most: int, limits: list[str], *, written: bool
) -> None:
    dbc = LEVELS.replace("[0|100]", f"[0|{most}]")
    [sensor] = new(tmp_path, dbc, "--signals=Vel_NDE", *limits)["sensors"]
    assert sensor.get("ok_between") == ([0.0, float(most)] if written else None)
    text = (tmp_path / "new.toml").read_text("utf-8")
    left_out = f"# The DBC file states 0 to {most} mm/s. It is no ok_between here: beyond"
    assert (left_out in text) == (not written)
