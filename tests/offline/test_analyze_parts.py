"""The parts of ``daqsvc analyze`` by themselves."""

from __future__ import annotations

import io
import json
import math
import os
import re
import signal
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from support.given_codes import had
from support.orbit_files import AMPLITUDE_UM, RATE_HZ, SPEED_RPM, Orbit

from daqsvc.commands.arguments import SpeedOption, speed
from daqsvc.detectors.rotor_synchronous.recorded import analyse, posterior
from daqsvc.detectors.rotor_synchronous.recorded_speed import RotorSetup
from daqsvc.diagnosis.record import Diagnosis, Severity
from daqsvc.diagnosis.recorded import by_name, finite, worst
from daqsvc.dsp.quality import RefusedError
from daqsvc.dsp.quality import recorded as quality
from daqsvc.dsp.quality.unit import refuse_size
from daqsvc.offline import progress
from daqsvc.offline.progress import ProgressInterval
from daqsvc.offline.runner import Outcome, WorkerLostError, judge_all
from daqsvc.recording.recording import Recording
from daqsvc.rotor.laval import LavalRotor

if TYPE_CHECKING:
    from collections.abc import Callable

ROTOR = LavalRotor(natural_frequency_hz=60.0, damping_ratio=0.1, clearance_um=200.0)
SETUP = RotorSetup(probes=("x", "y"), rotor=ROTOR, speed_rpm=SPEED_RPM)


def recorded(orbit: Orbit) -> Recording:
    return Recording(("x", "y"), np.column_stack([orbit.x, orbit.y]), RATE_HZ, Path("orbit"), nan_count=0)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_analysing_changes_nothing_and_gives_the_same_twice() -> None:
    recording = recorded(Orbit(change=0.8))
    before = recording.samples.copy()
    one, other = (analyse(recording, SETUP).as_json() for _ in range(2))
    assert json.dumps(one) == json.dumps(other)
    assert np.array_equal(recording.samples, before)


def test_the_progress_of_a_long_recording_is_told() -> None:
    told: list[tuple[int, int]] = []
    recording = recorded(Orbit(600))
    analyse(recording, SETUP, lambda done, total: told.append((done, total)))
    assert len(told) > 1
    assert [done for done, _ in told] == sorted({done for done, _ in told})
    assert told[-1] == (len(recording.samples), len(recording.samples))


def test_a_setup_needs_a_speed_from_somewhere() -> None:
    with pytest.raises(ValueError, match="--speed-rpm, or name a keyphasor"):
        RotorSetup(probes=("x", "y"), rotor=ROTOR, speed_rpm=None)


def test_probabilities_are_those_of_the_evidence() -> None:
    odds = posterior({"normal": 0.0, "rub": math.log(3.0), "unmodelled": -math.inf})
    assert odds == pytest.approx({"normal": 0.25, "rub": 0.75, "unmodelled": 0.0})


def test_json_holds_no_nan() -> None:
    told = finite({"a": [1.0, math.nan, np.float64(2.0)], "b": (math.inf, np.int64(3), None, "NaN")})
    assert told == {"a": [1.0, None, 2.0], "b": [None, 3, None, "NaN"]}
    assert type(told["a"][2]) is float


@pytest.mark.parametrize("unit_um", [1e-5, 150.0])
def test_orbits_of_impossible_size_are_refused(unit_um: float) -> None:
    samples = unit_um * AMPLITUDE_UM * np.column_stack([np.cos(np.arange(640)), np.sin(np.arange(640))])
    refuse_size(samples / unit_um, 200.0, "um")
    with pytest.raises(RefusedError, match="the unit 'um' looks wrong"):
        refuse_size(samples, 200.0, "um")


def test_a_coarse_converter_is_not_a_clipped_probe() -> None:
    orbit = Orbit()
    samples = np.round(np.column_stack([orbit.x, orbit.y]) / 5.0) * 5.0
    known = quality.count_bad(("x", "y"), samples)
    assert quality.refuse_stuck(known, ("x", "y"), samples, 64.0) == known
    samples[:, 0] = np.minimum(samples[:, 0], 20.0)
    with pytest.raises(quality.ClippedProbeError, match="x is clipped at 20 um") as refused:
        quality.refuse_stuck(known, ("x", "y"), samples, 64.0)
    assert refused.value.quality.clipped["x"] > 1000


def test_peaks_that_are_cut_off_now_and_then_are_told() -> None:
    orbit = Orbit()
    samples = np.column_stack([orbit.x, np.minimum(orbit.y, np.sort(orbit.y)[-40])])
    known = quality.refuse_stuck(quality.count_bad(("x", "y"), samples), ("x", "y"), samples, 64.0)
    assert known.clipped == {"x": 0, "y": 40}
    assert known.problems[0].startswith("y is clipped now and then: 40 samples are at 2")


def test_complaints_of_one_kind_are_told_once() -> None:
    orbit = Orbit()
    for revolution in range(55, 100, 5):
        orbit.x[revolution * 64 : revolution * 64 + 40] = np.nan
        orbit.x[revolution * 64 + 64 : revolution * 64 + 64 + min(60, revolution - 20)] = np.nan
    told = analyse(recorded(orbit), SETUP)
    assert told.refused is None
    assert len(told.quality.problems) == 1
    assert re.search(r"^x: \d+ of 64 samples.*times more\)$", told.quality.problems[0])


def test_a_mean_within_the_noise_is_no_mean() -> None:
    orbit = Orbit()
    samples = np.column_stack([orbit.x, orbit.y])
    assert not quality.lacks_mean(samples)
    assert quality.lacks_mean(samples - samples.mean(axis=0))


@pytest.mark.parametrize(
    ("text", "option"),
    [
        ("5000", SpeedOption(5000.0, step_rpm=1.0)),
        ("-12.50", SpeedOption(-12.5, step_rpm=0.01)),
        ("6e3", SpeedOption(6000.0, step_rpm=1000.0)),
        ("orbit:60", SpeedOption(60.0, orbit=True, step_rpm=1.0)),
    ],
)
def test_speeds_are_read(text: str, option: SpeedOption) -> None:
    assert speed(text) == option


def test_a_bar_is_shown_to_a_person_who_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    monkeypatch.setitem(progress.__dict__, "_RichBar", _without_rich)
    terminal, pipe = Terminal(), io.StringIO()
    bars = [ProgressInterval("file", terminal), ProgressInterval("file", pipe)]
    for bar in bars:
        bar.update(1, 4)
    assert terminal.getvalue() == ""
    now = progress.PATIENCE_S + 0.1
    for bar in bars:
        bar.update(2, 4)
    assert re.search(r"file \[#{20}\.{20}\] 50 %", terminal.getvalue())
    for bar in bars:
        bar.close()
    assert terminal.getvalue().endswith("\r")
    assert pipe.getvalue() == ""


def _without_rich(_label: str, _stream: io.StringIO) -> None:
    raise ModuleNotFoundError("rich")


def test_the_bar_of_rich_is_taken_where_there_is_one() -> None:
    pytest.importorskip("rich")
    terminal = Terminal()
    bar = ProgressInterval("recordings", terminal, patience_s=0.0)
    bar.update(1, 2)
    bar.close()
    assert "recordings" in terminal.getvalue()


@dataclass(frozen=True)
class Sleepless:
    """Judges nothing, and dies of one recording."""

    deadly: str

    def judge(
        self, recording: str, figures: str | None, progress: Callable[[int, int], None] | None = None
    ) -> Outcome:
        if recording == self.deadly:
            os.kill(os.getpid(), signal.SIGKILL)
        return Outcome(
            {"recording": recording, "figures": figures, "pid": os.getpid()}, recording, refused=False
        )


def test_recordings_go_to_processes_and_come_back_in_order() -> None:
    names = [f"{i}" for i in range(12)]
    told = list(judge_all(Sleepless("none"), names, [None] * 12, processes=2))
    assert [one.text for one in told] == names
    assert os.getpid() not in {one.json["pid"] for one in told}
    (alone,) = judge_all(Sleepless("none"), ["a"], ["b"], processes=1)
    assert alone.json == {"recording": "a", "figures": "b", "pid": os.getpid()}


def test_a_process_that_is_killed_is_told() -> None:
    with pytest.raises(WorkerLostError, match="fewer --jobs") as lost:
        list(judge_all(Sleepless("1"), ["0", "1", "2"], [None] * 3, processes=2))
    assert lost.value.code.id == "C25"
    had("C25", lost.value)


def test_each_sensor_of_a_level_detector_has_a_statement_of_its_own_and_the_worst_is_told() -> None:
    def said(sensor: str, first_index: int, severity: Severity) -> Diagnosis:
        return Diagnosis(
            machine="m",
            detector=f"levels/{sensor}",
            t_ns=0,
            stream="shaft",
            first_index=first_index,
            end_index=first_index + 100,
            decision=severity,
            severity=severity,
            statistics={"rms": 1.0},
        )

    diagnoses = [
        *(said("probe-x", 0, "normal"), said("probe-y", 0, "normal")),
        *(said("probe-x", 100, "danger"), said("probe-y", 100, "normal")),
        *(said("probe-x", 200, "alert"), said("probe-y", 200, "alert")),
    ]
    found = by_name("levels/shaft", diagnoses, 100.0)
    assert [one.detector for one in found] == ["levels/probe-x", "levels/probe-y"]
    assert [one.as_json()["severity"] for one in found] == ["alert", "alert"]
    assert found[0].as_json()["worst"]["severity"] == "danger"
    assert found[0].as_json()["worst"]["onset_sample"] == 100
    assert found[0].describe().startswith("levels/probe-x: alert (alert, danger at 1.000 s); rms 1")
    assert worst(found) == "levels/probe-x, danger from 1.000 s on"
    assert worst(by_name("levels/shaft", diagnoses[:2], 100.0)) == ""
    (silent,) = by_name("levels/shaft", [], 100.0)
    assert silent.as_json()["worst"] is None


def test_complaints_that_differ_in_figures_only_are_one_with_a_count() -> None:
    reasons = [f"kph: no pulse for {n} revolutions at {3000 - n} rpm" for n in range(8, 43)]
    first, other = quality.complaints(
        [*reasons[:20], "x: gap of 4.5e-05 s", *reasons[20:], "x: gap of -0.1 s"]
    )
    assert first.describe() == "kph: no pulse for 8 revolutions at 2992 rpm (and 34 times more)"
    assert other.describe() == "x: gap of 4.5e-05 s (and 1 time more)"


def test_the_figure_shows_where_the_test_holds_a_changed_machine_against_itself() -> None:
    from daqsvc.detectors.rotor_synchronous.plots import _innovations, _new_references, _Subject

    orbit = Orbit(300, change=0.8)
    analysis = analyse(recorded(orbit), SETUP)
    assert analysis.trace is not None
    assert analysis.calibration is not None
    subject = _Subject(
        name="orbit",
        probes=("x", "y"),
        analysis=analysis,
        trace=analysis.trace,
        calibration=analysis.calibration,
        xy=np.column_stack([orbit.x, orbit.y]),
        rate_hz=RATE_HZ,
        clearance_um=None,
    )
    ((first, last),) = _new_references(subject)
    assert 81 + 8 < first < 81 + 60
    assert last == 300
    _, lower = _innovations(subject).axes
    assert "compared with the changed machine" in lower.get_legend_handles_labels()[1]
    healthy = analyse(recorded(Orbit(120)), SETUP)
    assert _new_references(replace(subject, analysis=healthy, trace=healthy.trace)) == []
