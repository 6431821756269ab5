"""The unit under a real systemd, in a guest: started, killed, hung, stopped, and its sandbox from within."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numba.core import caching
from support.paths import ROOT
from support.unit_kernels import reference_s
from support.vcan_links import VcanLink

from daqsvc import kernel_cache
from daqsvc.alarms.commands import Verb
from daqsvc.control import ControlRequest, ask, ask_status
from daqsvc.outbox.reading import read_journal
from daqsvc.settings import load_machine_file
from drivers.can.plugin import frame_layout
from sim_hw.nodes.can_node import to_frames

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [
    pytest.mark.skipif(
        os.environ.get("DAQSVC_HIL_SYSTEMD") != "1", reason="needs a systemd of its own: make hil"
    ),
    pytest.mark.timeout(120),
]
UNIT = "daqsvc@pump"
STORE = Path("/var/lib/daqsvc/pump")
LATE = "daqsvc@late"
"""Whose bus, broker, disk and time are not there at the start."""
KERNELS = Path("/var/cache/daqsvc/kernels")
INSTALLED = Path("/opt/hil")
"""Not where it lies on the host: that may be below /root or /tmp, which the sandbox hides."""
WATCHDOG_S = 6
PATIENCE_S = 60.0
READY_S, STOP_S = 3.0, 2.0
"""What the service promises; the guest is some times as slow as a machine that it is for."""
NOMINAL_S = 0.8
"""What `reference_s` is on such a machine."""
RATE_HZ = 640
FIRST_OF_2000_S = 946_684_800.0
BROKEN = "schema_version = 1\nsite = 5\n"


def sh(*command: object) -> str:
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout


def shown(unit: str = UNIT) -> dict[str, str]:
    keys = "ActiveState,SubState,MainPID,NRestarts,Result,StatusText,ExecMainStatus"
    return dict(line.split("=", 1) for line in sh("systemctl", "show", unit, "-p", keys).splitlines())


def journal(unit: str = UNIT, least: str = "debug") -> str:
    """What the journal has of a unit, from a level on."""
    return sh("journalctl", "-u", unit, "--no-pager", "-o", "cat", "-p", least)


def until(true: Any, what: str) -> Any:
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        if result := true():
            return result
        time.sleep(0.1)
    pytest.fail(f"not within {PATIENCE_S:g} s: {what}; {shown()}\n{journal()[-3000:]}")


def slowness(*taken_s: float) -> float:
    """How many times as slow this is as a machine on which the promises hold, by `reference_s` taken here."""
    return max(1.0, max(taken_s) / min(NOMINAL_S, float(os.environ["DAQSVC_HOST_S"])))


def say(figure: str) -> None:
    """Into the log of `make hil`, whatever pytest captures."""
    with contextlib.suppress(OSError), Path(os.environ["HIL_OUT"], "console").open("a") as console:
        console.write(f"\n{figure}\n")


def started_again(before: dict[str, str]) -> dict[str, str]:
    def found() -> dict[str, str] | None:
        now = shown()
        is_new = int(now["NRestarts"]) > int(before["NRestarts"]) and now["MainPID"] not in {
            "0",
            before["MainPID"],
        }
        return now if is_new and now["ActiveState"] == "active" else None

    now: dict[str, str] = until(found, "it is started again")
    return now


def alarm(name: str, store: Path = STORE) -> dict[str, Any] | None:
    """How an alarm stands, by the journal, which its own account may read."""
    os.seteuid(store.stat().st_uid)
    try:
        payloads = [json.loads(message.payload) for message in read_journal(store, history=0).latest]
    finally:
        os.seteuid(0)
    stands = next((one for one in payloads if one.get("alarm") == name), None)
    return stands and {key: stands[key] for key in ("state", "level", "occurrence", "time")}


class Shaft(threading.Thread):
    """The probes of the rig: an orbit of 20 um at 600 rpm, on a CAN interface, until the end."""

    def __init__(self, machine: Path, link: VcanLink) -> None:
        super().__init__(daemon=True)
        self._layout = frame_layout(load_machine_file(machine), "shaft")
        self._link = link
        self._over = threading.Event()

    def run(self) -> None:
        turns = np.arange(RATE_HZ) / 64.0
        rng = np.random.default_rng(3)
        waves = {
            "x": 20.0 * np.cos(2 * np.pi * turns),
            "y": 20.0 * np.sin(2 * np.pi * turns),
            "kph": np.where(turns % 1.0 < 0.1, -2.0, -10.0),
        }
        samples = np.stack([waves[n] + rng.normal(0.0, 0.02, RATE_HZ) for n in self._layout.channels], axis=1)
        begun_s, second = time.monotonic(), 0
        with self._link.sender() as sender:
            while not self._over.is_set():
                frames = to_frames(samples, self._layout, RATE_HZ, first_index=second * RATE_HZ).payloads
                for n, payload in enumerate(frames):
                    due_s = begun_s + second + (n + 1) / len(frames)
                    time.sleep(max(0.0, due_s - time.monotonic()))
                    head = (0x101).to_bytes(4, sys.byteorder) + bytes([len(payload), 0, 0, 0])
                    sender.send(head + payload.tobytes())
                second += 1

    def stop(self) -> None:
        self._over.set()
        self.join()


def install() -> None:
    """Put program, account and unit where they belong, with the kernels that the host has compiled."""
    places = {"tree": ROOT, "site": sysconfig.get_path("purelib"), "python": sys.base_prefix}
    for name, place in places.items():
        (INSTALLED / name).mkdir(parents=True)
        sh("mount", "--bind", place, INSTALLED / name)
    python = f"{INSTALLED}/python/bin/python{sys.version_info.major}.{sys.version_info.minor}"
    program = Path("/usr/bin/daqsvc")
    program.write_text(
        f"#!/bin/sh\nexport LD_LIBRARY_PATH={INSTALLED}/python/lib PYTHONDONTWRITEBYTECODE=1\n"
        f"export PYTHONPATH={INSTALLED}/tree:{INSTALLED}/site\n"
        f'exec {python} {INSTALLED}/tree/tests/hil/unit_main.py "$@"\n'
    )
    program.chmod(0o755)
    config = ROOT / "config" / "systemd"
    Path("/etc/sysusers.d").mkdir(exist_ok=True)
    shutil.copy(config / "daqsvc.sysusers.conf", "/etc/sysusers.d/daqsvc.conf")
    sh("systemd-sysusers", "/etc/sysusers.d/daqsvc.conf")
    shutil.copy(config / "daqsvc@.service", "/etc/systemd/system/")
    for unit in (UNIT, LATE, "daqsvc@broken"):
        changes = Path(f"/etc/systemd/system/{unit}.service.d")
        changes.mkdir()
        (changes / "quicker.conf").write_text(f"[Service]\nWatchdogSec={WATCHDOG_S}\nRestartSec=200ms\n")
    Path("/etc/credstore").mkdir(exist_ok=True)
    secret = Path("/etc/credstore/daqsvc-pump.mqtt-password")
    secret.write_text("s3cret\n")
    secret.chmod(0o600)
    sh("systemctl", "daemon-reload")
    warmed = Path(os.environ["NUMBA_CACHE_DIR"])
    path_of = caching._CacheLocator.get_suitable_cache_subpath
    for source in {
        file.parent for package in ("daqsvc", "drivers") for file in (ROOT / package).rglob("*.py")
    }:
        kept = warmed / path_of(f"{source}/x.py")
        if kept.is_dir():
            shutil.copytree(kept, KERNELS / path_of(f"{INSTALLED}/tree/{source.relative_to(ROOT)}/x.py"))
    sh("chown", "-R", "daqsvc:daqsvc", KERNELS.parent)
    assert KERNELS.parent == kernel_cache.SERVICE


@pytest.fixture(scope="module")
def unit() -> Iterator[str]:
    """The unit, running, with its device on the bus."""
    install()
    link = VcanLink()
    folder = Path("/etc/daqsvc")
    folder.mkdir()
    text = (ROOT / "config" / "machines" / "laval-rig.toml").read_text()
    text = text.replace('channel = "can0"', f'channel = "{link.name}"').replace(
        'start = "retry"', 'start = "error"'
    )
    text = text.replace("alert = 40.0", "alert = 4.0").replace('"/var/lib/daqsvc"', f'"{STORE}"')
    text = re.sub(r"^(ca_file|password_file) = .*$", "", text, flags=re.MULTILINE)
    text = text.replace("broker.example", "127.0.0.1")
    text = text.replace('username = "daq"', 'username = "daq"\npassword_credential = "mqtt-password"')
    (folder / "pump.toml").write_text(text)
    (folder / "broken.toml").write_text(BROKEN)
    shaft = Shaft(folder / "pump.toml", link)
    shaft.start()
    try:
        yield UNIT
    finally:
        shaft.stop()
        link.close()


def test_it_is_ready_soon_with_kernels_that_are_compiled(unit: str) -> None:
    before = sum(1 for _ in KERNELS.rglob("*.nbc"))
    assert before > 0
    reference_before_s = reference_s()
    begun_s = time.monotonic()
    sh("systemctl", "start", unit)
    took_s = time.monotonic() - begun_s
    slow = slowness(reference_before_s, reference_s())
    say(f"ready after {took_s:.2f} s in a guest that is {slow:.1f} times as slow as a machine of today")
    now = shown()
    assert (now["ActiveState"], now["NRestarts"]) == ("active", "0")
    assert re.fullmatch(
        r"1 of 1 buses up; alarms: .*; broker not connected; \d+ alarm messages .*", now["StatusText"]
    )
    assert sum(1 for _ in KERNELS.rglob("*.nbc")) == before, "nothing was compiled anew"
    assert took_s <= READY_S * slow


def test_the_sandbox_is_in_force(unit: str) -> None:
    assert shown(unit)["ActiveState"] == "active"
    found = json.loads((STORE / "probe.json").read_text())
    assert found.pop("uid") == int(sh("id", "-u", "daqsvc"))
    assert int(sh("getent", "group", "dialout").split(":")[2]) in found.pop("groups")
    variables = {"STATE_DIRECTORY", "CACHE_DIRECTORY", "RUNTIME_DIRECTORY", "CREDENTIALS_DIRECTORY"}
    assert variables <= set(found.pop("variables"))
    assert found.pop("write /etc") == found.pop("write /usr") == "Read-only file system"
    assert found.pop("read /root") == "Permission denied"
    assert found == {
        "capabilities": 0,
        "no_new_privileges": "1",
        "seccomp": "2",
        "packet socket": "Address family not supported by protocol",
        "CAN socket": "done",
        "set the clock": "Operation not permitted",
        "change the owner": "Operation not permitted",
        "write a sysctl": "Read-only file system",
        "write the state": "done",
        "secret": "done",
        "no secret": "No such file or directory",
    }


def test_whatever_ends_it_it_is_started_again_and_its_alarms_stand_as_they_did(unit: str) -> None:
    name = "shaft-vibration-x"
    until(lambda: (alarm(name) or {}).get("state") == "active_unacknowledged", "the alarm is active")
    request = ControlRequest(schema="daqsvc.control/1", verb=Verb.ACKNOWLEDGE, alarm=name, by="tester")
    assert ask(STORE, request).accepted
    assert Path("/run/daqsvc/pump/control.sock").is_socket()
    stands = alarm(name)
    assert stands is not None
    assert stands["state"] == "active_acknowledged"
    now = shown(unit)
    for number, what in enumerate(("kill", "detector", "loop"), start=1):
        begun_s = time.monotonic()
        if what == "kill":
            os.kill(int(now["MainPID"]), signal.SIGKILL)
        else:
            Path("/etc/daqsvc/hang").write_text(f"{now['MainPID']} {what}")
        now = started_again(now)
        say(f"{what}: ready again after {time.monotonic() - begun_s:.1f} s")
        assert now["NRestarts"] == str(number)
        assert alarm(name) == stands
    status = ask_status(STORE)
    assert (status["buses"]["can0"]["state"], status["outputs"]) == ("up", {"mqtt": {"connected": False}})
    away = "WARNING MQTT broker"
    assert away in journal(least="warning")
    assert away not in journal(least="err")
    assert "CRITICAL detector levels/shaft has stalled" in journal(least="crit")
    said = journal()
    assert "detector levels/shaft has stalled, without a step for 6 s" in said
    assert "the event loop has stood still for 3 s: the event loop is in look (unit_main.py" in said
    assert said.count("Watchdog timeout (limit 6s)!") == 2, said
    assert "gets on again" not in said


def boot_without_time(unit: str) -> None:
    """As on a box without a battery clock, which gets the time after the start."""
    away_s = time.time() - FIRST_OF_2000_S
    time.clock_settime(time.CLOCK_REALTIME, FIRST_OF_2000_S)
    try:
        sh("systemctl", "start", unit)
    finally:
        time.clock_settime(time.CLOCK_REALTIME, time.time() + away_s)


def test_without_bus_broker_disk_and_time_it_starts_and_goes_on_when_they_come(unit: str) -> None:
    others = shown(unit)
    link = VcanLink()
    link.remove()
    file, store = Path("/etc/daqsvc/late.toml"), STORE.with_name("late")
    text = Path("/etc/daqsvc/pump.toml").read_text().replace(str(STORE), str(store))
    text = re.sub(r'channel = "vcan\w+"', f'channel = "{link.name}"', text)
    file.write_text(text.replace('start = "error"', 'start = "retry"'))
    store.mkdir()
    sh("mount", "-t", "tmpfs", "-o", "size=32m", "late", store)
    filler = store / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file_of_zeros:
        while file_of_zeros.write(bytes(1 << 16)):
            pass
    boot_without_time(LATE)
    started = shown(LATE)
    assert started["ActiveState"] == "active"
    assert "0 of 1 buses up" in started["StatusText"]
    until(lambda: "make room on the disk" in journal(LATE), "it says that the disk is full")
    assert not (store / "outbox.sqlite").exists()

    filler.unlink()
    link.add()
    shaft = Shaft(file, link)
    shaft.start()
    try:
        until(lambda: "1 of 1 buses up" in shown(LATE)["StatusText"], "the bus is up")
        stands = until(lambda: alarm("shaft-vibration-x", store), "an alarm is in the journal")
    finally:
        shaft.stop()
        link.close()
    assert stands["time"] > "2026"
    for before, now in ((started, shown(LATE)), (others, shown(unit))):
        assert [now[key] for key in ("MainPID", "NRestarts")] == [
            before[key] for key in ("MainPID", "NRestarts")
        ]
    sh("systemctl", "stop", LATE)
    assert shown(LATE)["Result"] == "success"


def test_a_wrong_machine_file_is_not_tried_again_and_again() -> None:
    done = subprocess.run(["systemctl", "start", "daqsvc@broken"], check=False, capture_output=True)
    assert done.returncode != 0
    now = until(lambda: (one := shown("daqsvc@broken"))["ActiveState"] == "failed" and one, "it has failed")
    assert (now["ExecMainStatus"], now["NRestarts"]) == ("2", "0")
    assert "broken.toml:2: site = 5" in journal("daqsvc@broken", "err")


def test_it_stops_within_two_seconds(unit: str) -> None:
    begun_s = time.monotonic()
    sh("systemctl", "stop", unit)
    took_s = time.monotonic() - begun_s
    slow = slowness(reference_s())
    say(f"stopped after {took_s:.2f} s in a guest that is {slow:.1f} times as slow as a machine of today")
    now = shown(unit)
    assert (now["ActiveState"], now["Result"]) == ("inactive", "success"), journal()[-2000:]
    assert took_s <= STOP_S * slow
    assert not Path("/run/daqsvc/pump").exists()
