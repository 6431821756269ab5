"""For every code there is a broken machine file, or something else that is wrong, which gives it.

Codes of a service that runs come in lines of its log: the tests that make such lines have the mark ``gives``,
and fail without them.
"""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING

import pytest
from support.given_codes import codes_of_marks, in_one_line, messages, unknown
from support.machine_files import LAVAL, MACHINES, changed
from support.paths import ROOT

from daqsvc.cli import main
from daqsvc.detectors.make import check_files
from daqsvc.errors.table import CODES
from daqsvc.settings import MachineFileError, parse_machine_file
from daqsvc.settings.problems import AssemblyError

if TYPE_CHECKING:
    from pathlib import Path

SPECIMENS = ROOT / "tests" / "guard" / "specimens"
MODBUS, SERIAL, CAN = (SPECIMENS / f"specimen-{name}.toml" for name in ("modbus", "serial", "can"))
MEASURES = MACHINES / "standard-measures.toml"
TWO_BUSES = MACHINES / "rotor-two-buses.toml"
TOPICS = 'topic_root = "daqsvc"'
START_UP = '[alarm_handling.start_up]\ndetector = "rotor-bank"\nbetween = [60.0, 660.0]\n[alarm_handling]'
PAGE = '[page]\nlisten = "{}"\n[store]'

GIVEN: list[tuple[str, Path, list[tuple[str, str]]]] = [
    ("F30", LAVAL, [("[store]", "[recorder]\nevery_s = 15.0\n[store]")]),
    ("F31", TWO_BUSES, [("max_error_us = 200.0", "max_error_us = 2000.0")]),
    ("F41", LAVAL, [("static_sag_um = 10.0", "static_sag_um = 130.0")]),
    ("F42", LAVAL, [("speed_rpm = 600.0", "speed_rpm = 0.0")]),
    (
        "F44",
        MACHINES / "modbus-vibration-temperature.toml",
        [('"degC"\nok_between = [-40.0, 105.0]', '"float32"\nok_between = [-40.0, 105.0]')],
    ),
    ("F45", LAVAL, [("speed_rpm = 600.0", "speed_rpm = 1.485")]),
    ("B04", CAN, [("valid_raw = [-32767, 32767]", "valid_raw = [-40000, 32767]")]),
    ("B16", MODBUS, [('table = "input"\nunit = 1', 'table = "input"\nunit = 250')]),
    ("B17", MODBUS, [("address = 16\ndepth = 1024", "address = 65000\ndepth = 1024")]),
    ("B18", MODBUS, [('name = "t", address = 0,', 'name = "t", address = 100,')]),
    ("B21", MODBUS, [("bits = [0, 12], scale = 0.1", "bits = [30, 12], scale = 0.1")]),
    ("B22", MODBUS, [("address = 16\ndepth = 1024", "address = 16\ndepth = 1000")]),
    ("B26", MODBUS, [('name = "t", address = 0,', 'name = "t", address = 40018,')]),
    (
        "B45",
        MACHINES / "modbus-vibration-temperature.toml",
        [('"degC"\nok_between = [-40.0, 105.0]', '"degC"')],
    ),
    ("B46", SERIAL, [('column = "t", unit = "ms"', 'column = "t", unit = "s"')]),
    ("B24", SERIAL, [('"/dev/serial/by-id/usb-a"', '"/dev/ttyUSB0"')]),
    ("D10", LAVAL, [("noise_um = 2.0", "noise_um = 200.0")]),
    (
        "D11",
        LAVAL,
        [('damping_ratio = 0.10, severity = "alert"', 'damping_ratio = 0.02, severity = "alert"')],
    ),
    ("D17", LAVAL, [('name = "F1L3", damping_ratio = 0.02', 'name = "F1L3", damping_ratio = 0.0')]),
    ("A10", MEASURES, [('measure = "velocity_rms_2_1000"', 'measure = "1x_phase_lag"')]),
    ("A12", LAVAL, [("[alarm_handling]", START_UP)]),
    ("A14", MEASURES, [("shaft = true", 'group = 1, support = "rigid"')]),
    (
        "A18",
        MACHINES / "motor-accelerometer.toml",
        [
            ("rate_hz = 12_000.0", "rate_hz = 60.0"),
            ("[10.0, 1000.0]", "[10.0, 24.0]"),
            ('measure = "rms"', 'measure = "velocity_rms"'),
        ],
    ),
    (
        "A19",
        MACHINES / "modbus-vibration-temperature.toml",
        [("ok_between = [0.0, 65.0]", "ok_between = [0.0, 5.0]")],
    ),
    ("O04", LAVAL, [("[store]", PAGE.format("192.0.2.1:8420"))]),
    ("O05", LAVAL, [("[store]", PAGE.format("0.0.0.0:8420"))]),
    ("O07", LAVAL, [(TOPICS, f'{TOPICS}\n[mqtt.sparkplug]\nclient_id = "daqsvc-lab:edge-1"')]),
    ("O08", LAVAL, [(TOPICS, f'{TOPICS}\n[mqtt.sparkplug]\nservers = ["mqtt://other.example"]')]),
]
"""Beside what the guard shows: the code, a machine file, and what is made other in it."""

ELSEWHERE = {
    "F23": "settings/test_failing_plugins.py",
    "F43": "settings/test_failing_plugins.py",
    "F25": "settings/test_failing_plugins.py",
    "F26": "service/test_several_machines.py",
    "B14": "settings/test_settings_contradictions.py",
    "B25": "settings/test_failing_plugins.py",
    "B27": "drivers/test_reconnect.py",
    "B28": "drivers/test_frames.py",
    "C04": "commands/test_store_argument.py",
    "C05": "commands/test_cli_alarms.py",
    "C07": "alarms/test_control_socket.py",
    "C08": "commands/test_cli_alarms.py",
    "C12": "offline/test_export.py",
    "C15": "sim_hw/test_demo_manners.py",
    "C16": "commands/test_cli.py",
    "C17": "page/test_page_server.py",
    "C20": "drivers/can/test_record_command.py",
    "C25": "offline/test_analyze_parts.py",
    "C26": "service/test_assembly.py",
    "C27": "commands/test_store_argument.py",
    "D21": "errors/test_logs_name_codes.py",
    "D22": "errors/test_logs_name_codes.py",
    "D14": "detectors/rotor_bank/test_bank_of_a_run_up.py",
    "O02": "publish/mqtt/test_mqtt_settings.py",
    "O10": "errors/test_logs_name_codes.py",
    "O11": "errors/test_logs_name_codes.py",
    "O24": "publish/mqtt/test_postgresql_ingest.py",
    "O06": "service/test_several_machines.py",
    "R04": "recording/test_recording_bombs.py",
    "R10": "recording/test_recording_files.py",
    "R13": "offline/test_analyze_can_logs.py",
    "R14": "offline/test_analyze_bearing.py",
    "R16": "rotor/test_run_up.py",
    "R18": "offline/test_replay_refused.py",
    "S01": "service/test_reload.py",
    "S02": "commands/test_check_store.py",
    "S03": "outbox/test_outbox.py",
    "S04": "commands/test_cli_alarms.py",
    "S05": "service/test_killed_parts.py",
    "S06": "commands/test_cli_alarms.py",
    "S07": "commands/test_alarm_damage.py",
}
"""What takes more than a text of a machine file: the test that asserts the code."""

OTHER_MESSAGE = "correct the message in tests/errors/messages.txt (DAQSVC_TAKE_MESSAGES=1 adds it)"

COMMANDS: list[tuple[str, list[str]]] = [
    ("C01", ["trend", "--since", "1h", "--until", "2h"]),
    ("C02", ["shelve", "housing", "--for", "5 min"]),
    ("C03", ["alarms"]),
    ("C06", ["status", "--store", "."]),
    ("C09", ["example", "laval-rig", "--out", "nowhere/pump.toml"]),
    ("C10", ["trend", "--store", "broken"]),
    ("C11", ["example", "laval-rig", "--out", "words.csv"]),
    ("C13", ["trend", "--store", "."]),
    ("C14", ["explain", "Z99"]),
    ("C18", ["page", "--listen", "192.0.2.7:8420", "--store", "."]),
    ("C19", ["account", "accounts", "ann", "--remove"]),
    ("C21", ["sniff", "serial", "ttyUSB9"]),
    ("C22", ["new", "--answers", "nowhere.toml"]),
    ("C23", ["sim", "--scenario", "unbalnce", f"{LAVAL}"]),
    ("C24", ["fleet", "report", "."]),
    ("R01", ["export", "nowhere.csv", "--to", "new.csv"]),
    ("R02", ["export", "notes.wav", "--to", "new.csv"]),
    ("R03", ["export", "cut.wav", "--to", "new.csv"]),
    ("R05", ["export", "norate.csv", "--fs", "100", "--map", "y=y", "--to", "new.csv"]),
    ("R06", ["export", "words.csv", "--to", "new.csv"]),
    ("R07", ["export", "norate.csv", "--to", "new.csv"]),
    ("R08", ["export", "timed.csv", "--fs", "500", "--to", "new.csv"]),
    ("R09", ["export", "gap.csv", "--to", "new.csv"]),
    ("R11", ["export", "header.csv", "--to", "new.csv"]),
    ("R12", ["export", "plant.blf", "--to", "new.csv"]),
    ("R15", ["analyze", f"{LAVAL}", "norate.csv", "--fs", "100"]),
    ("R17", ["replay", "notes.mcap"]),
    ("R19", ["export", "norate.csv", "--fs", "99.5", "--to", "new.wav"]),
]
"""The code, and what is asked of daqsvc where `RECORDINGS` are."""

RECORDINGS = {
    "words.csv": "a,b\n1,2\nfoo,5\n3,4\n",
    "norate.csv": "x\n1\n2\n3\n",
    "timed.csv": "t (s),x\n" + "".join(f"{i / 1000},{i % 7}\n" for i in range(50)),
    "header.csv": "x,y\n",
    "gap.csv": "t (s),x\n" + "".join(f"{i / 1000},{i % 7}\n" for i in (*range(50), *range(5000, 5050))),
    "cut.wav": "RIFF\0\0\0\0WAVEfmt \x10\0\0\0\1\0\1\0\x40\x1f\0\0\x40\x1f\0\0\1\0\x08\0data\x40\x1f\0\0ab",
    "broken/history.sqlite": "no database at all, but long enough to be one",
    "notes.wav": "no sound",
    "notes.mcap": "no snapshot",
    "plant.blf": "no log",
}


@pytest.mark.parametrize(("code", "arguments"), COMMANDS, ids=[one[0] for one in COMMANDS])
def test_the_command_is_answered_with_the_code(
    code: str,
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name, text in RECORDINGS.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", f"{tmp_path}")
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    try:
        exit_code = main(arguments)
    except SystemExit as error:  # of the parser
        exit_code = error.code
    assert exit_code != 0
    out, err = capsys.readouterr()
    given = re.findall(rf"^(.*) \[{code}\]$", (err or out).rstrip(), re.MULTILINE)
    assert given, (out, err)
    assert not unknown(code, set(given)), OTHER_MESSAGE


def said_of(path: Path, edits: list[tuple[str, str]]) -> list[str]:
    """What is said of a machine file that is changed so: errors and warnings, with their codes."""
    text, _ = changed(path, *edits)
    try:
        machine = parse_machine_file(text, path)
        said = [f"{warning}" for warning in machine.warnings]
        check_files(machine)
    except MachineFileError as error:
        said = [f"{problem}" for problem in error.problems]
    except AssemblyError as error:
        said = [f"{error}"]
    return said


@pytest.mark.parametrize(("code", "path", "edits"), GIVEN, ids=[one[0] for one in GIVEN])
def test_the_broken_machine_file_is_answered_with_the_code(
    code: str, path: Path, edits: list[tuple[str, str]]
) -> None:
    said = said_of(path, edits)
    given = {one.removesuffix(f" [{code}]") for one in said if one.endswith(f"[{code}]")}
    assert given, said
    assert not unknown(code, {in_one_line(one) for one in given}), OTHER_MESSAGE


@pytest.mark.parametrize(("code", "place"), ELSEWHERE.items())
def test_the_test_elsewhere_asserts_the_code(code: str, place: str) -> None:
    text = (ROOT / "tests" / place).read_text(encoding="utf-8")
    assert f"[{code}]" in text or f'"{code}"' in text


@cache
def shown() -> dict[str, set[str]]:
    """By code the messages of the golden texts of the guard, which holds the program to them."""
    found: dict[str, set[str]] = {}
    for file in (ROOT / "tests" / "guard" / "golden").glob("*.txt"):
        text = re.sub(r"\n    (?! )", " ", file.read_text("utf-8"))  # warnings go on below themselves
        for message, code in re.findall(r"^(?:! |  )?(.*) \[([A-Z]\d\d)\]$", text, re.MULTILINE):
            found.setdefault(code, set()).add(in_one_line(message.removeprefix("machines/")))
    return found


@pytest.mark.parametrize("code", sorted({*shown()} - {one[0] for one in COMMANDS} - codes_of_marks()))
def test_a_message_of_the_golden_texts_is_among_those_that_tests_have_had(code: str) -> None:
    assert not unknown(code, shown()[code]), OTHER_MESSAGE


def test_every_code_is_given_by_something() -> None:
    given = {one[0] for one in [*GIVEN, *COMMANDS]} | set(ELSEWHERE) | codes_of_marks()
    assert [code for code in CODES if code not in given and code not in shown()] == []


def test_every_code_has_a_message_that_the_program_has_given() -> None:
    assert [code for code in CODES if code not in messages()] == []
