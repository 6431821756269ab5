"""``daqsvc calibrate``: the healthy machine, from recordings or from the live bus, into a file."""

from __future__ import annotations

import asyncio
import json
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from daqsvc.commands.arguments import EXIT_OK, EXIT_REFUSED, EXIT_USAGE, refuse_value, signals_to_end
from daqsvc.commands.complaint import complain
from daqsvc.commands.recording_options import (
    add_calibrate_options,
    bearing_recording_misuse,
    calibrate_misuse,
    calibrates_bearing,
    refuse,
    split_files,
)
from daqsvc.commands.with_kernels import VerbWithKernels
from daqsvc.errors.command_line import INTERRUPTED, WRONG_VALUE

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable, Sequence

    from daqsvc.bearing.baseline import BearingBaseline
    from daqsvc.commands.calibrate_report import Refused
    from daqsvc.errors.code import Code
    from daqsvc.offline.runner import Runner
    from daqsvc.recording.recording import Recording
    from daqsvc.rotor.calibration.file import CalibrationRecord
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings import MachineFile


class CalibrateCommand(VerbWithKernels):
    """``daqsvc calibrate [MACHINE] [RECORDING...]``."""

    help = "learn the healthy machine from recordings or the live bus, and write it to a file"
    description = (
        "Learn what the healthy machine looks like, with uncertainties, and which faults its model can "
        "tell apart. A recording in which the speed changes by more than 10 % is a run-up or "
        "coast-down: from it come natural frequency, damping and unbalance. From a recording at steady "
        "speed comes the baseline at that speed. With --channels, or a machine file with "
        "[pipeline.bearing], learn the healthy state of rolling bearings. Data that cannot be those of "
        "a healthy machine are refused, and nothing is written."
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """See `Command.add_arguments`."""
        self._parser = parser
        parser.epilog = (
            "Exit code: 0 if the calibration was made; 2 for wrong usage; 3 if the data were refused "
            "(one line has the reason); 1 if something else failed."
        )
        add_calibrate_options(parser)

    def run(self, arguments: argparse.Namespace) -> int:
        """See `Command.run`."""
        from daqsvc.recording.recording import set_memory  # noqa: PLC0415 - each verb imports what it needs

        set_memory(arguments.max_memory)
        self._prepare_kernel_cache()
        path, recordings = split_files(arguments)
        if wrong := calibrate_misuse(arguments, path, recordings):
            refuse(self._parser, wrong, recordings)
        if arguments.out is not None and not arguments.out.absolute().parent.is_dir():
            self._parser.error(f"--out {arguments.out}: there is no such directory; make it first")
        machine = None
        if path is not None:
            machine = self._load(path)
            if machine is None:
                return EXIT_USAGE
        from daqsvc.bearing.identify import NotIdentifiableError  # noqa: PLC0415
        from daqsvc.dsp.quality import RefusedError  # noqa: PLC0415
        from daqsvc.recording import RecordingError  # noqa: PLC0415
        from daqsvc.rotor.synchronous.baseline import NotCalibratableError  # noqa: PLC0415

        try:
            if self._of_bearings(machine, recordings, arguments):
                return _keep_bearings(self._calibrated_bearings(machine, recordings[0], arguments), arguments)
            if machine is not None and arguments.live:
                return _keep(_live(machine, arguments), arguments)
            return _keep(self._calibrated_rotor(machine, recordings, arguments), arguments)
        except (RefusedError, RecordingError, NotCalibratableError, NotIdentifiableError) as error:
            return _refuse(str(error), error.code, as_json=arguments.json)
        except _FailedError as error:
            return complain("daqsvc calibrate", error, error.code)

    def _of_bearings(
        self, machine: MachineFile | None, recordings: Sequence[str], arguments: argparse.Namespace
    ) -> bool:
        """Whether the bearings are calibrated; a rotor comes first."""
        if machine is None:
            return calibrates_bearing(arguments)
        from daqsvc.detectors.bearing.settings import Bearing  # noqa: PLC0415 - brings pydantic
        from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous  # noqa: PLC0415 - as above

        if machine.pipeline.table(RotorSynchronous) is not None:
            return False
        if machine.pipeline.table(Bearing) is None:
            from daqsvc.offline.runner import calibrated_tables  # noqa: PLC0415

            self._parser.error(
                f"{machine.path} has neither {' nor '.join(calibrated_tables())} to be calibrated; add one"
            )
        if wrong := bearing_recording_misuse(arguments, recordings):
            self._parser.error(wrong)
        return True

    def _runner(
        self, make: Callable[[argparse.Namespace], MachineFile], machine: MachineFile | None, arguments: Any
    ) -> Runner:
        """What reads the recordings of the machine file, or of one that the options make.

        Args:
            make: makes it of the options.
            machine: the machine file on disk, if there is one.
            arguments: the options.
        """
        from daqsvc.offline.machine_options import WrongValueError, recording_options  # noqa: PLC0415
        from daqsvc.offline.runner import Runner  # noqa: PLC0415

        patterns = calibrates_bearing(arguments)
        options = recording_options(arguments, in_memory=machine is None, patterns=patterns)
        try:
            runner = Runner(lambda: make(arguments), options, machine=machine and _uncalibrated(machine))
            runner.prepare()
        except WrongValueError as error:
            refuse_value(self._parser, error, error.code)
        except ValueError as error:
            self._parser.error(str(error))
        return runner

    def _calibrated_rotor(
        self, machine: MachineFile | None, recordings: Sequence[str], arguments: argparse.Namespace
    ) -> CalibrationRecord:
        from daqsvc.detectors.rotor_synchronous.calibrating import calibrate_recordings  # noqa: PLC0415
        from daqsvc.detectors.rotor_synchronous.recorded import RecordedRotor  # noqa: PLC0415
        from daqsvc.offline.machine_options import rotor_machine  # noqa: PLC0415

        runner = self._runner(rotor_machine, machine, arguments)
        rotor = next(one for one in runner.detectors.values() if isinstance(one, RecordedRotor))
        loaded = [runner.load(path, only=rotor.sensors) for path in recordings]
        return calibrate_recordings(
            _with_notes_printed(loaded),
            rotor.setup,
            rotor_is_known=machine is not None or arguments.natural_frequency_hz is not None,
            sweep_rpm=arguments.sweep_rpm,
        )

    def _calibrated_bearings(
        self, machine: MachineFile | None, recording: str, arguments: argparse.Namespace
    ) -> BearingBaseline:
        from daqsvc.bearing.identify import NotIdentifiableError  # noqa: PLC0415
        from daqsvc.detectors.bearing.calibrating import calibrate_bearings  # noqa: PLC0415
        from daqsvc.detectors.bearing.recorded import RecordedBearings  # noqa: PLC0415
        from daqsvc.dsp.quality import RefusedError  # noqa: PLC0415
        from daqsvc.offline.machine_options import bearing_machine  # noqa: PLC0415

        runner = self._runner(bearing_machine, machine, arguments)
        (bearings,) = (one for one in runner.detectors.values() if isinstance(one, RecordedBearings))
        (loaded,) = _with_notes_printed([runner.load(recording, only=bearings.sensors)])
        try:
            return calibrate_bearings(runner.machine, bearings.settings, loaded, together=machine is None)
        except (RefusedError, NotIdentifiableError):
            raise
        except ValueError as error:
            self._parser.error(str(error))  # masses and springs that the rate of the stream is too low for


def _uncalibrated(machine: MachineFile) -> MachineFile:
    """The machine without the calibrations that its tables name: they are about to be made."""
    from daqsvc.settings.plugins import configured  # noqa: PLC0415

    update = {
        key: settings.model_copy(update={"calibration": None})
        for key, _, settings in configured(machine.pipeline)
        if "calibration" in type(settings).model_fields
    }
    return machine.model_copy(update={"pipeline": machine.pipeline.model_copy(update=update)})


def _with_notes_printed(loaded: Sequence[Recording]) -> Sequence[Recording]:
    """Recordings, after the problems in reading them were printed."""
    for recording in loaded:
        for note in recording.notes:
            print(f"daqsvc calibrate: warning: {recording.source}: {note}", file=sys.stderr)  # noqa: T201
    return loaded


def _live(machine: MachineFile, arguments: argparse.Namespace) -> CalibrationRecord:
    """Listen to the machine; the terminal sees the revolutions go by."""
    from daqsvc.acquisition.clock import SystemClock  # noqa: PLC0415
    from daqsvc.offline.calibrate_live import calibrate_live, default_timeout_s  # noqa: PLC0415
    from daqsvc.offline.progress import progress_bar  # noqa: PLC0415
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
        raise _FailedError("interrupted; nothing was written", INTERRUPTED) from None
    except (AssemblyError, DeviceAbsentError, LayoutError) as error:
        raise _FailedError(str(error), error.code) from None
    source = f"live, {machine.machine.name}"
    return CalibrationRecord(rotor=made.rotor, steady=(made,), steady_sources=(source,))


class _FailedError(Exception):
    """Something else than the data or the usage is at fault."""

    def __init__(self, message: str, code: Code | None) -> None:
        super().__init__(message)
        self.code = code


def _keep(record: CalibrationRecord, arguments: argparse.Namespace) -> int:
    """Write the file first, then print what was found."""
    from daqsvc.acquisition.clock import SystemClock, iso_utc  # noqa: PLC0415
    from daqsvc.commands.calibrate_report import as_json, as_text  # noqa: PLC0415
    from daqsvc.rotor.calibration.file import CalibrationFileError, save_record  # noqa: PLC0415

    record = replace(record, written=iso_utc(SystemClock().wall_ns()))
    try:
        sentence = (
            json.dumps(as_json(record, arguments.predict_rpm, arguments.out))
            if arguments.json
            else as_text(record, arguments.predict_rpm)
        )
    except ValueError as error:
        return _refuse(f"--predict-rpm: {error}", WRONG_VALUE, as_json=arguments.json)
    if arguments.out is not None:
        try:
            save_record(record, arguments.out)
        except CalibrationFileError as error:
            return complain("daqsvc calibrate", error, error.code)
        if not arguments.json:
            sentence += f"\nwritten to {arguments.out}"
    print(sentence, flush=True)  # noqa: T201 - this is what the verb is for
    return EXIT_OK


def _keep_bearings(baseline: BearingBaseline, arguments: argparse.Namespace) -> int:
    """Write the file first, then print what was found."""
    from daqsvc.acquisition.clock import SystemClock, iso_utc  # noqa: PLC0415
    from daqsvc.bearing.baseline import BaselineFileError, save_bearing_baseline  # noqa: PLC0415
    from daqsvc.commands.calibrate_report import bearings_as_json, bearings_as_text  # noqa: PLC0415

    baseline = replace(baseline, written=iso_utc(SystemClock().wall_ns()))
    if arguments.out is not None:
        try:
            save_bearing_baseline(baseline, arguments.out)
        except BaselineFileError as error:
            return complain("daqsvc calibrate", error, error.code)
    sentence = (
        json.dumps(bearings_as_json(baseline, arguments.out))
        if arguments.json
        else bearings_as_text(baseline, arguments.out)
    )
    print(sentence, flush=True)  # noqa: T201 - this is what the verb is for
    return EXIT_OK


def _refuse(why: str, code: Code, *, as_json: bool) -> int:
    if as_json:
        refused: Refused = {"refused": why, "code": code.id}
        print(json.dumps(refused), flush=True)  # noqa: T201
        return EXIT_REFUSED
    return complain("not calibrated", why, code, EXIT_REFUSED)
