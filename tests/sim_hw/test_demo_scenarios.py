"""``daqsvc demo`` plays every scenario that comes along, and what makes it stop is one sentence."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import pytest
from support.formats import fits
from support.paths import ROOT

from daqsvc.cli import main
from sim_hw.demo import session
from sim_hw.nodes.pacing import DrivenPacer
from sim_hw.scenario import builtin_scenarios

pytestmark = pytest.mark.integration
SHIPPED = sorted((ROOT / "config/scenarios").glob("*.toml"))
LONG = {"bad-bus", "bearing-damage", "healthy", "link-faults", "paper"}
"""What else the demo is tested with plays the built-in ones."""


def demo(capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, dict[str, Any], str]:
    """Exit code, summary and what was written to stderr."""
    code = main(["demo", "--speed", "1000", "--json", *options])
    heard = capsys.readouterr()
    messages = [json.loads(line) for line in heard.out.splitlines()]
    for one in messages:
        if one["type"] in {"page", "summary"}:  # the others are payloads
            fits("daqsvc demo", one)
    return code, messages[-1] if messages else {}, heard.err


@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(str(name), marks=pytest.mark.long if Path(name).stem in LONG else ())
        for name in [*builtin_scenarios(), *SHIPPED]
    ],
)
def test_every_scenario_that_comes_along_is_played_to_its_end(
    scenario: str, capsys: pytest.CaptureFixture[str]
) -> None:
    code, summary, err = demo(capsys, "--scenario", scenario)
    assert (code, summary["complete"]) == (0, True), err
    assert summary["wrong_declarations"] == 0
    assert None not in {onset["declared_rev"] for onset in summary["onsets"]}
    played, frames = summary["samples"], summary["frames"]
    assert played["sent"] > 0
    assert frames["received"] == frames["sent"]
    # What the device sampled came, or is counted as lost. What it did not sample while it was off is
    # estimated from when its frames came, and on a busy host they are read up to 0.1 s late.
    assert played["received"] + played["lost"] == pytest.approx(played["sent"] + played["left_over"], abs=70)


@pytest.mark.long
def test_noise_beyond_the_converter_is_saturated_and_said(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    code, summary, _ = demo(capsys, "--scenario", "healthy", "--snr-db", "-30")
    assert (code, summary["complete"], summary["wrong_declarations"]) == (0, True, 0)
    assert caplog.text.count("The device saturates such values") == 1


def test_a_receiver_that_stops_reading_ends_the_demo_in_a_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "DrivenPacer", functools.partial(DrivenPacer, stall_s=0.1))
    monkeypatch.setattr(session.DemoSession, "backlog", lambda _: 10**6)
    code, _, err = demo(capsys, "--scenario", "healthy")
    assert code == 1
    assert "daqsvc demo: playing has stopped: the receiver has been 1000000 behind" in err
