"""The process of ``daqsvc run``: how it ends, whatever hangs in it, and what it outlives."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import re
import select
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from support.examples import first_of
from support.machine_files import LAVAL
from support.ports import free_port
from support.waiting import PATIENCE_S, eventually_blocking

from daqsvc.commands import process_guard

if TYPE_CHECKING:
    from collections.abc import Iterator

    from _pytest.mark import ParameterSet

pytestmark = pytest.mark.integration
PATIENT_TURNS = 200
"""In place of two seconds, where a stop in order is looked for: this machine may have much else to do."""
HANGS_S = 240.0
"""How long the faults hang: whoever is gone long before did not wait for them."""

MAIN = """
import asyncio, os, sys, threading, time
from pathlib import Path
import daqsvc.service
from daqsvc.cli import main
from daqsvc.commands import process_guard
from daqsvc.service import LoopLag, Service

def once_ready(do):
    before = Service._until_stopped
    async def until_stopped(self, stop, first=None):
        if first is None:
            do(self)
        await before(self, stop, first)
    Service._until_stopped = until_stopped

def when_asked(hang):
    asked = Path(sys.argv[sys.argv.index("--store") + 1]).with_name("hang")
    def look():
        if asked.exists():
            asked.rename(asked.with_name("hangs"))
            hang()
        asyncio.get_running_loop().call_later(0.02, look)
    once_ready(lambda self: look())

process_guard.STOP_TURNS = {turns}
{fault}
sys.exit(main(sys.argv[1:]))
"""

FAULTS = {
    "loop": "when_asked(lambda: time.sleep(60))",
    "busy loop": "def spin():\n    while True: pass\nwhen_asked(spin)",
    "task": (
        "async def deaf(self):\n"
        "    while True:\n"
        "        try: await asyncio.sleep(1)\n"
        "        except asyncio.CancelledError: pass\n"
        "LoopLag.watch = deaf"
    ),
    "thread": (
        "forgotten = threading.Thread(target=time.sleep, args=(60,), name='forgotten')\n"
        "once_ready(lambda self: forgotten.start())"
    ),
}


def _long(name: str) -> ParameterSet:
    return pytest.param(name, marks=pytest.mark.long)


def rig(tmp_path: Path) -> Path:
    text = LAVAL.read_text().replace('interface = "socketcan"', 'interface = "virtual"')
    text = re.sub(r"^url = .*$", f'url = "mqtt://127.0.0.1:{free_port()}"', text, flags=re.MULTILINE)
    text = re.sub(r"^(ca_file|username|password_file) = .*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^\[mqtt\]", "[mqtt]\ninsecure = true", text, flags=re.MULTILINE)
    file = tmp_path / "rig.toml"
    file.write_text(text)
    return file


def command(tmp_path: Path, fault: str = "", turns: int = PATIENT_TURNS) -> list[str]:
    store = str(tmp_path / "store")
    main = MAIN.format(fault=fault, turns=turns)
    return [sys.executable, "-c", main, "run", str(rig(tmp_path)), "--store", store, "-v"]


@contextlib.contextmanager
def service(
    tmp_path: Path, fault: str = "", turns: int = PATIENT_TURNS, **options: Any
) -> Iterator[subprocess.Popen[str]]:
    """A service that is ready, with a fault in it; killed at the end if need be."""
    process = subprocess.Popen(
        command(tmp_path, fault, turns),
        stderr=subprocess.PIPE,
        text=True,
        # The tests themselves may run under nohup.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # noqa: PLW1509
        **options,
    )
    try:
        assert process.stderr is not None
        said: list[str] = []
        for line in process.stderr:
            said.append(line)
            if "watching laval-rig" in line:
                break
        else:
            pytest.fail("".join(said))
        yield process
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def let_hang(tmp_path: Path) -> None:
    """Have the event loop hang now, and not before the test has seen that the service is ready."""
    (tmp_path / "hang").touch()
    eventually_blocking((tmp_path / "hangs").exists, "the event loop hangs")


def rest_of(process: subprocess.Popen[str]) -> str:
    assert process.stderr is not None
    return process.stderr.read()


def closed(tmp_path: Path) -> bool:
    """Whether the journal was closed in order: SQLite then takes its write-ahead log away."""
    store = tmp_path / "store"
    return (store / "outbox.sqlite").exists() and not (store / "outbox.sqlite-wal").exists()


@pytest.mark.long
@pytest.mark.parametrize("hangs", ["loop", *(_long(name) for name in ("task", "busy loop", "thread"))])
def test_a_stop_is_obeyed_whatever_hangs_and_the_journal_is_closed(hangs: str, tmp_path: Path) -> None:
    with service(tmp_path, FAULTS[hangs], process_guard.STOP_TURNS) as process:
        if "loop" in hangs:
            let_hang(tmp_path)
        begun_s = time.monotonic()
        process.send_signal(signal.SIGTERM)
        said = rest_of(process)
        code = process.wait(PATIENCE_S)
        took_s = time.monotonic() - begun_s
    assert code == 4, said
    assert closed(tmp_path)
    assert took_s < HANGS_S / 4
    last = said.splitlines()[-1]
    assert (
        "forgotten" in last if hangs == "thread" else "the service did not stop in time and is ended" in last
    )
    assert "Traceback" not in said


@pytest.mark.long
def test_the_guard_and_the_log_outlive_what_kills_their_threads(tmp_path: Path) -> None:
    fault = (
        "import ctypes\n"
        "def kill(self):\n"
        "    for t in threading.enumerate():\n"
        "        if t.name in ('process guard', 'log'):\n"
        "            error = ctypes.py_object(SystemExit)\n"
        "            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(t.ident), error)\n"
        "once_ready(kill)"
    )
    with service(tmp_path, fault) as process:
        process.send_signal(signal.SIGHUP)
        assert process.stderr is not None
        until_said = iter(process.stderr.readline, "")
        assert any("SIGHUP" in line for line in until_said), "the signal is heard, and said"
        process.send_signal(signal.SIGTERM)
        said = rest_of(process)
        assert process.wait(PATIENCE_S) == 0, said
    assert said.splitlines()[-1].endswith("stopped")


@pytest.mark.long
def test_a_call_that_hangs_in_a_thread_does_not_delay_the_end(tmp_path: Path) -> None:
    fault = (
        "from daqsvc.self_check import SelfCheck\nSelfCheck.free_bytes = lambda self: time.sleep(60)\n"
        "once_ready(lambda self: asyncio.ensure_future(asyncio.to_thread(time.sleep, 60)))"
    )
    with service(tmp_path, fault) as process:
        process.send_signal(signal.SIGTERM)
        said = rest_of(process)
        assert process.wait(PATIENCE_S) == 0, said
    assert closed(tmp_path)


@pytest.mark.long
def test_an_event_loop_that_stands_still_ends_the_process(tmp_path: Path) -> None:
    with service(tmp_path, f"process_guard.STUCK_TURNS = 10\n{FAULTS['loop']}") as process:
        let_hang(tmp_path)
        said = rest_of(process)
        assert process.wait(PATIENCE_S) == 5, said
    assert "the event loop has been blocked for 1 s: the event loop is in " in said
    assert closed(tmp_path)


@pytest.mark.long
def test_a_process_that_was_suspended_goes_on(tmp_path: Path) -> None:
    with service(tmp_path, "process_guard.STUCK_TURNS = 10") as process:
        process.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        process.send_signal(signal.SIGCONT)
        time.sleep(0.5)
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


LOSSES = {
    "no alarm can reach the disk any more; the service ends, and must be started again": (
        "import ctypes\n"
        "def kill(self):\n"
        "    writer = next(t for t in threading.enumerate() if t.name == 'outbox-writer')\n"
        "    error = ctypes.py_object(SystemExit)\n"
        "    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(writer.ident), error)\n"
        "once_ready(kill)"
    ),
    "the service was ended by something in its process, and must be started again": (
        "before = Service._until_stopped\n"
        "async def leave(self, stop, first=None):\n"
        "    if first is None: await asyncio.sleep(0.5); sys.exit(0)\n"
        "    await before(self, stop, first)\n"
        "Service._until_stopped = leave"
    ),
    "the service was cancelled by something in its process, and must be started again": (
        "def cancel(self):\n"
        "    next(t for t in asyncio.all_tasks() if t.get_name() == 'service').cancel()\n"
        "once_ready(cancel)"
    ),
}


@pytest.mark.long
def test_a_store_of_a_newer_version_is_refused_for_good(tmp_path: Path) -> None:
    store = tmp_path / "store"
    store.mkdir(mode=0o700)
    with contextlib.closing(sqlite3.connect(store / "outbox.sqlite")) as newer:
        newer.execute("PRAGMA user_version = 99")
    (store / "outbox.sqlite.version").write_text("9.9.0\n")
    done = subprocess.run(command(tmp_path), capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 2, "systemd would start it again and again"
    assert "written by daqsvc 9.9.0" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.long
@pytest.mark.parametrize("why", first_of(*LOSSES))
def test_what_cannot_be_started_again_ends_the_process_with_its_own_code(why: str, tmp_path: Path) -> None:
    with service(tmp_path, LOSSES[why]) as process:
        said = rest_of(process)
        assert process.wait(PATIENCE_S) == 3, said
    assert re.search(rf"{re.escape(why)} \[S\d\d\]$", said), said


@pytest.mark.long
def test_a_task_of_a_plugin_that_exits_ends_nothing(tmp_path: Path) -> None:
    fault = "async def leave(): sys.exit(0)\nwhen_asked(lambda: asyncio.create_task(leave()))"
    with service(tmp_path, fault) as process:
        let_hang(tmp_path)
        assert process.stderr is not None
        until_said = iter(process.stderr.readline, "")
        assert any(
            "a task would have ended the process: failed with SystemExit: 0" in line for line in until_said
        )
        process.send_signal(signal.SIGTERM)
        said = rest_of(process)
        assert process.wait(PATIENCE_S) == 0, said
    assert closed(tmp_path)


@pytest.mark.long
def test_signals_that_do_not_stop_the_service_are_said(tmp_path: Path) -> None:
    with service(tmp_path) as process:
        for _ in range(2):
            process.send_signal(signal.SIGHUP)
            assert process.stderr is not None
            until_said = iter(process.stderr.readline, "")
            assert any("SIGHUP: the machine files have not changed" in line for line in until_said)
        for number in (signal.SIGUSR1, signal.SIGUSR2):
            process.send_signal(number)
            assert process.stderr is not None
            until_said = iter(process.stderr.readline, "")
            assert any(f"{number.name} is ignored" in line for line in until_said)
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    assert closed(tmp_path)


@contextlib.contextmanager
def on_a_terminal(tmp_path: Path, *, nohup: bool = False) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """A service that has a terminal of its own, and the other end of that."""
    master, slave = pty.openpty()

    def take_terminal() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)
        signal.signal(signal.SIGHUP, signal.SIG_IGN if nohup else signal.SIG_DFL)

    process = subprocess.Popen(
        command(tmp_path),
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        preexec_fn=take_terminal,  # noqa: PLW1509 - nothing else makes a terminal the controlling one
    )
    os.close(slave)
    try:
        seen = b""
        while b"watching laval-rig" not in seen:
            assert select.select([master], [], [], PATIENCE_S)[0], seen
            seen += os.read(master, 4096)
        yield process, master
    finally:
        process.kill()
        process.wait()


@pytest.mark.long
def test_a_terminal_that_goes_away_stops_the_service_in_order(tmp_path: Path) -> None:
    with on_a_terminal(tmp_path) as (process, master):
        os.close(master)
        assert process.wait(PATIENCE_S) == 0
    assert closed(tmp_path)


@pytest.mark.long
def test_a_service_that_is_to_outlive_its_terminal_does(tmp_path: Path) -> None:
    with on_a_terminal(tmp_path, nohup=True) as (process, master):
        os.close(master)
        time.sleep(2.0)
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    assert closed(tmp_path)


@pytest.mark.long
def test_a_log_that_nobody_reads_any_more_stops_the_service_in_order(tmp_path: Path) -> None:
    with service(tmp_path) as process:
        assert process.stderr is not None
        process.stderr.close()
        process.send_signal(signal.SIGHUP)  # has something said
        assert process.wait(PATIENCE_S) == 0
    assert closed(tmp_path)


@pytest.mark.long
def test_under_systemd_the_restart_of_its_journal_stops_nothing(tmp_path: Path) -> None:
    with service(tmp_path, env=os.environ | {"JOURNAL_STREAM": "8:1"}) as process:
        assert process.stderr is not None
        process.stderr.close()
        process.send_signal(signal.SIGHUP)
        time.sleep(1.0)
        assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0


FAILURES = {
    # As a file system does that finds itself damaged.
    "Read-only file system": lambda device, _: Path(f"/sys/fs/ext4/{device}/trigger_fs_error").write_text(
        "1"
    ),
    # As a disk does that is gone.
    "Input/output error": lambda _, store: _shut_down(store),
}
EXT4_IOC_SHUTDOWN = 0x8004587D


def _shut_down(store: Path) -> None:
    at = os.open(store, os.O_RDONLY)
    try:
        fcntl.ioctl(at, EXT4_IOC_SHUTDOWN, struct.pack("I", 2))  # without a last sync
    finally:
        os.close(at)


@contextlib.contextmanager
def disk_of_its_own(tmp_path: Path) -> Iterator[tuple[Path, str]]:
    """A store on a file system of its own, and the name of its device; skips where there can be none."""
    store, image = tmp_path / "store", tmp_path / "image"
    store.mkdir()
    with image.open("wb") as file:
        file.truncate(64 << 20)
    for step in (["mkfs.ext4", "-q", image], ["mount", "-o", "loop,errors=remount-ro", image, store]):
        if os.geteuid() != 0 or shutil.which(str(step[0])) is None:
            pytest.skip("this account may not mount a file system")
        if subprocess.run(step, capture_output=True, check=False).returncode != 0:
            pytest.skip("this machine does not let a file be mounted")
    try:
        store.chmod(0o700)
        device = subprocess.run(
            ["findmnt", "-n", "-o", "SOURCE", store], capture_output=True, text=True, check=True
        )
        yield store, Path(device.stdout.strip()).name
    finally:
        subprocess.run(["umount", "--lazy", store], check=True)


@pytest.mark.long
@pytest.mark.parametrize("failure", ["Read-only file system", _long("Input/output error")])
def test_a_store_that_fails_does_not_spoil_the_end(failure: str, tmp_path: Path) -> None:
    with disk_of_its_own(tmp_path) as (store, device), service(tmp_path) as process:
        FAILURES[failure](device, store)
        time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
        said = rest_of(process)
        assert process.wait(PATIENCE_S) == 0, said
    assert "Traceback" not in said
    (left,) = [line for line in said.splitlines() if "control.sock" in line]
    # A disk that takes long to say so, as on a busy machine, is not waited for.
    late = left.endswith("s and is left behind [S12]")
    assert late or left.endswith(f"is left behind, where the next start replaces it: {failure} [S12]"), left
    assert said.splitlines()[-1].endswith("stopped")
