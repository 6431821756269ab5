"""Whether a rotor bank fits sensors and machine, and whether its modes fit their names.

And whether its noise, rate and modes are possible with this rotor in this clearance.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING

from daqsvc.detectors.shaft.checks import LEAST_FOR_PULSES, check_geometry, check_rotor, check_sensors, named
from daqsvc.errors.alarms import SILENT_DETECTOR
from daqsvc.errors.detectors import (
    FALSE_ALARM_RATE,
    HEALTHY_MODE,
    MODE_TOUCHES,
    MODE_UNSEEN,
    MODE_WITHOUT_FAULT,
    NEEDS_ROTOR,
    NO_REVOLUTIONS,
    NOISE_TOO_LARGE,
)
from daqsvc.errors.machine_file import CONTRADICTION, SAMPLED_TOO_SLOWLY
from daqsvc.rounding import rounded_up
from daqsvc.settings.problems import Finding, unique
from daqsvc.settings.rotor_physics import rest_um, whirl_um
from daqsvc.settings.section import UnusableValueError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from daqsvc.detectors.rotor_bank.settings import Mode, RotorBank
    from daqsvc.settings.models import MachineFile, Rotor
    from daqsvc.settings.problems import KeyPath


_BANK: KeyPath = ("pipeline", "rotor_bank")
_MOST_PER_1000_REV = 1000.0


def bank_checks(draft: MachineFile, bank: RotorBank) -> Iterator[Iterator[Finding]]:
    """Every check of a rotor bank.

    Args:
        draft: the machine file, or what is valid of it.
        bank: its rotor bank.
    """
    yield check_rotor(draft, _BANK, "the model bank")
    yield _modelled(draft, bank)
    yield _measured(bank)
    yield check_sensors(draft, _BANK, bank.probes, bank.keyphasor)
    yield check_geometry(draft, _BANK, bank.probes)
    yield _pulses(draft, bank)
    yield _healthy_mode(draft, bank)
    for index, mode in enumerate(bank.modes):
        at: KeyPath = (*_BANK, "modes", index)
        yield _mode_fault(draft, mode, at)
        yield _static_load(draft, mode, at)
    yield _mode_names(bank)
    yield _rates(bank)
    yield from physics_checks(draft, bank)


def check_bank_alarm(bank: RotorBank, at: KeyPath) -> Iterator[Finding]:
    """An alarm can follow the bank: it decides between its modes.

    Args:
        bank: the rotor bank.
        at: where the alarm is in the file.
    """
    if bank.rule == "paper":
        yield Finding(
            (*at, "detector"),
            'would never raise it: pipeline.rotor_bank.rule = "paper" gives probabilities only',
            'write rule = "cusum", or remove the alarm',
            code=SILENT_DETECTOR,
        )


def _measured(bank: RotorBank) -> Iterator[Finding]:
    """What a run-up does not know of today's machine, its first revolutions show."""
    if bank.calibration is not None and bank.calibrate_revolutions == 0:
        yield Finding(
            (*_BANK, "calibrate_revolutions"),
            "is 0, with the rotor from a run-up: its unbalance and its rest may have changed since",
            "write e.g. calibrate_revolutions = 50",
            code=NO_REVOLUTIONS,
        )


def _modelled(draft: MachineFile, bank: RotorBank) -> Iterator[Finding]:
    """What only the models of the bank need to know of the rotor."""
    rotor = draft.machine.rotor
    if rotor is None:
        return  # reported already
    for key, about, example in (
        ("eccentricity_um", "mass eccentricity", "10.0"),
        ("contact_stiffness", "stiffness of the stator", "30.0"),
    ):
        if key == "eccentricity_um" and bank.calibration is not None:
            continue  # a run-up shows it
        with suppress(UnusableValueError):
            if getattr(rotor, key) is None:
                yield Finding(
                    ("machine", "rotor", key),
                    f"is missing: {about}; the model bank needs it",
                    f"add e.g. {key} = {example} to [machine.rotor], or remove [pipeline.rotor_bank]",
                    code=NEEDS_ROTOR,
                )


def _pulses(draft: MachineFile, bank: RotorBank) -> Iterator[Finding]:
    """A revolution has enough samples for the keyphasor's pulse."""
    keyphasor = named(draft).get(bank.keyphasor)
    if keyphasor is None or keyphasor.stream not in draft.streams:
        return
    rate_hz, speed_rpm = draft.streams[keyphasor.stream].rate_hz, abs(draft.machine.speed_rpm)
    samples = 60.0 * rate_hz / speed_rpm
    if samples < LEAST_FOR_PULSES:
        yield Finding(
            (*_BANK, "keyphasor"),
            f"is sampled {samples:.3g} times a revolution ({rate_hz:g} Hz at {speed_rpm:g} rpm): its pulses "
            f"need {LEAST_FOR_PULSES:g}",
            f"sample at {rounded_up(LEAST_FOR_PULSES * speed_rpm / 60.0, 4)} Hz or faster",
            code=SAMPLED_TOO_SLOWLY,
        )


def _healthy_mode(draft: MachineFile, bank: RotorBank) -> Iterator[Finding]:
    """The first mode is healthy, and the rotor that [machine.rotor] describes."""
    healthy, at = bank.modes[0], (*_BANK, "modes", 0)
    if healthy.severity != "normal":
        yield Finding(
            (*at, "severity"),
            "the first mode is the healthy one",
            'write severity = "normal", or put the healthy mode first',
            code=HEALTHY_MODE,
        )
    if healthy.fault is not None:
        yield Finding((*at, "fault"), "the first mode is the healthy one", "remove it", code=HEALTHY_MODE)
    for key in healthy.differs:
        if key != "damping_ratio":
            yield Finding(
                (*at, key),
                "the first mode is the healthy one: the rotor as [machine.rotor] describes it",
                "remove it, and correct [machine.rotor]",
                code=HEALTHY_MODE,
            )
    rotor = draft.machine.rotor
    if rotor is not None and healthy.damping_ratio not in {None, rotor.damping_ratio}:
        yield Finding(
            (*at, "damping_ratio"),
            f"differs from damping_ratio = {rotor.damping_ratio:g} of [machine.rotor], the healthy rotor",
            "remove it, or correct one of the two",
            code=HEALTHY_MODE,
        )


def _mode_fault(draft: MachineFile, mode: Mode, at: KeyPath) -> Iterator[Finding]:
    """A mode that is called a fault has what makes it one, and every mode but the first differs."""
    rotor = draft.machine.rotor
    healthy = None if rotor is None else rotor.damping_ratio
    less_damping = mode.damping_ratio is not None and (healthy is None or mode.damping_ratio < healthy)
    makes = {
        "unbalance": (mode.unbalance_ratio != 1.0, "unbalance_ratio = 1.8"),
        "damping_loss": (less_damping, f"damping_ratio = {0.5 * (healthy or 0.1):g}, below the healthy one"),
        "static_load": (mode.static_load_um != (0.0, 0.0), "static_load_um = [0.0, -10.0]"),
        "stiffness_loss": (mode.stiffness_ratio < 1.0, "stiffness_ratio = 0.9"),
        "rub": (mode.rub, "rub = true"),
    }
    if mode.fault is not None:
        made, example = makes[mode.fault]
        if not made:
            yield Finding(
                (*at, "fault"),
                "no figure of this mode fits that fault",
                f"write e.g. {example}",
                code=MODE_WITHOUT_FAULT,
            )
    elif at[-1] != 0 and not any(made for made, _ in makes.values()):
        examples = ", ".join(example.split(" = ")[0] for _, example in makes.values())
        yield Finding(
            at,
            f'mode "{mode.name}" is not worse than the healthy rotor',
            f"set one of {examples}, or remove the mode",
            code=MODE_WITHOUT_FAULT,
        )


def _static_load(draft: MachineFile, mode: Mode, at: KeyPath) -> Iterator[Finding]:
    """A static load is not sought with probes that do not show one."""
    if mode.static_load_um != (0.0, 0.0) and draft.ac_coupled:
        yield Finding(
            (*at, "static_load_um"),
            "cannot be seen: a probe of the bank is AC-coupled and shows no static position",
            "use DC-coupled probes (ac_coupled = false), or remove the mode",
            code=MODE_UNSEEN,
        )


def _mode_names(bank: RotorBank) -> Iterator[Finding]:
    """Names tell the modes apart."""
    yield from unique([mode.name for mode in bank.modes], (*_BANK, "modes"), "mode")


def _rates(bank: RotorBank) -> Iterator[Finding]:
    """A threshold is given in nats or by a rate, not both, and the rate asks for evidence at all."""
    for rate, nats in (
        ("false_alarms_per_1000_rev", "threshold_nats"),
        ("mtbf_hours", "back_threshold_nats"),
    ):
        if getattr(bank, rate) is not None and nats in bank.model_fields_set:
            yield Finding(
                (*_BANK, nats),
                f"is given by {rate} already",
                f"remove one of the two, e.g. {nats}",
                code=CONTRADICTION,
            )
    wanted = bank.false_alarms_per_1000_rev
    if wanted is not None and wanted >= _MOST_PER_1000_REV:
        yield Finding(
            (*_BANK, "false_alarms_per_1000_rev"),
            "would be a false alarm at every revolution",
            "write e.g. 0.02",
            code=FALSE_ALARM_RATE,
        )


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
        return  # reported already
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
            code=NOISE_TOO_LARGE,
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
            code=SAMPLED_TOO_SLOWLY,
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
            f"{rest:.4g} um does not fit a clearance of {rotor.clearance_um:g} um; its model has no contact",
            "write rub = true in it, or a smaller fault",
            fatal=False,
            code=MODE_TOUCHES,
        )
