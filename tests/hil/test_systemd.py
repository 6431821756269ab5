"""The unit under a real systemd, in a guest: started, killed, hung, stopped, and its sandbox from within."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import sysconfig
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from support.guide_commands import shell_blocks
from support.paths import ROOT
from support.systemd_units import IN_A_GUEST, STORE, UNIT, Shaft, alarm, journal, say, sh, shown, until
from support.unit_kernels import put_kernels, reference_s
from support.vcan_links import VcanLink

from daqsvc import kernel_cache
from daqsvc.alarms.commands import Verb
from daqsvc.control import ControlRequest, ask, ask_status

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [IN_A_GUEST, pytest.mark.timeout(120)]
LATE = "daqsvc@late"
"""Whose bus, broker, disk and time are not there at the start."""
KERNELS = Path("/var/cache/daqsvc/kernels")
INSTALLED = Path("/opt/hil")
"""Not where it lies on the host: that may be below /root or /tmp, which the sandbox hides."""
WATCHDOG_S = 6
READY_S, STOP_S = 3.0, 2.0
"""What the service promises; the guest is some times as slow as a machine that it is for."""
NOMINAL_S = 0.8
"""What `reference_s` is on such a machine."""
FIRST_OF_2000_S = 946_684_800.0
BROKEN = "schema_version = 1\nsite = 5\n"


def slowness(*taken_s: float) -> float:
    """How many times as slow this is as a machine on which the promises hold, by `reference_s` taken here."""
    return max(1.0, max(taken_s) / min(NOMINAL_S, float(os.environ["DAQSVC_HOST_S"])))


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


def install() -> None:
    """Put the program where it belongs, all else as docs/edge-box.md says, and kernels of the host."""
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
    [[*guide, _check, _start]] = shell_blocks("edge-box.md")["Run under systemd"]
    for command in guide:
        sh("/bin/sh", "-ec", command, cwd=ROOT)
    for unit in (UNIT, LATE, "daqsvc@broken"):
        changes = Path(f"/etc/systemd/system/{unit}.service.d")
        changes.mkdir()
        (changes / "quicker.conf").write_text(f"[Service]\nWatchdogSec={WATCHDOG_S}\nRestartSec=200ms\n")
    Path("/etc/credstore").mkdir(exist_ok=True)
    secret = Path("/etc/credstore/daqsvc-pump.mqtt-password")
    secret.write_text("s3cret\n")
    secret.chmod(0o600)
    sh("systemctl", "daemon-reload")
    put_kernels(INSTALLED / "tree", KERNELS)
    sh("chown", "-R", "daqsvc:daqsvc", KERNELS.parent)
    assert KERNELS.parent == kernel_cache.SERVICE


@pytest.fixture(scope="module")
def unit() -> Iterator[str]:
    """The unit, running, with its device on the bus."""
    install()
    link = VcanLink()
    folder = Path("/etc/daqsvc")
    text = (folder / "pump.toml").read_text()
    assert f'directory = "{STORE}"' in text
    text = text.replace('channel = "can0"', f'channel = "{link.name}"').replace(
        'start = "retry"', 'start = "error"'
    )
    text = text.replace("alert = 40.0", "alert = 4.0")
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
        r"1 of 1 buses up; alarms: .*; broker not connected( \(.*\))?; \d+ alarm messages .*",
        now["StatusText"],
    )
    assert sum(1 for _ in KERNELS.rglob("*.nbc")) == before, "nothing was compiled anew"
    assert took_s <= READY_S * slow


def test_a_kernel_that_is_not_kept_is_compiled_in_the_sandbox_by_another_process(unit: str) -> None:
    kept = {*KERNELS.rglob("*.nbc")}
    missing = next(path for path in kept if path.name.startswith("sound.is_sound"))
    missing.unlink()
    sh("systemctl", "restart", unit)
    assert shown(unit)["ActiveState"] == "active"
    said = journal(unit)
    assert "compiling kernels" in said
    assert "compiles kernels by itself" not in said
    assert {*KERNELS.rglob("*.nbc")} == kept


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
    status = until(
        lambda: (now := ask_status(STORE)[0])["outputs"]["mqtt"]["reason"] and now,
        "it knows why no broker is there",
    )
    assert status["outputs"]["mqtt"].pop("away_s") >= 0.0
    away = {"connected": False, "reason": "127.0.0.1:8883: nothing listens there", "code": "O09"}
    assert (status["buses"]["can0"]["state"], status["outputs"]) == ("up", {"mqtt": away})
    away = "WARNING MQTT broker"
    assert away in journal(least="warning")
    assert away not in journal(least="err")
    assert "CRITICAL detector levels/shaft has stalled" in journal(least="crit")
    said = journal()
    assert "detector levels/shaft has stalled, without a step for 6 s" in said
    still = r"the event loop has been blocked for 3 s: the event loop is in (look|is_to_hang) \(unit_main\.py"
    assert re.search(still, said), said
    assert said.count("Watchdog timeout (limit 6s)!") == 2, said
    assert "works again" not in said


def test_its_machine_file_is_read_again_without_a_restart(unit: str) -> None:
    file = Path("/etc/daqsvc/pump.toml")
    text, before, stands = file.read_text(), shown(unit), alarm("shaft-vibration-x")
    received = ask_status(STORE)[0]["streams"]["shaft"]["samples_received"]
    changed = re.sub("(?m)^shelve_at_most_s = .*$", "shelve_at_most_s = 60.0", text)
    assert changed != text
    try:
        file.write_text(changed)
        sh("systemctl", "reload", unit)
        assert "reloaded: machine laval-rig: other alarms or setpoints" in journal()
        file.write_text(changed.replace("[machine]", "[machin]"))
        refused = subprocess.run(["systemctl", "reload", unit], capture_output=True, text=True, check=False)
        assert refused.returncode != 0
        assert "machin: unknown key" in journal()
    finally:
        file.write_text(text)
    now = until(lambda: (one := shown(unit))["ActiveState"] == "active" and one, "it goes on")
    assert (now["MainPID"], now["NRestarts"]) == (before["MainPID"], before["NRestarts"])
    status = ask_status(STORE)[0]["streams"]["shaft"]
    assert status["samples_received"] > received
    assert alarm("shaft-vibration-x") == stands
    sh("systemctl", "reload", unit)


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
