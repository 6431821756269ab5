"""What `daqsvc run` does once the service is ready."""

from __future__ import annotations

import asyncio
import gc
import signal
from types import SimpleNamespace

import daqsvc.service
from daqsvc import cli
from daqsvc.commands import run
from daqsvc.commands.service_manager import ServiceManager
from daqsvc.supervision import Supervisor


async def test_what_the_start_has_made_is_not_looked_through_for_garbage_again(monkeypatch, tmp_path):
    frozen = []

    class Service:
        def __init__(self, *_, **__):
            self.ready = asyncio.Event()
            self.alarms = SimpleNamespace(outbox=SimpleNamespace(close_from_outside=None))
            self.supervisor = Supervisor()

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
    box = SimpleNamespace(names="rig")
    try:
        await asyncio.wait_for(run._run_until_stopped(box, [], tmp_path, guard, ServiceManager()), 10.0)
    finally:
        gc.unfreeze()
    assert frozen[1] > frozen[0] + 1000
    assert len(reloads) == 1, "SIGHUP is obeyed from the start on, not before"


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
    assert caplog.text.count("SIGHUP: the machine files say nothing different") == 3


def test_a_hang_up_that_comes_before_the_service_has_its_handlers_ends_nothing():
    before = signal.getsignal(signal.SIGHUP)
    try:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        cli._ignore_until_heard(["check", "machine.toml"])
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_DFL
        cli._ignore_until_heard(["run", "machine.toml"])
        signal.raise_signal(signal.SIGHUP)
        # Whoever has asked for it (nohup) keeps a service that outlives its terminal.
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        cli._ignore_until_heard(["run", "machine.toml"])
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
