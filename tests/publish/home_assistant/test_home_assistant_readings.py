"""Which figures Home Assistant is told when: few, rounded, and at once what matters."""

from __future__ import annotations

import gc
import json
from dataclasses import replace

import numpy as np
import pytest

from daqsvc.acquisition.clock import NS_PER_S, DrivenClock
from daqsvc.diagnosis.reading import Reading
from daqsvc.diagnosis.record import Diagnosis
from daqsvc.publish.home_assistant.left_over import FILE, LeftOver
from daqsvc.publish.home_assistant.readings import Readings
from daqsvc.publish.home_assistant.settings import HomeAssistant
from daqsvc.publish.output import Watched
from daqsvc.publish.topics import Topics

WATCHED = Watched(
    "rig",
    findings=("rotor-bank",),
    readings=(
        Reading("levels/probe-x", "statistics", "rms", "um"),
        Reading("rotor-bank", "statistics", "speed", "rpm"),
        Reading("rotor-bank", "probabilities", "F1"),
    ),
)
LEVEL = Diagnosis("rig", "levels/probe-x", 0, "shaft", 0, 320, "normal", statistics={"rms": 41.23456789})
BANK = Diagnosis(
    "rig",
    "rotor-bank",
    0,
    "shaft",
    0,
    320,
    "N",
    statistics={"speed": 600.0},
    probabilities={"F1": 0.01234567},
)


class Told:
    """What goes out while diagnoses come at a rate."""

    def __init__(self):
        self.clock = DrivenClock()
        self.readings = Readings(HomeAssistant(), WATCHED, Topics("daqsvc", "lab", "edge-1"), self.clock)
        self.messages = []

    def say(self, *diagnoses, for_s=1.0, rate_hz=2.0):
        """Have the same said for a while; the messages that went out."""
        before = len(self.messages)
        for _ in range(round(for_s * rate_hz)):
            for diagnosis in diagnoses:
                self.readings.note(diagnosis)
            due = self.readings.due()
            self.messages += [(topic, json.loads(payload)) for topic, payload in due]
            self.clock.advance_to(self.clock.monotonic_ns() + round(NS_PER_S / rate_hz))
        return [payload for _, payload in self.messages[before:]]


def test_a_healthy_machine_is_told_once_a_minute_and_rounded():
    told = Told()
    rng = np.random.default_rng(3)
    for _ in range(600):
        noisy = replace(LEVEL, statistics={"rms": 41.2 * (1 + 0.02 * rng.standard_normal())})
        told.say(noisy, BANK, for_s=1.0)
    # Ten minutes, two detectors, with figures twice a second: 2,400 statements.
    assert len(told.messages) == 2 * 10
    assert {topic for topic, _ in told.messages} == {
        "daqsvc/lab/edge-1/rig/readings/levels/probe-x",
        "daqsvc/lab/edge-1/rig/readings/rotor-bank",
    }
    for _, payload in told.messages:
        for figures in (payload["statistics"], payload["probabilities"]):
            assert all(value == round(value, 3) for value in figures.values())


def test_what_moves_beyond_the_deadband_is_told_before_but_not_more_often_than_every_ten_seconds():
    told = Told()
    assert [p["statistics"]["rms"] for p in told.say(LEVEL)] == [41.2]
    assert told.say(replace(LEVEL, statistics={"rms": 44.0}), for_s=20) == []
    up = replace(LEVEL, statistics={"rms": 55.0})
    assert [p["statistics"]["rms"] for p in told.say(up, for_s=5)] == [55.0]
    swinging = [replace(LEVEL, statistics={"rms": rms}) for rms in (20.0, 80.0)]
    heard = [payload for k in range(60) for payload in told.say(swinging[k % 2])]
    assert 4 <= len(heard) <= 6


def test_a_finding_is_told_at_once_with_all_that_it_may_be():
    told = Told()
    assert [p["finding"] for p in told.say(BANK)] == ["N"]
    found = replace(BANK, decision="U2", group=("U2", "D1"), severity="alert")
    assert [p["finding"] for p in told.say(found)] == ["U2 or D1"]
    bearing = replace(BANK, decision="inner", where="drive-end", severity="alert")
    assert [p["finding"] for p in told.say(bearing)] == ["inner at drive-end"]


def test_without_good_data_nothing_is_said_to_be_known():
    told = Told()
    assert len(told.say(LEVEL, BANK, for_s=15)) == 2
    silent = [replace(d, quality="missing", statistics={}, probabilities={}) for d in (LEVEL, BANK)]
    level, bank = sorted(told.say(*silent), key=lambda payload: payload["detector"])
    assert level["statistics"] == {"rms": None}
    assert (bank["finding"], bank["probabilities"]) == (None, {"F1": None})
    # A stream that comes and goes with every window is not told with every window.
    flapping = [payload for k in range(60) for payload in told.say(LEVEL if k % 2 else silent[0])]
    assert len(flapping) <= 6


def test_everything_is_told_anew_to_whoever_has_just_started():
    told = Told()
    told.say(LEVEL, BANK)
    assert told.say(LEVEL, BANK) == []
    told.readings.forget()
    assert len(told.say(LEVEL, BANK)) == 2


def test_a_detector_that_nobody_shows_costs_nothing():
    told = Told()
    assert told.say(replace(LEVEL, detector="levels/other")) == []


@pytest.mark.parametrize("content", [None, b"", b"{", b"[]", b'{"topics": 7}', b"[" * 70_000, b"\xff"])
def test_what_was_told_is_remembered_whatever_became_of_the_file(tmp_path, content):
    # What other tests have left is not to be finalised where a nested file leaves no depth for it.
    gc.collect()
    if content is not None:
        (tmp_path / FILE).write_bytes(content)
    LeftOver(tmp_path, ["a", "b"]).remember()
    assert LeftOver(tmp_path, ["b", "c"]).left_over() == ["a"]
    assert LeftOver(tmp_path, []).left_over() == ["a", "b"]
    LeftOver(tmp_path, ["b"]).remember(["a"])
    assert LeftOver(tmp_path, []).left_over() == ["a", "b"]


def test_a_disk_that_takes_nothing_is_said_and_stops_nothing(tmp_path, caplog):
    LeftOver(tmp_path / "gone", ["a"]).remember()
    assert "cannot be written" in caplog.text
