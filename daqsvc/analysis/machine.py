"""Recordings of a machine that has a machine file: every detector that watches it live judges them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from daqsvc.analysis.bank import bank_analysis
from daqsvc.analysis.bearing_machine import (
    analyse_machine_bearings,
    bearings_not_judged,
    check_bearings,
    present,
)
from daqsvc.analysis.bearing_setup import matching
from daqsvc.analysis.can_logs import is_can_log, load_can_log
from daqsvc.analysis.many import Outcome
from daqsvc.analysis.quality import known_against
from daqsvc.analysis.result import RotorAnalysis
from daqsvc.analysis.rotor import analyse
from daqsvc.analysis.setup import Keyphasor, RefusedError, RotorSetup
from daqsvc.analysis.statements import Statements, by_name, listen, worst
from daqsvc.detectors.bearing.settings import Bearing
from daqsvc.detectors.make import detectors
from daqsvc.detectors.rotor_bank.settings import ROTOR_BANK, RotorBank
from daqsvc.detectors.rotor_synchronous.build import healthy_rotor
from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous
from daqsvc.recording.channels import UM_PER_UNIT
from daqsvc.recording.errors import RecordingError
from daqsvc.recording.recording import list_channels, load_recording
from daqsvc.rotor.synchronous.watch import WatchRules
from daqsvc.settings import load_machine_file, models

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from daqsvc.analysis.bearing_machine import MachineBearings
    from daqsvc.analysis.bearing_result import BearingAnalysis
    from daqsvc.recording.channels import LengthUnit
    from daqsvc.recording.recording import Recording
    from daqsvc.settings import MachineFile

    Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineAnalyst:
    """Judges recordings of the machine of a machine file.

    A sensor's samples are the variable that ``channels`` says, else the one with the sensor's name, else the
    one with its channel's name. Detectors whose sensors the recording lacks are left out. The recording's
    sampling rate replaces that of the streams.

    Attributes:
        machine: path of the machine file.
        channels: which variable of a recording is which sensor or channel.
        rate_hz: sampling rate; None: what the recording says.
        unit: unit of the proximity probes in the recording; None: those of the sensors.
        calibration: file with the healthy machine, in place of what the machine file names.
        read: the machine file as soon as it was read; it stays in its process.
    """

    machine: str
    channels: Mapping[str, str] = field(default_factory=dict)
    rate_hz: float | None = None
    unit: LengthUnit | None = None
    calibration: Path | None = None
    read: list[MachineFile] = field(default_factory=list, repr=False, compare=False)

    def __getstate__(self) -> tuple[Any, ...]:
        """All but what was read: the models of its tables are made where it is read."""
        return self.machine, self.channels, self.rate_hz, self.unit, self.calibration

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        """As it was, in another process."""
        names = ("machine", "channels", "rate_hz", "unit", "calibration", "read")
        for name, value in zip(names, (*state, []), strict=True):
            object.__setattr__(self, name, value)

    def machine_file(self) -> MachineFile:
        """The machine file, read once a process.

        Raises:
            MachineFileError: it cannot be used.
        """
        if not self.read:
            self.read.append(load_machine_file(Path(self.machine)))
        return self.read[0]

    def check(self) -> None:
        """See whether the map fits the machine.

        Raises:
            ValueError: it names what is no sensor or channel, or the calibration cannot be used.
            MachineFileError: the machine file cannot be used.
        """
        machine = self.machine_file()
        self.check_map(machine)
        synchronous = machine.pipeline.table(RotorSynchronous)
        if synchronous is not None:
            healthy_rotor(machine, synchronous, self.calibration)
        elif self.calibration is not None and machine.pipeline.table(Bearing) is None:
            raise ValueError(
                f"--calibration: {self.machine} has neither [pipeline.rotor_synchronous] nor "
                "[pipeline.bearing] that would use it; add it"
            )
        if machine.pipeline.table(Bearing) is not None:
            check_bearings(machine, self._of_bearings(machine))

    def check_map(self, machine: MachineFile) -> None:
        """See whether the map names sensors or channels of a machine.

        Args:
            machine: the machine file, loaded.

        Raises:
            ValueError: it does not.
        """
        known = {name for sensor in machine.sensors for name in (sensor.name, sensor.channel)}
        if unknown := [name for name in self.channels if name not in known]:
            raise ValueError(
                f"--map names {unknown[0]!r}, which is no sensor of {self.machine}; there are "
                f"{', '.join(sensor.name for sensor in machine.sensors)}"
            )

    def judge(
        self, recording: str, figures: str | None, progress: Callable[[int, int], None] | None = None
    ) -> Outcome:
        """See `daqsvc.analysis.many.Analyst.judge`."""
        machine = self.machine_file()
        try:
            loaded = self.load(machine, recording)
        except (RecordingError, RefusedError) as error:
            return _outcome(_not_judged(machine, recording, str(error)), ())
        machine = _as_recorded(machine, loaded)
        analysis: RotorAnalysis | BearingAnalysis | None = None
        synchronous = machine.pipeline.table(RotorSynchronous)
        if synchronous is not None:
            setup = self.setup(machine, synchronous)
            analysis = analyse(loaded, setup, progress)
            if figures is not None and analysis.trace is not None:
                from daqsvc.analysis.plots import draw  # noqa: PLC0415 - brings matplotlib

                draw(loaded, setup, analysis, figures)
        statements = self._statements(machine, loaded)
        bank = statements.get(ROTOR_BANK)
        if bank is not None:
            if figures is not None:
                from daqsvc.analysis.bank_plots import draw_bank  # noqa: PLC0415 - brings matplotlib

                draw_bank(loaded, bank, f"{figures}-bank")
            if analysis is None:
                analysis = bank_analysis(loaded, bank)
        if analysis is None and machine.pipeline.table(Bearing) is None:
            analysis = RotorAnalysis(recording=recording, quality=known_against(loaded))
        try:
            bearings = self._bearings(machine, loaded, figures)
        except ValueError as error:
            analysis, bearings = _not_judged(machine, recording, str(error)), None
        return _outcome(analysis, tuple(statements.values()), bearings, loaded.notes)

    def load(self, machine: MachineFile, recording: str, only: Sequence[str] | None = None) -> Recording:
        """The sensors of a machine in a recording, by their names.

        Args:
            machine: the machine file, loaded.
            recording: path of the recording: a file, a CAN log, or a folder of CAN logs.
            only: names of the sensors that are wanted; None: all that it has.

        Raises:
            RecordingError: it cannot be read.
            RefusedError: it lacks a sensor that is wanted, or of the rotor's detector, or has none at all.
        """
        if not is_can_log(recording):
            columns = self.columns(machine, recording)
            self._refuse_lacking(machine, recording, only or (), columns)
            wanted = columns if only is None else {name: columns[name] for name in only}
            return load_recording(recording, wanted, self.rate_hz)
        if self.channels or self.unit is not None:
            raise RefusedError(
                f"{recording} is a CAN log, of which the machine file says channels and units: leave out "
                f"{'--map' if self.channels else '--unit'}"
            )
        found = load_can_log(machine, recording, self.rate_hz)
        self._refuse_lacking(machine, recording, only or _needed(machine), found.names)
        if only is None:
            return found
        samples = found.samples[:, [found.names.index(name) for name in only]]
        return replace(
            found,
            names=tuple(only),
            samples=samples,
            nan_count=int(np.isnan(samples).sum()),
            infinity_count=int(np.isinf(samples).sum()),
        )

    def _refuse_lacking(
        self, machine: MachineFile, recording: str, wanted: Iterable[str], there: Container[str]
    ) -> None:
        """Refuse a recording without a sensor that is wanted.

        Raises:
            RefusedError: it lacks one.
        """
        lacking = [name for name in wanted if name not in there]
        if lacking and is_can_log(recording):
            raise RefusedError(
                f"{recording} holds no samples of {', '.join(lacking)} of {self.machine}; give the log of "
                "its bus too, in one folder"
            )
        if lacking:
            raise RefusedError(
                f"{recording} has no channel for {', '.join(lacking)} of {machine.path}; name its variable, "
                f"e.g. --map {lacking[0]}=VARIABLE"
            )

    def columns(self, machine: MachineFile, recording: str) -> dict[str, str]:
        """The variable of each sensor that a recording has.

        Args:
            machine: the machine file, loaded.
            recording: path of the recording.

        Raises:
            RecordingError: it cannot be read.
            RefusedError: it lacks a sensor of the rotor's detector, or has none at all.
        """
        there = list_channels(recording)
        found = {}
        for sensor in machine.sensors:
            mapped = self.channels.get(sensor.name, self.channels.get(sensor.channel))
            if mapped is not None:
                found[sensor.name] = matching(recording, mapped, there)
            elif sensor.name in there:
                found[sensor.name] = sensor.name
            elif sensor.channel in there:
                found[sensor.name] = sensor.channel
        missing = [name for name in _needed(machine) if name not in found]
        if missing or not found:
            missing = missing or [sensor.name for sensor in machine.sensors]
            raise RefusedError(
                f"{recording} has no channel for {', '.join(missing)} of {self.machine}; name its variable, "
                f"e.g. --map {missing[0]}=VARIABLE. It holds {', '.join(there) or 'no channel'}"
            )
        return found

    def setup(self, machine: MachineFile, given: RotorSynchronous) -> RotorSetup:
        """The calibrated rotor of a machine file, as `analyse` wants it.

        Args:
            machine: the machine file, loaded.
            given: its calibrated rotor.

        Raises:
            CalibrationFileError: its calibration cannot be used.
        """
        x, y = (cast("models.ProximityProbe", machine.sensor(name)) for name in given.probes)
        keyphasor = None
        if given.reference == "keyphasor" and given.keyphasor is not None:
            sensor = cast("models.Keyphasor", machine.sensor(given.keyphasor))
            keyphasor = Keyphasor(sensor.name, sensor.threshold_v, sensor.edge, sensor.hysteresis_v)
        rotor, calibrations = healthy_rotor(machine, given, self.calibration)
        return RotorSetup(
            probes=(x.name, y.name),
            probe_angles_deg=(x.angle_deg or 0.0, 90.0 if y.angle_deg is None else y.angle_deg),
            rotor=rotor,
            speed_rpm=machine.machine.speed_rpm,
            unit=self.unit or x.unit,
            keyphasor=keyphasor,
            follow_orbit=given.reference == "orbit",
            rules=WatchRules(
                calibrate_revolutions=given.calibrate_revolutions,
                false_alarms_per_1000_rev=given.false_alarms_per_1000_rev,
                probe_drift_um=given.probe_drift_um,
                retry=False,
            ),
            calibrations=calibrations,
            ac_coupled=machine.ac_coupled,
        )

    def _bearings(
        self, machine: MachineFile, recording: Recording, figures: str | None
    ) -> MachineBearings | None:
        """What the bearings' detector says; None without one.

        Raises:
            ValueError: its calibration cannot be used.
        """
        given = machine.pipeline.table(Bearing)
        if given is None:
            return None
        stream = machine.sensor(given.bearings[0].sensor).stream
        samples = self._stream(machine, stream, recording)
        found = analyse_machine_bearings(machine, recording, samples, self._of_bearings(machine))
        if figures is not None and found.analysis.races:
            from daqsvc.analysis.bearing_plots import draw_envelopes  # noqa: PLC0415 - brings matplotlib

            draw_envelopes(found.analysis, figures)
        return found

    def _of_bearings(self, machine: MachineFile) -> Path | None:
        """The calibration that was given, if it is for the bearings: a rotor's comes first."""
        return self.calibration if machine.pipeline.table(RotorSynchronous) is None else None

    def _statements(self, machine: MachineFile, recording: Recording) -> dict[str, Statements]:
        """What the other detectors say, by name."""
        pipeline = machine.pipeline.model_copy(update={"rotor_synchronous": None, "bearing": None})
        others = machine.model_copy(update={"pipeline": pipeline})
        streams = {name: self._stream(machine, name, recording) for name in machine.streams}
        for grid in machine.grids:
            # A recording has all its channels on one grid already.
            streams[grid.name] = np.concatenate([streams[name] for name in grid.streams], axis=1)
        return {
            statements.detector: statements
            for detector in detectors(others)
            for statements in by_name(
                detector.name,
                tuple(listen(detector, streams[detector.stream], recording.rate_hz)),
                recording.rate_hz,
                getattr(detector, "faults", {}),
            )
        }

    def _stream(self, machine: MachineFile, stream: str, recording: Recording) -> Floats:
        """The recording in columns and units of a stream, float64 ``[n, channels]``; NaN where missing."""
        names = machine.streams[stream].layout.channel_names
        samples = np.full((len(recording.samples), len(names)), np.nan)
        for sensor in machine.sensors:
            if sensor.stream == stream:
                column = recording.samples[:, recording.names.index(sensor.name)]
                if isinstance(sensor, models.ProximityProbe) and self.unit is not None:
                    column = column * UM_PER_UNIT[self.unit] / UM_PER_UNIT[sensor.unit]
                samples[:, names.index(sensor.channel)] = column
        return np.where(np.isfinite(samples), samples, np.nan)


def _needed(machine: MachineFile) -> tuple[str, ...]:
    """The sensors without which the rotor cannot be judged."""
    synchronous, bank = machine.pipeline.table(RotorSynchronous), machine.pipeline.table(RotorBank)
    if synchronous is not None:
        return synchronous.sensors
    return () if bank is None else (*bank.probes, bank.keyphasor)


def _as_recorded(machine: MachineFile, recording: Recording) -> MachineFile:
    """The machine with the sensors of a recording only, the detectors that they suffice for, and its rate."""
    sensors = tuple(sensor for sensor in machine.sensors if sensor.name in recording.names)
    bank = machine.pipeline.table(RotorBank)
    update: dict[str, Any] = {}
    if bank is not None and not {*bank.probes, bank.keyphasor} <= set(recording.names):
        update["rotor_bank"] = None
    update["bearing"] = present(machine.pipeline.table(Bearing), recording.names)
    streams = {
        name: stream.model_copy(update={"rate_hz": recording.rate_hz})
        for name, stream in machine.streams.items()
    }
    return machine.model_copy(
        update={
            "sensors": sensors,
            "streams": streams,
            "pipeline": machine.pipeline.model_copy(update=update),
        }
    )


def _not_judged(machine: MachineFile, recording: str, why: str) -> RotorAnalysis | BearingAnalysis:
    """The verdict about a recording that cannot be judged, with the keys that one about it would have."""
    pipeline = machine.pipeline
    if (
        pipeline.table(Bearing) is None
        or pipeline.table(RotorSynchronous) is not None
        or pipeline.table(RotorBank) is not None
    ):
        return RotorAnalysis.not_judged(recording, why)
    return bearings_not_judged(machine, recording, why)


def _outcome(
    analysis: RotorAnalysis | BearingAnalysis | None,
    statements: tuple[Statements, ...],
    bearings: MachineBearings | None = None,
    notes: Iterable[str] = (),
) -> Outcome:
    """The rotor's verdict comes first; the bearings' if nothing watches the rotor."""
    first = analysis if analysis is not None or bearings is None else bearings.analysis
    assert first is not None  # noqa: S101 - one of the two is there
    found = first.as_json()
    quality = found["data_quality"]
    quality["problems"] = list(dict.fromkeys([*notes, *quality["problems"]]))
    texts = [first.describe(), *(said.describe() for said in statements)]
    if bearings is not None:
        statements = (*statements, bearings.statements)
        if first is analysis:
            found["bearing"] = bearings.analysis.as_json()
            texts.append(f"bearings of {bearings.analysis.describe()}")
    found["detectors"] = {said.detector: said.as_json() for said in statements}
    if alarmed := worst(statements):
        texts.insert(1, f"worst of the other detectors: {alarmed}")
    texts[1:1] = [note for note in notes if note not in texts[0]]
    return Outcome(found, "\n  ".join(texts), first.refused is not None)
