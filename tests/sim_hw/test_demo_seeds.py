"""The paper's scenario through the whole service, 20 seeds of 20; ten of them in .ci/run.

Twenty right of twenty says, with 95 % confidence, that more than 86 % of runs are right (Clopper-Pearson);
`test_rotor_detection.py` says more, on the detector alone.
"""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

pytestmark = pytest.mark.statistical
SEEDS = 20
MODES = ["N", "F1", "F1L2", "F1L3"]


@pytest.mark.statistical
@pytest.mark.parametrize(
    "seed",
    [*range(SEEDS // 2), *(pytest.param(n, marks=pytest.mark.marathon) for n in range(SEEDS // 2, SEEDS))],
)
def test_the_demo_declares_the_papers_modes_in_order(seed: int) -> None:
    command = [sys.executable, "-m", "daqsvc", "demo", "--scenario", "paper", "--json"]
    command += ["--seed", str(seed), "--speed", "1000"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    diagnoses = [line for line in lines if line["type"] == "diagnosis" and line["detector"] == "rotor-bank"]
    assert [line["decision"] for line in diagnoses if line["changed"]] == MODES
    summary = lines[-1]
    assert summary["declared"] == MODES
    assert summary["wrong_declarations"] == 0
    assert summary["samples"]["lost"] == 0
    # Each mode was declared while the machine was in it.
    assert all(row["delay_rev"] is not None for row in summary["onsets"])
