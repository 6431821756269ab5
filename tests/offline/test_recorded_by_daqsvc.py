"""What ``daqsvc record`` and the recorder write, `analyze`, `calibrate`, `export`, `demo` and `sim` read."""

from __future__ import annotations

import argparse
import json
import re
import time
from datetime import datetime

import can
import numpy as np
import pytest
from support.orbit_files import RATE_HZ, SPEED_RPM, UNBALANCE, Orbit
from support.paths import ROOT
from support.snapshot_files import Sampled, write_snapshot

from daqsvc.cli import main
from daqsvc.recording.recording import load_all
from daqsvc.recording.streams import iso_ns
from daqsvc.settings import load_machine_file
from drivers.can.plugin import frame_layout
from sim_hw.demo.command import DemoCommand, script_of
from sim_hw.sim_command import SimCommand, _script

pytestmark = pytest.mark.integration
EPOCH_S = 1_795_445_911.125
ENDINGS = [".blf", ".asc", ".log", ".mcap"]
SENSORS = ("probe-x", "probe-y", "keyphasor")


@pytest.fixture
def _elsewhere(ending, monkeypatch):
    """Where it is not UTC, for the logs whose begin has no zone."""
    if ending == ".asc":
        monkeypatch.setenv("TZ", "Asia/Kolkata")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.fixture
def machine(tmp_path):
    """An example machine that turns as the orbits do."""
    text = (ROOT / "config" / "machines" / "rotor-synchronous.toml").read_text()
    values = {"speed_rpm": SPEED_RPM, "natural_frequency_hz": 60.0, "clearance_um": 200.0}
    for key, value in values.items():
        text = re.sub(rf"^{key} = [\d.]+", f"{key} = {value}", text, flags=re.MULTILINE)
    path = tmp_path / "machine.toml"
    path.write_text(re.sub(r"^rate_hz = 1600.0", f"rate_hz = {RATE_HZ}", text, flags=re.MULTILINE))
    return path


@pytest.fixture(params=ENDINGS)
def ending(request):
    return request.param


@pytest.fixture
def recorded(ending, machine, tmp_path):
    """A recording of each kind, and its samples as they were sent."""
    return write_recording(tmp_path / f"run{ending}", machine, Orbit(change=UNBALANCE))


def write_recording(path, machine, orbit):
    samples = np.column_stack([orbit.x, orbit.y, orbit.keyphasor])
    layout = frame_layout(load_machine_file(machine), "shaft")
    n = layout.samples_per_frame
    blocks = samples[: len(samples) // n * n].reshape(-1, n, 3).astype(np.float32)
    payloads = layout.encode(np.arange(len(blocks)) * n % 2**16, blocks)
    sent = layout.decode(payloads).samples.reshape(-1, 3)
    if path.suffix == ".mcap":
        units = dict(zip(SENSORS, ("um", "um", "V"), strict=True))
        start_ns = round(EPOCH_S * 1000) * 1_000_000
        return write_snapshot(path, {"shaft": Sampled(RATE_HZ, units, sent)}, start_ns), sent
    with can.Logger(path) as logger:
        for number, payload in enumerate(payloads):
            logger.on_message_received(
                can.Message(
                    timestamp=EPOCH_S + number * n / RATE_HZ,
                    arbitration_id=layout.frame_id,
                    is_extended_id=False,
                    is_fd=True,
                    channel="can0" if path.suffix == ".log" else 0,
                    data=payload.tobytes(),
                )
            )
    return path, sent


def save_table(path, samples):
    np.savez(path, **dict(zip(SENSORS, samples.T.astype(float), strict=True)), fs=RATE_HZ)
    return path


def test_analyze_judges_it_as_its_samples(analyze, machine, recorded, tmp_path):
    source, sent = recorded
    table = save_table(tmp_path / "table.npz", sent)
    code, (found, expected), err = analyze(machine, source, table, "--jobs", 1)
    assert (code, err) == (0, "")
    assert expected["verdict"] == "unbalance"
    assert {**found, "recording": ""} == {**expected, "recording": ""}


def test_a_snapshot_is_judged_by_its_slower_streams_where_the_verdict_rests_on_them(
    analyze, machine, tmp_path
):
    orbit = Orbit(change=UNBALANCE)
    samples = np.column_stack([orbit.x, orbit.y, orbit.keyphasor]).astype(np.float32)
    streams = {
        "housing": Sampled(2 * RATE_HZ, {"casing": "m/s2"}, np.zeros((2 * len(samples), 1))),
        "shaft": Sampled(RATE_HZ, dict(zip(SENSORS, ("um", "um", "V"), strict=True)), samples),
    }
    source = write_snapshot(tmp_path / "run.mcap", streams, round(EPOCH_S * 1e9))
    table = save_table(tmp_path / "table.npz", samples)
    code, (found, expected), err = analyze(machine, source, table, "--jobs", 1)
    assert (code, err) == (0, "")
    [problem] = found["data_quality"].pop("problems")
    assert problem.startswith(f"casing left out: sampled at {2 * RATE_HZ:g} Hz, and the slower streams are")
    assert expected["data_quality"].pop("problems") == []
    assert {**found, "recording": ""} == {**expected, "recording": ""}


def test_calibrate_learns_from_it_as_from_its_samples(verb, machine, ending, tmp_path):
    source, sent = write_recording(tmp_path / f"run{ending}", machine, Orbit())
    table = save_table(tmp_path / "table.npz", sent)
    learnt = [verb("calibrate", machine, path) for path in (source, table)]
    assert [code for code, _, _ in learnt] == [0, 0]
    of_log, of_table = ({**found, "written": ""} for _, (found,), _ in learnt)
    assert json.dumps(of_log).replace(source.name, table.name) == json.dumps(of_table)


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".parquet", ".mf4"])
@pytest.mark.usefixtures("_elsewhere")
def test_export_writes_its_samples_and_its_begin(machine, recorded, tmp_path, suffix):
    source, sent = recorded
    target = tmp_path / f"out{suffix}"
    assert main(["export", str(machine), str(source), "--to", str(target)]) == 0
    (stream,), notes = load_all(target)
    assert notes == []
    assert (stream.names, stream.units) == (SENSORS, ("um", "um", "V"))
    assert np.array_equal(stream.samples.astype(np.float32), sent)
    # The last sample of a frame is taken when it is sent, so the first of all is a frame older; ASC has ms.
    begin_s = EPOCH_S
    if source.suffix == ".asc":  # written in the local time of whoever writes it, and taken for UTC
        begin_s += datetime.fromtimestamp(EPOCH_S).astimezone().utcoffset().total_seconds()
    assert stream.start_ns == pytest.approx(begin_s * 1e9, abs=8e6), iso_ns(stream.start_ns)


def test_the_demo_plays_it(machine, recorded):
    parser = argparse.ArgumentParser()
    DemoCommand().add_arguments(parser)
    options = ["--recording", str(recorded[0]), "--unit", "um"]
    if recorded[0].suffix != ".mcap":
        options += ["--machine", str(machine)]
    script = script_of(parser.parse_args(options))
    assert script.rate_hz == RATE_HZ
    assert np.array_equal(script.samples.astype(np.float32), recorded[1])


def test_the_simulator_plays_it(machine, recorded):
    parser = argparse.ArgumentParser()
    SimCommand().add_arguments(parser)
    _, signals, _, _ = _script(parser.parse_args([str(machine), "--recording", str(recorded[0])]))
    played = signals._recording
    assert played.names == SENSORS
    assert np.array_equal(played.samples.astype(np.float32), recorded[1])


def test_the_demo_needs_the_machine_file_of_a_log(tmp_path, capsys):
    log = tmp_path / "run.log"
    log.write_text("(1.0) can0 123#00\n")
    assert main(["demo", "--recording", str(log)]) == 1
    err = capsys.readouterr().err
    assert "only the layouts of a machine file make sense of: name that with --machine" in err


def test_a_sensor_is_found_by_its_name_with_the_unit_in_brackets(analyze, machine, tmp_path):
    orbit = Orbit(change=UNBALANCE)
    samples = np.column_stack([orbit.x, orbit.y, orbit.keyphasor]).astype(np.float32)
    table = save_table(tmp_path / "table.npz", samples)
    named = tmp_path / "named.csv"
    header = "time [ms],probe-x [um],probe-y (um),keyphasor [V]"
    t_ms = 1e3 * np.arange(len(samples)) / RATE_HZ
    np.savetxt(named, np.column_stack([t_ms, samples]), "%.9g", ",", header=header, comments="")
    code, (found, expected), err = analyze(machine, named, table, "--jobs", 1)
    assert (code, err) == (0, "")
    assert found["verdict"] == expected["verdict"] == "unbalance"
