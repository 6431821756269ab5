"""``daqsvc sim``: simulated devices on real or virtual buses, for any client."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import signal
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

from daqsvc.commands.arguments import EXIT_OK, EXIT_USAGE, ArgumentParser
from daqsvc.commands.complaint import complain
from daqsvc.confined.small_toml import TomlFileError, read_toml
from daqsvc.errors.command_line import SIMULATION
from sim_hw.arguments import add_random, add_recording, add_speed, misplaced, positive, whole
from sim_hw.played import PlayedStream

if TYPE_CHECKING:
    from collections.abc import Sequence

    from daqsvc.settings import MachineFile
    from sim_hw.node_faults import NodeFaults
    from sim_hw.nodes.pacing import Pacer
    from sim_hw.sim_nodes import SimNode
    from sim_hw.sim_signals import Signals

SCENARIO = "paper"
OF_RECORDINGS = ("map", "fs", "max_memory")
OF_PLANTS = ("snr_db",)
"""Options that go with the one or the other; a scenario's faults, and their seed, go with both."""
DEFAULT_BUS = "daqsvc-can0"
"""Name of the virtual bus below the folder for temporary files, where none is given."""


class SimCommand:
    """The verb ``sim`` (entry-point group ``daqsvc.commands``)."""

    help = "put simulated devices on a bus, for the service or any other client"
    description = (
        "Put the devices of a machine file on their buses and play a scenario or a measured recording. "
        "A device is CAN frames over a virtual bus between processes or SocketCAN, a Modbus server, or "
        "a serial port behind a pseudo-terminal. At the end, or when stopped, print as JSON what was "
        "sent and which faults were put in."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        self._parser = parser
        parser.add_argument(
            "what",
            nargs="?",
            metavar="FILE|SCENARIO",
            help="machine file (TOML), as for daqsvc run; or a scenario, played by the rig of the demo",
        )
        play = parser.add_argument_group("what to play")
        play.add_argument(
            "--scenario", metavar="NAME|FILE", help=f"scenario for a machine file (default: {SCENARIO})"
        )
        add_random(play)
        add_recording(play)
        play.add_argument("--duration", type=positive, metavar="S", help="time to play, in s (default: all)")
        play.add_argument(
            "--stream",
            action="append",
            metavar="NAME",
            help="play only this stream; may be repeated (default: all)",
        )
        where = parser.add_argument_group("where to play it")
        where.add_argument(
            "--bus",
            type=Path,
            metavar="PATH",
            help="virtual CAN bus to use instead of the interface in the machine file; without FILE, run "
            "that bus for other processes",
        )
        where.add_argument(
            "--link",
            type=Path,
            metavar="PATH",
            help="path of a link to the pseudo-terminal that is the serial port",
        )
        where.add_argument("--port", type=_port, metavar="N", help="TCP port of the Modbus server")
        add_speed(where, "; daqsvc run needs 1, as it knows the sampling rate")

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        if wrong := _misuse(arguments):
            self._parser.error(wrong)
        from daqsvc import kernel_cache  # noqa: PLC0415
        from daqsvc.cli import start_logging  # noqa: PLC0415

        start_logging(verbose=False)
        kernel_cache.prepare()
        # What python-can reports of a bus is raised too; a lost one it would report at each attempt.
        logging.getLogger("can").setLevel(logging.CRITICAL)
        if arguments.what is None:
            from sim_hw.bus_socket import run_hub  # noqa: PLC0415

            return run_hub(str(arguments.bus))
        from daqsvc.recording import RecordingError  # noqa: PLC0415
        from daqsvc.settings import MachineFileError  # noqa: PLC0415
        from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415
        from drivers.frames import LayoutError  # noqa: PLC0415
        from sim_hw.scenario import ScenarioError  # noqa: PLC0415
        from sim_hw.sim_nodes import NodeError  # noqa: PLC0415
        from sim_hw.sim_signals import SignalError  # noqa: PLC0415

        try:
            return asyncio.run(_simulate(arguments))
        except MachineFileError as error:
            _say(str(error))  # each problem has its code
            return EXIT_USAGE
        except (
            AssemblyError,
            LayoutError,
            NodeError,
            RecordingError,
            ScenarioError,
            SignalError,
        ) as error:
            return complain("daqsvc sim", error, error.code)
        except TimeoutError as error:
            return complain("daqsvc sim", error, SIMULATION)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console script ``daqsvc-sim``; returns the exit code."""
    command = SimCommand()
    parser = ArgumentParser(prog="daqsvc-sim", description=command.description)
    command.add_arguments(parser)
    return command.run(parser.parse_args(arguments))


def _misuse(arguments: argparse.Namespace) -> str | None:
    """What is wrong with arguments that are valid each for itself; None if nothing is."""
    if arguments.what is None:
        if arguments.bus is None:
            return "name a machine file or a scenario to play, or a bus to run (--bus PATH)"
        return None
    return misplaced(arguments, OF_RECORDINGS, OF_PLANTS)


class SimSummary(TypedDict):
    """What was played.

    Attributes:
        complete: whether all was played.
        buses: by bus the address that it was played at.
        streams: by stream what was played.
    """

    complete: bool
    buses: dict[str, str]
    streams: dict[str, Annotated[dict[str, Any], PlayedStream]]


async def _simulate(arguments: argparse.Namespace) -> int:
    from daqsvc.acquisition.clock import SystemClock  # noqa: PLC0415
    from sim_hw.nodes.pacing import RealTimePacer  # noqa: PLC0415
    from sim_hw.sim_nodes import NodeOrder, node_for  # noqa: PLC0415
    from sim_hw.sim_signals import SignalError, stream_samples  # noqa: PLC0415

    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    machine, signals, faults, unixbus = await asyncio.to_thread(_script, arguments)
    streams = arguments.stream or list(machine.streams)
    if unknown := [name for name in streams if name not in machine.streams]:
        raise SignalError(
            f"{machine.path} has no stream {unknown[0]!r}; there are {', '.join(machine.streams)}"
        )
    samples = await asyncio.to_thread(lambda: [stream_samples(machine, name, signals) for name in streams])
    nodes: dict[str, SimNode] = {}
    async with contextlib.AsyncExitStack() as stack:
        for bus in machine.buses:
            wanted = [played for played in samples if machine.streams[played.stream].bus == bus]
            if not wanted:
                continue
            order = NodeOrder(machine, bus, wanted, faults, unixbus, arguments.link, arguments.port)
            nodes[bus] = await node_for(order)
            stack.push_async_callback(nodes[bus].close)
            _say(f"playing {', '.join(s.stream for s in wanted)} on {nodes[bus].address}")
        pacer = _Faster(RealTimePacer(SystemClock()), arguments.speed)
        complete = await _until_played(list(nodes.values()), pacer, stop)
        summary: SimSummary = {"complete": complete, "buses": {}, "streams": {}}
        for bus, node in nodes.items():
            summary["buses"][bus] = node.address
            summary["streams"] |= node.figures()
    print(json.dumps(summary), flush=True)  # noqa: T201 - this is the output
    return EXIT_OK


async def _until_played(nodes: Sequence[SimNode], pacer: Pacer, stop: asyncio.Event) -> bool:
    """Play all nodes to their end, or until stopped; whether it came to the end.

    Raises:
        TimeoutError: a bus has taken nothing for too long.
    """

    async def play() -> None:
        # All begin together: what is sampled at the same time is sent at the same time.
        for node in nodes:
            await node.ready()
        async with asyncio.TaskGroup() as group:
            for node in nodes:
                group.create_task(node.play(pacer))

    playing = asyncio.create_task(play())
    stopping = asyncio.create_task(stop.wait())
    try:
        await asyncio.wait({playing, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if not playing.done():
            return False
        if isinstance(error := playing.exception(), BaseExceptionGroup):
            raise _first(error)
        playing.result()
        return True
    finally:
        for task in (playing, stopping):
            task.cancel()
        await asyncio.wait({playing, stopping})


class _Faster:
    """A pacer whose simulated time passes ``speed`` times as fast as that of another."""

    def __init__(self, pacer: Pacer, speed: float) -> None:
        self._pacer, self._speed = pacer, speed

    async def wait_until(self, t_ns: int) -> None:
        await self._pacer.wait_until(round(t_ns / self._speed))


def _script(
    arguments: argparse.Namespace,
) -> tuple[MachineFile, Signals, NodeFaults | None, Path | None]:
    """The machine, what its sensors see, what goes wrong, and the virtual bus if there is one."""
    from daqsvc.settings import load_machine_file  # noqa: PLC0415
    from sim_hw.scenario import Scenario, load_any_scenario  # noqa: PLC0415
    from sim_hw.sim_signals import (  # noqa: PLC0415
        BearingSignals,
        RecordedSignals,
        RotorSignals,
        SignalError,
    )

    source = Path(arguments.what)
    is_machine = source.is_file() and not _is_scenario(source)
    scenario = None
    if not is_machine or arguments.scenario is not None or arguments.recording is None:
        scenario = load_any_scenario(arguments.scenario or SCENARIO if is_machine else arguments.what)
    unixbus: Path | None = arguments.bus
    if is_machine:
        machine = load_machine_file(source)
    elif isinstance(scenario, Scenario):
        from sim_hw.demo.machines import laval_rig  # noqa: PLC0415

        machine = laval_rig(scenario, 1.0, "mqtt://127.0.0.1")
        unixbus = unixbus or Path(tempfile.gettempdir()) / DEFAULT_BUS
    else:
        raise SignalError(
            f"a bearing needs sensors: name a machine file too, daqsvc sim FILE --scenario {source}"
        )
    if scenario is None and arguments.seed is not None:
        raise SignalError(
            "--seed draws the faults of a scenario again, and a recording has none; name a scenario too with "
            "--scenario, or leave --seed out"
        )
    faults = None if scenario is None else scenario.node_faults(arguments.seed)
    signals: Signals
    if arguments.recording is not None:
        from daqsvc.recording.recording import set_memory, stop_reading  # noqa: PLC0415
        from sim_hw.recordings import load_played  # noqa: PLC0415

        set_memory(arguments.max_memory)
        recording = load_played(
            arguments.recording,
            arguments.map,
            arguments.fs,
            machine if is_machine else None,
            "name that in place of the scenario",
        )
        stop_reading()
        for note in recording.notes:
            logging.getLogger(__name__).warning("%s: %s", recording.source, note)
        signals = RecordedSignals(recording, arguments.duration)
    elif isinstance(scenario, Scenario):
        signals = RotorSignals(scenario, arguments.duration, arguments.seed, arguments.snr_db)
    else:
        assert scenario is not None  # noqa: S101 - without a recording one was loaded
        signals = BearingSignals(scenario, arguments.duration, arguments.seed, arguments.snr_db)
    return machine, signals, faults, unixbus


def _is_scenario(path: Path) -> bool:
    try:
        return "plant" in read_toml(path)
    except (OSError, TomlFileError):
        return False  # the reader of machine files states what is wrong with it


def _port(text: str) -> int:
    port = whole(text)
    if not 0 < port < 2**16:
        raise argparse.ArgumentTypeError(f"{text} is not a TCP port; give one from 1 to 65535")
    return port


def _first(group: BaseExceptionGroup[BaseException]) -> BaseException:
    first = group.exceptions[0]
    return _first(first) if isinstance(first, BaseExceptionGroup) else first


def _say(message: str) -> None:
    print(f"daqsvc sim: {message}", file=sys.stderr, flush=True)  # noqa: T201 - stdout is for the summary
