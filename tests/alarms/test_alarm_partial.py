"""Alarms on levels of windows that lack samples: they may be raised, and are never cleared."""

from __future__ import annotations

import numpy as np
import pytest
from support.alarm_rig import AlarmRig, kinds
from support.gapped_signals import RATE_HZ, lost, loud_above, machine

from daqsvc.alarms.manager import LevelRule
from daqsvc.alarms.quality import LASTING
from daqsvc.alarms.setpoints import Setpoint
from daqsvc.alarms.voting import VotingRule
from daqsvc.detectors.levels.detector import GapCheck, LevelChannel, LevelDetector
from daqsvc.detectors.levels.statements import Limits
from daqsvc.diagnosis.detector import Window
from daqsvc.dsp.quality.missing import MOST_MISSING

WINDOW = 1000
SECOND_NS = 1_000_000_000
GAP = GapCheck(0.2, -10.0, -18.0, -2.0)
PROBE = {"unit": "um", "gap": GAP}
ACCELEROMETER = {"unit": "m/s2", "gap": None}


class Watched:
    """A sensor with one alarm, from samples to events; the statements are kept."""

    def __init__(self, measure, channel, setpoint):
        names = ("alert", "danger", "alert_low", "danger_low")
        limits = [Limits(measure, *(getattr(setpoint, name) for name in names))]
        self.detector = LevelDetector(
            "rig", "s", RATE_HZ, [LevelChannel("a", 0, limits=limits, **channel)], window_s=WINDOW / RATE_HZ
        )
        self.rig = AlarmRig(LevelRule("high", "a", measure, setpoint))
        self.said = []
        self.taken = 0

    def take(self, samples, skipped=0):
        self.taken += skipped + len(samples)
        self.rig.clock.advance((skipped + len(samples)) / RATE_HZ)
        period_ns = SECOND_NS / RATE_HZ
        first = self.taken - len(samples)
        column = samples.astype(np.float32).reshape(-1, 1)
        window = Window(first, column, self.rig.clock.t_ns, period_ns, skipped)
        events = []
        for diagnosis in self.detector.process(window):
            self.said.append(diagnosis)
            events += self.rig.told(self.rig.manager.take(diagnosis))
        return kinds(events)


def knocking(rng, count):
    """A quiet machine with knocks: its crest factor is high."""
    samples = 0.2 * machine(rng, count)
    samples[::250] += 8.0
    return samples


def much_lost(rng, samples, share, frame):
    """As `lost`, but never as few as count for none."""
    while np.isnan(gapped := lost(rng, samples, share, frame)).mean() <= MOST_MISSING:
        pass
    return gapped


MEASURES = {
    "rms": (ACCELEROMETER, Setpoint(alert=1.0), lambda rng, n: 3.0 * machine(rng, n), machine, 0.3),
    "peak": (ACCELEROMETER, Setpoint(alert=4.0), lambda rng, n: 3.0 * machine(rng, n), machine, 0.3),
    "crest_factor": (ACCELEROMETER, Setpoint(alert=6.0), knocking, machine, 1.0),
    "velocity_rms": (ACCELEROMETER, Setpoint(alert=4.0), lambda rng, n: 3.0 * machine(rng, n), machine, 0.3),
    "gap_voltage": (
        PROBE,
        Setpoint(alert=-8.0, alert_low=-12.0),
        lambda rng, n: machine(rng, n) - 15.0,
        machine,
        1.0,
    ),
}


@pytest.mark.parametrize("frame", [1, 20])
@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("measure", MEASURES)
def test_an_alert_stands_while_samples_are_missing_whatever_the_others_show(measure, share, frame):
    channel, setpoint, loud, quiet, scale = MEASURES[measure]
    rng = np.random.default_rng(5)
    watched = Watched(measure, channel, setpoint)
    assert ("high", "raised") in watched.take(loud(rng, WINDOW))
    for signal in (loud, lambda rng, n: scale * quiet(rng, n)):
        events = []
        for _ in range(40):
            events += watched.take(much_lost(rng, signal(rng, WINDOW), share, frame))
        assert {said.quality for said in watched.said[1:]} == {"missing"}
        assert {said.decision for said in watched.said} == {"alert"}
        assert events == ([("sensor-ok/a", "raised")] if signal is loud else [])
    assert watched.take(scale * quiet(rng, WINDOW))[-1] == ("high", "returned")


@pytest.mark.parametrize("measure", ["rms", "peak", "velocity_rms"])
def test_what_is_loud_for_sure_raises_its_alarm(measure):
    rng = np.random.default_rng(6)
    channel, setpoint, loud, quiet, scale = MEASURES[measure]
    watched = Watched(measure, channel, setpoint)
    assert not watched.take(scale * quiet(rng, WINDOW))
    louder = lost(rng, 3.0 * loud(rng, WINDOW), 0.3, 1)
    assert watched.take(louder) == [("high", "raised")]
    (event,) = watched.rig.events
    assert f"{measure} of a is at least " in event.message
    assert "% of its samples are missing, alert limit" in event.message
    value, (low, _) = watched.said[-1].statistics[measure], watched.said[-1].bounds[measure]
    assert setpoint.alert <= low < value


def test_a_gap_voltage_that_is_too_low_for_sure_raises_its_alarm():
    rng = np.random.default_rng(6)
    channel, setpoint, loud, quiet, _ = MEASURES["gap_voltage"]
    watched = Watched("gap_voltage", channel, setpoint)
    assert not watched.take(quiet(rng, WINDOW))
    assert watched.take(lost(rng, loud(rng, WINDOW), 0.3, 1)) == [("high", "raised")]
    assert "gap_voltage of a is at most -1" in watched.rig.events[-1].message
    assert watched.rig.events[-1].finding == "low"


@pytest.mark.parametrize("measure", ["rms", "crest_factor", "velocity_rms"])
def test_what_may_be_an_artefact_of_the_gaps_raises_nothing(measure):
    rng = np.random.default_rng(7)
    # The velocity of a loud bearing, filled in, would be ten times that of the shaft; nor is it known.
    setpoint = Setpoint(alert={"rms": 0.9, "crest_factor": 4.0, "velocity_rms": 1.0}[measure])
    watched = Watched(measure, ACCELEROMETER, setpoint)
    for share in (0.02, 0.1, 0.3, 0.5):
        for _ in range(20):
            signal = loud_above(rng, WINDOW) if measure == "velocity_rms" else machine(rng, WINDOW)
            scale = 0.8 / signal.std() if measure == "rms" else 1.0
            events = watched.take(lost(rng, scale * signal, share, 1))
            assert [e for e in events if e[0] == "high"] == []


def test_no_delay_goes_on_while_it_cannot_be_known():
    rng = np.random.default_rng(8)
    second = int(RATE_HZ)
    delays = {"on_delay_ns": 2 * SECOND_NS, "off_delay_ns": 2 * SECOND_NS}
    watched = Watched("rms", ACCELEROMETER, Setpoint(alert=1.0, **delays))
    loud, quiet = (lambda n: 3.0 * machine(rng, n)), (lambda n: 0.3 * machine(rng, n))
    assert not watched.take(loud(second))
    for _ in range(10):  # loud by what is there, but not for sure
        unsure = 1.1 * machine(rng, WINDOW) / machine(rng, WINDOW).std()
        assert ("high", "raised") not in watched.take(lost(rng, unsure, 0.4, 1))
    assert ("high", "raised") in watched.take(loud(3 * second))
    assert ("high", "returned") not in watched.take(quiet(second))
    for _ in range(10):
        assert ("high", "returned") not in watched.take(lost(rng, quiet(WINDOW), 0.3, 1))
    assert ("high", "returned") in watched.take(quiet(4 * second))


def test_a_frame_lost_now_and_then_makes_no_quality_alarm_and_many_make_one():
    rng = np.random.default_rng(9)
    watched = Watched("rms", ACCELEROMETER, Setpoint(alert=5.0))
    events = []
    for k in range(60):
        events += watched.take(lost(rng, machine(rng, WINDOW), 0.3 if k % 3 == 0 else 0.0, 1))
    assert events == []
    for _ in range(LASTING):
        events += watched.take(lost(rng, machine(rng, WINDOW), 0.3, 1))
    assert events == [("sensor-ok/a", "raised")]
    for _ in range(2):  # and good windows among them do not return it
        events += watched.take(machine(rng, WINDOW))
        events += watched.take(lost(rng, machine(rng, WINDOW), 0.3, 1))
    assert events == [("sensor-ok/a", "raised")]
    for _ in range(LASTING):
        events += watched.take(machine(rng, WINDOW))
    assert events == [("sensor-ok/a", "raised"), ("sensor-ok/a", "returned")]
    assert "samples of a are missing: its levels are estimates" in watched.rig.events[0].message


def test_a_sensor_that_was_not_ok_is_believed_again_by_what_is_there():
    rng = np.random.default_rng(10)
    watched = Watched("rms", PROBE, Setpoint(alert=5.0))
    assert ("high", "suppressed") in watched.take(machine(rng, WINDOW) - 60.0)
    assert watched.take(np.full(WINDOW, np.nan)) == [("sensor-ok/a", "changed")]
    assert ("high", "unsuppressed") in watched.take(lost(rng, machine(rng, WINDOW), 0.3, 1))


def uncertain(value, low, high, share=0.3):
    return {
        "statistics": {"rms": value},
        "bounds": {"rms": (low, high)},
        "missing_share": share,
        "quality": "missing",
        "decision": "normal",
    }


def test_a_sensor_that_lacks_samples_votes_for_what_is_sure_and_never_against():
    rule = VotingRule("high", ("a", "b", "c"), 2, "rms", Setpoint(alert=40.0, danger=60.0))
    rig = AlarmRig(rule)
    take = lambda sensor, *bounds: rig.take(  # noqa: E731
        detector=f"levels/{sensor}", sensors=(sensor,), **uncertain(*bounds)
    )
    for sensor in "abc":
        rig.rms(10.0, sensor=sensor)
    assert rig.rms(50.0, sensor="a") == []
    assert take("b", 45.0, 38.0, 90.0) == []  # perhaps
    assert kinds(take("b", 55.0, 45.0, 90.0)) == [("high", "raised")]
    assert rig.status("high").level.label == "alert"
    assert take("b", 10.0, 8.0, 90.0) == []
    assert rig.rms(10.0, sensor="c") == []  # b may still be beyond the limit
    assert kinds(rig.rms(10.0, sensor="b")) == [("high", "returned")]


def test_no_delay_goes_on_over_samples_that_nobody_looked_at():
    rng = np.random.default_rng(11)
    watched = Watched("rms", ACCELEROMETER, Setpoint(alert=1.0, off_delay_ns=4 * SECOND_NS))
    assert ("high", "raised") in watched.take(3.0 * machine(rng, WINDOW))
    for _ in range(4):
        assert watched.take(0.3 * machine(rng, WINDOW), skipped=int(5 * RATE_HZ)) == []
    skipped = watched.said[-2]
    assert (skipped.decision, skipped.missing_share) == ("normal", 1.0)
    assert "10,000 samples of a were not judged" in skipped.reason
    assert ("high", "returned") in watched.take(0.3 * machine(rng, 9 * WINDOW))
