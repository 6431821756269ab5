"""The calibrated rotor from the bus to its alarm: what an operator sees when a machine changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.live_service import play, running, watch_of
from support.machine_files import MACHINES
from support.waiting import eventually

from daqsvc.box import Box
from daqsvc.service import Service
from daqsvc.settings import parse_machine_file
from sim_hw.demo.broker import EmbeddedBroker
from sim_hw.demo.session import DemoSession, Script
from sim_hw.link_faults import LinkFaults
from sim_hw.scenario import Scenario

if TYPE_CHECKING:
    from pathlib import Path

    from sim_hw.demo.session import Received

pytestmark = pytest.mark.integration
EXAMPLE = MACHINES / "rotor-synchronous.toml"
HEALTHY_REV, CHANGED_REV = 80.0, 150.0


def scenario(*onsets, revolutions=230.0):
    """The example's pump at 0.8 of its critical speed; onsets are pairs of revolution and change."""
    return Scenario.model_validate(
        {
            "title": "a pump",
            "revolutions": revolutions,
            "plant": {
                "kind": "rotor",
                "speed_rpm": 1500.0,
                "rotor": {"speed_ratio": 0.8, "damping_ratio": 0.11, "eccentricity": 0.1},
            },
            "noise": {"snr_db": 10.0},
            "onset": [
                {"mode": f"mode-{i}", "at_rev": at, "change": change} for i, (at, change) in enumerate(onsets)
            ],
        }
    )


@pytest.fixture(scope="module")
def rebalanced():
    """A rotor whose unbalance grows by three quarters, and that is balanced again."""
    return scenario((HEALTHY_REV, {"eccentricity": 0.175}), (CHANGED_REV, {"eccentricity": 0.1})).simulate(4)


def samples_of(machine):
    return np.column_stack([machine.channels[name] for name in ("x_um", "y_um", "keyphasor_v")])


def machine_file(url):
    text = EXAMPLE.read_text(encoding="utf-8").replace('"socketcan"', '"virtual"')
    text = text[: text.index("[mqtt]")] + f'[mqtt]\nurl = "{url}"\ninsecure = true\n'
    return parse_machine_file(text, EXAMPLE)


@pytest.mark.long
async def test_a_change_is_one_alarm_refined_from_departure_to_name(rebalanced) -> None:
    heard: list[Received] = []
    script = Script(
        title="unbalance",
        machine=machine_file,
        stream="shaft",
        samples=samples_of(rebalanced),
        rate_hz=rebalanced.rate_hz,
        faults=LinkFaults(drop=0.01, seed=1),
    )
    outcome = await DemoSession(script, speed=1000, broker_url=None, on_message=heard.append).run()
    assert outcome.complete
    alarms = [m.payload for m in heard if m.kind == "alarm" and m.payload["alarm"] == "rotor-changed"]
    assert [(p["kind"], p["cause"]["decision"]) for p in alarms] == [
        ("raised", "departure"),
        ("changed", "unbalance"),
        ("returned", "normal"),
    ]
    raised, named, returned = alarms
    assert len({p["occurrence"] for p in alarms}) == 1
    assert raised["level"] == named["level"] == "alert"
    # Departed within two revolutions, named at the third look, back within twenty of being balanced.
    at = [p["cause"]["revolutions"] for p in alarms]
    assert HEALTHY_REV - 0.5 < at[0] < HEALTHY_REV + 3.0
    assert at[1] < HEALTHY_REV + 13.0
    assert CHANGED_REV < at[2] < CHANGED_REV + 25.0
    cause = named["cause"]
    assert set(cause["group"]) == {"unbalance", "damping_loss"}
    assert cause["evidence"]["unbalance"] > 100.0
    assert cause["thresholds"]["departure"] < raised["cause"]["statistics"]["departure"]
    assert sum(cause["probabilities"].values()) == pytest.approx(1.0)
    onset = cause["window"]["first_index"] / 64.0
    assert onset == pytest.approx(HEALTHY_REV, abs=3.0)
    assert "finds a change, its cause not yet known" in raised["message"]
    assert "finds unbalance" in named["message"]
    assert "not told apart from damping_loss" in named["message"]
    assert returned["level"] == "normal"
    # What the diagnoses cost: a few statements a second, not one a revolution.
    said = [m for m in heard if m.kind == "diagnosis" and m.payload["detector"] == "rotor-synchronous"]
    assert len(said) < 45
    assert outcome.figures["streams"]["shaft"]["samples_lost"] > 0


@pytest.mark.long
async def test_a_silent_bus_does_not_clear_the_alarm(tmp_path: Path) -> None:
    machine = scenario((60.0, {"eccentricity": 0.25}), revolutions=90.0).simulate(5)
    async with EmbeddedBroker() as broker:
        async with running(machine_file(broker.url), tmp_path) as service:
            await play(service, samples_of(machine), machine.rate_hz)
            await eventually(
                lambda: "unbalance" in service.alarms.manager.alarms["rotor-changed"].message,
                "the change is named",
            )
            await eventually(
                lambda: "detector-ok/rotor-synchronous" in service.alarms.manager.alarms,
                "the silence is told",
            )
            alarms = service.alarms.manager.alarms
            assert alarms["detector-ok/rotor-synchronous"].level.label == "alert"
            assert "no samples of stream 'shaft'" in alarms["detector-ok/rotor-synchronous"].message
            assert alarms["rotor-changed"].level.label == "danger"
            assert alarms["rotor-changed"].state.is_active
        # A restart knows what healthy was: it does not take the faulty machine for it.
        again = Service(Box.single(machine_file(broker.url)), tmp_path)
        (detector,) = (d for d in watch_of(again).pipeline.detectors if d.name == "rotor-synchronous")
        before = next(d for d in watch_of(service).pipeline.detectors if d.name == "rotor-synchronous")
        assert detector.watch.state == "watching"
        np.testing.assert_array_equal(detector.watch.calibration.baseline, before.watch.calibration.baseline)
