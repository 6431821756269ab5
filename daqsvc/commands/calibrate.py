"""``daqsvc calibrate``: the healthy machine, from recordings or from the live bus, into a file."""

from __future__ import annotations

import asyncio
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from daqsvc.commands.calibrate_arguments import add_calibrate_arguments, misuse
from daqsvc.commands.calibrate_bearing import (
    add_bearing_arguments,
    bearing_misuse,
    by_bearing,
    calibrate_bearings,
    shared_misuse,
)
from daqsvc.commands.option_types import SpeedOption
from daqsvc.commands.signals import signals_to_end

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence

    from daqsvc.analysis.calibrating import CalibrationSetup
    from daqsvc.recording.recording import Recording
    from daqsvc.rotor.calibration.file import CalibrationRecord
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings import MachineFile

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_REFUSED = 3


class CalibrateCommand:
    """``daqsvc calibrate [MACHINE] [RECORDING...]``.

    Args:
        load: reads a machine file; None after its errors have been printed.
        prepare_kernel_cache: says where compiled kernels are kept.
    """

    help = "learn the healthy machine from recordings or the live bus, and write it to a file"
    description = (
        "Learn what the healthy machine looks like, with uncertainties, and what its model can and cannot "
        "tell apart. A recording through which the speed goes up or down by more than 10 % is a run-up and "
        "tells natural frequency, damping and unbalance; one at steady speed tells the baseline there. With "
        "--channels, or a machine file with [pipeline.bearing], the healthy state of rolling bearings. Data "
        "that cannot be a healthy machine are refused, and nothing is written."
    )

    def __init__(
        self, load: Callable[[Path], MachineFile | None], prepare_kernel_cache: Callable[[], None]
    ) -> None:
        self._load = load
        self._prepare_kernel_cache = prepare_kernel_cache

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `Command.add_arguments`."""
        self._parser = parser
        parser.epilog = (
            "Exit code: 0 if the calibration was made, 3 if the data were refused (one line says why), 2 for "
            "wrong usage, 1 if something else failed."
        )
        add_calibrate_arguments(parser)
        add_bearing_arguments(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `Command.run`."""
        from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous  # noqa: PLC0415 - pydantic
        from daqsvc.recording.recording import set_memory  # noqa: PLC0415 - each verb imports what it needs

        set_memory(arguments.max_memory)
        self._prepare_kernel_cache()
        machine_path = arguments.files[0] if arguments.files[0].lower().endswith(".toml") else None
        recordings = arguments.files[1:] if machine_path is not None else arguments.files
        if by_bearing(arguments):
            return self._bearings(recordings, arguments, bearing_misuse(arguments, machine_path, recordings))
        if wrong := misuse(arguments, machine_path, recordings):
            self._parser.error(wrong)
        self._need_directory(arguments)
        machine = None
        if machine_path is not None:
            machine = self._load(Path(machine_path))
            if machine is None:
                return EXIT_USAGE
            if machine.pipeline.table(RotorSynchronous) is None:
                return self._without_rotor(recordings, arguments, machine)
        from daqsvc.analysis.setup import RefusedError  # noqa: PLC0415
        from daqsvc.recording.errors import RecordingError  # noqa: PLC0415
        from daqsvc.rotor.synchronous.baseline import NotCalibratableError  # noqa: PLC0415

        try:
            if machine is None:
                record = self._from_options(recordings, arguments)
            elif arguments.live:
                record = _live(machine, arguments)
            else:
                record = self._from_machine(machine, recordings, arguments)
        except (RefusedError, RecordingError, NotCalibratableError) as error:
            return _refuse(str(error), as_json=arguments.json)
        except _FailedError as error:
            return _fail(str(error))
        return _keep(record, arguments)

    def _need_directory(self, arguments: argparse.Namespace) -> None:
        if arguments.out is not None and not arguments.out.absolute().parent.is_dir():
            self._parser.error(f"--out {arguments.out}: there is no such directory; make it first")

    def _without_rotor(
        self, recordings: Sequence[str], arguments: argparse.Namespace, machine: MachineFile
    ) -> int:
        from daqsvc.detectors.bearing.settings import Bearing  # noqa: PLC0415 - brings pydantic

        if machine.pipeline.table(Bearing) is None:
            self._parser.error(
                f"{machine.path} has neither [pipeline.rotor_synchronous] nor [pipeline.bearing] to be "
                "calibrated; add one"
            )
        return self._bearings(recordings, arguments, shared_misuse(arguments, recordings), machine)

    def _bearings(
        self,
        recordings: Sequence[str],
        arguments: argparse.Namespace,
        wrong: str,
        machine: MachineFile | None = None,
    ) -> int:
        if wrong:
            self._parser.error(wrong)
        self._need_directory(arguments)
        try:
            return calibrate_bearings(recordings[0], arguments, machine)
        except ValueError as error:
            self._parser.error(str(error))

    def _from_options(self, recordings: Sequence[str], arguments: argparse.Namespace) -> CalibrationRecord:
        from daqsvc.analysis.calibrating import calibrate_recordings  # noqa: PLC0415
        from daqsvc.recording.recording import load_recording  # noqa: PLC0415

        try:
            setup = _setup(arguments)
        except ValueError as error:
            self._parser.error(str(error))
        loaded = [load_recording(path, setup.taken.columns, arguments.fs) for path in recordings]
        return calibrate_recordings(_with_notes_said(loaded), setup)

    def _from_machine(
        self, machine: MachineFile, recordings: Sequence[str], arguments: argparse.Namespace
    ) -> CalibrationRecord:
        from daqsvc.analysis.calibrating import calibrate_recordings  # noqa: PLC0415
        from daqsvc.analysis.calibrating_machine import MachineRecordings  # noqa: PLC0415

        of_machine = MachineRecordings(machine, arguments.map, arguments.fs, arguments.unit)
        try:
            setup = of_machine.setup(arguments.sweep_rpm)
        except ValueError as error:
            self._parser.error(str(error))
        loaded = [of_machine.load(path) for path in recordings]
        return calibrate_recordings(_with_notes_said(loaded), setup)


def _with_notes_said(loaded: Sequence[Recording]) -> Sequence[Recording]:
    """Recordings, once what was wrong with them in reading has been said."""
    for recording in loaded:
        for note in recording.notes:
            print(f"daqsvc calibrate: warning: {recording.source}: {note}", file=sys.stderr)  # noqa: T201
    return loaded


def _setup(arguments: argparse.Namespace) -> CalibrationSetup:
    """What the options say.

    Raises:
        ValueError: they contradict each other.
    """
    from daqsvc.analysis.calibrating import CalibrationSetup  # noqa: PLC0415
    from daqsvc.analysis.setup import Keyphasor, RotorSetup  # noqa: PLC0415
    from daqsvc.rotor.laval import LavalRotor  # noqa: PLC0415

    speed, sweep_rpm = arguments.speed_rpm or SpeedOption(None), arguments.sweep_rpm
    given = arguments.natural_frequency_hz is not None
    rotor = LavalRotor(
        natural_frequency_hz=arguments.natural_frequency_hz if given else 1.0,
        damping_ratio=arguments.damping_ratio if given else 0.1,
        natural_frequency_tolerance=arguments.natural_frequency_tolerance / 100.0,
        damping_tolerance=arguments.damping_tolerance / 100.0,
        clearance_um=arguments.clearance_um,
        static_sag_um=arguments.static_sag_um,
    )
    keyphasor = None
    if arguments.keyphasor is not None:
        keyphasor = Keyphasor(arguments.keyphasor, arguments.keyphasor_threshold)
    taken = RotorSetup(
        probes=arguments.probes,
        rotor=rotor,
        speed_rpm=sweep_rpm[1] if speed.rpm is None and sweep_rpm is not None else speed.rpm,
        unit=arguments.unit or "um",
        keyphasor=keyphasor,
        follow_orbit=speed.orbit,
        ac_coupled=arguments.ac_coupled,
        channels=arguments.map,
        rate_hz=arguments.fs,
    )
    return CalibrationSetup(taken=taken, rotor_given=given, sweep_rpm=sweep_rpm)


def _live(machine: MachineFile, arguments: argparse.Namespace) -> CalibrationRecord:
    """Listen to the machine; the terminal sees the revolutions go by."""
    from daqsvc.acquisition.clock import SystemClock  # noqa: PLC0415
    from daqsvc.analysis.progress import progress_bar  # noqa: PLC0415
    from daqsvc.commands.calibrate_live import calibrate_live, default_timeout_s  # noqa: PLC0415
    from daqsvc.rotor.calibration.file import CalibrationRecord  # noqa: PLC0415
    from daqsvc.settings.problems import AssemblyError  # noqa: PLC0415
    from drivers.base import DeviceAbsentError  # noqa: PLC0415
    from drivers.frames import LayoutError  # noqa: PLC0415

    timeout_s = arguments.timeout_s or default_timeout_s(machine, arguments.revolutions)

    async def listen(progress: Callable[[int, int], None]) -> Calibration:
        listening = asyncio.current_task()
        assert listening is not None  # noqa: S101 - this is one
        for number in signals_to_end():
            asyncio.get_running_loop().add_signal_handler(number, listening.cancel)
        return await calibrate_live(
            machine,
            SystemClock(),
            revolutions=arguments.revolutions,
            timeout_s=timeout_s,
            progress=progress,
        )

    try:
        with progress_bar(f"{arguments.revolutions} revolutions") as bar:
            made = asyncio.run(listen(bar.update))
    except asyncio.CancelledError:
        raise _FailedError("interrupted; nothing was written") from None
    except (AssemblyError, DeviceAbsentError, LayoutError) as error:
        raise _FailedError(str(error)) from None
    source = f"live, {machine.machine.name}"
    return CalibrationRecord(rotor=made.rotor, steady=(made,), steady_sources=(source,))


class _FailedError(Exception):
    """Something else than the data or the usage is at fault."""


def _keep(record: CalibrationRecord, arguments: argparse.Namespace) -> int:
    """Write the file first, then say what was found."""
    from daqsvc.acquisition.clock import SystemClock, iso_utc  # noqa: PLC0415
    from daqsvc.commands.calibrate_report import as_json, as_text  # noqa: PLC0415
    from daqsvc.rotor.calibration.file import CalibrationFileError, save_record  # noqa: PLC0415

    record = replace(record, written=iso_utc(SystemClock().wall_ns()))
    try:
        said = (
            json.dumps(as_json(record, arguments.predict_rpm, arguments.out))
            if arguments.json
            else as_text(record, arguments.predict_rpm)
        )
    except ValueError as error:
        return _refuse(f"--predict-rpm: {error}", as_json=arguments.json)
    if arguments.out is not None:
        try:
            save_record(record, arguments.out)
        except CalibrationFileError as error:
            return _fail(str(error))
        if not arguments.json:
            said += f"\nwritten to {arguments.out}"
    print(said, flush=True)  # noqa: T201 - this is what the verb is for
    return EXIT_OK


def _refuse(why: str, *, as_json: bool) -> int:
    if as_json:
        print(json.dumps({"refused": why}), flush=True)  # noqa: T201
    else:
        print(f"not calibrated: {why}", file=sys.stderr)  # noqa: T201
    return EXIT_REFUSED


def _fail(message: str) -> int:
    print(f"daqsvc calibrate: {message}", file=sys.stderr)  # noqa: T201 - errors go to stderr
    return EXIT_FAILED
