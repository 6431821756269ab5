"""``daqsvc calibrate`` as it is called: recordings and the live bus in, a file or one line of refusal out."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import threading
import tomllib
from functools import cache
from typing import TYPE_CHECKING

import can
import numpy as np
import pytest
from support.formats import fits
from support.machine_files import MACHINES
from support.paths import ROOT
from support.run_ups import ECCENTRICITY, OMEGA, RATE_HZ, record

from daqsvc.acquisition.clock import SystemClock
from daqsvc.cli import main
from daqsvc.detectors.bearing.settings import Bearing
from daqsvc.offline.calibrate_live import _only_rotor, calibrate_live
from daqsvc.rotor.calibration.file import load_calibration, load_record
from daqsvc.rotor.laval import unbalance_response
from daqsvc.rotor.synchronous.baseline import NotCalibratableError
from daqsvc.settings import parse_machine_file
from daqsvc.settings.plugins import configured
from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import CanNode
from sim_hw.nodes.pacing import RealTimePacer
from sim_hw.scenario import Scenario

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.integration
MACHINE = MACHINES / "rotor-synchronous.toml"
SPECIMENS = ROOT / "tests" / "guard" / "specimens"


@cache
def told_by(said):
    return fits("daqsvc calibrate", json.loads(said))


def pump() -> np.ndarray:
    """The example's pump at 0.8 of its critical speed, 120 revolutions."""
    scenario = Scenario.model_validate(
        {
            "title": "a pump",
            "revolutions": 120.0,
            "plant": {
                "kind": "rotor",
                "speed_rpm": 1500.0,
                "rotor": {"speed_ratio": 0.8, "damping_ratio": 0.11, "eccentricity": 0.1},
            },
            "noise": {"snr_db": 10.0},
        }
    ).simulate(4)
    return np.column_stack([scenario.channels[name] for name in ("x_um", "y_um", "keyphasor_v")])


def save(path: Path, samples: np.ndarray, rate_hz: float = 1600.0) -> str:
    np.savez(path, x=samples[:, 0], y=samples[:, 1], kph=samples[:, 2], fs=rate_hz)
    return str(path)


def with_marks(xy: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """A keyphasor that rises as a slope at angle zero, so that edges can be interpolated."""
    turned = np.mod(angle + math.pi, 2.0 * math.pi) - math.pi
    return np.column_stack((xy, np.clip(20.0 * turned, -4.0, 4.0) * (np.abs(turned) < 1.5)))


@cache
def run_up() -> np.ndarray:
    return with_marks(*record(5.0))


@cache
def steady(speed_hz: float, noise_um: float = 5.0) -> np.ndarray:
    """The rotor of the run-up, long at one speed."""
    angle = 2.0 * math.pi * speed_hz * np.arange(round(6.0 * RATE_HZ)) / RATE_HZ
    z = (
        ECCENTRICITY
        * complex(unbalance_response(2.0 * math.pi * speed_hz / OMEGA, 0.08))
        * np.exp(1j * angle)
    )
    z += 5.0 - 150.0j
    noise = noise_um * np.random.default_rng(1).standard_normal((len(z), 2))
    return with_marks(np.column_stack((z.real, z.imag)) + noise, angle)


OPTIONS = ["--probes", "x,y", "--keyphasor", "kph", "--keyphasor-threshold", "0"]
ROTOR = ["--natural-frequency-hz", "40", "--damping-ratio", "0.08"]


def calibrate(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    try:
        code = main(["calibrate", *map(str, arguments)])
    except SystemExit as left:
        code = int(left.code or 0)
    said = capsys.readouterr()
    return code, said.out, said.err


def test_a_run_up_and_two_speeds_make_one_file(tmp_path: Path, capsys) -> None:
    out = tmp_path / "rotor.toml"
    recordings = [
        save(tmp_path / "slow.npz", steady(30.0), RATE_HZ),
        save(tmp_path / "up.npz", run_up(), RATE_HZ),
        save(tmp_path / "fast.npz", steady(50.0), RATE_HZ),
    ]
    code, said, _ = calibrate(capsys, *recordings, *OPTIONS, "--clearance-um", "400", "--out", out, "--json")
    assert code == 0
    found = fits("daqsvc calibrate", json.loads(said))
    assert found["refused"] is None
    assert found["out"] == str(out)
    told = found["run_up"]
    assert told["natural_frequency_hz"] == pytest.approx(
        40.0, abs=4.0 * told["natural_frequency_uncertainty_hz"]
    )
    assert told["natural_frequency_uncertainty_hz"] < 0.02
    assert told["damping_ratio"] == pytest.approx(0.08, rel=0.01)
    assert told["heavy_spot_deg"] == pytest.approx(math.degrees(0.7), abs=1.0)
    assert told["laval"] is True
    predicted = {round(one["speed_rpm"] / 2400.0, 2): one for one in told["predicted_1x"]}
    assert set(predicted) == {0.5, 0.7, 0.95, 1.0}
    assert predicted[1.0]["amplitude_um"] == pytest.approx(20.0 / 0.16, rel=0.01)
    assert [round(one["speed_rpm"]) for one in found["steady"]] == [1800, 3000]
    assert all(one["off_prediction"] < 0.01 for one in found["steady"])
    made = load_record(out)
    assert made.run_up is not None
    assert made.rotor.natural_frequency_tolerance == 0.02
    assert made.rotor.clearance_um == 400.0
    slow = load_calibration(out, 1800.0)
    assert slow.rotor == made.rotor
    assert slow.fit_error == made.run_up.fit_error
    assert slow.revolutions > 170
    truth = ECCENTRICITY * complex(unbalance_response(0.75, 0.08))
    assert abs(complex(slow.baseline[1]) - truth) < 0.01 * abs(truth)
    # What was written is what analysis reads: the same machine is normal against it.
    against = ["--speed-rpm", "1800", "--calibration", str(out), "--json"]
    assert main(["analyze", recordings[0], *OPTIONS, *against]) == 0
    verdict = json.loads(capsys.readouterr().out)
    assert verdict["verdict"] == "normal"
    assert verdict["calibration"]["revolutions"] == slow.revolutions


def test_a_recording_chooses_its_baseline_by_the_speed_that_its_keyphasor_measures(
    tmp_path: Path, capsys
) -> None:
    out = tmp_path / "rotor.toml"
    slow, fast, between = (save(tmp_path / f"{hz:g}.npz", steady(hz), RATE_HZ) for hz in (30.0, 50.0, 40.0))
    assert calibrate(capsys, slow, fast, *OPTIONS, *ROTOR, "--out", out)[0] == 0
    code = main(["analyze", slow, fast, between, *OPTIONS, "--calibration", str(out), "--json"])
    assert code == 3
    found = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [one["verdict"] for one in found[:2]] == ["normal", "normal"]
    assert [round(one["calibration"]["speed_rpm"]) for one in found[:2]] == [1800, 3000]
    assert "no baseline within 5 % of 2400.0 rpm, but at 1800.0, 3000.0 rpm" in found[2]["refused"]


def test_a_person_reads_what_was_found_and_what_cannot_be_told_apart(tmp_path: Path, capsys) -> None:
    out = tmp_path / "rotor.toml"
    recording = save(tmp_path / "slow.npz", steady(30.0), RATE_HZ)
    code, said, _ = calibrate(capsys, recording, *OPTIONS, *ROTOR, "--out", out)
    assert code == 0
    assert "rotor as given: natural frequency 40 Hz +- 20 %" in said
    assert "behaves like a Laval rotor as far as was seen" in said
    assert "without a run-up, unbalance and loss of damping are one group" in said
    assert said.endswith(f"written to {out}\n")
    assert tomllib.loads(out.read_text())["written"].endswith("Z")


@pytest.mark.long
def test_an_even_sweep_needs_no_keyphasor(tmp_path: Path, capsys) -> None:
    xy, _ = record(5.0)
    recording = save(tmp_path / "up.npz", np.column_stack((xy, xy[:, 0])), RATE_HZ)
    sweep = ["--probes", "x,y", "--sweep-rpm", "720,4500", "--predict-rpm", "1200,2400"]
    code, said, _ = calibrate(capsys, recording, *sweep, "--json")
    assert code == 0
    told = fits("daqsvc calibrate", json.loads(said))["run_up"]
    assert told["natural_frequency_hz"] == pytest.approx(40.0, rel=2e-3)
    assert [one["speed_rpm"] for one in told["predicted_1x"]] == [1200.0, 2400.0]
    code, said, _ = calibrate(capsys, recording, *sweep[:-1], "9000", "--json")
    assert code == 3
    assert "1X at 9000 rpm cannot be predicted: the run-up went from" in told_by(said)["refused"]


@pytest.mark.long
def test_no_speed_is_predicted_for_a_machine_that_is_no_laval_rotor(tmp_path: Path, capsys) -> None:
    samples = with_marks(*record(5.0, stiffness_y=0.8))
    recording = save(tmp_path / "up.npz", samples, RATE_HZ)
    out = tmp_path / "rotor.toml"
    code, said, _ = calibrate(capsys, recording, *OPTIONS, "--predict-rpm", "2400", "--out", out, "--json")
    assert code == 0
    told = fits("daqsvc calibrate", json.loads(said))["run_up"]
    assert told["laval"] is False
    assert told["predicted_1x"] is None
    assert "no Laval rotor explains the orbit" in told["verdict"]
    assert load_record(out).rotor.natural_frequency_tolerance >= 0.2


def refused(capsys, tmp_path: Path, samples: np.ndarray, *options: object, rate_hz: float = RATE_HZ) -> str:
    out = tmp_path / "rotor.toml"
    recording = save(tmp_path / "bad.npz", samples, rate_hz)
    code, said, error = calibrate(capsys, recording, *(options or (*OPTIONS, *ROTOR)), "--out", out)
    assert code == 3, (said, error)
    assert not said
    assert not out.exists()
    assert error.startswith(f"not calibrated: {recording}: ")
    assert error.count("\n") == 1
    return error


def test_refuses_what_cannot_be_the_healthy_machine(tmp_path: Path, capsys) -> None:
    good = steady(30.0)
    changed = np.concatenate((good[:16000, :2], 1.5 * good[16000:, :2]))
    changed = np.column_stack((changed, good[:, 2]))
    assert "not steady: " in refused(capsys, tmp_path, changed)
    assert "too short: 1" in refused(capsys, tmp_path, good[:2000])
    clipped = good.copy()
    clipped[:, 0] = np.minimum(clipped[:, 0], 20.0)
    assert "x is clipped at 20 um" in refused(capsys, tmp_path, clipped)
    dead = good.copy()
    dead[:, 1] = 3.0
    assert "y is dead: all samples are 3" in refused(capsys, tmp_path, dead)
    noise = good.copy()
    noise[:, :2] = np.random.default_rng(2).standard_normal((len(good), 2))
    assert "there is no orbit" in refused(capsys, tmp_path, noise)
    assert "turns against the stated rotation" in refused(capsys, tmp_path, good[:, [1, 0, 2]])
    assert "turns against the stated rotation" in refused(capsys, tmp_path, run_up()[:, [1, 0, 2]])
    weak = good * [1.0, 1.0, 0.1] + [0.0, 0.0, 3.0]
    assert "keyphasor kph: 0 pulses cross 0" in refused(capsys, tmp_path, weak)
    fixed = ["--probes", "x,y", "--speed-rpm", "1809", *ROTOR]
    assert "the shaft turns at 1800." in refused(capsys, tmp_path, good, *fixed)


@pytest.mark.long
def test_refuses_two_recordings_of_one_kind(tmp_path: Path, capsys) -> None:
    one, two = (save(tmp_path / f"{i}.npz", steady(30.0), RATE_HZ) for i in range(2))
    code, said, _ = calibrate(capsys, one, two, *OPTIONS, *ROTOR, "--json")
    assert code == 3
    assert "there is another recording at 1800.0 rpm; give one for each speed" in told_by(said)["refused"]
    up, again = (save(tmp_path / f"up{i}.npz", run_up(), RATE_HZ) for i in range(2))
    code, said, _ = calibrate(capsys, up, again, *OPTIONS, "--json")
    assert code == 3
    assert told_by(said)["refused"] == f"{up} and {again} are run-ups; give one of them"
    code, said, _ = calibrate(capsys, one, *OPTIONS, "--json")
    assert code == 3
    assert "are not known: add a run-up, or give --natural-frequency-hz" in told_by(said)["refused"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["a.npz"], "nothing would be kept: give --out FILE, --json or both"),
        (
            ["a.npz", "--json", "--probes", "x,y"],
            "the speed is not known: give --speed-rpm for a steady recor",
        ),
        ([MACHINE, "--json"], "no recording is given; name one after the machine file, or listen"),
        ([MACHINE, "a.npz", "--json", "--live"], "--live listens to the machine; leave out recordings"),
        (["a.npz", "--json", "--live"], "--live needs a machine file, which states how to reach"),
        (
            [MACHINE, "a.npz", "--json", "--probes", "x,y"],
            "--probes: the machine file states this; leave it out",
        ),
        (
            ["a.npz", *OPTIONS, "--json", "--damping-ratio", "0.1"],
            "--damping-ratio go together; give both, or",
        ),
        (
            ["a.npz", *OPTIONS, "--json", "--sweep-rpm", "5,5"],
            "'5,5' is no sweep; write FROM,TO in revolutio",
        ),
        (
            ["a.npz", *OPTIONS, "--out", "/no/such/x.toml"],
            "--out /no/such/x.toml: there is no such directory",
        ),
        ([MACHINE, "a.npz", "--json", "--map", "z=1"], "--map names 'z', which is no sensor of"),
    ],
)
def test_wrong_usage_is_said(arguments, message: str, capsys) -> None:
    code, said, error = calibrate(capsys, *arguments)
    assert code == 2
    assert not said
    assert message in error


def test_a_recording_that_is_not_there(tmp_path: Path, capsys) -> None:
    code, _, error = calibrate(capsys, tmp_path / "no.npz", *OPTIONS, *ROTOR, "--out", tmp_path / "x.toml")
    assert code == 3
    assert "no.npz" in error


def test_channels_may_be_mapped_one_by_one(tmp_path: Path, capsys) -> None:
    x, y, keyphasor = steady(30.0).T
    recording = tmp_path / "logger.npz"
    np.savez(recording, a=x, b=y, c=keyphasor, fs=RATE_HZ)
    maps = ["--map", "x=a,y=b", "--map", "kph=c"]
    code, said, _ = calibrate(capsys, recording, *OPTIONS, *ROTOR, *maps, "--json")
    assert code == 0
    assert told_by(said)["steady"][0]["speed_rpm"] == pytest.approx(1800.0, rel=1e-3)
    code, _, error = calibrate(capsys, recording, *OPTIONS, *ROTOR, *maps, "--map", "x=b", "--json")
    assert code == 2
    assert "--map names 'x' twice" in error


def test_a_machine_file_says_probes_units_and_speed(tmp_path: Path, capsys) -> None:
    out = tmp_path / "pump.toml"
    recording = save(tmp_path / "pump.npz", pump())
    code, _, error = calibrate(capsys, MACHINE, recording, "--out", out)
    assert code == 0, error
    made = load_calibration(out)
    assert made.speed_rpm == pytest.approx(1500.0, rel=1e-3)
    assert made.rotor.natural_frequency_hz == 31.0
    assert made.revolutions > 100
    assert main(["analyze", str(MACHINE), recording, "--calibration", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["verdict"] == "normal"


def machine_file(channel: str):
    text = (
        MACHINE.read_text(encoding="utf-8")
        .replace('"socketcan"', '"virtual"')
        .replace('"can0" ', f'"{channel}" ')
    )
    return parse_machine_file(text[: text.index("[mqtt]")], MACHINE)


async def test_the_live_bus_gives_the_same_machine() -> None:
    machine = machine_file("calibrate-live")
    channel = machine.buses["can0"].model_dump()["channel"]
    layout = frame_layout(machine, "shaft")
    clock = SystemClock()
    told: list[tuple[int, int]] = []
    listening = asyncio.create_task(
        calibrate_live(
            machine, clock, revolutions=40, timeout_s=60.0, progress=lambda *seen: told.append(seen)
        )
    )
    with can.Bus(interface="virtual", channel=channel, protocol=can.CanProtocol.CAN_FD) as bus:
        await asyncio.sleep(0.3)
        playing = asyncio.create_task(CanNode(bus, layout, pump(), 1600.0).play(RealTimePacer(clock)))
        made = await listening
        playing.cancel()
        await asyncio.gather(playing, return_exceptions=True)
    assert made.revolutions == 40
    assert made.speed_rpm == pytest.approx(1500.0, rel=1e-3)
    assert made.laval
    assert told[-1][1] == 40


def test_whatever_else_watches_the_machine_is_left_out_while_it_is_calibrated() -> None:
    file = SPECIMENS / "specimen-calibrated.toml"
    machine = parse_machine_file(file.read_text(encoding="utf-8"), file)
    assert machine.pipeline.table(Bearing) is not None
    alone = _only_rotor(machine, 40)
    assert [key for key, _, _ in configured(alone.pipeline)] == ["rotor_synchronous"]


async def test_a_silent_bus_is_not_waited_for_for_ever() -> None:
    machine = machine_file("calibrate-silent")
    with pytest.raises(
        NotCalibratableError, match=r"no samples of shaft came within 0\.3 s; check that the m"
    ):
        await calibrate_live(machine, SystemClock(), revolutions=40, timeout_s=0.3)


async def test_listening_can_be_interrupted_and_leaves_nothing_behind() -> None:
    machine = machine_file("calibrate-interrupted")
    listening = asyncio.create_task(calibrate_live(machine, SystemClock(), revolutions=40, timeout_s=60.0))
    await asyncio.sleep(0.3)
    listening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await listening
    assert [task.get_name() for task in asyncio.all_tasks() if task is not asyncio.current_task()] == []


def test_ctrl_c_ends_listening_and_writes_nothing(tmp_path: Path, capsys) -> None:
    path, out = tmp_path / "machine.toml", tmp_path / "rotor.toml"
    text = MACHINE.read_text(encoding="utf-8").replace('"socketcan"', '"virtual"')
    path.write_text(text[: text.index("[mqtt]")], encoding="utf-8")
    ctrl_c = threading.Timer(1.5, os.kill, (os.getpid(), signal.SIGINT))
    ctrl_c.start()
    code, said, error = calibrate(capsys, path, "--live", "--out", out)
    ctrl_c.join()
    assert code == 1
    assert not said
    assert "interrupted" in error
    assert not out.exists()
