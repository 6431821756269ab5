"""Whether the figures of a rotor can be true together: its orbit, clearance, natural frequency and speed.

The orbit is that of a Laval rotor without contact: forced by the unbalance, about where its static load bends
the shaft. Nothing here is a matter of taste: what is refused cannot be, or cannot be watched.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.errors.alarms import NEVER_REACHED
from daqsvc.errors.machine_file import ROTOR_FIGURES
from daqsvc.settings.alarms import SetpointAlarm
from daqsvc.settings.problems import Finding
from daqsvc.settings.section import UnusableValueError
from daqsvc.settings.sensors import ProximityProbe

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.settings.models import MachineFile, Rotor
    from daqsvc.settings.problems import KeyPath

_ROTOR: KeyPath = ("machine", "rotor")
_FAR_FROM_RUNNING = 30.0
"""Natural frequency over running speed, or the reverse: a rpm for a Hz is a factor of 60."""
_UM_PER_UNIT = {"um": 1.0, "mm": 1000.0, "mil": 25.4}
_REACH = {"rms": 1.0, "peak": 2.0, "peak_to_peak": 2.0}
"""What a shaft that fills its clearance shows at most, in clearances."""


def physics_checks(draft: MachineFile) -> Iterator[Iterator[Finding]]:
    """Every check of what the rotor's figures mean together.

    Args:
        draft: the machine file, or what is valid of it.
    """
    with suppress(UnusableValueError):
        rotor = draft.machine.rotor
        if rotor is None:
            return
        yield _sag(rotor)
        yield _orbit(draft, rotor)
        yield _running_speed(draft, rotor)
        yield _setpoints(draft, rotor)


def rest_um(rotor: Rotor) -> float:
    """How far from the middle of its clearance the healthy shaft rests."""
    return math.hypot(rotor.static_load_x_um, rotor.static_sag_um)


def whirl_um(
    rotor: Rotor, speed_rpm: float, *, damping_ratio: float, stiffness: float = 1.0, unbalance: float = 1.0
) -> float:
    """Radius of the 1X orbit if nothing touches; 0 if nothing is known of the unbalance.

    Args:
        rotor: the rotor.
        speed_rpm: its speed.
        damping_ratio: its damping.
        stiffness: that of the shaft over the healthy one's.
        unbalance: over the healthy one.
    """
    speed = abs(speed_rpm) / 60.0 / rotor.natural_frequency_hz
    unbalance *= rotor.eccentricity_um or 0.0
    resistance = math.hypot(stiffness - speed**2, 2.0 * damping_ratio * speed)
    return unbalance * speed**2 / resistance if resistance else math.inf


def _sag(rotor: Rotor) -> Iterator[Finding]:
    rest, clearance_um = rest_um(rotor), rotor.clearance_um
    if rest >= clearance_um:
        key = "static_sag_um" if rotor.static_sag_um >= abs(rotor.static_load_x_um) else "static_load_x_um"
        yield Finding(
            (*_ROTOR, key),
            f"lays the shaft on the stator: it would rest {rest:.4g} um from the middle of a clearance of "
            f"{clearance_um:g} um",
            "correct the sag, or the clearance (it is the radial one)",
            code=ROTOR_FIGURES,
        )


def _orbit(draft: MachineFile, rotor: Rotor) -> Iterator[Finding]:
    """The healthy rotor does not touch its stator."""
    eccentricity_um, clearance_um, rest = rotor.eccentricity_um, rotor.clearance_um, rest_um(rotor)
    if eccentricity_um is None or rest >= clearance_um:
        return
    whirl = whirl_um(rotor, draft.machine.speed_rpm, damping_ratio=rotor.damping_ratio)
    at = (*_ROTOR, "eccentricity_um")
    remedy = "correct eccentricity_um, damping_ratio, natural_frequency_hz or clearance_um (the radial one)"
    if rest + whirl >= clearance_um:
        yield Finding(
            at,
            f"makes the healthy rotor rub all the time: at {abs(draft.machine.speed_rpm):g} rpm it would "
            f"whirl by {whirl:.4g} um about a rest at {rest:.4g} um, in a clearance of "
            f"{clearance_um:g} um",
            remedy,
            code=ROTOR_FIGURES,
        )
    elif eccentricity_um >= clearance_um:
        yield Finding(
            at,
            f"is not less than clearance_um = {clearance_um:g}: near its natural frequency, and at any speed "
            "above, this rotor rubs",
            remedy,
            fatal=False,
            code=ROTOR_FIGURES,
        )


def _running_speed(draft: MachineFile, rotor: Rotor) -> Iterator[Finding]:
    """A natural frequency far from the speed is mostly one in another unit."""
    natural_hz, running_hz = rotor.natural_frequency_hz, abs(draft.machine.speed_rpm) / 60.0
    if max(natural_hz / running_hz, running_hz / natural_hz) > _FAR_FROM_RUNNING:
        yield Finding(
            (*_ROTOR, "natural_frequency_hz"),
            f"is {natural_hz / running_hz:.3g} times the speed of {running_hz:.4g} Hz: so far from it "
            "nothing that it tells shows in the orbit",
            "write it in Hz, and machine.speed_rpm in revolutions a minute",
            fatal=False,
            code=ROTOR_FIGURES,
        )


def _setpoints(draft: MachineFile, rotor: Rotor) -> Iterator[Finding]:
    """A shaft cannot move farther than the stator lets it."""
    probes = {sensor.name: sensor for sensor in draft.sensors if isinstance(sensor, ProximityProbe)}
    for index, alarm in enumerate(draft.alarms):
        if not isinstance(alarm, SetpointAlarm) or alarm.measure not in _REACH:
            continue
        units = [_UM_PER_UNIT.get(probes[name].unit) for name in alarm.watched if name in probes]
        for key, setpoint in alarm.setpoints.items():
            reach_um = _REACH[alarm.measure] * rotor.clearance_um
            if any(unit is not None and setpoint * unit > reach_um for unit in units):
                yield Finding(
                    ("alarms", index, key),
                    f"is more than the stator lets the shaft move: in a clearance of "
                    f"{rotor.clearance_um:g} um {alarm.measure} is {reach_um:g} um at most",
                    "correct it, or clearance_um (the radial one) of [machine.rotor]",
                    fatal=False,
                    code=NEVER_REACHED,
                )
                break
