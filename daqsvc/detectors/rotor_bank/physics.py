"""Whether noise, rate and modes of a rotor bank can be, with such a rotor in such a clearance."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from daqsvc.settings.problems import Finding
from daqsvc.settings.rotor_physics import rest_um, whirl_um

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.detectors.rotor_bank.settings import Mode, RotorBank
    from daqsvc.settings.models import MachineFile, Rotor
    from daqsvc.settings.problems import KeyPath

_PER_NATURAL_PERIOD = 2.0
"""Samples of a period of the natural frequency: with fewer nothing of it is seen (Nyquist)."""


def physics_checks(draft: MachineFile, bank: RotorBank) -> Iterator[Iterator[Finding]]:
    """Every check of what the bank's figures and the rotor's mean together.

    Args:
        draft: the machine file, or what is valid of it.
        bank: its rotor bank.
    """
    rotor = draft.machine.rotor
    if rotor is None:
        return  # said already
    yield _noise(rotor, bank)
    yield _natural_frequency(draft, rotor, bank)
    for index, mode in enumerate(bank.modes[1:], 1):
        yield _mode(draft, rotor, mode, ("pipeline", "rotor_bank", "modes", index))


def _noise(rotor: Rotor, bank: RotorBank) -> Iterator[Finding]:
    if bank.noise_um >= rotor.clearance_um:
        yield Finding(
            ("pipeline", "rotor_bank", "noise_um"),
            f"hides every motion within clearance_um = {rotor.clearance_um:g}",
            "correct one of the two; probes have some 0.1 to 5 um",
        )


def _natural_frequency(draft: MachineFile, rotor: Rotor, bank: RotorBank) -> Iterator[Finding]:
    """The observers of the bank follow the free motion of the shaft, which must be sampled for that."""
    rates_hz = [
        draft.streams[sensor.stream].rate_hz
        for sensor in draft.sensors
        if sensor.name in bank.probes and sensor.stream in draft.streams
    ]
    if not rates_hz:
        return
    needed_hz = _PER_NATURAL_PERIOD * rotor.natural_frequency_hz
    if min(rates_hz) <= needed_hz:
        yield Finding(
            ("machine", "rotor", "natural_frequency_hz"),
            f"is not seen at {min(rates_hz):g} Hz, the rate of the bank's probes: half of that is the "
            "highest frequency that samples tell",
            f"sample faster than {needed_hz:g} Hz, or correct it",
        )


def _mode(draft: MachineFile, rotor: Rotor, mode: Mode, at: KeyPath) -> Iterator[Finding]:
    """A mode whose orbit does not fit the clearance is one with contact."""
    if mode.rub:
        return
    load_x_um, load_y_um = mode.static_load_um
    rest = math.hypot(rotor.static_load_x_um + load_x_um, load_y_um - rotor.static_sag_um)
    rest /= mode.stiffness_ratio
    damping_ratio = rotor.damping_ratio if mode.damping_ratio is None else mode.damping_ratio
    speed_rpm = draft.machine.speed_rpm
    whirl = whirl_um(
        rotor,
        speed_rpm,
        damping_ratio=damping_ratio,
        stiffness=mode.stiffness_ratio,
        unbalance=mode.unbalance_ratio,
    )
    healthy = rest_um(rotor) + whirl_um(rotor, speed_rpm, damping_ratio=rotor.damping_ratio)
    if rest + whirl >= rotor.clearance_um > healthy:
        yield Finding(
            at,
            f'mode "{mode.name}" would touch the stator: a whirl of {whirl:.4g} um about a rest at '
            f"{rest:.4g} um does not fit a clearance of {rotor.clearance_um:g} um, and its model knows no "
            "contact",
            "write rub = true in it, or a smaller fault",
            fatal=False,
        )
