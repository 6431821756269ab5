"""Machine files whose sensors come over several buses: what is refused, and where the detectors look."""

from __future__ import annotations

import pytest
from support.machine_files import LAVAL, MACHINES, changed, only_problem, parsed

from daqsvc.acquisition.clock import SystemClock
from daqsvc.detectors.make import detectors
from daqsvc.diagnosis.snapshots import alignment
from daqsvc.settings import describe, load_machine_file, parse_machine_file

TWO_BUSES = MACHINES / "rotor-two-buses.toml"
TABLE = TWO_BUSES.read_text(encoding="utf-8").partition("[pipeline.alignment]")[2].partition("\n[")[0]


def test_sensors_of_two_streams_need_the_alignment_table() -> None:
    problem, _ = only_problem(TWO_BUSES, (f"[pipeline.alignment]{TABLE}\n", ""))
    assert problem.key == "pipeline.rotor_synchronous.probes[0]"
    assert problem.message == 'is in stream "shaft-x", but keyphasor "keyphasor" is in stream "shaft-y"'
    assert "[pipeline.alignment]" in problem.remedy


def test_an_alignment_of_one_stream_is_of_no_effect() -> None:
    text, line = changed(LAVAL, ("[pipeline.rotor_bank]", "[pipeline.alignment]\n\n[pipeline.rotor_bank]"))
    machine = parse_machine_file(text, LAVAL)
    (warning,) = [w for w in machine.warnings if w.key == "pipeline.alignment"]
    assert warning.line == line
    assert "has no effect" in warning.message
    assert alignment(machine, SystemClock(), print).aligners == ()


def test_an_error_that_is_a_fault_s_worth_of_phase_is_warned_of() -> None:
    (warning,) = [
        w
        for w in parsed(TWO_BUSES, ("max_error_us = 200.0", "max_error_us = 2000.0")).warnings
        if "max_error_us" in w.key
    ]
    assert "2000 us are 18 deg of a revolution at 1500 rpm" in warning.message
    assert warning.remedy.startswith("write max_error_us = 1110 or less")


def test_a_revolution_needs_samples_in_every_stream() -> None:
    problem, _ = only_problem(TWO_BUSES, ("rate_hz = 2000.0", "rate_hz = 250.0"))
    assert problem.key == "pipeline.rotor_synchronous.probes"
    assert "are sampled 10 times a revolution (250 Hz at 1500 rpm)" in problem.message


def test_the_keyphasor_s_stream_is_the_grid_and_detectors_find_their_columns() -> None:
    machine = load_machine_file(TWO_BUSES)
    (grid,) = machine.grids
    assert grid.name == "shaft-y+shaft-x"
    assert grid.rate_hz == 1600.0
    assert grid.channel_names == ("shaft-y.y", "shaft-y.kph", "shaft-x.x")
    assert [grid.column(machine.sensor(name)) for name in ("probe-x", "probe-y", "keyphasor")] == [2, 0, 1]
    (detector,) = (d for d in detectors(machine) if d.name == "rotor-synchronous")
    assert detector.stream == grid.name
    # The levels of each probe are taken where it is sampled.
    levels = {d.stream for d in detectors(machine) if d.name.startswith("levels/")}
    assert levels == {"shaft-x", "shaft-y"}
    assert "shaft-x on the samples of shaft-y" in describe(machine)


def test_a_grid_is_made_as_the_file_says() -> None:
    text, _ = changed(
        TWO_BUSES,
        ("max_error_us = 200.0", "max_error_us = 150.0"),
        ("max_wait_ms = 1000.0", "max_wait_ms = 300.0"),
        ("rate_hz = 2000.0\nlatency_ms = 0.0", "rate_hz = 2000.0\nlatency_ms = 1.5"),
    )
    (aligner,) = alignment(parse_machine_file(text, TWO_BUSES), SystemClock(), print).aligners
    assert [source.stream for source in aligner.sources] == ["shaft-y", "shaft-x"]
    assert [source.latency_ns for source in aligner.sources] == [0, 1_500_000]
    assert aligner.channels == ("shaft-y.y", "shaft-y.kph", "shaft-x.x")


@pytest.mark.parametrize("value", ["-1.0", "0.0"])
def test_an_error_of_nothing_is_refused(value) -> None:
    problem, _ = only_problem(TWO_BUSES, ("max_error_us = 200.0", f"max_error_us = {value}"))
    assert problem.key == "pipeline.alignment.max_error_us"
