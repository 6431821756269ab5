"""Every `daqsvc` line of the pages is run in a folder that has what the page names, and shows what is shown.

docs/tutorials has a reader of its own (tests/tutorials). Other programs: test_shown_programs.py.
"""

from __future__ import annotations

import contextlib
import os
import pty
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest
from offline.test_analyze_can_logs import frames, machine_file, signals, write
from project.test_quoted_messages import texts
from project.test_quoted_messages import words as words_of
from project.test_snippets import ALL, simple
from scipy.io import savemat
from support.bearing_signals import INNER, RATE_HZ, healthy, knocks
from support.fleet_archives import add_machine, add_recordings
from support.machine_files import MACHINES
from support.orbit_files import Orbit
from support.paths import ROOT
from support.ports import free_port
from support.run_ups import RATE_HZ as RUN_UP_HZ
from support.run_ups import record
from support.waiting import PATIENCE_S

from sim_hw.plants import rotor as plant

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.integration, pytest.mark.long]
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT}", "COLUMNS": "80"}
SOCKET = "control.sock"
GOES_ON = {"run": SOCKET, "page": "Ctrl-C ends it", "sim": "", "record": "", "status --watch": "BUS"}
"""Verbs that go on until Ctrl-C: what they show first; "" for those that are stopped two seconds after."""
TYPED = {"new": "\n", "account": "a long password\n"}
"""Verbs that ask, and what is typed each time."""
NOT_HERE = {
    "daqsvc calibrate run-up.npz steady.npz ": "needs both of one machine: tests/offline/test_calibrate.py",
    "daqsvc analyze monday.npz --probes x,y --keyphasor kph --calibration ": "needs that calibration",
    "daqsvc export 2026": "needs a snapshot: tests/offline/test_export.py",
    "daqsvc replay 2026": "needs a snapshot: tests/snapshots/test_as_recording.py",
    "daqsvc page --snapshot ": "needs snapshots: tests/page/test_snapshots_page.py",
    "daqsvc page ": "goes on: tests/page/test_page_server.py, docs/tutorials",
    "daqsvc calibrate machine.toml --live": "needs a healthy machine: tests/offline/test_calibrate.py",
    "daqsvc calibrate MACHINE.toml --live": "needs a healthy machine: tests/offline/test_calibrate.py",
    "daqsvc new --listen": "needs a device: tests/commands/test_new_kinds.py",
    "daqsvc sniff serial ": "needs a port: tests/drivers/serial/test_serial_sniff.py",
    "daqsvc sniff modbus ": "needs a device at port 502: tests/drivers/modbus/test_modbus_sniff.py",
    "daqsvc page pump.toml --listen ": "needs that address, and a certificate: tests/page/test_access.py",
    "daqsvc sniff can ": "SocketCAN, of the kernel: tests/hil/test_vcan_sniff.py",
}
"""How lines begin that cannot be run, and why; all else is run."""
STANDS_FOR = {
    "/etc/daqsvc/page.accounts": "page.accounts",
    "/etc/daqsvc": "etc",
    "/archive-results": "archive-results",
    "/archive": "archive",
    "s3://plant/archive": "archive",
    "s3://plant/verdicts": "verdicts",
    "tcp://scheduler:8786": "local:1",
    "~/daqsvc-virtual": "daqsvc-virtual",
}
"""Places of other computers, and what is there in the folder."""
IN_PLACE = [
    ("README.md", "monday/*.csv", {"monday/*.csv": "monday/table.csv"}),
    ("README.md", "bearing.toml", {"monday.npz": "healthy.npz"}),
    ("docs/analyze.md", "DE_time", {"RECORDING...": "105.mat"}),
    ("docs/analyze.md", "de,fe", {"RECORDING...": "105.npz"}),
    (
        "docs/analyze.md",
        "MACHINE.toml RECORDING...",
        {"MACHINE.toml": "orbit.toml", "RECORDING...": "run-up.blf"},
    ),
    ("docs/analyze.md", "healthy.npz", {"MACHINE.toml": "bearing.toml"}),
    ("docs/analyze.md", "", {"machine.toml": "orbit.toml"}),
    ("docs/calibration.md", "healthy.npz", {"MACHINE.toml": "bearing.toml"}),
    ("docs/calibration.md", "monday.npz", {"MACHINE.toml": "bearing.toml", "monday.npz": "healthy.npz"}),
    ("docs/calibration.md", "--probes", {"RECORDING...": "run-up.npz"}),
    ("docs/calibration.md", "--live", {"MACHINE.toml": "machine.toml"}),
    ("docs/calibration.md", "", {"MACHINE.toml": "orbit.toml", "RECORDING...": "run-up.blf"}),
    ("docs/export.md", "blf", {"machine.toml": "orbit.toml"}),
    ("docs/order-change.md", "", {"TODAY.csv": "axes.npz", "HEALTHY.csv": "axes.npz"}),
    ("docs/virtual-bus.md", "", {"config/machines/virtual-rig.toml": "machine.toml"}),
    ("", "", {"RECORDING...": "run.npz", "MACHINE.toml": "machine.toml", "FILE": "out.toml"}),
]
"""By page and a part of the line: files that are there under another name."""
SHARED_BUS = "/tmp/daqsvc-can0"  # noqa: S108 - as it is in the file
RIG = (MACHINES / "virtual-rig.toml").read_text("utf-8")


def machine(home: Path, name: str, bus: str) -> str:
    """The rig of the virtual bus, with a name and a bus of its own, and no broker."""
    text = RIG[: RIG.index("[mqtt]")].replace("virtual-rig", name).replace(SHARED_BUS, f"{home}/{bus}")
    return text.replace("can0]", f"{bus}]").replace('bus = "can0"', f'bus = "{bus}"')


MORE = """
[store]
directory = "{home}/store"

[recorder]
before_s = 2.0
after_s = 1.0

[history]
"""


@pytest.fixture(scope="module")
def home() -> Iterator[Path]:
    """A folder with machine files and recordings under the names that the pages give them."""
    made = Path(tempfile.mkdtemp(prefix="pages-"))  # a short path, as sockets lie in it
    (made / "config").symlink_to(ROOT / "config")
    plant_files = made / "etc/plant"
    plant_files.mkdir(parents=True)
    pump = machine(made, "pump", "can0") + MORE.format(home=made)
    for name in ("machine.toml", "pump.toml", "etc/plant/pump.toml", "etc/pump.toml"):
        (made / name).write_text(pump)
    for name in ("fan.toml", "etc/plant/fan.toml"):
        (made / name).write_text(machine(made, "fan", "can1"))
    (made / "broken.toml").write_text(
        re.sub(
            "(?m)^damping_ratio = 0.18", 'damping_ratio = "lots"', (MACHINES / "laval-rig.toml").read_text()
        )
    )
    (made / "plant.toml").write_text(f'[mqtt]\nurl = "mqtt://127.0.0.1:{free_port()}"\ninsecure = true\n')
    _recordings(made)
    yield made
    shutil.rmtree(made)


def _recordings(made: Path) -> None:
    changed = [plant.Change(70.0, plant.PlantParameters(damping_ratio=0.10))]
    motion = plant.simulate(plant.PlantParameters(), changed, revolutions=140.0, samples_per_rev=64.0)
    x, y = motion.in_um(100.0)
    np.savez(made / "run.npz", x=x, y=y, fs=5111.0 / 60.0 * 64.0)
    up, angle = record(noise_um=0.5)
    kph = plant.keyphasor_voltage(angle / (2.0 * np.pi))
    for name in ("run-up", "monday"):
        np.savez(made / f"{name}.npz", x=up[:, 0], y=up[:, 1], kph=kph, fs=RUN_UP_HZ)
    good, other = healthy(10.0, 1), healthy(10.0, 4)
    bad = healthy(10.0, 2) + knocks(10.0, INNER, 3)
    for number in ("105", "130"):
        savemat(made / f"{number}.mat", {f"X{number}_DE_time": bad})
    savemat(made / "97.mat", {"X097_DE_time": good})
    np.savez(made / "105.npz", de=bad, fe=other, fs=RATE_HZ)
    np.savez(
        made / "healthy.npz", **{"accel-de": good, "accel-fe": other, "de": good, "fe": other}, fs=RATE_HZ
    )
    t = np.arange(40_000) / 20_000.0
    axes = {
        name: size * np.sin(2 * np.pi * 30.0 * t) + np.random.default_rng(size).normal(0, 0.1, len(t))
        for name, size in zip("XYZ", (1, 2, 3), strict=True)
    }
    np.savez(made / "axes.npz", **axes, fs=20_000.0)
    still, angle = record(noise_um=0.5, speeds_hz=(50.0, 50.0))
    kph = plant.keyphasor_voltage(angle / (2.0 * np.pi))
    np.savez(made / "steady.npz", x=still[:, 0], y=still[:, 1], kph=kph, fs=RUN_UP_HZ)
    orbit(made)
    archive(made)
    t = np.arange(3000) / 640.0
    turns = np.column_stack(
        [
            10 * np.cos(2 * np.pi * 10 * t),
            10 * np.sin(2 * np.pi * 10 * t) - 10.0,
            plant.keyphasor_voltage(10 * t),
        ]
    )
    np.savetxt(
        made / "monday" / "table.csv",
        np.column_stack([t, turns]),
        delimiter=",",
        header="time (s),ch1,ch2,ch3",
        comments="",
    )
    bearing = (MACHINES / "bearing.toml").read_text("utf-8")
    (made / "bearing.toml").write_text(re.sub("rate_hz = 25[_]?600.0", "rate_hz = 12000.0", bearing))


def orbit(made: Path) -> None:
    """A machine file, and a CAN log of its bus."""
    file = machine_file(made / "orbit.toml")
    sent, _ = frames(file, "shaft", signals(Orbit(300)), channel="can0")
    write(made / "run-up.blf", sent)
    (made / "monday").mkdir()
    write(made / "monday" / "can0.blf", sent)


def archive(made: Path) -> None:
    """An archive of a fleet of one machine."""
    recordings = add_machine(made / "archive", "pump-1")
    add_recordings(recordings, 3, changed_from=2)
    (made / "faults.csv").write_text("machine,fault,first,last\npump-1,unbalance,2026-03-03,2026-03-03\n")


@pytest.fixture(scope="module")
def service(home: Path) -> Iterator[Path]:
    """The one service of all pages, with two machines, and what its sensors send."""
    assert run(["check", "etc/plant"], home).returncode == 0
    with contextlib.ExitStack() as running:
        for words in (
            ["run", "etc/plant"],
            ["sim", "etc/plant/pump.toml", "--duration", "900"],
            ["sim", "etc/plant/fan.toml", "--scenario", "healthy", "--duration", "900"],
        ):
            running.enter_context(process(words, home))
        until = time.monotonic() + 3 * PATIENCE_S
        while (said := run(["alarms", "pump.toml"], home)) and "rotor-fault" not in said.stdout:
            assert time.monotonic() < until, said
            time.sleep(1.0)
        yield home


@contextlib.contextmanager
def process(words: list[str], folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A command that goes on; it is killed at the end if it has not ended."""
    running = subprocess.Popen(
        [sys.executable, "-m", "daqsvc", *words],
        cwd=folder, env=ENVIRONMENT, text=True, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    try:
        yield running
    finally:
        if running.poll() is None:
            running.kill()
        running.communicate()


def in_terminal(words: list[str], folder: Path, typed: str) -> tuple[int, str]:
    """A command that asks; what is typed is there from the start."""
    leader, follower = pty.openpty()
    running = subprocess.Popen(
        [sys.executable, "-m", "daqsvc", *words],
        cwd=folder, env=ENVIRONMENT, stdin=follower, stdout=follower, stderr=follower, start_new_session=True,
    )  # fmt: skip
    os.close(follower)
    output = b""
    while True:
        try:
            output += (part := os.read(leader, 65_536))
        except OSError:
            break
        if part.rstrip().endswith((b":", b"]:", b"more:")) or b"Once more" in part:
            os.write(leader, typed.encode())
    os.close(leader)
    return running.wait(PATIENCE_S), output.decode()


def run(words: list[str], folder: Path, typed: str = "") -> subprocess.CompletedProcess[str]:
    """A command that ends by itself."""
    return subprocess.run(
        [sys.executable, "-m", "daqsvc", *words],
        cwd=folder, env=ENVIRONMENT, text=True, input=typed, check=False, timeout=PATIENCE_S,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


class Shown(NamedTuple):
    """A line that a page shows, and what is below it.

    Attributes:
        page: the page, from the root of the repository.
        words: the command, without ``daqsvc``.
        output: what is shown as its output; None if nothing is.
    """

    page: str
    words: list[str]
    output: str | None

    @property
    def line(self) -> str:
        return shlex.join(["daqsvc", *self.words])


def ours(page: str, command: str, output: str | None) -> Iterator[Shown]:
    for one in simple(command):
        rest = one[1:] if one[0] == "sudo" else one
        if rest[0].rpartition("/")[2] == "daqsvc":
            yield Shown(page, rest[1:], output)


def shown() -> Iterator[Shown]:
    """All lines, in the order of the pages."""
    for number, block in enumerate(ALL):
        page = f"{block.page.relative_to(ROOT)}"
        if page == "docs/reference/verbs.md" or block.language not in {"sh", ""}:
            continue
        if block.language == "sh":
            below = ALL[number + 1] if number + 1 < len(ALL) else block
            is_output = below.page == block.page and below.language == "" and not below.commands
            for place, command in enumerate(block.commands):
                follows = is_output and place == 0 and below.line - block.line < 14
                yield from ours(page, command, below.text if follows else None)
        elif block.text.startswith("daqsvc "):
            yield from ours(page, block.text.strip(), None)
        else:
            for part in re.split(r"(?m)^\$ ", block.text)[1:]:
                command, _, output = part.partition("\n")
                yield from ours(page, re.sub(r"\s+#\s.*", "", command), output)


SHOWN = list(shown())
LIVE = {"status", "alarms", "ack", "reset", "reload", "snapshot", "trend"}


def is_live(one: Shown) -> bool:
    return (
        one.words[0] in LIVE
        or "--live" in one.words
        or one.words[0] == "record"
        or (one.words[0] == "page" and "--plant" not in one.words)
        or any("alarm.mcap" in word for word in one.words)
    )


def arranged(one: Shown) -> list[str]:
    """The words of a line, as they are run in the folder: without what goes into a file."""
    words = one.words[: one.words.index(">")] if ">" in one.words else one.words
    return [there(one, word.strip("[]")) for word in words]


def there(one: Shown, word: str) -> str:
    """What stands for a word of a line in the folder."""
    for page, part, names in IN_PLACE:
        if page in one.page and part in one.line and word in names:
            return names[word]
    for place, instead in STANDS_FOR.items():
        if word.startswith(place):
            return instead + word.removeprefix(place)
    return word


@pytest.mark.parametrize(
    "one", [one for one in SHOWN if not is_live(one)], ids=lambda one: f"{one.page} {one.line}"
)
def test_what_is_shown_runs(one: Shown, home: Path) -> None:
    if reason := not_here(one):
        pytest.skip(reason)
    folder = of_page(home, one.page)
    assert complaint(one, arranged(one), folder) == ""


@pytest.mark.timeout(1200)
def test_what_is_shown_of_a_service_runs(service: Path) -> None:
    """In one test, so that one service runs, whatever tests run beside."""
    complaints = [
        f"{one.page}: {one.line}: {wrong}"
        for one in filter(is_live, SHOWN)
        if not not_here(one) and (wrong := complaint(one, arranged(one), service))
    ]
    assert complaints == []


def not_here(one: Shown) -> str:
    """Why a line cannot be run; "" if it can."""
    return next((why for begin, why in NOT_HERE.items() if one.line.startswith(begin)), "")


def complaint(one: Shown, words: list[str], folder: Path) -> str:
    """What is wrong with a line, as it runs; "" if nothing is."""
    if one.output and "lots" in one.output:
        words = ["check", "broken.toml"]
    if "--out" in words:
        (folder / words[words.index("--out") + 1]).unlink(missing_ok=True)
    if words[0] == "run":
        shutil.rmtree(folder / "store", ignore_errors=True)
    verb = "status --watch" if "--watch" in words else words[0]
    if verb in TYPED:
        code, output = in_terminal(words, folder, TYPED[verb])
    elif verb in GOES_ON:
        code, output = until_shown(words, folder, GOES_ON[verb])
    else:
        done = run(words, folder)
        code, output = done.returncode, done.stdout
    if "nothing to acknowledge" in output and one.page == "docs/several-machines.md":
        return ""  # README has acknowledged it before
    if code != (2 if "broken.toml" in words else "refused" in (one.output or "")):
        return f"exit code {code}: {output}"
    if one.output is None or "--json" in words:
        return ""
    output = output.replace("broken.toml", "machine.toml")
    return differs(one.output, output, by_words=one.words[0] in BY_WORDS)


BY_WORDS = {"status", "alarms", "trend", "reload"}
"""Verbs whose tables depend on the hour: of these, words are compared, and titles of columns."""


def shape(line: str) -> str:
    """A line with every figure alike."""
    line = re.sub(r"(?<![A-Za-z])[-+]?\d[\d,.]*(?:e[-+]?\d+)?", "#", line.strip())
    return re.sub(r"\s+", " ", line)


def differs(shown: str, output: str, *, by_words: bool) -> str:
    """The first that a page shows and that did not come; "" if all did."""
    if by_words:
        said = {word for text, _ in texts() for word in text} | set(words_of(output))
        for line in shown.splitlines():
            if (
                line.isupper()
                and "#" not in shape(line)
                and shape(line) not in map(shape, output.splitlines())
            ):
                return line
        return next(
            (word for word in words_of(shown) if re.fullmatch("[a-z]{4,}", word) and word not in said), ""
        )
    expected = [shape(line) for line in shown.splitlines() if line.strip()]
    came = [shape(line) for line in output.splitlines() if line.strip()]
    for begin in range(len(came)):
        at, missing = begin, ""
        for number, line in enumerate(expected):
            if line == "...":
                continue
            if number and expected[number - 1] == "...":
                while at < len(came) and came[at] != line:
                    at += 1
            if at >= len(came) or not re.fullmatch(re.escape(line).replace(r"\.\.\.", ".*"), came[at]):
                missing = line
                break
            at += 1
        if not missing:
            return ""
    return f"{shown!r} is not in {output!r}"


@pytest.mark.parametrize(
    ("shown", "output", "same"),
    [
        ("a 1\n...\nb 2\n", "a 7\nx\nb 9\n", True),
        ("a 1\nb 2\n", "a 7\nx\nb 9\n", False),
        ("all is well\n", "File machine.toml\n", False),
    ],
)
def test_other_output_than_shown_is_found(shown: str, output: str, *, same: bool) -> None:
    assert (differs(shown, output, by_words=False) == "") is same


def of_page(home: Path, page: str) -> Path:
    """A folder with all that there is, for the lines of one page."""
    folder = home / re.sub(r"\W", "-", page)
    if not folder.exists():
        folder.mkdir()
        for file in home.iterdir():
            if file.suffix == ".toml":
                (folder / file.name).write_text(file.read_text().replace(f"{home}/", f"{folder}/"))
            elif file.suffix in {".npz", ".mat", ".blf", ".csv", ".mcap"} or file.name in {
                "config",
                "archive",
                "monday",
            }:
                (folder / file.name).symlink_to(file)
        (folder / "etc").mkdir()
        (folder / "etc/plant").mkdir()
        for name in ("pump", "fan"):
            shutil.copy(folder / f"{name}.toml", folder / "etc/plant")
    return folder


def until_shown(words: list[str], folder: Path, text: str) -> tuple[int, str]:
    """Start a command that goes on, and press Ctrl-C; returns the exit code, and what it showed."""
    with process(words, folder) as running:
        assert running.stdout is not None
        output = ""
        if text == SOCKET:
            until = time.monotonic() + PATIENCE_S
            while running.poll() is None and not list(folder.rglob(text)):
                assert time.monotonic() < until
                time.sleep(0.2)
        elif not text:
            with contextlib.suppress(subprocess.TimeoutExpired):
                running.wait(2.0)
        else:
            while line := running.stdout.readline():
                output += line
                if text in line:
                    break
            time.sleep(1.0)  # what it shows may be there a little before it takes signals
        if running.poll() is None:
            running.send_signal(signal.SIGINT)
        rest, _ = running.communicate(timeout=PATIENCE_S)
        return running.returncode, output + rest
