"""A folder with machine files and recordings under the names that the pages give them."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat
from support.bearing_signals import INNER, RATE_HZ, healthy, knocks
from support.fleet_archives import REVOLUTIONS, add_machine
from support.machine_files import MACHINES
from support.orbit_files import UNBALANCE, Orbit
from support.orbit_logs import frames, machine_file, signals, write
from support.paths import ROOT
from support.ports import free_port
from support.run_ups import record
from support.tls_files import self_signed

from daqsvc.page.access.accounts import account_line, write_account
from daqsvc.page.access.role import Role
from sim_hw.plants import rotor as plant

ACCOUNTS = "page.accounts"
SHARED_BUS = "/tmp/daqsvc-can0"  # noqa: S108 - as it is in the file
"""The virtual bus of the pages; the folder has one of its own."""
MEASURED = Path(os.environ["DAQSVC_DATA"]) / "cwru" if "DAQSVC_DATA" in os.environ else None
"""Recordings that are not in the repository; without them, the folder has others under the same names."""
CALIBRATED_LIVE = "feed-pump.toml"
"""A machine that is calibrated while it runs."""
HEALTHY_PUMP = "healthy-pump.toml"
"""The scenario of that machine."""
_RIG = (MACHINES / "virtual-rig.toml").read_text("utf-8")
_MORE = """
[store]
directory = "{home}/store"

[recorder]
before_s = 2.0
after_s = 1.0

[history]

[[alarms]]
name = "shaft-vibration-x"
sensor = "probe-x"
measure = "rms"
alert = 15.0
danger = 200.0
deadband = 2.0
"""
_ROTOR: dict[str, Any] = {"rate_hz": 16_000.0, "natural_hz": 5111.0 / 60.0, "zeta": 0.18}
"""Of the recordings of README."""
_SPEED_RPM = 6000.0
"""Of the machine that is calibrated while it runs: 200 revolutions take two seconds."""
_SCENARIO = f"""
title = "A healthy pump"
revolutions = 12000.0
samples_per_rev = 64
[plant]
kind = "rotor"
speed_rpm = {_SPEED_RPM}
[plant.rotor]
speed_ratio = 0.8
damping_ratio = 0.10
eccentricity = 0.1
[noise]
snr_db = 10.0
"""


def fill(made: Path) -> None:
    """Put all of it into an empty folder; its path is a short one, as sockets lie in it."""
    (made / "config").symlink_to(ROOT / "config")
    (made / "etc/plant").mkdir(parents=True)
    _machine_files(made)
    _recordings(made)
    _archive(made)
    write_account(made / ACCOUNTS, "ann", account_line("ann", Role.OPERATOR, "a long password"))
    pair = self_signed(made, "box7", "127.0.0.1")
    pair.cert.rename(made / "box7.pem")


def copy(home: Path, folder: Path) -> None:
    """Make another such folder: with the same recordings, and with buses, stores and accounts of its own."""
    shutil.copytree(home, folder, symlinks=True, copy_function=os.link)
    for file in [*folder.glob("*.toml"), *folder.glob("etc/**/*.toml")]:
        text = file.read_text()
        file.unlink()
        file.write_text(text.replace(f"{home}/", f"{folder}/"))
    (folder / ACCOUNTS).unlink()
    shutil.copy(home / ACCOUNTS, folder)


def _machine_files(made: Path) -> None:
    pump = _rig(made, "pump", "can0") + _MORE.format(home=made)
    for name in ("machine.toml", "pump.toml", "etc/plant/pump.toml", "etc/pump.toml"):
        (made / name).write_text(pump)
    for name in ("fan.toml", "etc/plant/fan.toml"):
        (made / name).write_text(_rig(made, "fan", "can1"))
    laval = (MACHINES / "laval-rig.toml").read_text("utf-8")
    (made / "broken.toml").write_text(
        re.sub("(?m)^damping_ratio = 0.18", 'damping_ratio = "lots"', laval), "utf-8"
    )
    (made / "plant.toml").write_text(f'[mqtt]\nurl = "mqtt://127.0.0.1:{free_port()}"\ninsecure = true\n')
    bearing = (MACHINES / "bearing.toml").read_text("utf-8")
    (made / "bearing.toml").write_text(re.sub("rate_hz = 25[_]?600.0", "rate_hz = 12000.0", bearing))
    (made / CALIBRATED_LIVE).write_text(_quick(made))
    (made / HEALTHY_PUMP).write_text(_SCENARIO)


def _rig(home: Path, name: str, bus: str) -> str:
    """The rig of the virtual bus, with another name and bus, and no broker."""
    text = _RIG[: _RIG.index("[mqtt]")].replace("virtual-rig", name).replace(SHARED_BUS, f"{home}/{bus}")
    return text.replace("can0]", f"{bus}]").replace('bus = "can0"', f'bus = "{bus}"')


def _quick(home: Path) -> str:
    """The pump of rotor-synchronous.toml on a virtual bus, four times as fast."""
    text = (MACHINES / "rotor-synchronous.toml").read_text("utf-8").partition("[mqtt]")[0]
    new = {
        "speed_rpm": f"{_SPEED_RPM}",
        "rate_hz": f"{_SPEED_RPM / 60.0 * 64.0}",
        "natural_frequency_hz": f"{_SPEED_RPM / 60.0 / 0.8}",
        "interface": '"unixbus"',
        "channel": f'"{home}/can2"',
    }
    for key, value in new.items():
        text = re.sub(rf'(?m)^{key} = (?:"\w+"|[\d.]+)', f"{key} = {value}", text, count=1)
    return re.sub(r"(?m)^(?:data_)?bitrate = .*\n", "", text)


def _recordings(made: Path) -> None:
    _rotor_recordings(made)
    good, other = healthy(10.0, 1), healthy(10.0, 4)
    bad = healthy(10.0, 2) + knocks(10.0, INNER, 3)
    for number in ("105", "130"):
        savemat(made / f"{number}.mat", {f"X{number}_DE_time": bad})
    savemat(made / "97.mat", {"X097_DE_time": good})
    if MEASURED is not None:
        for number in ("97", "105", "130"):
            (made / f"{number}.mat").unlink()
            (made / f"{number}.mat").symlink_to(MEASURED / f"{number}.mat")
    np.savez(made / "105.npz", de=bad, fe=other, fs=RATE_HZ)
    both: dict[str, Any] = {"accel-de": good, "accel-fe": other, "de": good, "fe": other}
    np.savez(made / "healthy.npz", **both, fs=RATE_HZ)
    t = np.arange(40_000) / 20_000.0
    axes: dict[str, Any] = {
        name: size * np.sin(2 * np.pi * 30.0 * t) + np.random.default_rng(size).normal(0, 0.1, len(t))
        for name, size in zip("XYZ", (1, 2, 3), strict=True)
    }
    np.savez(made / "axes.npz", **axes, fs=20_000.0)
    # A machine file, and a CAN log of its bus.
    file = machine_file(made / "orbit.toml")
    sent, _ = frames(file, "shaft", signals(Orbit(300)), channel="can0")
    write(made / "run-up.blf", sent)
    (made / "monday").mkdir()
    write(made / "monday" / "can0.blf", sent)
    _table(made / "monday" / "table.csv")


def _rotor_recordings(made: Path) -> None:
    """A change of a rotor, and the run-up and the steady running of one machine."""
    changed = [plant.Change(70.0, plant.PlantParameters(damping_ratio=0.10))]
    motion = plant.simulate(plant.PlantParameters(), changed, revolutions=140.0, samples_per_rev=64.0)
    x, y = motion.in_um(100.0)
    np.savez(made / "run.npz", x=x, y=y, fs=5111.0 / 60.0 * 64.0)
    up, angle = record(noise_um=0.5, speeds_hz=(20.0, 136.0), **_ROTOR)
    kph = plant.keyphasor_voltage(angle / (2.0 * np.pi))
    np.savez(made / "run-up.npz", x=up[:, 0], y=up[:, 1], kph=kph, fs=_ROTOR["rate_hz"])
    # It begins at rest: the first half is left out.
    still, angle = record(noise_um=0.5, speeds_hz=(80.0, 80.0), duration_s=4.0, **_ROTOR)
    kph = plant.keyphasor_voltage(angle / (2.0 * np.pi))
    half = len(still) // 2
    for name in ("steady", "monday"):
        np.savez(
            made / f"{name}.npz", x=still[half:, 0], y=still[half:, 1], kph=kph[half:], fs=_ROTOR["rate_hz"]
        )


def _table(file: Path) -> None:
    """A recording of the rig, as a logger writes it."""
    t = np.arange(3000) / 640.0
    orbit = [10 * np.cos(2 * np.pi * 10 * t), 10 * np.sin(2 * np.pi * 10 * t) - 10.0]
    table = np.column_stack([t, *orbit, plant.keyphasor_voltage(10 * t)])
    np.savetxt(file, table, delimiter=",", header="time (s),ch1,ch2,ch3", comments="")


def _archive(made: Path) -> None:
    """An archive of a fleet of one machine."""
    recordings = add_machine(made / "archive", "pump-1")
    # Two false alarms, of a day each, and a fault.
    for day in range(1, 11):
        change = UNBALANCE if day in {3, 6, 9, 10} else 0.0
        Orbit(REVOLUTIONS, change, seed=day).save(recordings / f"2026-03-{day:02}.npz")
    (made / "faults.csv").write_text("machine,fault,first,last\npump-1,unbalance,2026-03-09,\n")
