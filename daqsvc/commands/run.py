"""``daqsvc run FILE ...``: the service, until it is stopped."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daqsvc import kernel_cache
from daqsvc.commands.arguments import EXIT_FAILED, EXIT_HUNG, EXIT_LOST, EXIT_OK, EXIT_STUCK, EXIT_USAGE
from daqsvc.commands.log_thread import LogThread
from daqsvc.commands.machine_files import load_box, read_box
from daqsvc.commands.process_guard import ProcessGuard
from daqsvc.commands.service_manager import ServiceManager
from daqsvc.commands.start_memory import give_back, share_heaps
from daqsvc.commands.store_argument import StoreNotFoundError, files_by_identity, store_directory
from daqsvc.errors.code import coded
from daqsvc.errors.service import ESSENTIAL_LOST, RELOAD_REFUSED
from daqsvc.notice import notice
from daqsvc.threads import call_in_thread

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Coroutine, Sequence

    from daqsvc.box import Box
    from daqsvc.service import Service
    from daqsvc.settings import MachineFile
    from daqsvc.supervision import Part

log = logging.getLogger(__name__)
milestones = logging.getLogger(f"{__name__}.milestones")
"""What is logged without ``-v``, too: a service that states nothing leaves a person in doubt."""

LOOK_S = 0.2
"""How often is looked whether samples of all streams have come."""

LOG_S = 0.3
"""What the last lines of the log may take to be written."""

STDERR = 2

LOCK = "outbox.sqlite.lock"
"""The file of a store that a service holds, as `daqsvc.outbox.journal.Journal.hold` does."""

SWITCH_S = 0.001
"""How long a thread that computes may keep the interpreter from another that waits for it: the event loop."""


class RunCommand:
    """``daqsvc run FILE ...``.

    Args:
        load: reads a machine file; None after its errors have been printed.
        start_logging: of the command line; takes the handler to log to.
    """

    help = "run the service until SIGTERM or SIGINT"
    description = (
        "Run the service for one machine file, or for several machines that share their buses, one "
        "journal and one connection to the broker. It acquires samples, diagnoses the machines and "
        "publishes alarms. SIGTERM, SIGINT (Ctrl-C) or the loss of its terminal stop it within two "
        "seconds. Alarms that the broker has not acknowledged stay in the journal and are sent at the "
        "next start. Exit code 0: it was stopped. Exit code 1: it could not start. Exit code 2: the "
        "machine file has errors. Exit code 3: it lost something that it cannot work without, such as "
        f"the writer of the journal. Exit code {EXIT_HUNG}: it hung while it stopped, and was killed. "
        f"Exit code {EXIT_STUCK}: its event loop was blocked, and it was killed."
    )

    def __init__(
        self, load: Callable[[Path], MachineFile | None], start_logging: Callable[..., None]
    ) -> None:
        self._load = load
        self._start_logging = start_logging

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument(
            "files",
            type=Path,
            nargs="+",
            metavar="FILE",
            help="machine file (TOML), the machine files of several machines on one box, or their directory",
        )
        parser.add_argument(
            "--store",
            type=Path,
            metavar="DIR",
            help="directory of the alarm journal (default: store.directory of the machine file, else "
            "$STATE_DIRECTORY, else ~/.local/state/daqsvc)",
        )
        parser.add_argument(
            "-v",
            "--verbose",
            action="store_true",
            help="also log what goes well, not only notices, warnings and errors",
        )

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        share_heaps()
        manager = ServiceManager.of_environment()
        handler = LogThread(STDERR)
        self._start_logging(verbose=arguments.verbose, handler=handler)
        milestones.setLevel(logging.INFO)
        try:
            manager.starting()
            from daqsvc.kernel_compiler import compile_apart  # noqa: PLC0415 - each verb imports only what it needs

            box = load_box(arguments.files, self._load)
            if box is None:
                return EXIT_USAGE
            kernel_cache.prepare()
            compile_apart()
            sys.setswitchinterval(SWITCH_S)
            with ProcessGuard(handler.flush_within, manager.stopping) as guard:
                # Under systemd its journal reads the log, whose restart is no reason to stop.
                handler.on_gone = None if "JOURNAL_STREAM" in os.environ else guard.lose_terminal
                return _run(box, arguments.files, arguments.store, guard, manager)
        finally:
            manager.close()
            handler.flush_within(LOG_S)


def _run(
    box: Box, files: Sequence[Path], store: Path | None, guard: ProcessGuard, manager: ServiceManager
) -> int:
    from daqsvc.outbox.files import take_possession  # noqa: PLC0415
    from daqsvc.outbox.journal import refuse_store  # noqa: PLC0415
    from daqsvc.outbox.machine_files import take_store  # noqa: PLC0415
    from daqsvc.outbox.messages import (  # noqa: PLC0415
        NewerOutboxError,
        OutboxAwayError,
        OutboxError,
        StoreInUseError,
        StorePathError,
    )
    from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415 - each verb imports only what it needs
    from daqsvc.supervision import EssentialLostError  # noqa: PLC0415
    from drivers.base import DeviceAbsentError  # noqa: PLC0415
    from drivers.frames import LayoutError  # noqa: PLC0415

    try:
        is_named = store is not None
        store = store or store_directory(box)
        # What comes next may compile kernels, on a small box for minutes: meanwhile the store is held, which
        # states to others that a service starts.
        refuse_store(store)
        with contextlib.ExitStack() as held:
            # What the disk cannot do now, it may by the time the journal is opened.
            with contextlib.suppress(OSError):
                held.enter_context(take_possession(store / LOCK))
            take_store(store, files_by_identity(box), on_purpose=is_named)
            _run_loop(_run_until_stopped(box, files, store, guard, manager, held.close))
    except (AssemblyError, LayoutError, NewerOutboxError, StoreNotFoundError, StorePathError) as error:
        log.critical("%s", error, extra=coded(error.code))
        return EXIT_USAGE
    except StoreInUseError as error:
        log.critical("%s", error, extra=coded(error.code))
        # Of other machines, it will always be in use; of these, until the other service ends.
        watched = {*box.machines} if store is None else _watched(store) or {*box.machines}
        return EXIT_USAGE if watched.isdisjoint(box.machines) else EXIT_FAILED
    except (DeviceAbsentError, OutboxError) as error:
        # Some file systems, such as /proc, have no room for directories, ever.
        is_placeless = isinstance(error.__cause__, FileNotFoundError) and not isinstance(
            error, OutboxAwayError
        )
        remedy = "name another in [store] of the machine file, or with --store"
        log.critical(
            "%s",
            f"the store {store} cannot be made there: {remedy}" if is_placeless else error,
            extra=coded(error.code),
        )
        return EXIT_USAGE if is_placeless else EXIT_FAILED
    except EssentialLostError as error:
        log.critical("%s; the service ends, and must be started again", error, extra=coded(error.code))
        return EXIT_LOST
    except (SystemExit, asyncio.CancelledError) as error:
        how = "ended" if isinstance(error, SystemExit) else "cancelled"
        log.critical(
            "the service was %s by something in its process, and must be started again",
            how,
            extra=coded(ESSENTIAL_LOST),
        )
        return EXIT_LOST
    return EXIT_OK


def _watched(store: Path) -> set[str]:
    """The machines that the service on a store watches; empty if it does not answer."""
    from daqsvc.control import ControlError, ask_status  # noqa: PLC0415 - only what a verb needs

    try:
        return {str(status["machine"]) for status in ask_status(store)}
    except ControlError as error:
        log.info("what the other daqsvc watches is not known: %s", error)
        return set()


def _run_loop(work: Coroutine[Any, Any, None]) -> None:
    """Run the event loop until ``work`` is done, also if a task of a plugin would end the process."""
    with asyncio.Runner() as runner:
        loop = runner.get_loop()
        running = loop.create_task(work)
        while not running.done():
            try:
                loop.run_until_complete(running)
            except (SystemExit, KeyboardInterrupt) as error:
                message = "a task would have ended the process"
                loop.call_exception_handler({"message": message, "exception": error})
        running.result()


class _Reloader:
    """Has the machine files read again as SIGHUP asks; all that asks meanwhile makes one time more.

    Args:
        service: that goes on with them.

    Attributes:
        part: what does it; None before anybody has asked.
        is_over: whether the service stops.
    """

    def __init__(self, service: Service) -> None:
        self.part: Part | None = None
        self.is_over = False
        self._service = service
        self._asked = False

    def ask(self) -> None:
        """Have them read again, soon."""
        self._asked = True
        if self.part is None or self.part.over.done():
            self.part = self._service.supervisor.keep("reload", self._reload, may_end=lambda: True)
            self.part.over.add_done_callback(self._ask_again)

    def _ask_again(self, over: asyncio.Future[None]) -> None:
        """Something may have been asked for right after the last check."""
        if self._asked and not over.cancelled() and not self.is_over:
            self.ask()

    async def _reload(self) -> None:
        from daqsvc.control import ReloadRefusedError, ReloadTooLateError  # noqa: PLC0415 - as above

        while self._asked:
            self._asked = False
            try:
                if not await self._service.reload():
                    notice(log, "SIGHUP: the machine files have not changed")
            except ReloadTooLateError:
                log.info("SIGHUP is ignored: the service ends")
                return
            except ReloadRefusedError as refused:
                for reason in refused.reasons:
                    log.error(  # noqa: TRY400 - the message is enough
                        "SIGHUP is refused, and the service goes on as before: %s",
                        reason,
                        extra=coded(RELOAD_REFUSED),
                    )


async def _await_samples(service: Service) -> None:
    """Say once when samples of all streams have come."""
    while True:
        if all(one.ring.started for one in service.streams.values()):
            break
        await asyncio.sleep(LOOK_S)
    milestones.info("samples come from all streams: %s", ", ".join(service.streams))


def _reloading(manager: ServiceManager, begins: bool) -> None:  # noqa: FBT001 - a callback
    manager.reloading(begins=begins)
    if not begins:
        call_in_thread(give_back, name="give back")


async def _run_until_stopped(
    box: Box,
    files: Sequence[Path],
    store: Path,
    guard: ProcessGuard,
    manager: ServiceManager,
    let_go: Callable[[], object] = lambda: None,
) -> None:
    """Run the service.

    Args:
        box: the machine files.
        files: as they were named.
        store: directory of the journal.
        guard: of the process.
        manager: the service manager, which receives the state of the service.
        let_go: releases the store, which the service takes itself.

    Raises:
        AssemblyError, DeviceAbsentError, EssentialLostError, LayoutError, OutboxError: see `Service`.
    """
    from daqsvc.outbox.machine_files import note_files  # noqa: PLC0415
    from daqsvc.service import Service  # noqa: PLC0415
    from daqsvc.supervision import stop_all  # noqa: PLC0415

    stop = asyncio.Event()
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    service = Service(
        box,
        store,
        on_ending=guard.stopping,
        runtime=Path(runtime) if runtime else None,
        read_again=partial(read_box, files),
        on_reload=partial(_reloading, manager),
        files=files,
    )
    guard.protect(service.alarms.outbox.close_from_outside)
    guard.stop_by(asyncio.get_running_loop(), stop.set)
    let_go()
    running = asyncio.create_task(service.run(stop), name="service")
    follow = partial(manager.follow, service)
    parts = [service.supervisor.keep("service manager", follow, may_end=lambda: True)]
    reloader = _Reloader(service)
    ready = asyncio.create_task(service.ready.wait(), name="ready")
    try:
        await asyncio.wait({running, ready}, return_when=asyncio.FIRST_COMPLETED)
        if service.ready.is_set():
            guard.expect_turns(manager.watchdog_s and manager.watchdog_s / 2)
            # What the start has made stays until the end. Looking through it for garbage, libraries and all
            # alarms, would hold up the event loop for some .1 s each time.
            gc.freeze()
            guard.reload_by(reloader.ask)
            note_files(store, {name: machine.path for name, machine in box.machines.items()})
            milestones.info("watching %s; the journal is in %s", box.names, store)
            awaiting = partial(_await_samples, service)
            parts.append(service.supervisor.keep("first samples", awaiting, may_end=lambda: True))
            call_in_thread(give_back, name="give back")
        await running
    finally:
        ready.cancel()
        reloader.is_over = True
        await stop_all([*parts, *([reloader.part] if reloader.part else [])], LOG_S)
    log.info("stopped")
