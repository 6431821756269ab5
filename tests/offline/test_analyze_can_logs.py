"""``analyze`` and ``calibrate`` on what ``record`` writes: the verdict is that of the samples themselves."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time

import can
import numpy as np
import pytest
from support.given_codes import had
from support.orbit_files import RATE_HZ, UNBALANCE, Orbit
from support.orbit_logs import EPOCH_S, frames, machine_file, signals, write

from sim_hw.bus_socket import UnixBus
from sim_hw.bus_socket_hub import Hub

pytestmark = pytest.mark.integration
ENDINGS = [".blf", ".asc", ".log", ".log.gz"]


@pytest.fixture
def machine(tmp_path):
    return machine_file(tmp_path / "machine.toml")


def save_table(path, samples):
    np.savez(path, **dict(zip(["probe-x", "probe-y", "keyphasor"], samples.T, strict=True)), fs=RATE_HZ)
    return path


def same(one, other):
    """Whether two verdicts differ in nothing but the name of the recording."""
    return {**one, "recording": ""} == {**other, "recording": ""}


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_log_is_judged_as_its_samples_are(analyze, machine, tmp_path, ending):
    sent, samples = frames(machine, "shaft", signals(Orbit(change=UNBALANCE)), channel="can0")
    log = write(tmp_path / f"run{ending}", sent)
    code, (of_log, of_table), err = analyze(
        machine, log, save_table(tmp_path / "t.npz", samples), "--jobs", 1
    )
    assert (code, err) == (0, "")
    assert of_log["verdict"] == "unbalance"
    assert same(of_log, of_table)


@pytest.mark.long
def test_what_is_recorded_off_a_bus_is_judged_as_what_was_sent(analyze, tmp_path):
    address = tmp_path / "bus"
    machine = machine_file(tmp_path / "machine.toml")
    text = re.sub(r"^(data_)?bitrate = .*\n", "", machine.read_text(), flags=re.MULTILINE)
    text = text.replace('interface = "socketcan"', 'interface = "unixbus"')
    machine.write_text(text.replace('channel = "can0"', f'channel = "{address}"'))
    sent, samples = frames(machine, "shaft", signals(Orbit(change=UNBALANCE)))
    log = tmp_path / "run.blf"
    hub = Hub(str(address))
    hub.start()
    command = [sys.executable, "-m", "daqsvc", "record", str(machine), "--out", str(log)]
    recorder = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        with UnixBus(str(address), fd=True, hub="join") as bus:
            until = time.monotonic() + 60
            while not (log.exists() and log.stat().st_size):
                assert time.monotonic() < until
                bus.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
                time.sleep(0.05)
            begun = time.monotonic()
            for message in sent:
                time.sleep(max(0.0, begun + message.timestamp - EPOCH_S - time.monotonic()))
                bus.send(message)
            time.sleep(0.5)
            recorder.send_signal(signal.SIGTERM)
            out, said = recorder.communicate(timeout=60)
    finally:
        recorder.kill()
        recorder.communicate()
        hub.stop()
    assert recorder.returncode == 0, said
    assert json.loads(out)["streams"]["shaft"] == {"samples_received": len(samples), "samples_lost": 0}
    _, (of_log, of_table), _ = analyze(machine, log, save_table(tmp_path / "t.npz", samples), "--jobs", 1)
    assert of_log["verdict"] == "unbalance"
    assert same(of_log, of_table)


def test_the_parts_of_a_folder_are_one_recording(analyze, machine, tmp_path):
    sent, samples = frames(machine, "shaft", signals(Orbit(change=UNBALANCE)), channel="can0")
    folder = tmp_path / "logs"
    folder.mkdir()
    third = len(sent) // 3
    for number, part in enumerate((sent[:third], sent[third : 2 * third], sent[2 * third :])):
        write(folder / f"can0-20261122T10000{number}.000000Z.blf", part)
    (folder / "notes.txt").write_text("of Monday")
    _, (of_folder, of_table), _ = analyze(
        machine, folder, save_table(tmp_path / "t.npz", samples), "--jobs", 1
    )
    assert same(of_folder, of_table)


def test_lost_frames_are_missing_samples(analyze, machine, tmp_path):
    sent, _ = frames(machine, "shaft", signals(Orbit()), channel="can0")
    del sent[100:103]
    _, (found,), _ = analyze(machine, write(tmp_path / "run.blf", sent))
    assert found["data_quality"]["missing"] == dict.fromkeys(["probe-x", "probe-y", "keyphasor"], 30)


def test_a_log_that_is_cut_short_is_judged_as_far_as_it_goes(analyze, machine, tmp_path):
    sent, _ = frames(machine, "shaft", signals(Orbit(200)), channel="can0")
    log = write(tmp_path / "run.blf", sent)
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.8)])
    code, (found,), _ = analyze(machine, log)
    assert (code, found["verdict"]) == (0, "normal")
    assert re.search(r"run.blf is damaged behind frame .* are taken", found["data_quality"]["problems"][0])


def test_a_log_whose_first_frames_are_damaged_is_refused_without_a_word_of_others(analyze, machine, tmp_path):
    sent, _ = frames(machine, "shaft", signals(Orbit(200)), channel="can0")
    log = write(tmp_path / "flip.blf", sent)
    raw = bytearray(log.read_bytes())
    # The first container: its compressed data begin behind the file's header and its own.
    raw[144 + 32 + 8 : 144 + 32 + 40] = bytes(32)
    log.write_bytes(raw)
    _, found, err = analyze(machine, log)
    said = err + repr(found)
    assert "is damaged from its first frame on" in said
    assert "none can be read" in said
    assert "before that" not in said


def two_buses(tmp_path):
    machine = machine_file(tmp_path / "two.toml", "rotor-two-buses.toml", rate_hz=RATE_HZ)
    machine.write_text(machine.read_text().replace("rate_hz = 2000.0", f"rate_hz = {RATE_HZ}"))
    # The grid begins after some seconds, and the machine is healthy for some more.
    x, y, mark = np.concatenate([signals(Orbit(400, seed=2)), signals(Orbit(400, change=UNBALANCE))]).T
    of_y, _ = frames(machine, "shaft-y", np.column_stack([y, mark]), channel="can0")
    of_x, _ = frames(machine, "shaft-x", x[:, None], channel="can1")
    return machine, of_x, of_y


@pytest.mark.long
def test_two_buses_are_put_on_one_grid(analyze, tmp_path):
    machine, of_x, of_y = two_buses(tmp_path)
    both = write(tmp_path / "both.log", sorted([*of_x, *of_y], key=lambda message: message.timestamp))
    folder = tmp_path / "logs"
    folder.mkdir()
    write(folder / "can0-1.log", of_y)
    write(folder / "can1-1.log", of_x)
    code, (of_both, of_folder), _ = analyze(machine, both, folder, "--jobs", 1)
    assert code == 0, of_both["refused"]
    assert same(of_both, of_folder)
    assert of_both["verdict"] in {"unbalance", "damping_loss"}
    assert "unbalance" in of_both["group"]
    code, (of_one,), _ = analyze(machine, folder / "can0-1.log")
    assert code == 3
    assert "holds no samples of probe-x" in of_one["refused"]
    assert "in one folder" in of_one["refused"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--fs", "999"], "is 3200 Hz by .* and 999 Hz as given: leave --fs out"),
        (
            ["--map", "probe-x=x"],
            "a CAN log, of which the machine file states channels and units: leave out --map",
        ),
        (["--unit", "mm"], "leave out --unit"),
    ],
)
def test_options_that_contradict_a_log_are_refused(analyze, machine, tmp_path, options, message):
    sent, _ = frames(machine, "shaft", signals(Orbit(60)), channel="can0")
    code, (found,), _ = analyze(machine, write(tmp_path / "run.blf", sent), *options)
    assert code == 3
    assert re.search(message, found["refused"])


def test_logs_without_samples_of_the_machine_are_refused(analyze, machine, tmp_path):
    other = [can.Message(timestamp=EPOCH_S + k, arbitration_id=0x123, data=b"12") for k in range(9)]
    (tmp_path / "empty").mkdir()
    (tmp_path / "cut.blf").write_bytes(b"LOGG")
    logs = [write(tmp_path / "other.log", other), tmp_path / "empty", tmp_path / "cut.blf"]
    code, found, err = analyze(machine, *logs, "--jobs", 1)
    assert (code, err) == (3, "")
    refused = [one["refused"] for one in found]
    assert [one["code"] for one in found][:2] == ["R13", "R01"]
    had("R13", found[0]["refused"])
    assert "has no frame of a stream of" in refused[0]
    assert "but frames of 0x123 (29 bit)" in refused[0]
    assert "is a folder without a CAN log" in refused[1]
    assert "cut.blf cannot be read as a CAN log" in refused[2]


def test_a_log_of_another_rate_than_the_machine_file_says_is_refused(analyze, machine, tmp_path):
    sent, _ = frames(machine, "shaft", signals(Orbit()), channel="can0")
    slow = machine_file(tmp_path / "slow.toml", rate_hz=RATE_HZ / 2)
    code, (found,), _ = analyze(slow, write(tmp_path / "run.blf", sent))
    assert code == 3
    assert re.search(r"stream 'shaft' comes at 32\d\d Hz, and .*slow.toml states 1600 Hz", found["refused"])


def test_a_log_without_a_machine_file_is_refused(analyze, machine, tmp_path):
    sent, _ = frames(machine, "shaft", signals(Orbit(60)), channel="can0")
    log = write(tmp_path / "run.blf", sent)
    code, (found,), _ = analyze(
        log, "--probes", "x,y", "--speed-rpm", 3000, "--natural-frequency-hz", 60, "--damping-ratio", 0.1
    )
    assert code == 3
    assert "is a CAN log, which only the layouts of a machine file make sense of" in found["refused"]


def test_a_calibration_is_learnt_from_a_log(verb, machine, tmp_path):
    sent, samples = frames(machine, "shaft", signals(Orbit()), channel="can0")
    of_log = verb("calibrate", machine, write(tmp_path / "run.blf", sent))
    of_table = verb("calibrate", machine, save_table(tmp_path / "t.npz", samples))
    assert of_log[0] == of_table[0] == 0
    for learnt in (of_log[1][0], of_table[1][0]):
        learnt.pop("written")
    assert json.dumps(of_log[1]).replace("run.blf", "t.npz") == json.dumps(of_table[1])
