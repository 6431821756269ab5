"""A long recording is judged piece by piece: what that takes does not grow with its length."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
RATE_HZ = 51_200
MACHINE = ROOT / "config" / "machines" / "bearing.toml"
PROGRAM_MB = 400
"""What the program takes by itself with its compiled kernels (some 220), and the bearings' live detector
while it learns the healthy machine from half a minute at this rate (some 170)."""
LONG_S = 300
SAMPLES_MB = 4e-6 * RATE_HZ * LONG_S
"""As they lie in the file: some 60, so a program that kept them all would take more than it may."""

MEASURE = """
import re, resource, sys
from pathlib import Path
from daqsvc.cli import main
code = main(sys.argv[1:])
from daqsvc.recording.recording import stop_reading
stop_reading()
# The figure of getrusage for the process itself begins with what its parent took when it was started.
program_mb = int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 1e3
print(code, program_mb, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3, file=sys.stderr)
"""


def analyzed(path: Path, samples: np.ndarray, by: str) -> subprocess.CompletedProcess[str]:
    """What the program says of samples in a file, and how much memory it has taken."""
    np.savez(path, de=samples, fs=float(RATE_HZ))
    options = ["--channels", "de", "--bearing", "6205", "--speed-rpm", "1797", "--unit", "m/s2"]
    told = [MACHINE, "--map", "accel-de=de"] if by == "machine file" else options
    arguments = ["analyze", *told, path, "--json", "--jobs", "1"]
    command = [sys.executable, "-c", MEASURE, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True)


@pytest.mark.long
@pytest.mark.timeout(900)
@pytest.mark.parametrize("by", ["machine file", "options"])
def test_five_minutes_at_51200_hz(tmp_path, by):
    noise = np.random.default_rng(3).standard_normal(RATE_HZ * LONG_S, np.float32)
    # Once before: what compiles kernels, the first time on a computer, takes more.
    analyzed(tmp_path / "short.npz", noise[: RATE_HZ * 85], by)
    run = analyzed(tmp_path / "long.npz", noise, by)
    code, program_mb, reader_mb = map(float, run.stderr.splitlines()[-1].split())
    found = json.loads(run.stdout)
    assert code in {0, 3}
    assert found["data_quality"]["samples"] == len(noise)
    assert program_mb < PROGRAM_MB
    assert reader_mb < 100 + SAMPLES_MB + 60  # Python and NumPy, the file, and flags of its samples
