"""Whether what is said of the calibrated rotor fits its sensors and the machine."""

from __future__ import annotations

from typing import TYPE_CHECKING

from daqsvc.detectors.shaft.checks import check_geometry, check_rotor, check_sensors, named
from daqsvc.settings.problems import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.detectors.rotor_synchronous.settings import RotorSynchronous
    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import KeyPath

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
    """What tells the shaft angle is there, and what is there tells it."""
    if synchronous.reference == "keyphasor" and synchronous.keyphasor is None:
        yield Finding(
            (*_SYNCHRONOUS, "speed_source"),
            "needs a keyphasor, and none is named",
            'add keyphasor, or write speed_source = "fixed" or "orbit"',
        )
    elif synchronous.reference != "keyphasor" and synchronous.keyphasor is not None:
        yield Finding(
            (*_SYNCHRONOUS, "keyphasor"),
            f'is not looked at: the shaft angle comes from speed_source = "{synchronous.reference}"',
            'write speed_source = "keyphasor", or remove it',
            fatal=False,
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
            f"sample at {_LEAST_SAMPLES_PER_REV * speed_rpm / 60.0:.4g} Hz or faster, "
            "or remove [pipeline.rotor_synchronous]",
        )
