"""``daqsvc record FILE --bus NAME --out LOG``: a one-off recording of a CAN bus."""

from __future__ import annotations

import asyncio
import json
import re
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from daqsvc import kernel_cache
from daqsvc.commands.arguments import EXIT_OK, EXIT_USAGE, positive, signals_to_end
from daqsvc.commands.complaint import complain
from daqsvc.errors.command_line import ARGUMENTS, CANNOT_WRITE, NOTHING_ON_BUS, THERE_ALREADY, WRONG_VALUE
from daqsvc.rounding import counted

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

    from daqsvc.errors.code import Code
    from daqsvc.settings import MachineFile
    from drivers.base import Driver
    from drivers.can.driver import CanDriver
    from drivers.can.settings import CanBus


ENDINGS = (".blf", ".asc", ".log")
LIVE_S, LOGGED_S = 1.0, 10.0
"""How often progress is shown: in a terminal, and elsewhere."""
WIDTH = 79
"""Of that line in a terminal."""


class RecordCommand:
    """``daqsvc record FILE --bus NAME --out LOG``.

    Args:
        load: reads a machine file; None after its errors have been printed.
        start_logging: of the service.
    """

    help = "record all frames of a CAN bus in a log file, until Ctrl-C"
    description = (
        "Record all frames of a CAN bus in one log file, without the rest of the service. SIGINT "
        "(Ctrl-C) or SIGTERM end it. At the end, print as JSON what was recorded, and what the streams "
        'of the machine file do with it. The file can be replayed (driver = "replay") or opened by any '
        "tool that reads CAN logs."
    )

    def __init__(
        self, load: Callable[[Path], MachineFile | None], start_logging: Callable[..., None]
    ) -> None:
        self._load = load
        self._start_logging = start_logging

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        parser.add_argument("file", type=Path, metavar="FILE", help="machine file (TOML)")
        parser.add_argument(
            "--bus", metavar="NAME", help="name of the bus (default: the only CAN bus of the file)"
        )
        parser.add_argument(
            "--out",
            type=Path,
            required=True,
            metavar="LOG",
            help="log file to write; its suffix is the format: .blf, .asc, or .log of candump",
        )
        parser.add_argument(
            "--duration", type=positive, metavar="S", help="time to record, in s (default: until stopped)"
        )

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        self._start_logging(verbose=False)
        kernel_cache.prepare()
        machine = self._load(arguments.file)
        if machine is None:
            return EXIT_USAGE
        try:
            name, bus = _bus(machine, arguments.bus)
            _check_new(arguments.out)
        except _MisuseError as error:
            return complain("daqsvc", error, error.code, EXIT_USAGE)
        from daqsvc.acquisition.clock import SystemClock  # noqa: PLC0415 - each verb imports what it needs
        from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415
        from drivers.base import DeviceAbsentError  # noqa: PLC0415
        from drivers.can.driver import CanDriver  # noqa: PLC0415
        from drivers.can.record_files import OneLog  # noqa: PLC0415
        from drivers.frames import LayoutError  # noqa: PLC0415
        from drivers.make import bus_port  # noqa: PLC0415

        there = _logs(arguments.out)
        try:
            port = bus_port(machine, name, SystemClock(), lambda _block: None)
            driver = CanDriver(bus, port, logs=OneLog(arguments.out))
            asyncio.run(_run_until_stopped(driver, arguments.duration, _Progress(driver, arguments.out)))
        except (AssemblyError, DeviceAbsentError, LayoutError) as error:
            return complain("daqsvc", error, error.code)
        files = sorted(_logs(arguments.out) - there)
        summary = _summary(name, driver, files)
        counters = {key: value for key, value in asdict(driver.counters).items() if key not in summary}
        streams = {"streams": summary["streams"]}  # they come last, behind all that is of the bus
        printed = {key: value for key, value in summary.items() if key not in streams} | counters | streams
        print(json.dumps(printed))  # noqa: T201 - this is what the verb is for
        if unrecorded := summary["frames_unrecorded"]:
            what = f"{counted(unrecorded, 'frame')} could not be recorded in {arguments.out}"
            return complain("daqsvc", what, CANNOT_WRITE)
        if not files:
            what = (
                f"{driver.link.name} has carried no frame, so there is no {arguments.out}; "
                f"its state at the end: {driver.link.reason or 'up'}"
            )
            return complain("daqsvc", what, NOTHING_ON_BUS)
        return EXIT_OK


class _MisuseError(Exception):
    """The arguments do not fit the machine file or the disk."""

    def __init__(self, message: str, code: Code) -> None:
        super().__init__(message)
        self.code = code


def _bus(machine: MachineFile, name: str | None) -> tuple[str, CanBus]:
    """The CAN bus that is meant: its name and its table."""
    from drivers.can.settings import CanBus  # noqa: PLC0415 - each verb imports what it needs

    can_buses = {key: bus for key, bus in machine.buses.items() if isinstance(bus, CanBus)}
    there = f"CAN buses of {machine.path} are {', '.join(can_buses)}" if can_buses else "there is none"
    if name is None:
        if len(can_buses) != 1:
            raise _MisuseError(f"--bus: name the CAN bus to record; {there}", ARGUMENTS)
        return next(iter(can_buses.items()))
    if name not in can_buses:
        what = f"--bus {name}: {machine.path} has no CAN bus of this name; {there}"
        raise _MisuseError(what, WRONG_VALUE)
    return name, can_buses[name]


def _check_new(log: Path) -> None:
    if log.suffix.lower() not in ENDINGS:
        what = f"--out {log}: ends in none of {', '.join(ENDINGS)}, by which the format is chosen; add one"
        raise _MisuseError(what, WRONG_VALUE)
    if log.exists():
        what = f"--out {log}: is there already; give another name, or remove it first"
        raise _MisuseError(what, THERE_ALREADY)
    if not log.parent.is_dir():
        raise _MisuseError(f"--out {log}: there is no folder {log.parent}; make it first", CANNOT_WRITE)


def _logs(log: Path) -> set[Path]:
    """The file, and the files that go on with it where the disk refused for a while."""
    names = re.compile(re.escape(log.stem) + r"(-\d+)?" + re.escape(log.suffix))
    return {path for path in log.parent.iterdir() if names.fullmatch(path.name)}


class _Progress:
    """Shows the progress of the recording on stderr: over the same line in a terminal, else now and then.

    Args:
        driver: of the bus.
        log: the file.
    """

    def __init__(self, driver: Driver, log: Path) -> None:
        self._driver = driver
        self._log = log
        self._is_live = sys.stderr.isatty()

    async def tell(self) -> None:
        """Say it until cancelled."""
        _tell(f"recording {self._driver.link.name} in {self._log}; Ctrl-C ends it\n")
        try:
            while True:
                await asyncio.sleep(LIVE_S if self._is_live else LOGGED_S)
                # Blanks go over the end of a longer line.
                _tell(f"{self._words():<{WIDTH}}\r" if self._is_live else f"{self._words()}\n")
        finally:
            if self._is_live:
                _tell("\n")

    def _words(self) -> str:
        link, counters = self._driver.link, asdict(self._driver.counters)
        frames = f"{counted(counters['frames_recorded'], 'frame')} recorded"
        if counters["frames_unrecorded"]:
            frames += f", {counters['frames_unrecorded']:,} not"
        if link.reason:
            frames += f"; {link.reason}"
        return frames[:WIDTH] if self._is_live else frames


def _tell(words: str) -> None:
    print(words, end="", file=sys.stderr, flush=True)  # noqa: T201 - progress is no result


async def _run_until_stopped(driver: Driver, duration_s: float | None, progress: _Progress) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in signals_to_end():
        loop.add_signal_handler(number, stop.set)
    running = asyncio.create_task(driver.run(), name="record")
    stopped = asyncio.create_task(stop.wait(), name="stop")
    telling = asyncio.create_task(progress.tell(), name="progress")
    await asyncio.wait({running, stopped}, timeout=duration_s, return_when=asyncio.FIRST_COMPLETED)
    for task in (telling, stopped, running):
        task.cancel()
    ended = await asyncio.gather(running, stopped, telling, return_exceptions=True)
    if isinstance(ended[0], Exception):
        raise ended[0]


class StreamReceived(TypedDict):
    """What came of a stream.

    Attributes:
        samples_received: samples that were received.
        samples_lost: samples that were lost on the way.
    """

    samples_received: int
    samples_lost: int


class RecordSummary(TypedDict):
    """What was recorded; the counters of the bus come with it.

    Attributes:
        bus: name of the bus.
        files: recordings that were written.
        bytes: their size.
        frames_recorded: frames that are in them.
        frames_unrecorded: frames that are not, because the disk refused them or was too slow.
        losses: how often the bus went down after it had been up.
        streams: what came of each stream.
    """

    bus: str
    files: list[str]
    bytes: int
    frames_recorded: int
    frames_unrecorded: int
    losses: int
    streams: dict[str, StreamReceived]


def _summary(bus: str, driver: CanDriver, files: list[Path]) -> RecordSummary:
    counted = driver.counters
    return {
        "bus": bus,
        "files": [str(path) for path in files],
        "bytes": sum(path.stat().st_size for path in files),
        "frames_recorded": counted.frames_recorded,
        "frames_unrecorded": counted.frames_unrecorded,
        "losses": driver.link.losses,
        "streams": {
            name: {"samples_received": stream.samples_received, "samples_lost": stream.samples_lost}
            for name, (stream, _) in driver.streams.items()
        },
    }
