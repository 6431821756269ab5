"""For every code there is a broken machine file, or something else that is wrong, which gives it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest
from support.machine_files import LAVAL, MACHINES, changed
from support.paths import ROOT

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
    ("B04", CAN, [("valid_raw = [-32767, 32767]", "valid_raw = [-40000, 32767]")]),
    ("B16", MODBUS, [('table = "input"\nunit = 1', 'table = "input"\nunit = 250')]),
    ("B17", MODBUS, [("address = 16\ndepth = 1024", "address = 65000\ndepth = 1024")]),
    ("B18", MODBUS, [('name = "t", address = 0,', 'name = "t", address = 100,')]),
    ("B21", MODBUS, [("bits = [0, 12], scale = 0.1", "bits = [30, 12], scale = 0.1")]),
    ("B26", MODBUS, [('name = "t", address = 0,', 'name = "t", address = 40018,')]),
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
    ("O04", LAVAL, [("[store]", PAGE.format("192.0.2.1:8420"))]),
    ("O05", LAVAL, [("[store]", PAGE.format("0.0.0.0:8420"))]),
    ("O07", LAVAL, [(TOPICS, f'{TOPICS}\n[mqtt.sparkplug]\nclient_id = "daqsvc-lab:edge-1"')]),
    ("O08", LAVAL, [(TOPICS, f'{TOPICS}\n[mqtt.sparkplug]\nservers = ["mqtt://other.example"]')]),
]
"""Beside what the guard shows: the code, a machine file, and what is made other in it."""

ELSEWHERE = {
    "F23": "settings/test_failing_plugins.py",
    "F25": "settings/test_failing_plugins.py",
    "F26": "service/test_several_machines.py",
    "B14": "settings/test_settings_contradictions.py",
    "B25": "settings/test_failing_plugins.py",
    "D14": "detectors/rotor_bank/test_bank_of_a_run_up.py",
    "O02": "publish/mqtt/test_mqtt_settings.py",
    "O06": "service/test_several_machines.py",
    "S01": "service/test_reload.py",
    "S02": "commands/test_check_store.py",
}
"""What takes more than a text of a machine file: the test that asserts the code."""


@pytest.mark.parametrize(("code", "path", "edits"), GIVEN, ids=[one[0] for one in GIVEN])
def test_the_broken_machine_file_is_answered_with_the_code(
    code: str, path: Path, edits: list[tuple[str, str]]
) -> None:
    text, _ = changed(path, *edits)
    try:
        machine = parse_machine_file(text, path)
        said = [f"{warning}" for warning in machine.warnings]
        check_files(machine)
    except MachineFileError as error:
        said = [f"{problem}" for problem in error.problems]
    except AssemblyError as error:
        said = [f"{error}"]
    assert any(one.endswith(f"[{code}]") for one in said), said


@pytest.mark.parametrize(("code", "place"), ELSEWHERE.items())
def test_the_test_elsewhere_asserts_the_code(code: str, place: str) -> None:
    assert f"[{code}]" in (ROOT / "tests" / place).read_text(encoding="utf-8")


def test_every_code_is_given_by_something() -> None:
    golden = (ROOT / "tests" / "guard" / "golden").glob("*.txt")
    shown = {
        code for file in golden for code in re.findall(r"\[([A-Z]\d\d)\]", file.read_text(encoding="utf-8"))
    }
    assert [code for code in CODES if code not in shown | {one[0] for one in GIVEN} | set(ELSEWHERE)] == []
