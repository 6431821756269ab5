"""Whether what is said about streams with different clocks fits the detectors that take samples from them."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile
    from daqsvc.settings.problems import KeyPath

_ALIGNMENT: KeyPath = ("pipeline", "alignment")
_COARSE_DEG = 10.0
"""An error of the phase that a detector of the rotor takes for a change of the machine."""


def alignment_checks(draft: MachineFile) -> Iterator[Iterator[Finding]]:
    """Every check of the alignment.

    Args:
        draft: the machine file, or what is valid of it.
    """
    with suppress(UnusableValueError):
        if draft.pipeline.alignment is not None:
            yield _used(draft)
            yield _fine_enough(draft, draft.pipeline.alignment.max_error_us)


def _used(draft: MachineFile) -> Iterator[Finding]:
    """Some detector has its sensors in several streams."""
    named = {sensor.name: sensor.stream for sensor in draft.sensors}
    if any(len({named.get(name) for name in together}) > 1 for together in draft.sampled_together):
        return
    yield Finding(
        _ALIGNMENT,
        "has no effect: no detector of the rotor has its sensors in several streams",
        "remove it",
        fatal=False,
    )


def _fine_enough(draft: MachineFile, max_error_us: float) -> Iterator[Finding]:
    """The error is a small part of a revolution."""
    speed_rpm = abs(draft.machine.speed_rpm)
    error_deg = 360.0 * speed_rpm / 60.0 * max_error_us / 1e6
    if error_deg > _COARSE_DEG:
        yield Finding(
            (*_ALIGNMENT, "max_error_us"),
            f"{max_error_us:g} us are {error_deg:.3g} deg of a revolution at {speed_rpm:g} rpm: as much as a "
            "fault moves the phase",
            f"write max_error_us = {_COARSE_DEG / 6.0 / speed_rpm * 1e6:.3g} or less, or bring the sensors "
            "together in one stream",
            fatal=False,
        )
