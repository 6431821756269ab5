"""Every `daqsvc` line of the pages is run in a folder that has what the page names, and shows what is shown.

docs/tutorials has a reader of its own (tests/tutorials). Other programs: test_shown_programs.py.
"""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from project.test_quoted_messages import is_said
from support.page_folder import ACCOUNTS, CALIBRATED_LIVE, HEALTHY_PUMP, MEASURED, copy, fill
from support.paths import ROOT
from support.ports import free_port
from support.shown_devices import READY
from support.shown_lines import Shown, shown_lines
from support.shown_output import differs
from support.shown_tables import unlike
from support.sim_processes import process
from support.snippets import documented
from support.waiting import PATIENCE_S, eventually_blocking

from daqsvc.acquisition.samples import SampleBlock
from daqsvc.confined.limits import ResourceLimits
from daqsvc.snapshots.reading import read_snapshot

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

pytestmark = [pytest.mark.integration, pytest.mark.long, pytest.mark.timeout(1200)]
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT}", "COLUMNS": "80"}
AT = re.compile(r"https?://[^;\s]+")
SAYS = {"page": "Ctrl-C ends it", "sim": "playing", "status --watch": "BUS"}
"""Verbs that go on until Ctrl-C, and what they say when they have begun."""
MAKES = {"run": "control.sock", "record": "run-up.blf"}
"""Others, and what they then have made."""
TYPED = {
    "new": {},
    "new --listen": {"What do the samples come over?": "serial", "Which serial port?": "/dev/ttyUSB0"},
    "account": {"": "a long password"},
}
"""Verbs that ask, and what is typed, by words of the question; Enter alone for all others."""
MOST_QUESTIONS = 60
NOT_HERE = {
    "daqsvc sniff can ": "tests/hil/test_vcan_shown.py::test_what_docs_sniff_shows_of_can_runs",
}
"""How lines begin that need what this computer may not have, and the test that runs them where it is."""
STANDS_FOR = {
    f"/etc/daqsvc/{ACCOUNTS}": ACCOUNTS,
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
    # The lines below it go on with the file of the line before.
    ("README.md", "--live", {"machine.toml": CALIBRATED_LIVE, "pump.toml": "live.toml"}),
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
    ("docs/calibration.md", "--live", {"MACHINE.toml": CALIBRATED_LIVE, "FILE": "live.toml"}),
    ("docs/calibration.md", "", {"MACHINE.toml": "orbit.toml", "RECORDING...": "run-up.blf"}),
    ("docs/export.md", "blf", {"machine.toml": "orbit.toml"}),
    ("docs/order-change.md", "", {"TODAY.csv": "axes.npz", "HEALTHY.csv": "axes.npz"}),
    ("docs/virtual-bus.md", "", {"config/machines/virtual-rig.toml": "machine.toml"}),
    ("", "", {"RECORDING...": "run.npz", "MACHINE.toml": "machine.toml", "FILE": "out.toml"}),
]
"""By page and a part of the line: files that are there under another name."""
SHOWN = shown_lines()
LIVE = {"status", "alarms", "ack", "reset", "reload", "snapshot", "trend", "record"}
OF_THE_HOUR = {"status", "alarms", "trend", "reload"}
"""Verbs whose tables depend on the hour: see support/shown_tables.py."""
OTHER_FIGURES = {
    "daqsvc sniff serial ": "counts what has come in some seconds",
}
"""How lines begin of whose output only words are compared, and why; see also `has_its_recordings`."""


def is_live(one: Shown) -> bool:
    """Whether a line needs a service that runs, or what it has recorded."""
    of_service = one.words[0] == "page" and "--plant" not in one.words
    return one.words[0] in LIVE or of_service or any("alarm.mcap" in word for word in one.words)


def has_its_recordings(one: Shown) -> bool:
    """Whether the recordings of a line are those of the page; else others are in the folder."""
    return MEASURED is not None or not re.search(r"\b\d+\.mat\b", f"{one.line} {one.output}")


def pages(lines: Sequence[Shown]) -> list[str]:
    return [*dict.fromkeys(one.page for one in lines)]


@pytest.fixture(scope="module")
def home() -> Iterator[Path]:
    """A folder with all that the lines name; each test has a copy beside it."""
    made = Path(tempfile.mkdtemp(prefix="pages-"))  # a short path, as sockets lie in it
    (made / "all").mkdir()
    fill(made / "all")
    yield made / "all"
    shutil.rmtree(made)


@pytest.mark.parametrize("page", pages([one for one in SHOWN if not is_live(one)]))
def test_what_a_page_shows_runs(page: str, home: Path, subtests: pytest.Subtests) -> None:
    """One line after the other, as some need what one before has made."""
    folder = home.with_name(re.sub(r"\W", "-", page))
    copy(home, folder)
    lines = [one for one in SHOWN if one.page == page and not is_live(one)]
    assert not (found := complaints(lines, folder)), "\n".join(found)
    for one in lines:
        if one.output and not has_its_recordings(one):
            with subtests.test("figures", line=one.line):
                pytest.skip("only words were compared: set DAQSVC_DATA to where the recordings are")


def test_what_is_shown_of_a_service_runs(home: Path) -> None:
    """In one test, so that one service runs, whatever tests run beside: two machines, and their sensors."""
    folder = home.with_name("service")
    copy(home, folder)
    assert run(["check", "etc/plant"], folder).returncode == 0
    with contextlib.ExitStack() as running:
        for words in (
            ["run", "etc/plant"],
            ["sim", "etc/plant/pump.toml", "--duration", "900"],
            ["sim", "etc/plant/fan.toml", "--scenario", "healthy", "--duration", "900"],
        ):
            running.enter_context(beside(words, folder))
        until = time.monotonic() + 3 * PATIENCE_S
        while (said := run(["alarms", "pump.toml"], folder)) and "rotor-fault" not in said.stdout:
            assert time.monotonic() < until, said
            time.sleep(1.0)
        shelved = ["shelve", "shaft-vibration-x", "--for", "8h", "--by", "ann", "pump.toml"]
        shelved += ["--reason", "probe bracket is loose"]
        assert run(shelved, folder).returncode == 0
        live = [one for one in SHOWN if is_live(one)]
        heard: list[str] = []
        found = complaints(live, folder, heard)
        found += refusals(folder / "store" / "control.sock")
    for one in filter(of_the_hour, live):
        if wrong := unlike(one.output or "", "\n".join(heard), is_said):
            found.append(f"{one.page}: {one.line}: {wrong!r} is nowhere")
    assert not found, "\n".join(found)


def test_lines_that_are_not_run_here_are_run_there() -> None:
    for begin, place in NOT_HERE.items():
        file, _, name = place.partition("::")
        assert [one for one in SHOWN if one.line.startswith(begin)], begin
        assert f"\ndef {name}(" in (ROOT / file).read_text("utf-8")


def refusals(control: Path) -> list[str]:
    """The lines that the pages show for the control socket, and that the service does not accept."""
    found = []
    for block in documented():
        if block.language == "json" and '"daqsvc.control/1"' in block.text:
            for line in filter(lambda line: '"daqsvc.control/1"' in line, block.text.splitlines()):
                answer = answered(control, line)
                if answer.get("accepted") is False and "machine" not in line:
                    # The page has one machine.
                    answer = answered(control, json.dumps({**json.loads(line), "machine": "pump"}))
                if answer.get("accepted") is False:
                    found.append(f"{block.name}: {line}: {answer}")
    return found


def answered(control: Path, line: str) -> dict[str, Any]:
    """The first line that a service answers."""
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(PATIENCE_S)
        client.connect(f"{control}")
        client.sendall(f"{line}\n".encode())
        with client.makefile() as lines:
            answer: dict[str, Any] = json.loads(lines.readline())
    return answer


def of_the_hour(one: Shown) -> bool:
    """Whether a line shows a table that is compared with all that were heard."""
    return one.words[0] in OF_THE_HOUR and one.output is not None


def complaints(lines: Sequence[Shown], folder: Path, heard: list[str] | None = None) -> list[str]:
    """What is wrong with lines, run one after the other; `heard` gets what `OF_THE_HOUR` have shown."""
    return [
        f"{one.page}: {one.line}: {wrong}"
        for one in lines
        if not one.line.startswith(tuple(NOT_HERE)) and (wrong := complaint(one, folder, heard))
    ]


def complaint(one: Shown, folder: Path, heard: list[str] | None) -> str:
    """What is wrong with a line, as it runs; "" if nothing is."""
    words = arranged(one)
    if one.output and "lots" in one.output:
        words = ["check", "broken.toml"]
    if "--out" in words:
        (folder / words[words.index("--out") + 1]).unlink(missing_ok=True)
    if words[0] == "run":
        shutil.rmtree(folder / "store", ignore_errors=True)
    with surroundings(one, folder) as instead:
        code, output = done([put_in(word, instead) for word in words], folder, instead)
    for place, what in instead.items():
        output = output.replace(what, place) if place.startswith("/") else of_device(output, place, what)
    output = output.replace("broken.toml", "machine.toml").replace(f"{folder}/store", "/var/lib/daqsvc/pump")
    if "nothing to acknowledge" in output and one.page == "docs/several-machines.md":
        return ""  # README has acknowledged it before
    if code != (2 if "broken.toml" in words else "refused" in (one.output or "")):
        return f"exit code {code}: {output}"
    if words == ["new", "--listen"] and "Found, and proposed below" not in output:
        return f"it has not heard the device: {output}"
    if one.words[0] in OF_THE_HOUR and heard is not None:
        heard.append(output)
        return ""
    figures = has_its_recordings(one) and not one.line.startswith(tuple(OTHER_FIGURES))
    return differs(one.output or "", output, figures=figures)


def of_device(output: str, host: str, there: str) -> str:
    """An output with the address of a page, and its port, instead of those of the device that is here."""
    here, _, port = there.partition(":")
    for found, shown in (
        (there, f"{host}:502"),
        (f'host = "{here}"', f'host = "{host}"'),
        (f"tcp_port = {port}", "tcp_port = 502"),
    ):
        output = output.replace(found, shown)
    return output


def arranged(one: Shown) -> list[str]:
    """The words of a line, as they are run in the folder: without what goes into a file."""
    words = one.words[: one.words.index(">")] if ">" in one.words else one.words
    return [there(one, word.strip("[]")) for word in words]


def there(one: Shown, word: str) -> str:
    """What stands for a word of a line in the folder."""
    for page, part, names in IN_PLACE:
        if page in one.page and part in one.line and word in names:
            return names[word]
    return put_in(word, STANDS_FOR)


def put_in(word: str, instead: Mapping[str, str]) -> str:
    """A word with what stands for its begin."""
    for place, what in instead.items():
        if word.startswith(place):
            return what + word.removeprefix(place)
    return word


@contextlib.contextmanager
def surroundings(one: Shown, folder: Path) -> Iterator[dict[str, str]]:
    """What a line needs besides files, for as long as it runs; and by words of the line, what is there."""
    verb = one.words[0]
    with contextlib.ExitStack() as running:
        if verb == "new":
            shutil.rmtree(folder / "new", ignore_errors=True)
            (folder / "new").mkdir()  # it would ask whether to write over a file
        if verb == "sniff" or "--listen" in one.words[:2]:
            link, port = folder / "new/ttyUSB0" if verb == "new" else folder / "ttyUSB0", free_port()
            running.enter_context(devices(link, port))
            yield {"/dev/ttyUSB0": f"{link}", "192.0.2.10": f"127.0.0.1:{port}"}
        elif "--live" in one.words:
            sim = running.enter_context(beside(["sim", CALIBRATED_LIVE, "--scenario", HEALTHY_PUMP], folder))
            until_line(sim, "playing")
            yield {}
        elif verb == "reload":
            running.enter_context(changed(folder / "etc/plant/pump.toml", "_unit = 7.87", "_unit = 8.0"))
            yield {}
        elif "alarm.mcap" in one.line:
            yield {next(word for word in one.words if "alarm.mcap" in word): f"{snapshot(folder)}"}
        else:
            yield {}


@contextlib.contextmanager
def changed(file: Path, old: str, new: str) -> Iterator[None]:
    """A file in which the first of some words are others, for as long as this lasts."""
    text = file.read_text()
    file.write_text(text.replace(old, new, 1))
    try:
        yield
    finally:
        file.write_text(text)


@contextlib.contextmanager
def devices(link: Path, port: int) -> Iterator[None]:
    """A serial device behind a link, and a Modbus server at a port."""
    command = [sys.executable, "-m", "support.shown_devices", f"{link}", f"{port}"]
    environment = {**ENVIRONMENT, "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        try:
            assert running.stdout.readline().strip() == READY
            yield
        finally:
            running.kill()


def snapshot(folder: Path) -> Path:
    """A snapshot around an alarm, as soon as one is finished; beside it one by another name."""
    made: list[Path] = []

    def there_is_one() -> bool:
        made[:] = filter(has_samples, (folder / "store").rglob("*-alarm.mcap"))
        return bool(made)

    eventually_blocking(there_is_one, "there is a snapshot with samples")
    shutil.copy(made[0], folder / "healthy.mcap")
    return made[0]


def has_samples(file: Path) -> bool:
    """Whether a snapshot is finished, and not of an alarm from before the first sample."""
    if not file.read_bytes().endswith(b"\x89MCAP0\r\n"):
        return False
    return any(isinstance(entry.what, SampleBlock) for entry in read_snapshot(file, ResourceLimits()).entries)


def done(words: list[str], folder: Path, instead: Mapping[str, str]) -> tuple[int, str]:
    """The exit code of a command, and what it has shown; one that goes on is ended by Ctrl-C."""
    option = next((option for option in ("--watch", "--listen") if option in words), "")
    verb = f"{words[0]} {option}" if f"{words[0]} {option}" in {*TYPED, *SAYS} else words[0]
    if verb in TYPED:
        typed = {question: put_in(answer, instead) for question, answer in TYPED[verb].items()}
        return in_terminal(words, folder / "new" if words[0] == "new" else folder, typed)
    if verb == "page":
        return page(words, folder)
    if verb in SAYS or verb in MAKES:
        return goes_on(words, folder, verb)
    ended = run(words, folder)
    return ended.returncode, ended.stdout


def run(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """A command that ends by itself."""
    return subprocess.run(
        [sys.executable, "-m", "daqsvc", *words],
        cwd=folder, env=ENVIRONMENT, text=True, check=False, timeout=PATIENCE_S,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


def beside(words: list[str], folder: Path) -> contextlib.AbstractContextManager[subprocess.Popen[str]]:
    """A command that goes on; what it says on stderr is with the rest."""
    return process(*words, cwd=folder, env=ENVIRONMENT, stdin=subprocess.DEVNULL, stderr=subprocess.STDOUT)


def until_line(running: subprocess.Popen[str], text: str) -> str:
    """All that a command shows, up to the line with a text, or up to its end."""
    assert running.stdout is not None
    output = ""
    while line := running.stdout.readline():
        output += line
        if text in line:
            break
    return output


def interrupted(running: subprocess.Popen[str], output: str) -> tuple[int, str]:
    """Press Ctrl-C; returns the exit code, and all that came."""
    if running.poll() is None:
        running.send_signal(signal.SIGINT)
    rest, _ = running.communicate(timeout=PATIENCE_S)
    return running.returncode, output + rest


def goes_on(words: list[str], folder: Path, verb: str) -> tuple[int, str]:
    """Start a command that goes on, and press Ctrl-C when it has begun."""
    with beside(words, folder) as running:
        if verb in SAYS:
            return interrupted(running, until_line(running, SAYS[verb]))

        def has_begun() -> bool:
            made = [file for file in folder.rglob(MAKES[verb]) if file.is_socket() or file.stat().st_size]
            return bool(made) or running.poll() is not None

        eventually_blocking(has_begun, f"{verb} has made {MAKES[verb]}")
        return interrupted(running, "")


def page(words: list[str], folder: Path) -> tuple[int, str]:
    """Start the page at a free port, open it, and press Ctrl-C."""
    port = f"{free_port()}"
    if "--listen" in words:
        words = [word.replace("192.0.2.7:8420", f"127.0.0.1:{port}") for word in words]
    else:
        words = [*words, "--port", port]
    with beside(words, folder) as running:
        output = until_line(running, SAYS["page"])
        if (at := AT.search(output)) is not None:
            assert ("/sign-in" in opened(at[0], folder / "box7.pem")) == ("--accounts" in words)
        code, output = interrupted(running, output)
        return code, output.replace(f":{port}/", ":8420/")


def opened(address: str, certificate: Path) -> str:
    """The address of what a browser gets at one; it trusts a certificate."""
    trust = ssl.create_default_context(cafile=certificate) if address.startswith("https:") else None
    asked = urllib.request.Request(address, headers={"Accept": "text/html"})  # noqa: S310 - of HTTP
    with urllib.request.urlopen(asked, timeout=PATIENCE_S, context=trust) as answer:  # noqa: S310
        assert "</html>" in answer.read().decode()
        return str(answer.url)


def in_terminal(words: list[str], folder: Path, typed: Mapping[str, str]) -> tuple[int, str]:
    """A command that asks."""
    leader, follower = pty.openpty()
    running = subprocess.Popen(
        [sys.executable, "-m", "daqsvc", *words],
        cwd=folder, env=ENVIRONMENT, stdin=follower, stdout=follower, stderr=follower, start_new_session=True,
    )  # fmt: skip
    os.close(follower)
    shown = [""]
    while len(shown) < MOST_QUESTIONS:
        try:
            shown[-1] += os.read(leader, 65_536).decode()
        except OSError:  # it has ended
            break
        if shown[-1].endswith(": "):
            answer = next((answer for question, answer in typed.items() if question in shown[-1]), "")
            os.write(leader, f"{answer}\n".encode())
            shown.append("")
    os.close(leader)
    return running.wait(PATIENCE_S), "".join(shown)
