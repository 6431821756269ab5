"""What a machine file can say about the recording of a CAN bus."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.machine_files import LAVAL, changed, only_problem

from daqsvc.acquisition.clock import SystemClock
from daqsvc.commands.record import ENDINGS
from daqsvc.settings import describe, parse_machine_file
from drivers.can.driver import CanDriver
from drivers.can.record_files import ENDINGS as WRITTEN
from drivers.can.record_files import OneLog
from drivers.make import bus_driver

WITH_RECORD = ("fd = true", 'fd = true\nrecord = { folder = "can", format = "candump", keep_mb = 500 }')


def test_a_recorded_bus_is_described_and_its_folder_is_beside_the_machine_file() -> None:
    text, _ = changed(LAVAL, WITH_RECORD)
    machine = parse_machine_file(text, Path("/etc/daqsvc/m.toml"))
    assert "recorded as candump in can, 500 MB at most" in describe(machine).replace("\n", " ")
    driver = bus_driver(machine, "can0", SystemClock(), lambda _: None)
    assert isinstance(driver, CanDriver)
    assert driver._bus.record is not None
    assert driver._bus.record.model_dump() == {
        "folder": Path("/etc/daqsvc/can"),
        "format": "candump",
        "file_mb": 64,
        "keep_mb": 500,
    }


def test_a_bus_is_not_recorded_unless_it_is_asked_for() -> None:
    bus = parse_machine_file(LAVAL.read_text(encoding="utf-8"), LAVAL).buses["can0"].model_dump()
    assert bus["record"] is None
    assert bus["filter"] is None


@pytest.mark.parametrize(
    ("record", "key", "said"),
    [
        ('{ folder = "can", file_mb = 300, keep_mb = 599 }', "keep_mb", "keep 600 MB or more"),
        ('{ folder = "can", format = "mdf" }', "format", "candump"),
        ('{ format = "blf" }', "folder", "/var/lib/daqsvc/can"),
    ],
)
def test_what_cannot_be_recorded_is_named_with_a_remedy(record: str, key: str, said: str) -> None:
    problem, _ = only_problem(LAVAL, ("fd = true", f"fd = true\nrecord = {record}"))
    assert problem.key == f"buses.can0.record.{key}"
    assert said in str(problem)


def test_the_verb_knows_the_endings_of_all_formats() -> None:
    assert set(ENDINGS) == set(WRITTEN.values())
    with pytest.raises(ValueError, match=r"must end in \.blf, \.asc, \.log"):
        OneLog(Path("run.csv"))
