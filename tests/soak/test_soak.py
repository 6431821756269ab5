"""The soak as a test: four minutes of it, and an hour of a machine's time."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from nothing_lost.broker import mosquitto_program
from soak.run import soak
from support.paths import ROOT

if TYPE_CHECKING:
    from pathlib import Path

FOUR_MINUTES_S = 240.0

pytestmark = [pytest.mark.integration, pytest.mark.mosquitto, pytest.mark.long, pytest.mark.timeout(3600)]


@pytest.fixture(autouse=True)
def _mosquitto() -> None:
    if mosquitto_program() is None:
        reason = "no mosquitto on this machine (apt-get install mosquitto)"
        if os.environ.get("DAQSVC_REQUIRE_MOSQUITTO") == "1":
            pytest.fail(reason)
        pytest.skip(reason)


@pytest.mark.first
async def test_four_minutes_of_all_that_can_happen_lose_nothing(tmp_path: Path) -> None:
    """Memory is left to the hour below and to `make soak`: here the last life is too short to say."""
    report = await soak(FOUR_MINUTES_S, tmp_path)
    print(report)  # noqa: T201 - pytest shows it if it fails
    assert not report.violations, f"{report}"
    # What did not happen proves nothing.
    assert {"process killed", "broker killed", "another machine", "bus can0 flaps"} <= report.befell.keys()
    assert report.lives > 1
    assert report.census[0] is not None
    for name, total in report.ledger.totals.items():
        assert total.received > 0, name
        assert total.steady_entries > 0, name
    assert report.ledger.totals["pump"].unsent > 0
    assert report.ledger.totals["fan"].lost > 0
    assert {turn.machine for turn in report.evidence.turns} == {"pump", "fan", "gear", "mill", "saw"}


@pytest.mark.marathon
async def test_an_hour_of_the_machine_s_time_leaves_all_figures_flat() -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([f"{ROOT}", f"{ROOT / 'tests'}"])}
    done = await asyncio.to_thread(
        subprocess.run,
        [sys.executable, "-m", "soak.hour"],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert done.stdout, done.stderr
    outcome = json.loads(done.stdout)
    assert not outcome["violations"], outcome
    assert outcome["machine_s"] >= 3600.0
