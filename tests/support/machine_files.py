"""Example machine files made faulty, for the tests of the settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from support.paths import ROOT

from daqsvc.settings import MachineFileError, parse_machine_file

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from daqsvc.settings import MachineFile
    from daqsvc.settings.problems import Problem

MACHINES = ROOT / "config" / "machines"
LAVAL = MACHINES / "laval-rig.toml"
MOTOR = MACHINES / "motor-accelerometer.toml"
TRIAXIAL = MACHINES / "dbc-triaxial.toml"


def problems_of(text: str, path: Path = LAVAL) -> Sequence[Problem]:
    with pytest.raises(MachineFileError) as caught:
        parse_machine_file(text, path)
    return caught.value.problems


def changed(path: Path, *replacements: tuple[str, str]) -> tuple[str, int]:
    """The text of a machine file with its first ``old`` made ``new``, and the line of the last change."""
    text = path.read_text(encoding="utf-8")
    line = 0
    for old, new in replacements:
        assert old in text, old
        line = text[: text.index(old)].count("\n") + 1
        text = text.replace(old, new, 1)
    return text, line


def parsed(path: Path, *replacements: tuple[str, str]) -> MachineFile:
    """The machine file with changes that leave it sound."""
    return parse_machine_file(changed(path, *replacements)[0], path)


def only_problem(path: Path, *replacements: tuple[str, str]) -> tuple[Problem, int]:
    text, line = changed(path, *replacements)
    problems = problems_of(text, path)
    assert len(problems) == 1, "\n".join(map(str, problems))
    return problems[0], line
