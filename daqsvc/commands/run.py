"""``daqsvc run FILE``: the service, until it is stopped."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from daqsvc import kernel_cache
from daqsvc.commands.arguments import EXIT_FAILED, EXIT_HUNG, EXIT_LOST, EXIT_OK, EXIT_STUCK, EXIT_USAGE
from daqsvc.commands.log_thread import LogThread
from daqsvc.commands.process_guard import ProcessGuard
from daqsvc.commands.service_manager import ServiceManager
from daqsvc.commands.store_argument import StoreNotFoundError, store_directory

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Coroutine

    from daqsvc.settings import MachineFile

log = logging.getLogger(__name__)


LOG_S = 0.3
"""What the last lines of the log may take to be written."""

STDERR = 2


class RunCommand:
    """``daqsvc run FILE``.

    Args:
        load: reads a machine file; None after its errors have been printed.
        start_logging: of the command line; takes the handler to log to.
    """

    help = "run the service until SIGTERM or SIGINT"
    description = (
        "Run the service for one machine file: acquire, diagnose, and publish alarms. SIGTERM, SIGINT "
        "(Ctrl-C) or the loss of its terminal stop it within two seconds; alarms that the broker has not "
        "acknowledged stay in the journal and go out at the next start. Exit codes: 0 it was stopped; 1 it "
        "could not start; 2 the machine file has errors; 3 something without which it is useless was lost, "
        f"such as the writer of the journal; {EXIT_HUNG} something hung while it stopped, and it was ended "
        f"by force; {EXIT_STUCK} its event loop stood still, and it was ended by force."
    )

    def __init__(
        self, load: Callable[[Path], MachineFile | None], start_logging: Callable[..., None]
    ) -> None:
        self._load = load
        self._start_logging = start_logging

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument("file", type=Path, metavar="FILE", help="the machine file (TOML)")
        parser.add_argument(
            "--store",
            type=Path,
            metavar="DIR",
            help="directory of the alarm journal (default: as in the file, else $STATE_DIRECTORY, "
            "else ~/.local/state/daqsvc)",
        )
        parser.add_argument("-v", "--verbose", action="store_true", help="log what goes well, too")

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        manager = ServiceManager.of_environment()
        handler = LogThread(STDERR)
        self._start_logging(verbose=arguments.verbose, handler=handler)
        try:
            machine = self._load(arguments.file)
            if machine is None:
                return EXIT_USAGE
            kernel_cache.prepare()
            with ProcessGuard(handler.flush_within, manager.stopping) as guard:
                # Under systemd its journal reads the log, whose restart is no reason to stop.
                handler.on_gone = None if "JOURNAL_STREAM" in os.environ else guard.lose_terminal
                return _run(machine, arguments.store, guard, manager)
        finally:
            manager.close()
            handler.flush_within(LOG_S)


def _run(machine: MachineFile, store: Path | None, guard: ProcessGuard, manager: ServiceManager) -> int:
    from daqsvc.outbox.messages import NewerOutboxError, OutboxError, StorePathError  # noqa: PLC0415
    from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415 - each verb imports only what it needs
    from daqsvc.supervision import EssentialLostError  # noqa: PLC0415
    from drivers.base import DeviceAbsentError  # noqa: PLC0415
    from drivers.frames import LayoutError  # noqa: PLC0415

    try:
        _run_loop(_run_until_stopped(machine, store or store_directory(machine), guard, manager))
    except (AssemblyError, LayoutError, NewerOutboxError, StoreNotFoundError, StorePathError) as error:
        log.critical("%s", error)
        return EXIT_USAGE
    except (DeviceAbsentError, OutboxError) as error:
        log.critical("%s", error)
        return EXIT_FAILED
    except EssentialLostError as error:
        log.critical("%s; the service ends, and must be started again", error)
        return EXIT_LOST
    except SystemExit:
        log.critical("the service was ended by something in its process, and must be started again")
        return EXIT_LOST
    except asyncio.CancelledError:
        log.critical("the service was cancelled by something in its process, and must be started again")
        return EXIT_LOST
    return EXIT_OK


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


async def _run_until_stopped(
    machine: MachineFile, store: Path, guard: ProcessGuard, manager: ServiceManager
) -> None:
    from daqsvc.service import Service  # noqa: PLC0415
    from daqsvc.supervision import stop_all  # noqa: PLC0415

    stop = asyncio.Event()
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
    service = Service(machine, store, on_ending=guard.stopping, runtime=Path(runtime) if runtime else None)
    guard.protect(service.alarms.outbox.close_from_outside)
    guard.stop_by(asyncio.get_running_loop(), stop.set)
    running = asyncio.create_task(service.run(stop), name="service")
    follow = partial(manager.follow, service)
    following = [service.supervisor.keep("service manager", follow, may_end=lambda: True)]
    ready = asyncio.create_task(service.ready.wait(), name="ready")
    try:
        await asyncio.wait({running, ready}, return_when=asyncio.FIRST_COMPLETED)
        if service.ready.is_set():
            guard.expect_turns(manager.watchdog_s and manager.watchdog_s / 2)
            # What the start has made stays until the end. Looking through it for garbage, libraries and all
            # alarms, would hold up the event loop for some .1 s each time.
            gc.freeze()
            log.info("watching %s; the journal is in %s", machine.machine.name, store)
        await running
    finally:
        ready.cancel()
        await stop_all(following, LOG_S)
    log.info("stopped")
