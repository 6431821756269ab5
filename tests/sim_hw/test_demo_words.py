"""What the demo shows: times that go forward, and where lost frames come from."""

from __future__ import annotations

import io
import re

import numpy as np
from rich.console import Console
from support.machine_files import MACHINES

from sim_hw.demo.session import Received, Script, _not_sent
from sim_hw.demo.view import View
from sim_hw.scenario import load_scenario

BAD_BUS = MACHINES.parent / "scenarios" / "bad-bus.toml"


def script(**more):
    return Script("a rig", lambda _: None, "shaft", np.zeros((19_200, 3)), 640.0, **more)


def shown(act, speed=1.0):
    """What a view without a terminal prints."""
    console = Console(file=io.StringIO(), width=200, force_terminal=False)
    act(View(script(), speed, console))
    return console.file.getvalue()


def alarm(name, shown_by_s):
    payload = {"level": "alert", "kind": "raised", "message": name, "monotonic_ns": round(1e9 * shown_by_s)}
    return Received("alarm", "", payload | {"cause": {"monotonic_ns": round(1e9 * shown_by_s)}})


def test_alarms_are_shown_with_times_that_go_forward():
    def act(view):
        window = {"end_index": 640}
        view.on_message(
            Received("diagnosis", "", {"detector": "levels/x", "monotonic_ns": 10**9, "window": window})
        )
        for name, shown_by_s in (("long window", 16.5), ("revolution", 16.12), ("later", 17.0)):
            view.on_message(alarm(name, shown_by_s))

    times_s = [float(at) for at in re.findall(r"^ *(\d+\.\d+) s", shown(act), re.MULTILINE)]
    assert times_s == [16.5, 16.5, 17.0]


def test_frames_that_were_never_sent_are_told_from_those_that_the_link_lost():
    faults = load_scenario(BAD_BUS).node_faults(0)
    not_sent = _not_sent(script(faults=faults))
    assert not_sent == ["2 s of silence", "2 s of brown-out"]
    assert _not_sent(script()) == []
    summary = {
        "onsets": [],
        "samples": {
            "sent": 9,
            "received": 9,
            "lost": 0,
            "skipped": 0,
            "left_over": 0,
            "skipped_by_detectors": 0,
        },
        "frames": {"injected": {"dropped": 33}, "counted": {"dropped": 889}, "not_sent": not_sent},
        "loop_lag_ms": {"p50": 0.0, "p99": 0.0, "max": 0.0},
        "alarm_events": 0,
        "messages": 0,
        "simulated_s": 1.0,
        "real_s": 1.0,
        "complete": True,
    }
    text = shown(lambda view: view.show_summary(summary))
    assert (
        "856 of the frames counted as dropped were never on the bus: the scenario has 2 s of silence and"
        in text
    )
    assert "through the broker; 1.0 s played in 1.0 s, without the start\n" in text
    assert "this computer is too slow" not in text
    slow = shown(lambda view: view.show_summary(summary), speed=20.0)
    assert "That is 1 times the speed of the machine, and not 20 times: this computer is too slow" in slow
    summary["frames"]["not_sent"], summary["samples"]["left_over"] = [], 1
    assert "1 sample was not sent: it fills no frame\n" in shown(lambda view: view.show_summary(summary))
    assert "never on the bus" not in shown(lambda view: view.show_summary(summary))
