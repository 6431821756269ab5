"""``make bench`` measures the packages, not the rooms of the tests that have their names."""

from __future__ import annotations

import os
import re
import subprocess
import sys

from support.paths import ROOT


def test_the_packages_are_found_before_the_rooms_of_the_tests() -> None:
    said = subprocess.run(
        ["make", "--dry-run", "--old-file=.venv/.ready", "bench"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    found = re.search(r"PYTHONPATH=(\S+) ", said)
    assert found is not None
    environment = {**os.environ, "PYTHONPATH": found[1]}
    # As a script in tests/bench has it: its own folder, not this one, is the first of the path.
    command = [sys.executable, "-P", "-c", "import drivers.can.settings, daqsvc.recorder, support"]
    subprocess.run(command, cwd=ROOT, env=environment, check=True)
