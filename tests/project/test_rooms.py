"""Tests lie by the packages that they are about, and one room of them can be run."""

from __future__ import annotations

import os
import subprocess

import pytest
from support.paths import ROOT

TESTS = ROOT / "tests"
SUITES = {"conformance", "guard", "hil", "nothing_lost", "plants", "project", "prose", "soak", "tutorials"}
ROOMS = sorted({str(file.parent.relative_to(TESTS)) for file in TESTS.rglob("test_*.py")})


def make(**variables: str) -> subprocess.CompletedProcess[str]:
    """What ``make test`` would run."""
    environment = {
        k: v for k, v in os.environ.items() if k not in {"MAKEFLAGS", "MAKELEVEL", "MFLAGS", "ROOM"}
    }
    command = ["make", "--dry-run", "--directory", ROOT, "test", *(f"{k}={v}" for k, v in variables.items())]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


@pytest.mark.sources
@pytest.mark.parametrize("room", [room for room in ROOMS if room not in SUITES])
def test_a_room_is_a_package_or_a_module(room: str) -> None:
    places = [ROOT / "daqsvc" / room, ROOT / room, (ROOT / "daqsvc" / room).with_suffix(".py")]
    assert any(place.exists() for place in places), places


def test_no_two_files_of_tests_have_the_same_name() -> None:
    """Pytest would not read the second of them, in a run of both."""
    names = [file.name for file in TESTS.rglob("test_*.py")]
    assert sorted(names) == sorted({*names})


def test_no_test_lies_outside_a_room() -> None:
    assert "." not in ROOMS
    assert "drivers/can" in ROOMS
    assert (
        sorted(make(ROOM="nowhere").stderr.partition("there are ")[2].partition(".  Stop")[0].split())
        == ROOMS
    )


def test_one_room_is_run_and_without_it_all() -> None:
    assert '-m "not long" tests/drivers/can ' in make(ROOM="drivers/can").stdout
    assert '-m "not long"  ' in make().stdout


def test_a_room_that_is_not_there_is_told_in_a_sentence_with_those_that_are() -> None:
    done = make(ROOM="rotors")
    assert done.returncode != 0
    assert "pytest" not in done.stdout
    assert "there is no room 'rotors' in tests/; there are acquisition alarms bearing" in done.stderr


def test_every_test_is_of_one_kind(request: pytest.FixtureRequest) -> None:
    kinds = {"unit", "property", "integration", "statistical", "hil", "conformance"}
    for item in request.session.items:
        found = {mark.name for mark in item.iter_markers()} & kinds
        assert len(found) == 1, (item.nodeid, found)
