"""The calibrated rotor as a plugin, and whether its settings fit its sensors and the machine."""

from __future__ import annotations

from typing import TYPE_CHECKING, get_args

from daqsvc.detectors.rotor_synchronous.settings import ROTOR_SYNCHRONOUS, RotorSynchronous
from daqsvc.detectors.shaft.checks import check_geometry, check_rotor, check_sensors, named
from daqsvc.diagnosis.plugin import Detectability, DetectorPlugin, UnfitOptionError
from daqsvc.diagnosis.reading import Reading
from daqsvc.errors.detectors import CALIBRATION_FILE, NEEDS_KEYPHASOR
from daqsvc.errors.machine_file import NO_EFFECT, SAMPLED_TOO_SLOWLY
from daqsvc.rounding import rounded_up
from daqsvc.settings.problems import AssemblyError, Finding

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from daqsvc.detectors.rotor_synchronous.recorded import RecordedRotor
    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.plugin import DetectabilityOptions
    from daqsvc.diagnosis.recorded import RecordingOptions
    from daqsvc.rotor.laval import LavalRotor
    from daqsvc.rotor.synchronous.baseline import Calibration
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import KeyPath


class RotorSynchronousPlugin(DetectorPlugin[RotorSynchronous]):
    """The rotor against its own healthy state."""

    settings = RotorSynchronous
    about = "the rotor against its own healthy state"
    detector = ROTOR_SYNCHRONOUS
    states_speed = True
    calibrated = True
    predictable = True
    place = 2

    def sampled_together(self, settings: RotorSynchronous) -> tuple[str, ...]:
        """See `PipelineTable.sampled_together`."""
        return settings.sampled_together

    def checks(self, draft: MachineFile, settings: RotorSynchronous) -> Iterator[Iterator[Finding]]:
        """See `PipelineTable.checks`."""
        return synchronous_checks(draft, settings)

    def start_up_signals(
        self, draft: MachineFile, settings: RotorSynchronous
    ) -> Mapping[str, tuple[str, ...]]:
        """See `PipelineTable.start_up_signals`."""
        del draft, settings
        return {ROTOR_SYNCHRONOUS: ("speed", "1x.amplitude")}

    def describe(self, machine: MachineFile, settings: RotorSynchronous) -> str:
        """See `PipelineTable.describe`."""
        return _described(machine, settings)

    def build(
        self, machine: MachineFile, settings: RotorSynchronous, store: Path | None
    ) -> tuple[Detector, ...]:
        """See `DetectorPlugin.build`."""
        from daqsvc.detectors.rotor_synchronous.build import rotor_synchronous  # noqa: PLC0415 - brings SciPy

        return (rotor_synchronous(machine, settings, _healthy_rotor(machine, settings), store),)

    def check_files(self, machine: MachineFile, settings: RotorSynchronous) -> None:
        """See `DetectorPlugin.check_files`: whether its calibration can be used."""
        _healthy_rotor(machine, settings)

    def recorded(
        self, machine: MachineFile, settings: RotorSynchronous, options: RecordingOptions
    ) -> RecordedRotor:
        """See `DetectorPlugin.recorded`."""
        from daqsvc.detectors.rotor_synchronous.recorded import RecordedRotor  # noqa: PLC0415 - brings SciPy

        return RecordedRotor(machine, settings, options)

    def detectability(
        self, machine: MachineFile, settings: RotorSynchronous, options: DetectabilityOptions
    ) -> Detectability:
        """See `DetectorPlugin.detectability`."""
        if options.process_noise is not None:
            raise UnfitOptionError(
                "--process-noise: there is no [pipeline.rotor_bank] that it belongs to; leave it out"
            )
        from daqsvc.detectors.rotor_synchronous import detectability as vector  # noqa: PLC0415 - brings NumPy

        prediction = vector.synchronous_detectability(
            machine, settings, noise_um=options.noise_um, eccentricity_um=options.eccentricity_um
        )
        return Detectability(
            {**vector.as_json(prediction, machine, settings)}, vector.as_text(prediction, machine)
        )

    def readings(self, machine: MachineFile, settings: RotorSynchronous) -> Iterator[Reading]:
        """See `DetectorPlugin.readings`."""
        from daqsvc.rotor.synchronous.signatures import RotorFault  # noqa: PLC0415 - brings NumPy's solvers

        del machine, settings
        yield Reading(ROTOR_SYNCHRONOUS, "statistics", "speed", "rpm")
        yield Reading(ROTOR_SYNCHRONOUS, "statistics", "1x.amplitude", "um")
        yield Reading(ROTOR_SYNCHRONOUS, "statistics", "1x.phase", "deg")
        for fault in get_args(RotorFault):
            yield Reading(ROTOR_SYNCHRONOUS, "probabilities", fault)


def _healthy_rotor(
    machine: MachineFile, settings: RotorSynchronous
) -> tuple[LavalRotor, tuple[Calibration, ...]]:
    from daqsvc.detectors.rotor_synchronous.build import healthy_rotor  # noqa: PLC0415 - brings SciPy
    from daqsvc.rotor.calibration.file import CalibrationFileError  # noqa: PLC0415 - as above

    try:
        return healthy_rotor(machine, settings)
    except CalibrationFileError as error:
        raise AssemblyError(
            f"{machine.path}: pipeline.rotor_synchronous.calibration = {str(settings.calibration)!r}: "
            f"{error}",
            code=CALIBRATION_FILE,
        ) from error


def _described(machine: MachineFile, synchronous: RotorSynchronous) -> str:
    *others, last = synchronous.sensors
    speed_rpm = abs(machine.machine.speed_rpm)
    angle = {
        "keyphasor": "angle from the keyphasor",
        "fixed": f"angle from {speed_rpm:g} rpm, taken as exact",
        "orbit": f"angle from the orbit's 1X around {speed_rpm:g} rpm",
    }
    healthy = (
        f"the first {synchronous.calibrate_revolutions} revolutions are the healthy state, kept over restarts"
        if synchronous.calibration is None
        else f"healthy state in {synchronous.calibration} (that of the first "
        f"{synchronous.calibrate_revolutions} revolutions if a run-up is all that it holds)"
    )
    parts = [
        f"{', '.join(others)} and {last}",
        angle[synchronous.reference],
        healthy,
        f"at most {synchronous.false_alarms_per_1000_rev:g} false alarms in 1000 revolutions",
        f"natural frequency within {synchronous.natural_frequency_tolerance_percent:g} %",
        f"damping within {synchronous.damping_tolerance_percent:g} %",
    ]
    if machine.ac_coupled:
        parts.append("no mean position from AC-coupled probes, so no static load is seen")
    return "; ".join(parts)


_SYNCHRONOUS: KeyPath = ("pipeline", "rotor_synchronous")
_LEAST_SAMPLES_PER_REV = 12.0
"""Mean, 1X and 2X both ways are five complex figures; the rest is left for the noise."""


def synchronous_checks(draft: MachineFile, synchronous: RotorSynchronous) -> Iterator[Iterator[Finding]]:
    """Every check of the calibrated rotor.

    Args:
        draft: the machine file, or what is valid of it.
        synchronous: its calibrated rotor.
    """
    at, probes = _SYNCHRONOUS, synchronous.probes
    yield check_rotor(draft, at, "the calibrated rotor")
    yield check_sensors(draft, at, probes, synchronous.keyphasor)
    yield check_geometry(draft, at, probes)
    yield _speed_source(synchronous)
    yield _samples_per_rev(draft, synchronous)


def _speed_source(synchronous: RotorSynchronous) -> Iterator[Finding]:
    """The source of the shaft angle is there, and what is there gives the angle."""
    if synchronous.reference == "keyphasor" and synchronous.keyphasor is None:
        yield Finding(
            (*_SYNCHRONOUS, "speed_source"),
            "needs a keyphasor, and none is named",
            'add keyphasor, or write speed_source = "fixed" or "orbit"',
            code=NEEDS_KEYPHASOR,
        )
    elif synchronous.reference != "keyphasor" and synchronous.keyphasor is not None:
        yield Finding(
            (*_SYNCHRONOUS, "keyphasor"),
            f'is not used: the shaft angle comes from speed_source = "{synchronous.reference}"',
            'write speed_source = "keyphasor", or remove it',
            fatal=False,
            code=NO_EFFECT,
        )


def _samples_per_rev(draft: MachineFile, synchronous: RotorSynchronous) -> Iterator[Finding]:
    """A revolution has enough samples for its harmonics."""
    known = named(draft)
    sensors = [known[name] for name in synchronous.sensors if name in known]
    rates_hz = [draft.streams[s.stream].rate_hz for s in sensors if s.stream in draft.streams]
    if not rates_hz:
        return
    rate_hz, speed_rpm = min(rates_hz), abs(draft.machine.speed_rpm)
    samples = 60.0 * rate_hz / speed_rpm
    if samples < _LEAST_SAMPLES_PER_REV:
        yield Finding(
            (*_SYNCHRONOUS, "probes"),
            f"are sampled {samples:.3g} times a revolution ({rate_hz:g} Hz at {speed_rpm:g} rpm); 1X and 2X "
            f"need {_LEAST_SAMPLES_PER_REV:g}",
            f"sample at {rounded_up(_LEAST_SAMPLES_PER_REV * speed_rpm / 60.0, 4)} Hz or faster, "
            "or remove [pipeline.rotor_synchronous]",
            code=SAMPLED_TOO_SLOWLY,
        )
