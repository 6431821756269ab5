"""The Debian package under a real systemd, in a guest: docs/install.md word for word, what README shows."""

from __future__ import annotations

import os
import re
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from support.brokers import running_mosquitto
from support.guide_commands import shell_blocks
from support.paths import ROOT
from support.systemd_units import (
    IN_A_GUEST,
    PATIENCE_S,
    UNIT,
    Shaft,
    alarm,
    journal,
    let_go_of_files,
    messages,
    say,
    sh,
    shown,
    until,
)
from support.unit_kernels import put_kernels
from support.vcan_links import VcanLink

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [IN_A_GUEST, pytest.mark.timeout(300)]
MACHINE = Path("/etc/daqsvc/pump.toml")
STORE = Path("/var/lib/daqsvc")
PROGRAM = Path("/usr/lib/daqsvc")
KERNELS = Path("/var/cache/daqsvc/kernels")
ENABLED = Path(f"/etc/systemd/system/multi-user.target.wants/{UNIT}.service")
NAME = "shaft-vibration-x"
INSTALL, ELSEWHERE, UPGRADE, BACK, REMOVE = "The package", "From the wheel", "Upgrade", "Go back", "Remove"
CLONE = "From a clone"
GUIDE = shell_blocks("install.md")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the administrator is, with a package as the guide names it; and everything is agreed to."""
    Path("/etc/apt/apt.conf.d/hil").write_text('APT::Get::Assume-Yes "true";\n')
    Path("/etc/dpkg/dpkg.cfg.d/hil").write_text("force-unsafe-io\n")  # no power cut is tried here
    return tmp_path_factory.mktemp("admin")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The device on can0, and a broker; its port."""
    link = VcanLink("can0")
    shaft = Shaft(ROOT / "config" / "machines" / "laval-rig.toml", link)
    shaft.start()
    try:
        with running_mosquitto(tmp_path_factory.mktemp("broker")) as broker:
            yield broker.port
    finally:
        shaft.stop()
        link.close()


def older() -> Path:
    return Path(os.environ["DAQSVC_DEBS"].split()[0])


def newer() -> Path:
    return Path(os.environ["DAQSVC_DEBS"].split()[1])


def bring(package: Path, folder: Path) -> None:
    """The one package that lies there."""
    for other in folder.iterdir():
        other.unlink()
    shutil.copy(package, folder)  # apt follows no links


def do(command: str, folder: Path) -> str:
    """A command of the guide, as it stands there."""
    begun_s = time.monotonic()
    said = sh("/bin/sh", "-ec", command, cwd=folder)
    say(f"{time.monotonic() - begun_s:5.1f} s: {command}")
    let_go_of_files()
    return said


def version() -> str:
    return sh("dpkg-query", "-W", "-f", "${Version}", "daqsvc")


def edit(broker: int) -> None:
    """What the machine is like here: its broker and a setpoint that its shaft exceeds."""
    text = re.sub(r"^(username|ca_file|password_file) = .*$", "", MACHINE.read_text(), flags=re.MULTILINE)
    url = f'"mqtt://127.0.0.1:{broker}"\ninsecure = true'
    text = text.replace('"mqtts://broker.example:8883"', url)
    MACHINE.write_text(text.replace("alert = 40.0", "alert = 15.0"))


def masked(text: str) -> str:
    """What is said, without figures and times, how lines are broken, and what a busy computer may lose."""
    said = [part for part in text.split("\n\n") if not part.startswith("LOST OR FAULTY")]
    text = re.sub(r"(since|CPU:).*$", r"\1", "\n\n".join(said), flags=re.MULTILINE)
    text = re.sub(r"[-+]?\d[\d.,]*(e-?\d+)?", "0", text)
    return re.sub(r"0 (min|h|d)\b", "0 s", " ".join(text.split()))


def test_every_command_of_the_guide_is_known_here() -> None:
    assert {heading: [len(block) for block in blocks] for heading, blocks in GUIDE.items()} == {
        INSTALL: [2, 3, 3],
        ELSEWHERE: [3],
        CLONE: [3],
        UPGRADE: [1],
        BACK: [1],
        REMOVE: [3],
    }
    # What has made the package, and what needs PyPI. tests/project/test_install_docs.py has those of a clone;
    # the rest is done below.
    assert GUIDE[INSTALL][0][1] == "make deb"


def test_it_is_installed_and_ready_by_the_commands_of_the_guide(folder: Path, rig: int) -> None:
    bring(older(), folder)
    install, example, start = GUIDE[INSTALL][1]
    do(install, folder)
    put_kernels(PROGRAM / "lib/python3.11/site-packages", KERNELS)
    sh("chown", "-R", "daqsvc:daqsvc", KERNELS.parent)
    do(example, folder)
    edit(rig)
    do(start, folder)
    now = shown()
    assert (now["ActiveState"], now["NRestarts"]) == ("active", "0")
    assert now["StatusText"].startswith("1 of 1 buses up; alarms: ")
    assert "compiling kernels" not in journal()
    assert Path(f"/proc/{now['MainPID']}/exe").resolve() == Path("/usr/bin/python3.11")
    assert ENABLED.is_symlink()
    until(lambda: (alarm(NAME, STORE) or {}).get("state") == "active_unacknowledged", "the alarm is active")
    sh("runuser", "-u", "daqsvc", "--", "daqsvc", "ack", NAME, MACHINE)
    until(lambda: "1 active acknowledged" in shown()["StatusText"], "systemd knows of it")


def test_what_else_the_guide_names_says_what_it_should(folder: Path) -> None:
    text = " ".join((ROOT / "docs" / "install.md").read_text("utf-8").split())
    named = re.findall(r"`((?:daqsvc|systemctl|journalctl|runuser) [^`]*pump[^`]*)`", text)
    expected = ["active (running)", "alarm shaft-vibration-x raised", "broker: connected", "Store ", NAME]
    assert len(named) == len(expected)
    for command, words in zip(named, expected, strict=True):
        said = do(command, folder)
        assert words in said, (command, said)
        assert "Warnings" not in said


def test_the_readme_shows_what_it_says(folder: Path) -> None:
    readme = (ROOT / "README.md").read_text("utf-8")
    blocks = re.findall(r"(?m)^```\n\$ (.*)\n((?:(?!```).*\n)*)```$", readme)
    shown_there = [(command.partition(" #")[0], text) for command, text in blocks if "pump" in command]
    assert len(shown_there) == 2
    expected = [masked(text) for _, text in shown_there]
    until_s = time.monotonic() + PATIENCE_S
    while True:
        said = [do(command, folder) for command, _ in shown_there]
        # A message may be on its way to the broker at the very moment, and then one waits.
        if [masked(one) for one in said] == expected or time.monotonic() > until_s:
            break
        time.sleep(1.0)
    assert [masked(one) for one in said] == expected, "\n".join(said)


def state() -> tuple[Any, ...]:
    """How the alarm stands, and everything that the journal has ever taken."""
    return alarm(NAME, STORE), {one["sequence"]: one for one in messages(STORE, history=10_000)}


def test_a_newer_version_takes_over_while_it_runs(folder: Path) -> None:
    before, (stands, events) = shown(), state()
    bring(newer(), folder)
    [[upgrade]] = GUIDE[UPGRADE]
    do(upgrade, folder)
    assert version() == newer().name.split("_")[1]
    now = shown()
    assert (now["ActiveState"], now["NRestarts"]) == ("active", "0")
    assert now["MainPID"] != before["MainPID"]
    later, since = state()
    assert later == stands
    assert events.items() <= since.items()


def test_the_older_version_comes_back_and_leaves_alone_what_does_not_run(folder: Path) -> None:
    sh("systemctl", "stop", UNIT)
    stands = state()
    bring(older(), folder)
    [[back]] = GUIDE[BACK]
    do(back.replace("OLDER", older().name.split("_")[1]), folder)
    assert version() == older().name.split("_")[1]
    assert shown()["ActiveState"] == "inactive"
    assert state() == stands
    sh("systemctl", "start", UNIT)
    assert state()[0] == stands[0]


def test_what_goes_when_it_is_removed_and_what_stays(folder: Path) -> None:
    stands = state()
    remove, purge, rest = GUIDE[REMOVE][0]
    do(remove, folder)
    assert (shown()["ActiveState"], shown()["MainPID"]) == ("inactive", "0")
    assert not PROGRAM.exists()
    assert not Path("/usr/bin/daqsvc").is_symlink()
    assert (MACHINE.exists(), ENABLED.is_symlink(), KERNELS.exists()) == (True, True, True)
    assert state()[0] == stands[0]
    do(purge, folder)
    assert (MACHINE.exists(), ENABLED.is_symlink(), KERNELS.parent.exists()) == (True, False, False)
    assert state()[0] == stands[0]
    do(rest, folder)
    for place in ("/etc", "/usr", "/var"):
        assert sh("find", place, "-xdev", "-name", "*daqsvc*") == ""
        let_go_of_files()
