"""Example machine files made faulty, for the tests of the settings."""

from __future__ import annotations

import pytest
from support.paths import ROOT

from daqsvc.settings import MachineFileError, parse_machine_file

MACHINES = ROOT / "config" / "machines"
LAVAL = MACHINES / "laval-rig.toml"
MOTOR = MACHINES / "motor-accelerometer.toml"
TRIAXIAL = MACHINES / "dbc-triaxial.toml"


def problems_of(text, path=LAVAL):
    with pytest.raises(MachineFileError) as caught:
        parse_machine_file(text, path)
    return caught.value.problems


def changed(path, *replacements):
    """The text of a machine file with its first ``old`` made ``new``, and the line of the last change."""
    text = path.read_text(encoding="utf-8")
    line = 0
    for old, new in replacements:
        assert old in text, old
        line = text[: text.index(old)].count("\n") + 1
        text = text.replace(old, new, 1)
    return text, line


def only_problem(path, *replacements):
    text, line = changed(path, *replacements)
    problems = problems_of(text, path)
    assert len(problems) == 1, "\n".join(map(str, problems))
    return problems[0], line
