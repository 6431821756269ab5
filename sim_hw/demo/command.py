"""``daqsvc demo``: the whole service against a simulated machine, with nothing else needed."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from daqsvc.commands.arguments import channel_map, sampling_rate_hz
from daqsvc.commands.complaint import complain
from daqsvc.errors.command_line import EXTRA_MISSING, INTERRUPTED, SIMULATION
from sim_hw.arguments import add_random, add_recording, add_speed, first_option, misplaced, positive
from sim_hw.demo.machines import DemoError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from types import FrameType

    from daqsvc.recording.recording import Recording
    from daqsvc.settings import MachineFile
    from sim_hw.demo.machines import AlarmLimits
    from sim_hw.demo.page import PageAddress
    from sim_hw.demo.session import DemoOutcome, DemoPage, DemoSession, DemoSummary, Received, Script
    from sim_hw.scenario import BearingScenario

SCENARIO = "paper"
UNIT = "g"
BEARING_RATE_HZ = 12_000.0
SIMULATED_BEARING = "6205-2RS"
"""What the simulated bearing is: `sim_hw.plants.bearing.ORDERS` are its orders."""
DECISIONS = {"healthy": "normal"}
"""What the detector calls a part of a scenario, where it has another name."""
UNITS = ("g", "m/s2", "mm/s", "um", "mm", "mil")


class DemoCommand:
    """The verb ``demo`` (entry-point group ``daqsvc.commands``)."""

    help = "run the whole service against a simulated machine or a recording"
    description = (
        "Run the whole service - virtual CAN bus, driver, ring, detectors, alarms, journal, MQTT - "
        "against a simulated machine or a measured recording. It needs no broker, no root and no "
        "network: a broker starts inside the process, and what you see has passed through it."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `daqsvc.cli.Command.add_arguments`."""
        self._parser = parser
        what = parser.add_argument_group("what to play")
        what.add_argument(
            "--scenario",
            metavar="NAME|FILE",
            help="a built-in scenario (paper, healthy, link-faults) or a scenario file (default: paper)",
        )
        add_random(what)
        add_recording(what)
        what.add_argument(
            "--machine",
            type=Path,
            metavar="FILE",
            help="machine file (TOML) with the layout of the frames, if the recording is a CAN log",
        )
        what.add_argument("--unit", choices=UNITS, help="unit of the samples (default: g)")
        what.add_argument(
            "--baseline",
            type=Path,
            metavar="FILE",
            help="recording of the healthy machine; the alarm setpoints are 1.5 and 3 times its RMS",
        )
        what.add_argument(
            "--baseline-map",
            type=channel_map,
            metavar="NAME=VARIABLE,...",
            help="like --map, for the recording of the healthy machine (default: --map)",
        )
        what.add_argument(
            "--baseline-fs",
            type=sampling_rate_hz,
            metavar="HZ",
            help="like --fs, for the recording of the healthy machine (default: --fs)",
        )
        what.add_argument(
            "--bearing",
            metavar="NAME",
            help="designation in the catalogue, e.g. 6205-2RS: watch this bearing with every channel",
        )
        what.add_argument(
            "--speed-rpm",
            type=positive,
            metavar="N",
            help="with --bearing: speed of the shaft in the recording, exact to 1 %%",
        )
        how = parser.add_argument_group("how to play it")
        add_speed(how)
        how.add_argument(
            "--broker",
            type=broker_url,
            metavar="URL",
            help="publish to this broker, mqtt://HOST[:PORT], without TLS (default: one inside the process)",
        )
        how.add_argument(
            "--snapshots",
            type=Path,
            metavar="DIR",
            help="folder for the snapshots that alarms request, for daqsvc replay (default: they are removed "
            "with the demo)",
        )
        how.add_argument(
            "--page",
            action="store_true",
            help="also serve daqsvc page, at the address that is printed",
        )
        how.add_argument("--again", action="store_true", help="play it in a loop, until Ctrl-C")
        how.add_argument(
            "--json",
            action="store_true",
            help='print one JSON object per line: type "diagnosis", "alarm", "status", at the end "summary"',
        )

    def run(self, arguments: argparse.Namespace) -> int:
        """See `daqsvc.cli.Command.run`."""
        if wrong := misuse(arguments):
            self._parser.error(wrong)
        with _sigterm_interrupts():
            try:
                return _run(arguments)
            except KeyboardInterrupt:
                return complain("daqsvc demo", "interrupted", INTERRUPTED)


def _run(arguments: argparse.Namespace) -> int:
    import logging  # noqa: PLC0415

    from daqsvc import kernel_cache  # noqa: PLC0415
    from daqsvc.cli import start_logging  # noqa: PLC0415

    start_logging(verbose=False)
    # Every alarm comes back from the broker and is shown; the service's log would repeat it.
    logging.getLogger("daqsvc.alarm_log").setLevel(logging.ERROR)
    kernel_cache.prepare()
    try:
        import sim_hw.demo.session  # noqa: F401, PLC0415 - is all there that it needs?
        from daqsvc.recording import RecordingError  # noqa: PLC0415
        from daqsvc.settings import MachineFileError  # noqa: PLC0415
        from sim_hw.scenario import ScenarioError  # noqa: PLC0415
    except ModuleNotFoundError as error:
        what = f"the demo needs {error.name}; install it with: pip install 'daqsvc[demo]'"
        return complain("daqsvc demo", what, EXTRA_MISSING)
    try:
        script = script_of(arguments)
        summary = _play(script, arguments)
    except MachineFileError as error:
        return complain("daqsvc demo", error, error.problems[-1].code)
    except (DemoError, RecordingError, ScenarioError) as error:
        return complain("daqsvc demo", error, error.code)
    if not summary["complete"]:
        what = "the service's last messages did not come back from the broker"
        return complain("daqsvc demo", what, SIMULATION)
    return 0


async def _interruptible(session: DemoSession) -> DemoOutcome:
    """Have SIGTERM and a lost terminal cancel what is played, as Ctrl-C does: it then ends in order.

    Once all has been played and it only repeats, one of them ends it with its outcome.

    Raises:
        KeyboardInterrupt: one of them came.
    """
    loop, task, interrupted = asyncio.get_running_loop(), asyncio.current_task(), False
    assert task is not None  # noqa: S101 - a coroutine runs in one

    def interrupt() -> None:
        nonlocal interrupted
        if not session.enough():
            interrupted = True
            task.cancel()

    for number in (*_ends_on(), signal.SIGINT):
        loop.add_signal_handler(number, interrupt)
    try:
        return await session.run()
    except asyncio.CancelledError:
        if interrupted:
            raise KeyboardInterrupt from None
        raise


def _ends_on() -> list[signal.Signals]:
    return [n for n in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is not signal.SIG_IGN]


@contextlib.contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """SIGTERM and a lost terminal do what Ctrl-C does, also while no event loop runs."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in _ends_on()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _play(script: Script, arguments: argparse.Namespace) -> DemoSummary:
    from sim_hw.demo.session import DemoSession, summarise  # noqa: PLC0415

    def play(on_message: Callable[[Received], None], on_page: Callable[[PageAddress], None]) -> DemoOutcome:
        session = DemoSession(
            script,
            speed=arguments.speed,
            broker_url=arguments.broker,
            on_message=on_message,
            snapshots=arguments.snapshots,
            on_page=on_page if arguments.page else None,
            again=arguments.again,
        )
        return asyncio.run(_interruptible(session))

    if arguments.json:
        summary = summarise(script, play(_print_message, _print_page), speed=arguments.speed)
        _print_json(summary)
        return summary
    from sim_hw.demo.view import View  # noqa: PLC0415

    with View(script, arguments.speed) as view:
        outcome = play(view.on_message, view.show_page)
    summary = summarise(script, outcome, speed=arguments.speed)
    view.show_summary(summary)
    view.show_snapshots(summary)
    return summary


def _print_page(address: PageAddress) -> None:
    page: DemoPage = {"type": "page", "address": address.look, "operator": address.act}
    _print_json(page)


def _print_message(message: Received) -> None:
    if message.kind in {"diagnosis", "alarm", "status"}:
        _print_json({"type": message.kind, "topic": message.topic, **message.payload})


def _print_json(content: Mapping[str, Any]) -> None:
    print(json.dumps(content), flush=True)  # noqa: T201 - this is the output


def script_of(arguments: argparse.Namespace) -> Script:
    """What the arguments ask to play.

    Raises:
        DemoError, RecordingError, ScenarioError: it cannot be played.
    """
    return _from_scenario(arguments) if arguments.recording is None else _from_recording(arguments)


def _from_scenario(arguments: argparse.Namespace) -> Script:
    import numpy as np  # noqa: PLC0415

    from sim_hw.demo.machines import laval_rig  # noqa: PLC0415
    from sim_hw.demo.session import Script  # noqa: PLC0415
    from sim_hw.scenario import Scenario, load_any_scenario  # noqa: PLC0415

    scenario = load_any_scenario(arguments.scenario or SCENARIO)
    if not isinstance(scenario, Scenario):
        return _of_bearing(scenario, arguments)
    machine = scenario.simulate(arguments.seed, arguments.snr_db)
    samples = np.column_stack([machine.channels[name] for name in ("x_um", "y_um", "keyphasor_v")])
    return Script(
        title=scenario.title,
        machine=lambda url: laval_rig(scenario, machine.noise_um, url),
        stream="shaft",
        samples=samples,
        rate_hz=machine.rate_hz,
        onsets=machine.onsets,
        samples_per_rev=machine.samples_per_rev,
        faults=scenario.node_faults(arguments.seed),
        seed=scenario.seed if arguments.seed is None else arguments.seed,
    )


def _of_bearing(scenario: BearingScenario, arguments: argparse.Namespace) -> Script:
    import numpy as np  # noqa: PLC0415

    from daqsvc.detectors.bearing.settings import BEARING  # noqa: PLC0415
    from daqsvc.recording.recording import Recording  # noqa: PLC0415
    from sim_hw.demo.machines import PlayedBearing, for_recording  # noqa: PLC0415
    from sim_hw.demo.session import Script  # noqa: PLC0415
    from sim_hw.scenario import Onset  # noqa: PLC0415

    run = scenario.accelerations(BEARING_RATE_HZ, arguments.seed, arguments.snr_db)
    samples = np.column_stack([run.rotor_m_s2, run.housing_m_s2])
    recording = Recording(("rotor", "housing"), samples, BEARING_RATE_HZ, Path(scenario.title), 0)
    bearing = PlayedBearing(SIMULATED_BEARING, scenario.plant.speed_rpm)
    per_rev = BEARING_RATE_HZ * 60.0 / scenario.plant.speed_rpm
    begins = [("healthy", 0.0), *((damage.part, damage.at_s) for damage in scenario.damage)]
    return Script(
        title=scenario.title,
        machine=lambda url: for_recording(recording, "m/s2", {}, url, bearing),
        stream="recording",
        samples=samples,
        rate_hz=BEARING_RATE_HZ,
        onsets=[
            Onset(DECISIONS.get(part, part), at_s * BEARING_RATE_HZ / per_rev, round(at_s * BEARING_RATE_HZ))
            for part, at_s in begins
        ],
        samples_per_rev=per_rev,
        faults=scenario.node_faults(arguments.seed),
        seed=scenario.seed if arguments.seed is None else arguments.seed,
        detector=BEARING,
    )


def _from_recording(arguments: argparse.Namespace) -> Script:
    from daqsvc.recording.recording import set_memory, stop_reading  # noqa: PLC0415
    from sim_hw.demo.machines import PlayedBearing, for_recording, playable, setpoints  # noqa: PLC0415
    from sim_hw.demo.session import Script  # noqa: PLC0415

    set_memory(arguments.max_memory)
    machine = None
    if arguments.machine is not None:
        from daqsvc.settings import load_machine_file  # noqa: PLC0415

        machine = load_machine_file(arguments.machine)
    recording = playable(_load(arguments.recording, arguments.map, arguments.fs, "--map", machine))
    limits: AlarmLimits = {}
    if arguments.baseline is not None:
        rate_hz = arguments.baseline_fs or arguments.fs
        healthy = _load(
            arguments.baseline, arguments.baseline_map or arguments.map, rate_hz, "--baseline-map", machine
        )
        healthy = playable(healthy)
        limits = setpoints(healthy, recording.rate_hz)
        if not set(limits) & set(recording.names):
            raise DemoError(
                f"baseline {healthy.source} gives {', '.join(limits)}, the recording "
                f"{', '.join(recording.names)}; give both the same sensor names with --map and --baseline-map"
            )
    stop_reading()
    unit = arguments.unit or UNIT
    bearing = None
    if arguments.bearing is not None:
        bearing = PlayedBearing(arguments.bearing, arguments.speed_rpm)
    # Made once before anything is started: it states what is wrong with the recording.
    for_recording(recording, unit, limits, "mqtt://127.0.0.1:1883", bearing)
    return Script(
        title=f"{recording.source.name}: {', '.join(recording.names)} at {recording.rate_hz:g} Hz",
        machine=lambda url: for_recording(recording, unit, limits, url, bearing),
        stream="recording",
        samples=recording.samples,
        rate_hz=recording.rate_hz,
    )


def _load(
    path: Path,
    channels: Mapping[str, str] | None,
    rate_hz: float | None,
    option: str,
    machine: MachineFile | None,
) -> Recording:
    from sim_hw.recordings import load_played  # noqa: PLC0415

    recording = load_played(path, channels, rate_hz, machine, "name that with --machine")
    if recording.left_out:
        left_out = ", ".join(f"{name} ({length} samples)" for name, length in recording.left_out.items())
        _say(
            f"warning: {path}: left out {left_out}: not as long as the others "
            f"({len(recording.samples)} samples); choose channels with {option}"
        )
    for note in recording.notes:
        _say(f"warning: {path}: {note}")
    return recording


OF_RECORDINGS = (
    "map",
    "fs",
    "max_memory",
    "machine",
    "unit",
    "baseline",
    "baseline_map",
    "baseline_fs",
    "bearing",
    "speed_rpm",
)
OF_SCENARIOS = ("scenario", "seed", "snr_db")
OF_BASELINES = ("baseline_map", "baseline_fs")


def misuse(arguments: argparse.Namespace) -> str | None:
    """What is wrong with arguments that are valid each for itself; None if nothing is."""
    if wrong := misplaced(arguments, OF_RECORDINGS, OF_SCENARIOS):
        return wrong
    if arguments.baseline is None and (option := first_option(arguments, OF_BASELINES)):
        return f"{option} goes with a baseline; give that with --baseline, or leave {option} out"
    if (arguments.bearing is None) != (arguments.speed_rpm is None):
        return "--bearing and --speed-rpm go together: its lines lie at multiples of the speed; give both"
    if arguments.bearing is not None and arguments.unit not in {None, "g", "m/s2"}:
        return f"--bearing needs accelerometers, and --unit is {arguments.unit}; leave one of the two out"
    return None


def broker_url(text: str) -> str:
    """``mqtt://HOST[:PORT]``; the text is kept out of the messages where it may hold a password."""
    form = "write mqtt://HOST or mqtt://HOST:PORT"
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        raise argparse.ArgumentTypeError(f"the port must be a number from 1 to 65535; {form}") from None
    if parts.scheme in {"mqtts", "ssl", "tls"}:
        raise argparse.ArgumentTypeError(f"the demo does not speak TLS ({parts.scheme}://); {form}")
    if parts.username is not None or parts.password is not None:
        raise argparse.ArgumentTypeError(f"the demo does not log in with a user and a password; {form}")
    if parts.scheme != "mqtt" or not parts.hostname:
        raise argparse.ArgumentTypeError(f"{text!r} is not the address of a broker; {form}")
    if port == 0:
        raise argparse.ArgumentTypeError(f"the port must be a number from 1 to 65535; {form}")
    if parts.path not in {"", "/"} or parts.query or parts.fragment:
        raise argparse.ArgumentTypeError(f"{text!r} has something after host and port; {form}")
    return text


def _say(message: str) -> None:
    print(f"daqsvc demo: {message}", file=sys.stderr)  # noqa: T201 - stdout is for what is played
