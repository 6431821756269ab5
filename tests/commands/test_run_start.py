"""What `daqsvc run` does once the service is ready."""

from __future__ import annotations

import asyncio
import gc
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest
from support.can_gateway import MACHINE, CanGateway, daqsvc_run
from support.notify_sockets import NotifySocket
from support.ports import free_port
from support.waiting import eventually

import daqsvc.service
from daqsvc.commands import early_signals, run
from daqsvc.commands.process_guard import ProcessGuard
from daqsvc.commands.service_manager import ServiceManager
from daqsvc.control import ReloadRefusedError, ReloadTooLateError
from daqsvc.outbox.files import is_possessed
from daqsvc.supervision import Supervisor


async def test_what_the_start_has_made_is_not_looked_through_for_garbage_again(monkeypatch, tmp_path):
    frozen = []

    class Service:
        def __init__(self, *_, **__):
            self.ready = asyncio.Event()
            self.alarms = SimpleNamespace(outbox=SimpleNamespace(close_from_outside=None))
            self.supervisor = Supervisor()
            self.streams = {}
            self.made = [[] for _ in range(2000)]

        async def run(self, stop):
            frozen.append(gc.get_freeze_count())
            self.ready.set()
            while gc.get_freeze_count() == frozen[0] and not stop.is_set():
                await asyncio.sleep(0)
            frozen.append(gc.get_freeze_count())

    monkeypatch.setattr(daqsvc.service, "Service", Service)
    reloads = []
    guard = SimpleNamespace(
        stopping=None,
        protect=lambda _: None,
        stop_by=lambda *_: None,
        expect_turns=lambda _: None,
        reload_by=reloads.append,
    )
    box = SimpleNamespace(names="rig", machines={})
    try:
        await asyncio.wait_for(run._run_until_stopped(box, [], tmp_path, guard, ServiceManager()), 10.0)
    finally:
        gc.unfreeze()
    assert frozen[1] > frozen[0] + 1000
    assert len(reloads) == 1, "SIGHUP is obeyed when the service is ready"


@pytest.mark.long
@pytest.mark.parametrize("journal", ["", "1:2"])
async def test_without_v_a_person_sees_that_it_watches_and_that_samples_come(journal, monkeypatch, tmp_path):
    if journal:
        monkeypatch.setenv("JOURNAL_STREAM", journal)
    log = tmp_path / "log"
    async with CanGateway() as gateway:
        file = tmp_path / "motor.toml"
        text = MACHINE.format(gateway=gateway.port, broker=free_port(), alarms="").partition("[mqtt]")[0]
        file.write_text(text)
        async with daqsvc_run(file, tmp_path / "store", "--store", f"{tmp_path}/store"):
            await eventually(lambda: "samples come" in log.read_text(), "samples come")
    said = [line.partition("INFO ")[2] for line in log.read_text().splitlines()]
    assert said == [
        f"watching motor; the journal is in {tmp_path}/store",
        "samples come from all streams: shaking",
    ], "and nothing else is said while all is well"


async def test_however_often_sighup_comes_meanwhile_the_files_are_read_once_more(caplog):
    """A queue of them would hold up whoever reloads next, and the event loop."""
    may_go_on, reloads = asyncio.Event(), []

    async def reload():
        reloads.append(True)
        await may_go_on.wait()
        return []

    reloader = run._Reloader(SimpleNamespace(supervisor=Supervisor(), reload=reload))
    for _ in range(1000):
        reloader.ask()
        await asyncio.sleep(0)
    assert len(reloads) == 1
    may_go_on.set()
    await reloader.part.over
    assert len(reloads) == 2
    reloader.ask()
    await reloader.part.over
    assert len(reloads) == 3
    assert caplog.text.count("SIGHUP: the machine files have not changed") == 3


async def test_a_hang_up_while_the_service_starts_is_obeyed_once_when_it_is_ready(caplog):
    """The machine files may have changed since they were read."""
    reloads = []
    guard = ProcessGuard()
    guard._terminals = []
    with guard:
        guard.stop_by(asyncio.get_running_loop(), lambda: None)
        for _ in range(3):
            guard._hear(signal.SIGHUP)
        assert reloads == []
        guard.reload_by(lambda: reloads.append("at once"))
        assert reloads == ["at once"]
        guard._hear(signal.SIGHUP)
        await eventually(lambda: len(reloads) == 2, "it is obeyed as ever")
    said = "SIGHUP: the service starts; it reads its machine files again when it is ready"
    assert [record.getMessage() for record in caplog.records] == [said]


def test_systemd_is_asked_for_time_before_anything_that_takes_long(monkeypatch, tmp_path):
    """Kernels compile for minutes on a small box, and its TimeoutStartSec is one minute."""
    with NotifySocket(tmp_path) as systemd:
        monkeypatch.setenv("NOTIFY_SOCKET", systemd.address)
        told = []

        def load_box(*_):
            told.append(systemd.next())

        monkeypatch.setattr(run, "load_box", load_box)
        monkeypatch.setattr(run, "LogThread", lambda _: SimpleNamespace(flush_within=lambda _: None))
        command = run.RunCommand(lambda _: None, lambda **_: None)
        assert command.run(SimpleNamespace(files=[], store=None, verbose=False)) == 2
    assert "EXTEND_TIMEOUT_USEC" in told[0]
    assert told[0]["STATUS"].startswith("starting: ")


def test_a_hang_up_that_comes_before_the_service_has_its_handlers_ends_nothing():
    before = signal.getsignal(signal.SIGHUP)
    try:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        early_signals.ignore_until_heard(["check", "machine.toml"])
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL
        early_signals.ignore_until_heard(["run", "machine.toml"])
        signal.raise_signal(signal.SIGHUP)
        assert early_signals.take_hang_up()
        # Whoever has asked for it (nohup) keeps a service that outlives its terminal.
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        early_signals.ignore_until_heard(["run", "machine.toml"])
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


async def test_a_hang_up_after_the_machine_files_were_read_is_obeyed_when_the_service_is_ready(caplog):
    """The guard does not hear signals yet then, and what was read may be old."""
    before = signal.getsignal(signal.SIGHUP)
    early_signals.take_hang_up()
    reloads = []
    try:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        early_signals.ignore_until_heard(["run", "machine.toml"])
        signal.raise_signal(signal.SIGHUP)
        for number in (1, 0):
            guard = ProcessGuard()
            guard._terminals = []
            with guard:
                guard.stop_by(asyncio.get_running_loop(), lambda: None)
                guard.reload_by(lambda: reloads.append(True))
                assert len(reloads) == number, "once"
            reloads.clear()
    finally:
        signal.signal(signal.SIGHUP, before)
    said = "SIGHUP: the service starts; it reads its machine files again when it is ready"
    assert [record.getMessage() for record in caplog.records] == [said]


def test_the_store_is_held_while_the_service_is_made(monkeypatch, tmp_path):
    """Which may compile kernels for minutes: who asks is told that a service starts."""
    held = []

    class Service:
        def __init__(self, *_, **__):
            held.append(is_possessed(tmp_path / "store" / "outbox.sqlite.lock"))
            self.ready = asyncio.Event()
            self.alarms = SimpleNamespace(outbox=SimpleNamespace(close_from_outside=None))
            self.supervisor = Supervisor()
            self.streams = {}

        async def run(self, stop):
            # It takes possession itself.
            held.append(is_possessed(tmp_path / "store" / "outbox.sqlite.lock"))

    monkeypatch.setattr(daqsvc.service, "Service", Service)
    guard = SimpleNamespace(stopping=None, protect=lambda _: None, stop_by=lambda *_: None)
    box = SimpleNamespace(names="rig", machines={})
    assert run._run(box, [], tmp_path / "store", guard, ServiceManager()) == 0
    assert held == [True, False]


@pytest.mark.gives("S16")
async def test_a_hang_up_that_is_refused_is_an_error_for_each_reason(caplog):
    async def reload():
        raise ReloadRefusedError(["rig.toml:3: box: restart the service [S01]", "it is odd"])

    reloader = run._Reloader(SimpleNamespace(supervisor=Supervisor(), reload=reload))
    reloader.ask()
    await reloader.part.over
    refused = "SIGHUP is refused, and the service goes on as before: "
    assert caplog.messages == [
        f"{refused}rig.toml:3: box: restart the service [S01]",
        f"{refused}it is odd [S16]",
    ]


async def test_a_hang_up_right_before_the_end_is_no_error(caplog):
    async def reload():
        raise ReloadTooLateError

    reloader = run._Reloader(SimpleNamespace(supervisor=Supervisor(), reload=reload))
    reloader.ask()
    await reloader.part.over
    assert caplog.text == ""


IMPORTING = """
import signal, sys
sys.argv = {argv!r}
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "daqsvc.commands.alarms":
            signal.raise_signal({number})
sys.meta_path.insert(0, Finder())
import daqsvc.cli
daqsvc.cli.early_signals.imported()
print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""


@pytest.mark.parametrize(
    ("argv", "number", "code", "out"),
    [
        (["/usr/bin/daqsvc", "run", "m.toml"], signal.SIGINT, 130, ""),
        (["/x/daqsvc/__main__.py", "status"], signal.SIGINT, 130, ""),
        (["daqsvc", "run", "m.toml"], signal.SIGHUP, 0, "True\n"),
        (["daqsvc", "status"], signal.SIGHUP, -signal.SIGHUP, ""),
    ],
)
def test_signals_while_the_program_is_imported_are_no_tracebacks(argv, number, code, out):
    script = IMPORTING.format(argv=argv, number=int(number))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (code, out, "")


def test_what_is_not_the_program_keeps_its_signals(monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    early_signals.begin(["/usr/bin/pytest", "run"])
    early_signals.begin(["/usr/bin/daqsvc-sim", "run"])
    # A worker that verbs begin.
    monkeypatch.setitem(sys.modules, "multiprocessing", sys)
    early_signals.begin(["/usr/bin/daqsvc", "run"])
    assert signal.getsignal(signal.SIGINT) is before
