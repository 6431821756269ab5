"""The unit in ``config/systemd``: systemd takes it, and finds little that it exposes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

from daqsvc import kernel_cache
from daqsvc.commands import arguments, process_guard

UNIT = ROOT / "config" / "systemd" / "daqsvc@.service"
SYSUSERS = ROOT / "config" / "systemd" / "daqsvc.sysusers.conf"
MOST_EXPOSED = 20
"""Tenths; a service without any of this has 96."""
PROGRAM = "/usr/bin/daqsvc"


@pytest.fixture
def analyze() -> str:
    program = shutil.which("systemd-analyze")
    if program is None:
        if os.environ.get("DAQSVC_REQUIRE_SYSTEMD") == "1":
            pytest.fail("systemd-analyze is missing; install it with: apt-get install systemd")
        pytest.skip("needs systemd-analyze (Debian: systemd)")
    return program


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    """A copy whose program is there."""
    copy = tmp_path / "daqsvc@pump.service"
    text = UNIT.read_text()
    assert text.count(PROGRAM) == 2, "to start it, and to reload it"
    copy.write_text(text.replace(PROGRAM, str(Path(sys.executable).with_name("daqsvc"))))
    return copy


def values(key: str) -> list[str]:
    return re.findall(rf"^{key}=(.*)$", UNIT.read_text(), re.MULTILINE)


def test_systemd_takes_the_unit_without_a_word(analyze: str, unit: Path) -> None:
    done = subprocess.run([analyze, "verify", unit], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_unit_exposes_little(analyze: str, unit: Path) -> None:
    command = [analyze, "security", "--no-pager", "--offline=true", f"--threshold={MOST_EXPOSED}", unit]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Overall exposure level" in done.stdout


def test_the_unit_fits_the_program() -> None:
    assert values("Type") == ["notify"]
    assert values("Restart") == ["on-failure"]
    assert values("RestartPreventExitStatus") == [str(arguments.EXIT_USAGE)]
    still_s = process_guard.STUCK_TURNS * process_guard.TURN_S
    assert float(values("WatchdogSec")[0]) < still_s, (
        "systemd is quicker than the guard, which names the loop first"
    )
    assert float(values("TimeoutStopSec")[0]) > 2.0
    assert Path("/var/cache") / values("CacheDirectory")[0] == kernel_cache.SERVICE
    assert not values("MemoryDenyWriteExecute"), "numba writes code and runs it"
    (account,) = (line.split() for line in SYSUSERS.read_text().splitlines() if not line.startswith("#"))
    assert account[:2] == ["u", *values("User")]
